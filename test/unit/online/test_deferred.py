"""Deferred jobs: shared, refused, ended."""

from __future__ import annotations

from concurrent.futures import CancelledError

import pytest

from calib_ros.errors import CalibrationError
from calib_ros.online.deferred import MAX_WAITING, Deferred, DeferredJob
from calib_ros.online.worker import Cancelled

OUTCOME = "outcome"


def go_on() -> None:
    """A thread that is not to end."""


def answered(progress) -> str:
    progress("causes", 0.5)
    return OUTCOME


def job(key: object, work=answered) -> DeferredJob[str]:
    return DeferredJob("check", key, work)


def test_jobs_with_the_same_key_share_one_that_has_not_begun() -> None:
    queue = Deferred()
    first, again, other = queue.add(job(1)), queue.add(job(1)), queue.add(job(2))
    assert first is again
    assert other is not first
    assert queue.add(DeferredJob("count", 1, answered)) is not first
    assert queue.run_next(go_on) is OUTCOME
    assert (first.result(0), other.done(), queue.waiting) == (OUTCOME, False, True)
    assert queue.add(job(1)) is not first
    queue.run_next(go_on)
    assert other.result(0) is OUTCOME


def test_more_than_a_few_waiting_are_turned_away() -> None:
    queue = Deferred()
    waiting = [queue.add(job(k)) for k in range(MAX_WAITING)]
    with pytest.raises(CalibrationError, match="8 checks wait already; ask again"):
        queue.add(job(80)).result(0)
    assert queue.add(job(0)) is waiting[0]  # the same as one that waits costs nothing
    queue.run_next(go_on)
    assert not queue.add(job(80)).done()


def test_what_goes_wrong_is_said_to_who_asked_and_the_next_is_done() -> None:
    def fails(progress):
        raise ZeroDivisionError("a defect")

    queue = Deferred()
    first, cancelled, second = queue.add(job(1, fails)), queue.add(job(2)), queue.add(job(3))
    assert cancelled.cancel()
    assert queue.run_next(go_on) is None
    with pytest.raises(ZeroDivisionError):
        first.result(0)
    queue.run_next(go_on)
    assert second.result(0) is OUTCOME
    with pytest.raises(CancelledError):
        cancelled.result(0)
    assert queue.run_next(go_on) is None  # nothing waits


def test_refused_jobs_fail_at_once_and_the_one_under_way_ends() -> None:
    queue, ended = Deferred(), []

    def refused(progress):
        queue.refuse("not now")
        assert str(running.exception(0)) == "not now"
        queue.accept()  # who asks again at once does not keep it alive
        try:
            progress("causes", 0.5)
        except Cancelled:
            ended.append(True)
            raise
        return OUTCOME

    running, waiting = queue.add(job(1, refused)), queue.add(job(2))
    assert queue.run_next(go_on) is None
    assert ended == [True]
    assert str(waiting.exception(0)) == "not now"
    assert not queue.waiting
    queue.refuse("not now")
    assert str(queue.add(job(1), "an obstacle").exception(0)) == "not now"
    queue.accept()
    assert str(queue.add(job(1), "an obstacle").exception(0)) == "an obstacle"


def test_a_thread_that_is_to_end_ends_its_job() -> None:
    def stopping() -> None:
        raise Cancelled

    queue = Deferred()
    asked = queue.add(job(1))
    assert queue.run_next(stopping) is None
    assert str(asked.exception(0)) == job(1).ended
    queue.refuse()
    assert str(queue.add(job(1)).exception(0)) == "the check was ended: the node is stopping"
