"""What an optimiser asks of a score."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]


class Score(Protocol):
    """A score of an extrinsic, to be maximised."""

    def value(self, T: Matrix) -> float:
        """Score at T_camera_lidar (4, 4)."""
        ...


class SmoothScore(Score, Protocol):
    """A score that knows its slope."""

    def linearise(self, T: Matrix) -> tuple[Matrix, Matrix]:
        """Gradient (6,) of the score by a left twist at T and a positive matrix (6, 6) that scales the step."""
        ...
