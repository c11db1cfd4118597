"""sensor_msgs/PointCloud2 of any field layout -> PointCloud."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import BadInputError
from calib_ros.frame import PointCloud
from calib_ros.messages.point_times import seconds_from_stamp
from calib_ros.messages.wire import payload, stamp_ns

# sensor_msgs/PointField; 9-11 exist since ROS 2 Lyrical.
DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8", 9: "i8", 10: "u8", 11: "u1"}
# Names that drivers use, the preferred one first (Ouster has both intensity and reflectivity).
INTENSITY = ("intensity", "intensities", "i", "reflectivity", "reflectance", "remission")
RING = ("ring", "channel", "line", "laser_id", "laser", "laser_number", "scan_line", "beam")
TIME = ("time", "t", "timestamp", "time_stamp", "time_offset", "offset_time", "timeoffset", "point_time")


def decode_cloud(msg: Any) -> PointCloud:
    """sensor_msgs/PointCloud2 -> PointCloud, NaN points kept, organised clouds row by row.

    Times become seconds relative to the header stamp (`seconds_from_stamp`). The arrays do not share the
    message's memory. BadInputError: no x, y, z, a layout that contradicts itself, or fewer bytes than declared.
    """
    width, height = int(msg.width), int(msg.height)
    if width < 0 or height < 0:
        raise BadInputError(f"PointCloud2: size {width}x{height} is negative; check the LiDAR driver")
    if width * height == 0:
        return PointCloud(np.zeros((0, 3), np.float32))
    layout = _Layout.of(msg, width, height)
    # Garbage in a field must not print warnings for every scan: values out of float32's range become inf.
    with np.errstate(over="ignore", invalid="ignore"):
        xyz = np.empty((height, width, 3), np.float32)
        for axis, name in enumerate("xyz"):
            xyz[:, :, axis] = layout.column(layout.fields[name])
        intensity, ring, time = (layout.first_of(names) for names in (INTENSITY, RING, TIME))
        return PointCloud(
            xyz.reshape(-1, 3),
            None if intensity is None else intensity.astype(np.float32).ravel(),
            None if ring is None else ring.astype(np.int32).ravel(),
            None if time is None else seconds_from_stamp(time.ravel(), stamp_ns(msg.header.stamp)),
        )


@dataclass(frozen=True)
class _Layout:
    """Where each field of each point lies in the message's bytes, checked against their number."""

    fields: dict[str, Any]
    data: NDArray[np.uint8]
    shape: tuple[int, int]  # height, width
    strides: tuple[int, int]  # bytes from row to row, from point to point
    byte_order: str

    @classmethod
    def of(cls, msg: Any, width: int, height: int) -> _Layout:
        fields: dict[str, Any] = {}
        for field in msg.fields:
            fields.setdefault(str(field.name).strip().lower(), field)
        missing = [name for name in "xyz" if name not in fields]
        if missing:
            raise BadInputError(
                f"PointCloud2: no field {', '.join(missing)} among ({', '.join(fields) or 'none'}); "
                "choose the topic of a 3-D LiDAR with x, y, z"
            )
        point_step = int(msg.point_step)
        for name, field in fields.items():
            _check_field(name, field, point_step)
        row_bytes = width * point_step
        # A cloud of one row needs no row_step, and some drivers leave it at 0 or at the size of a full scan.
        row_step = row_bytes if height == 1 else int(msg.row_step) or row_bytes
        if row_step < row_bytes:
            raise BadInputError(
                f"PointCloud2: row_step {row_step} is shorter than {width} points of {point_step} bytes; check the LiDAR driver"
            )
        data = payload(msg.data)
        if len(data) < height * row_step:
            raise BadInputError(
                f"PointCloud2: {len(data)} bytes of data, but {width}x{height} points of {point_step} bytes "
                f"need {height * row_step}; the message is truncated, check the LiDAR driver or the recording"
            )
        return cls(fields, data, (height, width), (row_step, point_step), ">" if msg.is_bigendian else "<")

    def column(self, field: Any) -> NDArray[Any]:
        """A field of all points (height, width) as a view; of an array field its first element."""
        dtype = np.dtype(self.byte_order + DATATYPES[int(field.datatype)])
        column: NDArray[Any] = np.ndarray(self.shape, dtype, self.data, int(field.offset), self.strides)
        return column

    def first_of(self, names: tuple[str, ...]) -> NDArray[Any] | None:
        """The column of the first name that the cloud has."""
        for name in names:
            field = self.fields.get(name)
            if field is not None and int(field.datatype) in DATATYPES:
                return self.column(field)
        return None


def _check_field(name: str, field: Any, point_step: int) -> None:
    code = DATATYPES.get(int(field.datatype))
    if code is None:
        if name in ("x", "y", "z"):
            raise BadInputError(f"PointCloud2: field {name} has unknown datatype {field.datatype}; check the LiDAR driver")
        return
    offset = int(field.offset)
    end = offset + np.dtype(code).itemsize * max(int(field.count), 1)  # PCL, too, takes a count of 0 for 1
    if offset < 0 or end > point_step:
        raise BadInputError(f"PointCloud2: field {name} ends at byte {end}, but point_step is {point_step}; check its driver")
