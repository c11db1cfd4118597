"""The file formats of KITTI: numbered files, scans, pictures, calibrations and timestamps."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import BadInputError
from calib_ros.frame import NANOSECONDS, PointCloud
from calib_ros.messages.pictures import decode_picture

Matrix = NDArray[np.float64]
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")  # KITTI has PNG; copies are often recompressed
DIGITS = 10  # of a frame's number; more make no stamp
DATE = re.compile(r"(19|20)\d\d-\d\d-\d\d[ T]\d\d:\d\d:\d\d(\.\d{1,9})?Z?")
MAX_STAMP_S = 2**31  # what a message can hold
POINT_BYTES = 16  # x, y, z, reflectance as float32


def numbered_files(folder: Path, suffixes: tuple[str, ...]) -> dict[int, Path]:
    """Files named by frame numbers: number -> path, ascending. Empty if there is no such folder."""
    if not folder.is_dir():
        return {}
    files = [p for p in folder.iterdir() if p.suffix.lower() in suffixes and p.stem.isdecimal() and len(p.stem) <= DIGITS]
    return {int(p.stem): p for p in sorted(files, key=lambda p: int(p.stem))}


def read_scan(path: Path) -> PointCloud:
    """A Velodyne .bin in the order of the file, with intensity 0..1; KITTI stores neither rings nor times."""
    try:
        values = np.fromfile(path, "<f4")
        size = path.stat().st_size
    except OSError as error:
        raise BadInputError(f"scan {path} cannot be read ({error.strerror}); check the file") from error
    if size == 0 or size % POINT_BYTES:
        raise BadInputError(f"scan {path} is truncated: {size} bytes are not a multiple of {POINT_BYTES}; copy it again")
    points = values.reshape(-1, 4)
    return PointCloud(np.ascontiguousarray(points[:, :3]), points[:, 3].copy())


def read_picture(path: Path) -> NDArray[np.uint8]:
    """A picture as stored: (H, W) grey or (H, W, 3) BGR, uint8."""
    try:
        image = decode_picture(np.fromfile(path, np.uint8))
    except OSError:
        image = None
    if image is None:
        raise BadInputError(f"picture {path} is missing or unreadable; copy it again")
    if image.dtype != np.uint8 or (image.ndim == 3 and image.shape[2] != 3):
        raise BadInputError(f"picture {path} is no 8-bit grey or colour picture; copy it again")
    return np.asarray(image, np.uint8)


class CalibrationFile:
    """A text file of lines "key: numbers"."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            text = path.read_text("utf-8", "replace")
        except FileNotFoundError:
            raise BadInputError(
                f"calibration {path} is missing; download the calibration of this recording and put it there"
            ) from None
        except OSError as error:
            raise BadInputError(f"calibration {path} cannot be read ({error.strerror}); check the file") from error
        self._lines = {key.strip(): values for key, colon, values in (line.partition(":") for line in text.splitlines()) if colon}

    def matrix(self, key: str, rows: int, columns: int) -> Matrix:
        """The numbers of a key (rows, columns). BadInputError when it is missing or has others."""
        try:
            values = np.array(self._lines[key].split(), float)
        except KeyError:
            raise BadInputError(f"calibration {self.path} has no line '{key}:'; download the file again") from None
        except ValueError:
            values = np.zeros(0)
        if values.size != rows * columns or not np.isfinite(values).all():
            raise BadInputError(f"calibration {self.path}: '{key}' must have {rows * columns} numbers; download it again")
        return values.reshape(rows, columns)


class Timestamps:
    """One stamp per line, for ALL frames of the drive.

    So they are looked up by a frame's number: files may be missing.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._lines = path.read_text("utf-8", "replace").splitlines()
        except OSError as error:
            raise BadInputError(f"timestamps {path} cannot be read ({error.strerror}); check the file") from error

    @classmethod
    def if_present(cls, path: Path) -> Timestamps | None:
        """None when there is no such file."""
        return cls(path) if path.is_file() else None

    def ns(self, number: int) -> int:
        """Stamp in ns: of a date and time (taken as UTC) since 1970, of seconds as they are."""
        text = self._lines[number].strip() if number < len(self._lines) else ""
        try:
            if DATE.fullmatch(text):
                return int(np.datetime64(text.rstrip("Z").replace(" ", "T"), "ns").astype(np.int64))
            stamp = round(float(text) * NANOSECONDS)
            if abs(stamp) >= MAX_STAMP_S * NANOSECONDS:
                raise OverflowError
            return stamp
        except (ValueError, OverflowError):
            raise BadInputError(
                f"{self.path} has no timestamp on line {number + 1} for frame {number}; "
                "download it again, it has one line per frame of the drive"
            ) from None
