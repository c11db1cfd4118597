"""What an estimate takes for granted besides the extrinsic: the intrinsics (lens.py) and the clocks (time_offset.py).

The extrinsic is refined anew with another value of an unknown, and the match gets worse, or clearly better. What the scenes do
not tell of it moves the extrinsic along one direction, and belongs to its covariance.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from scipy.special import ndtr, stdtr

from calib_ros import se3
from calib_ros.arrays import Covariance, Matrix, Transform
from calib_ros.intrinsics import IntrinsicEstimate
from calib_ros.registration.acceptance.refusal import Refusal, left_open
from calib_ros.registration.acceptance.split_half import disagreement, inflation
from calib_ros.registration.covariance import NO_NOISE, REGIONS, effective_frames, inverse_curvature, noise_level
from calib_ros.registration.score.point_score import PointScore
from calib_ros.registration.search.constraints import Limits, PoseConstraints
from calib_ros.registration.search.optimizers import levenberg_marquardt

Changed = tuple[PointScore, Matrix]  # the score with another value of an unknown, and where to begin

NEAR_POINTS, NEAR_LEVELS, NEAR_TOLERANCE_DEG = 4000, (3, 4), 0.003  # edge points and levels on which that is refined

# Points and levels for values farther off: 3 % of the focal length move the extrinsic by 3 deg and 40 cm. REACH: twice as far.
POINTS, LEVELS, TOLERANCE_DEG = 6000, (1, 2, 3, 4), 0.01
REACH = np.array([np.deg2rad(6.0)] * 3 + [0.8] * 3)  # rad, m
BRACKETING = 6  # steps from the best of the alternatives, of which the next one is a few steps away, until its top lies between
FARTHEST = 2.0  # steps
SIGNIFICANCE = 1e-3  # largest probability of a false refusal, of all unknowns together
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


@dataclass(frozen=True, eq=False)
class NuisanceParameter(ABC):
    """One more unknown of the registration beside the extrinsic, 0 where it is as configured.

    sigma: its standard deviation in advance, 0 = known. name: for files, with the unit. gross: standard deviation of values that
    are plainly wrong. step: to either side for its effect; so far that edges move by a pixel or more, and no further than their
    blurred maps reach.
    """

    sigma: float
    name: str
    gross: ClassVar[float]
    step: ClassVar[float]

    @property
    def unit(self) -> float:
        """By which values are multiplied for files."""
        return 1.0

    @property
    @abstractmethod
    def alternatives(self) -> Sequence[float]:
        """Other values that are compared with 0."""

    @abstractmethod
    def changed(self, score: PointScore, T: Transform, value: float) -> Changed:
        """The score with another value, and where its optimum is looked for if T (4, 4) is the one without."""

    @abstractmethod
    def observable_in(self, score: PointScore) -> bool:
        """Whether these frames can show it at all."""

    @abstractmethod
    def refusal(self, value: float, deviations: float) -> Refusal:
        """Why an extrinsic is refused if this value is right; deviations: how far it is off, in standard deviations."""

    def effect(self, score: PointScore, T: Transform, limits: Limits, points: int = NEAR_POINTS) -> Effect:
        """How it moves the optimum T (4, 4), refined anew a step to either side. points: edge points used at most."""
        if not self.observable_in(score):
            return Effect(np.zeros(6), 0.0)
        limits = Limits(T, np.where(limits.open_axes, np.inf, 0.0))  # at speed, a step is farther than the trust region
        part = score.subset(points, np.random.default_rng(0))
        changes = [self.changed(part, T, x) for x in (-self.step, 0.0, self.step)]
        ends, values = zip(*(refined(*own, limits, NEAR_LEVELS, NEAR_TOLERANCE_DEG) for own in changes), strict=True)
        direction = np.where(limits.open_axes, se3.log(ends[2] @ se3.inverse(ends[0])), 0.0) / (2 * self.step)
        fallen = max(values[1] - 0.5 * (values[0] + values[2]), 0.0)
        return Effect(direction, 2 * fallen / self.step**2 / noise_of(part, T, limits))

    def scores_at(self, score: PointScore, T: Transform, values: Iterable[float]) -> list[float]:
        """Score with each value, the extrinsic held at T (4, 4)."""
        return [self.changed(score, T, float(x))[0].at(-1).value(T) for x in values]


@dataclass(frozen=True, eq=False)
class NuisanceEstimate:
    """What the scenes tell of an unknown, by its profile: the score with each value at an extrinsic of its own (as the profile
    likelihood of Murphy and van der Vaart 2000).

    value: where the profile is highest, in the unit of the parameter; 0 = as given. effect: how it moves the optimum, and how
    well the scenes tell it. freedom: degrees of freedom of the noise, regions of frames less the unknowns.
    """

    parameter: NuisanceParameter
    value: float
    effect: Effect
    freedom: float = np.inf

    @property
    def sigma(self) -> float:
        """Standard deviation of the value by the scenes alone, inf where they do not show it."""
        return float(1 / np.sqrt(self.effect.information)) if self.effect.information > 0 else np.inf

    @property
    def is_observable(self) -> bool:
        """Whether the scenes tell more of it than is known in advance."""
        return self.sigma < self.parameter.sigma

    @property
    def in_files(self) -> IntrinsicEstimate:
        """The same in the unit of files."""
        unit = self.parameter.unit
        return IntrinsicEstimate(unit * self.value, unit * self.sigma, self.is_observable)

    @property
    def deviations(self) -> float:
        """How far the value is off, in standard deviations of the scenes and of what is known in advance together."""
        total = np.hypot(self.sigma, self.parameter.sigma)
        return float(abs(self.value) / total) if total > 0 else 0.0

    @property
    def p_value(self) -> float:
        """Probability that the scenes show a right one at least so far off."""
        return float(2 * (stdtr(self.freedom, -self.deviations) if np.isfinite(self.freedom) else ndtr(-self.deviations)))

    @property
    def posterior(self) -> tuple[float, float]:
        """Value and standard deviation with what is known in advance: the product of both normal distributions."""
        sigma, prior = self.effect.sigma(self.parameter.sigma), self.parameter.sigma
        return (self.value * self.effect.information * sigma**2 if prior > 0 else 0.0), sigma

    def largest_within(self, deg: float, m: float) -> float:
        """The largest value whose extrinsic lies no farther away than deg and m."""
        per_unit = np.array([np.rad2deg(np.linalg.norm(self.effect.direction[:3])), np.linalg.norm(self.effect.direction[3:])])
        return float(np.min(np.array([deg, m]) / np.maximum(per_unit, 1e-12)))

    def probability_wrong(self, value: float) -> float:
        """Probability that it is plainly wrong and farther off than `value`, if GROSSLY of all that are given are."""
        odds, parameter = GROSSLY / (1 - GROSSLY), self.parameter
        usual, gross = np.hypot(self.sigma, parameter.sigma), np.hypot(self.sigma, parameter.gross)
        if np.isfinite(self.sigma):  # else the scenes show nothing, and it is as likely as in advance
            log_ratio = self._log_density(self.value / gross) - self._log_density(self.value / usual)
            odds *= usual / gross * np.exp(min(log_ratio, 50.0))
        sigma = self.effect.sigma(parameter.gross)
        mean = self.value * self.effect.information * sigma**2
        return float(odds / (1 + odds) * (ndtr((-value - mean) / sigma) + ndtr((mean - value) / sigma)))

    def _log_density(self, deviations: float) -> float:
        """Of Student's distribution, but for what all have in common."""
        if not np.isfinite(self.freedom):
            return -0.5 * deviations**2
        return float(-0.5 * (self.freedom + 1) * np.log1p(deviations**2 / self.freedom))

    def added_covariance(self, constraints: PoseConstraints, covariance: Covariance) -> Covariance:
        """Second moment (6, 6) about the optimum for the given value, whose own covariance is `covariance`, if it is another."""
        direction = self.effect.constrained(constraints, covariance, self.parameter.sigma).direction
        mean, sigma = self.posterior
        return np.outer(direction, direction) * (mean**2 + sigma**2)


def estimate_parameters(
    parameters: Sequence[NuisanceParameter],
    score: PointScore,
    T: Transform,
    limits: Limits,
    inflated: float = 1.0,
    search: bool = False,
) -> tuple[NuisanceEstimate, ...]:
    """What the scenes tell of each parameter at the optimum T (4, 4), those that they cannot show left out.

    limits: axes that are fixed stay so. inflated: factor of the noise, by the disagreement of halves at T. search: values far off
    are tried as well, as after a search, whose optimum may belong to one.
    """
    free = Limits(T, np.where(limits.open_axes, np.inf, 0.0))
    if not limits.open_axes.any():
        return ()
    part = score.subset(POINTS if search else NEAR_POINTS, np.random.default_rng(0))
    shown = [parameter for parameter in parameters if parameter.observable_in(score)]
    freedom = max(REGIONS * effective_frames(score) - 7, 1.0)
    found = (_estimate(parameter, part, T, limits, free, inflated, search) for parameter in shown)
    return tuple(replace(estimate, freedom=freedom) for estimate in found)


def _estimate(
    parameter: NuisanceParameter, score: PointScore, T: Transform, limits: Limits, free: Limits, inflated: float, search: bool
) -> NuisanceEstimate:
    # Around where each begins, not within a search's bounds: near one of them only other values could go on.
    reach, step = np.where(limits.open_axes, REACH, 0.0), parameter.step

    def far(x: float) -> tuple[Matrix, float]:
        other, start = parameter.changed(score, T, x)
        start = free.clip(start)
        return refined(other, start, Limits(start, reach), LEVELS, TOLERANCE_DEG)

    def near(k: int) -> tuple[Matrix, float]:
        """The profile k steps from `best`, from the optimum there on."""
        (other, there), (_, here) = (parameter.changed(score, T, x) for x in (best + k * step, best))
        return refined(other, T_best @ se3.inverse(here) @ there, free, NEAR_LEVELS, NEAR_TOLERANCE_DEG)

    best, T_best = 0.0, T
    if search:
        tried = {x: far(x) for x in (0.0, *parameter.alternatives)}
        best = max(tried, key=lambda x: tried[x][1])
        T_best = tried[best][0]
    profile, top = {k: near(k) for k in (-1, 0, 1)}, 0
    for _ in range(BRACKETING if search else 0):
        top = max(profile, key=lambda k: profile[k][1])
        if min(profile) < top < max(profile):
            break
        beyond = top + 1 if top == max(profile) else top - 1
        profile[beyond] = near(beyond)
    top = min(max(top, min(profile) + 1), max(profile) - 1)
    (T_low, low), (T_here, here), (T_high, high) = (profile[k] for k in (top - 1, top, top + 1))
    value = best + top * step
    fallen = here - 0.5 * (low + high)  # by one step to either side
    direction = np.where(limits.open_axes, se3.log(T_high @ se3.inverse(T_low)), 0.0) / (2 * step)
    if fallen <= 0:
        return NuisanceEstimate(parameter, value, Effect(direction, 0.0))
    seen = parameter.changed(score, T, value)[0]
    noise = noise_of(seen, T_here, free)
    # Vertex of the parabola through the three, in steps; farther away it says nothing.
    value += step * float(np.clip(0.25 * (high - low) / fallen, -FARTHEST, FARTHEST))
    information = 2 * fallen / step**2 / noise
    if abs(value) > step:  # a top elsewhere that is hardly higher is one of chance: the profile between is no parabola
        given = profile[0][1] if best == 0 else refined(score, T, free, NEAR_LEVELS, NEAR_TOLERANCE_DEG)[1]
        information = min(information, 2 * max(here - given, 0.0) / noise / value**2)
        if inflated > 1:  # halves may disagree because of the wrong value
            inflated = min(inflated, inflation(disagreement(seen, T_here, free)))
    return NuisanceEstimate(parameter, value, Effect(direction, information / inflated))


def wrong_parameter(estimates: Sequence[NuisanceEstimate], tolerance_deg: float, tolerance_m: float) -> Refusal | None:
    """Which unknown is significantly not as given, such that the extrinsic would be off by more than the tolerance, or plainly
    wrong with a probability above OPEN_PROBABILITY; None if all may be as given."""
    judged = [(e, e.largest_within(tolerance_deg, tolerance_m)) for e in estimates]
    wrong = [e for e, largest in judged if e.p_value * len(judged) < SIGNIFICANCE and abs(e.value) > largest]
    if wrong:
        worst = max(wrong, key=lambda e: e.deviations)
        return worst.parameter.refusal(worst.value, worst.deviations)
    for e, largest in judged:
        probability, unit = e.probability_wrong(largest), e.parameter.unit
        if probability > OPEN_PROBABILITY:
            return left_open(e.parameter.name, unit * e.value, unit * e.sigma, probability, tolerance_deg, tolerance_m)
    return None


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
