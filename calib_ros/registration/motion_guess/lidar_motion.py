"""The LiDAR's trajectory through consecutive scans, from odometry where frames carry it, else from the scans themselves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib_ros import se3
from calib_ros.config import MotionConfig
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.lidar.deskew import has_times, mid_exposure
from calib_ros.lidar.ego_motion import MAX_GAP_S, estimate_motion

Matrix = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Run:
    """Consecutive frames between whose scans the motion is known.

    first: position of the first frame. times: (n,) s of the scans, from the first scan of all. images: (n,) s of the images on
    the same clock. poses: (n, 4, 4) of the LiDAR at the scans in its frame at the first of the run. twists: (n - 1, 6) mean
    velocity from each scan to the next, rad/s and m/s in the LiDAR's frame.
    """

    first: int
    times: Matrix
    images: Matrix
    poses: Matrix
    twists: Matrix

    def __len__(self) -> int:
        return len(self.times)

    def pose(self, seconds: ArrayLike) -> Matrix:
        """Poses (k, 4, 4) at moments (k,) s; before the first and after the last scan at the velocity there."""
        seconds = np.asarray(seconds, float)
        k = np.clip(np.searchsorted(self.times, seconds, side="right") - 1, 0, len(self.twists) - 1)
        return np.asarray(self.poses[k] @ se3.exp_many(self.twists[k] * (seconds - self.times[k])[:, None]))

    def relative(self, first: ArrayLike, second: ArrayLike) -> Matrix:
        """Transforms (k, 4, 4) of points from the LiDAR's frame at the moments `first` (k,) s to that at `second`."""
        return np.asarray(np.linalg.inv(self.pose(second)) @ self.pose(first))


def lidar_runs(frames: Sequence[Frame], config: MotionConfig) -> tuple[list[Run], list[str]]:
    """The runs of consecutive frames, in the order of their stamps, whose motion is known, and why it is not elsewhere.

    Frames that carry a twist on both sides of a gap are believed. Raises MissingDependencyError where scans have to be aligned
    and small_gicp is missing.
    """
    reasons: list[str] = []
    runs: list[Run] = []
    if not frames:
        return runs, reasons
    origin = frames[0].moment_of_cloud
    twists: list[Matrix] = []
    first = 0
    for k in range(1, len(frames) + 1):
        twist, reason = (
            _between(frames[k - 1], frames[k], config, twists[-1] if twists else None) if k < len(frames) else (None, "")
        )
        if twist is not None:
            twists.append(twist)
            continue
        if reason:
            reasons.append(reason)
        if twists:
            runs.append(_run(frames[first:k], first, np.array(twists), origin, config))
        twists, first = [], k
    return runs, reasons


def _between(before: Frame, frame: Frame, config: MotionConfig, start: Matrix | None) -> tuple[Matrix | None, str]:
    """Mean velocity (6,) from one frame's scan to the next one's, or None and why it is unknown."""
    gap_s = (frame.moment_of_cloud - before.moment_of_cloud) / NANOSECONDS
    if not 0 < gap_s <= MAX_GAP_S:
        return None, f"frames {before.name} and {frame.name} are {gap_s:.3g} s apart, more than {MAX_GAP_S:g} s"
    if before.twist is not None and frame.twist is not None:
        return (before.twist + frame.twist) / 2, ""
    if before.compensated or not has_times(before.cloud) or config.deskew == "off":
        # All points count as measured at the stamp. Of compensated scans that is so; others without times are both distorted
        # alike, which leaves the motion between them nearly as it is, while a wrong guess of the times would not.
        config = replace(config, spin="none") if config.from_scans != "always" or before.compensated else config
        before, frame = (replace(f, cloud=replace(f.cloud, time=None)) for f in (before, frame))
    motion = estimate_motion(before.cloud, frame.cloud, gap_s, config, start)
    return motion.twist, motion.reason


def _run(frames: Sequence[Frame], first: int, twists: Matrix, origin: int, config: MotionConfig) -> Run:
    times = np.array([(f.moment_of_cloud - origin) / NANOSECONDS for f in frames])
    late = config.time_offset_s - mid_exposure(config)
    images = np.array([(f.stamp - origin) / NANOSECONDS - late for f in frames])
    poses = [np.eye(4)]
    for twist, gap in zip(twists, np.diff(times), strict=True):
        poses.append(poses[-1] @ se3.exp(twist * gap))
    return Run(first, times, images, np.array(poses), twists)
