"""KITTI raw drives, odometry sequences and object folders, and drives of KITTI-360, as sequences of frames."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib_ros import se3
from calib_ros.arrays import Matrix, Transform
from calib_ros.camera import Camera
from calib_ros.datasets.kitti_files import (
    IMAGE_SUFFIXES,
    CalibrationFile,
    ScanMotion,
    Timestamps,
    image_moment,
    numbered_files,
    read_image,
    read_scan,
)  # fmt: skip
from calib_ros.datasets.recent import Recent, Timed
from calib_ros.datasets.source import describe_camera
from calib_ros.errors import BadInputError
from calib_ros.frame import NANOSECONDS, Frame, PointCloud

# As kitti2bag names them.
CAMERA_FRAMES = ("camera_gray_left", "camera_gray_right", "camera_color_left", "camera_color_right")
LIDAR_FRAME, KITTI_360 = "velo_link", "360"
PERIOD_NS = NANOSECONDS // 10  # KITTI's cameras and scanner run at 10 Hz
EXPECTED_FOLDERS = (
    "velodyne_points/data and image_0N/data (KITTI raw), velodyne, image_N and calib.txt (KITTI odometry), "
    "velodyne, image_N and calib/ (KITTI object), image_0N/data_rect (KITTI-360: a drive of data_2d_raw)"
)
# Names of folders that hold drives: drives are found from above without searching a whole disk.
_PARENT_FOLDER = re.compile(
    r"\d{4}_\d\d_\d\d|data_2d_raw|sequences|dataset|raw|odometry|object|training|testing|\d\d", re.IGNORECASE
)


class KittiSource:
    """Frames of a KITTI raw drive, odometry sequence or object folder, for one of the cameras 0 to 3 (by default 2), or of a
    drive of KITTI-360, for its perspective camera 0 or 1.

    A frame is a number with an image and a scan; files are read on access. Frames of raw drives have point times, the exposure of
    the image as stamp and, with oxts, the LiDAR's twist. In the object layout each frame has its own calibration.

    Raises BadInputError, with the path and what to do, for another folder, a missing camera, missing or damaged files.
    """

    def __init__(self, path: str | Path, camera: int | str | None = None) -> None:
        root = find_drive(Path(path))
        if root is None:
            raise BadInputError(f"{path} is not a KITTI folder; looked for {EXPECTED_FOLDERS}")
        if isinstance(camera, str):
            raise BadInputError(f"{path} has no camera {camera}; KITTI's are numbers from 0 to 3")
        of_360 = layout_name(root) == KITTI_360
        camera = (0 if of_360 else 2) if camera is None else camera
        self._layout = layout_of(root, camera)
        self.cameras = list(map(str, self._layout.images))
        self.path = root
        self.name = root.resolve().name
        self.camera_frame = f"image_0{camera}" if of_360 else CAMERA_FRAMES[camera]
        self.lidar_frame = LIDAR_FRAME
        self.recent = Recent(0)  # scans that are kept
        self._camera_number = camera
        self._images = numbered_files(self._layout.images[camera], IMAGE_SUFFIXES)
        self._scans = numbered_files(self._layout.scans, (".bin",))
        self.numbers = sorted(self._images.keys() & self._scans.keys())
        if not self.numbers:
            pictures, scans = (os.path.relpath(part, root) for part in (self._layout.images[camera], self._layout.scans))
            raise BadInputError(
                f"{root}: no number has both a picture ({len(self._images)} in {pictures}) and a scan "
                f"({len(self._scans)} in {scans}); download both of this drive"
            )
        first = self.numbers[0]
        P, self.reference = self._layout.calibrate(first)
        height, width = read_image(self._images[first]).shape[:2]
        self.camera = Camera(P[:, :3], width, height)

    def calibration_at(self, index: int) -> tuple[Matrix, Matrix]:
        """Camera matrix (3, 3) and T_camera_lidar (4, 4) of a frame, whose picture and scan are not read."""
        P, T_camera_lidar = self._layout.calibrate(self.numbers[index])
        return P[:, :3], T_camera_lidar

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, index: int) -> Frame:
        number = self.numbers[index]
        image = read_image(self._images[number])
        P, T_camera_lidar = self._layout.calibrate(number)
        stamp, cloud_stamp = self._layout.stamps(number)
        height, width = image.shape[:2]
        motion = self._layout.motion
        return Frame(
            image=image,
            cloud=self._cloud(number),
            camera=Camera(P[:, :3], width, height),
            stamp=stamp,
            cloud_stamp=cloud_stamp,
            reference=T_camera_lidar,
            name=self._scans[number].stem,
            twist=None if motion is None else motion.twist(number),
            compensated=self._layout.compensated,
        )

    def scans(self) -> Timed:
        """The scans of all frames with their stamps, ns."""
        stamps = [self._layout.stamps(number) for number in self.numbers]
        moments = np.array([image if scan is None else scan for image, scan in stamps], np.int64)
        return Timed(moments, lambda index: self._cloud(self.numbers[index]))

    def _cloud(self, number: int) -> PointCloud:
        path, motion = self._scans[number], self._layout.motion
        cloud = self.recent(path, lambda: read_scan(path))
        return cloud if motion is None else replace(cloud, time=motion.times(cloud, number))

    def describe(self) -> dict[str, str]:
        """What the folder holds: label -> text."""
        frames, images, scans = len(self), len(self._images), len(self._scans)
        motion = "scans are compensated already" if self._layout.compensated else "unknown: no stamps of image and scan"
        if self._layout.motion is not None:
            motion = "from oxts" if self._layout.motion.has_oxts else "no oxts; can be estimated from consecutive scans"
        return {
            "kind": f"KITTI {self._layout.kind}",
            "path": str(self.path),
            "frames": f"{frames}, numbers {self.numbers[0]} to {self.numbers[-1]}; left out: "
            f"{images - frames} pictures without scan, {scans - frames} scans without picture",
            "stamps": self._layout.stamps_from,
            "motion": motion,
            "cameras": ", ".join(
                f"{number}{' (chosen)' if number == self._camera_number else ''}" for number in self._layout.images
            ),
            "camera": describe_camera(self.camera) + (" (of the first frame)" if self._layout.kind == "object" else ""),
            "camera_frame": self.camera_frame,
            "lidar_frame": self.lidar_frame,
            "reference": "from the calibration files" + (", one per frame" if self._layout.kind == "object" else ""),
        }


def drives_in(path: Path, depth: int = 3) -> list[Path]:
    """The drive at a path, or those up to so many folders below it, by name."""
    if layout_name(path):
        return [path]
    children = sorted(path.iterdir()) if depth and path.is_dir() else []
    inside = [child for child in children if layout_name(child) or _PARENT_FOLDER.fullmatch(child.name)]
    return [drive for child in inside for drive in drives_in(child, depth - 1)]


def find_drive(path: Path) -> Path | None:
    """The drive at a path: the path itself, or the only one below it; None if there is none, BadInputError for several."""
    drives = drives_in(path)
    if len(drives) > 1:
        shown = ", ".join(str(drive.relative_to(path)) for drive in drives[:8]) + (", ..." if len(drives) > 8 else "")
        raise BadInputError(f"{path} holds {len(drives)} KITTI drives: {shown}; give the folder of one of them")
    return drives[0] if drives else None


@dataclass(frozen=True)
class DriveLayout:
    """Where a drive has its files.

    images: folder of each camera present, by number. calibrate: frame number -> P (3, 4) of the rectified camera and
    T_camera_lidar (4, 4). stamps: frame number -> stamp of the image in ns, and of the scan if known. motion: velocity and point
    times, if known. compensated: whether the scans are motion-compensated.
    """

    kind: str
    images: dict[int, Path]
    scans: Path
    calibrate: Callable[[int], tuple[Matrix, Matrix]]
    stamps: Callable[[int], tuple[int, int | None]] = lambda number: (number * PERIOD_NS, None)
    stamps_from: str = ""
    motion: ScanMotion | None = None
    compensated: bool = False


def layout_of(root: Path, camera: int) -> DriveLayout:
    """The layout of a drive for one of its cameras (0, 1 grey; 2, 3 colour). BadInputError if something is missing."""
    kind = layout_name(root)
    pattern, scans = {
        "raw": ("image_0{}/data", "velodyne_points/data"),
        KITTI_360: ("image_0{}/data_rect", f"../../data_3d_raw/{root.absolute().name}/velodyne_points/data"),
    }.get(kind, ("image_{}", "velodyne"))
    images = {number: root / pattern.format(number) for number in range(4) if (root / pattern.format(number)).is_dir()}
    if not (root / scans).is_dir():
        raise BadInputError(f"{root} looks like KITTI {kind}, but has no folder {scans}; download the laser scans too")
    if camera not in images:
        has = f"it has {', '.join(map(str, images))}" if images else "it has none"
        raise BadInputError(
            f"{root} has no images of camera {camera} ({pattern.format(camera)}), {has}; choose another camera or download them"
        )
    builder = {"raw": _raw, "odometry": _odometry, "object": _object, KITTI_360: _kitti_360}[kind]
    return builder(root, camera, images, root / scans)


def layout_name(root: Path) -> str:
    """Layout of a folder by its content, even if incomplete; "" if it is not KITTI."""
    if any((root / f"image_0{n}" / "data_rect").is_dir() for n in range(2)):
        return KITTI_360
    if (root / "velodyne_points").is_dir() or any((root / f"image_0{n}" / "data").is_dir() for n in range(4)):
        return "raw"
    if (root / "velodyne").is_dir() or any((root / f"image_{n}").is_dir() for n in range(4)):
        return "object" if (root / "calib").is_dir() else "odometry"
    return ""


def _raw(root: Path, camera: int, images: dict[int, Path], scans: Path) -> DriveLayout:
    date = root if (root / "calib_cam_to_cam.txt").exists() else root.absolute().parent
    cameras, velodyne = (CalibrationFile(date / "calib_cam_to_cam.txt"), CalibrationFile(date / "calib_velo_to_cam.txt"))
    P = cameras.matrix(f"P_rect_0{camera}", 3, 4)
    Tr = np.c_[velodyne.matrix("R", 3, 3), velodyne.matrix("T", 3, 1)]
    T = _extrinsic(P, cameras.matrix("R_rect_00", 3, 3), Tr, velodyne.path)
    return _timed(DriveLayout("raw", images, scans, lambda _: (P, T)), camera, ScanMotion(root, date), image_moment)


def _kitti_360(root: Path, camera: int, images: dict[int, Path], scans: Path) -> DriveLayout:
    calibration = root.absolute().parents[1] / "calibration"
    cameras, velodyne = CalibrationFile(calibration / "perspective.txt"), CalibrationFile(calibration / "calib_cam_to_velo.txt")
    P = cameras.matrix(f"P_rect_0{camera}", 3, 4)
    T_velo_camera = se3.as_transform(np.vstack([velodyne.matrix("", 3, 4), [0, 0, 0, 1]]), f"the extrinsic of {velodyne.path}")
    T = _extrinsic(P, cameras.matrix("R_rect_00", 3, 3), se3.inverse(T_velo_camera)[:3], velodyne.path)
    # How its cameras are triggered is not KITTI's: their stamps are taken as they are.
    layout = DriveLayout(KITTI_360, images, scans, lambda _: (P, T))
    return _timed(layout, camera, ScanMotion(scans.parents[1], calibration), lambda image, scan: (image, scan))


def _timed(
    layout: DriveLayout, camera: int, motion: ScanMotion, moments: Callable[[int, int], tuple[int, int | None]]
) -> DriveLayout:
    """A layout with the stamps of the files timestamps.txt beside images and scans. moments: of the exposure and of the scan, by
    their stamps."""
    of_images = Timestamps.if_present(layout.images[camera].parent / "timestamps.txt")
    of_scans = Timestamps.if_present(layout.scans.parent / "timestamps.txt")

    def stamps(number: int) -> tuple[int, int | None]:
        if of_images is None:
            return number * PERIOD_NS, None
        return (of_images.ns(number), None) if of_scans is None else moments(of_images.ns(number), of_scans.ns(number))

    stamps_from = "10 Hz assumed, no timestamps.txt of the images" if of_images is None else "timestamps.txt"
    # Point times relative to the image need the stamps of both sensors.
    known = None if of_images is None or of_scans is None else motion
    return replace(layout, stamps=stamps, stamps_from=stamps_from, motion=known)


def _odometry(root: Path, camera: int, images: dict[int, Path], scans: Path) -> DriveLayout:
    calibration = CalibrationFile(root / "calib.txt")
    P = calibration.matrix(f"P{camera}", 3, 4)
    # Here Tr leads to the rectified camera 0, so that there is no R0_rect.
    T = _extrinsic(P, np.eye(3), calibration.matrix("Tr", 3, 4), calibration.path)
    times = Timestamps.if_present(root / "times.txt")

    def stamps(number: int) -> tuple[int, int | None]:
        return (number * PERIOD_NS if times is None else times.ns(number)), None

    stamps_from = "10 Hz assumed, no times.txt" if times is None else "times.txt"
    return DriveLayout("odometry", images, scans, lambda _: (P, T), stamps, stamps_from, compensated=True)


def _object(root: Path, camera: int, images: dict[int, Path], scans: Path) -> DriveLayout:
    def calibrate(number: int) -> tuple[Matrix, Matrix]:
        calibration = CalibrationFile(root / "calib" / f"{number:06d}.txt")
        P, R0 = calibration.matrix(f"P{camera}", 3, 4), calibration.matrix("R0_rect", 3, 3)
        return P, _extrinsic(P, R0, calibration.matrix("Tr_velo_to_cam", 3, 4), calibration.path)

    return DriveLayout(
        "object", images, scans, calibrate, lambda number: (number * PERIOD_NS, None), "none: scenes 0.1 s apart by number"
    )


def _extrinsic(P: Matrix, R0_rect: Matrix, Tr: Transform, path: Path) -> Transform:
    """T_camN_velo = [I | inv(K) P[:, 3]] R0_rect Tr (4, 4) (Geiger et al., Vision meets Robotics, 2013, eq. 4-8)."""
    # The last column of P holds the offset between the rectified cameras, about 6 cm for camera 2.
    K = P[:, :3]
    if abs(np.linalg.det(K)) < 1e-9:
        raise BadInputError(f"calibration {path}: a projection matrix is singular; download the calibration again")
    offset = se3.from_parts(np.eye(3), np.linalg.solve(K, P[:, 3]))
    bottom = [0.0, 0.0, 0.0, 1.0]
    return se3.as_transform(offset @ se3.from_parts(R0_rect, np.zeros(3)) @ np.vstack([Tr, bottom]), f"the extrinsic of {path}")
