"""Workers that are processes of this machine."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import connection, resource_tracker
from typing import Any

import cv2

from calib_ros.errors import BadInputError, CalibrationError
from calib_ros_check.jobs.journal import Answer
from calib_ros_check.jobs.pool import GOES_ON, J, Lost, Results, RunJobs, names, one_thread

ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
OUT_OF_MEMORY = f"out of memory? use fewer --workers; {GOES_ON}"


class LocalPool:
    """`workers` processes of this machine by concurrent.futures; one means this process itself, unless it is told what to do
    when it ends.

    When a worker dies (out of memory, a crash in a library), a new pool takes the groups that had not begun. Those in progress
    run again at the end, each alone on the machine, since the pool cannot say which of them it was; the one whose worker dies
    again is lost. All workers end when the generator is closed, on Ctrl-C, and when this process is killed.
    """

    def __init__(self, workers: int):
        if workers < 1:
            raise BadInputError(f"workers must be at least 1, got {workers}")
        self.workers = workers

    def results(self, run_jobs: RunJobs[J], groups: Sequence[Sequence[J]], lost: Lost[J] | None = None) -> Results[J]:
        """See Pool."""
        if self.workers == 1 and lost is None:
            with one_thread():
                for group in groups:
                    yield group, run_jobs(group)
            return
        waiting, again, twice = deque(groups), list[Sequence[J]](), list[tuple[Sequence[J], str]]()
        while waiting:
            in_progress, _ = yield from _until_crash(run_jobs, waiting, self.workers)
            again += in_progress
        for group in again:
            in_progress, how = yield from _until_crash(run_jobs, deque([group]), 1)
            twice += [(one, how) for one in in_progress]
        for group, how in twice:
            if lost is None:
                raise CalibrationError(f"the worker of these jobs ended twice, {how}: {names(group)}; {OUT_OF_MEMORY}")
            yield group, lost(group, f"its worker ended twice, {how}")


def _until_crash(
    run_jobs: RunJobs[J], waiting: deque[Sequence[J]], workers: int
) -> Generator[tuple[Sequence[J], list[Answer]], None, tuple[list[Sequence[J]], str]]:
    """Takes groups from `waiting` and yields their answers, until none is left or a worker dies.

    Returns the groups that were in progress then, and how the worker ended.
    """
    running: dict[Future[list[Answer]], Sequence[J]] = {}
    lost: list[Sequence[J]] = []
    with _Processes(min(workers, len(waiting))) as processes:
        try:
            processes.submit(int).result()
        except BrokenProcessPool:
            raise CalibrationError(f"a worker process ended at its start, {processes.how_ended()}; {OUT_OF_MEMORY}") from None
        while running or (waiting and not lost):
            while waiting and len(running) < workers and not lost:
                group = waiting.popleft()
                try:
                    running[processes.submit(_run_portably, run_jobs, group)] = group
                except BrokenProcessPool:
                    lost.append(group)
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                group = running.pop(future)
                try:
                    answers = future.result()
                except BrokenProcessPool:
                    lost.append(group)
                else:
                    yield group, answers
        return lost, processes.how_ended() if lost else ""


class _Processes:
    """A ProcessPoolExecutor whose processes end at once with the context, whatever they are doing."""

    def __init__(self, workers: int):
        self._executor = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _prepare_process)
        self._processes: list[multiprocessing.process.BaseProcess] = []

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Processes start here, when they are needed: with one thread each, and with Ctrl-C blocked until they ignore it."""
        before = multiprocessing.active_children()
        resource_tracker.ensure_running()  # or the first start does it, and lets Ctrl-C through
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        try:
            with _environment(ONE_THREAD):
                return self._executor.submit(function, *arguments)
        finally:
            self._processes += [process for process in multiprocessing.active_children() if process not in before]
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)

    def how_ended(self) -> str:
        """For people, once a worker has died: the executor terminates all others."""
        self._executor.shutdown()
        codes = [process.exitcode or 0 for process in self._processes]
        code = min(codes, key=lambda code: (code == 0, code == -signal.SIGTERM))
        return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit status {code}"

    def __enter__(self) -> _Processes:
        return self

    def __exit__(self, *error: object) -> None:
        for process in self._processes:
            process.kill()  # it holds nothing that would be lost
        self._executor.shutdown(cancel_futures=True)


def _prepare_process() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    cv2.setNumThreads(1)


def _end_with_parent() -> None:
    """A killed parent cannot end its workers, and one in the middle of a group would not notice for long."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)


def _run_portably(run_jobs: RunJobs[J], group: Sequence[J]) -> list[Answer]:
    """An error that does not survive the way to another process would count as the death of a worker: its text is raised."""
    try:
        return run_jobs(group)
    except Exception as error:
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:
            raise RuntimeError(f"{type(error).__name__}: {error}").with_traceback(error.__traceback__) from None
        raise


@contextmanager
def _environment(changes: dict[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
