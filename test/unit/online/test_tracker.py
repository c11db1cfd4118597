"""The tracker: gate, fusion over time, published status; and the pose filter by itself."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from tracked import (
    REFUSAL,
    USUAL_DEG,
    T,
    assessment,
    estimate,
    is_at,
    played,
    settled,
    tracking,
    turned,
    twist,
    unknown,
    variances,
)

from calib_ros import se3
from calib_ros.config import Config, TrackerConfig
from calib_ros.online.monitor import Verdict
from calib_ros.online.pose_filter import SYSTEMATIC_COVARIANCE, PoseFilter, without_systematic_error
from calib_ros.online.tracker import SETTLED_DEG, SETTLED_M, TRANSITIONS, UNSETTLING_REJECTIONS, Tracker, TrackerState
from calib_ros.registration.objective import SYSTEMATIC_ERROR
from calib_ros.result import CONVERGED, INITIAL, INSUFFICIENT, MOVED, REFUSED, Result


def test_first_good_estimate_replaces_the_initial_extrinsic():
    tracker, by = unknown(), ((0.5, 0, 0), (0.06, 0, 0))
    assert (tracker.last_good, tracker.monitored) == (None, False)
    extrinsic = tracker.update(estimate(by))
    assert extrinsic is tracker.current
    assert extrinsic.result is tracker.last_good
    assert (extrinsic.result.status, extrinsic.accepted, tracker.monitored) == (CONVERGED, 1, True)
    assert extrinsic.normalised_innovation > 2.5
    assert is_at(tracker, by, 0.001, 0.0001)  # the box, 3 deg and 30 cm wide, draws a little


@pytest.mark.parametrize(
    ("bad", "status", "says"),
    [
        (estimate(turned(9), status=REFUSED, reason="does not match"), REFUSED, "does not match"),
        (estimate(status=INSUFFICIENT, reason="drive on"), INSUFFICIENT, "drive on"),
        (estimate(turned(1), status=REFUSED), REFUSED, REFUSED),
        (estimate(turned(1.01), 2.0), REFUSED, r"1\.01 deg / \d+ cm .* 1 deg / 15 cm"),
        (estimate(((0, 0, 0), (0, 0.16, 0)), 2.0, 0.5), REFUSED, r"0\.00 deg / 16 cm .* 1 deg / 15 cm"),
        (estimate(turned(0.5)), REFUSED, r"0\.50 deg / \d+ cm"),
        (estimate(((0, 0, 0), (0, 0, 0.1))), REFUSED, r"0\.00 deg / 10 cm"),
    ],
)
def test_rejected_estimate_changes_only_the_status(bad, status, says):
    tracker = settled()
    before, good = tracker.current, tracker.last_good
    after = tracker.update(replace(bad, score=0.123, frames_used=3))
    assert np.array_equal(tracker.T, before.result.T_camera_lidar)
    assert tracker.last_good is good
    assert (after.result.status, after.result.score, after.result.frames_used) == (status, 0.123, 3)
    assert np.array_equal(after.result.covariance, good.covariance)
    assert (after.accepted, after.normalised_innovation) == (2, before.normalised_innovation)
    assert re.search(says, after.result.reason)


@pytest.mark.parametrize(("deg", "status"), [(USUAL_DEG, REFUSED), (0.15, CONVERGED)])
def test_innovation_gate_depends_on_the_covariance(deg, status):
    """0.28 deg away: not from an estimate that is sure, but from one that is not."""
    assert played(settled(), estimate(turned(0.28), deg=deg)) == [status]


def test_requested_estimate_bypasses_the_gate():
    tracker, far = settled(), ((2.5, 0, 0), (0.2, 0, 0))
    assert played(tracker, estimate(far)) == [REFUSED]
    extrinsic = tracker.update(estimate(far), share_new=0.0, on_request=True)
    assert is_at(tracker, far, 0.01, 0.001)  # whatever share was new
    assert extrinsic.result.status == CONVERGED
    assert tracker.last_good is extrinsic.result
    assert not tracker.settled  # nothing has confirmed it
    assert tracker.update(REFUSAL, on_request=True).result.status == REFUSED


def test_settled_after_two_consecutive_estimates_agree():
    tracker = unknown()
    for new, expected in (
        (estimate(), False),  # it agrees with the initial extrinsic, which nothing has confirmed
        (estimate(turned(2 * SETTLED_DEG)), False),
        (estimate(turned(2.5 * SETTLED_DEG)), True),
        (REFUSAL, True),
        (estimate(((2.5 * SETTLED_DEG, 0, 0), (1.5 * SETTLED_M, 0, 0)), m=0.05), False),  # probable, and yet far
    ):
        tracker.update(new)
        assert tracker.settled is expected


def test_consecutive_refusals_reopen_the_search_at_the_last_good_extrinsic():
    tracker, near = unknown(), estimate(turned(2))
    tracker.update(near)
    assert np.array_equal(tracker.search_center, T)  # one estimate may be wrong: the box stays where the user put it
    tracker.update(near)
    assert np.allclose(tracker.search_center, near.T_camera_lidar, atol=1e-4)
    played(tracker, *[REFUSAL] * (UNSETTLING_REJECTIONS - 1), near)  # not in a row
    for expected in (True, True, False):
        tracker.update(REFUSAL)
        assert tracker.settled == expected
    assert np.allclose(tracker.search_center, near.T_camera_lidar, atol=1e-4)
    tracker.reset()
    assert np.array_equal(tracker.search_center, T)


# --- fusion ---------------------------------------------------------------------------------------------------------------


def test_repeated_frames_do_not_shrink_the_covariance(monkeypatch):
    """30 estimates over the same 20 frames, one of which is new each time, tell as much as 30 frames."""
    for noise in ("PROCESS_NOISE_DEG", "PROCESS_NOISE_M"):
        monkeypatch.setattr(f"calib_ros.online.pose_filter.{noise}", 0.0)
    tracker = settled()
    start = tracker.spread
    for count, share, rtol in ((30, 1 / 20, 1e-3), (5, 0.0, 0.01)):
        for _ in range(count):
            tracker.update(estimate(), share_new=share)
        assert np.allclose(tracker.spread, start / (1 + 30 / 20), rtol=rtol, atol=1e-12)
    for _ in range(300):  # what all share, no frame averages out
        tracker.update(estimate())
    assert np.allclose(tracker.current.result.covariance, SYSTEMATIC_COVARIANCE, rtol=0.01, atol=1e-9)
    assert not without_systematic_error(SYSTEMATIC_COVARIANCE / 2).any()  # less than the bias is none


def test_process_noise_accumulates_while_estimates_are_rejected():
    tracker = settled()
    before = tracker.spread[0, 0]
    tracker.update(REFUSAL, seconds=60.0)
    tracker.apply(assessment(Verdict.SUSPECT))
    for seconds in (60.0, -1e6):  # then the clock is set back
        tracker.update(estimate(), seconds=seconds)
        assert tracker.spread[0, 0] - before == pytest.approx(2 * np.deg2rad(0.1) ** 2)


def test_fixed_axes_do_not_move():
    """A roll and a forward shift that the user has fixed: estimates have no variance there."""
    tracker, free = unknown(), [0, 1, 3, 4]
    for k in range(20):
        by = ((0.3 + 0.02 * math.sin(k), 0.2 + 0.02 * math.cos(k), 0), (0.01 + 0.003 * math.cos(k), 0, 0))
        extrinsic = tracker.update(estimate(by, [0.02, 0.02, 0], [0.005, 0.005, 0]), 0.3, 10.0)
        assert extrinsic.result.status == CONVERGED, extrinsic.result.reason
        C = extrinsic.result.covariance
        assert not C[[2, 5]].any()
        assert not C[:, [2, 5]].any()
        assert (np.diag(C)[free] > SYSTEMATIC_ERROR[free] ** 2).all()
        deg, m = twist(tracker.T)
        assert abs(deg[2]) < 1e-3  # second order of the other turns
        assert abs(m[2]) < 1e-4
    assert deg[0] == pytest.approx(0.3, abs=0.03)
    off = estimate(((0.9, 0.2, 0), (0.01, 0, 0)), [0.02, 0.02, 0], [0.005, 0.005, 0])
    assert played(tracker, off) == [REFUSED]  # 4 axes are enough to tell


def test_saved_state_restores_its_covariance():
    saved = estimate(turned(0.2))
    tracker = tracking(Result(T, INITIAL), saved)
    assert tracker.last_good is saved
    assert np.array_equal(tracker.T, saved.T_camera_lidar)
    assert np.allclose(tracker.spread, variances() - SYSTEMATIC_COVARIANCE, atol=1e-12)
    assert np.array_equal(tracker.search_center, saved.T_camera_lidar)
    assert (tracker.monitored, tracker.settled) == (True, False)  # the first estimate may be elsewhere: who knows
    assert played(tracker, estimate(turned(2))) == [CONVERGED]
    assert is_at(tracker, turned(2), 0.01, 0.001)
    without = tracking(replace(saved, covariance=None))
    assert without.monitored
    assert not without.spread.any()
    tracker.reset()
    assert np.array_equal(tracker.T, T)
    assert not tracker.monitored


def test_estimate_over_all_frames_replaces_earlier_ones():
    for covers_all, least, most in ((True, 0.098, 0.102), (False, 0.0, 0.05)):  # else fused, as one of several
        tracker = settled()
        tracker.update(estimate(turned(0.1)), 0.2, covers_all=covers_all)
        assert least < twist(tracker.T)[0][0] < most


# --- what is told ---------------------------------------------------------------------------------------------------------


def test_weak_direction_is_named_and_the_result_not_saved():
    tracker = unknown()
    extrinsic = tracker.update(estimate(deg=[0.03, 0.4, 0.03], m=[0.006, 0.006, 0.09], reason="one frame only"))
    assert (extrinsic.result.status, extrinsic.accepted) == (INSUFFICIENT, 1)
    assert re.search(r"forward shift \(9 cm\), yaw \(0.40 deg\).*one frame only", extrinsic.result.reason)
    assert (tracker.last_good, tracker.monitored) == (None, False)
    assert played(tracker, *[estimate()] * 4)[-1] == CONVERGED  # other scenes show it
    assert tracker.last_good is tracker.current.result
    # What was shown before is not lost with a scene that does not show it.
    assert played(tracker, estimate(deg=[0.03, 0.4, 0.03])) == [CONVERGED]


def test_probability_is_that_of_chi_squared():
    """One standard deviation along one axis: 0.9856 of all draws of six are farther away."""
    filter, C = PoseFilter(T, variances() - SYSTEMATIC_COVARIANCE), variances()
    sigma = np.sqrt(np.diag(filter.spread + C))
    assert filter.probability(T, C) == 1
    for k in range(6):
        assert filter.probability(se3.exp(sigma * np.eye(6)[k]) @ T, C) == pytest.approx(0.98561, abs=1e-4)
    # With fixed axes, of those that are left.
    fixed = PoseFilter(T, np.diag([1e-6, 0, 0, 0, 0, 0]))
    assert fixed.probability(se3.exp([2e-3, 1e-9, 0, 0, 0, 0]) @ T, np.zeros((6, 6))) == pytest.approx(0.0455, abs=1e-3)
    assert PoseFilter(T, np.zeros((6, 6))).probability(T, np.zeros((6, 6))) == 1


def test_every_transition_happens_and_no_other():
    """Random drives: what is not in the table of transitions would raise, and only what is confirmed or saved is usable."""
    seen = set()
    for seed in range(60):
        rng = np.random.default_rng(seed)
        config = replace(Config(), tracker=replace(TrackerConfig(), confirmations=int(rng.integers(1, 3))))
        saved, moved = estimate(), estimate(status=MOVED, reason="moved before")
        tracker = Tracker(Result(T, INITIAL), [None, saved, moved][seed % 3], config)
        for _ in range(40):
            before = tracker.state
            if rng.random() < 0.5:
                # Not only while it is monitored: an estimate may end while a keyframe is being tested.
                tracker.apply(assessment(list(Verdict)[rng.choice(4, p=[0.6, 0.1, 0.1, 0.2])]))
            else:
                offset = rng.choice([0.0, 0.05], p=[0.8, 0.2])
                new = estimate(turned(rng.choice([0, 0, 0, 2])), time_offset_s=offset, time_offset_sigma_s=0.001)
                tracker.update(REFUSAL if rng.random() < 0.3 else new, on_request=bool(rng.random() < 0.1))
            seen.add((before, tracker.state))
            if tracker.current.usable:
                assert tracker.state in (TrackerState.INITIAL, TrackerState.CONFIRMED)
    assert {(before, after) for (before, _), after in TRANSITIONS.items() if after is not TrackerState.INITIAL} <= seen
