"""Edges between two LiDARs, of scans of a room with pillars: registered, and by motion alone."""

from __future__ import annotations

import numpy as np
import pytest

from calib_ros import se3
from calib_ros.config import Config
from calib_ros.errors import TooFewFeaturesError
from calib_ros.frame import NANOSECONDS, PointCloud
from calib_ros.rig.lidars import SHARED, LidarScans, motion_edge, scan_edge, shared_view

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


def scans(poses: list[np.ndarray], T: np.ndarray, seed: int, late_ns: int = 0, side: int = 0) -> LidarScans:
    """Scans of a sensor at T (4, 4) on the vehicle; side: it sees only what is on this side of it."""
    world, out = room(), []
    for k, pose in enumerate(poses):
        rng = np.random.default_rng([seed, k])
        points = se3.transform(se3.inverse(pose @ T), world[rng.permutation(len(world))[:20000]])
        points = points[side * points[:, 0] >= 0] if side else points
        cloud = PointCloud((points + rng.normal(0, 0.01, points.shape)).astype(np.float32))
        out.append((NANOSECONDS + k * NANOSECONDS // 10 + late_ns, cloud))
    return LidarScans(out, STILL)


def squared(T: np.ndarray, covariance: np.ndarray) -> float:
    xi = se3.log(TRUE @ se3.inverse(T))
    return float(xi @ np.linalg.solve(covariance, xi))


def test_scans_are_registered_within_their_covariance() -> None:
    poses = drive(8)
    a, b = scans(poses, np.eye(4), 1), scans(poses, TRUE, 2)
    assert shared_view(a, b, WRONG @ TRUE) > SHARED
    edge = scan_edge(("a", a), ("b", b), WRONG @ TRUE)
    assert se3.rotation_error_deg(TRUE, edge.T) < 0.05
    assert se3.translation_error_m(TRUE, edge.T) < 0.01
    assert squared(edge.T, edge.covariance) < 22.5  # chi^2 of 6, one in a thousand
    assert edge.samples == 8
    assert (edge.target, edge.source, edge.kind) == ("a", "b", "scans")


def test_the_same_edge_results_from_either_side() -> None:
    poses = drive(4)
    a, b = scans(poses, np.eye(4), 1), scans(poses, TRUE, 2)
    one, other = scan_edge(("a", a), ("b", b), TRUE), scan_edge(("b", b), ("a", a), se3.inverse(TRUE))
    np.testing.assert_allclose(one.T, se3.inverse(other.T), atol=2e-3)


def test_an_offset_of_the_clocks_is_not_taken_for_a_place() -> None:
    """b stamps 20 ms late, so that its scans seem to be of later: the speed must tell it from a shift."""
    poses = [se3.exp([0, 0, 0, 0.15 * k + 0.02 * k * k - 4, -3, 0]) for k in range(10)]  # accelerating from 1.5 m/s
    a, b = scans(poses, np.eye(4), 1), scans(poses, TRUE, 2)
    b = LidarScans([(stamp + 20_000_000, cloud) for stamp, cloud in b.scans], STILL)
    edge = scan_edge(("a", a), ("b", b), TRUE)
    assert edge.time_offset_s is not None
    assert edge.time_sigma_s is not None
    assert edge.time_offset_s < -2 * edge.time_sigma_s  # measured earlier than stamped
    assert squared(edge.T, edge.covariance) < 22.5 + (0.02 / STILL.time_offset_sigma_s) ** 2


def test_scanners_that_look_apart_are_joined_by_motion() -> None:
    poses = drive(60)
    a, b = scans(poses, np.eye(4), 1, side=1), scans(poses, TRUE @ se3.exp([0, 0, np.pi, 0, 0, 0]), 2, side=1)
    turned = TRUE @ se3.exp([0, 0, np.pi, 0, 0, 0])
    edge = motion_edge(("a", a), ("b", b), WRONG @ turned)
    xi = se3.log(turned @ se3.inverse(edge.T))
    assert np.rad2deg(np.linalg.norm(xi[:3])) < 1.0
    assert xi @ np.linalg.solve(edge.covariance, xi) < 22.5
    assert edge.kind == "motion"


def test_without_turns_places_are_not_told_by_motion() -> None:
    poses = [se3.exp([0, 0, 0, 0.3 * k - 6, -3, 0]) for k in range(40)]
    edge = motion_edge(("a", scans(poses, np.eye(4), 1)), ("b", scans(poses, TRUE, 2)), TRUE)
    assert np.sqrt(np.diag(edge.covariance)[3:]).max() > 0.5  # m


def test_failures_say_what_to_do() -> None:
    poses = drive(3)
    a, b = scans(poses, np.eye(4), 1), scans(poses, TRUE, 2, 60 * NANOSECONDS)
    with pytest.raises(TooFewFeaturesError, match="a and b: no two of their scans are of the same moment; give scans"):
        scan_edge(("a", a), ("b", b), TRUE)
    with pytest.raises(TooFewFeaturesError, match=r"were not recorded at the same time|moved too little"):
        motion_edge(("a", a), ("b", b), TRUE)
    assert shared_view(a, b, se3.exp([0, 0, 0, 25, 25, 25])) < SHARED
