"""How a driver stamps scans without point times, found out from the scenes: which way the scanner turns, and where a scan begins.

Each convention gives every edge point another time, and the vehicle's motion then another place: the right one makes all frames
agree. Which part of the scan is stamped is a time offset of half a scan period at most.
"""

from __future__ import annotations

from dataclasses import replace

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


def convention(stamping: Stamping, seconds: float, scan_period_s: float) -> tuple[str, float]:
    """What to set for a driver that stamps as was found, for people, by the nearest usual convention; and the time offset that is
    left then, s. seconds: that of `stamping`, whose scans are stamped half a turn after they begin."""
    halves = {"start": 0.5, "middle": 0.0, "end": -0.5} if stamping.spin != "none" else {"middle": 0.0}
    name, azimuth = min(halves, key=lambda n: abs(seconds - halves[n] * scan_period_s)), stamping.azimuth_deg
    if name != "middle":
        azimuth = azimuth + 180.0 if azimuth <= 0 else azimuth - 180.0
    found = f"motion.spin: {stamping.spin}, motion.stamp_at: {name}, motion.stamp_azimuth_deg: {azimuth:g}"
    return found, seconds - halves[name] * scan_period_s
