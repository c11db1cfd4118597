"""What happens to the node: complaints, estimates, how long callbacks take; as log lines, and kept for /diagnostics."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from calib_ros.online.extrinsic import Extrinsic
from calib_ros.result import CONVERGED, INITIAL, INSUFFICIENT, REFUSED

REPEAT_S = 10.0  # the same complaint is logged at most this often


class Health:
    """Collects what happens; thread-safe, since every field is replaced whole."""

    def __init__(self, logger: Any) -> None:
        self._logger = logger
        self._logged: dict[str, float] = {}
        self._last_error = ("", -1e9)
        self._extrinsic: Extrinsic | None = None
        self._estimated_at: float | None = None
        self._callback_ms: deque[float] = deque(maxlen=2000)
        self.errors = 0

    def error(self, text: str, kind: str = "") -> None:
        """One line for a person; repeated ones are logged once in REPEAT_S. kind: what counts as the same, if not the text."""
        now, kind = time.monotonic(), kind or text
        self.errors += 1
        self._last_error = (text, now)
        if now - self._logged.get(kind, -1e9) >= REPEAT_S:
            if len(self._logged) > 100:  # texts may hold numbers that never repeat
                self._logged.clear()
            self._logged[kind] = now
            self._logger.warning(text)

    def unexpected(self, error: BaseException) -> str:
        """A defect of ours: says where it is and what to do, and returns that line."""
        trace = error.__traceback__
        while trace is not None and trace.tb_next is not None:
            trace = trace.tb_next
        where = f" in {Path(trace.tb_frame.f_code.co_filename).name}:{trace.tb_lineno}" if trace is not None else ""
        line = f"unexpected {type(error).__name__}{where}: {error}; please report it with the data that led to it"
        self.error(line)
        return line

    def estimated(self, extrinsic: Extrinsic) -> bool:
        """A new state of the extrinsic; True if a newly accepted estimate is behind it."""
        before, self._extrinsic = self._extrinsic, extrinsic
        result = extrinsic.result
        accepted = extrinsic.accepted > 0 and (before is None or extrinsic.accepted != before.accepted)
        if accepted:
            self._estimated_at = time.monotonic()
        if result.status in (CONVERGED, INSUFFICIENT) and accepted:  # insufficient: taken in, but some axes are not seen yet
            self._logger.info(
                f"extrinsic from {result.frames_used} keyframes: score {result.score:.3f}, "
                f"drift {extrinsic.drift:.2f}, {result.elapsed_s:.1f} s"
                + (f"; {result.reason}" if result.status == INSUFFICIENT else "")
            )
        elif result.status == INITIAL or (result.status == CONVERGED and not extrinsic.accepted):
            self._logger.info(
                f"initial extrinsic {result.lidar_frame} -> {result.camera_frame}: {result.reason or 'from the saved state'}"
            )
        elif result.status in (REFUSED, INSUFFICIENT):
            self.error(f"estimate {result.status}: {result.reason}")
        elif result.status != CONVERGED:  # told with every frame, with other numbers each time
            self.error(f"extrinsic {result.status}: {result.reason or extrinsic.verdict}", result.status)
        return accepted

    def timed(self, callback: Callable[[Any], None]) -> Callable[[Any], None]:
        """The callback, with its time kept. What it raises is said and goes no further: it would end the node."""

        def run(msg: Any) -> None:
            start = time.perf_counter()
            try:
                callback(msg)
            except Exception as error:
                self.unexpected(error)
            self._callback_ms.append(1e3 * (time.perf_counter() - start))

        return run

    @property
    def callback_p99_ms(self) -> float:
        """99 % of the newest 2000 callbacks took no longer, ms; 0 before the first."""
        times = list(self._callback_ms)
        return float(np.percentile(times, 99)) if times else 0.0

    @property
    def last_error(self) -> tuple[str, float]:
        """The newest complaint, and when it came by time.monotonic()."""
        return self._last_error

    @property
    def extrinsic(self) -> Extrinsic | None:
        """The newest state of the extrinsic."""
        return self._extrinsic

    @property
    def age_s(self) -> float | None:
        """Seconds since the last accepted estimate, None before the first."""
        return None if self._estimated_at is None else time.monotonic() - self._estimated_at
