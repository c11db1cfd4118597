"""Workers that are processes of this machine."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
from collections import deque
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from functools import partial
from multiprocessing import connection, resource_tracker
from typing import Any

import cv2

from calib_ros.errors import BadInputError, CalibrationError
from calib_ros_check.jobs.journal import Answer
from calib_ros_check.jobs.pool import GOES_ON, Ended, J, Lost, Results, RunJobs, all_answers, one_thread

ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class LocalPool:
    """`workers` processes of this machine by concurrent.futures; one means this process itself, unless it is told what to do
    when it ends.

    When a worker dies (out of memory, a crash in a library), another takes its place, and its group runs again at the end, alone
    on the machine; one whose worker dies again is lost. All workers end when the generator is closed, on Ctrl-C, and when this
    process is killed.
    """

    def __init__(self, workers: int):
        if workers < 1:
            raise BadInputError(f"workers must be at least 1, got {workers}")
        self.workers = workers

    def results(self, run_jobs: RunJobs[J], groups: Sequence[Sequence[J]], lost: Lost[J] | None = None) -> Results[J]:
        """See Pool."""
        if self.workers > 1 or lost is not None:
            yield from all_answers(partial(self._spread, run_jobs), groups, lost)
            return
        with one_thread():
            for group in groups:
                yield group, run_jobs(group)

    def _spread(self, run_jobs: RunJobs[J], groups: Sequence[Sequence[J]], ended: Ended[J]) -> Results[J]:
        """Answers of all groups but those whose workers die, which are added to `ended`."""
        waiting = deque(groups)
        running: dict[Future[Any], tuple[_Worker, Sequence[J] | None]] = {}  # None: it starts
        with ExitStack() as workers:

            def start() -> None:
                worker = workers.enter_context(_Worker())
                running[worker.started] = worker, None

            for _ in groups[: self.workers]:
                start()
            while running:
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    worker, group = running.pop(future)
                    if isinstance(future.exception(), BrokenProcessPool):
                        if group is None:
                            raise CalibrationError(f"at its start, a {worker.how_ended()}; out of memory? {GOES_ON}")
                        ended.append((group, worker.how_ended()))
                        if waiting:
                            start()
                        continue
                    answers = future.result()
                    if waiting:
                        following = waiting.popleft()
                        running[worker.submit(_run_portably, run_jobs, following)] = worker, following
                    if group is not None:
                        yield group, answers


class _Worker:
    """A process, which ends at once with the context, whatever it is doing. started: done when it waits for work."""

    def __init__(self) -> None:
        self._executor = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _prepare_process)
        self.submit = self._executor.submit
        before = {name: os.environ.get(name) for name in ONE_THREAD}
        resource_tracker.ensure_running()  # or the first start does it, and lets Ctrl-C through
        # It starts here: with one thread, and with Ctrl-C blocked until it ignores it.
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        os.environ.update(ONE_THREAD)
        try:
            self.started: Future[Any] = self.submit(int)
            # No list of the children that live: one that has ended at its start would be missing.
            (self._process,) = dict(self._executor._processes).values()
        finally:
            for name, value in before.items():
                os.environ.pop(name) if value is None else os.environ.update({name: value})
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)

    def how_ended(self) -> str:
        """For people, once it has died."""
        self._executor.shutdown()
        code = self._process.exitcode or 0
        return f"worker was killed by {signal.Signals(-code).name}" if code < 0 else f"worker ended with exit status {code}"

    def __enter__(self) -> _Worker:
        return self

    def __exit__(self, *error: object) -> None:
        self._process.kill()  # it holds nothing that would be lost
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
