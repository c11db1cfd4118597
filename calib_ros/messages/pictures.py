"""JPEG, PNG, BMP, TIFF and WebP bytes -> pixels, without trusting the size in the header."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import BadInputError

# More than any camera has; OpenCV allocates memory for all pixels before it reads the first one.
MAX_PIXELS = 2**27
# Of one-byte pixels, of which PNG packs up to eight into one; no encoder does better: deflate ends at 1032, JPEG at half of that.
PIXELS_PER_BYTE = 1100
PNG = b"\x89PNG\r\n\x1a\n"
JPEG = b"\xff\xd8\xff"
BMP = b"BM"
TIFF = {b"II*\0": "<", b"MM\0*": ">"}  # with the byte order
RIFF, WEBP = b"RIFF", b"WEBP"
# Tags of a TIFF: its size, and where its strips or tiles are, with their lengths. Types of their values by number.
TIFF_SIZE, TIFF_PARTS = (256, 257), ((273, 279), (324, 325))
TIFF_TAGS = (*TIFF_SIZE, *TIFF_PARTS[0], *TIFF_PARTS[1])
TIFF_TYPES = {1: "B", 3: "H", 4: "I"}
# Markers of a start of frame: 0xC0 to 0xCF without the tables and the extension among them.
FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


def decode_picture(data: NDArray[np.uint8]) -> NDArray[Any] | None:
    """JPEG, PNG, BMP, TIFF or WebP (n,) uint8 -> pixels as stored: (H, W) or (H, W, 3 or 4), uint8 or uint16, BGR; None if
    incomplete."""
    view = memoryview(data.tobytes())
    # Checked here, since OpenCV fills the rest of a truncated picture with grey: an edge that the camera never saw.
    formats = [(PNG, _png_header), (JPEG, _jpeg_header), (BMP, _bmp_header), (RIFF, _webp_header)]
    formats += [(magic, _tiff_header) for magic in TIFF]
    header = next((read(view) for magic, read in formats if view[: len(magic)] == magic), None)
    if header is None:
        return None
    width, height, packed = header
    if not 0 < width * height <= min(MAX_PIXELS, PIXELS_PER_BYTE * packed * len(view)):
        return None
    try:
        picture: Any = cv2.imdecode(np.frombuffer(view, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    return None if picture is None or picture.dtype not in (np.uint8, np.uint16) else np.asarray(picture)


def read_picture(path: Path, what: str = "picture") -> NDArray[Any]:
    """The same of a file. BadInputError, which calls it `what`, if it cannot be read or is incomplete."""
    try:
        picture = decode_picture(np.fromfile(path, np.uint8))
    except OSError as error:
        raise BadInputError(f"cannot read {what} {path}: {error.strerror}; check the file") from error
    if picture is None:
        raise BadInputError(f"{what} {path} is no complete PNG, JPEG, BMP, TIFF or WebP; copy it again")
    return picture


def _png_header(data: memoryview) -> tuple[int, int, int] | None:
    """Width, height and pixels per byte of a complete PNG with valid checksums."""
    at, header = len(PNG), None
    while at + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        if at + 12 + length > len(data):
            return None
        (checksum,) = struct.unpack_from(">I", data, at + 8 + length)
        if zlib.crc32(data[at + 4 : at + 8 + length]) != checksum:
            return None
        if kind == b"IHDR" and length == 13:
            width, height, bits = struct.unpack_from(">IIB", data, at + 8)
            header = (width, height, 8 // bits if bits in (1, 2, 4) else 1)
        if kind == b"IEND":
            return header
        at += 12 + length
    return None


def _jpeg_header(data: memoryview) -> tuple[int, int, int] | None:
    """Width, height and pixels per byte (1) of a JPEG with an end marker."""
    at = 2
    while at + 9 <= len(data):
        marker, length = data[at + 1], struct.unpack_from(">H", data, at + 2)[0]
        if data[at] != 0xFF:
            return None
        if marker in FRAMES:
            height, width = struct.unpack_from(">HH", data, at + 5)
            # Some cameras pad the bytes behind the end.
            return (width, height, 1) if bytes(data[at:]).rfind(b"\xff\xd9") > 0 else None
        at += 1 if marker == 0xFF else 2 + length  # bytes of 0xFF may fill the gap before a marker
    return None


def _bmp_header(data: memoryview) -> tuple[int, int, int] | None:
    """Width, height and pixels per byte of an uncompressed BMP with all its rows."""
    if len(data) < 54:
        return None
    offset, size, width, height, _, bits, compression = struct.unpack_from("<IIiiHHI", data, 10)
    height = abs(height)  # negative = from the top
    if size < 40 or width <= 0 or bits not in (1, 4, 8, 16, 24, 32) or compression not in (0, 3):
        return None
    complete = offset + height * ((width * bits + 31) // 32 * 4) <= len(data)
    return (width, height, max(8 // bits, 1)) if complete else None


def _tiff_header(data: memoryview) -> tuple[int, int, int] | None:
    """Width, height and pixels per byte of a TIFF with all its strips or tiles."""
    order = TIFF[bytes(data[:4])]
    try:
        (at,) = struct.unpack_from(order + "I", data, 4)
        (count,) = struct.unpack_from(order + "H", data, at)
        tags: dict[int, tuple[int, ...]] = {}
        for entry in range(at + 2, at + 2 + 12 * count, 12):
            tag, kind, number = struct.unpack_from(order + "HHI", data, entry)
            if tag in TIFF_TAGS and kind in TIFF_TYPES and number <= len(data):
                values = f"{order}{number}{TIFF_TYPES[kind]}"
                place = entry + 8 if struct.calcsize(values) <= 4 else struct.unpack_from(order + "I", data, entry + 8)[0]
                tags[tag] = struct.unpack_from(values, data, place)
        offsets, lengths = next((tags[own], tags[sizes]) for own, sizes in TIFF_PARTS if own in tags)
        complete = all(offset + length <= len(data) for offset, length in zip(offsets, lengths, strict=True))
        return (tags[TIFF_SIZE[0]][0], tags[TIFF_SIZE[1]][0], 8) if complete else None
    except (struct.error, KeyError, IndexError, ValueError, StopIteration):
        return None


def _webp_header(data: memoryview) -> tuple[int, int, int] | None:
    """Width, height and a bound of pixels per byte of a complete WebP."""
    if len(data) < 30 or bytes(data[8:12]) != WEBP or struct.unpack_from("<I", data, 4)[0] + 8 > len(data):
        return None
    kind = bytes(data[12:16])
    if kind == b"VP8X":
        width, height = (int.from_bytes(data[k : k + 3], "little") + 1 for k in (24, 27))
    elif kind == b"VP8L":
        bits = struct.unpack_from("<I", data, 21)[0]
        width, height = (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    else:
        width, height = (size & 0x3FFF for size in struct.unpack_from("<HH", data, 26))
    return width, height, 8
