"""Checks on request: made on the thread of estimates without changing anything, refused, ended."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from driven import Driven, config
from waiting import LIMIT_S

from calib_ros import se3
from calib_ros.errors import BadInputError
from calib_ros.frame import Frame
from calib_ros.online.pacing import Work
from calib_ros.result import Cause
from calib_ros_check.node import requests as checks
from calib_ros_check.node.requests import CheckRequest, request_check
from calib_ros_check.outcome import CauseState, CheckVerdict, Tolerance
from calib_ros_synthetic.drive import SyntheticDrive

SOON = LIMIT_S


def test_other_questions_are_others_and_what_cannot_be_checked_is_bad_input() -> None:
    for other in (CheckRequest(Tolerance(1)), CheckRequest(max_keyframes=1), CheckRequest(T_camera_lidar=np.eye(4))):
        assert other.key == replace(other).key != CheckRequest().key
    for values in ({"T_camera_lidar": np.zeros((4, 4))}, {"T_camera_lidar": np.full((4, 4), np.nan)}, {"max_keyframes": -1}):
        with pytest.raises(BadInputError):
            CheckRequest(**values)


# ---- in the pipeline -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def driven(drive: SyntheticDrive, street: list[Frame]) -> Iterator[Driven]:
    """Four keyframes, and an extrinsic that was estimated from them."""
    with Driven(drive, config(mode="manual", buffer_size=4)) as driven:
        for frame in street[:4]:
            driven.feed(frame)
        assert driven.pipeline.request_estimate().result(SOON).result.converged
        yield driven


def test_what_cannot_be_tried_without_pictures_is_told_and_nothing_changes(driven: Driven, drive: SyntheticDrive) -> None:
    pipeline, recalibrator = driven.pipeline, driven.pipeline.recalibrator
    before, kept, told = recalibrator.current, list(recalibrator.keyframes.features), len(driven.states)
    of_estimates = pipeline.load.counts().seconds[Work.ESTIMATES]
    inverse = CheckRequest(T_camera_lidar=se3.inverse(drive.reference), max_keyframes=2)
    result = request_check(driven.pipeline, inverse).result(SOON).result
    assert (result.verdict, result.cause) == (CheckVerdict.FAIL, Cause.INVERSE_TRANSFORM), result.reason
    states = {finding.cause: finding.state for finding in result.causes}
    assert states[Cause.MIRRORED_IMAGE] is states[Cause.ROTATED_IMAGE] is CauseState.EXCLUDED
    assert checks.NO_VEHICLE_FRAMES in result.notes  # which nobody has stated
    assert checks.NO_FISHEYE not in result.notes, "the cause is known"
    T = se3.perturb(drive.reference, [0, 2.0, 0], [0, 0, 0])
    result = request_check(driven.pipeline, CheckRequest(T_camera_lidar=T, max_keyframes=2)).result(SOON).result
    assert (result.verdict, result.cause) == (CheckVerdict.FAIL, None), result.reason
    assert checks.NO_FISHEYE in result.notes
    assert (recalibrator.current, list(recalibrator.keyframes.features), len(driven.states)) == (before, kept, told)
    assert driven.errors == []
    assert pipeline.wait_idle(SOON)
    counts = pipeline.load.counts().seconds
    assert (counts[Work.CHECKS] > 0, counts[Work.ESTIMATES]) == (True, of_estimates)


def test_a_check_waits_for_the_estimate_under_way(driven: Driven, monkeypatch: pytest.MonkeyPatch) -> None:
    recalibrator, go, order = driven.pipeline.recalibrator, threading.Event(), []
    estimate = recalibrator.estimate

    def held(*args, **kwargs):
        assert go.wait(SOON)
        extrinsic = estimate(*args, **kwargs)
        order.append("estimate")
        return extrinsic

    monkeypatch.setattr(recalibrator, "estimate", held)
    estimated = driven.pipeline.request_estimate()
    checked = request_check(driven.pipeline, CheckRequest(max_keyframes=1))
    checked.add_done_callback(lambda _: order.append("check"))
    go.set()
    assert (checked.result(SOON).of_current, checked.result(SOON).result.verdict in CheckVerdict) == (True, True)
    assert estimated.done()
    assert driven.pipeline.wait_idle(SOON)
    assert order == ["estimate", "check"]


def test_nothing_to_check_by_is_said_at_once(drive: SyntheticDrive, street: list[Frame]) -> None:
    with Driven(drive, config(mode="manual")) as driven:
        assert str(request_check(driven.pipeline, CheckRequest()).exception(0)) == checks.NO_PAIR
        driven.feed(street[0])
        driven.pipeline.reset()
        assert str(request_check(driven.pipeline, CheckRequest()).exception(0)) == checks.NO_KEYFRAME
        driven.feed(street[1])
        driven.pipeline.pause("parked")
        assert str(request_check(driven.pipeline, CheckRequest()).exception(0)) == "parked"
        driven.pipeline.resume()
        assert request_check(driven.pipeline, CheckRequest()).exception(SOON) is None
