"""What an estimate takes for granted besides the extrinsic: the intrinsics and the clocks. Do they fit, and what if they are off?

Another focal length, or an offset of the clocks, is one more unknown of the registration. The scenes tell some of it: the
extrinsic is refined anew with another value, and the match gets worse, or clearly better. What they do not tell moves the
extrinsic along one direction, and belongs to its covariance. The parameters are those of lens.py and time_offset.py.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from calib_ros import se3
from calib_ros.arrays import Covariance, Matrix, Transform
from calib_ros.registration.acceptance.refusal import WrongIntrinsics, WrongTimes
from calib_ros.registration.covariance import NO_NOISE, noise_covariance, noise_level
from calib_ros.registration.score.point_score import PointScore
from calib_ros.registration.search.constraints import Limits, PoseConstraints
from calib_ros.registration.search.optimizers import levenberg_marquardt

Changed = tuple[PointScore, Matrix]  # the score with another value of an unknown, and where to begin

NEAR_POINTS, NEAR_LEVELS, NEAR_TOLERANCE_DEG = 4000, (3, 4), 0.003  # edge points and levels on which that is refined

# Points and levels for values farther off: 3 % of the focal length move the extrinsic by 3 deg and 40 cm. REACH: twice as far.
POINTS, LEVELS, TOLERANCE_DEG = 6000, (1, 2, 3, 4), 0.01
REACH = np.array([np.deg2rad(6.0)] * 3 + [0.8] * 3)  # rad, m
# Gain from which another value is preferred, in standard deviations of the score and as a share of it, and the frames it takes:
# one frame may gain 7 by chance. Of 59 sets of five frames of 20 rigs and seven vehicles that are accepted with the right ones,
# focal lengths gain at most 1.0 and principal points 2.2, or 3.5 but 1 % of the score (a rolling shutter). Focal lengths 3 %
# wrong gain 3.5 to 9, and 12 to 150 % of the score. Principal points 2 % of the image width beside (13 to 26 px) gain 3.5 to 4 on
# average; those that gain little are rotations. Offsets of 50 ms gain 3 to 9 and 8 to 280 % where speeds differ (KITTI drive
# 0005, HDL-32E and OS1-128 in a bend), and right clocks at most 1.0 and 0.7 %.
SIGNIFICANT_Z, MIN_RELATIVE_GAIN, MIN_FRAMES = 2.5, 0.05, 3


@dataclass(frozen=True, eq=False)
class Effect:
    """How an unknown moves the optimum.

    direction: (6,) twist of the optimum, rad and m, per unit of the unknown. information: what the scenes tell of the unknown,
    the inverse of its variance.
    """

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
        """The same under constraints of the extrinsic: its prior holds the optimum back, and its limits end its way. covariance:
        (6, 6) of the optimum, its prior counted."""
        direction = self.direction
        if constraints.prior:
            direction = direction - covariance @ (constraints.information() * direction)
        sigma = self.sigma(prior)
        farthest = constraints.limits.half / sigma if sigma else np.full(6, np.inf)
        return replace(self, direction=np.clip(direction, -farthest, farthest))


@dataclass(frozen=True, eq=False)
class NuisanceParameter(ABC):
    """One more unknown of the registration beside the extrinsic, 0 where it is as configured.

    sigma: its standard deviation in advance, 0 = known. step: to either side for its effect; so far that edges move by a pixel or
    more, and no further than their blurred maps reach. alternatives: other values that are compared with 0.
    """

    sigma: float
    step: ClassVar[float]
    alternatives: ClassVar[Sequence[float]]

    @abstractmethod
    def changed(self, score: PointScore, T: Transform, value: float) -> Changed:
        """The score with another value, and where its optimum is looked for if T (4, 4) is the one without."""

    @abstractmethod
    def observable_in(self, score: PointScore) -> bool:
        """Whether these frames can show it at all."""

    @abstractmethod
    def refusal(self, value: float, gain: float) -> WrongIntrinsics | WrongTimes:
        """Why an extrinsic is refused that matches clearly better with this value; gain: as `Alternative`."""

    def effect(self, score: PointScore, T: Transform, limits: Limits, points: int = NEAR_POINTS) -> Effect:
        """How it moves the optimum T (4, 4), refined anew a step to either side, and by how much the score falls. points: edge
        points used at most."""
        if not self.observable_in(score):
            return Effect(np.zeros(6), 0.0)
        limits = Limits(T, np.where(limits.open_axes, np.inf, 0.0))  # at speed, a step is farther than the trust region
        part = score.subset(points, np.random.default_rng(0))
        changes = [self.changed(part, T, x) for x in (-self.step, 0.0, self.step)]
        ends, values = zip(*(refined(*own, limits, NEAR_LEVELS, NEAR_TOLERANCE_DEG) for own in changes), strict=True)
        direction = np.where(limits.open_axes, se3.log(ends[2] @ se3.inverse(ends[0])), 0.0) / (2 * self.step)
        fallen = max(values[1] - 0.5 * (values[0] + values[2]), 0.0)
        return Effect(direction, 2 * fallen / self.step**2 / noise_of(part, T, limits))

    def added_covariance(self, effect: Effect, constraints: PoseConstraints, covariance: Covariance) -> Covariance:
        """Covariance (6, 6) that it adds to an optimum whose own is `covariance`."""
        return effect.constrained(constraints, covariance, self.sigma).covariance(self.sigma)

    def scores_at(self, score: PointScore, T: Transform, values: Iterable[float]) -> list[float]:
        """Score with each value, the extrinsic held at T (4, 4)."""
        return [self.changed(score, T, float(x))[0].at(-1).value(T) for x in values]


@dataclass(frozen=True, eq=False)
class Alternative:
    """The value of a parameter with the best match. gain: by how much its score exceeds that of the given one, in standard
    deviations. relative_gain: the same, as a share of the score."""

    parameter: NuisanceParameter
    value: float
    gain: float
    relative_gain: float

    @property
    def significant(self) -> bool:
        """True if it is clearly better."""
        return self.gain > SIGNIFICANT_Z and self.relative_gain > MIN_RELATIVE_GAIN


def check_parameters(
    parameters: Sequence[NuisanceParameter], score: PointScore, T: Transform, limits: Limits
) -> WrongIntrinsics | WrongTimes | None:
    """Why one of them does not fit at the optimum T (4, 4), None if all do or too few frames tell."""
    shown = [p for p in parameters if p.observable_in(score)]
    if len(np.unique(score.frame)) < MIN_FRAMES or not limits.open_axes.any() or not shown:
        return None
    best = best_alternative(shown, score, T, limits)
    return best.parameter.refusal(best.value, best.gain) if best is not None and best.significant else None


def best_alternative(
    parameters: Iterable[NuisanceParameter], score: PointScore, T: Transform, limits: Limits
) -> Alternative | None:
    """Compare the match at the optimum T (4, 4) with that of other values of each parameter, each at its own optimum; None if
    none is better.

    limits: axes that are fixed stay so.
    """
    # Around where it begins, not within a search's bounds: near one of them only other values could go on.
    reach = np.where(limits.open_axes, REACH, 0.0)
    part = score.subset(POINTS, np.random.default_rng(0))
    # Coarse levels may have their optimum elsewhere.
    here = max(refined(part, T, Limits(T, reach), LEVELS, TOLERANCE_DEG)[1], part.at(-1).value(T))
    best, highest = None, here
    for parameter in parameters:
        for value in parameter.alternatives:
            other, start = parameter.changed(part, T, value)
            start = Limits(T, np.where(limits.open_axes, np.inf, 0.0)).clip(start)
            reached = refined(other, start, Limits(start, reach), LEVELS, TOLERANCE_DEG)[1]
            if reached > highest:
                best, highest = (parameter, value), reached
    if best is None:
        return None
    gain = highest - here
    return Alternative(*best, float(np.sqrt(2 * gain / noise_of(part, T, limits))), gain / max(abs(here), NO_NOISE))


def noise_of(score: PointScore, T: Transform, limits: Limits) -> float:
    """Noise of the score at its optimum T (4, 4): twice what is lost by one standard deviation; see `noise_level`."""
    level, axes = score.n_levels - 1, np.flatnonzero(limits.open_axes)
    return max(noise_level(score, T, level, noise_covariance(score, T, level, axes, noise=1.0), axes), NO_NOISE)


def refined(
    score: PointScore, T: Transform, limits: Limits, levels: tuple[int, ...], tolerance_deg: float
) -> tuple[Matrix, float]:
    """The optimum (4, 4) near T and its score."""
    T, value = limits.clip(T), 0.0
    for level in levels:
        T, value = levenberg_marquardt(score.at(level), T, limits=limits, tolerance_deg=tolerance_deg, near=True)
    return T, value
