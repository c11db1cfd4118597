"""Lines for people, few enough to be read: one of a kind in 10 s, whatever figures it gives."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

REPEAT_S = 10.0

Write = Callable[[str], object]


@dataclass
class _Told:
    """at: when the last line of a kind was written, s. left_out: how many have come since; text and write: of the newest."""

    at: float
    left_out: int = 0
    text: str = ""
    write: Write = print


class QuietLog:
    """Counts what comes within REPEAT_S of the last line of its kind; the newest of these is written afterwards. Thread-safe.

    now: s, by a steady clock.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now, self._lock = now, threading.Lock()
        self._told: dict[str, _Told] = {}

    def add(self, kind: str, text: str, write: Write) -> None:
        """A line. kind: what counts as the same, whatever the text. write: takes the text when its time has come."""
        with self._lock:
            now, last = self._now(), self._told.get(kind)
            if last is None or now - last.at >= REPEAT_S:
                self._told[kind] = _Told(now)
                write(text + _more(last.left_out if last else 0))
            else:
                last.left_out, last.text, last.write = last.left_out + 1, text, write

    def catch_up(self) -> None:
        """Write what has been left out long enough; to be called about once a second."""
        with self._lock:
            now = self._now()
            for kind, last in [item for item in self._told.items() if now - item[1].at >= REPEAT_S]:
                if last.left_out:
                    self._told[kind] = _Told(now)
                    last.write(last.text + _more(last.left_out - 1))
                else:
                    del self._told[kind]


def _more(count: int) -> str:
    return f" ({count} more in {REPEAT_S:g} s)" if count else ""
