"""When an extrinsic counts as confirmed: by keyframes, by another estimate, by what shows that the clocks agree."""

from __future__ import annotations

import numpy as np
import pytest
from tracked import STILL, T, assessment, confirming, consistent, estimate, turned, unknown, variances

from calib_ros.config import Config, TrackerConfig, update
from calib_ros.online.monitor import Verdict
from calib_ros.online.tracker import NOTHING, RECOVERING, Tracker
from calib_ros.result import CONVERGED, INITIAL, TENTATIVE, Result


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
