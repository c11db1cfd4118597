"""A hypothesis at its optimum: what is assumed, the extrinsic that matches best under it, and how well it does."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Generic, Protocol, TypeVar

import numpy as np
from scipy.special import ndtri

from calib_ros.arrays import Transform
from calib_ros.registration.acceptance.significance import null_distribution
from calib_ros.registration.nuisance.parameters import LEVELS, POINTS, REACH, TOLERANCE_DEG, refined
from calib_ros.registration.score.point_score import PointScore
from calib_ros.registration.search.constraints import Limits

SMALLEST_SCORE = 1e-9
FALSE_ALARMS = 0.01  # share of right cameras that may be taken for another one
PARAMETER_PENALTY = 3.0  # log-likelihood that one more unknown costs: about as many values can be told apart


class CheckHypothesis(Protocol):
    """What may differ from the claim. unknowns: how many things. min_relative_gain: share of the score that it has to gain."""

    @property
    def unknowns(self) -> int: ...

    @property
    def min_relative_gain(self) -> float: ...


H = TypeVar("H", bound=CheckHypothesis)


@dataclass(frozen=True, eq=False)
class Candidate(Generic[H]):
    """A hypothesis at its optimum.

    T: (4, 4), the optimum. score: of the frames as they look if the hypothesis holds; value: of the score there. gain: in
    log-likelihood, over what is claimed; relative_gain: the same, as a share of the score. tried: of how many candidates it is
    the best. parts: log-likelihood that is lost without each of the things that the hypothesis changes.
    """

    hypothesis: H
    T: Transform
    score: PointScore
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
    return Candidate(hypothesis, T, score, value)
