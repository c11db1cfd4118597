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
from calib_ros.online.tracker_states import NOTHING, TRANSITIONS, TrackerState
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


def turned(deg: float) -> tuple:
    return ((deg, 0, 0), (0, 0, 0))


def estimate(by: tuple = STILL, deg: object = USUAL_DEG, m: object = USUAL_M, status: str = CONVERGED, **more) -> Result:
    return Result(at(by), status, **{"score": 0.8, "covariance": variances(deg, m), "frames_used": 7, **more})


def twist(a: np.ndarray, b: np.ndarray = T) -> tuple[np.ndarray, np.ndarray]:
    """From b to a, deg and m."""
    xi = se3.log(a @ se3.inverse(b))
    return np.rad2deg(xi[:3]), xi[3:]


def is_at(tracker: Tracker, by: tuple, deg: float, m: float) -> bool:
    off = twist(tracker.T, at(by))
    return np.abs(off[0]).max() < deg and np.abs(off[1]).max() < m


REFUSAL, FAR = estimate(status=REFUSED, reason="no optimum"), estimate(((0, 2, 0), (0, 0, 0)))


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


def played(tracker: Tracker, *steps: Result | Verdict) -> list[str]:
    """The status after each estimate, and after each verdict of the monitor."""
    done = (tracker.update(step) if isinstance(step, Result) else tracker.apply(assessment(step)) for step in steps)
    return [extrinsic.result.status for extrinsic in done]


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
    assert (extrinsic.result.status, extrinsic.usable, tracker.monitored) == (TENTATIVE, False, True)
    return tracker


def consistent(tracker: Tracker, keyframes: int) -> Extrinsic:
    for _ in range(keyframes):
        tracker.apply(assessment(Verdict.CONSISTENT))
    return tracker.current


def test_confirmations_that_are_missing_are_counted_down_and_anew_after_a_movement():
    needed = TrackerConfig().confirmations
    tracker = Tracker(Result(T, INITIAL))
    assert tracker.missing == tracker.confirmations == (needed, 1, 0)
    tracker.update(estimate())
    consistent(tracker, needed - 1)
    assert (tracker.missing, tracker.confirmations) == ((1, 1, 0), (needed, 1, 0))
    tracker.update(estimate())
    assert tracker.missing == (1, 0, 0)
    consistent(tracker, 1)
    assert (tracker.missing, tracker.confirmations) == (NOTHING, NOTHING)
    tracker.apply(assessment(Verdict.MOVED))
    assert tracker.missing == (needed, RECOVERING + 1, 0)
    tracker.update(estimate(turned(2)))
    assert tracker.missing == (needed, RECOVERING, 0)
    saved = Tracker(Result(T, INITIAL), Result(T, CONVERGED, covariance=variances()))
    assert saved.missing == (1, 0, 0)
    consistent(saved, 1)
    assert saved.missing == NOTHING


@pytest.mark.parametrize("by", [STILL, ((0, 0.1, 0), (0.02, 0, 0))])
def test_first_estimate_is_tentative_until_keyframes_and_another_estimate_confirm_it(by):
    tracker = confirming()
    assert "1 more keyframe" in consistent(tracker, 4).result.reason
    assert tracker.update(estimate(by)).result.status == TENTATIVE
    assert tracker.apply(assessment(Verdict.INCONCLUSIVE)).result.status == TENTATIVE  # it shows nothing
    extrinsic = consistent(tracker, 1)
    assert (extrinsic.result.status, extrinsic.usable) == (CONVERGED, True)

    tracker = confirming()
    assert "another estimate" in consistent(tracker, 9).result.reason
    assert tracker.update(estimate(by)).usable


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


@pytest.mark.parametrize(("deg", "status", "usable"), [(0.05, CONVERGED, True), (2.0, TENTATIVE, False)])
def test_saved_extrinsic_counts_as_an_estimate(deg, status, usable):
    extrinsic = Tracker(estimate()).update(estimate(((0, deg, 0), (0, 0, 0))))
    assert (extrinsic.result.status, extrinsic.usable) == (status, usable)


def test_a_confirmed_saved_extrinsic_stays_usable_on_an_empty_road():
    tracker = Tracker(estimate())
    for verdict, usable in ((Verdict.INCONCLUSIVE, False), (Verdict.CONSISTENT, True), (Verdict.INCONCLUSIVE, True)):
        assert tracker.apply(assessment(verdict)).usable is usable


def clocks(left_m: float, sigma_s: float) -> dict[str, object]:
    """What clocks that are known to sigma_s leave open of an estimate: a shift along the view."""
    return {"clock_covariance": np.diag([0, 0, 0, 0, 0, left_m**2]), "clock_sigma_s": sigma_s}


STANDING, ALIKE, SLOWING_DOWN = clocks(0.0, 0.05), clocks(0.2, 0.05), clocks(0.02, 0.005)


def test_estimate_is_tentative_until_one_shows_that_the_clocks_agree():
    tracker = confirming()  # the motion in the first estimate is not known
    for _ in range(3):
        tracker.update(estimate(**ALIKE))
        extrinsic = consistent(tracker, 5)
        assert (extrinsic.result.status, extrinsic.usable) == (TENTATIVE, False)
    assert "clocks" in extrinsic.result.reason
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
        assert consistent(tracker, 5).result.status == TENTATIVE


@pytest.mark.parametrize(("second", "anew"), [(0.0124, False), (0.016, True)])
def test_a_confirmation_begins_again_where_two_offsets_differ_by_more_than_both_are_known_to(second, anew):
    tracker = confirming()
    tracker.update(estimate(time_offset_s=0.01, time_offset_sigma_s=0.0017))
    tracker.config = update(tracker.config, {"motion": {"time_offset_s": 0.01}})
    consistent(tracker, 5)
    tracker.update(estimate(time_offset_s=second, time_offset_sigma_s=0.0012))
    assert (tracker.state is TrackerState.TENTATIVE) is anew


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
    assert played(tracker, Verdict.MOVED, *[estimate(((3.0, 0, 0), (0.3, 0, 0)))] * (RECOVERING + 1))[-1] == TENTATIVE
    assert consistent(tracker, 5).usable


# --- the gate -------------------------------------------------------------------------------------------------------------


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


def test_repeated_frames_do_not_shrink_the_covariance():
    """30 estimates over the same 20 frames, one of which is new each time, tell as much as 30 frames."""
    tracker = settled(Config(tracker=TrackerConfig(process_noise_deg=0.0, process_noise_m=0.0)))
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
    told = tracker.apply(assessment(Verdict.SUSPECT, "2 deg elsewhere", 1e-6))
    assert (told.result.status, told.result.reason, told.monitor_message) == (SUSPECT, *["2 deg elsewhere"] * 2)
    assert (told.p_value, tracker.suspect, tracker.monitored) == (1e-6, True, True)
    assert tracker.last_good is before.result
    during = tracker.update(estimate(turned(0.05)))  # its frames are in question
    assert during.accepted == before.accepted
    assert np.array_equal(tracker.T, before.result.T_camera_lidar)
    told = tracker.apply(assessment(Verdict.CONSISTENT, "fits after all", 0.4))
    assert told.result is before.result
    assert (told.monitor_message, told.p_value, tracker.suspect) == ("fits after all", 0.4, False)
    assert played(tracker, Verdict.INCONCLUSIVE) == [CONVERGED]
    assert tracker.update(estimate(turned(0.05))).accepted == before.accepted + 1


def test_requested_estimate_is_answered_while_suspect():
    tracker = settled()
    tracker.apply(assessment(Verdict.SUSPECT))
    extrinsic = tracker.update(FAR, on_request=True)
    assert (extrinsic.result.status, tracker.suspect) == (CONVERGED, False)
    assert extrinsic.monitor_message == ""  # what the monitor said was of another extrinsic
    assert math.isnan(extrinsic.p_value)


@pytest.mark.parametrize(("verdict", "status"), [(Verdict.SUSPECT, CONVERGED), (Verdict.MOVED, MOVED)])
def test_suspicion_ends_when_the_monitor_stops_and_a_movement_does_not(verdict, status):
    tracker = settled()
    tracker.apply(assessment(verdict))
    assert tracker.stop_monitoring().result.status == status


def test_moved_until_estimates_in_a_row_agree():
    tracker = settled()
    good, was = tracker.last_good, tracker.T
    tracker.update(REFUSAL)
    told = tracker.apply(assessment(Verdict.MOVED, "has moved"))
    assert (told.result.status, told.result.reason) == (MOVED, "has moved")
    assert np.array_equal(tracker.T, was)
    assert (tracker.monitored, tracker.suspect) == (False, False)  # estimates are wanted
    assert played(tracker, REFUSAL) == [MOVED]
    assert REFUSAL.reason in tracker.current.result.reason
    other, agreeing = estimate(((0, -1, 0), (0, 0, 0))), []  # a few keyframes of one place may share a wrong optimum
    for new in [other, other, *[FAR] * RECOVERING]:
        assert played(tracker, new) == [MOVED]
        assert tracker.last_good is good
        assert not tracker.settled
        agreeing.append(RECOVERING - int(re.search(r"(\d) more", tracker.current.result.reason)[1]))
    assert agreeing == [0, 1, 0, *range(1, RECOVERING)]
    assert played(tracker, FAR) == [CONVERGED]
    assert (tracker.settled, tracker.monitored, tracker.current.monitor_message) == (True, True, "")
    assert tracker.last_good is tracker.current.result is not good
    assert is_at(tracker, ((0, 2, 0), (0, 0, 0)), 0.01, 0.001)


def test_the_search_after_a_movement_begins_where_the_camera_was():
    tracker = unknown()
    played(tracker, *[estimate(turned(2))] * 2, Verdict.MOVED, FAR)  # one of its own may be wrong
    assert np.allclose(tracker.search_center, at(turned(2)), atol=1e-4)


def test_moved_and_weak_result_is_not_saved():
    tracker = settled()
    good, weak = tracker.last_good, estimate(((0, 2, 0), (0, 0, 0)), m=[0.006, 0.006, 0.08])
    assert played(tracker, Verdict.MOVED, *[weak] * (RECOVERING + 1))[-1] == INSUFFICIENT
    assert tracker.last_good is good
    assert played(tracker, FAR) == [CONVERGED]
    assert tracker.last_good is tracker.current.result


def test_requested_estimate_ends_a_movement():
    tracker = settled()
    tracker.apply(assessment(Verdict.MOVED))
    assert tracker.update(REFUSAL, on_request=True).result.status == MOVED
    assert tracker.update(FAR, on_request=True).result.status == CONVERGED
    assert tracker.last_good is tracker.current.result


@pytest.mark.parametrize(("verdict", "status"), [(Verdict.CONSISTENT, CONVERGED), (Verdict.SUSPECT, SUSPECT)])
def test_blinded_overrides_the_status_and_ends(verdict, status):
    tracker = settled()
    before = tracker.apply(assessment(verdict)).result
    told = blind(tracker, "dark (contrast 1.0)")
    assert (told.result.status, told.result.reason) == (BLINDED, "dark (contrast 1.0)")
    assert np.array_equal(tracker.T, before.T_camera_lidar)
    assert blind(tracker, "dark (contrast 1.2)") is told  # not with every frame
    after = blind(tracker, "").result
    assert (after.status, after.reason, before.status) == (status, before.reason, status)


def test_a_blind_sensor_does_not_hide_a_movement():
    """Else one would take the transform for the last good one."""
    tracker = settled()
    tracker.apply(assessment(Verdict.MOVED))
    told = blind(tracker, "dark").result
    assert (told.status, told.reason) == (MOVED, "in words; dark")


def test_distant_estimate_is_rejected_after_poor_scenes():
    """Refused estimates open the search; where it then ends elsewhere, the calibration is in question until others agree."""
    tracker, refusals = settled(), [REFUSAL] * UNSETTLING_REJECTIONS
    good = tracker.last_good
    played(tracker, *refusals)
    for _ in range(RECOVERING):
        assert played(tracker, FAR) == [MOVED]
        assert tracker.last_good is good
    assert played(tracker, FAR) == [CONVERGED]
    assert played(tracker, *refusals, estimate(((0, 2.01, 0), (0, 0, 0))))[-1] == CONVERGED  # near: as before


@pytest.mark.parametrize(("verdict", "status"), [(Verdict.CONSISTENT, CONVERGED), (Verdict.SUSPECT, SUSPECT)])
def test_a_saved_extrinsic_is_initial_until_it_is_tested(verdict, status):
    saved = estimate(turned(0.2))
    tracker = tracking(saved)
    assert tracker.current.result.status == INITIAL
    assert tracker.last_good is saved
    assert played(tracker, verdict) == [status]


@pytest.mark.parametrize("start", [estimate(turned(0.2)), Result(T, INITIAL)], ids=["saved", "unknown"])
def test_reset_goes_back_to_the_start(start):
    tracker = tracking(start)
    before, good, spread = tracker.current, tracker.last_good, tracker.spread
    played(tracker, *[estimate()] * 3, Verdict.MOVED)
    blind(tracker, "dark")
    tracker.reset()
    now = tracker.current
    assert tracker.last_good is good
    assert now.result.status == INITIAL
    assert np.array_equal(now.result.T_camera_lidar, start.T_camera_lidar)
    assert (now.accepted, now.normalised_innovation, now.monitor_message, tracker.settled) == (0, 0, "", False)
    assert (now.result.reason, tracker.monitored) == (before.result.reason, start.converged)
    assert np.array_equal(tracker.spread, spread)


# --- the filter -----------------------------------------------------------------------------------------------------------


def test_fusing_is_adding_information():
    rng = np.random.default_rng(1)

    def random_covariance() -> np.ndarray:
        A = rng.normal(0, 1e-3, (6, 6)) * ([1.0] * 3 + [5.0] * 3)
        return A.T @ A + SYSTEMATIC_COVARIANCE

    for _ in range(10):
        prior, own = random_covariance(), random_covariance()
        xi = rng.normal(0, 1e-3, 6)
        filter = PoseFilter(T, prior)
        filter.update(se3.exp(xi) @ T, own + SYSTEMATIC_COVARIANCE, 0.5)
        told = [np.linalg.inv(prior), 0.5 * np.linalg.inv(own)]
        expected = np.linalg.inv(told[0] + told[1])
        assert np.allclose(filter.spread, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())
        assert np.allclose(se3.log(filter.T @ se3.inverse(T)), expected @ told[1] @ xi, rtol=1e-5, atol=1e-9)


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
