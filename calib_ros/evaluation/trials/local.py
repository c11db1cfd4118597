"""Workers on this machine: processes of their own, one group of jobs at a time each."""

from __future__ import annotations

import contextlib
import importlib
import multiprocessing
import os
import pickle
import signal
import threading
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing import connection, resource_tracker

import cv2

from calib_ros.errors import BadInputError, CalibrationError
from calib_ros.evaluation.trials.job import Answer, Job
from calib_ros.evaluation.trials.runner import Perform, Results

Group = Sequence[Job]
Reply = tuple[list[Answer], tuple[Exception, str] | None]  # answers, or what was raised and its traceback
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
EXIT_S = 5.0  # a process that has closed its pipe is gone after
ADVICE = "out of memory? use fewer --workers; the same command goes on where it stopped"


class LocalPool:
    """`workers` processes; one means this process itself. start: called first in each of them; must be picklable.

    A group that a worker dies of (out of memory, a crash in a library) is done once more after all others, alone on the machine;
    CalibrationError that names its jobs if its worker dies again. All workers end at once when the generator is closed, on Ctrl-C
    and when this process is killed. A pipe for each worker, because concurrent.futures gives up every group in flight when one
    worker dies, does not know which of them it was, and leaves its workers behind when this process is killed.
    """

    def __init__(self, workers: int, start: Callable[[], None] | None = None):
        if workers < 1:
            raise BadInputError(f"workers must be at least 1, got {workers}")
        self.workers, self.start = workers, start

    def results(self, perform: Perform, groups: Sequence[Group]) -> Results:
        """As Pool has it."""
        if self.workers == 1:
            yield from self._here(perform, groups)
            return
        lost: list[tuple[Group, str]] = []
        yield from self._spread(perform, groups, lost)
        for group, _ in lost:
            again: list[tuple[Group, str]] = []
            yield from self._spread(perform, [group], again)
            for _, how in again:
                raise CalibrationError(f"the worker of these jobs ended twice, {how}: {names(group)}; {ADVICE}")

    def _here(self, perform: Perform, groups: Sequence[Group]) -> Results:
        with one_thread():
            if self.start:
                self.start()
            for group in groups:
                yield group, perform(group)

    def _spread(self, perform: Perform, groups: Sequence[Group], lost: list[tuple[Group, str]]) -> Results:
        """Groups with their answers; those whose worker died go to `lost`, with how it ended."""
        waiting = deque(groups)
        workers: dict[connection.Connection, _Worker] = {}
        try:
            for _ in range(min(self.workers, len(groups))):
                self._hire(perform, workers)
            while workers:
                for pipe in connection.wait(list(workers)):
                    assert isinstance(pipe, connection.Connection)
                    worker, group = workers[pipe], workers[pipe].group
                    reply = worker.reply()
                    if reply is None:
                        how = workers.pop(pipe).stop(EXIT_S)
                        if group is None:
                            raise CalibrationError(f"a worker process ended at its start, {how}; {ADVICE}")
                        lost.append((group, how))
                        if len(workers) < len(waiting):
                            self._hire(perform, workers)
                        continue
                    answers, failure = reply
                    if failure:
                        raise failure[0] from RuntimeError(f"in a worker:\n{failure[1]}")
                    if waiting:
                        worker.give(waiting.popleft())
                    else:
                        workers.pop(pipe).stop()
                    if group is not None:
                        yield group, answers
        finally:
            for worker in workers.values():
                worker.stop()

    def _hire(self, perform: Perform, workers: dict[connection.Connection, _Worker]) -> None:
        """Ctrl-C is for this process only: the new one inherits that it is blocked, until it ignores it itself."""
        context = multiprocessing.get_context("spawn")
        ours, its = context.Pipe()
        process = context.Process(target=_work, args=(its, perform, self.start), daemon=True)
        resource_tracker.ensure_running()  # or the first start does it, and lets Ctrl-C through
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        try:
            with _environment(ONE_THREAD):
                process.start()
            workers[ours] = _Worker(process, ours)
        finally:
            its.close()
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


@dataclass(eq=False)
class _Worker:
    """A worker as its owner sees it. group: what it is doing, None until it is ready."""

    process: multiprocessing.process.BaseProcess
    pipe: connection.Connection
    group: Group | None = None

    def give(self, group: Group) -> None:
        self.group = group
        with contextlib.suppress(OSError):  # dead already: the reply says so
            self.pipe.send(group)

    def reply(self) -> Reply | None:
        """None if it died."""
        try:
            answer: Reply = self.pipe.recv()
        except (EOFError, OSError):
            return None
        return answer

    def stop(self, grace_s: float = 0.0) -> str:
        """Ends it, it holds nothing that would be lost. grace_s: to end by itself. How it ended, for people."""
        self.process.join(grace_s)
        self.process.kill()
        self.process.join()
        self.pipe.close()
        code = self.process.exitcode or 0
        return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit status {code}"


def _work(pipe: connection.Connection, perform: Perform, start: Callable[[], None] | None) -> None:
    """All that a worker process does: a reply when it is ready, and one for every group."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    cv2.setNumThreads(1)
    _reply(pipe, start or (lambda: None))
    while True:
        try:
            group = pipe.recv()
        except EOFError:
            return
        _reply(pipe, partial(perform, group))


def _reply(pipe: connection.Connection, act: Callable[[], list[Answer] | None]) -> None:
    try:
        pipe.send((act() or [], None))
    except Exception as error:
        pipe.send(([], (_portable(error), traceback.format_exc())))


def _portable(error: Exception) -> Exception:
    """The error itself if it survives the way to another process, else one with its text."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


def _end_with_parent() -> None:
    """Killed, the parent can end nobody; a worker in the middle of a group would not notice for long."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)


@contextmanager
def one_thread() -> Iterator[None]:
    """OpenCV with one thread, BLAS too where threadpoolctl is installed (scikit-learn brings it): CPU time is then that of the
    algorithm, and sums come out the same however many workers there are."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        limits = importlib.import_module("threadpoolctl").threadpool_limits(1)
    except ImportError:
        limits = contextlib.nullcontext()
    try:
        with limits:
            yield
    finally:
        cv2.setNumThreads(before)


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


def names(group: Group, most: int = 3) -> str:
    """Keys of the first jobs of a group, for people."""
    more = f" and {len(group) - most} more" if len(group) > most else ""
    return ", ".join(job.key for job in group[:most]) + more
