"""How noisy the reflectivity of a scan is, told by the scan itself."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

STEPS, PARTS = 20_000, 16  # steps of a scan that tell its noise, and parts into which their levels are divided


def reflectivity_noise(steps: NDArray[np.float32], levels: NDArray[np.float32]) -> tuple[np.float32, np.float32]:
    """Noise of a scan's reflectivity, by its steps (n,) and the mean reflectivities (n,) around them: at level 0, and its slope.
    The highest rising line below the median steps of parts of the levels: edges raise the medians, and nothing lowers them."""
    every = max(len(steps) // STEPS, 1)
    known = np.flatnonzero(~np.isnan(steps[::every]) & ~np.isnan(levels[::every])) * every
    parts = np.array_split(known[np.argsort(levels[known], kind="stable")], PARTS)
    medians = np.array([(np.median(levels[part]), np.median(steps[part])) for part in parts if len(part)]).reshape(-1, 2)
    x, y = medians[medians[:, 1] > 0].T  # where whole numbers hide the noise, they do not tell it
    if not len(x):
        return np.float32(0), np.float32(0)
    return line_below(x, y)


def line_below(x: NDArray[np.floating], y: NDArray[np.floating]) -> tuple[np.float32, np.float32]:
    """Of the lines a + b x that neither fall, nor begin below 0, nor pass above any of the points (n,), the one with the least
    total distance from them: a and b, reflectivity."""
    # A linear program, solved at a corner: a line through two points, through one and the origin, or level at the lowest.
    x, y = x.astype(np.float64), y.astype(np.float64)
    i, j = np.triu_indices(len(x), 1)
    apart = x[j] != x[i]
    i, j = i[apart], j[apart]
    b = np.concatenate([(y[j] - y[i]) / (x[j] - x[i]), y[x > 0] / x[x > 0], [0.0]])
    b = b[b >= 0]
    a = (y - b[:, None] * x).min(axis=1)
    total = np.where(a >= -1e-9 * y.max(), len(x) * a + x.sum() * b, -np.inf)
    best = int(np.argmax(total))
    return np.float32(max(a[best], 0.0)), np.float32(b[best])
