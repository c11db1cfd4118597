"""How a driver stamps scans without point times, found out from the scenes: which way the scanner turns, and where a scan begins.

Each convention gives every edge point another time, and the vehicle's motion then another place: the right one makes all frames
agree. Which part of the scan is stamped is a time offset of half a scan period at most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib_ros.config import MotionConfig
from calib_ros.lidar.deskew import moved, scan_times
from calib_ros.registration.features import FrameFeatures
from calib_ros.result import Stamping

AHEAD, BEHIND = 0.0, 180.0  # deg, azimuth half a turn away from where a scan begins and ends
CONVENTIONS = (
    Stamping("clockwise", AHEAD),
    Stamping("counterclockwise", AHEAD),
    Stamping("clockwise", BEHIND),
    Stamping("counterclockwise", BEHIND),
    Stamping("none", AHEAD),
)


def at_stamping(config: MotionConfig, stamping: Stamping) -> MotionConfig:
    """The configuration that says so."""
    return replace(config, spin=stamping.spin, stamp_azimuth_deg=stamping.azimuth_deg, stamp_at="middle")


def restamped(features: FrameFeatures, before: MotionConfig, after: MotionConfig) -> FrameFeatures:
    """Features extracted by `before` with points where `after` has them; the same if their times do not come from the azimuth, or
    the LiDAR's velocity is not known."""
    points = features.points
    if not features.timed_by_azimuth or features.twist is None or points.time is None or features.own is not None:
        return features
    measured = moved(points.xyz, features.twist, -points.time.astype(float))
    change = scan_times(measured, after, points.pose) - scan_times(measured, before, points.pose)
    time = points.time + change
    points = replace(points, xyz=moved(measured, features.twist, time).astype(np.float32), time=time.astype(np.float32))
    plain = None if features.plain is None else restamped(features.plain, before, after)
    return replace(features, points=points, plain=plain, view=None)  # points of a view have no times


@dataclass(frozen=True)
class Convention:
    """A convention for people: what to set for a driver that stamps so."""

    spin: str
    stamp_at: str
    stamp_azimuth_deg: float

    def __str__(self) -> str:
        return f"motion.spin: {self.spin}, motion.stamp_at: {self.stamp_at}, motion.stamp_azimuth_deg: {self.stamp_azimuth_deg:g}"


def convention(stamping: Stamping, seconds: float, scan_period_s: float) -> tuple[Convention, float]:
    """The usual convention nearest to what was found, and the time offset that is left then, s. seconds: that of `stamping`,
    whose scans are stamped half a turn after they begin."""
    if stamping.spin == "none":
        return Convention("none", "middle", 0.0), seconds
    halves = {"start": 0.5, "middle": 0.0, "end": -0.5}
    name = min(halves, key=lambda n: abs(seconds - halves[n] * scan_period_s))
    seam = (stamping.azimuth_deg + 180.0) % 360.0
    azimuth = stamping.azimuth_deg if name == "middle" else (seam if seam <= 180.0 else seam - 360.0)
    return Convention(stamping.spin, name, azimuth), seconds - halves[name] * scan_period_s


def stamped_by_azimuth(features: Sequence[FrameFeatures], config: MotionConfig) -> bool:
    """Whether there is a convention to find out."""
    return (
        config.stamping == "auto"
        and all(f.own is None for f in features)
        and any(f.twist is not None and f.timed_by_azimuth for f in features)
    )
