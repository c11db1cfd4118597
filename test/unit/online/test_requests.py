"""Requests for an estimate: shared, cancelled, refused. The pipeline under them runs real estimates."""

from __future__ import annotations

import threading
from concurrent.futures import CancelledError, Future

import pytest
from driven import Driven, config
from waiting import LIMIT_S, until

from calib_ros.config import update
from calib_ros.errors import CalibrationError
from calib_ros.frame import Frame
from calib_ros.online.requests import Requests
from calib_ros.online.worker import Cancelled
from calib_ros.result import INITIAL, Extrinsic, Result
from calib_ros_synthetic.drive import SyntheticDrive

SOON = LIMIT_S
LONG_SEARCH = {"search": {"rotation_deg": 3.0, "translation_m": 0.3, "starts": 1 << 20}}


@pytest.fixture
def extrinsic(drive: SyntheticDrive) -> Extrinsic:
    return Extrinsic(Result(drive.reference, INITIAL))


def test_requests_over_the_same_keyframes_share_a_run(extrinsic: Extrinsic) -> None:
    requests = Requests()
    first, first_needs = requests.add(3)
    second, second_needs = requests.add(3)  # nothing runs yet: both are answered by the run that begins next
    assert requests.begin(3)
    third, third_needs = requests.add(3)
    later, later_needs = requests.add(4)
    assert (first_needs, second_needs, third_needs, later_needs) == (True, True, False, True)
    requests.answer(extrinsic)
    assert first.result(0) is second.result(0) is third.result(0) is extrinsic
    assert not later.done()
    assert requests.begin(4)
    requests.fail(CalibrationError("no"))
    with pytest.raises(CalibrationError, match="no"):
        later.result(0)
    assert not requests.begin(4)


def test_progress_goes_to_those_who_still_wait(extrinsic: Extrinsic) -> None:
    requests = Requests()
    heard: dict[str, list[tuple[str, float]]] = {"first": [], "second": []}
    first, _ = requests.add(1, lambda *said: heard["first"].append(said))
    requests.begin(1)
    requests.report("search", 0.25)
    requests.add(1, lambda *said: heard["second"].append(said))
    requests.report("search", 0.5)
    assert first.cancel()
    requests.report("search", 0.75)
    assert heard == {"first": [("search", 0.25), ("search", 0.5)], "second": [("search", 0.5), ("search", 0.75)]}
    requests.answer(extrinsic)
    with pytest.raises(CancelledError):
        first.result(0)


def test_a_run_ends_when_the_last_request_is_cancelled_and_nobody_joins_it_then() -> None:
    requests = Requests()
    first, _ = requests.add(1)
    requests.begin(1)
    second, _ = requests.add(1)
    first.cancel()
    requests.report("search", 0.1)
    second.cancel()
    with pytest.raises(Cancelled):
        requests.report("search", 0.2)
    assert requests.add(1)[1]


def test_a_run_that_nobody_waits_for_goes_on() -> None:
    requests = Requests()
    requests.add(1)[0].cancel()  # before its run: it is not answered
    assert not requests.begin(1)
    requests.report("search", 0.1)
    assert requests.add(1)[1]  # it does not search the whole box


def test_refused_requests_fail_at_once_with_the_reason() -> None:
    requests = Requests()
    answered, _ = requests.add(1)
    requests.begin(1)
    waiting, _ = requests.add(2)
    requests.refuse("not now")
    late, needs_run = requests.add(1)
    assert not needs_run
    assert [str(future.exception(0)) for future in (answered, waiting, late)] == ["not now"] * 3
    with pytest.raises(Cancelled):
        requests.report("search", 0.1)
    requests.accept()
    assert requests.add(1)[1]


def searching(driven: Driven) -> Future[Extrinsic]:
    """A request whose search has begun, and does not end before the request does."""
    driven.pipeline.configure(update(driven.settings, LONG_SEARCH))
    began, asked, requests = threading.Event(), threading.Event(), list[Future[Extrinsic]]()

    def hold(*_: object) -> None:
        began.set()
        assert asked.wait(SOON)
        until(requests[0].done, "the end of the request")

    requests.append(driven.pipeline.request_estimate(hold))
    asked.set()
    assert began.wait(SOON)
    return requests[0]


def test_a_cancelled_estimate_leaves_the_pipeline_as_it_was(street: list[Frame], drive: SyntheticDrive) -> None:
    """Its keyframes are still to be estimated from: the next frame begins an automatic estimate over them."""
    with Driven(drive, config(mode="manual")) as driven:
        driven.feed(*street[:3])
        assert driven.pipeline.request_estimate().result(SOON).result.converged
        driven.feed(street[3])
        recalibrator = driven.pipeline.recalibrator
        before, new = recalibrator.current, recalibrator.keyframes.new
        assert new == 1
        assert searching(driven).cancel()
        assert driven.pipeline.wait_idle(SOON)
        assert (recalibrator.current, recalibrator.keyframes.new, driven.errors) == (before, new, [])
        driven.pipeline.configure(config(mode="manual"))
        assert driven.pipeline.request_estimate().result(SOON).accepted == before.accepted + 1


def test_a_paused_pipeline_keeps_keyframes_and_extrinsic(street: list[Frame], drive: SyntheticDrive) -> None:
    with Driven(drive, config()) as driven:
        driven.feed(*street[:3])
        recalibrator, estimates = driven.pipeline.recalibrator, driven.estimates
        kept = recalibrator.current
        request = searching(driven)
        driven.pipeline.pause("parked")
        assert str(request.exception(SOON)) == "parked"
        assert driven.pipeline.wait_idle(SOON)
        driven.feed(street[3])
        assert (recalibrator.current, recalibrator.keyframes_seen) == (kept, 3)
        driven.pipeline.configure(config())
        driven.pipeline.resume()
        assert driven.pipeline.data_age_s == float("inf")
        driven.feed(street[4])
        assert driven.pipeline.recalibrator is recalibrator
        assert recalibrator.keyframes_seen == 4
        assert driven.estimates == estimates + 1
