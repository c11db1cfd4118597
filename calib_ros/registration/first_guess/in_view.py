"""How well the points that are in view meet the classes: the measure of where a camera stands."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_ros.registration.point_score import PointScore
from calib_ros.registration.projection import MIN_DEPTH

Matrix = NDArray[np.float64]
BATCH = 1 << 18  # points of a batch of extrinsics


class InView:
    """The mean of a score's map values over those of its points that are in view; a SmoothScore.

    The sum over all points grows with what is in view, and a camera that is moved back has more of the road and of the cars
    beside it in view: on ten KITTI frames it is a tenth higher 1.3 m behind the truth, while the mean is highest at the truth.
    least: share of the weight that counts as in view at least, lest a few points be all that is looked at.
    """

    def __init__(self, score: PointScore, level: int, least: float = 0.02) -> None:
        self.score, self.level, self.least = score, level, least
        self._last: tuple[Matrix, float] | None = None  # an optimiser asks for the slope where it asked for the value before

    def share(self, transforms: Matrix) -> Matrix:
        """Share (k,) of the weight that is in view at each of (k, 4, 4)."""
        own, points = self.score.atlas.levels[self.level], self.score.points
        K, step, out = own.K.astype(np.float32), max(BATCH // points.shape[1], 1), []
        for k in range(0, len(transforms), step):
            T = transforms[k : k + step].astype(np.float32)
            y = ((K @ T[:, :3, :3]).reshape(-1, 3) @ points).reshape(len(T), 3, -1) + K @ T[:, :3, 3:]
            u, v, z = y[:, 0], y[:, 1], y[:, 2]
            inside = (z > MIN_DEPTH) & (u >= 0) & (v >= 0) & (u <= (own.width - 1) * z) & (v <= (own.height - 1) * z)
            out.append(inside @ self.score.weights)
        return np.maximum(np.concatenate(out), self.least)

    def values(self, transforms: Matrix) -> Matrix:
        """The mean (k,) at each of (k, 4, 4)."""
        return self.score.values(transforms, self.level) / self.share(transforms)

    def value(self, T: Matrix) -> float:
        """The mean at T (4, 4)."""
        return self.score.at(self.level).value(T) / self._share(T)

    def linearise(self, T: Matrix) -> tuple[Matrix, Matrix]:
        """Gradient (6,) and Gauss-Newton scale (6, 6), those in view taken to stay."""
        gradient, scale = self.score.at(self.level).linearise(T)
        return gradient / self._share(T), scale / self._share(T)

    def _share(self, T: Matrix) -> float:
        if self._last is None or not np.array_equal(self._last[0], T):
            self._last = T.copy(), float(self.share(T[None])[0])
        return self._last[1]
