"""Checks on request: shared, refused, ended, and made on the thread of estimates without changing anything."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
from driven import Driven, config

from calib_ros import se3
from calib_ros.errors import BadInputError, CalibrationError
from calib_ros.frame import Frame
from calib_ros.online.pacing import Work
from calib_ros.online.worker import Cancelled
from calib_ros_check.node import requests as checks
from calib_ros_check.node.requests import MAX_WAITING, CheckOutcome, CheckRequest, Checks
from calib_ros_check.outcome import Cause, State, Tolerance, Verdict
from calib_ros_synthetic.drive import SyntheticDrive

SOON = 60.0  # s; far longer than any of this takes
OUTCOME = CheckOutcome(None, True, 0.0)  # type: ignore[arg-type]


def go_on() -> None:
    """A thread that is not to end."""


def answered(request, progress) -> CheckOutcome:
    progress("causes", 0.5)
    return OUTCOME


def of(deg: float) -> CheckRequest:
    return CheckRequest(Tolerance(deg))


# ---- requests ------------------------------------------------------------------------------------------------------------


def test_the_same_question_shares_a_check_that_has_not_begun() -> None:
    queue, T = Checks(), np.eye(4)
    first, again, other = queue.add(CheckRequest(T_camera_lidar=T)), queue.add(CheckRequest(T_camera_lidar=T)), queue.add(of(1))
    assert first is again
    assert other is not first
    assert not any(
        a.asks_the_same_as(CheckRequest()) for a in (of(1), CheckRequest(max_keyframes=1), CheckRequest(T_camera_lidar=T))
    )
    assert queue.run_next(answered, go_on) is OUTCOME
    assert (first.result(0), other.done(), queue.waiting) == (OUTCOME, False, True)
    assert queue.add(CheckRequest(T_camera_lidar=T)) is not first
    queue.run_next(answered, go_on)
    assert other.result(0) is OUTCOME


def test_more_than_a_few_waiting_are_turned_away() -> None:
    queue = Checks()
    waiting = [queue.add(of(1 + k)) for k in range(MAX_WAITING)]
    assert isinstance(queue.add(of(80)).exception(0), CalibrationError)
    assert queue.add(of(1)) is waiting[0]  # the same as one that waits costs nothing
    queue.run_next(answered, go_on)
    assert not queue.add(of(80)).done()


def test_what_goes_wrong_is_said_to_who_asked_and_the_next_is_made() -> None:
    def fails(request, progress):
        raise ZeroDivisionError("a defect")

    queue = Checks()
    first, cancelled, second = queue.add(of(1)), queue.add(of(2)), queue.add(of(3))
    assert cancelled.cancel()
    assert queue.run_next(fails, go_on) is None
    assert isinstance(first.exception(0), ZeroDivisionError)
    queue.run_next(answered, go_on)
    assert second.result(0) is OUTCOME
    assert cancelled.cancelled()
    assert queue.run_next(answered, go_on) is None  # nothing waits


def test_refused_checks_fail_at_once_and_the_one_under_way_ends() -> None:
    queue, ended = Checks(), []
    running, waiting = queue.add(of(1)), queue.add(of(2))

    def refused(request, progress):
        queue.refuse("not now")
        assert str(running.exception(0)) == "not now"
        queue.accept()  # who asks again at once does not keep it alive
        try:
            progress("causes", 0.5)
        except Cancelled:
            ended.append(True)
            raise
        return OUTCOME

    assert queue.run_next(refused, go_on) is None
    assert ended == [True]
    assert str(waiting.exception(0)) == "not now"
    assert not queue.waiting
    queue.refuse("not now")
    assert str(queue.add(of(1)).exception(0)) == "not now"


@pytest.mark.parametrize(
    "values", [{"T_camera_lidar": np.zeros((4, 4))}, {"T_camera_lidar": np.full((4, 4), np.nan)}, {"max_keyframes": -1}]
)
def test_what_cannot_be_checked_is_bad_input(values: dict) -> None:
    with pytest.raises(BadInputError):
        CheckRequest(**values)


# ---- in the pipeline -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def driven(drive: SyntheticDrive, street: list[Frame]) -> Iterator[Driven]:
    """Four keyframes, and an extrinsic that was estimated from them."""
    with Driven(drive, config(mode="manual", buffer_size=4)) as driven:
        driven.feed(*street[:4])
        assert driven.pipeline.request_estimate().result(SOON).result.converged
        yield driven


def test_a_check_says_what_is_wrong_and_changes_nothing(driven: Driven, drive: SyntheticDrive) -> None:
    pipeline = driven.pipeline
    recalibrator = pipeline.recalibrator
    before, kept, states = recalibrator.current, list(recalibrator.buffer), len(driven.states)
    of_estimates = pipeline.load.counts().seconds[Work.ESTIMATES]
    own = pipeline.request_check(CheckRequest()).result(SOON)
    assert own.of_current
    assert own.result.verdict is Verdict.PASS, own.result.reason
    assert np.array_equal(own.result.T_checked, before.result.T_camera_lidar)
    assert (own.result.camera_frame, own.result.lidar_frame) == ("camera", "lidar")
    assert (len(own.result.frame_names), own.result.data_stamp) == (4, kept[-1].stamp)
    assert own.result.cpu_s > 0

    wrong = se3.perturb(drive.reference, [0, 2.0, 0], [0, 0, 0])
    given = pipeline.request_check(CheckRequest(Tolerance(1.0, 0.2), wrong, 2)).result(SOON)
    assert not given.of_current
    assert (given.result.verdict, given.result.cause) == (Verdict.FAIL, None)
    axes = {axis.name: axis for axis in given.result.axes}
    assert axes["ry"].low < 2.0 < axes["ry"].high
    assert axes["rx"].verdict is Verdict.PASS
    assert (len(given.result.frame_names), given.result.tolerance) == (2, Tolerance(1.0, 0.2))
    assert checks.NO_FISHEYE in given.result.notes, "what needs pictures is not tried"

    assert (recalibrator.current, list(recalibrator.buffer), len(driven.states)) == (before, kept, states)
    assert driven.errors == []
    assert pipeline.wait_idle(SOON)
    assert [outcome.result for outcome in driven.checked] == [own.result, given.result]
    counts = pipeline.load.counts()
    assert counts.seconds[Work.CHECKS] > 0
    assert counts.seconds[Work.ESTIMATES] == of_estimates


def test_all_causes_are_tried_without_pictures(driven: Driven, drive: SyntheticDrive) -> None:
    result = driven.pipeline.request_check(CheckRequest(T_camera_lidar=se3.inverse(drive.reference))).result(SOON).result
    assert (result.verdict, result.cause) == (Verdict.FAIL, Cause.INVERSE_TRANSFORM), result.reason
    states = {finding.cause: finding.state for finding in result.causes}
    assert states[Cause.MIRRORED_IMAGE] is states[Cause.ROTATED_IMAGE] is State.EXCLUDED
    assert checks.NO_VEHICLE_FRAMES in result.notes  # which nobody has stated
    assert checks.NO_FISHEYE not in result.notes, "the cause is known"


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
    checked = driven.pipeline.request_check(CheckRequest(max_keyframes=1))
    checked.add_done_callback(lambda _: order.append("check"))
    go.set()
    assert checked.result(SOON).result.verdict in Verdict
    assert estimated.done()
    assert driven.pipeline.wait_idle(SOON)
    assert order == ["estimate", "check"]


def test_nothing_to_check_by_is_said_at_once(drive: SyntheticDrive, street: list[Frame]) -> None:
    with Driven(drive, config(mode="manual")) as driven:

        def problem() -> str:
            return str(driven.pipeline.request_check(CheckRequest()).exception(0))

        assert problem() == checks.NO_PAIR
        driven.feed(street[0])
        driven.pipeline.reset()
        assert problem() == checks.NO_KEYFRAME
        driven.feed(street[1])
        driven.pipeline.pause("parked")
        assert problem() == "parked"
        driven.pipeline.resume()
        assert driven.pipeline.request_check(CheckRequest()).exception(SOON) is None


def test_a_check_under_way_ends_with_the_pipeline(
    drive: SyntheticDrive, street: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Driven stops the pipeline and asserts that all threads end."""
    began, ended = threading.Event(), []

    def for_ever(recalibrator, request, progress, frames):
        began.set()
        try:
            while True:
                progress("causes", 0.5)
                time.sleep(0.001)
        except Cancelled:
            ended.append(True)
            raise

    monkeypatch.setattr("calib_ros.online.pipeline.check_keyframes", for_ever)
    with Driven(drive, config(mode="manual")) as driven:
        driven.feed(street[0])
        asked = driven.pipeline.request_check(CheckRequest())
        assert began.wait(SOON)
    assert ended == [True]
    assert str(asked.exception(0)) == checks.ENDED
