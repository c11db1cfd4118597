"""Velocity of the LiDAR from two consecutive scans, for data without odometry, by GICP (Segal et al. 2009; small_gicp)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib_ros import se3
from calib_ros.config import MotionConfig
from calib_ros.errors import MissingDependencyError
from calib_ros.frame import NANOSECONDS, Frame, PointCloud
from calib_ros.lidar.deskew import MAX_TIME, has_times, moved, scan_times
from calib_ros.lidar.sweep import MIN_POINTS as MIN_VIEWED
from calib_ros.lidar.sweep import view_times

Floats = NDArray[np.float64]
MISSING = "the vehicle's motion is estimated from scans with small_gicp, which is missing: pip install small_gicp==1.0.1"
MAX_POINTS = 40_000  # of a scan that are used: more are not more accurate
MIN_RANGE, MAX_RANGE = 2.5, 60.0  # m; nearer is the vehicle itself, and far points are sparse and noisy
MIN_POINTS = 300  # after downsampling
# s between two scans: over less time the noise of the alignment exceeds the motion, over more the velocity is no longer constant.
MIN_GAP_S, MAX_GAP_S = 0.01, 0.35
VOXEL_M = 0.8  # m; size of the voxels that scans are thinned to before they are aligned
MIN_MATCHED = 0.65  # share of the points: the same street has 0.73 to 0.98, another place up to 0.59
MAX_SPEED, MAX_TURN_RATE = 60.0, 2.0  # m/s, rad/s; beyond what vehicles do, an alignment is wrong
ROAD_SPEED = 40.0  # m/s: no keyframes above, where a millisecond between the clocks is as much as an estimate scatters by
MATCH_DISTANCES = (4.0, 1.0)  # m; maximum distance of matches in the first and the second alignment
NEIGHBOURS = 10  # from which the surface around a point is estimated
MIN_STEP = 1e-3  # rad and m; smaller steps end the alignment
# Of the error along its weakest direction, per point: 0.5 on a flat field, 1 to 5 for other places, 7 to 34 in streets.
MIN_CURVATURE = 2.0


@dataclass(frozen=True, eq=False)
class Motion:
    """twist: (6,) mean velocity of the LiDAR between two scans, rad/s and m/s in its own frame; None: see reason. speed: m/s."""

    twist: Floats | None
    reason: str = ""
    speed: float = 0.0


def without_motion(frame: Frame, config: MotionConfig) -> str:
    """Why the velocity of a frame's LiDAR is not to be estimated from scans, for people; "" if it is."""
    if frame.twist is not None or frame.compensated or config.deskew == "off":
        return "compensated by the source, or left as they are"
    if config.from_scans == "never":
        return "motion.from_scans is never"
    if frame.cloud_stamp is None:
        return "the clouds have no stamps (recorded ones belong in times.csv)"
    # By azimuth only if configured: drivers differ, and a wrong guess moves points farther than the vehicle did.
    timed = config.from_scans == "always" or has_times(frame.cloud)
    return "" if timed else frame.cloud.time_problem or "points have no times (motion.from_scans: always goes by azimuth)"


def unknown_motion_s(frame: Frame, T_camera_lidar: NDArray[np.floating], config: MotionConfig) -> float:
    """For how long, s, an unknown velocity displaces the points in a camera's view: the root mean square of their times after the
    image's stamp. 0 where no velocity is to be estimated, or it is known. T_camera_lidar: (4, 4), to some degrees."""
    if without_motion(frame, config):
        return 0.0
    between = (frame.moment_of_cloud - frame.stamp) / NANOSECONDS + config.time_offset_s
    times = view_times(frame.cloud, frame.camera, T_camera_lidar, config)
    if times is None or len(times) < MIN_VIEWED:
        return float(np.hypot(between, config.scan_period_s * frame.camera.field_deg / 720))
    return float(np.sqrt(np.mean((between + times) ** 2)))


def estimate_motion(
    before: PointCloud, cloud: PointCloud, gap_s: float, config: MotionConfig, start: ArrayLike | None = None
) -> Motion:
    """Mean velocity between two scans, `gap_s` seconds apart by their stamps. Deterministic. start: twist (6,) to start from, if
    known; zero is tried too if that fails. Raises MissingDependencyError without small_gicp."""
    if not MIN_GAP_S <= gap_s <= MAX_GAP_S:
        return Motion(None, f"the scans are {gap_s:.3g} s apart, outside {MIN_GAP_S:g} to {MAX_GAP_S:g} s")
    scans = thinned(before, config), thinned(cloud, config)
    for points, time in scans:
        if len(points) < MIN_POINTS:
            return Motion(None, f"a scan has {len(points)} points to align, {MIN_POINTS} are needed")
        if not np.abs(time).max() <= MAX_TIME:
            return Motion(None, f"points up to {np.abs(time).max():.3g} s away from their scan's stamp: check its time field")
    starts = [np.zeros(6)] if start is None else [np.asarray(start, float), np.zeros(6)]
    motion = Motion(None)
    for first in starts:
        motion = _aligned(scans[0], scans[1], gap_s, first)
        if motion.twist is not None:
            break
    return motion


Scan = tuple[Floats, Floats]  # points (n, 3) m as measured, times (n,) s after the stamp


def thinned(cloud: PointCloud, config: MotionConfig, voxel_m: float = VOXEL_M) -> Scan:
    """The first point of every voxel, of up to MAX_POINTS: (n, 3) m as measured, with times (n,) s after the stamp."""
    # An odd step, so that all rings remain in a scan stored firing by firing.
    step = -(-len(cloud) // MAX_POINTS)
    part = cloud.select(np.arange(0, len(cloud), max(step + (step % 2 == 0), 1)))
    points = part.xyz.astype(np.float64)
    square = (points * points).sum(axis=1)
    keep = np.flatnonzero((square > MIN_RANGE**2) & (square < MAX_RANGE**2))  # NaN is neither
    cell = np.floor(points[keep] / voxel_m).astype(np.int64) + (1 << 20)
    _, first = np.unique((cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2], return_index=True)
    keep = keep[first]
    timed = has_times(cloud) and part.time is not None
    time = part.time[keep].astype(np.float64) if timed and part.time is not None else scan_times(points[keep], config)
    return points[keep], time


def _aligned(before: Scan, scan: Scan, gap_s: float, start: Floats) -> Motion:
    twist = start
    T = se3.exp(twist * gap_s)
    for reach in MATCH_DISTANCES:
        target, source = (moved(points, twist, time) for points, time in (before, scan))
        found = align(prepared(target), prepared(source), T, reach)
        T = np.asarray(found.T_target_source, float)
        if not np.isfinite(T).all():
            return Motion(None, "the alignment of the scans diverged")
        # T_before_now of a LiDAR with a constant twist is exp(twist gap).
        twist = se3.log(T) / gap_s
    matched = found.num_inliers / len(scan[0])
    speed, rate = float(np.linalg.norm(twist[3:])), float(np.linalg.norm(twist[:3]))
    curvature = float(np.linalg.eigvalsh(found.H[3:, 3:])[0]) / max(found.num_inliers, 1)
    problem = ""
    if not found.converged:
        problem = "the alignment of the scans did not converge"
    elif matched < MIN_MATCHED:
        problem = f"only {matched:.0%} of the points match the scan before, {MIN_MATCHED:.0%} are needed"
    elif curvature < MIN_CURVATURE:
        problem = "nothing in sight stands upright: the scans slide along each other"
    elif speed > MAX_SPEED or rate > MAX_TURN_RATE:
        return Motion(None, f"{speed:.1f} m/s and {rate:.2f} rad/s are beyond {MAX_SPEED:g} and {MAX_TURN_RATE:g}", speed)
    return Motion(None, problem) if problem else Motion(twist, "", speed)


def prepared(points: Floats) -> tuple[Any, Any]:
    """Points (n, 3) m for `align`: small_gicp's cloud with the surface around every point, and tree. Raises
    MissingDependencyError without the library."""
    try:
        import small_gicp as gicp
    except ImportError:
        raise MissingDependencyError(MISSING) from None
    cloud = gicp.PointCloud(points)
    tree = gicp.KdTree(cloud, 1)
    gicp.estimate_covariances(cloud, tree, NEIGHBOURS, 1)
    return cloud, tree


def align(target: tuple[Any, Any], source: tuple[Any, Any], T: Floats, reach_m: float) -> Any:
    """small_gicp's result of GICP of `prepared` points from T_target_source (4, 4), matched up to reach_m apart. Its H is of a
    right twist."""
    import small_gicp as gicp

    # One thread: sums in another order would make results differ from run to run.
    return gicp.align(
        target[0], source[0], target[1], init_T_target_source=T, registration_type="GICP", max_correspondence_distance=reach_m,
        num_threads=1, max_iterations=30, rotation_epsilon=MIN_STEP, translation_epsilon=MIN_STEP,
    )  # fmt: skip
