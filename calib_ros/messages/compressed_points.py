"""point_cloud_interfaces/CompressedPointCloud2, as the plugins of point_cloud_transport write it -> PointCloud."""

from __future__ import annotations

import sys
import zlib
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import BadInputError, MissingDependencyError
from calib_ros.frame import PointCloud
from calib_ros.messages.point_fields import POINT_FIELDS, cloud_of_columns, decode_cloud
from calib_ros.messages.wire import payload, shown, stamp_ns

COMPRESSED_POINTS = "point_cloud_interfaces/msg/CompressedPointCloud2"
CLOUD_DEFINITION = (
    "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\nbool is_bigendian\nuint32 point_step\n"
    "uint32 row_step\nuint8[] compressed_data\nbool is_dense\nstring format\n"
)
REPUBLISH = "republish the cloud as raw (`ros2 run point_cloud_transport republish`) and record that"
MAX_BYTES = 2**28  # of a cloud: 8 million points of 32 bytes
MAX_POINTS = MAX_BYTES // 32
DRACO_HEADER, DRACO_METADATA = 11, 0x80  # bytes; in its last one
FLOAT64 = 8  # of sensor_msgs/PointField
GZIP_OR_ZLIB = 32 + zlib.MAX_WBITS  # the plugin writes the former


def decode_compressed_cloud(msg: Any) -> PointCloud:
    """zlib, zstd and Draco -> PointCloud, as `decode_cloud`. Raises BadInputError for other formats and for damaged data,
    MissingDependencyError for Draco without DracoPy."""
    kind, data = str(msg.format).strip().lower(), payload(msg.compressed_data).tobytes()
    if kind == "draco":
        return _draco(msg, data)
    if kind not in ("zlib", "zstd"):
        raise BadInputError(f"CompressedPointCloud2: format '{shown(msg.format)}' is not read; {REPUBLISH}")
    size = int(msg.height) * max(int(msg.row_step), int(msg.width) * int(msg.point_step))
    if not 0 <= size <= MAX_BYTES:
        raise BadInputError(f"CompressedPointCloud2: {size} bytes are more than any scan has; check the recording")
    try:
        points = _inflated(kind, data, max(size, 1))  # 0 would be no limit
    except Exception as error:  # each library has errors of its own
        raise _damaged(kind, error) from None
    fields = {
        name: getattr(msg, name) for name in ("header", "height", "width", "fields", "is_bigendian", "point_step", "row_step")
    }
    return decode_cloud(SimpleNamespace(**fields, data=points))


def _inflated(kind: str, data: bytes, size: int) -> bytes:
    if kind == "zlib":
        return zlib.decompressobj(GZIP_OR_ZLIB).decompress(data, size)
    if sys.version_info >= (3, 14):
        from compression import zstd
    else:  # rosbags requires it
        from backports import zstd
    return bytes(zstd.ZstdDecompressor().decompress(data, size))


def _draco(msg: Any, data: bytes) -> PointCloud:
    """The plugin makes each field an attribute of its own, in their order, and may leave out points or change their order."""
    try:
        import DracoPy
    except ImportError:
        raise MissingDependencyError(
            "clouds compressed by Draco are read with DracoPy, which is missing: python3 -m pip install DracoPy"
        ) from None
    try:
        count = _draco_points(data)
    except (IndexError, RecursionError) as error:
        raise _damaged("Draco", error) from None
    if not 0 <= count <= min(int(msg.width) * int(msg.height), MAX_POINTS):
        raise BadInputError(f"CompressedPointCloud2: {count} points of Draco for {msg.width}x{msg.height}; record the bag again")
    try:
        decoded = DracoPy.decode(data)
        columns: list[NDArray[Any]] = [np.asarray(attribute["data"]) for attribute in decoded.attributes]
    except Exception as error:  # DracoPy has errors of its own
        raise _damaged("Draco", error) from None
    fields = list(msg.fields)
    if len(columns) != len(fields):
        raise BadInputError(f"CompressedPointCloud2: {len(columns)} attributes of Draco for {len(fields)} fields; {REPUBLISH}")
    kept = {str(field.name): column[:, 0] for field, column in zip(fields, columns, strict=True) if column.ndim == 2}
    # DracoPy turns float64 into float32, which leaves nothing of absolute times.
    lost = [f.name for f in fields if f.datatype == FLOAT64 and str(f.name).strip().lower() in POINT_FIELDS["time"]]
    cloud = cloud_of_columns({name: column for name, column in kept.items() if name not in lost}, stamp_ns(msg.header.stamp))
    problem = f"times as float64 are lost in decoding Draco; {REPUBLISH}"
    return replace(cloud, time_problem=problem) if lost and cloud.time is None else cloud


def _draco_points(data: bytes) -> int:
    """The number of points that a Draco file says it has, for which its decoder takes memory. IndexError if it is truncated."""
    at = DRACO_HEADER

    def number() -> int:
        nonlocal at
        value = shift = 0
        while True:
            value, shift, at = value | (data[at] & 127) << shift, shift + 7, at + 1
            if data[at - 1] < 128:
                return value

    def skip_metadata() -> None:
        nonlocal at
        for _ in range(number()):
            at += 1 + data[at]  # the name of an entry
            size = number()  # which moves on, too
            at += size
        for _ in range(number()):
            at += 1 + data[at]
            skip_metadata()

    if data[DRACO_HEADER - 1] & DRACO_METADATA:
        for _ in range(number()):  # first those of the attributes
            number()
            skip_metadata()
        skip_metadata()
    return int.from_bytes(bytes(data[k] for k in range(at, at + 4)), "little", signed=True)


def _damaged(kind: str, error: Exception) -> BadInputError:
    reason = " ".join(str(error).split()) or type(error).__name__
    return BadInputError(f"CompressedPointCloud2: {kind} data is damaged ({shown(reason)}); record the bag again")
