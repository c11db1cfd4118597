"""How much the data speak against the current extrinsic: likelihood ratios of "it has moved" against "it is right".

A ratio is 1 on average while the extrinsic is right, whatever the hypothesis that it moved: so it reaches A with a probability of
at most 1 / A (Ville 1939), and of n tests in an hour at most n / A per hour are false alarms. All ratios are natural logarithms.
"""

from __future__ import annotations

from collections import deque

import numpy as np
import scipy

from calib_ros.arrays import Covariance, Matrix
from calib_ros.registration.covariance import free_axes

# Sizes of movements that are thought of, alike: from what estimates would follow to what a knock does. 10 cm go with a degree.
SIZES_DEG = (0.25, 0.5, 1.0, 2.0, 4.0)
M_PER_DEG = 0.1
# Variances of the twist: of no movement, of a rotation of each size, of a shift of each.
_TURNS, _SHIFTS = np.deg2rad(SIZES_DEG) ** 2 / 3, (M_PER_DEG * np.array(SIZES_DEG)) ** 2 / 3
_MOVEMENTS = np.concatenate([np.zeros((1, 6)), np.outer(_TURNS, [1, 1, 1, 0, 0, 0]), np.outer(_SHIFTS, [0, 0, 0, 1, 1, 1])])
REMEMBERED = 50  # keyframes that tell how well a right extrinsic matches here
MIN_REMEMBERED = 3  # of these, needed to judge
TAIL = 0.9  # quantile of shifts by which covariances are scaled: of REMEMBERED ones five lie beyond
LOWEST = -20.0  # of one keyframe; what matches as usual does not make up for all that comes after it


def log_student(squared: float, log_det: float, dimensions: int, freedom: float) -> float:
    """Logarithm of the density of Student's distribution at a squared Mahalanobis distance, log_det that of its scale matrix."""
    half = 0.5 * (freedom + dimensions)
    constant = scipy.special.gammaln(half) - scipy.special.gammaln(0.5 * freedom) - 0.5 * dimensions * np.log(np.pi * freedom)
    return float(constant - 0.5 * log_det - half * np.log1p(squared / freedom))


def shift_evidence(shift: Matrix, covariance: Covariance, freedom: float) -> float:
    """Log likelihood ratio of "the mount has turned or moved" against "it has not", by how far an optimum lies away.

    shift: (6,) twist, rad and m. covariance: (6, 6) of it while nothing has moved. freedom: degrees of freedom of that
    covariance. The movement is of unknown direction: a normal distribution of each of SIZES_DEG, of the rotation or of the shift,
    all as probable (the mixture of Robbins 1970).
    """
    axes = np.flatnonzero(free_axes(covariance))
    if not len(axes):
        return 0.0
    sigma = np.sqrt(np.diag(covariance))[axes]
    x, correlation = shift[axes] / sigma, covariance[np.ix_(axes, axes)] / np.outer(sigma, sigma)

    added = _MOVEMENTS[:, axes] / sigma**2
    S = correlation + added[:, None] * np.eye(len(axes))
    stack = np.broadcast_to(x[:, None], (len(S), len(x), 1))  # numpy 1 would take (6, 1) for a stack of vectors
    squared = [float(x @ y) for y in np.linalg.solve(S, stack)[..., 0]]
    densities = [log_student(*own, len(axes), freedom) for own in zip(squared, np.linalg.slogdet(S)[1].tolist(), strict=True)]
    return float(scipy.special.logsumexp(densities[1:]) - np.log(len(_MOVEMENTS) - 1) - densities[0])


class ShiftNoise:
    """How large shifts are here while the extrinsic is right, in units of their covariances: learnt from keyframes that fit.

    A covariance is made to be safe on one keyframe of any scene; the shifts of many of a drive tell how far it is. What counts is
    their tail, from which false alarms come. Not thread-safe.
    """

    def __init__(self) -> None:
        self._usual: deque[float] = deque(maxlen=REMEMBERED)

    def learn(self, squared: float, axes: int, freedom: float) -> None:
        """A keyframe that fits has this squared Mahalanobis distance (see `covariance.distance`) by a covariance of `freedom`."""
        if axes:
            self._usual.append(squared / axes / float(scipy.special.fdtri(axes, freedom, TAIL)))

    @property
    def scale(self) -> float:
        """Factor of covariances; before anything is known 1, which counts as MIN_REMEMBERED keyframes."""
        n = len(self._usual)
        return (MIN_REMEMBERED + n * float(np.quantile(self._usual, TAIL))) / (MIN_REMEMBERED + n) if n else 1.0


class MatchEvidence:
    """Do keyframes still match at the extrinsic? Where it has moved so far that no optimum is found, they match as decoys do.

    evidence: log likelihood ratio of the newest keyframes, those together that speak against it most (the cumulative sum of Page
    1954). count: how many these are. Not thread-safe.
    """

    def __init__(self) -> None:
        # z-scores grow with the root of the number of edge points, and are compared by what one point adds to them.
        self._usual: deque[float] = deque(maxlen=REMEMBERED)
        self.reset()

    def reset(self) -> None:
        """The extrinsic was replaced."""
        self._before, self._newest, self.count = 0.0, 0.0, 0

    @property
    def evidence(self) -> float:
        """Of the newest keyframes together."""
        return self._before + self._newest

    def learn(self, z_score: float, points: float) -> None:
        """A keyframe that fits has this z-score, by so many effective points; neither has a unit."""
        self._usual.append(z_score / np.sqrt(points))

    def add(self, z_score: float, points: float, same_scene: bool) -> None:
        """A new keyframe. same_scene: it shows what the one before has shown, and tells nothing besides."""
        ratio = max(self.ratio(z_score, points), LOWEST)
        if same_scene and self.count:
            self._newest = max(self._newest, ratio)
            return
        self._before = max(self.evidence, 0.0)
        self._newest, self.count = ratio, (self.count if self._before > 0 else 0) + 1

    def ratio(self, z_score: float, points: float) -> float:
        """Of one keyframe: as far above decoys as they are among themselves, or as far as keyframes are here usually. 0 while
        that is not known."""
        n = len(self._usual)
        if n < MIN_REMEMBERED:
            return 0.0
        usual = np.array(self._usual) * np.sqrt(points)
        scale = float(np.hypot(usual.std(ddof=1) * np.sqrt(1 + 1 / n), 1.0))  # z-scores are known to 1 each
        right = log_student(((z_score - usual.mean()) / scale) ** 2, 2 * np.log(scale), 1, n - 1)
        return float(-0.5 * z_score**2 - 0.5 * np.log(2 * np.pi) - right)
