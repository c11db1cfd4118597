"""Waiting for something to happen, however busy the machine is."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

LIMIT_S = 240.0  # of any wait: far longer than a busy machine takes, and shorter than the limit of pytest-timeout


def pause() -> None:
    """A moment for other threads and processes."""
    time.sleep(0.01)


def until(
    condition: Callable[[], Any], what: object = "", turn: Callable[[], object] = pause, state: Callable[[], object] = lambda: ""
) -> Any:
    """Wait until the condition holds and return its value. turn: what is done meanwhile. state: told where it never does."""
    end = time.monotonic() + LIMIT_S
    while not (value := condition()):
        assert time.monotonic() < end, f"did not happen within {LIMIT_S} s: {what or condition}; {state()}"
        turn()
    return value
