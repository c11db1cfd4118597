"""A thread with a queue of one item: slow work never holds up whoever hands items over, and never lags behind."""

from __future__ import annotations

import os
import threading
import time
import traceback
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from functools import partial
from typing import Generic, TypeVar

Item = TypeVar("Item")


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
