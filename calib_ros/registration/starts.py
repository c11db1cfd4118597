"""Points to start from that fill a box evenly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class Sobol:
    """A scrambled Sobol sequence over [-1, 1]^dimensions."""

    def __init__(self, dimensions: int, seed: int) -> None:
        from scipy.stats import qmc  # half a second, which a process that searches nothing is spared

        self._sequence = qmc.Sobol(dimensions, seed=seed)

    def next(self, count: int) -> NDArray[np.float64]:
        """The next points (count, dimensions)."""
        return np.asarray(self._sequence.random(count) * 2 - 1)
