"""A thread with a queue of one item: slow work never holds up whoever hands items over, and never lags behind."""

from __future__ import annotations

import os
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Generic, TypeVar

Item = TypeVar("Item")


class Cancelled(Exception):
    """Raised inside long work when its worker is asked to stop."""


class Worker(Generic[Item]):
    """Runs `work(item)` on a thread with a queue of one item: a newer item replaces the one that waits.

    on_error: called on the worker thread with whatever `work` raises; the thread goes on. nice: by how much it yields to others
    where all cores are busy, 0 to 19. on_idle: called on the worker thread whenever it has nothing left to do.
    """

    def __init__(
        self,
        name: str,
        work: Callable[[Item], None],
        on_error: Callable[[Exception], None],
        nice: int = 0,
        on_idle: Callable[[], None] = lambda: None,
    ) -> None:
        self._work, self._on_error, self._nice, self._on_idle = work, on_error, nice, on_idle
        self._changed = threading.Condition()
        self._waiting: list[Item] = []
        self._busy = self._stopping = False
        self._busy_since = 0.0
        self.busy_s = 0.0
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, item: Item) -> list[Item]:
        """Put an item into the queue; never blocks. Returns those that it replaces. After stop() it is ignored."""
        with self._changed:
            if self._stopping:
                return []
            # One that an idle thread has been woken for is as good as begun: on a busy machine it may take a while to run.
            begun = int(not self._busy)
            replaced, self._waiting = self._waiting[begun:], [*self._waiting[:begun], item]
            self._changed.notify_all()
        return replaced

    def newer(self, item: Item) -> Item:
        """For an item that is worked on: the newest that waits, which is taken in its place, or itself."""
        with self._changed:
            waiting, self._waiting = self._waiting, []
        return waiting[-1] if waiting else item

    @property
    def stopping(self) -> bool:
        """True once stop() was called."""
        return self._stopping

    @property
    def busy(self) -> bool:
        """True while an item is worked on or waits."""
        with self._changed:
            return self._busy or bool(self._waiting)

    def check_cancelled(self, *_: object) -> None:
        """Raise Cancelled after stop(); to be called now and then from within long work."""
        if self._stopping:
            raise Cancelled

    def busy_seconds(self) -> float:
        """Time spent working so far, the item under way included."""
        with self._changed:
            return self.busy_s + (time.monotonic() - self._busy_since if self._busy else 0.0)

    def wait_idle(self, timeout: float | None = None) -> bool:
        """Wait until nothing is worked on or waits; False when the time is up first."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._busy and not self._waiting, timeout)

    def stop(self, timeout: float = 1.5) -> bool:
        """End the thread, and wait for it; True if it ended in time."""
        with self._changed:
            self._stopping = True
            self._waiting = []
            self._changed.notify_all()
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def _run(self) -> None:
        if self._nice and hasattr(os, "setpriority"):
            with suppress(OSError):  # some sandboxes do not allow even that
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), self._nice)
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._stopping)
                if self._stopping:
                    return
                item = self._waiting.pop(0)
                self._busy, self._busy_since = True, time.monotonic()
            self._guarded(partial(self._work, item))
            with self._changed:
                self._busy = False
                self.busy_s += time.monotonic() - self._busy_since
                idle = not self._waiting
                self._changed.notify_all()
            if idle:
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
