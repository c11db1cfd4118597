"""Real ROS messages for tests, built alike from the classes of rosbags and of rclpy."""

from __future__ import annotations

import array
import importlib
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

TYPES = get_typestore(Stores.ROS2_KILTED)
FAMILIES = ("rosbags", "rclpy")
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
        raw = (
            np.frombuffer(values, np.uint8)
            if isinstance(values, bytes)
            else np.ascontiguousarray(values).reshape(-1).view(np.uint8)
        )
        return raw if self.family == "rosbags" else array.array("B", raw.tobytes())

    def header(self, stamp: int = 1_700_000_000_123_456_789, frame: str = "sensor") -> Any:
        time = self.make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=frame)

    def image(self, encoding: str, width: int, height: int, data: Any, step: int, big: int = 0) -> Any:
        return self.make(
            "sensor_msgs/msg/Image",
            header=self.header(),
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=big,
            step=step,
            data=self.data(data),
        )

    def compressed(self, layout: str, data: bytes) -> Any:
        return self.make("sensor_msgs/msg/CompressedImage", header=self.header(), format=layout, data=self.data(data))

    def camera_info(self, width: int, height: int, K: Any, D: Any = (), P: Any = None, **fields: Any) -> Any:
        D = np.array(D, float)
        roi = self.make(
            "sensor_msgs/msg/RegionOfInterest",
            **dict(zip(("x_offset", "y_offset", "height", "width"), fields.get("roi", (0, 0, 0, 0)), strict=True)),
            do_rectify=False,
        )
        return self.make(
            "sensor_msgs/msg/CameraInfo",
            header=self.header(),
            height=height,
            width=width,
            distortion_model=fields.get("model", "plumb_bob"),
            d=D if self.family == "rosbags" else D.tolist(),
            k=np.array(K, float).reshape(9),
            r=np.eye(3).reshape(9),
            p=np.zeros(12) if P is None else np.array(P, float).reshape(12),
            binning_x=fields.get("binning", 0),
            binning_y=fields.get("binning", 0),
            roi=roi,
        )

    def cloud(self, points: np.ndarray, *, padding: int = 0, stamp: int = 1_700_000_000_123_456_789) -> Any:
        """A structured array (n,) or (rows, n) -> PointCloud2 with its layout and byte order; padding bytes per row."""
        rows = np.atleast_2d(points)
        dtype = rows.dtype
        order = "<"
        fields = []
        for name in dtype.names or ():
            kind, offset = dtype.fields[name][:2]
            base, shape = kind.subdtype or (kind, ())
            order = ">" if base.byteorder == ">" else order
            count = int(np.prod(shape, dtype=int))
            fields.append(
                self.make("sensor_msgs/msg/PointField", name=name, offset=offset, datatype=DATATYPES[base.str[1:]], count=count)
            )
        data = b"".join(row.tobytes() + b"\xff" * padding for row in rows)
        return self.make(
            "sensor_msgs/msg/PointCloud2",
            header=self.header(stamp),
            height=rows.shape[0],
            width=rows.shape[1],
            fields=fields,
            is_bigendian=order == ">",
            point_step=dtype.itemsize,
            row_step=rows.shape[1] * dtype.itemsize + padding,
            data=self.data(data),
            is_dense=False,
        )
