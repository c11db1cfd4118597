"""The worker thread: newest item first, errors reported, always stoppable. Tests wait for events and do not sleep."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable, Iterator

import pytest
from waiting import LIMIT_S

from calib_ros.online.worker import Cancelled, Worker

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
