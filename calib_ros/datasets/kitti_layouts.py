"""KITTI's three folder layouts: raw drives, odometry sequences and the object benchmark."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.datasets.kitti_files import CalibrationFile, Timestamps
from calib_ros.datasets.kitti_motion import ScanMotion, image_moment
from calib_ros.errors import BadInputError
from calib_ros.frame import NANOSECONDS

Matrix = NDArray[np.float64]
PERIOD_NS = NANOSECONDS // 10  # KITTI's cameras and scanner run at 10 Hz
LOOKED_FOR = (
    "velodyne_points/data and image_0N/data (KITTI raw), velodyne, image_N and calib.txt (KITTI odometry), "
    "velodyne, image_N and calib/ (KITTI object)"
)
# Folders that hold drives, so that these are found from above without searching a whole disk.
_CONTAINER = re.compile(r"\d{4}_\d\d_\d\d|sequences|dataset|raw|odometry|object|training|testing|\d\d", re.IGNORECASE)


@dataclass(frozen=True)
class Layout:
    """Where a drive keeps what.

    images: folder of each camera present, by its number. calibrate: frame number -> P (3, 4), the rectified
    camera's projection, and T_camera_lidar (4, 4). stamps: frame number -> ns of the image, and of the scan
    if known. motion: how the vehicle moves and when the points were measured, if known. compensated: whether the
    scans are corrected for it already.
    """

    kind: str
    root: Path
    images: dict[int, Path]
    scans: Path
    calibrate: Callable[[int], tuple[Matrix, Matrix]]
    stamps: Callable[[int], tuple[int, int | None]]
    stamps_from: str
    motion: ScanMotion | None = None
    compensated: bool = False

    @property
    def motion_from(self) -> str:
        """For people: where the vehicle's motion during a scan is known from."""
        if self.compensated:
            return "scans are compensated already"
        if self.motion is None:
            return "unknown: no stamps of image and scan"
        return "from oxts" if self.motion.has_oxts else "no oxts; can be estimated from consecutive scans"


def drives_in(path: Path) -> list[Path]:
    """The drive at a path, or those below it, by name."""
    return [path] if _kind(path) else _drives_below(path, 3)


def find_drive(path: Path) -> Path | None:
    """The drive at a path: the path itself, or the only one below it; None if there is none.

    BadInputError when there are several.
    """
    drives = drives_in(path)
    if len(drives) > 1:
        shown = ", ".join(str(drive.relative_to(path)) for drive in drives[:8]) + (", ..." if len(drives) > 8 else "")
        raise BadInputError(f"{path} holds {len(drives)} KITTI drives: {shown}; give the folder of one of them")
    return drives[0] if drives else None


def layout_of(root: Path, camera: int) -> Layout:
    """The layout of a drive's folder, for one of its cameras (0 and 1 grey, 2 and 3 colour)."""
    kind = _kind(root)
    pattern, scans = ("image_0{}/data", "velodyne_points/data") if kind == "raw" else ("image_{}", "velodyne")
    images = {number: root / pattern.format(number) for number in range(4) if (root / pattern.format(number)).is_dir()}
    if not (root / scans).is_dir():
        raise BadInputError(f"{root} looks like KITTI {kind}, but has no folder {scans}; download the laser scans, too")
    if camera not in images:
        has = f"it has {', '.join(map(str, images))}" if images else "it has none"
        raise BadInputError(
            f"{root} has no images of camera {camera} ({pattern.format(camera)}), {has}; choose another camera or download them"
        )
    builder = {"raw": _raw, "odometry": _odometry, "object": _object}[kind]
    return builder(root, camera, images, root / scans)


def _kind(root: Path) -> str:
    """Layout of a folder by what it contains, even if incomplete; "" when it is none."""
    if (root / "velodyne_points").is_dir() or any((root / f"image_0{n}" / "data").is_dir() for n in range(4)):
        return "raw"
    if (root / "velodyne").is_dir() or any((root / f"image_{n}").is_dir() for n in range(4)):
        return "object" if (root / "calib").is_dir() else "odometry"
    return ""


def _drives_below(path: Path, depth: int) -> list[Path]:
    if not depth or not path.is_dir():
        return []
    drives: list[Path] = []
    for child in sorted(path.iterdir()):
        if child.is_dir() and _kind(child):
            drives.append(child)
        elif _CONTAINER.fullmatch(child.name):
            drives += _drives_below(child, depth - 1)
    return drives


def _raw(root: Path, camera: int, images: dict[int, Path], scans: Path) -> Layout:
    date = root if (root / "calib_cam_to_cam.txt").exists() else root.absolute().parent
    cameras, velodyne = (CalibrationFile(date / "calib_cam_to_cam.txt"), CalibrationFile(date / "calib_velo_to_cam.txt"))
    P = cameras.matrix(f"P_rect_0{camera}", 3, 4)
    Tr = np.c_[velodyne.matrix("R", 3, 3), velodyne.matrix("T", 3, 1)]
    T = _extrinsic(P, cameras.matrix("R_rect_00", 3, 3), Tr, velodyne.path)
    of_images = Timestamps.if_present(images[camera].parent / "timestamps.txt")
    of_scans = Timestamps.if_present(scans.parent / "timestamps.txt")

    def stamps(number: int) -> tuple[int, int | None]:
        if of_images is None:
            return number * PERIOD_NS, None
        return (of_images.ns(number), None) if of_scans is None else image_moment(of_images.ns(number), of_scans.ns(number))

    stamps_from = "10 Hz assumed" if of_images is None else "timestamps.txt"
    # Without both sensors' stamps it is not known when, relative to the image, a point was measured.
    motion = None if of_images is None or of_scans is None else ScanMotion(root, date)
    return Layout("raw", root, images, scans, lambda _: (P, T), stamps, stamps_from, motion)


def _odometry(root: Path, camera: int, images: dict[int, Path], scans: Path) -> Layout:
    calibration = CalibrationFile(root / "calib.txt")
    P = calibration.matrix(f"P{camera}", 3, 4)
    # Here Tr leads to the rectified camera 0 already, so there is no R0_rect.
    T = _extrinsic(P, np.eye(3), calibration.matrix("Tr", 3, 4), calibration.path)
    times = Timestamps.if_present(root / "times.txt")

    def stamps(number: int) -> tuple[int, int | None]:
        return (number * PERIOD_NS if times is None else times.ns(number)), None

    stamps_from = "10 Hz assumed" if times is None else "times.txt"
    return Layout("odometry", root, images, scans, lambda _: (P, T), stamps, stamps_from, compensated=True)


def _object(root: Path, camera: int, images: dict[int, Path], scans: Path) -> Layout:
    def calibrate(number: int) -> tuple[Matrix, Matrix]:
        calibration = CalibrationFile(root / "calib" / f"{number:06d}.txt")
        P, R0 = calibration.matrix(f"P{camera}", 3, 4), calibration.matrix("R0_rect", 3, 3)
        return P, _extrinsic(P, R0, calibration.matrix("Tr_velo_to_cam", 3, 4), calibration.path)

    return Layout(
        "object", root, images, scans, calibrate, lambda number: (number * PERIOD_NS, None), "none: scenes 0.1 s apart by number"
    )


def _extrinsic(P: Matrix, R0_rect: Matrix, Tr: Matrix, path: Path) -> Matrix:
    """T_camN_velo = [I | inv(K) P[:, 3]] R0_rect Tr (4, 4): scanner, camera 0, rectified camera 0, camera N.

    From Geiger et al., Vision meets Robotics, 2013, eq. 4-8; the offset between the rectified cameras, about
    6 cm for camera 2, is hidden in the last column of P.
    """
    K = P[:, :3]
    if abs(np.linalg.det(K)) < 1e-9:
        raise BadInputError(f"calibration {path}: a projection matrix is singular; download the calibration again")
    offset = se3.from_parts(np.eye(3), np.linalg.solve(K, P[:, 3]))
    bottom = [0.0, 0.0, 0.0, 1.0]
    return se3.as_transform(offset @ se3.from_parts(R0_rect, np.zeros(3)) @ np.vstack([Tr, bottom]), f"the extrinsic of {path}")
