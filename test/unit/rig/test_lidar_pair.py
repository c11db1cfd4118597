"""Two LiDARs while they drive: fused over time, a displacement noticed and found again, scans that do not match."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from room import STILL, TRUE, WRONG, drive, scans

from calib_ros import se3
from calib_ros.config import RefineConfig
from calib_ros.result import CONVERGED, INITIAL, INSUFFICIENT, MOVED, SUSPECT
from calib_ros.rig.lidar_pair import CONFIRM, FAILED, LEAST, QUICK_S, REST_S, LidarPair
from calib_ros.rig.lidars import MIN_MOTIONS, SCANS, LidarScans

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
    xi = se3.log(TRUE @ se3.inverse(result.T_camera_lidar))
    assert xi @ np.linalg.solve(result.covariance, xi) < 22.5  # chi^2 of 6, one in a thousand


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
    turned, poses, n = TRUE @ se3.exp([0, 0, np.pi, 0, 0, 0]), drive(90), MIN_MOTIONS + 6
    pair = LidarPair("a", "b", STILL.time_offset_sigma_s, limits)
    for k in range(0, 4 * n, 4):
        own = poses[k : k + 2]
        pair.add(scans(own, np.eye(4), [1, k], side=1), scans(own, turned, [2, k], side=1), WRONG @ turned)
        assert pair.extrinsic.result.frames_used in (0, len(pair._motions))
    result = pair.extrinsic.result
    assert (pair.kind, result.status, pair.extrinsic.usable, result.frames_used) == ("motion", status, status == CONVERGED, n)
    assert pair.every_s == QUICK_S
    xi = se3.log(turned @ se3.inverse(result.T_camera_lidar))
    assert np.rad2deg(np.linalg.norm(xi[:3])) < 1.0
    assert xi @ np.linalg.solve(result.covariance, xi) < 22.5  # chi^2 of 6, one in a thousand
    own = poses[4 * n : 4 * n + 2]  # a single scan matches, and they go on with what they have
    pair.add(scans(own, np.eye(4), [1, n]), scans(own, turned, [2, n]), turned)
    assert len(pair._found) == 1
    own = poses[4 * n - 2 : 4 * n]
    pair.add(scans(own, np.eye(4), [1, n + 1], side=1), scans(own, turned, [2, n + 1], side=1), WRONG @ turned)
    assert (pair.kind, pair.extrinsic.result.status, pair.extrinsic.result.frames_used) == ("motion", status, n + 1)
