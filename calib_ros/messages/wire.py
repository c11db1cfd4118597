"""Stamp and byte payload, which all ROS messages share."""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib_ros.frame import NANOSECONDS


class WireHeader(NamedTuple):
    """A std_msgs/Header as it lies in a message."""

    seconds: int
    nanoseconds: int
    frame_id: str

    @property
    def stamp(self) -> int:
        """ns."""
        return self.seconds * NANOSECONDS + self.nanoseconds


def wire_header(data: bytes) -> WireHeader:
    """The header that begins a CDR message; the rest is not decoded. struct.error for less than 16 bytes."""
    order = "<" if data[1:2] == b"\1" else ">"
    seconds, nanoseconds, length = struct.unpack_from(order + "iII", data, 4)
    return WireHeader(seconds, nanoseconds, bytes(data[16 : 16 + length]).rstrip(b"\0").decode("utf-8", "replace"))


def stamp_ns(stamp: Any) -> int:
    """builtin_interfaces/Time (`sec`, `nanosec`) -> nanoseconds."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def shown(text: object) -> str:
    """Text from a message for an error: one line of at most 80 characters."""
    line = " ".join(str(text).encode("utf-8", "backslashreplace").decode().split())
    return line if len(line) <= 80 else f"{line[:77]}..."


def payload(data: Any) -> NDArray[np.uint8]:
    """A message's `data` -> (n,) uint8 that shares its memory. rosbags has numpy arrays, rclpy array.array or bytes; only a plain
    list of numbers is copied."""
    if isinstance(data, np.ndarray):
        return np.ascontiguousarray(data).reshape(-1).view(np.uint8)
    if isinstance(data, (list, tuple)):
        return np.array(data, np.uint8)
    return np.frombuffer(data, np.uint8) if len(data) else np.zeros(0, np.uint8)
