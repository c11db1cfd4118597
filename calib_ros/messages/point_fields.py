"""sensor_msgs/PointCloud2 of any field layout, Livox's CustomMsg, and columns of a file, -> PointCloud.

How to add a LiDAR driver
-------------------------
If `ros2 topic echo --once --field fields TOPIC` shows a name that is missing in POINT_FIELDS, append it to the names of its
quantity, in lower case; earlier names win where a cloud has several. A time unit is found from the duration of the scan, so that
most drivers need no entry in INTEGER_TIME_UNITS and FLOAT_TIME_UNITS. Add the driver to test/unit/messages/test_messages.py.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import BadInputError
from calib_ros.frame import PointCloud
from calib_ros.messages.wire import WireHeader, payload, shown, stamp_ns, wire_header

REQUIRED = ("x", "y", "z")  # m in the LiDAR frame
# Quantity of a point -> lower-case field names that drivers use, preferred first.
POINT_FIELDS: dict[str, tuple[str, ...]] = {
    **{name: (name,) for name in REQUIRED},
    # In the driver's unit; lidar.range_image.reflectivity scales it to 0..1. Ouster has both intensity and reflectivity.
    "intensity": ("intensity", "intensities", "i", "reflectivity", "reflectance", "remission"),
    # Number of the laser, in any order.
    "ring": ("ring", "channel", "line", "laser_id", "laser", "laser_number", "scan_line", "beam"),
    # When the point was measured, in any of the units below, from the header stamp or absolute.
    "time": ("time", "t", "timestamp", "time_stamp", "time_offset", "offset_time", "timeoffset", "point_time"),
}
# Units of times in ns per count, the usual one of the type first: Ouster's `t` is uint32 nanoseconds, Velodyne's `time` float32
# seconds, Hesai's and Robosense's `timestamp` float64 seconds, Livox's `timestamp` float64 nanoseconds.
INTEGER_TIME_UNITS = (1, 10**3, 10**6)
FLOAT_TIME_UNITS = (10**9, 10**6, 10**3, 1)
SCAN_NS = (5e5, 5e9)  # a scan lasts between 0.5 ms (a packet of points) and 5 s (a solid-state unit that accumulates)
RELATIVE_NS = 2e9  # times within this of zero count from the header stamp, others are absolute
SAME_CLOCK_NS = 5e9  # an absolute time farther than this from the header stamp comes from another clock
# Datatypes of sensor_msgs/PointField as numpy's; 9-11 exist since ROS 2 Lyrical.
DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8", 9: "i8", 10: "u8", 11: "u1"}
# Livox's own message, of its drivers: for ROS 2, its first units in ROS 2, ROS 1.
LIVOX = ("livox_ros_driver2/msg/CustomMsg", "livox_interfaces/msg/CustomMsg", "livox_ros_driver/msg/CustomMsg")
CUSTOM_POINT = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n"
CUSTOM_MSG = "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\nCustomPoint[] points\n"
# A point of it in CDR: 19 bytes, of which the next one begins at a multiple of four. Times are ns from the header's stamp.
LIVOX_FIELDS = {"offset_time": "u4", "x": "f4", "y": "f4", "z": "f4", "reflectivity": "u1", "tag": "u1", "line": "u1"}
LIVOX_OFFSETS, LIVOX_SIZE, LIVOX_STRIDE = (0, 4, 8, 12, 16, 17, 18), 19, 20


def decode_cloud(msg: Any) -> PointCloud:
    """sensor_msgs/PointCloud2 -> PointCloud; NaN points are kept, organised clouds are read row by row.

    Times become seconds from the header stamp (`seconds_from_stamp`). The arrays do not share the message's memory. Raises
    BadInputError for a cloud without x, y, z, a layout that contradicts itself, or fewer bytes than declared.
    """
    width, height = int(msg.width), int(msg.height)
    if width < 0 or height < 0:
        raise BadInputError(f"PointCloud2: size {width}x{height} is negative; check the LiDAR driver")
    if width * height == 0:
        return PointCloud(np.zeros((0, 3), np.float32))
    return cloud_of_columns(_columns(msg, width, height), stamp_ns(msg.header.stamp))


def livox_scan(data: bytes) -> tuple[WireHeader, bool, bytes]:
    """CDR bytes of a CustomMsg -> its header, whether it is big-endian, and points of LIVOX_STRIDE bytes each with LIVOX_FIELDS
    at LIVOX_OFFSETS. Raises BadInputError for a truncated message."""
    try:
        header, order = wire_header(data), "<" if data[1] & 1 else ">"
        (length,) = struct.unpack_from(order + "I", data, 12)
        at = -(-(12 + length) // 8) * 8  # the time base is aligned; offsets count from behind the first four bytes
        (count,) = struct.unpack_from(order + "I", data, 4 + at + 16)
    except (struct.error, IndexError):
        raise BadInputError(f"CustomMsg: {len(data)} bytes are no whole message; check the driver or the recording") from None
    begin, size = 4 + at + 20, count * LIVOX_STRIDE
    if begin + max(size - (LIVOX_STRIDE - LIVOX_SIZE), 0) > len(data):
        raise BadInputError(f"CustomMsg: {len(data)} bytes are too few for {count} points; the message is truncated")
    return header, order == ">", bytes(data[begin : begin + size]).ljust(size, b"\0")


def decode_livox(data: bytes) -> PointCloud:
    """CDR bytes of a CustomMsg -> PointCloud with times, lines and reflectivity. Raises BadInputError for a truncated message."""
    header, big_endian, whole = livox_scan(data)
    kinds = [">"[:big_endian] + kind for kind in LIVOX_FIELDS.values()]
    layout = np.dtype({"names": list(LIVOX_FIELDS), "formats": kinds, "offsets": LIVOX_OFFSETS, "itemsize": LIVOX_STRIDE})
    points = np.frombuffer(whole, layout)
    return cloud_of_columns({name: points[name] for name in LIVOX_FIELDS}, header.stamp)


def cloud_of_columns(columns: Mapping[str, NDArray[Any]], stamp: int = 0) -> PointCloud:
    """Columns (n,) of numbers by the field names of any driver, as files hold them -> PointCloud, as `decode_cloud`. stamp: of
    the cloud, ns, from which absolute times count. The arrays do not share memory with the columns. Raises BadInputError without
    x, y, z, or for columns of different lengths."""
    known = {name.strip().lower(): column for name, column in columns.items() if column.dtype.kind in "iufb"}
    missing = [name for name in REQUIRED if name not in known]
    if missing:
        raise BadInputError(
            f"the cloud has no field {', '.join(missing)} among ({', '.join(map(shown, columns)) or 'none'}); a point needs x, y "
            "and z, as those of a 3-D LiDAR have them"
        )
    chosen: dict[str, NDArray[Any]] = {}
    for quantity, names in POINT_FIELDS.items():
        name = next((name for name in names if name in known), None)
        if name is None:
            continue
        if known[name].shape != (len(known["x"]),):
            raise BadInputError(f"field {name} has shape {known[name].shape}, but there are {len(known['x'])} points")
        chosen[quantity] = known[name]
    # Garbage in a field must not print warnings for every scan: values out of float32's range become inf.
    with np.errstate(over="ignore", invalid="ignore"):
        xyz = np.empty((len(chosen["x"]), 3), np.float32)
        for axis, name in enumerate("xyz"):
            xyz[:, axis] = chosen[name]
        intensity, ring, time = (chosen.get(name) for name in ("intensity", "ring", "time"))
        seconds, problem = (None, "") if time is None else seconds_from_stamp(time, stamp)
        return PointCloud(
            xyz,
            None if intensity is None else intensity.astype(np.float32),
            None if ring is None else ring.astype(np.int32),
            seconds,
            time_problem=problem,
        )


def seconds_from_stamp(values: NDArray[Any], stamp: int) -> tuple[NDArray[np.float32] | None, str]:
    """Times (n,) of any number type and the header stamp in ns -> (n,) float32 seconds from that stamp, or None and why.

    The first unit in which the scan lasts as long as a scan can is used. Points without a time (zero or NaN) get 0. Where the
    stamp is unknown (0), absolute times count from the earliest point.
    """
    integers = values.dtype.kind in "iub"
    counts = values.astype(np.int64 if integers else np.float64)
    valid = (counts != 0) & np.isfinite(counts)
    if not valid.any():
        return np.zeros(len(counts), np.float32), ""
    number = int if integers else float  # Python's int cannot overflow in the differences below
    first, last = number(counts[valid].min()), number(counts[valid].max())
    span, units, (shortest, longest) = last - first, INTEGER_TIME_UNITS if integers else FLOAT_TIME_UNITS, SCAN_NS
    shorter = units[0] if span * units[0] < shortest else None
    unit = next((unit for unit in units if shortest <= span * unit <= longest), shorter)
    if unit is None:
        return None, "the times of the points span more than a scan can last in any unit; check the LiDAR driver"
    if max(abs(first), abs(last)) * unit <= RELATIVE_NS:
        origin = 0 * first
    elif (last - first) * unit < SCAN_NS[0] and values.dtype.itemsize < 8:
        return None, (
            f"the times of the points are absolute and all the same ({values.dtype.name}); let the LiDAR driver write them as "
            "float64 or relative to the header stamp"
        )
    elif abs(first * unit - stamp) <= SAME_CLOCK_NS:
        origin = stamp // unit if integers else stamp / unit
    elif stamp == 0:
        origin = first
    else:
        return None, (
            f"the times of the points are of another clock, {(first * unit - stamp) * 1e-9:+.0f} s from the header stamp (TAI is "
            "37 s ahead of UTC); let the LiDAR driver use one clock for both"
        )
    seconds = ((counts - origin) * (unit * 1e-9)).astype(np.float32)
    seconds[~valid] = 0
    return seconds, ""


def _columns(msg: Any, width: int, height: int) -> dict[str, NDArray[Any]]:
    """The fields of all points (n,) whose name and type are known; their layout is checked against the number of bytes. Of an
    array field the first element."""
    fields: dict[str, Any] = {}
    for field in msg.fields:
        fields.setdefault(str(field.name).strip().lower(), field)
    point_step = int(msg.point_step)
    for name, field in fields.items():
        code, offset = DATATYPES.get(int(field.datatype)), int(field.offset)
        if code is None and name in REQUIRED:
            raise BadInputError(f"PointCloud2: field {name} has unknown datatype {field.datatype}; check the LiDAR driver")
        # PCL, too, takes a count of 0 for 1.
        end = 0 if code is None else offset + np.dtype(code).itemsize * max(int(field.count), 1)
        if code is not None and (offset < 0 or end > point_step):
            raise BadInputError(
                f"PointCloud2: field {shown(name)} ends at byte {end}, but point_step is {point_step}; check its driver"
            )
    row_bytes = width * point_step
    # A cloud of one row needs no row_step, and some drivers leave it at 0 or at the size of a full scan.
    row_step = row_bytes if height == 1 else int(msg.row_step) or row_bytes
    if row_step < row_bytes:
        raise BadInputError(
            f"PointCloud2: row_step {row_step} is shorter than {width} points of {point_step} bytes; check the LiDAR driver"
        )
    data, order = payload(msg.data), ">" if msg.is_bigendian else "<"
    if len(data) < height * row_step:
        raise BadInputError(
            f"PointCloud2: {len(data)} bytes of data, but {width}x{height} points of {point_step} bytes "
            f"need {height * row_step}; the message is truncated, check the LiDAR driver or the recording"
        )
    shape, strides, columns = (height, width), (row_step, point_step), {}
    known = set(chain(*POINT_FIELDS.values()))
    for name, field in fields.items():
        if name in known and int(field.datatype) in DATATYPES:
            kind = order + DATATYPES[int(field.datatype)]
            columns[name] = np.ndarray(shape, kind, data, int(field.offset), strides).reshape(-1)
    return columns
