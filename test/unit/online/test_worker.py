"""Work on threads: newest item first, errors reported, always stoppable; turns in order; requests shared, cancelled, refused."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Future

import pytest
from waiting import LIMIT_S, until

from calib_ros.errors import CalibrationError
from calib_ros.online.common import Turns
from calib_ros.online.worker import ESTIMATE, MAX_WAITING, Cancelled, Pending, Requests, Worker

SOON = LIMIT_S


class Recorder:
    """A worker whose work waits for `go` and writes down what it did."""

    def __init__(self, blocked: bool = False) -> None:
        self.items: list[object] = []
        self.errors: list[Exception] = []
        self.started, self.go = threading.Semaphore(0), threading.Event()
        if not blocked:
            self.go.set()
        self.worker: Worker[object] = Worker("recorder", self.work, self.errors.append)

    def work(self, item: object) -> None:
        self.started.release()
        while not self.go.wait(0.002):
            self.worker.check_cancelled()
        if isinstance(item, BaseException):
            raise item
        self.items.append(item)

    def put(self, *items: object) -> None:
        """One after the other."""
        for item in items:
            self.worker.put(item)
            assert self.worker.wait_idle(SOON)

    def begin(self, item: object) -> None:
        """Until it is at work."""
        self.worker.put(item)
        assert self.started.acquire(timeout=SOON)


@pytest.fixture
def make() -> Iterator[Callable[..., Recorder]]:
    made: list[Recorder] = []

    def make(blocked: bool = False) -> Recorder:
        made.append(Recorder(blocked))
        return made[-1]

    yield make
    for recorder in made:
        recorder.go.set()
        assert recorder.worker.stop(SOON)


def test_the_newest_item_replaces_those_that_wait(make):
    recorder = make(blocked=True)
    recorder.begin("first")
    assert [recorder.worker.put(k) for k in range(5)] == [[], [0], [1], [2], [3]]
    assert recorder.worker.busy
    assert not recorder.worker.wait_idle(0.01)
    recorder.go.set()
    assert recorder.worker.wait_idle(SOON)
    assert recorder.items == ["first", 4]
    assert not recorder.worker.busy


def test_errors_are_reported_and_the_thread_goes_on(make):
    recorder, problems = make(), [ValueError("a"), RuntimeError("b"), AssertionError("c")]
    recorder.put(*problems, "after")
    assert recorder.errors == problems
    assert recorder.items == ["after"]


def test_a_reporter_that_fails_does_not_end_the_thread(capfd):
    def report(error: Exception) -> None:
        raise RuntimeError("the log is gone")

    done: list[float] = []
    worker: Worker[int] = Worker("reporter", lambda item: done.append(1 / item), report)
    for item in (0, 1):
        worker.put(item)
        assert worker.wait_idle(SOON)
    assert done == [1]
    assert worker.stop(SOON)
    assert "the log is gone" in capfd.readouterr().err


def test_stop_ends_work_that_checks_for_cancellation(make):
    recorder = make(blocked=True)
    recorder.begin("long")
    recorder.worker.put("never")
    assert recorder.worker.stop(SOON)
    assert recorder.items == []
    assert recorder.errors == []  # being stopped is no error
    assert (recorder.worker.stopping, recorder.worker.busy) == (True, False)
    assert recorder.worker.wait_idle(0)


def test_stop_reports_work_that_ignores_cancellation():
    go, started = threading.Event(), threading.Event()
    worker: Worker[int] = Worker("deaf", lambda _: (started.set(), go.wait()), print)
    worker.put(1)
    assert started.wait(SOON)
    assert not worker.stop(0.01)
    go.set()
    assert worker.stop(SOON)


def test_an_idle_worker_stops_at_once_and_takes_nothing_any_more(make):
    recorder = make()
    recorder.worker.check_cancelled("stage", 0.5)  # usable as a progress callback
    assert recorder.worker.stop(SOON)
    assert recorder.worker.stop(SOON)
    recorder.worker.put("late")
    assert not recorder.worker.busy
    assert recorder.worker.wait_idle(0)
    assert recorder.items == []
    with pytest.raises(Cancelled):
        recorder.worker.check_cancelled("stage", 0.6)


def test_an_interpreter_that_ends_waits_for_the_item_under_way_and_says_nothing():
    """Although nobody has stopped the worker, and it hands what it made to another one."""
    script = """
import time
from calib_ros.online.worker import Worker
other = Worker("other", print, print)
worker = Worker("worker", lambda item: [time.sleep(0.3), print("done"), other.put(item)], print)
worker.put("item")
"""
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=SOON)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "done\n", "")


def test_turns_come_in_the_order_of_asking_and_a_wait_can_be_given_up() -> None:
    turns, done = Turns(), []

    def work(name: str) -> None:
        with turns.mine():
            done.append(name)

    def stop() -> None:
        raise Cancelled

    with turns.mine():
        threads = []
        for name in "abc":
            threads.append(threading.Thread(target=work, args=name))
            threads[-1].start()
            until(lambda: len(turns._queue) == len(threads) + 1)
        with pytest.raises(Cancelled), turns.mine(stop):
            pass
    for thread in threads:
        thread.join()
    assert done == ["a", "b", "c"]


# ---- requests ----

OUTCOME = "outcome"


class Queue(Requests):
    """Estimates and checks, which return OUTCOME after what a test does meanwhile."""

    def ask(self, keyframes: int, progress=None) -> Future[str]:
        return self.add(Pending(ESTIMATE), keyframes, progress)

    def check(self, key: object, obstacle: str = "") -> Future[str]:
        return self.add(Pending("check", key), obstacle=obstacle)

    def do(self, keyframes: int | None = None, meanwhile=lambda progress: None, is_due: bool = False) -> bool:
        """An estimate over so many keyframes, None = a check; False if there is none to be done, Cancelled or not."""
        job = self.begin(keyframes is not None, keyframes, is_due)
        if job is not None:
            assert self.run(job, lambda progress: [meanwhile(progress), OUTCOME][1], lambda: None) is OUTCOME
        return job is not None


def test_requests_for_an_estimate_share_the_next_and_those_over_the_same_keyframes_the_one_under_way() -> None:
    queue, asked = Queue(), []
    first, second = queue.ask(2), queue.ask(3)  # nothing runs yet: both are answered by the run that begins next
    assert queue.do(3, lambda _: asked.extend([queue.ask(3), queue.ask(4), queue.close(), queue.ask(3)]))
    joins, *later = (future for future in asked if future)
    assert [future.result(0) for future in (first, second, joins)] == [OUTCOME] * 3
    assert not any(future.done() for future in later)
    assert queue.do(4)
    assert [future.result(0) for future in later] == [OUTCOME] * 2
    assert not queue.do(4)


def test_checks_with_the_same_key_share_one_that_has_not_begun() -> None:
    queue, asked = Queue(), []
    first, again, other = queue.check(1), queue.check(1), queue.check(2)
    queue.add(Pending("count", 1))
    assert queue.do(None, lambda _: asked.append(queue.check(1)))
    assert [first.result(0), again.result(0)] == [OUTCOME] * 2
    assert [other.done(), asked[0].done()] == [False, False]
    assert queue.do()
    assert other.result(0) is OUTCOME
    assert [queue.do(), queue.do()] == [True, True]  # the count, and what was asked for meanwhile
    assert asked[0].result(0) is OUTCOME
    assert not queue.waiting


def test_more_than_a_few_waiting_are_turned_away() -> None:
    queue = Queue()
    waiting = [queue.check(k) for k in range(MAX_WAITING)]
    with pytest.raises(CalibrationError, match="8 checks wait already; ask again"):
        queue.check(80).result(0)
    same, estimate = queue.check(0), queue.ask(1)
    queue.do()
    assert same.result(0) is waiting[0].result(0) is OUTCOME  # the same as one that waits costs nothing
    assert [queue.check(80).done(), estimate.done()] == [False, False]


def test_what_goes_wrong_is_said_to_who_asked_and_the_next_is_done() -> None:
    def fails(progress):
        raise ZeroDivisionError("a defect")

    queue = Queue()
    first, cancelled, second = queue.check(1), queue.check(2), queue.check(3)
    assert cancelled.cancel()
    with pytest.raises(ZeroDivisionError):
        queue.do(None, fails)
    assert isinstance(first.exception(0), ZeroDivisionError)
    assert queue.do()
    assert second.result(0) is OUTCOME
    with pytest.raises(CancelledError):
        cancelled.result(0)
    assert not queue.do()


def test_a_run_ends_when_the_last_request_is_cancelled_and_nobody_joins_it_then() -> None:
    queue = Queue()
    first = queue.ask(1)

    def meanwhile(progress) -> None:
        second = queue.ask(1)
        first.cancel()
        progress("search", 0.1)
        second.cancel()
        try:
            progress("search", 0.2)
        finally:
            queue.ask(1)

    with pytest.raises(Cancelled):
        queue.do(1, meanwhile)
    assert queue.do(1)


def test_a_run_that_nobody_waits_for_goes_on_and_is_not_joined() -> None:
    """It does not search the whole box."""
    queue = Queue()
    queue.ask(1).cancel()
    assert not queue.do(1)
    assert queue.do(1, lambda progress: [progress("search", 0.1), queue.ask(1)], is_due=True)
    assert queue.waiting


@pytest.mark.parametrize("keyframes", [1, None], ids=["an estimate", "a check"])
def test_refused_requests_fail_at_once_and_the_one_under_way_ends(keyframes: int | None) -> None:
    queue, late = Queue(), []

    def ask() -> Future[str]:
        return queue.check(object()) if keyframes is None else queue.ask(keyframes)

    def meanwhile(progress) -> None:
        waiting = queue.check(2)
        queue.refuse("not now")
        late.extend([ask(), waiting, queue.check(1, "an obstacle")])
        assert str(answered.exception(0)) == "not now"
        queue.accept()  # who asks again at once does not keep it alive
        late.append(queue.check(1, "an obstacle"))
        progress("search", 0.5)

    answered = ask()
    with pytest.raises(Cancelled):
        queue.do(keyframes, meanwhile)
    assert [str(future.exception(0)) for future in late] == ["not now"] * 3 + ["an obstacle"]
    assert not queue.waiting
    queue.refuse("not now")
    assert not queue.do(1, is_due=True)
