"""The files of KITTI: numbered files, scans, images, calibrations, timestamps, and oxts as velocities of the LiDAR."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.arrays import Matrix, Transform
from calib_ros.errors import BadInputError
from calib_ros.frame import NANOSECONDS, PointCloud
from calib_ros.messages.pictures import read_picture

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")  # KITTI has PNG; copies are often recompressed
# Numbers of a point: x, y, z, reflectance, and in other data sets its ring, time, or a radar's values; or x, y, z alone.
COLUMNS = (4, 3, 5, 6, 7, 8)
SAMPLED = 20000  # points that are looked at
SAME_SCAN = 0.5  # of their distance: neighbours in a scan are closer; 0.004 to 0.2 in scans, 1 to 1.4 where it is read wrongly
BINS, SURE, LEAST, ALIKE = 8, 5.0, 0.05, 0.9  # of `_distinct`: 0.2 to 1 for points in any order, and for multiples alike
DIGITS = 10  # of a frame number; longer names are not frames
DATE = re.compile(r"(19|20)\d\d-\d\d-\d\d[ T]\d\d:\d\d:\d\d(\.\d{1,9})?Z?")
MAX_STAMP_S = 2**31  # that a ROS message can hold
OXTS_FIELDS = 30
ATTITUDE, VELOCITY, RATES = slice(3, 5), slice(8, 11), slice(17, 20)  # roll, pitch; vf, vl, vu; wx, wy, wz
# T_velo_imu without calib_imu_to_velo.txt: aligned axes (they are to 0.9 deg) and the lever arm of the recordings' cars, m.
NOMINAL_LEVER_ARM = (-0.81, 0.32, -0.80)
PERIOD_S = 0.1033  # of a revolution, without timestamps_start.txt and timestamps_end.txt
TURN_LIMITS_S = (0.02, 0.5)  # stamps of start and end that give another duration are ignored
# The scanner triggers the cameras as it faces forward, which is when a scan is stamped (Geiger et al., Vision meets Robotics,
# 2013). An image's own stamp, 10.5 ms later, is when it arrived. On drive 0005, with the scans moved by oxts, the score at the
# recording's extrinsic is highest at 3 ms (29 frames) and 4 ms (the faster 13), that of the re-estimated one at 4.5 to 5 ms.
TRIGGER_TO_IMAGE_NS = 4_000_000
MAX_IMAGE_DELAY_NS = 50_000_000  # images stamped later were not triggered by this scan


def numbered_files(folder: Path, suffixes: tuple[str, ...], digits: int = DIGITS) -> dict[int, Path]:
    """Files named by frame number of at most so many digits: number -> path, ascending. Empty without the folder."""
    if not folder.is_dir():
        return {}
    files = [p for p in folder.iterdir() if p.suffix.lower() in suffixes and p.stem.isdecimal() and len(p.stem) <= digits]
    return {int(p.stem): p for p in sorted(files, key=lambda p: int(p.stem))}


def read_scan(path: Path, known: bool = True) -> PointCloud:
    """A Velodyne .bin in the order of the file, without rings and times. known, and what is raised: as of `read_points`."""
    points = read_points(path, COLUMNS, known)
    return PointCloud(np.ascontiguousarray(points[:, :3]), points[:, 3].copy() if points.shape[1] > 3 else None)


def read_points(path: Path, columns: Sequence[int], known: bool = True) -> NDArray[np.float32]:
    """Points (n, k) of a file of float32, k one of `columns`, which its numbers tell where the size fits several. known: where
    they do not tell, the first is taken. BadInputError if damaged, or if nobody knows."""
    try:
        values = np.fromfile(path, "<f4")
        size = path.stat().st_size
    except OSError as error:
        raise BadInputError(f"scan {path} cannot be read ({error.strerror}); check the file") from error
    usual, fits = columns[0], [k for k in sorted(columns) if size and size % (4 * k) == 0]
    if usual in fits and (len(fits) == 1 or _gap(values, usual) <= SAME_SCAN):
        return values.reshape(-1, usual)
    gaps = {k: _gap(values, k) for k in fits}
    told = sorted((k for k in fits if gaps[k] <= SAME_SCAN), key=lambda k: gaps[k])
    if not told:  # points in no order
        kinds = {k: _distinct(values, k) for k in fits}
        told = [k for k in fits if kinds[k] >= max(ALIKE * max(kinds.values()), LEAST)] or [usual] * (known and usual in fits)
    if not told and usual in fits:
        layouts = " or ".join(map(str, fits))
        raise BadInputError(f"scan {path} has {layouts} numbers a point, which they do not tell; save it as .npz")
    if not told:
        raise BadInputError(f"scan {path} is truncated: {size} bytes are not a multiple of {4 * usual}; copy it again")
    return values.reshape(-1, told[0])


def _gap(values: NDArray[np.float32], columns: int) -> float:
    """Median distance of points that follow each other, as a share of their distance, if numbers (n,) are of so many a point:
    small along the rings of a scan, and large where other numbers are taken for coordinates."""
    with np.errstate(over="ignore", invalid="ignore"):
        xyz = values[: columns * SAMPLED].reshape(-1, columns)[:, :3].astype(np.float64)
        gaps = np.linalg.norm(np.diff(xyz, axis=0), axis=1) / np.maximum(np.linalg.norm(xyz[1:], axis=1), 1e-3)
    known = gaps[np.isfinite(gaps)]
    return float(np.median(known)) if len(known) else np.inf


def _distinct(values: NDArray[np.float32], columns: int) -> float:
    """How much the place of a number in its point tells of its value, nats, if numbers (n,) are of so many a point."""
    values = values[: 4 * SAMPLED]
    ranks = np.argsort(np.argsort(values, kind="stable"), kind="stable")
    cells = np.arange(len(values)) % columns * BINS + ranks * BINS // len(values)
    joint = np.bincount(cells, minlength=columns * BINS).reshape(columns, BINS) / len(values)
    surprise = joint * np.log(np.maximum(joint, 1e-12) / np.outer(joint.sum(axis=1), joint.sum(axis=0)))
    freedom = (BINS - 1) * (columns - 1)  # of chance, which is chi-squared
    return float(surprise.sum() - (freedom + SURE * np.sqrt(2 * freedom)) / (2 * len(values)))


def read_image(path: Path) -> NDArray[np.uint8]:
    """An image as stored: (H, W) grey or (H, W, 3) BGR, uint8. BadInputError if missing or damaged."""
    image = read_picture(path)
    if image.dtype != np.uint8 or (image.ndim == 3 and image.shape[2] != 3):
        raise BadInputError(f"picture {path} is not an 8-bit grey or colour picture; copy it again")
    return np.asarray(image, np.uint8)


class CalibrationFile:
    """A text file of lines "key: numbers", or of numbers alone, whose key is ""."""

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
        lines = (line.partition(":") for line in text.splitlines() if line.strip())
        self._lines = {key.strip() if colon else "": values if colon else key for key, colon, values in lines}

    def matrix(self, key: str, rows: int, columns: int) -> Matrix:
        """The numbers of a key as (rows, columns). BadInputError if missing or of another size."""
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
    """A file with a stamp per line for ALL frames of the drive, indexed by frame number: frames may be missing."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._lines = path.read_text("utf-8", "replace").splitlines()
        except OSError as error:
            raise BadInputError(f"timestamps {path} cannot be read ({error.strerror}); check the file") from error

    @classmethod
    def if_present(cls, path: Path) -> Timestamps | None:
        """None without the file."""
        return cls(path) if path.is_file() else None

    def ns(self, number: int) -> int:
        """Stamp of a frame, ns: a date and time (taken as UTC) since 1970, or seconds as they are."""
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


def lidar_twist(values: Matrix, T_velo_imu: Transform) -> Matrix:
    """Numbers of an oxts file (30,) -> twist (6,) of the LiDAR in its own frame, rad/s and m/s."""
    # vf, vl, vu are level with the ground (dataformat.txt), wx, wy, wz in the body's frame: roll and pitch separate the two.
    roll, pitch = values[ATTITUDE]
    R_level_body = se3.rotation_from_euler(0.0, pitch, roll)
    R, t = T_velo_imu[:3, :3], T_velo_imu[:3, 3]
    turn = R @ values[RATES]
    # Lever arm: the LiDAR's origin is at -R' t in the IMU's frame.
    return np.concatenate([turn, R @ (R_level_body.T @ values[VELOCITY]) + np.cross(t, turn)])


class ScanMotion:
    """Point times and LiDAR velocity of a raw drive's scans. root: the drive. date: the folder of its calibrations. has_oxts:
    whether the drive has velocities."""

    def __init__(self, root: Path, date: Path) -> None:
        self._start = Timestamps.if_present(root / "velodyne_points" / "timestamps_start.txt")
        self._end = Timestamps.if_present(root / "velodyne_points" / "timestamps_end.txt")
        self._oxts, calibration = root / "oxts" / "data", date / "calib_imu_to_velo.txt"
        self.has_oxts = self._oxts.is_dir()
        self._T_velo_imu = se3.from_parts(np.eye(3), NOMINAL_LEVER_ARM)
        if calibration.is_file():
            file = CalibrationFile(calibration)
            parts = se3.from_parts(file.matrix("R", 3, 3), file.matrix("T", 3, 1)[:, 0])
            self._T_velo_imu = se3.as_transform(parts, f"the calibration {calibration}")

    def twist(self, number: int) -> Matrix | None:
        """(rx, ry, rz, tx, ty, tz) of the LiDAR in its frame, rad/s and m/s; None without a file. BadInputError if damaged."""
        path = self._oxts / f"{number:010d}.txt"
        if not path.is_file():
            return None
        try:
            values = np.array(path.read_text("utf-8", "replace").split(), float)
        except (OSError, ValueError):
            values = np.zeros(0)
        if len(values) != OXTS_FIELDS or not np.isfinite(values).all():
            raise BadInputError(f"{path} must have {OXTS_FIELDS} numbers, see dataformat.txt; copy it again or delete it")
        return lidar_twist(values, self._T_velo_imu)

    def period_s(self, number: int) -> float:
        """Duration of a scan's revolution, s."""
        if self._start is not None and self._end is not None:
            try:
                turn = (self._end.ns(number) - self._start.ns(number)) / NANOSECONDS
            except BadInputError:  # the nominal period is good enough
                return PERIOD_S
            if TURN_LIMITS_S[0] <= turn <= TURN_LIMITS_S[1]:
                return turn
        return PERIOD_S

    def times(self, cloud: PointCloud, number: int) -> NDArray[np.float32]:
        """(n,) s after the scan's stamp, at which the scanner, which turns clockwise, faces forward."""
        with np.errstate(invalid="ignore"):  # signalling NaN of a damaged file
            azimuth = np.arctan2(cloud.xyz[:, 1], cloud.xyz[:, 0])
        return np.asarray(-azimuth * (self.period_s(number) / (2 * np.pi)), np.float32)


def image_moment(image: int, scan: int) -> tuple[int, int]:
    """Stamps of timestamps.txt, ns -> exposure of the image and stamp of the scan, ns."""
    return (scan + TRIGGER_TO_IMAGE_NS if 0 <= image - scan <= MAX_IMAGE_DELAY_NS else image), scan
