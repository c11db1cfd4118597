"""A time series in bounded memory."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import ArrayLike, NDArray

Rows = NDArray[np.float64]


class Ring:
    """The newest `span_s` of rows of numbers, at most one row in span_s / capacity seconds: the last one of each such step.

    An hour at 10 Hz in 1800 rows is one row in 2 s, evenly, but for the newest row, which is always there. Times must not go
    back; a row from before the newest one begins the series anew.
    """

    def __init__(self, width: int, span_s: float = 3600.0, capacity: int = 1800) -> None:
        self.step_s, self._span_s = span_s / capacity, span_s
        self._rows: deque[Rows] = deque(maxlen=capacity)  # time first
        self._empty = np.empty((0, width + 1))

    def add(self, time_s: float, values: ArrayLike) -> None:
        """A row (width,); it takes the place of the row before in the same step."""
        if self._rows and time_s < self._rows[-1][0]:
            self._rows.clear()
        if len(self._rows) > 1 and time_s // self.step_s == self._rows[-1][0] // self.step_s:
            self._rows.pop()
        row = np.empty(self._empty.shape[1])
        row[0], row[1:] = time_s, values
        self._rows.append(row)

    def add_gap(self, time_s: float) -> None:
        """Nothing was known at this time: lines are broken here."""
        self.add(time_s, np.nan)

    def rows(self, since_s: float = -np.inf, most: int = 0) -> Rows:
        """(n, 1 + width): times and values not older than since_s nor than the span, oldest first.

        most: at most so many (0 = all), evenly, with the newest one; every gap stays.
        """
        if not self._rows:
            return self._empty
        rows = np.array(self._rows)
        rows = rows[rows[:, 0] >= max(since_s, rows[-1, 0] - self._span_s)]
        if most and len(rows) > most:
            chosen = np.linspace(0, len(rows) - 1, most).round().astype(int)
            gaps = np.flatnonzero(np.isnan(rows[:, 1:]).all(axis=1))
            rows = rows[np.union1d(chosen, gaps)]
        return np.asarray(rows)
