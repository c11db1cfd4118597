"""Jobs that others ask for, done on the thread of estimates: a queue of futures that knows nothing of what they are about."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Hashable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from calib_ros.errors import CalibrationError
from calib_ros.online.worker import Cancelled
from calib_ros.registration.progress import Callback

T = TypeVar("T")
# Different jobs: one takes seconds, and somebody who asks in a loop must not keep estimates away for long.
MAX_WAITING = 8


@dataclass(frozen=True, eq=False)
class DeferredJob(Generic[T]):
    """What is to be done.

    kind: a noun for people, as "check". key: jobs of a kind with the same key share one that has not begun. work: called on the
    thread of estimates with a callback of progress, to be called now and then, which raises Cancelled where the job is to end.
    """

    kind: str
    key: Hashable
    work: Callable[[Callback], T]

    @property
    def ended(self) -> str:
        """What is said where it is not done any more."""
        return f"the {self.kind} was ended: the node is stopping"


_PendingJob = tuple[DeferredJob[Any], "Future[Any]"]


class Deferred:
    """Jobs that wait, and the one under way. One is done at a time, in the order in which they came. Thread-safe.

    A job is a future; cancel() ends it while it waits, for all who share it.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: deque[_PendingJob] = deque()
        self._running: _PendingJob | None = None
        self._refusal: str | None = None  # "" = the node is stopping

    @property
    def waiting(self) -> bool:
        """True while there is a job that has not begun."""
        with self._lock:
            return bool(self._waiting)

    def add(self, job: DeferredJob[T], obstacle: str = "") -> Future[T]:
        """A new job. It fails at once with a CalibrationError if there is an obstacle, jobs are refused, or too many wait."""
        future: Future[T] = Future()
        asked = job.kind, job.key
        with self._lock:
            shared = next((own for one, own in self._waiting if (one.kind, one.key) == asked and not own.cancelled()), None)
            problem = obstacle if self._refusal is None else self._refusal or job.ended
            if not problem and shared is not None:
                return shared
            if not problem and len(self._waiting) >= MAX_WAITING:
                problem = f"{MAX_WAITING} {job.kind}s wait already; ask again when one of them is answered"
            if not problem:
                self._waiting.append((job, future))
                return future
        future.set_exception(CalibrationError(problem))
        return future

    def run_next(self, check_cancelled: Callable[[], None]) -> Any:
        """Do the job that has waited longest, on this thread, and return what it returns; None if none waits, or it failed.
        Raises nothing: what goes wrong is the future's.

        check_cancelled: raises Cancelled where the thread is to end.
        """
        begun = None
        with self._lock:
            while self._waiting and begun is None:
                asked = self._waiting.popleft()
                begun = self._running = asked if asked[1].set_running_or_notify_cancel() else None
        if begun is None:
            return None
        job, future = begun

        def progress(stage: str, share: float) -> None:
            check_cancelled()
            if self._running is not begun:  # refused meanwhile
                raise Cancelled

        outcome: Any = None
        error: Exception | None = None
        try:
            progress("", 0.0)
            outcome = job.work(progress)
        except Cancelled:
            error = CalibrationError(job.ended)
        except Exception as caught:
            error = caught
        with self._lock:
            mine, self._running = self._running is begun, None
        if mine and error is None:  # else: answered already
            future.set_result(outcome)
        elif mine:
            future.set_exception(error)
        return outcome if mine else None

    def refuse(self, reason: str = "") -> None:
        """Fail all jobs with a CalibrationError, new ones too, and end the one under way. reason: "" = the node is stopping."""
        with self._lock:
            self._refusal = reason
            failed = [own for own in self._waiting if own[1].set_running_or_notify_cancel()]
            failed += [self._running] if self._running is not None else []
            self._running = None
            self._waiting.clear()
        for job, future in failed:
            future.set_exception(CalibrationError(reason or job.ended))

    def accept(self) -> None:
        """Take jobs again."""
        with self._lock:
            self._refusal = None
