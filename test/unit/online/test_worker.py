"""The worker thread: newest item first, errors reported, always stoppable. Tests wait for events and do not sleep."""

from __future__ import annotations

import threading

import pytest

from calib_ros.online.worker import Cancelled, Worker

SOON = 10.0  # s; far longer than any of this takes


class Recorder:
    """A worker whose work waits for `go` and writes down what it did."""

    def __init__(self, blocked: bool = False) -> None:
        self.items: list[object] = []
        self.errors: list[Exception] = []
        self.threads: set[str] = set()
        self.started, self.go = threading.Semaphore(0), threading.Event()
        if not blocked:
            self.go.set()
        self.worker: Worker[object] = Worker("recorder", self.work, self.errors.append)

    def work(self, item: object) -> None:
        self.threads.add(threading.current_thread().name)
        self.started.release()
        while not self.go.wait(0.002):
            self.worker.check_cancelled()
        if isinstance(item, BaseException):
            raise item
        self.items.append(item)

    def wait_started(self) -> None:
        assert self.started.acquire(timeout=SOON)


@pytest.fixture
def make():
    made: list[Recorder] = []

    def make(blocked: bool = False) -> Recorder:
        made.append(Recorder(blocked))
        return made[-1]

    yield make
    for recorder in made:
        recorder.go.set()
        assert recorder.worker.stop(SOON)


def test_items_are_worked_on_in_another_thread(make):
    recorder = make()
    for k in range(3):
        recorder.worker.put(k)
        assert recorder.worker.wait_idle(SOON)
    assert recorder.items == [0, 1, 2]
    assert recorder.threads == {"recorder"}
    assert (recorder.worker.done, recorder.worker.dropped) == (3, 0)


def test_the_newest_item_replaces_those_that_wait(make):
    recorder = make(blocked=True)
    recorder.worker.put("first")
    recorder.wait_started()
    for k in range(5):
        recorder.worker.put(k)
    assert recorder.worker.busy
    recorder.go.set()
    assert recorder.worker.wait_idle(SOON)
    assert recorder.items == ["first", 4]
    assert (recorder.worker.done, recorder.worker.dropped) == (2, 4)
    assert not recorder.worker.busy


def test_none_is_a_valid_item(make):
    recorder = make()
    recorder.worker.put(None)
    assert recorder.worker.wait_idle(SOON)
    assert recorder.items == [None]


def test_errors_are_reported_and_the_thread_goes_on(make):
    recorder = make()
    problems = [ValueError("a"), RuntimeError("b"), AssertionError("c")]
    for problem in problems:
        recorder.worker.put(problem)
        assert recorder.worker.wait_idle(SOON)
    recorder.worker.put("after")
    assert recorder.worker.wait_idle(SOON)
    assert recorder.errors == problems
    assert recorder.items == ["after"]
    assert recorder.worker.done == 4


def test_a_reporter_that_fails_does_not_end_the_thread(capfd):
    done = []

    def work(item: int) -> None:
        if item == 0:
            raise ValueError("the frame")
        done.append(item)

    def report(error: Exception) -> None:
        raise RuntimeError("the log is gone")

    worker: Worker[int] = Worker("reporter", work, report)
    for item in (0, 1):
        worker.put(item)
        assert worker.wait_idle(SOON)
    assert done == [1]
    assert worker.stop(SOON)
    assert "the log is gone" in capfd.readouterr().err


def test_stop_ends_work_that_checks_for_cancellation(make):
    recorder = make(blocked=True)
    recorder.worker.put("long")
    recorder.wait_started()
    recorder.worker.put("never")
    assert recorder.worker.stop(SOON)
    assert recorder.items == []
    assert recorder.errors == []  # being stopped is no error
    assert recorder.worker.stopping
    assert not recorder.worker.busy
    assert recorder.worker.wait_idle(0)


def test_stop_reports_work_that_ignores_cancellation():
    go = threading.Event()
    started = threading.Event()

    def work(_: int) -> None:
        started.set()
        go.wait()

    worker: Worker[int] = Worker("deaf", work, print)
    worker.put(1)
    assert started.wait(SOON)
    assert not worker.stop(0.01)
    go.set()
    assert worker.stop(SOON)
    assert worker.done == 1


def test_an_idle_worker_stops_at_once_and_twice(make):
    recorder = make()
    assert recorder.worker.stop(SOON)
    assert recorder.worker.stop(SOON)


def test_after_stop_nothing_is_taken(make):
    recorder = make()
    recorder.worker.stop(SOON)
    recorder.worker.put("late")
    assert not recorder.worker.busy
    assert recorder.worker.wait_idle(0)
    assert recorder.items == []


def test_check_cancelled_raises_only_after_stop(make):
    recorder = make()
    recorder.worker.check_cancelled("stage", 0.5)  # usable as a progress callback
    recorder.worker.stop(SOON)
    with pytest.raises(Cancelled):
        recorder.worker.check_cancelled("stage", 0.6)


def test_waiting_for_idle_has_an_end(make):
    recorder = make(blocked=True)
    assert recorder.worker.wait_idle(0)
    recorder.worker.put(1)
    assert not recorder.worker.wait_idle(0.01)
    recorder.go.set()
    assert recorder.worker.wait_idle(SOON)


def test_busy_time_counts_the_work_under_way(make):
    recorder = make(blocked=True)
    assert recorder.worker.busy_seconds() == 0
    recorder.worker.put(1)
    recorder.wait_started()
    first = recorder.worker.busy_seconds()
    assert recorder.worker.busy_seconds() > first
    recorder.go.set()
    recorder.worker.wait_idle(SOON)
    total = recorder.worker.busy_seconds()
    assert total > first
    assert recorder.worker.busy_seconds() == total


def test_concurrent_puts_lose_nothing(make):
    """Every item handed over is either done or dropped, from however many threads."""
    recorder = make()
    threads = [threading.Thread(target=lambda k=k: [recorder.worker.put((k, i)) for i in range(200)]) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert recorder.worker.wait_idle(SOON)
    assert recorder.worker.done + recorder.worker.dropped == 800
    assert recorder.worker.done == len(recorder.items)
    assert any(item[1] == 199 for item in recorder.items)  # the last one put is worked on
    for k in range(4):
        order = [i for thread, i in recorder.items if thread == k]
        assert order == sorted(order)
