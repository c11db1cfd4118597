"""The message types by which bags are decoded."""

from __future__ import annotations

from functools import cache
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from calib_ros.messages.compressed_points import CLOUD_DEFINITION, COMPRESSED_POINTS
from calib_ros.messages.point_fields import CUSTOM_MSG, CUSTOM_POINT, LIVOX
from calib_ros.messages.video import FORMER_DEFINITION, FORMER_PACKET, VIDEO


@cache
def typestore() -> Typestore:
    """The message types of ROS 2, the same in every release: a bag's own definitions, maybe broken, are not needed."""
    store = get_typestore(Stores.ROS2_KILTED)
    for name in LIVOX:
        package = name.partition("/")[0]
        store.register(get_types_from_msg(CUSTOM_POINT, f"{package}/msg/CustomPoint"))
        store.register(get_types_from_msg(CUSTOM_MSG, name))
    for name, definition in {**VIDEO, FORMER_PACKET: FORMER_DEFINITION, COMPRESSED_POINTS: CLOUD_DEFINITION}.items():
        store.register(get_types_from_msg(definition, name))
    return store


def layout_of(connection: Any) -> str:
    """The type of `typestore` by which a connection's messages are decoded: of a name that has had two, by its definition."""
    former = connection.msgtype.endswith("/FFMPEGPacket") and "img_width" in connection.msgdef.data
    return FORMER_PACKET if former else str(connection.msgtype)


def cdr_of_ros1(data: bytes, connection: Any) -> bytes:
    """A message of a bag of ROS 1 -> CDR."""
    return bytes(typestore().ros1_to_cdr(data, layout_of(connection)))


def begins_with_header(connection: Any) -> bool:
    """Whether a connection's messages begin with a std_msgs/Header."""
    fields = typestore().fielddefs[layout_of(connection)][1]
    return bool(fields) and fields[0][0] == "header"
