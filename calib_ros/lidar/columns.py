"""Columns of the range image of a spinning scanner: its azimuth step, and the column of each firing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

ENOUGH = 30_000  # points that tell the azimuth step
MAX_COLUMNS = 16384
LEVELS = 25.0  # bins of gaps per unit of their logarithm: each 4 % wide
USUAL_STEP = float(np.deg2rad(0.2))  # where no ring has two points


def azimuth_step(row: NDArray[np.int32], azimuth: NDArray[np.floating]) -> float:
    """The most frequent azimuth difference of neighbours in a ring, rad.

    Lost returns leave multiples of the step, and second returns of one firing leave differences near 0 of all sizes: neither
    is as frequent.
    """
    every = max(len(row) // ENOUGH, 1)
    some = row % every == 0
    if not some.any():
        some = np.ones(len(row), bool)
    row, azimuth = row[some], azimuth[some]
    order = np.lexsort((azimuth, row))
    gap = np.diff(azimuth[order])
    gap = gap[(np.diff(row[order]) == 0) & (gap > 2 * np.pi / MAX_COLUMNS)]
    if not len(gap):
        return USUAL_STEP
    level = np.rint(np.log(gap / gap.min()) * LEVELS).astype(np.intp)
    count = np.convolve(np.bincount(level), [1, 1, 1], "same")
    usual = gap[np.abs(level - count.argmax()) <= 4]
    return float(np.median(usual))


def columns_of(row: NDArray[np.int32], azimuth: NDArray[np.floating], columns: int) -> NDArray[np.intp]:
    """Column (n,) of each point, its ring's firings in the middle of the cells.

    Firings that fall on the borders of cells (simulators start at exactly -180 deg) would by rounding share a cell here and
    leave one empty there, and the jump across the empty one is no edge.
    """
    turn = azimuth.astype(np.float64) * columns
    rings = np.bincount(row, np.cos(turn)) + 1j * np.bincount(row, np.sin(turn))
    # Relative to the mean of all rings, so that rings which fire together stay in the same columns.
    common = np.angle(rings.sum())
    phase = common + np.angle(rings * np.exp(-1j * common))
    return np.asarray(np.rint((turn - phase[row]) / (2 * np.pi) + columns // 2).astype(np.intp) % columns)
