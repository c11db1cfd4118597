"""Extrinsics that are to be confirmed, suspect, have moved, or whose sensors are blind."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from tracked import (
    FAR,
    REFUSAL,
    STILL,
    T,
    assessment,
    at,
    blind,
    confirming,
    consistent,
    estimate,
    is_at,
    played,
    settled,
    turned,
    unknown,
    variances,
)

from calib_ros.config import Config, TrackerConfig, update
from calib_ros.online.monitor import Verdict
from calib_ros.online.tracker import NOTHING, RECOVERING, UNSETTLING_REJECTIONS, Tracker
from calib_ros.result import BLINDED, CONVERGED, INITIAL, INSUFFICIENT, MOVED, SUSPECT, TENTATIVE, Result


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
    return {"clock_direction": np.array([0, 0, 0, 0, 0, left_m / sigma_s]), "clock_sigma_s": sigma_s}


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
