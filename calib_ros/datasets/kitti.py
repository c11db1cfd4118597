"""KITTI folders as sequences of frames."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.datasets.source import describe_camera
from calib_ros.errors import BadInputError
from calib_ros.frame import NANOSECONDS, Frame, PointCloud
from calib_ros.messages.pictures import decode_picture

# The file formats of KITTI: numbered files, scans, pictures, calibrations and timestamps.
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


# KITTI raw: how the vehicle moves (oxts), and when its scanner measured a point.
Floats = NDArray[np.float64]
OXTS_FIELDS = 30
ATTITUDE, VELOCITY, RATES = slice(3, 5), slice(8, 11), slice(17, 20)  # roll, pitch; vf, vl, vu; wx, wy, wz
# T_velo_imu where calib_imu_to_velo.txt is missing: aligned axes (they are to 0.9 deg) and the lever arm of the recordings' cars.
NOMINAL_LEVER_ARM = (-0.81, 0.32, -0.80)
PERIOD_S = 0.1033  # a turn, where timestamps_start.txt and _end.txt are missing
# The scanner triggers the cameras as it faces forward, which is when a scan is stamped (Geiger et al., Vision meets Robotics,
# 2013), and they expose for 2 ms at most. So the image cannot show the moment of its own stamp, 10.5 ms after the scan's: that is
# when the picture had arrived. The delay was measured on drive 0005, with the scans moved by oxts: the score at the recording's
# own extrinsic is highest at 3 ms (29 frames) and 4 ms (the faster 13), that of the re-estimated extrinsic at 4.5 to 5 ms; a
# millisecond is 4 to 6 mm along the road.
TRIGGER_TO_IMAGE_NS = 4_000_000
MAX_IMAGE_DELAY_NS = 50_000_000  # images stamped otherwise were not triggered by this scan
TURN_LIMITS_S = (0.02, 0.5)  # stamps of start and end that say something else are not used


class Oxts:
    """Velocities of the GPS/IMU unit, one file per frame, as twists of the LiDAR.

    folder: oxts/data. calibration: calib_imu_to_velo.txt.
    """

    def __init__(self, folder: Path, calibration: Path) -> None:
        self.folder = folder
        self._T_velo_imu = se3.from_parts(np.eye(3), NOMINAL_LEVER_ARM)
        if calibration.is_file():
            file = CalibrationFile(calibration)
            parts = se3.from_parts(file.matrix("R", 3, 3), file.matrix("T", 3, 1)[:, 0])
            self._T_velo_imu = se3.as_transform(parts, f"the calibration {calibration}")

    def twist(self, number: int) -> Floats | None:
        """(rx, ry, rz, tx, ty, tz) of the LiDAR in its own frame, rad/s and m/s; None if the frame has no file.

        BadInputError for a file that is truncated or no list of numbers.
        """
        path = self.folder / f"{number:010d}.txt"
        if not path.is_file():
            return None
        try:
            values = np.array(path.read_text("utf-8", "replace").split(), float)
        except (OSError, ValueError):
            values = np.zeros(0)
        if len(values) != OXTS_FIELDS or not np.isfinite(values).all():
            raise BadInputError(f"{path} must have {OXTS_FIELDS} numbers, see dataformat.txt; copy it again or delete it")
        return lidar_twist(values, self._T_velo_imu)


def lidar_twist(values: Floats, T_velo_imu: Floats) -> Floats:
    """Numbers of an oxts file (30,) -> twist (6,) of the LiDAR in its own frame.

    vf, vl, vu are level with the ground (dataformat.txt), wx, wy, wz and the LiDAR belong to the car's body: roll and pitch lie
    between them.
    """
    roll, pitch = values[ATTITUDE]
    R_level_body = Rotation.from_euler("ZYX", [0.0, pitch, roll]).as_matrix()
    R, t = T_velo_imu[:3, :3], T_velo_imu[:3, 3]
    turn = R @ values[RATES]
    # The LiDAR's origin is off the IMU's by -R' t in the IMU's frame, and a turning car carries it along.
    return np.concatenate([turn, R @ (R_level_body.T @ values[VELOCITY]) + np.cross(t, turn)])


class ScanMotion:
    """When the points of a raw drive's scans were measured, and how fast the LiDAR moved.

    root: the drive. date: the folder of its calibrations.
    """

    def __init__(self, root: Path, date: Path) -> None:
        folder = root / "velodyne_points"
        self._start = Timestamps.if_present(folder / "timestamps_start.txt")
        self._end = Timestamps.if_present(folder / "timestamps_end.txt")
        self._oxts = Oxts(root / "oxts" / "data", date / "calib_imu_to_velo.txt")

    @property
    def has_oxts(self) -> bool:
        """False if the drive comes without velocities."""
        return self._oxts.folder.is_dir()

    def twist(self, number: int) -> Floats | None:
        """See Oxts.twist."""
        return self._oxts.twist(number)

    def period_s(self, number: int) -> float:
        """Duration of a scan's turn."""
        if self._start is not None and self._end is not None:
            try:
                turn = (self._end.ns(number) - self._start.ns(number)) / NANOSECONDS
            except BadInputError:  # nothing that a scan could not do without
                return PERIOD_S
            if TURN_LIMITS_S[0] <= turn <= TURN_LIMITS_S[1]:
                return turn
        return PERIOD_S

    def times(self, cloud: PointCloud, number: int) -> NDArray[np.float32]:
        """(n,) s after the scan's stamp.

        The head turns clockwise and faces forward at the stamp; a scan begins and ends behind the car, at azimuth +-pi.
        """
        azimuth = np.arctan2(cloud.xyz[:, 1], cloud.xyz[:, 0])
        return np.asarray(-azimuth * (self.period_s(number) / (2 * np.pi)), np.float32)


def image_moment(image: int, scan: int) -> tuple[int, int]:
    """Stamps in ns of timestamps.txt -> moment that the image shows, and the scan's stamp."""
    return (scan + TRIGGER_TO_IMAGE_NS if 0 <= image - scan <= MAX_IMAGE_DELAY_NS else image), scan


# KITTI's three folder layouts: raw drives, odometry sequences and the object benchmark.
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


# As kitti2bag named them.
CAMERA_FRAMES = ("camera_gray_left", "camera_gray_right", "camera_color_left", "camera_color_right")
LIDAR_FRAME = "velo_link"


class KittiSource:
    """Frames of a KITTI raw drive, odometry sequence or object folder, for one of the cameras 0 to 3.

    A frame is a number with a picture and a scan; its stamps belong to that number, so that missing frames
    leave gaps. Raw drives tell when each point was measured, their stamp is the moment that the image shows,
    and with oxts they tell how fast the LiDAR moved. Pictures and scans are read when a frame is asked for. In
    the object layout each frame has its own calibration: `camera` and `reference` are then those of the first
    frame, and Frame.camera and Frame.reference the frame's own. BadInputError, with the path and what to do: no
    KITTI folder, a camera that is not there, missing or damaged files.
    """

    def __init__(self, path: str | Path, camera: int = 2) -> None:
        root = find_drive(Path(path))
        if root is None:
            raise BadInputError(f"{path} is no KITTI folder; looked for {LOOKED_FOR}")
        self._layout = layout_of(root, camera)
        self.path = root
        self.name = root.resolve().name
        self.camera_frame = CAMERA_FRAMES[camera]
        self.lidar_frame = LIDAR_FRAME
        self._camera_number = camera
        self._images = numbered_files(self._layout.images[camera], IMAGE_SUFFIXES)
        self._scans = numbered_files(self._layout.scans, (".bin",))
        self.numbers = sorted(self._images.keys() & self._scans.keys())
        if not self.numbers:
            pictures, scans = (self._layout.images[camera].relative_to(root), self._layout.scans.relative_to(root))
            raise BadInputError(
                f"{root}: no number has both a picture ({len(self._images)} in {pictures}) and a scan "
                f"({len(self._scans)} in {scans}); download both of this drive"
            )
        first = self.numbers[0]
        P, self.reference = self._layout.calibrate(first)
        height, width = read_picture(self._images[first]).shape[:2]
        self.camera = Camera(P[:, :3], width, height)

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, index: int) -> Frame:
        number = self.numbers[index]
        image = read_picture(self._images[number])
        P, T_camera_lidar = self._layout.calibrate(number)
        stamp, cloud_stamp = self._layout.stamps(number)
        height, width = image.shape[:2]
        cloud, motion = read_scan(self._scans[number]), self._layout.motion
        if motion is not None:
            cloud = replace(cloud, time=motion.times(cloud, number))
        return Frame(
            image=image,
            cloud=cloud,
            camera=Camera(P[:, :3], width, height),
            stamp=stamp,
            cloud_stamp=cloud_stamp,
            reference=T_camera_lidar,
            name=self._scans[number].stem,
            twist=None if motion is None else motion.twist(number),
            compensated=self._layout.compensated,
        )

    def describe(self) -> dict[str, str]:
        """What the folder holds: label -> text."""
        frames, images, scans = len(self), len(self._images), len(self._scans)
        return {
            "kind": f"KITTI {self._layout.kind}",
            "path": str(self.path),
            "frames": f"{frames}, numbers {self.numbers[0]} to {self.numbers[-1]}; left out: "
            f"{images - frames} pictures without scan, {scans - frames} scans without picture",
            "stamps": self._layout.stamps_from,
            "motion": self._layout.motion_from,
            "cameras": ", ".join(
                f"{number}{' (chosen)' if number == self._camera_number else ''}" for number in self._layout.images
            ),
            "camera": describe_camera(self.camera) + (" (of the first frame)" if self._layout.kind == "object" else ""),
            "camera_frame": self.camera_frame,
            "lidar_frame": self.lidar_frame,
            "reference": "from the calibration files" + (", one per frame" if self._layout.kind == "object" else ""),
        }
