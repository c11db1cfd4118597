"""What a score is worth by chance: the scores of extrinsics so far off that edges match by chance only, and the probability that
the best optimum of chance reaches it. They are spread evenly, as the starts of a search are."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.arrays import Matrix, Transform
from calib_ros.registration.score.point_score import PointScore

NEIGHBOURS = 128
HALF_WIDTH = np.array([np.deg2rad(6.0)] * 3 + [0.5] * 3)  # rad, m; edges move by tens of pixels: nothing matches but by chance
POINTS = 15000  # edge points used, so that many frames do not cost more
NO_SPREAD = 1e-6  # a picture without any edge scores 0 everywhere: its z-score is 0

# z-scores. None of a decoy comes near the first: 1 to 6.3 on five vehicles and synthetic streets, from one frame to ten.
UNDOUBTED_Z, HIGHEST_DECOY_Z, LOWEST_DECOY_Z = 10.0, 6.3, 1.0
GUMBEL_SCALE = 0.65  # of the distribution of the best of many optima of chance: 0.6 to 0.9 within searches, 0.2 to 0.7 across

# z-score of a frame as a share of the median of all: 0.6 to 2.5 with the right image, -0.12 to 0.2 with another scene's.
OUTLIER_SHARE = 0.35
MIN_MEDIAN_Z = 2.5  # median z-score below which no frame matches, and none can judge the others
MIN_JUDGING_FRAMES = 4  # frames needed to tell which of them is an outlier


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


@dataclass(frozen=True, eq=False)
class NullDistribution:
    """The score at an extrinsic against the scores of extrinsics spread around it, in their standard deviations above their mean:
    unlike scores, they compare across scenes and sensors.

    z_score: of all frames together. z_scores: (n_frames,) of every frame alone; NaN for a frame without points. mean, spread: of
    the distribution of all frames together.
    """

    z_score: float
    z_scores: Matrix
    mean: float = 0.0
    spread: float = 1.0

    def outlier_frames(self) -> NDArray[np.intp]:
        """Frames that match no better than chance where the others match well: paired wrongly, or a covered lens."""
        z = self.z_scores
        if np.isfinite(z).sum() < MIN_JUDGING_FRAMES or np.nanmedian(z) < MIN_MEDIAN_Z:
            return np.zeros(0, np.intp)
        with np.errstate(invalid="ignore"):
            return np.flatnonzero(z < OUTLIER_SHARE * np.nanmedian(z))


def null_distribution(score: PointScore, T: Transform) -> NullDistribution:
    """The null distribution around T_camera_lidar (4, 4), on the finest level."""
    part = score.subset(POINTS, np.random.default_rng(0))
    transforms = np.concatenate([[T], null_extrinsics(T)])
    of_frames = part.frame_values(transforms, part.n_levels - 1)
    share = np.bincount(part.frame, part.weights, part.n_frames)
    of_all = np.nan_to_num(of_frames) @ share
    here, others = of_frames[0], of_frames[1:]
    z_scores = (here - others.mean(axis=0)) / np.maximum(others.std(axis=0), NO_SPREAD)
    mean, spread = float(of_all[1:].mean()), max(float(of_all[1:].std()), NO_SPREAD)
    return NullDistribution((float(of_all[0]) - mean) / spread, z_scores, mean, spread)


def null_extrinsics(T: Transform) -> Matrix:
    """Extrinsics (NEIGHBOURS, 4, 4) spread around T (4, 4), so far off that nothing matches but by chance."""
    return np.asarray(_twists() @ T)


@cache
def _twists() -> Matrix:
    return se3.exp_many(EvenPoints(6, seed=0).next(NEIGHBOURS) * HALF_WIDTH)


def p_value(z_score: float, decoy_z: float | None, rounds: int = 1) -> float:
    """Probability that the best optimum of chance reaches this z-score: the difference of two maxima of Gumbel's distribution is
    logistic. decoy_z: of the best optimum of one round in the decoy; None = not searched, and taken to be as high as any. rounds:
    of the search itself, with whose logarithm the best optimum of chance rises."""
    decoy = HIGHEST_DECOY_Z if decoy_z is None else decoy_z
    margin = (z_score - decoy) / GUMBEL_SCALE - np.log(rounds)
    return float(1 / (1 + np.exp(np.clip(margin, -50, 50))))
