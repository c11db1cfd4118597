"""Points to start from that fill a box evenly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class EvenPoints:
    """A sequence that fills [-1, 1]^dimensions evenly, wherever it is cut: multiples of the powers of a root, modulo 1 (Roberts,
    The unreasonable effectiveness of quasirandom sequences, 2018), from where the seed says. scipy.stats takes half a second to
    import for as much."""

    def __init__(self, dimensions: int, seed: int) -> None:
        root = 2.0
        for _ in range(64):  # of x^(d + 1) = x + 1
            root = (1 + root) ** (1 / (dimensions + 1))
        self._step = root ** -np.arange(1.0, dimensions + 1)
        self._at, self._taken = np.random.default_rng(seed).random(dimensions), 0

    def next(self, count: int) -> NDArray[np.float64]:
        """The next points (count, dimensions)."""
        k = np.arange(self._taken, self._taken + count)[:, None]
        self._taken += count
        return np.asarray((self._at + k * self._step) % 1 * 2 - 1)
