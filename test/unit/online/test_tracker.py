"""The tracker: gate, fusion over time, published status; and the pose filter by itself."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from calib_ros import se3
from calib_ros.config import Config, TrackerConfig, update
from calib_ros.online.monitor import Assessment, Verdict
from calib_ros.online.pose_filter import SYSTEMATIC_COVARIANCE, PoseFilter, without_systematic_error
from calib_ros.online.sensor_health import SensorFault, SensorProblem
from calib_ros.online.tracker import RECOVERING, SETTLED_DEG, SETTLED_M, UNSETTLING_REJECTIONS, Tracker
from calib_ros.registration.covariance import SYSTEMATIC_ERROR
from calib_ros.result import BLINDED, CONVERGED, INITIAL, INSUFFICIENT, MOVED, REFUSED, SUSPECT, TENTATIVE, Extrinsic, Result

T = se3.exp([0.1, -1.2, 0.9, 0.27, -0.05, 0.1])
STILL = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
USUAL_DEG, USUAL_M = 0.03, 0.006


def variances(deg: object = USUAL_DEG, m: object = USUAL_M) -> np.ndarray:
    """(6, 6) of standard deviations, of all axes or of each, with the bias of every estimate where there is any."""
    sigma = np.concatenate([np.deg2rad(np.broadcast_to(deg, 3)), np.broadcast_to(m, 3)])
    return np.diag(sigma**2) + SYSTEMATIC_COVARIANCE * (sigma > 0)


def at(by: tuple = STILL) -> np.ndarray:
    """T after a left twist, deg and m."""
    return se3.exp(np.concatenate([np.deg2rad(by[0]), by[1]])) @ T


def estimate(by: tuple = STILL, deg: object = USUAL_DEG, m: object = USUAL_M, status: str = CONVERGED, **more) -> Result:
    return Result(at(by), status, **{"score": 0.8, "covariance": variances(deg, m), "frames_used": 7, **more})


def twist(a: np.ndarray, b: np.ndarray = T) -> tuple[np.ndarray, np.ndarray]:
    """From b to a, deg and m."""
    xi = se3.log(a @ se3.inverse(b))
    return np.rad2deg(xi[:3]), xi[3:]


def tracking(initial: Result, current: Result | None = None, config: Config | None = None) -> Tracker:
    """A tracker that trusts the first estimate."""
    config = config or Config()
    return Tracker(initial, current, replace(config, tracker=replace(config.tracker, confirmations=0)))


def unknown(config: Config | None = None) -> Tracker:
    return tracking(Result(T, INITIAL, "no estimate yet"), config=config)


def settled(config: Config | None = None) -> Tracker:
    """Two estimates agree, at T."""
    tracker = unknown(config)
    for _ in range(2):
        tracker.update(estimate())
    assert tracker.settled
    return tracker


def blind(tracker: Tracker, message: str) -> Extrinsic:
    """The camera shows nothing, or both sensors work ("")."""
    return tracker.set_sensor_problem(SensorProblem(SensorFault.CAMERA_BLIND, message) if message else None)


def assessment(verdict: Verdict, text: str = "in words", p_value: float = 1e-5) -> Assessment:
    return Assessment(verdict, text, p_value, 3)


# --- the first estimate ---------------------------------------------------------------------------------------------------


def confirming(config: Config | None = None) -> Tracker:
    """A tracker that has accepted its first estimate."""
    tracker = Tracker(Result(T, INITIAL), config=config)
    extrinsic = tracker.update(estimate())
    assert extrinsic.result.status == TENTATIVE
    assert not extrinsic.usable
    assert tracker.monitored
    return tracker


def consistent(tracker: Tracker, keyframes: int) -> Extrinsic:
    for _ in range(keyframes):
        tracker.apply(assessment(Verdict.CONSISTENT))
    return tracker.current


def test_first_estimate_is_tentative_until_keyframes_and_another_estimate_confirm_it():
    tracker = confirming()
    assert consistent(tracker, 4).result.reason.startswith("to be confirmed by keyframes, 4 of 5")
    assert tracker.update(estimate()).result.status == TENTATIVE
    assert tracker.apply(assessment(Verdict.INCONCLUSIVE)).result.status == TENTATIVE  # it shows nothing
    extrinsic = consistent(tracker, 1)
    assert extrinsic.result.status == CONVERGED
    assert extrinsic.usable

    tracker = confirming()
    assert consistent(tracker, 9).result.reason.startswith("to be confirmed by another estimate")
    assert tracker.update(estimate(((0, 0.1, 0), (0.02, 0, 0)))).usable


def test_an_estimate_elsewhere_has_to_be_confirmed_anew():
    tracker = confirming()
    consistent(tracker, 4)
    assert tracker.update(estimate(((0, 0.8, 0), (0.1, 0, 0)))).result.status == TENTATIVE
    assert consistent(tracker, 4).result.status == TENTATIVE
    assert tracker.update(estimate(((0, 0.8, 0), (0.1, 0, 0)))).result.status == TENTATIVE
    assert consistent(tracker, 1).usable


def test_keyframes_confirm_where_no_other_estimate_comes_and_estimates_where_nothing_monitors():
    manual = confirming(update(Config(), {"online": {"mode": "manual"}}))
    assert consistent(manual, 5).usable
    unmonitored = confirming(update(Config(), {"monitor": {"enabled": False}}))
    assert unmonitored.update(estimate()).usable
    jumped = unmonitored.update(estimate(((2.0, 0, 0), (0.2, 0, 0))), on_request=True)
    assert jumped.result.status == TENTATIVE


def test_saved_extrinsic_counts_as_an_estimate():
    saved = estimate()
    near, far = (Tracker(saved).update(estimate(((0, deg, 0), (0, 0, 0)))) for deg in (0.05, 2.0))
    assert near.result.status == CONVERGED
    assert near.usable
    assert far.result.status == TENTATIVE
    assert not far.usable


def test_a_confirmed_saved_extrinsic_stays_usable_on_an_empty_road():
    tracker = Tracker(estimate())
    assert not tracker.apply(assessment(Verdict.INCONCLUSIVE)).usable
    assert consistent(tracker, 1).usable
    assert tracker.apply(assessment(Verdict.INCONCLUSIVE)).usable


def clocks(left_m: float, sigma_s: float) -> dict[str, object]:
    """What clocks that are known to sigma_s leave open of an estimate: a shift along the view."""
    return {"clock_covariance": np.diag([0, 0, 0, 0, 0, left_m**2]), "clock_sigma_s": sigma_s}


STANDING, ALIKE, SLOWING_DOWN = clocks(0.0, 0.05), clocks(0.2, 0.05), clocks(0.02, 0.005)


def test_estimate_is_tentative_until_one_shows_that_the_clocks_agree():
    tracker = confirming()  # the motion in the first estimate is not known
    for _ in range(3):
        tracker.update(estimate(**ALIKE))
        extrinsic = consistent(tracker, 5)
        assert extrinsic.result.status == TENTATIVE
        assert not extrinsic.usable
    assert extrinsic.result.reason.startswith("to be confirmed by frames of another speed or turn")
    assert tracker.update(estimate(**SLOWING_DOWN)).usable
    assert tracker.update(estimate(**ALIKE)).usable  # clocks stay as they are


def test_standing_still_needs_no_clocks_and_says_nothing_of_them():
    tracker = confirming()
    tracker.update(estimate(**STANDING))
    assert consistent(tracker, 5).usable
    assert tracker.update(estimate(**ALIKE)).usable  # it was right without them

    tracker = Tracker(Result(T, INITIAL), config=Config())
    tracker.update(estimate(**STANDING))
    for _ in range(3):
        tracker.update(estimate(((0, 0, 0), (0.3, 0, 0)), **ALIKE))
        extrinsic = consistent(tracker, 5)
    assert extrinsic.result.status == TENTATIVE


def test_clocks_that_are_said_to_agree_need_not_be_shown():
    tracker = confirming()
    tracker.update(estimate(**ALIKE))
    assert not consistent(tracker, 5).usable
    tracker.config = update(tracker.config, {"motion": {"max_time_offset_s": 0.0}})
    assert consistent(tracker, 1).usable


def test_what_the_sensors_leave_open_is_not_averaged_out():
    tracker, shared = unknown(), np.diag([0, 0, 0, 0, 0, 0.03**2])
    for _ in range(20):
        extrinsic = tracker.update(estimate(covariance=variances() + shared, shared_covariance=shared))
    assert extrinsic.result.covariance[5, 5] > 0.03**2
    assert tracker.spread[5, 5] < 0.006**2


def test_movement_while_tentative_starts_the_confirmation_anew():
    tracker = confirming()
    consistent(tracker, 4)
    tracker.apply(assessment(Verdict.MOVED))
    for _ in range(RECOVERING + 1):
        tracker.update(estimate(((3.0, 0, 0), (0.3, 0, 0))))
    assert tracker.current.result.status == TENTATIVE
    assert consistent(tracker, 5).usable


# --- the gate -------------------------------------------------------------------------------------------------------------


def test_first_good_estimate_replaces_the_initial_extrinsic():
    tracker = unknown()
    assert tracker.last_good is None
    assert not tracker.monitored
    extrinsic = tracker.update(estimate(((0.5, 0, 0), (0.06, 0, 0))))
    assert extrinsic is tracker.current
    assert extrinsic.result is tracker.last_good
    assert extrinsic.result.status == CONVERGED
    assert (extrinsic.accepted, extrinsic.normalised_innovation > 2.5) == (1, True)
    deg, m = twist(tracker.T, at(((0.5, 0, 0), (0.06, 0, 0))))
    # The box, 3 deg and 30 cm wide, draws a little.
    assert np.abs(deg).max() < 0.001
    assert np.abs(m).max() < 0.0001
    assert tracker.monitored


def test_rejected_estimate_changes_only_the_status():
    for bad, status, says in (
        (estimate(((9, 0, 0), (0, 0, 0)), status=REFUSED, reason="does not match"), REFUSED, "does not match"),
        (estimate(status=INSUFFICIENT, reason="drive on"), INSUFFICIENT, "drive on"),
        (estimate(((1, 0, 0), (0, 0, 0)), status=REFUSED), REFUSED, REFUSED),
        (estimate(((0, 1.01, 0), (0, 0, 0)), 2.0), REFUSED, r"1\.01 deg / \d+ cm away .* beyond 1 deg / 15 cm"),
        (estimate(((0, 0, 0), (0, 0.16, 0)), 2.0, 0.5), REFUSED, r"0\.00 deg / 16 cm away .* beyond 1 deg / 15 cm"),
        (
            estimate(((0.5, 0, 0), (0, 0, 0))),
            REFUSED,
            r"does not fit the current extrinsic \(0\.50 deg / \d+ cm away, far beyond",
        ),
        (estimate(((0, 0, 0), (0, 0, 0.1))), REFUSED, r"does not fit the current extrinsic \(0\.00 deg / 10 cm away"),
    ):
        tracker = settled()
        before, good = tracker.current, tracker.last_good
        after = tracker.update(replace(bad, score=0.123, frames_used=3))
        assert np.array_equal(tracker.T, before.result.T_camera_lidar)
        assert tracker.last_good is good
        assert after.result.status == status
        assert pytest.approx(0.123) == after.result.score
        assert after.result.frames_used == 3
        assert np.array_equal(after.result.covariance, good.covariance)
        assert (after.accepted, after.normalised_innovation) == (2, before.normalised_innovation)
        assert re.search(says, after.result.reason)


def test_innovation_gate_depends_on_the_covariance():
    """0.28 deg away: not from an estimate that is sure, but from one that is not; nor where the gate is wider."""
    off = ((0.28, 0, 0), (0, 0, 0))
    sure, unsure, open_gate = settled(), settled(), settled(Config(tracker=TrackerConfig(gate=0.0)))
    assert sure.update(estimate(off)).result.status == REFUSED
    assert unsure.update(estimate(off, deg=0.15)).result.status == CONVERGED
    assert open_gate.update(estimate(off)).result.status == CONVERGED


def test_requested_estimate_bypasses_the_gate():
    tracker = settled()
    far = ((2.5, 0, 0), (0.2, 0, 0))
    assert tracker.update(estimate(far)).result.status == REFUSED
    extrinsic = tracker.update(estimate(far), share_new=0.0, on_request=True)
    assert extrinsic.result.status == CONVERGED
    deg, m = twist(tracker.T, at(far))
    assert np.abs(deg).max() < 0.01  # whatever share was new
    assert np.abs(m).max() < 0.001
    assert tracker.last_good is extrinsic.result
    assert not tracker.settled  # nothing has confirmed it
    refused = tracker.update(estimate(status=REFUSED, reason="no match"), on_request=True)
    assert refused.result.reason == "no match"


def test_settled_after_two_consecutive_estimates_agree():
    tracker = unknown()
    tracker.update(estimate())
    assert not tracker.settled  # it agrees with the initial extrinsic, which nothing has confirmed
    tracker.update(estimate(((2 * SETTLED_DEG, 0, 0), (0, 0, 0))))
    assert not tracker.settled
    tracker.update(estimate(((2.5 * SETTLED_DEG, 0, 0), (0, 0, 0))))
    assert tracker.settled
    tracker.update(estimate(status=REFUSED, reason="x"))
    assert tracker.settled
    tracker.update(estimate(((2.5 * SETTLED_DEG, 0, 0), (1.5 * SETTLED_M, 0, 0)), m=0.05))  # probable, and yet far
    assert not tracker.settled


def test_consecutive_refusals_reopen_the_search_at_the_last_good_extrinsic():
    tracker = unknown()
    near = estimate(((2, 0, 0), (0, 0, 0)))
    tracker.update(near)
    assert np.array_equal(tracker.search_center, T)  # one estimate may be wrong: the box stays where the user put it
    tracker.update(near)
    assert np.allclose(tracker.search_center, near.T_camera_lidar, atol=1e-4)
    refused = estimate(status=REFUSED, reason="too far")
    for _ in range(UNSETTLING_REJECTIONS - 1):
        tracker.update(refused)
    tracker.update(near)  # not in a row
    for expected in (True, True, False):
        tracker.update(refused)
        assert tracker.settled == expected
    assert np.allclose(tracker.search_center, near.T_camera_lidar, atol=1e-4)
    # Now a jump is followed, since a search has found it, but not relied on before others agree.
    assert tracker.update(estimate(((0, 2, 0), (0, 0, 0)))).result.status == MOVED
    assert twist(tracker.T)[0][1] == pytest.approx(2, abs=0.01)
    tracker.reset()
    assert np.array_equal(tracker.search_center, T)


# --- fusion ---------------------------------------------------------------------------------------------------------------


def test_unobservable_directions_keep_their_value():
    """The second scene shows no forward shift, and says nonsense of it."""
    tracker = settled()
    known = tracker.current.result.covariance
    weak = estimate(((0.05, 0, 0), (0, 0.01, 0.12)), m=[USUAL_M, USUAL_M, 1.0])
    extrinsic = tracker.update(weak)
    assert extrinsic.result.status == CONVERGED
    deg, m = twist(tracker.T)
    assert deg[0] == pytest.approx(0.025, abs=0.003)  # half way: as sure as what was known
    assert m[1] == pytest.approx(0.005, abs=0.0005)
    assert abs(m[2]) < 1e-3
    after = extrinsic.result.covariance
    assert after[5, 5] == pytest.approx(known[5, 5], rel=0.01)
    assert after[4, 4] < 0.9 * known[4, 4]


def test_repeated_frames_do_not_shrink_the_covariance():
    """30 estimates over the same 20 frames, one of which is new each time, tell as much as 30 frames."""
    tracker = settled(Config(tracker=TrackerConfig(process_noise_deg=0.0, process_noise_m=0.0)))
    start = tracker.spread
    for _ in range(30):
        tracker.update(estimate(), share_new=1 / 20)
    assert np.allclose(tracker.spread, start / (1 + 30 / 20), rtol=1e-3, atol=1e-12)
    for _ in range(5):
        tracker.update(estimate(), share_new=0.0)
    assert np.allclose(tracker.spread, start / (1 + 30 / 20), rtol=0.01, atol=1e-12)
    for _ in range(500):
        tracker.update(estimate())
    assert np.allclose(
        tracker.current.result.covariance, SYSTEMATIC_COVARIANCE, rtol=0.01, atol=1e-9
    )  # what all share, no frame averages out


def test_covariance_grows_with_time():
    off = ((0.12, 0, 0), (0.02, 0, 0))
    moves = []
    for seconds in (0.0, 3600.0):
        tracker = settled()
        for _ in range(50):
            tracker.update(estimate())
        tracker.update(estimate(off, deg=0.1, m=0.02), seconds=seconds)
        moves.append(twist(tracker.T)[0][0] / 0.12)
    assert moves[0] < 0.02
    assert moves[1] > 0.95  # 0.1 deg x sqrt(60 min) = 0.77 deg of creep


def test_process_noise_accumulates_while_estimates_are_rejected():
    tracker = settled()
    before = tracker.spread[0, 0]
    tracker.update(estimate(status=REFUSED), seconds=60.0)
    tracker.apply(assessment(Verdict.SUSPECT))
    tracker.update(estimate(), seconds=60.0)
    assert tracker.spread[0, 0] - before == pytest.approx(2 * np.deg2rad(0.1) ** 2)
    tracker.update(estimate(), seconds=-1e6)  # a clock that was set back
    assert tracker.spread[0, 0] - before == pytest.approx(2 * np.deg2rad(0.1) ** 2)


def test_a_slow_drift_is_followed():
    """0.5 deg in a minute, for five minutes. An estimate a second over 20 frames lags 10 s behind, and is off by its noise."""
    tracker, rng = settled(), np.random.default_rng(3)
    errors, refused = [], 0
    for second in range(300):
        angle = 0.5 * second / 60
        by = ((0, angle - 0.5 * 10 / 60 + rng.normal(0, USUAL_DEG), 0), tuple(rng.normal(0, USUAL_M, 3)))
        extrinsic = tracker.update(estimate(by), share_new=1 / 20, seconds=1.0)
        refused += extrinsic.result.status != CONVERGED
        errors.append(se3.rotation_error_deg(at(((0, angle, 0), (0, 0, 0))), tracker.T))
    assert max(errors) < 0.3
    assert refused == 0


def test_fixed_axes_do_not_move():
    """A roll and a forward shift that the user has fixed: estimates have no variance there."""
    tracker = unknown()
    for k in range(20):
        by = ((0.3 + 0.02 * math.sin(k), 0.2 + 0.02 * math.cos(k), 0), (0.01 + 0.003 * math.cos(k), 0, 0))
        extrinsic = tracker.update(estimate(by, [0.02, 0.02, 0], [0.005, 0.005, 0]), 0.3, 10.0)
        assert extrinsic.result.status == CONVERGED, extrinsic.result.reason
        C = extrinsic.result.covariance
        assert not C[[2, 5]].any()
        assert not C[:, [2, 5]].any()
        assert (np.diag(C)[[0, 1, 3, 4]] > SYSTEMATIC_ERROR[[0, 1, 3, 4]] ** 2).all()
        deg, m = twist(tracker.T)
        assert abs(deg[2]) < 1e-3  # second order of the other turns
        assert abs(m[2]) < 1e-4
    assert deg[0] == pytest.approx(0.3, abs=0.03)
    off = estimate(((0.9, 0.2, 0), (0.01, 0, 0)), [0.02, 0.02, 0], [0.005, 0.005, 0])
    assert tracker.update(off).result.status == REFUSED  # 4 axes are enough to tell


def test_saved_state_restores_its_covariance():
    saved = estimate(((0.2, 0, 0), (0, 0, 0)))
    tracker = tracking(Result(T, INITIAL), saved)
    assert tracker.last_good is saved
    assert np.array_equal(tracker.current.result.T_camera_lidar, saved.T_camera_lidar)
    assert tracker.monitored
    assert np.allclose(tracker.spread, variances() - SYSTEMATIC_COVARIANCE, atol=1e-12)
    assert np.array_equal(tracker.search_center, saved.T_camera_lidar)
    assert not tracker.settled  # the first estimate may be elsewhere: who knows what happened since
    extrinsic = tracker.update(estimate(((2, 0, 0), (0, 0, 0))))
    assert extrinsic.result.status == CONVERGED
    assert twist(tracker.T)[0][0] == pytest.approx(2, abs=0.01)
    without = tracking(replace(saved, covariance=None))
    assert without.monitored
    assert not without.spread.any()
    tracker.reset()
    assert np.array_equal(tracker.T, T)
    assert not tracker.monitored


# --- what is told ---------------------------------------------------------------------------------------------------------


def test_weak_direction_is_named_and_the_result_not_saved():
    tracker = unknown()
    extrinsic = tracker.update(estimate(deg=[0.03, 0.4, 0.03], m=[0.006, 0.006, 0.09], reason="one frame only"))
    assert extrinsic.result.status == INSUFFICIENT
    expected = "the scenes do not show forward shift (9 cm), yaw (0.40 deg) well; drive on; one frame only"
    assert extrinsic.result.reason == expected
    assert extrinsic.accepted == 1
    assert tracker.last_good is None
    assert not tracker.monitored
    for _ in range(4):  # other scenes show it
        extrinsic = tracker.update(estimate())
    assert extrinsic.result.status == CONVERGED
    assert tracker.last_good is extrinsic.result
    # What was shown before is not lost with a scene that does not show it.
    assert tracker.update(estimate(deg=[0.03, 0.4, 0.03])).result.status == CONVERGED


def test_known_directions_become_weak_with_time_and_the_last_good_result_stays():
    tracker = settled()
    good = tracker.last_good
    extrinsic = tracker.update(estimate(m=[USUAL_M, USUAL_M, 2.0]), seconds=3600.0)
    assert extrinsic.result.status == INSUFFICIENT
    assert "forward shift (8 cm)" in extrinsic.result.reason  # 1 cm x sqrt(60 min)
    assert tracker.last_good is good


def test_suspect_extrinsic_is_held_until_confirmed_again():
    tracker = settled()
    before = tracker.current
    extrinsic = tracker.apply(assessment(Verdict.SUSPECT, "2 deg elsewhere", 1e-6))
    assert (extrinsic.result.status, extrinsic.result.reason) == (SUSPECT, "2 deg elsewhere")
    assert (extrinsic.monitor_message, extrinsic.p_value) == ("2 deg elsewhere", 1e-6)
    assert tracker.suspect
    assert tracker.monitored
    assert tracker.last_good is before.result
    during = tracker.update(estimate(((0.05, 0, 0), (0, 0, 0))))  # its frames are in question
    assert during.accepted == before.accepted
    assert np.array_equal(tracker.T, before.result.T_camera_lidar)
    extrinsic = tracker.apply(assessment(Verdict.CONSISTENT, "fits after all", 0.4))
    assert extrinsic.result is before.result
    assert (extrinsic.monitor_message, extrinsic.p_value) == ("fits after all", 0.4)
    assert not tracker.suspect
    assert tracker.apply(assessment(Verdict.INCONCLUSIVE, "tells nothing")).result.status == CONVERGED
    assert tracker.update(estimate(((0.05, 0, 0), (0, 0, 0)))).accepted == before.accepted + 1


def test_requested_estimate_is_answered_while_suspect():
    tracker = settled()
    tracker.apply(assessment(Verdict.SUSPECT))
    extrinsic = tracker.update(estimate(((2, 0, 0), (0, 0, 0))), on_request=True)
    assert extrinsic.result.status == CONVERGED
    assert not tracker.suspect
    assert extrinsic.monitor_message == ""  # what the monitor said was of another extrinsic
    assert math.isnan(extrinsic.p_value)


def test_suspicion_ends_when_the_monitor_stops():
    tracker = settled()
    before = tracker.current
    tracker.apply(assessment(Verdict.SUSPECT))
    assert tracker.stop_monitoring().result is before.result
    assert not tracker.suspect
    tracker.apply(assessment(Verdict.MOVED))
    assert tracker.stop_monitoring().result.status == MOVED  # that it is not where it was remains true


def test_moved_until_estimates_in_a_row_agree():
    tracker = settled()
    good = tracker.last_good
    tracker.update(estimate(status=REFUSED, reason="an old refusal"))
    extrinsic = tracker.apply(assessment(Verdict.MOVED, "has moved"))
    assert (extrinsic.result.status, extrinsic.result.reason) == (MOVED, "has moved")
    assert np.array_equal(extrinsic.result.T_camera_lidar, good.T_camera_lidar)
    assert not tracker.monitored
    assert not tracker.suspect  # estimates are wanted
    new = ((0, 2, 0), (0.05, 0, 0))
    refused = tracker.update(estimate(status=REFUSED, reason="no optimum"))
    assert (refused.result.status, refused.result.reason) == (MOVED, "estimate refused: no optimum")
    seen, agreeing = [], []
    other = ((0, -1, 0), (0, 0, 0))  # a few keyframes of one place may share a wrong optimum
    for by in [other, other, *[new] * (RECOVERING + 1)]:
        assert tracker.last_good is good
        assert not tracker.settled
        shown = tracker.update(estimate(by)).result
        seen.append(shown.status)
        if shown.status == MOVED:
            agreeing.append(int(shown.reason.removeprefix("estimate converged: ").partition(" of ")[0]))
    assert seen == [MOVED] * (RECOVERING + 2) + [CONVERGED]
    assert agreeing == [0, 1, 0, *range(1, RECOVERING)]
    assert tracker.settled
    assert tracker.monitored
    assert tracker.last_good is tracker.current.result is not good
    assert twist(tracker.T)[0][1] == pytest.approx(2, abs=0.01)
    assert tracker.current.monitor_message == ""


def test_moved_and_weak_result_is_not_saved():
    tracker = settled()
    good = tracker.last_good
    tracker.apply(assessment(Verdict.MOVED))
    for _ in range(RECOVERING + 1):
        extrinsic = tracker.update(estimate(((0, 2, 0), (0, 0, 0)), m=[0.006, 0.006, 0.08]))
    assert extrinsic.result.status == INSUFFICIENT
    assert tracker.last_good is good
    assert tracker.update(estimate(((0, 2, 0), (0, 0, 0)))).result.status == CONVERGED
    assert tracker.last_good is not good


def test_requested_estimate_ends_a_movement():
    tracker = settled()
    tracker.apply(assessment(Verdict.MOVED))
    assert tracker.update(estimate(status=REFUSED, reason="no"), on_request=True).result.status == MOVED
    extrinsic = tracker.update(estimate(((0, 2, 0), (0, 0, 0))), on_request=True)
    assert extrinsic.result.status == CONVERGED
    assert tracker.last_good is extrinsic.result


def test_the_search_after_a_movement_begins_where_the_camera_was():
    tracker = unknown()
    for _ in range(2):
        tracker.update(estimate(((2, 0, 0), (0, 0, 0))))
    tracker.apply(assessment(Verdict.MOVED))
    was = tracker.T
    assert np.array_equal(tracker.search_center, was)
    tracker.update(estimate(((0, 2, 0), (0, 0, 0))))  # one of its own may be wrong
    assert np.array_equal(tracker.search_center, was)


def test_blinded_overrides_all_statuses_but_moved_and_ends():
    tracker = settled()
    for verdict, status in ((Verdict.CONSISTENT, CONVERGED), (Verdict.SUSPECT, SUSPECT)):
        before = tracker.apply(assessment(verdict)).result
        extrinsic = blind(tracker, "the camera shows nothing")
        assert (extrinsic.result.status, extrinsic.result.reason) == (BLINDED, "the camera shows nothing")
        assert np.array_equal(extrinsic.result.T_camera_lidar, before.T_camera_lidar)
        assert blind(tracker, "the camera shows nothing") is extrinsic  # said already
        after = blind(tracker, "").result
        assert (after.status, after.reason) == (before.status, before.reason)
        assert after.status == status
        blind(tracker, "the camera shows nothing (contrast 1.0)")
        told = tracker.current
        assert blind(tracker, "the camera shows nothing (contrast 1.2)") is told  # not with every frame
        blind(tracker, "")
    tracker.apply(assessment(Verdict.MOVED))
    told = blind(tracker, "the camera shows nothing").result
    assert told.status == MOVED  # else one would take the transform for the last good one
    assert told.reason.endswith("; the camera shows nothing")
    assert tracker.last_good.status == CONVERGED


def test_distant_estimate_is_rejected_after_poor_scenes():
    """Refused estimates open the search; where it then ends elsewhere, the calibration is in question until others agree."""
    tracker = settled()
    good = tracker.last_good
    for _ in range(UNSETTLING_REJECTIONS):
        tracker.update(estimate(status=REFUSED, reason="stands out 1.7-fold"))
    far = estimate(((2.0, 0, 0), (0.2, 0, 0)))
    for _ in range(RECOVERING):
        assert tracker.update(far).result.status == MOVED
        assert tracker.last_good is good
    assert tracker.update(far).result.status == CONVERGED
    for _ in range(UNSETTLING_REJECTIONS):
        tracker.update(estimate(status=REFUSED, reason="stands out 1.7-fold"))
    assert tracker.update(estimate(((2.01, 0, 0), (0.2, 0, 0)))).result.status == CONVERGED  # near: as before


def test_a_saved_extrinsic_is_initial_until_it_is_tested():
    saved = estimate(((0.2, 0, 0), (0, 0, 0)))
    tracker = tracking(saved)
    assert tracker.current.result.status == INITIAL
    assert tracker.last_good is saved
    assert tracker.apply(assessment(Verdict.CONSISTENT)).result.status == CONVERGED
    tracker = tracking(saved)
    assert tracker.apply(assessment(Verdict.SUSPECT)).result.status == SUSPECT


def test_reset_goes_back_to_the_start():
    saved = estimate(((0.2, 0, 0), (0, 0, 0)))
    tracker = tracking(saved)
    for _ in range(3):
        tracker.update(estimate())
    tracker.apply(assessment(Verdict.MOVED))
    blind(tracker, "dark")
    tracker.reset()
    assert tracker.last_good is saved
    assert tracker.current.result.status == INITIAL
    assert np.array_equal(tracker.current.result.T_camera_lidar, saved.T_camera_lidar)
    assert (
        tracker.current.accepted,
        tracker.current.normalised_innovation,
        tracker.current.monitor_message,
        tracker.settled,
    ) == (0, 0, "", False)
    assert tracker.monitored
    assert np.allclose(tracker.spread, variances() - SYSTEMATIC_COVARIANCE, atol=1e-12)
    other = unknown()
    other.update(estimate())
    other.reset()
    assert other.last_good is None
    assert other.current.result.status == INITIAL


def test_only_converged_estimates_are_kept():
    """Whatever comes, in any order."""
    rng = np.random.default_rng(0)
    tracker = unknown()
    for _ in range(400):
        what = rng.integers(6)
        if what == 0:
            if tracker.monitored:
                tracker.apply(assessment(list(Verdict)[rng.integers(len(Verdict))]))
        elif what == 1:
            blind(tracker, str(rng.choice(["", "dark"])))
        else:
            by = (tuple(rng.normal(0, 0.1, 3)), tuple(rng.normal(0, 0.02, 3)))
            weak = [0.01, 0.01, float(rng.choice([0.01, 0.2]))]
            status = str(rng.choice([CONVERGED, CONVERGED, REFUSED]))
            before, kept = tracker.current, tracker.last_good
            in_doubt = tracker.lost or tracker.suspect
            asked = bool(rng.random() < 0.05)
            after = tracker.update(estimate(by, 0.1, weak, status), rng.random(), rng.random(), asked)
            if tracker.last_good is not kept:
                assert status == CONVERGED
                assert after.accepted == before.accepted + 1
                assert not tracker.lost
                assert not tracker.suspect
                assert asked or not in_doubt or after.accepted > RECOVERING
        good, C = tracker.last_good, tracker.filter.covariance
        assert good is None or good.status == CONVERGED
        assert np.linalg.eigvalsh(C).min() > 0
        assert np.allclose(C, C.T, atol=0)
        statuses = {CONVERGED, REFUSED, INSUFFICIENT, SUSPECT, MOVED, BLINDED, INITIAL}
        assert tracker.current.result.status in statuses
        if tracker.current.result.status == CONVERGED:
            assert not tracker.lost
            assert not tracker.suspect


# --- the belief -----------------------------------------------------------------------------------------------------------


def random_covariance(rng: np.random.Generator, size: float) -> np.ndarray:
    A = rng.normal(0, size, (6, 6)) * ([1.0] * 3 + [5.0] * 3)
    return A.T @ A + SYSTEMATIC_COVARIANCE


def test_fusing_is_adding_information():
    rng = np.random.default_rng(1)
    for _ in range(10):
        prior, own = random_covariance(rng, 1e-3), random_covariance(rng, 1e-3)
        xi = rng.normal(0, 1e-3, 6)
        filter = PoseFilter(T, prior)
        filter.update(se3.exp(xi) @ T, own + SYSTEMATIC_COVARIANCE, 0.5)
        told = [np.linalg.inv(prior), 0.5 * np.linalg.inv(own)]
        expected = np.linalg.inv(told[0] + told[1])
        assert np.allclose(filter.spread, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())
        assert np.allclose(se3.log(filter.T @ se3.inverse(T)), expected @ told[1] @ xi, rtol=1e-5, atol=1e-9)


def test_systematic_error_is_not_averaged_down():
    filter = PoseFilter(T, (variances() - SYSTEMATIC_COVARIANCE) / 9500)  # as after so many estimates
    for _ in range(500):
        filter.update(T, variances(), 1.0)
    assert np.diag(filter.covariance) == pytest.approx(np.diag(SYSTEMATIC_COVARIANCE), rel=1e-3)
    assert np.allclose(without_systematic_error(variances()), variances() - SYSTEMATIC_COVARIANCE, atol=1e-15)
    assert not without_systematic_error(SYSTEMATIC_COVARIANCE / 2).any()  # less than the bias is none
    assert not without_systematic_error(np.zeros((6, 6))).any()


def test_unknown_axis_does_not_mask_a_known_one():
    """1 rad and 10 m on one side, a thousandth of a degree on the other."""
    filter = PoseFilter(T, np.diag([1.0, 1, 1, 100, 100, 100]))
    sure = np.diag(np.array([1e-5, 1e-5, 1, 1e-4, 1e-4, 10]) ** 2) + SYSTEMATIC_COVARIANCE
    xi = np.array([1e-3, -2e-3, 0.3, 0.01, 0.02, 1.0])
    filter.update(se3.exp(xi) @ T, sure, 1e-3)
    found = se3.log(filter.T @ se3.inverse(T))
    assert found[[0, 1, 3, 4]] == pytest.approx(xi[[0, 1, 3, 4]], rel=1e-3, abs=2e-3)
    assert found[2] < 0.01
    assert filter.probability(se3.exp([1e-2, 0, 0, 0, 0, 0]) @ filter.T, sure) < 1e-6


def test_probability_is_that_of_chi_squared():
    """One standard deviation along one axis: 0.9856 of all draws of six are farther away."""
    filter, C = PoseFilter(T, variances() - SYSTEMATIC_COVARIANCE), variances()
    sigma = np.sqrt(np.diag(filter.spread + C))
    assert filter.probability(T, C) == 1
    for k in range(6):
        assert filter.probability(se3.exp(sigma * np.eye(6)[k]) @ T, C) == pytest.approx(0.98561, abs=1e-4)
    rng = np.random.default_rng(0)
    drawn = [filter.probability(se3.exp(sigma * rng.standard_normal(6)) @ T, C) for _ in range(2000)]
    assert np.quantile(drawn, [0.1, 0.5, 0.9]) == pytest.approx([0.1, 0.5, 0.9], abs=0.03)
    # With fixed axes, of those that are left.
    fixed = PoseFilter(T, np.diag([1e-6, 0, 0, 0, 0, 0]))
    assert fixed.probability(se3.exp([2e-3, 1e-9, 0, 0, 0, 0]) @ T, np.zeros((6, 6))) == pytest.approx(0.0455, abs=1e-3)
    assert PoseFilter(T, np.zeros((6, 6))).probability(T, np.zeros((6, 6))) == 1


def test_estimate_over_all_frames_replaces_earlier_ones():
    tracker, other = settled(), settled()
    better = estimate(((0.1, 0, 0), (0, 0, 0)))
    tracker.update(better, 0.2, covers_all=True)
    assert twist(tracker.T)[0][0] == pytest.approx(0.1, abs=2e-3)
    other.update(better, 0.2)  # fused, as one of several
    assert twist(other.T)[0][0] < 0.05
