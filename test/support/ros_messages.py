"""Real ROS messages for tests, built alike from the classes of rosbags and of rclpy."""

from __future__ import annotations

import array
import gzip
import importlib
import struct
from typing import Any

import numpy as np
import pytest

from calib_ros.datasets.bag_messages import typestore, zstd

TYPES = typestore()
FAMILIES = ("rosbags", "rclpy")
STAMP = 1_700_000_000_123_456_789
# numpy type -> PointField.datatype
DATATYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


class Messages:
    """Builds messages as the family's users meet them: numpy arrays in rosbags, array.array in rclpy."""

    def __init__(self, family: str) -> None:
        self.family = family
        if family == "rclpy":
            pytest.importorskip("rclpy", reason="rclpy is not installed")

    def make(self, kind: str, **fields: Any) -> Any:
        if self.family == "rosbags":
            return TYPES.types[kind](**fields)
        package, _, name = kind.split("/")
        return getattr(importlib.import_module(f"{package}.msg"), name)(**fields)

    def data(self, values: Any) -> Any:
        raw = np.frombuffer(values if isinstance(values, bytes) else np.ascontiguousarray(values).tobytes(), np.uint8)
        return raw if self.family == "rosbags" else array.array("B", raw.tobytes())

    def header(self, stamp: int = STAMP, frame: str = "sensor") -> Any:
        time = self.make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=frame)

    def image(self, encoding: str, width: int, height: int, data: Any, step: int, big: int = 0) -> Any:
        size = {"width": width, "height": height, "step": step, "is_bigendian": big}
        return self.make("sensor_msgs/msg/Image", header=self.header(), encoding=encoding, data=self.data(data), **size)

    def compressed(self, layout: str, data: bytes) -> Any:
        return self.make("sensor_msgs/msg/CompressedImage", header=self.header(), format=layout, data=self.data(data))

    def camera_info(self, width: int, height: int, K: Any, D: Any = (), P: Any = None, **fields: Any) -> Any:
        D = np.array(D, float)
        part = dict(zip(("x_offset", "y_offset", "height", "width"), fields.get("roi", (0, 0, 0, 0)), strict=True))
        matrices = {"k": np.array(K, float).reshape(9), "r": np.eye(3).reshape(9)}
        matrices["p"] = np.zeros(12) if P is None else np.array(P, float).reshape(12)
        return self.make(
            "sensor_msgs/msg/CameraInfo",
            **{"header": self.header(), "height": height, "width": width, **matrices},
            distortion_model=fields.get("model", "plumb_bob"),
            d=D if self.family == "rosbags" else D.tolist(),
            **dict.fromkeys(("binning_x", "binning_y"), fields.get("binning", 0)),
            roi=self.make("sensor_msgs/msg/RegionOfInterest", **part, do_rectify=False),
        )

    def compressed_cloud(self, points: np.ndarray, layout: str, data: bytes | None = None) -> Any:
        """A CompressedPointCloud2 as point_cloud_transport's plugins write it, by default zlib, zstd or draco."""
        raw = self.cloud(points)
        if data is None:
            pack = {"zlib": gzip.compress, "zstd": zstd.compress}.get(layout)
            data = draco(points) if pack is None else pack(raw.data.tobytes())
        return self.compressed_of(raw, layout, data)

    def compressed_of(self, cloud: Any, layout: str, data: bytes) -> Any:
        """A PointCloud2 -> the CompressedPointCloud2 with these data."""
        names = ("header", "height", "width", "fields", "is_bigendian", "point_step", "row_step", "is_dense")
        fields = {name: getattr(cloud, name) for name in names}
        return self.make(
            "point_cloud_interfaces/msg/CompressedPointCloud2", **fields, compressed_data=self.data(data), format=layout
        )

    def cloud(self, points: np.ndarray, *, padding: int = 0, stamp: int = STAMP, frame: str = "sensor") -> Any:
        """A structured array (n,) or (rows, n) -> PointCloud2 with its layout and byte order; padding bytes per row."""
        rows = np.atleast_2d(points)
        order, fields = "<", []
        for name in rows.dtype.names or ():
            kind, offset = rows.dtype.fields[name][:2]
            base, shape = kind.subdtype or (kind, ())
            order = ">" if base.byteorder == ">" else order
            count = int(np.prod(shape, dtype=int))
            layout = {"name": name, "offset": offset, "datatype": DATATYPES[base.str[1:]], "count": count}
            fields.append(self.make("sensor_msgs/msg/PointField", **layout))
        (height, width), step = rows.shape, rows.dtype.itemsize
        return self.make(
            "sensor_msgs/msg/PointCloud2",
            **{"header": self.header(stamp, frame), "height": height, "width": width, "fields": fields},
            **{"is_bigendian": order == ">", "point_step": step, "row_step": width * step + padding, "is_dense": False},
            data=self.data(b"".join(row.tobytes() + b"\xff" * padding for row in rows)),
        )


def draco(points: np.ndarray) -> bytes:
    """A structured array (n,) -> a Draco file as point_cloud_transport's plugin has it made: each field an attribute of its own,
    in their order, x, y and z as positions; here in sequence, without quantisation."""
    kinds = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 9, "f8": 10}
    names = points.dtype.names or ()
    # Version 2.3 of a point cloud in sequence, without flags; its points, one encoder, its attributes.
    out = b"DRACO" + bytes([2, 3, 0, 0, 0, 0]) + struct.pack("<i", len(points)) + bytes([1, len(names)])
    for number, name in enumerate(names):  # type (position or any), kind of number, how many, normalised or not, number
        out += bytes([0 if name in "xyz" else 4, kinds[points.dtype[name].str[1:]], 1, 0, number])
    return out + bytes(len(names)) + b"".join(points[name].tobytes() for name in names)
