"""One standard of evidence for every explanation of what the scenes show.

The extrinsic is as given; or off; or something was mixed up, or another camera took the pictures. Any two are compared at the
optimum of each: the difference of their scores over the noise of the score is a log-likelihood ratio, and has to outweigh how
rare the better one is in advance. An explanation under which a scene is symmetric matches as well, and outweighs nothing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import Generic, Protocol, TypeVar

import numpy as np
from scipy.special import ndtri

from calib_ros import se3
from calib_ros.arrays import Covariance, Matrix, Transform
from calib_ros.registration.acceptance.split_half import disagreement, inflation
from calib_ros.registration.covariance import REGIONS, USUAL_CELLS, effective_frames, effective_points
from calib_ros.registration.nuisance.parameters import (
    GROSSLY,
    LEVELS,
    NEAR_LEVELS,
    POINTS,
    REACH,
    TOLERANCE_DEG,
    noise_of,
    refined,
)
from calib_ros.registration.score.chance import null_distribution
from calib_ros.registration.score.point_score import PointScore
from calib_ros.registration.search.constraints import Limits, unlimited
from calib_ros_check.outcome import Tolerance
from calib_ros_check.tolerance import CONFIDENCE

ROUNDS = 50  # of the fixed point
UNKNOWNS = 6  # of an extrinsic
EVEN = 1.0  # prior odds, that an extrinsic which somebody checks is off
SMALLEST_SCORE = 1e-9
FALSE_ALARMS = 0.01  # share of right cameras that may be taken for another one
PARAMETER_PENALTY = 3.0  # log-likelihood that one more unknown costs: about as many values can be told apart
INDEPENDENT = 2.0  # frames; one scene alone does not tell noise from what is wrong in it


@dataclass(frozen=True, eq=False)
class Match:
    """An explanation at its optimum T (4, 4), with the score of the frames as they look if it holds."""

    score: PointScore
    T: Transform


class CheckHypothesis(Protocol):
    """What may differ from the claim. unknowns: how many things. min_relative_gain: share of the score that it has to gain."""

    @property
    def unknowns(self) -> int: ...

    @property
    def min_relative_gain(self) -> float: ...


H = TypeVar("H", bound=CheckHypothesis)


@dataclass(frozen=True, eq=False)
class Candidate(Match, Generic[H]):
    """A hypothesis at its optimum.

    value: of the score there. gain: in log-likelihood, over what is claimed; relative_gain: the same, as a share of the score.
    tried: of how many candidates it is the best. parts: log-likelihood that is lost without each of the things that the
    hypothesis changes.
    """

    hypothesis: H
    value: float
    gain: float = 0.0
    relative_gain: float = 0.0
    tried: int = 1
    parts: Mapping[str, float] = field(default_factory=dict)

    @cached_property
    def z_score(self) -> float:
        """Of the match, against extrinsics around it."""
        return null_distribution(self.score, self.T).z_score

    @property
    def deviations(self) -> float:
        """The gain in standard deviations of the score."""
        return float(np.sqrt(2 * max(self.gain, 0.0)))

    @property
    def penalised_gain(self) -> float:
        """Gain in log-likelihood, its unknowns paid for."""
        return self.gain - PARAMETER_PENALTY * self.hypothesis.unknowns

    @property
    def significant(self) -> bool:
        """True if it is clearly better than what is claimed."""
        by_chance = -float(ndtri(FALSE_ALARMS / self.tried))
        enough = self.deviations > by_chance and self.relative_gain > self.hypothesis.min_relative_gain
        return self.hypothesis.unknowns > 0 and enough

    def against(self, value: float, noise: float) -> Candidate[H]:
        """With what it gains over a score of this value. noise: see `noise_of`."""
        gain = self.value - value
        return replace(self, gain=gain / noise, relative_gain=gain / max(abs(value), SMALLEST_SCORE))


def fit(hypothesis: H, score: PointScore, start: Transform, levels: tuple[int, ...] = LEVELS) -> Candidate[H]:
    """The optimum of a hypothesis near a start (4, 4). score: of the frames as they look if it holds."""
    part = score.subset(POINTS, np.random.default_rng(0))
    T, value = refined(part, start, Limits(start, REACH), levels, TOLERANCE_DEG)
    return Candidate(score, T, hypothesis, value)


def freedom(score: PointScore) -> float:
    """Degrees of freedom of the noise of a score: the regions of all frames that show different places, with those that the usual
    noise counts for, less the unknowns."""
    return REGIONS * effective_frames(score) + USUAL_CELLS - UNKNOWNS - 1


def shows_noise(score: PointScore) -> bool:
    """Whether there are scenes enough to tell noise from what is wrong in one of them."""
    return effective_frames(score) >= INDEPENDENT


def evidence(match: Match) -> float:
    """What the points together say for a match: their score times how many there are, since other extrinsics see others."""
    return match.score.at(-1).value(match.T) * effective_points(match.score)


def log_odds(better: Match, other: Match | None) -> float:
    """Log-likelihood ratio of two matches of the same frames, by the noise at the better one; negative if it is none. other: None
    = nothing is in view.

    Student's distribution: few regions tell their own noise badly. Noise is inflated by the disagreement of halves.
    """
    score, T = better.score, better.T
    noise = noise_of(score, T, unlimited(T)) * inflation(disagreement(score, T, unlimited(T)))
    gain = (evidence(better) - (evidence(other) if other is not None else 0.0)) / effective_points(score) / noise
    degrees = freedom(score)
    return math.copysign(0.5 * (degrees + 1) * math.log1p(2 * abs(gain) / degrees), gain)


def convinces(log_ratio: float, prior_odds: float) -> bool:
    """Whether an explanation is more probable than another one by CONFIDENCE."""
    return math.log(prior_odds) + log_ratio >= math.log(CONFIDENCE / (1 - CONFIDENCE))


def rare_odds(tried: int) -> float:
    """Prior odds of one of so many explanations, all of which together are GROSSLY rare."""
    return GROSSLY / (1 - GROSSLY) / tried


def is_off(optimum: Match, covariance: Covariance, T_checked: Transform, tolerance: Tolerance) -> bool:
    """Whether an optimum convinces against every extrinsic within the tolerance of T_checked (4, 4). Its covariance (6, 6) tells
    where the best of these is, but knows one top of the score only."""
    part = optimum.score.subset(POINTS, np.random.default_rng(0))
    half = np.array([np.deg2rad(tolerance.deg)] * 3 + [tolerance.m] * 3)
    nearest = se3.exp(_nearest_within(se3.log(optimum.T @ se3.inverse(T_checked)), covariance, half)) @ T_checked
    limits, ends = Limits(T_checked, half / np.sqrt(3)), [nearest]
    for start, levels in product((T_checked, limits.clip(nearest)), (LEVELS, NEAR_LEVELS)):
        ends.append(refined(part, start, limits, levels, TOLERANCE_DEG)[0])
    best = max((Match(part, T) for T in ends), key=evidence)
    return convinces(log_odds(Match(part, optimum.T), best), EVEN)


def _nearest_within(error: Matrix, covariance: Covariance, half: Matrix) -> Matrix:
    """The twist (6,) whose rotation and shift are within half (6,), rad and m, that is nearest to an error (6,) by its covariance
    (6, 6): by the multipliers of both limits, found as a fixed point."""
    information, multipliers, twist = np.linalg.inv(covariance), half**-2.0, error
    for _ in range(ROUNDS):
        twist = np.linalg.solve(information + np.diag(multipliers), information @ error)
        sizes = np.repeat(np.linalg.norm(twist.reshape(2, 3), axis=1), 3)
        multipliers = np.maximum(multipliers, 1e-12) * (sizes / half) ** 2
    return twist * min(1.0, float((half / np.maximum(sizes, 1e-12)).min()))
