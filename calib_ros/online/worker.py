"""A thread with a queue of one item: slow work never holds up whoever hands items over, and never lags behind; and what
others ask such a thread for: who shares an estimate or another job, hears of its progress, and may end it."""

from __future__ import annotations

import os
import threading
import time
import traceback
from collections.abc import Callable, Hashable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Generic, TypeVar

from calib_ros.errors import CalibrationError
from calib_ros.registration.progress import Callback

Item = TypeVar("Item")
T = TypeVar("T")
ESTIMATE = "estimate"  # the kind of job whose work is the recalibrator's
# Of a kind: a job takes seconds, and somebody who asks in a loop must not keep estimates away for long.
MAX_WAITING = 8


class Cancelled(Exception):
    """Raised inside long work when its worker is asked to stop."""


class Worker(Generic[Item]):
    """Runs `work(item)` on a thread with a queue of one item: a newer item replaces the one that waits.

    on_error: called on the worker thread with whatever `work` raises; the thread goes on. nice: by how much it yields to others
    where all cores are busy, 0 to 19. on_idle: called on the worker thread whenever it has nothing left to do. busy: an item is
    worked on or waits. stopping: stop() was called.
    """

    def __init__(
        self,
        name: str,
        work: Callable[[Item], None],
        on_error: Callable[[Exception], None],
        nice: int = 0,
        on_idle: Callable[[], None] = lambda: None,
    ) -> None:
        self._work, self._on_error, self._on_idle = work, on_error, on_idle
        self._lock = threading.Lock()
        self._waiting: list[Item] = []
        self.busy = self.stopping = False
        self.busy_s, self._busy_since = 0.0, 0.0
        self._thread = ThreadPoolExecutor(1, name, _yield_to_others, (nice,))
        self._under_way: Future[None] = Future()
        self._under_way.set_result(None)

    def put(self, item: Item) -> list[Item]:
        """Put an item into the queue; never blocks. Returns those that it replaces. After stop() it is ignored."""
        with self._lock:
            if self.stopping:
                return []
            if self.busy:
                replaced, self._waiting = self._waiting, [item]
                return replaced
            # One that an idle thread has been woken for is as good as begun: on a busy machine it may take a while to run.
            self.busy, self._busy_since = True, time.monotonic()
            try:
                self._under_way = self._thread.submit(self._work_off, item)
            except RuntimeError:  # the interpreter ends
                self.busy = False
            return []

    def check_cancelled(self, *_: object) -> None:
        """Raise Cancelled after stop(); to be called now and then from within long work."""
        if self.stopping:
            raise Cancelled

    def busy_seconds(self) -> float:
        """Time spent working so far, the item under way included."""
        with self._lock:
            return self.busy_s + (time.monotonic() - self._busy_since if self.busy else 0.0)

    def wait_idle(self, timeout: float | None = None) -> bool:
        """Wait until nothing is worked on or waits; False when the time is up first."""
        return bool(wait([self._under_way], timeout).done)

    def stop(self, timeout: float = 1.5) -> bool:
        """End the thread, and wait for it; True if it ended in time."""
        with self._lock:
            self.stopping, self._waiting = True, []
        ended = self.wait_idle(timeout)
        self._thread.shutdown(wait=ended)
        return ended

    def _work_off(self, item: Item) -> None:
        """An item, and those that have come meanwhile."""
        while self.busy:
            if not self.stopping:
                self._guarded(partial(self._work, item))
            with self._lock:
                now = time.monotonic()
                self.busy_s, self._busy_since = self.busy_s + now - self._busy_since, now
                self.busy = bool(self._waiting)
                item = self._waiting.pop() if self.busy else item
        self._guarded(self._on_idle)

    def _guarded(self, work: Callable[[], None]) -> None:
        """The thread must outlive any bad frame, and a reporter that fails, as a log does at shutdown."""
        try:
            work()
        except Cancelled:
            pass
        except Exception as error:
            try:
                self._on_error(error)
            except Exception:
                traceback.print_exc()


def _yield_to_others(nice: int) -> None:
    if nice and hasattr(os, "setpriority"):
        with suppress(OSError):  # some sandboxes do not allow even that
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), nice)


@dataclass(eq=False)
class Pending:
    """Something to be done once for all who ask for it.

    kind: a noun for people, as "check". key: while it waits, all who ask for the same kind and key share it. work: called with a
    callback of progress, to be called now and then, which raises Cancelled where the job is to end. open_to: once it has begun,
    those join it who ask with the same; None = nobody.
    """

    kind: str
    key: Hashable = None
    work: Callable[[Callback], Any] | None = None
    open_to: Hashable = None
    asked: list[tuple[Future[Any], Callback | None]] = field(default_factory=list)

    @property
    def ended(self) -> str:
        """What is said where it is not done any more."""
        return f"the {self.kind} was ended: the node is stopping"

    def is_wanted(self) -> bool:
        """True while somebody waits for it."""
        self.asked = [(future, progress) for future, progress in self.asked if not future.cancelled()]
        return bool(self.asked)

    def answer(self, outcome: Any = None, error: BaseException | None = None) -> None:
        """To all who wait for it."""
        for future, _ in self.asked:
            if not future.set_running_or_notify_cancel():  # from here on it cannot be cancelled
                continue
            if error is None:
                future.set_result(outcome)
            else:
                future.set_exception(error)


class Requests:
    """Jobs that wait, and the one under way. One is done at a time, those of a kind in the order in which they came. Thread-safe.

    A request is a future, whose cancel() ends it at once; a job that was asked for ends when nobody waits for it any more.
    waiting: the jobs that have not begun.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.waiting: list[Pending] = []
        self._running: Pending | None = None
        self._refusal: str | None = None  # "" = the node is stopping

    @property
    def refused(self) -> bool:
        """True between refuse() and accept()."""
        return self._refusal is not None

    def add(self, job: Pending, joins: Hashable = None, progress: Callback | None = None, obstacle: str = "") -> Future[Any]:
        """A new request; it fails at once with a CalibrationError for an obstacle, if requests are refused, or too many wait.

        joins: see Pending.open_to. progress: called on the thread of the job with its stage and share done, from when the request
        joins it; must not raise.
        """
        future: Future[Any] = Future()
        with self._lock:
            alike, running = [own for own in self.waiting if own.kind == job.kind], self._running
            shared = next((own for own in alike if own.key == job.key), None)
            if running is not None and running.kind == job.kind and joins is not None and running.open_to == joins:
                shared = running
            problem = obstacle if self._refusal is None else self._refusal or job.ended
            if not problem and shared is None and len(alike) >= MAX_WAITING:
                problem = f"{MAX_WAITING} {job.kind}s wait already; ask again when one of them is answered"
            if not problem:
                self.waiting += [] if shared else [job]
                (shared or job).asked.append((future, progress))
                return future
        future.set_exception(CalibrationError(problem))
        return future

    def begin(self, estimate: bool, open_to: Hashable = None, is_due: bool = False) -> Pending | None:
        """The job that has waited longest, an estimate or another one, is under way from now on; None if there is none.

        is_due: an estimate begins though nobody has asked for one. It is open to nobody: it does not search the whole box.
        """
        with self._lock:
            self.waiting = [job for job in self.waiting if job.is_wanted()]
            job = next((own for own in self.waiting if (own.kind == ESTIMATE) == estimate), None)
            if job is not None:
                self.waiting.remove(job)
                job.open_to = open_to
            elif is_due and not self.refused:
                job = Pending(ESTIMATE)
            self._running = job
            return job

    def close(self) -> None:
        """No request joins the job under way from now on: it would give another result than a run of its own."""
        with self._lock:
            if self._running is not None:
                self._running.open_to = None

    def run(self, job: Pending, work: Callable[[Callback], T], check_cancelled: Callable[[], None]) -> T:
        """Do the job that has begun, on this thread, and answer all who wait for it; what `work` raises they hear as well.

        check_cancelled: raises Cancelled where the thread is to end.
        """
        asked_for = bool(job.asked)

        def progress(stage: str, share: float) -> None:
            check_cancelled()
            with self._lock:
                if job is not self._running or (asked_for and not job.is_wanted()):
                    job.open_to = None  # under the same lock: who asks from now on gets a run of its own
                    raise Cancelled
                listeners = [listener for _, listener in job.asked if listener is not None]
            for listener in listeners:
                listener(stage, share)

        try:
            check_cancelled()
            outcome = work(progress)
        except BaseException as error:
            self._end(job, error=CalibrationError(job.ended) if isinstance(error, Cancelled) else error)
            raise
        self._end(job, outcome)
        return outcome

    def _end(self, job: Pending, outcome: Any = None, error: BaseException | None = None) -> None:
        with self._lock:
            refused, self._running = job is not self._running, None
        if not refused:  # else: answered already
            job.answer(outcome, error)

    def refuse(self, reason: str = "") -> None:
        """Fail all requests with a CalibrationError, new ones too, and end the job under way, asked for or not. reason: "" = the
        node is stopping."""
        with self._lock:
            self._refusal = reason
            ended = [*self.waiting, *filter(None, [self._running])]
            self.waiting, self._running = [], None
        for job in ended:
            job.answer(error=CalibrationError(reason or job.ended))

    def accept(self) -> None:
        """Take requests again."""
        with self._lock:
            self._refusal = None
