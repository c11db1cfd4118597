"""How the clocks' offset moves the optimum, and what the scenes tell of it by its profile.

The profile is the score with each value at an extrinsic of its own (as the profile likelihood of Murphy and van der Vaart 2000).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from calib_ros import se3
from calib_ros.arrays import Matrix, Transform
from calib_ros.registration.acceptance.refusal import Refusal, left_open, wrong_times
from calib_ros.registration.acceptance.split_half import disagreement, inflation
from calib_ros.registration.covariance import REGIONS, effective_frames
from calib_ros.registration.nuisance.parameters import (
    GROSSLY,
    LEVELS,
    NEAR_LEVELS,
    NEAR_POINTS,
    NEAR_TOLERANCE_DEG,
    OPEN_PROBABILITY,
    POINTS,
    REACH,
    SIGNIFICANCE,
    TOLERANCE_DEG,
    Effect,
    noise_of,
    refined,
)
from calib_ros.registration.score.point_score import PointScore
from calib_ros.registration.search.constraints import Limits

GROSS_S = 0.05  # standard deviation of offsets that are plainly wrong
STEP_S = 0.03  # 3 px at a turn of 5 deg/s, or at 10 m/s and 20 m beside the way
ALTERNATIVES_S = (-0.1, -0.075, -0.05, -0.025, 0.025, 0.05, 0.075, 0.1)  # up to one scan at 10 Hz
BRACKETING = 6  # steps from the best of the alternatives, of which the next one is a few steps away, until its top lies between
FARTHEST = 2.0  # steps


@dataclass(frozen=True, eq=False)
class ClockOffset:
    """The offset of the clocks, s, as a change of motion.time_offset_s. sigma_s: its standard deviation in advance, 0 = known.
    twists: (n_frames, 6) of the LiDAR, rad/s and m/s."""

    sigma_s: float
    twists: Matrix

    def changed(self, score: PointScore, T: Transform, value: float) -> tuple[PointScore, Matrix]:
        """The score with another offset, and where its optimum is looked for if T (4, 4) is the one without: what all frames have
        in common of their motion turns the extrinsic back."""
        weight = np.bincount(score.frame, score.weights, len(self.twists))
        common = weight @ self.twists / weight.sum()
        return score.moved(self.twists, value), T @ se3.exp(-common * value)

    def effect(self, score: PointScore, T: Transform, limits: Limits, points: int = NEAR_POINTS) -> Effect:
        """How it moves the optimum T (4, 4), refined anew a step to either side. points: edge points used at most."""
        if not self.twists.any():  # a vehicle at rest shows no offset of its own
            return Effect(np.zeros(6), 0.0)
        limits = Limits(T, np.where(limits.open_axes, np.inf, 0.0))  # at speed, a step is farther than the trust region
        part = score.subset(points, np.random.default_rng(0))
        changes = [self.changed(part, T, x) for x in (-STEP_S, 0.0, STEP_S)]
        ends, values = zip(*(refined(*own, limits, NEAR_LEVELS, NEAR_TOLERANCE_DEG) for own in changes), strict=True)
        direction = np.where(limits.open_axes, se3.log(ends[2] @ se3.inverse(ends[0])), 0.0) / (2 * STEP_S)
        fallen = max(values[1] - 0.5 * (values[0] + values[2]), 0.0)
        return Effect(direction, 2 * fallen / STEP_S**2 / noise_of(part, T, limits))


@dataclass(frozen=True, eq=False)
class ClockEstimate:
    """What the scenes tell of the offset.

    value: where the profile is highest, s; 0 = as given. prior_s: standard deviation in advance. effect: how it moves the
    optimum, and how well the scenes tell it. freedom: degrees of freedom of the noise, regions of frames less the unknowns.
    """

    value: float
    prior_s: float
    effect: Effect
    freedom: float = np.inf

    @property
    def sigma(self) -> float:
        """Standard deviation of the value by the scenes alone, inf where they do not show it."""
        return float(1 / np.sqrt(self.effect.information)) if self.effect.information > 0 else np.inf

    def refusal(self, deg: float, m: float) -> Refusal | None:
        """Why an extrinsic is not to be used: the offset is significantly not as given, such that it would be off by more than
        the tolerance, or plainly wrong with a probability above OPEN_PROBABILITY."""
        turn, shift = (float(np.linalg.norm(part)) for part in np.split(self.effect.direction, 2))
        largest = min(deg / max(float(np.rad2deg(turn)), 1e-12), m / max(shift, 1e-12))
        deviations = abs(self.value) / max(float(np.hypot(self.sigma, self.prior_s)), 1e-12)
        t, z = scipy.special.stdtr, scipy.special.ndtr
        chance = 2 * (t(self.freedom, -deviations) if np.isfinite(self.freedom) else z(-deviations))
        if chance < SIGNIFICANCE and abs(self.value) > largest:
            return wrong_times(self.value, deviations)
        probability = self._probability_wrong(largest)
        if probability > OPEN_PROBABILITY:
            return left_open("time_offset_s", self.value, self.sigma, probability, deg, m)
        return None

    def _probability_wrong(self, value: float) -> float:
        """Probability that it is plainly wrong and farther off than `value`, if GROSSLY of all that are given are."""
        odds = GROSSLY / (1 - GROSSLY)
        usual, gross = np.hypot(self.sigma, self.prior_s), np.hypot(self.sigma, GROSS_S)
        if np.isfinite(self.sigma):  # else the scenes show nothing, and it is as likely as in advance
            log_ratio = self._log_density(self.value / gross) - self._log_density(self.value / usual)
            odds *= usual / gross * np.exp(min(log_ratio, 50.0))
        sigma = self.effect.sigma(GROSS_S)
        mean = self.value * self.effect.information * sigma**2
        below, above = scipy.special.ndtr(np.array([-value - mean, mean - value]) / sigma)
        return float(odds / (1 + odds) * (below + above))

    def _log_density(self, deviations: float) -> float:
        """Of Student's distribution, but for what all have in common."""
        if not np.isfinite(self.freedom):
            return -0.5 * deviations**2
        return float(-0.5 * (self.freedom + 1) * np.log1p(deviations**2 / self.freedom))


def estimate_clocks(
    clocks: ClockOffset, score: PointScore, T: Transform, limits: Limits, inflated: float = 1.0
) -> ClockEstimate | None:
    """What the scenes tell of the offset at the optimum T (4, 4) of a search, which may belong to one far off; None of a vehicle
    at rest.

    limits: axes that are fixed stay so. inflated: factor of the noise, by the disagreement of halves at T.
    """
    if not limits.open_axes.any() or not clocks.twists.any():
        return None
    free, freedom = Limits(T, np.where(limits.open_axes, np.inf, 0.0)), max(REGIONS * effective_frames(score) - 7, 1.0)
    score = score.subset(POINTS, np.random.default_rng(0))
    # Around where each begins, not within a search's bounds: near one of them only other values could go on.
    reach = np.where(limits.open_axes, REACH, 0.0)

    def far(x: float) -> tuple[Matrix, float]:
        other, start = clocks.changed(score, T, x)
        start = free.clip(start)
        return refined(other, start, Limits(start, reach), LEVELS, TOLERANCE_DEG)

    tried = {x: far(x) for x in (0.0, *ALTERNATIVES_S)}
    best = max(tried, key=lambda x: tried[x][1])
    T_best = tried[best][0]

    def near(k: int) -> tuple[Matrix, float]:
        """The profile k steps from `best`, from the optimum there on."""
        (other, there), (_, here) = (clocks.changed(score, T, x) for x in (best + k * STEP_S, best))
        return refined(other, T_best @ se3.inverse(here) @ there, free, NEAR_LEVELS, NEAR_TOLERANCE_DEG)

    profile, top = {k: near(k) for k in (-1, 0, 1)}, 0
    for _ in range(BRACKETING):
        top = max(profile, key=lambda k: profile[k][1])
        if min(profile) < top < max(profile):
            break
        beyond = top + 1 if top == max(profile) else top - 1
        profile[beyond] = near(beyond)
    top = min(max(top, min(profile) + 1), max(profile) - 1)
    (T_low, low), (T_here, here), (T_high, high) = (profile[k] for k in (top - 1, top, top + 1))
    value = best + top * STEP_S
    fallen = here - 0.5 * (low + high)  # by one step to either side
    direction = np.where(limits.open_axes, se3.log(T_high @ se3.inverse(T_low)), 0.0) / (2 * STEP_S)
    if fallen <= 0:
        return ClockEstimate(value, clocks.sigma_s, Effect(direction, 0.0), freedom)
    seen = clocks.changed(score, T, value)[0]
    noise = noise_of(seen, T_here, free)
    # Vertex of the parabola through the three, in steps; farther away it says nothing.
    value += STEP_S * float(np.clip(0.25 * (high - low) / fallen, -FARTHEST, FARTHEST))
    information = 2 * fallen / STEP_S**2 / noise
    if abs(value) > STEP_S:  # a top elsewhere that is hardly higher is one of chance: the profile between is no parabola
        given = profile[0][1] if best == 0 else refined(score, T, free, NEAR_LEVELS, NEAR_TOLERANCE_DEG)[1]
        information = min(information, 2 * max(here - given, 0.0) / noise / value**2)
        if inflated > 1:  # halves may disagree because of the wrong value
            inflated = min(inflated, inflation(disagreement(seen, T_here, free)))
    return ClockEstimate(value, clocks.sigma_s, Effect(direction, information / inflated), freedom)
