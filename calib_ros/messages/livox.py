"""Livox's CustomMsg, of its drivers for ROS 1 and 2 -> PointCloud."""

from __future__ import annotations

import struct

import numpy as np

from calib_ros.errors import BadInputError
from calib_ros.frame import NANOSECONDS, PointCloud
from calib_ros.messages.point_fields import cloud_of_columns

LIVOX = ("livox_ros_driver2/msg/CustomMsg", "livox_ros_driver/msg/CustomMsg")
CUSTOM_POINT = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n"
CUSTOM_MSG = "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\nCustomPoint[] points\n"
# A point in CDR: 19 bytes, of which the next one begins at a multiple of four. Times are ns from the header's stamp.
FIELDS = {"time": "u4", "x": "f4", "y": "f4", "z": "f4", "reflectivity": "u1", "tag": "u1", "line": "u1"}
OFFSETS, SIZE, STRIDE = (0, 4, 8, 12, 16, 17, 18), 19, 20


def decode_livox(data: bytes) -> PointCloud:
    """CDR bytes of a CustomMsg -> PointCloud with times, lines and reflectivity. Raises BadInputError for a truncated message."""
    try:
        order = "<" if data[1] & 1 else ">"
        seconds, nanoseconds, length = struct.unpack_from(order + "iII", data, 4)
        at = -(-(12 + length) // 8) * 8  # the time base is aligned; offsets count from behind the first four bytes
        (count,) = struct.unpack_from(order + "I", data, 4 + at + 16)
        begin = 4 + at + 20
        if begin + max(count * STRIDE - (STRIDE - SIZE), 0) > len(data):
            raise BadInputError(f"CustomMsg: {len(data)} bytes are too few for {count} points; the message is truncated")
    except (struct.error, IndexError):
        raise BadInputError(f"CustomMsg: {len(data)} bytes are no whole message; record the bag again") from None
    kinds = [order + kind for kind in FIELDS.values()]
    layout = np.dtype({"names": list(FIELDS), "formats": kinds, "offsets": OFFSETS, "itemsize": STRIDE})
    padded = data[begin : begin + count * STRIDE].ljust(count * STRIDE, b"\0")
    points = np.frombuffer(padded, layout)
    return cloud_of_columns({name: points[name] for name in FIELDS}, seconds * NANOSECONDS + nanoseconds)
