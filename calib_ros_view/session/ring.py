"""A time series in bounded memory."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Rows = NDArray[np.float64]


class Ring:
    """The newest `span_s` of rows of numbers, at most one row in span_s / capacity seconds: the last one of each such step.

    An hour at 10 Hz in 1800 rows is one row in 2 s, evenly, but for the newest row, which is always there. Times must not go
    back; a row from before the newest one begins the series anew.
    """

    def __init__(self, width: int, span_s: float = 3600.0, capacity: int = 1800) -> None:
        self.step_s = span_s / capacity
        self._span_s, self._capacity = span_s, capacity
        self._rows = np.full((capacity, width + 1), np.nan)  # time first
        self._first = self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def nbytes(self) -> int:
        """Memory of the rows, which never grows."""
        return int(self._rows.nbytes)

    def clear(self) -> None:
        """Forget everything."""
        self._first = self._count = 0

    def add(self, time_s: float, values: ArrayLike) -> None:
        """A row (width,); it takes the place of the row before in the same step."""
        if self._count and time_s < self._row(self._count - 1)[0]:
            self.clear()
        before = self._count > 1 and time_s // self.step_s == self._row(self._count - 1)[0] // self.step_s
        if not before:
            if self._count == self._capacity:
                self._first = (self._first + 1) % self._capacity
            else:
                self._count += 1
        row = self._row(self._count - 1)
        row[0], row[1:] = time_s, values

    def add_gap(self, time_s: float) -> None:
        """Nothing was known at this time: lines are broken here."""
        self.add(time_s, np.nan)

    def rows(self, since_s: float = -np.inf, most: int = 0) -> Rows:
        """(n, 1 + width): times and values not older than since_s nor than the span, oldest first.

        most: at most so many (0 = all), evenly, with the newest one; every gap stays.
        """
        if not self._count:
            return np.empty((0, self._rows.shape[1]))
        order = (self._first + np.arange(self._count)) % self._capacity
        rows = self._rows[order]
        rows = rows[rows[:, 0] >= max(since_s, rows[-1, 0] - self._span_s)]
        if most and len(rows) > most:
            chosen = np.linspace(0, len(rows) - 1, most).round().astype(int)
            gaps = np.flatnonzero(np.isnan(rows[:, 1:]).all(axis=1))
            rows = rows[np.union1d(chosen, gaps)]
        return np.asarray(rows)

    def _row(self, k: int) -> Rows:
        return np.asarray(self._rows[(self._first + k) % self._capacity])
