"""Motion compensation: points of a moving scanner, moved to where they are at the image's stamp.

The velocity of the LiDAR is a twist xi = (rx, ry, rz, tx, ty, tz) in rad/s and m/s in its own frame, constant during a scan: a
point p measured tau seconds after the image's stamp is at exp(xi tau) p in the LiDAR's frame at that stamp.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib_ros import se3
from calib_ros.config import MotionConfig
from calib_ros.errors import BadTimesError
from calib_ros.frame import NANOSECONDS, Frame, PointCloud
from calib_ros.lidar.edges import EdgePoints
from calib_ros.lidar.scanner_pose import CLOUD_FRAME, ScannerPose

Floats = NDArray[np.float64]
MAX_TIME = 1.0  # s; no velocity is constant for longer, and larger values are of other clocks or units
SPINS = {"clockwise": -1.0, "counterclockwise": 1.0, "none": 0.0}  # sign of the azimuth's rate
STAMP_AT = {"start": 0.0, "middle": 0.5, "end": 1.0}  # share of the revolution completed at the stamp
BLOCK = 16384  # points moved at a time: larger arrays do not fit the cache and take many times as long
SMALL_ANGLE = 0.05  # rad; below it the closed forms lose digits, while the series are exact to 1e-12


def used_twist(frame: Frame, config: MotionConfig) -> Floats | None:
    """The twist (6,) by which the points of a frame are moved; None = they are not."""
    return None if config.deskew == "off" else frame.twist


def deskewed_edges(edges: EdgePoints, frame: Frame, config: MotionConfig) -> EdgePoints:
    """Edge points of a frame's scan at the image's stamp; unchanged if the frame has no twist. Raises BadTimesError for times
    that cannot be those of one scan."""
    twist = used_twist(frame, config)
    if twist is None:
        return edges
    tau = image_times(frame, edges.xyz, edges.time, config, edges.pose)
    return replace(edges, xyz=moved(edges.xyz, twist, tau).astype(np.float32), time=tau.astype(np.float32))


def deskewed_points(frame: Frame, config: MotionConfig) -> NDArray[np.float32] | None:
    """All points (n, 3) of a frame's scan at the image's stamp; None if the frame has no twist. Raises as `deskewed_edges`."""
    twist, cloud = used_twist(frame, config), frame.cloud
    if twist is None:
        return None
    return moved(cloud.xyz, twist, image_times(frame, cloud.xyz, cloud.time, config)).astype(np.float32)


def deskewed_frame(frame: Frame, config: MotionConfig) -> Frame:
    """A frame with all points at the image's stamp, for display; the frame itself if it has no twist."""
    xyz = deskewed_points(frame, config)
    return frame if xyz is None else replace(frame, cloud=replace(frame.cloud, xyz=xyz), twist=None, compensated=True)


def image_times(
    frame: Frame,
    xyz: NDArray[np.floating],
    time: NDArray[np.float32] | None,
    config: MotionConfig,
    pose: ScannerPose = CLOUD_FRAME,
) -> Floats:
    """Times at which points (n, 3) of a frame's scan were measured, (n,) s after the image's stamp.

    time: (n,) s after the cloud's stamp, if its points have times. pose: of the scanner, whose azimuth tells the times of points
    without. Raises BadTimesError for times more than MAX_TIME away.
    """
    between = (frame.moment_of_cloud - frame.stamp) / NANOSECONDS + config.time_offset_s
    if frame.compensated:
        tau = np.full(len(xyz), between)
    else:
        tau = between + (scan_times(xyz, config, pose) if time is None or not has_times(frame.cloud) else time.astype(np.float64))
    lost = ~np.isfinite(xyz).all(axis=1)  # lost returns have no azimuth, and are not used
    tau = np.where(lost, 0.0, tau)
    if len(tau) and not np.abs(tau).max() <= MAX_TIME:  # not: also NaN
        raise BadTimesError(
            f"frame {frame.name or frame.stamp}: points up to {np.abs(tau).max():.3g} s away from the image's moment; check the "
            "cloud's time field and both sensors' stamps, or set motion.deskew: off"
        )
    return tau


def has_times(cloud: PointCloud) -> bool:
    """Whether the points have times of their own; drivers without times fill in a constant."""
    time = cloud.time
    return time is not None and len(time) > 1 and bool((time != time[0]).any())


def scan_times(xyz: NDArray[np.floating], config: MotionConfig, pose: ScannerPose = CLOUD_FRAME) -> Floats:
    """Times of points (n, 3) of a spinning scanner by their azimuth, (n,) s after the cloud's stamp."""
    if pose.axis[2] < 0:  # about an axis that points to the cloud's z also where the scanner hangs upside down
        pose = pose.turned_over()
    xyz = pose.to_scanner(xyz)
    sign = SPINS[config.spin]
    if sign == 0:
        return np.zeros(len(xyz))
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0]).astype(np.float64)
    turns = sign * (azimuth - np.deg2rad(config.stamp_azimuth_deg)) / (2 * np.pi)
    over = STAMP_AT[config.stamp_at]
    return np.asarray((np.mod(turns + over, 1.0) - over) * config.scan_period_s)


def moved(xyz: NDArray[np.floating], twist: ArrayLike, tau: NDArray[np.floating]) -> Floats:
    """exp(twist tau_i) applied to each point: xyz (n, 3) m, twist (6,) rad/s and m/s, tau (n,) s -> (n, 3). With u = w x p + v, a
    = |w| tau a point moves by tau u + (1 - cos a) / w^2 w x u + (a - sin a) / w^3 w x (w x u)."""
    twist, time = np.asarray(twist, float), np.asarray(tau, float)
    out, W, rate = np.empty((len(xyz), 3)), se3.skew(twist[:3]), float(np.linalg.norm(twist[:3]))
    for k in range(0, len(xyz), BLOCK):
        p, t, own = np.asarray(xyz[k : k + BLOCK], float), time[k : k + BLOCK], out[k : k + BLOCK]
        u, angle = p @ W.T + twist[3:], rate * t
        square = angle * angle
        small = square < SMALL_ANGLE**2
        second, third = 1 / 2 - square / 24 + square**2 / 720, 1 / 6 - square / 120 + square**2 / 5040
        if not small.all():
            with np.errstate(divide="ignore", invalid="ignore"):
                second = np.where(small, second, (1 - np.cos(angle)) / square)
                third = np.where(small, third, (angle - np.sin(angle)) / (square * angle))
        own[:] = t[:, None] * u
        own += (t * t * second)[:, None] * (u @ W.T)
        own += (t * t * t * third)[:, None] * (u @ (W @ W).T)
        own += p
    return out
