"""KITTI raw: how the vehicle moves (oxts), and when its scanner measured a point."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib_ros import se3
from calib_ros.datasets.kitti_files import CalibrationFile, Timestamps
from calib_ros.errors import BadInputError
from calib_ros.frame import NANOSECONDS, PointCloud

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
