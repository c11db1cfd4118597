"""Returns of a range image that show no surface: rain and dust, and beams that hit two surfaces at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Ranges = NDArray[np.float32]
Mask = NDArray[np.bool_]


def strays(ranges: Ranges, jump: float, ratio: float) -> Mask:
    """Cells (rows, columns) whose return is alone, or lies between a near and a far surface.

    jump, ratio: ranges that differ less than `jump` m, or than this share of the range, are of one surface. A pole one
    column wide is no stray: it goes on above or below.
    """
    limit = np.maximum(np.float32(jump), np.float32(ratio) * ranges)
    alone = ~_near(ranges, np.roll(ranges, 1, 1), limit) & ~_near(ranges, np.roll(ranges, -1, 1), limit)
    alone &= ~np.isnan(ranges)
    row, column = np.nonzero(alone)
    if not len(row):
        return alone
    # Few are left: their other neighbours are looked up one by one.
    rows, columns = ranges.shape
    R, own = ranges[row, column], limit[row, column]
    upright = np.zeros(len(row), bool)
    diagonal = np.zeros(len(row), bool)
    for up in (-1, 1):
        inside = (row + up >= 0) & (row + up < rows)
        beyond = np.clip(row + up, 0, rows - 1)
        upright |= inside & _near(R, ranges[beyond, column], own)
        for aside in (-1, 1):
            diagonal |= inside & _near(R, ranges[beyond, (column + aside) % columns], own)
    for aside in (-2, 2):
        diagonal |= _near(R, ranges[row, (column + aside) % columns], own)
    left, right = ranges[row, (column + 1) % columns], ranges[row, (column - 1) % columns]
    with np.errstate(invalid="ignore"):
        mixed = ((left - R) * (right - R) < 0) & ~_steady(R, left, right)
    alone[row, column] = ~upright & (mixed | ~diagonal)
    return alone


def _near(a: Ranges, b: Ranges, limit: Ranges) -> Mask:
    with np.errstate(invalid="ignore"):
        return np.asarray(np.abs(a - b) < limit)


def _steady(R: Ranges, left: Ranges, right: Ranges) -> Mask:
    """Whether the three lie on one flat surface, along which the inverse range is linear."""
    middle, step = 0.5 * (1 / left + 1 / right), np.abs(1 / left - 1 / right)
    return np.asarray(np.abs(1 / R - middle) < 0.2 * step)
