"""Point clouds in files: PCD, PLY, LAS, text, KITTI's .bin and numpy's .npz -> PointCloud.

The names of fields, and the units of times, are those of the drivers: see `calib_ros.messages.point_fields`.
"""

from __future__ import annotations

import re
import struct
import warnings
from collections.abc import Callable
from io import BufferedReader, BytesIO
from itertools import islice, takewhile
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from calib_ros.datasets.kitti_files import read_scan
from calib_ros.errors import BadInputError, MissingDependencyError
from calib_ros.frame import PointCloud
from calib_ros.messages.point_fields import cloud_of_columns

Columns = dict[str, NDArray[Any]]
NEEDS_PCD = "PCD files are read with pypcd4, which is missing: python3 -m pip install pypcd4"
NEEDS_PLY = "PLY files are read with trimesh, which is missing: python3 -m pip install trimesh"
NEEDS_LAS = "LAS and LAZ files are read with laspy, which is missing: python3 -m pip install 'laspy[lazrs]'"
PCD_HEADER, MOST_PACKED = 10, 256  # lines at most; bytes that LZF makes of one at most
UNNAMED = "#$%&~~"  # what pypcd4 calls PCD's padding fields, "_"
PCD_DATA = re.compile(rb"^DATA[ \t]+(\w+)[^\n]*\n", re.MULTILINE)
PCD_LINES = [re.compile(rb"^%s[ \t]+([^\n]*)" % name, re.MULTILINE) for name in (b"FIELDS", b"SIZE", b"TYPE", b"COUNT")]
TEXT_NAMES = ("x", "y", "z", "intensity")  # of columns without a header
TEXT_SUFFIXES = (".csv", ".txt", ".xyz", ".asc", ".pts")
COMMENTS = ("#", "//")
# Formats of clouds that are not read, and with what they become one that is.
FOREIGN = {
    ".e57": "E57; convert it: pdal translate FILE.e57 FILE.pcd",
    ".pcap": "packets of a LiDAR; play them into its ROS driver and record the cloud",
    ".obj": "a mesh; export its points as PLY",
    ".stl": "a mesh; export its points as PLY",
    ".npy": "an array without names; save it with numpy.savez(FILE, xyz=...)",
    ".pkl": "a Python pickle; save it with numpy.savez(FILE, xyz=...)",
    ".rcp": "ReCap's; export it as PLY",
    ".fls": "Faro's; export it as PLY",
    ".drc": "Draco's; decode it as PLY: draco_decoder -i FILE.drc",
}
LAS_HEADER = 255  # bytes up to the number of points, since version 1.4
LAZ, LAZ_RATIO = 0x80, 500  # bit of the format of compressed points; bytes that a compressed one stands for at most, usually 10
PANIC = "PanicException"  # of lazrs, which is no Exception
CLOUD_COMPARE = "scalar_"  # before the names of fields in PLY files that CloudCompare writes


def read_cloud(path: Path, stamp: int = 0) -> PointCloud:
    """The points of a file by its ending, one of CLOUD_SUFFIXES; NaN points are kept. A .bin has float32 x, y, z, and maybe
    intensity and more numbers a point.

    stamp: of the cloud, ns, from which absolute times of points count. Raises BadInputError for a damaged file or one without
    x, y, z; MissingDependencyError without the library that reads it.
    """
    suffix = path.suffix.lower()
    if suffix == ".bin":
        return read_scan(path, known=False)
    try:
        columns = _READERS[suffix](path)
    except (BadInputError, MissingDependencyError):
        raise
    except OSError as error:
        raise BadInputError(f"cloud {path} cannot be read ({error.strerror or 'damaged'}); copy it again") from error
    except Exception as error:  # of a damaged file the libraries raise whatever the first wrong byte leads to
        why = " ".join(str(error).split())[:120] or type(error).__name__
        raise BadInputError(f"cloud {path} is damaged or no {suffix[1:].upper()} file ({why}); copy it again") from error
    try:
        return cloud_of_columns(columns, stamp)
    except BadInputError as error:
        raise BadInputError(f"cloud {path}: {error}") from error


def _read_pcd(path: Path) -> Columns:
    """PCD 0.7, ascii, binary or binary_compressed: columns by field; of an array field the first element."""
    try:
        from pypcd4 import MetaData
        from pypcd4 import PointCloud as PcdFile
    except ImportError:
        raise MissingDependencyError(NEEDS_PCD) from None
    whole = _tidy_pcd(path.read_bytes())
    lines = (line.decode().strip() for line in BytesIO(whole))
    header = takewhile(lambda line: not line.startswith("DATA"), (line for line in lines if line and not line.startswith("#")))
    declared = MetaData.parse_header([*islice(header, PCD_HEADER), "DATA ascii"])
    if sum(declared.count) > len(whole) or declared.points > MOST_PACKED * len(whole):  # pypcd4 makes room for all of it
        raise BadInputError(f"cloud {path} declares more than its {len(whole)} bytes can hold; copy it again")
    file = PcdFile.from_fileobj(BufferedReader(BytesIO(whole)))
    data = np.atleast_1d(file.pc_data)
    _require_all(path, len(data), file.points)
    names = [name for name in data.dtype.names or () if not name.startswith(UNNAMED)]
    return {name.removesuffix("__0000"): data[name] for name in names}


def _tidy_pcd(data: bytes) -> bytes:
    """A PCD as pypcd4 wants it, where PCL wants less: COUNT in the header, values of an ascii file one space apart."""
    last = PCD_DATA.search(data)
    if last is None:
        return data
    head, body = data[: last.start()], data[last.end() :]
    lines = [line.search(head) for line in PCD_LINES]
    fields, *_, counts = (line[1].split() if line else [] for line in lines)
    if fields and not counts:
        head += b"COUNT" + b" 1" * len(fields) + b"\n"
    if b"0" in counts:  # padding, which has no bytes
        for line in reversed(lines):
            if line and len(words := line[1].split()) == len(counts):
                kept = b" ".join(word for word, count in zip(words, counts, strict=True) if count != b"0")
                head = head[: line.start(1)] + kept + head[line.end(1) :]
    if last[1] == b"ascii":
        body = b"\n".join(b" ".join(line.split()) for line in body.splitlines())
    return head + last[0] + body


def _read_las(path: Path) -> Columns:
    """LAS or LAZ: metres from the file's scale and offset, and the dimensions by name."""
    try:
        import laspy
    except ImportError:
        raise MissingDependencyError(NEEDS_LAS) from None
    _check_las(path)
    try:
        # Not its parallel one, which makes room for chunks of any size.
        file = laspy.read(path, laz_backend=laspy.LazBackend.Lazrs)
    except laspy.errors.LaspyException as error:
        if "backend" in str(error).lower():
            raise MissingDependencyError(NEEDS_LAS) from None
        raise
    except BaseException as error:
        if type(error).__name__ != PANIC:
            raise
        raise BadInputError(f"cloud {path} is damaged ({error}); copy it again") from None
    _require_all(path, len(file.points), file.header.point_count)
    names = {"intensity": "intensity", "gps_time": "time"}
    columns = {name: np.asarray(file[own]) for own, name in names.items() if own in file.point_format.dimension_names}
    return {"x": np.asarray(file.x), "y": np.asarray(file.y), "z": np.asarray(file.z), **columns}


def _check_las(path: Path) -> None:
    """BadInputError for a header of more records, points or chunks than the file can hold: laspy reads records one by one, and
    lazrs ends the process where memory does not suffice."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(LAS_HEADER).ljust(LAS_HEADER, b"\0")
        chunks = _laz_chunks(file, struct.unpack_from("<I", head, 96)[0], size) if head[104] & LAZ else 0
    records, length, points = (struct.unpack_from(kind, head, at)[0] for kind, at in (("<I", 100), ("<H", 105), ("<I", 107)))
    extended = 0
    if head[25] >= 4:
        extended, points = struct.unpack_from("<IQ", head, 243)
    held = LAZ_RATIO * size if head[104] & LAZ else size
    for what, count, most in (
        ("records", records, size // 54),
        ("extended records", extended, size // 60),
        ("points", points, held // max(length, 20)),
        ("chunks", chunks, size),
    ):
        if count > most:
            raise BadInputError(f"cloud {path} is damaged or truncated: its header speaks of {count} {what}; copy it again")


def _laz_chunks(file: BinaryIO, begin: int, size: int) -> int:
    """Number of chunks of a LAZ file of so many bytes, by its table. Where that is stands where the points begin, or, if a stream
    was written, -1 there and the place at the end."""

    def number(kind: str, at: int) -> int:
        file.seek(min(max(at, 0), size))
        return int(struct.unpack(kind, file.read(struct.calcsize(kind)).ljust(struct.calcsize(kind), b"\0"))[0])

    table = number("<q", begin)
    return number("<I", (number("<q", size - 8) if table == -1 else table) + 4)


def _read_text(path: Path) -> Columns:
    """Text of a point a line, between commas, semicolons or blanks: by the first line that names x, y and z, or x, y, z,
    intensity. A word that is no number is NaN."""
    lines = [line.strip() for line in path.read_text("utf-8-sig").splitlines()]
    if any(";" in line for line in lines):  # where commas are decimal
        lines = [line.replace(",", ".") for line in lines]
    split = re.compile(r"\s*;\s*|\s+" if any(";" in line for line in lines) else r"\s*,\s*|\s+").split
    headers = [[name.strip("\"'").lower() for name in split(line.lstrip("#/ "))] for line in lines]
    at = next((k for k, header in enumerate(headers) if {*"xyz"} <= {*header}), None)
    points = [line for k, line in enumerate(lines) if line and k != at and not line.startswith(COMMENTS)]
    if points and points[0].isdecimal() and int(points[0]) == len(points) - 1:
        del points[0]  # the number of points
    columns = len(split(points[0])) if points else len(TEXT_NAMES)
    names = list(TEXT_NAMES[:columns]) if at is None else headers[at]
    rows = np.array([[_number(word) for word in split(line)[: len(names)]] for line in points]).reshape(-1, len(names))
    if len(rows) and not np.isfinite(rows).any():
        raise BadInputError(f"cloud {path} has no numbers; give a point a line, x y z intensity, or a first line with names")
    return dict(zip(names, rows.T, strict=True))


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return np.nan


def _read_ply(path: Path) -> Columns:
    """PLY, ascii or binary: columns by property of the element "vertex"."""
    try:
        from trimesh.exchange.ply import load_ply
    except ImportError:
        raise MissingDependencyError(NEEDS_PLY) from None
    with path.open("rb") as file, warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # numpy only warns of text that is no number
        elements = load_ply(file, skip_materials=True)["metadata"]["_ply_raw"]
    vertex = elements.get("vertex")
    if vertex is None:
        raise BadInputError(f"cloud {path} has no element 'vertex'; export it as a point cloud")
    if not vertex["length"]:
        return {name.removeprefix(CLOUD_COMPARE): np.zeros(0, np.float32) for name in vertex["properties"]}
    data = vertex["data"]
    columns = {name: np.asarray(data[name]) for name in vertex["properties"]}
    scalars = {name.removeprefix(CLOUD_COMPARE): column.ravel() for name, column in columns.items() if column.dtype.names is None}
    _require_all(path, min(map(len, scalars.values()), default=0), vertex["length"])
    return scalars


def _read_npz(path: Path) -> Columns:
    """Arrays xyz or points (n, 3), or x, y and z, and whatever other fields of n numbers there are."""
    with np.load(path, allow_pickle=False) as file:
        arrays: Columns = {name.lower(): file[name] for name in file.files}
    for name in ("xyz", "points"):
        if name in arrays:
            xyz = arrays.pop(name)
            if xyz.ndim != 2 or xyz.shape[1] != 3:
                raise BadInputError(f"cloud {path}: {name} has shape {xyz.shape}, but must be (n, 3); save other fields by name")
            arrays |= dict(zip("xyz", xyz.T, strict=True))
            break
    return {name: np.squeeze(array, 1) if array.ndim == 2 and array.shape[1] == 1 else array for name, array in arrays.items()}


def _require_all(path: Path, found: int, declared: int) -> None:
    if found < declared:
        raise BadInputError(f"cloud {path} is truncated: {found} of {declared} points; copy it again")


_READERS: dict[str, Callable[[Path], Columns]] = {
    **{".pcd": _read_pcd, ".ply": _read_ply, ".npz": _read_npz},
    **dict.fromkeys((".las", ".laz"), _read_las),
    **dict.fromkeys(TEXT_SUFFIXES, _read_text),
}
CLOUD_SUFFIXES = (*_READERS, ".bin")
