"""A driver on Cyclone DDS, as rmw_cyclonedds is seen by others: plays the images, clouds and CameraInfo of a bag on ROS topics.

A process of its own: `python cyclone_driver.py BAG`, once the node under test subscribes to all of them reliably.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct, make_idl_struct, types
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Nodetype

PERIOD_S = 0.1
TOPICS = {"sensor_msgs/msg/Image": "image", "sensor_msgs/msg/PointCloud2": "points", "sensor_msgs/msg/CameraInfo": "camera_info"}
# Loopback without multicast; 1.15 is Fast DDS, whose type objects Cyclone refuses. rmw_cyclonedds has none of its own to compare.
CONFIG = """<CycloneDDS><Domain Id="any"><General><AllowMulticast>false</AllowMulticast>
<Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces></General>
<Compatibility><IgnoreTypeInformation>1.15</IgnoreTypeInformation></Compatibility>
<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>"""
NUMBERS = {f"{sign}int{bits}": getattr(types, f"{sign}int{bits}") for sign in ("", "u") for bits in (8, 16, 32, 64)}
NUMBERS |= {"float32": types.float32, "float64": types.float64, "bool": bool, "byte": types.byte, "string": str}


class Types:
    """Types of DDS that are those of ROS messages."""

    def __init__(self, store: Any) -> None:
        self._store = store
        self._made: dict[str, type[IdlStruct]] = {}

    def of(self, name: str) -> type[IdlStruct]:
        """ "sensor_msgs/msg/Image" -> sensor_msgs::msg::dds_::Image_."""
        if name not in self._made:
            package, _, kind = name.split("/")
            fields = {field: self._field(node) for field, node in self._store.fielddefs[name][1]}
            self._made[name] = make_idl_struct(kind, f"{package}::msg::dds_::{kind}_", fields)
        return self._made[name]

    def _field(self, node: Any) -> Any:
        kind, of = node
        if kind == Nodetype.BASE:
            return NUMBERS[of[0]]
        if kind == Nodetype.NAME:
            return self.of(of)
        return types.array[self._field(of[0]), of[1]] if kind == Nodetype.ARRAY else types.sequence[self._field(of[0])]

    def message(self, msg: Any) -> Any:
        """A message of rosbags as one of DDS."""
        if isinstance(msg, np.ndarray):
            return msg.tolist()
        if isinstance(msg, list):
            return [self.message(one) for one in msg]
        if not hasattr(msg, "__msgtype__"):
            return msg
        fields = (field for field, _ in self._store.fielddefs[msg.__msgtype__][1])
        return self.of(msg.__msgtype__)(**{field: self.message(getattr(msg, field)) for field in fields})


def play(bag: Path, domain: int) -> None:
    """Each message once, at the rate of a camera."""
    network = Domain(domain, CONFIG)
    participant = DomainParticipant(domain)
    qos = Qos(
        Policy.Reliability.Reliable(duration(seconds=10)),
        Policy.History.KeepLast(10),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )
    with AnyReader([bag]) as reader:
        dds = Types(reader.typestore)
        writers, messages = {}, []
        for connection, _, data in reader.messages():
            if (kind := connection.msgtype) not in TOPICS:
                continue
            if kind not in writers:
                writers[kind] = DataWriter(participant, Topic(participant, f"rt/{TOPICS[kind]}", dds.of(kind)), qos=qos)
            messages.append((kind, dds.message(reader.deserialize(data, kind))))
    while not all(writer.get_matched_subscriptions() for writer in writers.values()):
        time.sleep(PERIOD_S)
    time.sleep(1.0)  # the other side has to find the writer, too
    for kind, message in messages:
        writers[kind].write(message)
        time.sleep(PERIOD_S / len(writers))
    for writer in writers.values():
        writer.wait_for_acks(duration(seconds=10))
    del network


if __name__ == "__main__":
    play(Path(sys.argv[1]), int(os.environ["ROS_DOMAIN_ID"]))
