"""When a scan sweeps the camera's view: the moment by which it belongs to an image, wherever its driver stamps it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.config import MotionConfig
from calib_ros.frame import NANOSECONDS, PointCloud
from calib_ros.lidar.deskew import MAX_TIME, has_times, scan_times

Floats = NDArray[np.float64]
MAX_POINTS = 4000  # of a scan that are projected, in 1 ms; a tenth of them in view tell the median to 1 ms
MIN_POINTS = 30  # in view; fewer are a wrong extrinsic or a covered scanner
# A new median must lie that much closer to the times: start and end of a scan may both be in the view of a camera looking back.
CLOSER = 0.8
# Offsets are multiples of this: the scene moves the median by less; cameras that the scanner triggers match exactly.
STEP_S = 0.005
BLIND_CLOUDS = 10  # without points in view, after which nothing is known


class SweepOffset:
    """Learns how long after its stamp a scan sweeps the camera's view. Not thread-safe. config may be replaced at any time."""

    def __init__(self, config: MotionConfig) -> None:
        self.config = config
        self._offset: float | None = None  # s, without motion.time_offset_s
        self._blind = 0

    @property
    def ns(self) -> int | None:
        """The offset with motion.time_offset_s, ns: added to a cloud's stamp it gives the moment, by the clock of the images, by
        which the cloud belongs to an image. None before it is known."""
        if self._offset is None:
            return None
        return round(round(self._offset / STEP_S) * STEP_S * NANOSECONDS) + self.stamped_ns

    @property
    def stamped_ns(self) -> int:
        """The offset, ns, of clouds that belong to their stamp."""
        return round(self.config.time_offset_s * NANOSECONDS)

    def add(self, cloud: PointCloud, camera: Camera, T_camera_lidar: NDArray[np.floating]) -> None:
        """Learn from a scan, the camera and T_camera_lidar (4, 4), to some degrees.

        Clouds that are compensated (motion.deskew: off) belong to their stamp; so do those without point times whose stamping
        is not stated, and, after BLIND_CLOUDS, those of which nothing is in view.
        """
        times = view_times(cloud, camera, T_camera_lidar, self.config)
        if times is None:
            self._offset = 0.0
        elif len(times) >= MIN_POINTS:
            self._blind, known = 0, self._offset
            k = (len(times) - 1) // 2  # of a time that occurs: no mean of two
            middle = float(np.partition(times, k)[k])
            if known is None or np.abs(times - middle).mean() < CLOSER * np.abs(times - known).mean():
                self._offset = middle
        elif self._offset is None:
            self._blind += 1
            self._offset = 0.0 if self._blind >= BLIND_CLOUDS else None


def view_times(cloud: PointCloud, camera: Camera, T_camera_lidar: NDArray[np.floating], config: MotionConfig) -> Floats | None:
    """Times (n,), s after the cloud's stamp, at which points in the camera's view were measured, of some thousand points. None if
    all points count as measured at the stamp."""
    # Whether the user has stated how a driver without point times stamps its scans: drivers differ, the default is a guess.
    usual = MotionConfig()
    stated = config.from_scans == "always" or any(
        getattr(config, name) != getattr(usual, name) for name in ("spin", "stamp_azimuth_deg", "stamp_at")
    )
    if config.deskew == "off" or not (has_times(cloud) or stated):
        return None
    # An odd step, so that all rings remain in a scan stored firing by firing.
    part = cloud.select(np.arange(0, len(cloud), (len(cloud) // MAX_POINTS) | 1)).finite()
    part = part.select(camera.project(se3.transform(T_camera_lidar, part.xyz))[1])
    times = part.time.astype(np.float64) if has_times(cloud) and part.time is not None else scan_times(part.xyz, config)
    return times[np.abs(times) <= MAX_TIME]
