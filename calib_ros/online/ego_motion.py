"""The LiDAR's velocity over time: each cloud offered is kept until the next one, for a keyframe that no odometry comes with."""

from __future__ import annotations

from dataclasses import replace

from calib_ros.config import MotionConfig
from calib_ros.errors import MissingDependencyError
from calib_ros.frame import NANOSECONDS, Frame, PointCloud
from calib_ros.lidar.motion import Motion, estimate_motion, wanted

Stamped = tuple[int, PointCloud]


class EgoMotion:
    """Not for several threads at once. config may be replaced at any time.

    last: what the last estimate said, None before the first. missing: a line for a person if small_gicp is, else "".
    """

    def __init__(self, config: MotionConfig) -> None:
        self.config = config
        self.last: Motion | None = None
        self.missing = ""
        self._before: Stamped | None = None
        self._newest: Stamped | None = None

    def offer(self, frame: Frame) -> None:
        """Every frame, in the order of time. Keeps references to two clouds, and costs nothing."""
        usable = frame.cloud_stamp is not None and not frame.compensated
        self._before, self._newest = self._newest, (frame.cloud_stamp or 0, frame.cloud) if usable else None

    def completed(self, frame: Frame) -> Frame:
        """The frame offered last, with its twist if it has none and the cloud before tells it; 50 ms for 130 000 points."""
        before, stamp = self._before, frame.cloud_stamp
        if self.missing or before is None or stamp is None or not wanted(frame, self.config):
            return frame
        start = None if self.last is None else self.last.twist
        try:
            self.last = estimate_motion(before[1], frame.cloud, (stamp - before[0]) / NANOSECONDS, self.config, start)
        except MissingDependencyError as error:
            self.missing = f"scans are not corrected for the vehicle's motion: {error}"
            return frame
        return frame if self.last.twist is None else replace(frame, twist=self.last.twist)
