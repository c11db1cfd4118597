"""Scans of two LiDARs in a room with pillars, without a renderer."""

from __future__ import annotations

import numpy as np

from calib_ros import se3
from calib_ros.config import Config
from calib_ros.frame import NANOSECONDS, PointCloud
from calib_ros.rig.lidars import LidarScans

TRUE = se3.exp([0.05, -0.1, 0.3, 0.4, -1.2, 0.2])  # T_a_b
WRONG = se3.exp(np.r_[np.deg2rad([2, -2, 2]), 0.15, -0.1, 0.1])
STILL = Config().motion


def room(n: int = 9000) -> np.ndarray:
    """Points (n, 3) on floor, walls, and pillars of several heights and places."""
    rng = np.random.default_rng(0)
    u, v = rng.uniform(-20, 20, n), rng.uniform(0, 6, n)
    faces = [np.c_[u, rng.uniform(-15, 15, n), np.zeros(n)], np.c_[u, np.full(n, 15), v], np.c_[u, np.full(n, -15), v]]
    faces += [np.c_[np.full(n, x), u * 0.75, v] for x in (-20, 20)]
    for x, y in rng.uniform(-12, 12, (12, 2)):
        angle = rng.uniform(0, 2 * np.pi, n // 8)
        faces.append(np.c_[x + 0.5 * np.cos(angle), y + 0.5 * np.sin(angle), rng.uniform(0, 4, n // 8)])
    return np.concatenate(faces) - [0, 0, 1.5]


def drive(n: int, turning: float = 0.3) -> list[np.ndarray]:
    """Poses of the vehicle, 0.1 s apart, round a bend at 3 m/s, swaying."""
    poses = [se3.exp([0, 0, 0, -4, -3, 0])]
    for k in range(n - 1):
        poses.append(poses[-1] @ se3.exp(np.array([0.1 * np.cos(k / 3), 0.1 * np.sin(k / 4), turning, 3, 0, 0]) * 0.1))
    return poses


def scans(poses: list[np.ndarray], T: np.ndarray, seed: int | list[int], late_ns: int = 0, side: int = 0) -> LidarScans:
    """Scans of a sensor at T (4, 4) on the vehicle. side: it sees only what is on this side of it."""
    world, out = room(), []
    for k, pose in enumerate(poses):
        rng = np.random.default_rng([*np.atleast_1d(seed), k])
        points = se3.transform(se3.inverse(pose @ T), world[rng.permutation(len(world))[:20000]])
        points = points[side * points[:, 0] >= 0] if side else points
        cloud = PointCloud((points + rng.normal(0, 0.01, points.shape)).astype(np.float32))
        out.append((NANOSECONDS + k * NANOSECONDS // 10 + late_ns, cloud))
    return LidarScans(out, STILL)
