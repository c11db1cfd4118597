"""Extrinsics that are suspect, have moved, or whose sensors are blind."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from tracked import FAR, REFUSAL, assessment, at, blind, estimate, is_at, played, settled, turned, unknown

from calib_ros.online.monitor import Verdict
from calib_ros.online.tracker import RECOVERING, UNSETTLING_REJECTIONS
from calib_ros.result import BLINDED, CONVERGED, INSUFFICIENT, MOVED, SUSPECT


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
