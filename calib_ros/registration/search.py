"""Global search in a box around the prior: Sobol starts in all six degrees of freedom, successive halving, in rounds.

Rotation-only grids lose the truth under half a metre of translation; false optima above the truth are rare once edges
are oriented, so that what decides is the number of starts. How many are enough depends on the box and on the scenes: the
search goes on, round by round, until independent starts agree on the best optimum.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from calib_ros import se3
from calib_ros.config import SearchConfig
from calib_ros.registration.constraints import Limits, Prior, SearchBox
from calib_ros.registration.optimizers import levenberg_marquardt, nelder_mead
from calib_ros.registration.score import PointScore
from calib_ros.registration.validation import null_distribution

Matrix = NDArray[np.float64]
PRIOR_STRENGTH = 0.03  # of the score at one box half width: keeps weak directions inside the box, does not move strong ones
BOX_STRENGTH = 2.0  # penalty per squared half width beyond 110 % of the box
SAME_START = 0.12  # of the half width: starts nearer than this on all axes count as one
SAME_OPTIMUM_DEG = 0.5  # optima nearer than this (10 cm count as 0.5 deg) count as one
HOPELESS = 0.9  # share of all starts that ended at an optimum which is no better than chance: more will, too
DOUBT = 0.3  # of one frame: that much more distinct has to be what few frames show, for the search to end early
UNMISTAKABLE = 1.5  # times the distinctness needed: this good, found once is enough
# Levels where starts are scored and begin to climb. Coarse ones have wide basins, but some scenes lead astray there; from
# 5 deg / 0.3 m with one frame of two KITTI drives, 49 of 80 end at the truth with the two coarsest, 66 with all three.
FAMILIES = (0, 1, 2)
# The level, of classes and of edges, of starts that are chosen by classes: of 36 trials with 12 KITTI frames, most of them hard,
# 26 searches end near the truth without such starts, 27 with level 1, 29 with 2, at about the same CPU time.
GUIDED = 2
GUIDE_POINTS = 1500  # as first_points: enough to rank starts
NEARBY = np.array([np.deg2rad(1.5)] * 3 + [0.4] * 3)  # rad, m; neighbouring optima lay 0.8 deg / 0.36 m from the truth
NEARBY_STARTS, NEARBY_CLIMBED = 256, 8
CLEARLY = 0.02  # of the score: by less, neighbours differ for no reason, and the better of them was as often the wrong one
REFINED = np.array([np.deg2rad(1.5)] * 3 + [0.15] * 3)  # rad, m; how far an axis is refined that is not searched
SIMPLEX_DEG = (0.8, 0.4)  # first simplex on the middle levels


@dataclass(frozen=True, eq=False)
class SearchResult:
    """The best extrinsic T (4, 4) of a search. agreed: of `climbed` independent starts, how many ended there. rounds: how many
    it took."""

    T: Matrix
    agreed: int
    climbed: int
    rounds: int


@dataclass(eq=False)
class _Optimum:
    """An optimum of the coarse levels; polished once it is among the best. count: starts that ended here."""

    value: float
    T: Matrix
    count: int = 1
    polished: bool = False
    coarse_T: Matrix | None = None
    final: Matrix | None = None
    final_value: float = -np.inf


class _Search:
    def __init__(
        self,
        score: PointScore,
        T_prior: Matrix,
        box: SearchBox,
        config: SearchConfig,
        limits: Limits,
        user_prior: Prior | None,
        guide: PointScore | None = None,
    ) -> None:
        rng = np.random.default_rng(config.seed)
        self.score, self.config, self.limits, self.T_prior = score, config, limits, T_prior
        self.first = score.subset(config.first_points, rng)
        self.coarse, self.middle = score.subset(config.coarse_points, rng), score.subset(config.middle_points, rng)
        self.guide = None if guide is None else guide.subset(GUIDE_POINTS, np.random.default_rng(config.seed))
        self.half = np.where(limits.open_axes, box.half_width(), 0.0)
        self.width = np.where(self.half > 0, self.half, REFINED)
        self.prior = Prior(T_prior, PRIOR_STRENGTH / self.width**2)
        self.user_prior, self.inverse_prior = user_prior, se3.inverse(T_prior)
        self.sobol = qmc.Sobol(6, seed=config.seed)
        self.optima: list[_Optimum] = []

    def penalty(self, T: Matrix) -> float:
        """Of leaving the box, and of what the user knows."""
        excess = np.maximum(np.abs(se3.log(T @ self.inverse_prior)) / self.width - 1.1, 0)
        return BOX_STRENGTH * float(excess @ excess) + (self.user_prior.cost(T)[0] if self.user_prior else 0.0)

    def starts(self, score: PointScore, level: int, first_round: bool, report: Callable[[float], None]) -> list[Matrix]:
        """The best starts of a family that differ, by a level of a score; the prior itself is among the first."""
        config, n = self.config, 1 << (self.config.starts - 1).bit_length()  # Sobol is balanced at powers of two only
        unit = self.sobol.random(n) * 2 - 1
        if first_round:
            unit = np.vstack([np.zeros(6), unit])
        scores = np.empty(len(unit))
        for k in range(0, len(unit), 256):
            transforms = se3.exp_many(unit[k : k + 256] * self.half) @ self.T_prior
            scores[k : k + 256] = score.values(transforms, level)
            report(k / len(unit))
        picked: list[int] = []
        for k in np.argsort(-scores, kind="stable"):
            if not picked or (np.abs(unit[k] - unit[picked]).max(axis=1) > SAME_START).all():
                picked.append(int(k))
                if len(picked) == config.distinct:
                    break
        return [self.limits.clip(se3.exp(unit[k] * self.half) @ self.T_prior) for k in picked]

    def optimise(self, starts: list[Matrix], level: int, report: Callable[[float], None]) -> int:
        """From starts to optima of the coarse levels, the worse part dropped after the coarsest; how many were left."""
        kept: list[tuple[float, Matrix]] = []
        for k, T in enumerate(starts):
            T, _ = levenberg_marquardt(self.first.at(level), T, 8, self.prior, self.limits, tolerance_deg=0.05)
            kept.append((self.coarse.at(1).value(T) - self.penalty(T), T))
            report(0.5 * (k + 1) / len(starts))
        kept.sort(key=lambda x: -x[0])
        kept = kept[: self.config.climbed]
        for k, (_, T) in enumerate(kept):
            for own in range(max(level, 1), 3):
                T, _ = levenberg_marquardt(self.coarse.at(own), T, 8, self.prior, self.limits, tolerance_deg=0.02)
            self.add(T)
            report(0.5 + 0.5 * (k + 1) / len(kept))
        return len(kept)

    def add(self, T: Matrix) -> None:
        """An optimum of the coarse levels to those found."""
        found = _Optimum(self.coarse.at(2).value(T) - self.penalty(T), T)
        for other in self.optima:
            if _same(T, other.coarse_T if other.coarse_T is not None else other.T):
                other.count += 1
                if found.value > other.value and not other.polished:
                    other.value, other.T = found.value, T
                return
        self.optima.append(found)

    def search_nearby(self, best: Matrix, value: float) -> Matrix:
        """Something better near the best optimum, where a ridge may have parted a start from the top; else the best itself."""
        half = np.where(self.half > 0, NEARBY, 0.0)
        around = se3.exp_many((qmc.Sobol(6, seed=self.config.seed).random(NEARBY_STARTS) * 2 - 1) * half) @ best
        order = np.argsort(-self.coarse.values(around, 2), kind="stable")
        for k in order[:NEARBY_CLIMBED]:
            T, _ = levenberg_marquardt(self.coarse.at(2), self.limits.clip(around[k]), 8, self.prior, self.limits, 0.02)
            other = _Optimum(0.0, T)
            self.finish(other)
            if other.final is not None and other.final_value > value + CLEARLY * abs(value):
                value, best = other.final_value, other.final
        return best

    def polish(self, optimum: _Optimum) -> None:
        """On the middle levels, by simplex: it is robust where the slope misleads."""
        optimum.coarse_T = optimum.T
        for level, step in zip((2, 3), SIMPLEX_DEG, strict=True):
            optimum.T, optimum.value = nelder_mead(
                self.middle.at(level), optimum.T, step, self.config.simplex_evaluations, self.penalty, self.limits
            )
        optimum.polished = True

    def finish(self, optimum: _Optimum) -> None:
        """On the fine levels with all points."""
        if optimum.final is None:
            T = optimum.T
            for level in (3, 4):
                T, value = levenberg_marquardt(self.score.at(level), T, 20, self.user_prior, self.limits, tolerance_deg=0.01)
            optimum.final, optimum.final_value = T, value - self.penalty(T)


def search(
    score: PointScore,
    T_prior: Matrix,
    box: SearchBox,
    config: SearchConfig,
    limits: Limits,
    min_distinctness: float,
    user_prior: Prior | None = None,
    progress: Callable[[float], None] | None = None,
    guide: PointScore | None = None,
) -> SearchResult:
    """The best extrinsic in the box by the score's second finest level; to be refined on the finest one.

    limits: axes that are fixed or bounded. min_distinctness: less than this is chance. known: a prior of the user's. progress:
    called with 0..1, slower with every round, for nobody knows how many it takes. guide: another score that tells where more
    starts are worth while. Deterministic for a given config.seed.
    """
    report = progress or (lambda share: None)

    def within(first: float, last: float) -> Callable[[float], None]:
        """Progress of a part of the round, as progress of the whole."""
        return lambda share: report(1 - (1 - 0.5 * (first + (last - first) * share)) / 2**number)

    run = _Search(score, T_prior, box, config, limits, user_prior, guide)
    families = [(run.first, level, level) for level in FAMILIES]
    if run.guide is not None:
        families.append((run.guide, GUIDED, GUIDED))
    share = 0.6 / len(families)
    polished: list[_Optimum] = []
    climbed = number = 0
    for number in range(box.rounds or config.rounds):
        for k, (told_by, at, level) in enumerate(families):
            starts = run.starts(told_by, at, number == 0, within(share * k, share * (k + 0.25)))
            climbed += run.optimise(starts, level, within(share * (k + 0.25), share * (k + 1)))
        waiting = sorted((o for o in run.optima if not o.polished), key=lambda o: -o.value)[: config.refined]
        for k, optimum in enumerate(waiting):
            run.polish(optimum)
            polished.append(optimum)
            within(0.6, 0.9)((k + 1) / len(waiting))
        polished.sort(key=lambda o: -o.value)
        for optimum in polished[: config.finalists]:
            run.finish(optimum)
        finished = [(o.final_value, o.final, o.count) for o in polished if o.final is not None]
        value, top, _ = max(finished, key=lambda x: x[0])
        best = run.search_nearby(top, value)
        agreed = sum(count for _, final, count in finished if _same(final, best) or _same(final, top))
        # A wrong optimum with a wide basin is found often too, but it hardly stands out of its surroundings.
        clear = null_distribution(score, best).peak_ratio / max(min_distinctness * (1 + DOUBT / score.n_frames), 1e-9)
        if clear >= (1.0 if agreed >= config.agreement else UNMISTAKABLE):
            break
        if number and agreed > HOPELESS * climbed:
            break
    report(1.0)
    return SearchResult(best, agreed, climbed, number + 1)


def _same(A: Matrix, B: Matrix) -> bool:
    gap = se3.log(A @ se3.inverse(B))
    return bool(np.linalg.norm(np.concatenate([np.rad2deg(gap[:3]), 5 * gap[3:]])) <= SAME_OPTIMUM_DEG)
