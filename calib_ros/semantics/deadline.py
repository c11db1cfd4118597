"""How long work may take, and that it can be broken off."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from calib_ros.errors import BudgetError

LOOKED_AT_S = 0.05  # how often a run of a network is asked whether it should go on


class Deadline:
    """Time that is up after `seconds` from now, or when `cancelled` says so (a node that shuts down)."""

    def __init__(self, seconds: float, cancelled: Callable[[], bool] = lambda: False) -> None:
        self.seconds, self._cancelled = seconds, cancelled
        self._end = time.monotonic() + seconds

    @property
    def over(self) -> bool:
        """True when the time is up."""
        return time.monotonic() >= self._end or self._cancelled()

    def check(self) -> None:
        """Raises BudgetError when the time is up."""
        if self._cancelled():
            raise BudgetError("broken off, since its result is no longer wanted")
        if self.over:
            raise BudgetError(f"broken off after the budget of {self.seconds:g} s (semantics.budget_s)")

    @contextmanager
    def ends(self, run_options: Any) -> Iterator[None]:
        """Within it a watcher sets `terminate` of onnxruntime's RunOptions when the time is up."""
        done = threading.Event()

        def watch() -> None:
            while not done.wait(LOOKED_AT_S):
                if self.over:
                    run_options.terminate = True
                    return

        watcher = threading.Thread(target=watch, name="calib_deadline", daemon=True)
        watcher.start()
        try:
            yield
        finally:
            done.set()
            watcher.join()
