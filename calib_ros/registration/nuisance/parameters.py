"""What an estimate takes for granted besides the extrinsic: the lens (judgement/lens.py) and the clocks (time_offset.py).

The extrinsic is refined anew with other clocks, and the match gets worse, or clearly better. What the scenes do
not tell of it moves the extrinsic along one direction, and belongs to its covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calib_ros.arrays import Covariance, Matrix, Transform
from calib_ros.registration.covariance import NO_NOISE, inverse_curvature, noise_level
from calib_ros.registration.score.point_score import PointScore
from calib_ros.registration.search.constraints import Limits, PoseConstraints
from calib_ros.registration.search.optimizers import levenberg_marquardt

NEAR_POINTS, NEAR_LEVELS, NEAR_TOLERANCE_DEG = 4000, (3, 4), 0.003  # edge points and levels on which that is refined

# Points and levels for values farther off: 3 % of the focal length move the extrinsic by 3 deg and 40 cm. REACH: twice as far.
POINTS, LEVELS, TOLERANCE_DEG = 6000, (1, 2, 3, 4), 0.01
REACH = np.array([np.deg2rad(6.0)] * 3 + [0.8] * 3)  # rad, m
SIGNIFICANCE = 1e-3  # largest probability of a false refusal
GROSSLY = 0.01  # share of what is given that is plainly wrong, as the intrinsics of another image size are
OPEN_PROBABILITY = 0.1  # of being plainly wrong: a search must reach its tolerance with 90 %

# Of the clocks alone: gain from which another offset is preferred, in standard deviations of the score, and the frames it takes.
SIGNIFICANT_Z, MIN_FRAMES = 2.5, 3


@dataclass(frozen=True, eq=False)
class Effect:
    """How an unknown moves the optimum. direction: (6,) twist of it, rad and m, per unit of the unknown. information: what the
    scenes tell of the unknown, the inverse of its variance."""

    direction: Matrix
    information: float

    def sigma(self, prior: float) -> float:
        """Standard deviation of the unknown, if it is `prior` in advance."""
        return float(1 / np.sqrt(self.information + 1 / prior**2)) if prior > 0 else 0.0

    def covariance(self, prior: float) -> Covariance:
        """(6, 6), what the unknown leaves open of the extrinsic. prior: its standard deviation in advance."""
        shift = self.sigma(prior) * self.direction
        return np.outer(shift, shift)

    def constrained(self, constraints: PoseConstraints, covariance: Covariance, prior: float) -> Effect:
        """The same under prior and limits of the extrinsic. covariance: (6, 6) of the optimum, its prior counted."""
        direction = self.direction
        if constraints.prior:
            direction = direction - covariance @ (constraints.information() * direction)
        sigma = self.sigma(prior)
        farthest = constraints.limits.half / sigma if sigma else np.full(6, np.inf)
        return replace(self, direction=np.clip(direction, -farthest, farthest))


def noise_of(score: PointScore, T: Transform, limits: Limits) -> float:
    """Noise of the score at its optimum T (4, 4): twice what is lost by one standard deviation; see `noise_level`."""
    axes = np.flatnonzero(limits.open_axes)
    return max(noise_level(score, T, inverse_curvature(score, T, axes), axes), NO_NOISE)


def refined(
    score: PointScore, T: Transform, limits: Limits, levels: tuple[int, ...], tolerance_deg: float
) -> tuple[Matrix, float]:
    """The optimum (4, 4) near T and its score."""
    T, value = limits.clip(T), 0.0
    for level in levels:
        T, value = levenberg_marquardt(score.at(level), T, limits=limits, tolerance_deg=tolerance_deg, near=True)
    return T, value
