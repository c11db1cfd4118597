"""Lines for people, few enough to be read: one of a kind in 10 s, whatever figures it gives."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable

REPEAT_S = 10.0


class QuietLog:
    """Counts what comes within REPEAT_S of the last line of its kind; the newest of these is written afterwards. Thread-safe.

    now: s, by a steady clock.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now, self._lock = now, threading.Lock()
        # Of each kind when its last line was written, how many have come since, and what writes the newest of these.
        self._told: dict[str, tuple[float, int, Callable[[str], object]]] = {}

    def add(self, kind: str, text: str, write: Callable[[str], object]) -> None:
        """A line. kind: what counts as the same, whatever the text. write: takes the text when its time has come."""
        with self._lock:
            now = self._now()
            at, left_out, _ = self._told.get(kind, (-math.inf, 0, write))
            if now - at >= REPEAT_S:
                self._told[kind] = now, 0, write
                write(text + _more(left_out))
            else:
                self._told[kind] = at, left_out + 1, lambda more: write(text + more)

    def catch_up(self) -> None:
        """Write what has been left out long enough; to be called about once a second."""
        with self._lock:
            now = self._now()
            for kind, (at, left_out, write) in list(self._told.items()):
                if now - at >= REPEAT_S:
                    del self._told[kind]
                    if left_out:
                        self._told[kind] = now, 0, write
                        write(_more(left_out - 1))


def _more(count: int) -> str:
    return f" ({count} more in {REPEAT_S:g} s)" if count else ""
