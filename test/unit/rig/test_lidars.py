"""Two LiDARs in a room with pillars: edges by their scans and by motion alone, and what they come to while they drive."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from calib_ros import se3
from calib_ros.config import Config, RefineConfig
from calib_ros.errors import TooFewFeaturesError
from calib_ros.frame import NANOSECONDS, PointCloud
from calib_ros.result import CONVERGED, INITIAL, INSUFFICIENT, MOVED, SUSPECT
from calib_ros.rig.lidar_pair import CONFIRM, FAILED, LEAST, QUICK_S, REST_S, LidarPair
from calib_ros.rig.lidars import MIN_MOTIONS, SCANS, SHARED, LidarScans, motion_edge, scan_edge, shared_view

TRUE = se3.exp([0.05, -0.1, 0.3, 0.4, -1.2, 0.2])  # T_a_b
WRONG = se3.exp(np.r_[np.deg2rad([2, -2, 2]), 0.15, -0.1, 0.1])
STILL = Config().motion
TURNED = TRUE @ se3.exp([0, 0, np.pi, 0, 0, 0])


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
        points = se3.transform(se3.inverse(pose @ T), world[rng.permutation(len(world))[:10000]])
        points = points[side * points[:, 0] >= 0] if side else points
        cloud = PointCloud((points + rng.normal(0, 0.01, points.shape)).astype(np.float32))
        out.append((NANOSECONDS + k * NANOSECONDS // 10 + late_ns, cloud))
    return LidarScans(out, STILL)


def squared(T: np.ndarray, covariance: np.ndarray, true: np.ndarray = TRUE) -> float:
    """Of the error of a transform, by its covariance; below 22.5 but for one in a thousand, chi^2 of 6."""
    xi = se3.log(true @ se3.inverse(T))
    return float(xi @ np.linalg.solve(covariance, xi))


def test_scans_are_registered_within_their_covariance_and_likewise_from_either_side() -> None:
    poses = drive(8)
    a, b = scans(poses, np.eye(4), 1), scans(poses, TRUE, 2)
    assert shared_view(a, b, WRONG @ TRUE) > SHARED
    edge = scan_edge(("a", a), ("b", b), WRONG @ TRUE)
    assert se3.rotation_error_deg(TRUE, edge.T) < 0.05
    assert se3.translation_error_m(TRUE, edge.T) < 0.01
    assert squared(edge.T, edge.covariance) < 22.5
    assert edge.samples == 8
    assert (edge.target, edge.source, edge.kind) == ("a", "b", "scans")
    other = scan_edge(("b", b), ("a", a), se3.inverse(WRONG @ TRUE))
    np.testing.assert_allclose(edge.T, se3.inverse(other.T), atol=2e-3)


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
    a, b = scans(poses, np.eye(4), 1, side=1), scans(poses, TURNED, 2, side=1)
    edge = motion_edge(("a", a), ("b", b), WRONG @ TURNED)
    assert se3.rotation_error_deg(TURNED, edge.T) < 1.0
    assert squared(edge.T, edge.covariance, TURNED) < 22.5
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


# --- while they drive -----------------------------------------------------------------------------------------------------


KNOCK = se3.exp(np.r_[np.deg2rad([0.3, 0, 0.8]), 0.04, 0, -0.02])
LIMITS = RefineConfig()
FAR = se3.exp([0, 0, 0, 50, 50, 0])


def moments(T: np.ndarray, n: int, first: int = 0, turning: float = 0.3) -> Iterator[tuple[LidarScans, LidarScans]]:
    """Two scans of each LiDAR at n moments of a drive, the source at T (4, 4) on the target."""
    poses = drive(first + 2 * n, turning)
    for k in range(first, first + 2 * n, 2):
        yield tuple(scans(poses[k : k + 2], own, [seed, k]) for own, seed in ((np.eye(4), 1), (T, 2)))


def driven(n: int) -> LidarPair:
    pair = LidarPair("a", "b", STILL.time_offset_sigma_s, LIMITS)
    for a, b in moments(TRUE, n):
        pair.add(a, b, WRONG @ TRUE)
    return pair


def test_registrations_are_fused_from_a_wrong_prior_on() -> None:
    pair = driven(LEAST - 1)
    assert (pair.extrinsic.result.status, pair.extrinsic.usable, pair.every_s) == (INITIAL, False, QUICK_S)
    pair = driven(6)
    result = pair.extrinsic.result
    assert (result.status, pair.extrinsic.usable, result.frames_used) == (CONVERGED, True, 6)
    deg, m = se3.error(TRUE, result.T_camera_lidar)
    assert deg < 0.05
    assert m < 0.01
    assert squared(result.T_camera_lidar, result.covariance) < 22.5


def test_a_displacement_is_told_once_it_is_confirmed_and_found_at_the_same_time() -> None:
    pair, told = driven(5), []
    for a, b in moments(KNOCK @ TRUE, CONFIRM + 1, first=10):
        pair.add(a, b, TRUE)
        told.append(pair.extrinsic.result.status)
        assert pair.extrinsic.usable == (told[-1] == CONVERGED)
        assert pair.every_s == QUICK_S
    assert told == [SUSPECT] * (CONFIRM - 1) + [MOVED, CONVERGED]
    assert se3.error(KNOCK @ TRUE, pair.extrinsic.result.T_camera_lidar)[0] < 0.1


def test_one_scan_that_matches_elsewhere_is_forgotten() -> None:
    pair = driven(5)
    (wrong,), (right,) = moments(KNOCK @ TRUE, 1, first=10), moments(TRUE, 1, first=12)
    before = pair.extrinsic.result.T_camera_lidar
    pair.add(*wrong, TRUE)
    assert pair.extrinsic.result.status == SUSPECT
    np.testing.assert_array_equal(pair.extrinsic.result.T_camera_lidar, before)
    pair.add(*right, TRUE)
    assert (pair.extrinsic.result.status, pair.extrinsic.result.frames_used) == (CONVERGED, 6)


def test_the_scene_of_a_parked_vehicle_counts_once_and_rest_comes_with_enough() -> None:
    pair, standing = driven(LEAST + 1), drive(1) * 2
    for k in range(3):
        pair.add(scans(standing, np.eye(4), [1, 90 + k]), scans(standing, TRUE, [2, 90 + k]), TRUE)
    assert pair.extrinsic.result.frames_used == LEAST + 2  # the first one that stands is of another place
    pair._found.extend(list(pair._found) * SCANS)
    assert pair.every_s == REST_S


@pytest.mark.parametrize("known", [True, False])
def test_scans_that_do_not_match_are_told_and_cost_less_and_less(known) -> None:
    pair = driven(LEAST) if known else LidarPair("a", "b", STILL.time_offset_sigma_s, LIMITS)
    driving, standing = moments(FAR @ TRUE, FAILED, first=6), drive(1) * 2  # at rest motion tells nothing, either
    still = [(scans(standing, np.eye(4), [1, k]), scans(standing, FAR @ TRUE, [2, k])) for k in range(FAILED)]
    for a, b in driving if known else still:
        pair.add(a, b, FAR @ TRUE if known else FAR)
    result = pair.extrinsic.result
    assert (result.status, pair.extrinsic.usable) == (SUSPECT if known else INITIAL, False)
    assert ("match at" if known else "by their priors they share no view") in result.reason
    assert pair.every_s == (QUICK_S if known else QUICK_S * 2**FAILED)


@pytest.mark.parametrize(
    ("limits", "status"), [(RefineConfig(), INSUFFICIENT), (RefineConfig(tolerance_deg=2, tolerance_m=0.5), CONVERGED)]
)
def test_lidars_that_look_apart_are_joined_by_how_they_move(limits, status) -> None:
    """Before and behind the vehicle; of the drive every fourth scan and the next one are given."""
    turned, poses, n = TURNED, drive(90), MIN_MOTIONS + 6
    pair = LidarPair("a", "b", STILL.time_offset_sigma_s, limits)
    for k in range(0, 4 * n, 4):
        own = poses[k : k + 2]
        pair.add(scans(own, np.eye(4), [1, k], side=1), scans(own, turned, [2, k], side=1), WRONG @ turned)
        assert pair.extrinsic.result.frames_used in (0, len(pair._motions))
    result = pair.extrinsic.result
    assert (pair.kind, result.status, pair.extrinsic.usable, result.frames_used) == ("motion", status, status == CONVERGED, n)
    assert pair.every_s == QUICK_S
    assert se3.rotation_error_deg(turned, result.T_camera_lidar) < 1.0
    assert squared(result.T_camera_lidar, result.covariance, turned) < 22.5
    own = poses[4 * n : 4 * n + 2]  # a single scan matches, and they go on with what they have
    pair.add(scans(own, np.eye(4), [1, n]), scans(own, turned, [2, n]), turned)
    assert len(pair._found) == 1
    own = poses[4 * n - 2 : 4 * n]
    pair.add(scans(own, np.eye(4), [1, n + 1], side=1), scans(own, turned, [2, n + 1], side=1), WRONG @ turned)
    assert (pair.kind, pair.extrinsic.result.status, pair.extrinsic.result.frames_used) == ("motion", status, n + 1)
