"""Global search in a box around the prior: evenly spread starts in all six degrees of freedom, successive halving, in rounds.

A round: starts of every seeding strategy -> their optima on the coarse levels -> the best polished by simplex -> the best of
these refined with all points -> the neighbourhood of the best one. Rounds go on until independent starts agree on the best
optimum and this stands out from what the same search finds in a decoy, the mirrored edge maps of the same frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib_ros import se3
from calib_ros.arrays import Matrix, Transform
from calib_ros.config import SearchConfig
from calib_ros.registration.progress import SILENT, Progress
from calib_ros.registration.score.chance import UNDOUBTED_Z, EvenPoints, null_distribution, p_value
from calib_ros.registration.score.point_score import PointScore
from calib_ros.registration.search.constraints import Limits, Prior, SearchBox
from calib_ros.registration.search.optimizers import levenberg_marquardt, nelder_mead
from calib_ros.registration.search.parallel import SERIAL, Workers

# What users set is in SearchConfig; these belong to the method. Levels count from the coarsest, 0.
# Seeding. Levels where starts are ranked and optimised first: the two coarsest find 49 of 80 KITTI frames, all three 66; in wide
# boxes starts lie farther apart than the basins of level 2, where none of 540 ends at the truth.
SEED_LEVELS, WIDE_SEED_LEVELS = (0, 1, 2), (0, 1)
GUIDE_LEVEL = 2  # of classes and of edges, for starts ranked by classes: 29 of 36 hard trials, 27 with level 1, 26 without them
FIRST_POINTS, GUIDE_POINTS = 1500, 1500  # edge points and points of classes: enough to rank starts
# Starts are scored on few points, the best of them again on more: of 54 hard searches 25 find the truth with 256 starts, 44 with
# 1024, 49 with 4096. Larger boxes than BASE_BOX get more starts, by the root of their volume.
RANKING_POINTS, BEST_RANKED = 300, 1024
BASE_BOX, MOST_TIMES = np.array([np.deg2rad(5.0)] * 3 + [0.3] * 3), 16  # rad, m
SAME_START = 0.12  # of the half width: starts nearer than this on all axes count as one
DISTINCT, CLIMBED = 20, 10  # distinct best starts optimised on the seed level, and of their ends those optimised on the next
BATCH = 256  # starts that are scored between two reports of progress

# Staying in the box.
PRIOR_STRENGTH = 0.03  # of the score at one box half width: keeps weak directions inside the box, does not move strong ones
BOX_STRENGTH = 2.0  # penalty per squared half width beyond 110 % of the box
REFINED = np.array([np.deg2rad(1.5)] * 3 + [0.15] * 3)  # rad, m; how far an axis is refined that is not searched

# Optima.
COARSE_POINTS, MIDDLE_POINTS = 5000, 15000  # edge points on the coarse levels and for the simplex: few miss a narrow optimum
POLISHED, FINALISTS = 2, 2  # optima of a round that the simplex polishes, and those compared on the finest level by all points
SIMPLEX_EVALUATIONS = 120  # of the score: by then a simplex of SIMPLEX_DEG has shrunk to the optimum
SAME_OPTIMUM_DEG = 0.5  # optima nearer than this (10 cm count as 0.5 deg) count as one
SIMPLEX_DEG = {2: 0.8, 3: 0.4}  # first simplex on the middle levels
FINE_LEVELS = (3, 4)
NEARBY = np.array([np.deg2rad(1.5)] * 3 + [0.4] * 3)  # rad, m; neighbouring optima lay 0.8 deg / 0.36 m from the truth
NEARBY_STARTS, NEARBY_OPTIMISED = 256, 8
MIN_IMPROVEMENT = 0.02  # share of the score: by less, neighbours differ by chance; the better one was as often wrong

# Ending.
AGREEMENT = 3  # independent starts that must reach the best optimum: two may do so by chance
# So many rounds, and starts agree on an optimum that is no better than chance: more rounds hardly find another. Or they do not
# agree in a wide box: then half of it is searched around the best optimum so far, which may share some edges with the truth.
FRUITLESS_ROUNDS = 3
# After so many, starts so close have met the truth; where none agree, and a decoy matches as well, nothing matches.
HOPELESS_ROUNDS = 2
WIDE_DEG, WIDE_M = 5.0, 0.3


@dataclass(frozen=True, eq=False)
class SearchResult:
    """The best extrinsic T (4, 4) of a search. agreed: of `optimised` independent starts, how many ended there. rounds: how many
    it took. decoy_z: z-score of the best optimum of the decoy; None where there was no doubt and none was searched. nearby:
    optima (4, 4) around T, whatever they score."""

    T: Transform
    agreed: int
    optimised: int
    rounds: int
    decoy_z: float | None = None
    nearby: tuple[Matrix, ...] = ()


def search(
    score: PointScore,
    T_prior: Transform,
    box: SearchBox,
    config: SearchConfig,
    limits: Limits,
    max_p_value: float,
    user_prior: Prior | None = None,
    progress: Progress = SILENT,
    guide: PointScore | None = None,
) -> SearchResult:
    """The best extrinsic in the box by the score's finest level.

    limits: axes that are fixed or bounded. max_p_value: of the best optimum against the decoy; the search goes on while it is
    larger. user_prior: a prior on the extrinsic. progress: slower with every round, since their number is not known. guide:
    another score that ranks starts of a strategy of its own.
    Deterministic for a given config.seed, whatever config.threads.
    """
    with Workers(config.threads) as workers:
        optima = Rounds(score, T_prior, box, config, limits, user_prior, guide, workers)
        decoy_z: float | None = None
        for number in range(box.rounds or config.rounds):
            optima.add_round(progress.part(1 - 0.5**number, 1 - 0.5 ** (number + 1)))
            best, agreed = optima.best()
            z_score = null_distribution(score, best).z_score
            if z_score < UNDOUBTED_Z and decoy_z is None:
                decoy_z = search_decoy(score, T_prior, box, config, limits, user_prior)
            significant = p_value(z_score, decoy_z, number + 1) <= max_p_value
            if agreed >= AGREEMENT and (significant or number + 1 >= FRUITLESS_ROUNDS):
                break
            no_better = decoy_z is not None and z_score <= decoy_z
            if number + 1 >= HOPELESS_ROUNDS and agreed < AGREEMENT and no_better and not is_wide(box):
                break
            if number + 1 == FRUITLESS_ROUNDS and agreed < AGREEMENT and is_wide(box):
                half = box.scaled(0.5, FRUITLESS_ROUNDS)
                closer = search(score, best, half, config, limits, max_p_value, user_prior, guide=guide)
                rounds = closer.rounds + number + 1
                z_score = null_distribution(score, closer.T).z_score
                significant = p_value(z_score, decoy_z if closer.decoy_z is None else closer.decoy_z, rounds) <= max_p_value
                before = score.at(-1).value(best)
                worse = score.at(-1).value(closer.T) < before - MIN_IMPROVEMENT * abs(before)
                if closer.agreed >= AGREEMENT and significant and not worse:
                    return replace(closer, optimised=closer.optimised + optima.optimised, rounds=rounds)
        progress(1.0)
        return SearchResult(best, agreed, optima.optimised, number + 1, decoy_z, optima.nearby)


def is_wide(box: SearchBox) -> bool:
    """Whether a start in the box may end at an optimum that shares some edges with the best one. Not one of few rounds."""
    deg, m = box.reach
    return box.rounds is None and (deg > WIDE_DEG or m > WIDE_M)


def search_decoy(
    score: PointScore, T: Transform, box: SearchBox, config: SearchConfig, limits: Limits, user_prior: Prior | None = None
) -> float:
    """z-score of the best extrinsic that a round of the same search finds in a decoy, the mirrored maps: no true alignment."""
    decoy = score.mirrored()
    return null_distribution(decoy, search_once(decoy, T, box, config, limits, user_prior)).z_score


def search_once(
    score: PointScore, T: Transform, box: SearchBox, config: SearchConfig, limits: Limits, user_prior: Prior | None = None
) -> Matrix:
    """The best extrinsic (4, 4) of one round, whether or not it stands out from chance."""
    with Workers(config.threads) as workers:
        optima = Rounds(score, T, box, config, limits, user_prior, workers=workers)
        optima.add_round()
        return optima.best()[0]


# Of seeding: starts are ranked by the first score, the best of them by the second, on the level, from which they are optimised.
Strategy = tuple[PointScore, PointScore, int]


@dataclass(eq=False)
class Optimum:
    """An optimum of the coarse levels, polished once it is among the best. count: starts that ended here. coarse_T: where it was
    before it was polished; None until it is. final: with all points, and its penalised score; None until it is a finalist."""

    value: float
    T: Transform
    count: int = 1
    coarse_T: Transform | None = None
    final: tuple[Matrix, float] | None = None


class Rounds:
    """A search, round by round: the box, the score on fewer and fewer points, the sequence that all starts are drawn from,
    and the optima so far.

    strategies: by the edges on every seed level, and by the guide if there is one. optimised: starts followed to the end. nearby:
    optima (4, 4) around the best.
    """

    def __init__(
        self,
        score: PointScore,
        T_prior: Transform,
        box: SearchBox,
        config: SearchConfig,
        limits: Limits,
        user_prior: Prior | None = None,
        guide: PointScore | None = None,
        workers: Workers = SERIAL,
    ) -> None:
        rng = np.random.default_rng(config.seed)
        self.score, self.config, self.limits, self.T_prior, self.workers = score, config, limits, T_prior, workers
        self.first = score.subset(FIRST_POINTS, rng)
        self.coarse, self.middle = score.subset(COARSE_POINTS, rng), score.subset(MIDDLE_POINTS, rng)

        def fewer(score: PointScore, points: int) -> PointScore:
            return score.subset(points, np.random.default_rng(config.seed))

        ranking = fewer(self.first, RANKING_POINTS)
        levels = WIDE_SEED_LEVELS if is_wide(box) else SEED_LEVELS
        self.strategies: list[Strategy] = [(ranking, self.first, level) for level in levels]
        if guide is not None:
            guide = fewer(guide, GUIDE_POINTS)
            self.strategies.append((fewer(guide, RANKING_POINTS), guide, GUIDE_LEVEL))
        self.half = np.where(limits.open_axes, box.half_width(), 0.0)
        self.width = np.where(self.half > 0, self.half, REFINED)
        self.box_prior = Prior(T_prior, PRIOR_STRENGTH / self.width**2)
        self.user_prior, self._inverse_prior = user_prior, se3.inverse(T_prior)
        self._points = EvenPoints(6, seed=config.seed)
        self.optimised = self._rounds = 0
        self._all: list[Optimum] = []
        self._polished: list[Optimum] = []
        self.nearby: tuple[Matrix, ...] = ()
        self._near: tuple[Matrix, Matrix] | None = None  # a finalist, and the best extrinsic near it

    def penalty(self, T: Transform) -> float:
        """Of leaving the box, and the cost of the user's prior."""
        excess = np.maximum(np.abs(se3.log(T @ self._inverse_prior)) / self.width - 1.1, 0)
        return BOX_STRENGTH * float(excess @ excess) + (self.user_prior.cost(T)[0] if self.user_prior else 0.0)

    def add_round(self, progress: Progress = SILENT) -> None:
        """Starts of every strategy, their optima, and the best of these polished."""
        for k, strategy in enumerate(self.strategies):
            own = progress.part(0.6 * k / len(self.strategies), 0.6 * (k + 1) / len(self.strategies))
            starts = self.seed_starts(strategy, self._rounds == 0, own.part(0, 0.25))
            self._optimise(starts, strategy[2], own.part(0.25, 1))

        def polish(optimum: Optimum) -> None:
            """On the middle levels, by simplex: it is robust where the slope misleads."""
            optimum.coarse_T = optimum.T
            for level, step in SIMPLEX_DEG.items():
                score = self.middle.at(level)
                optimum.T, optimum.value = nelder_mead(score, optimum.T, step, SIMPLEX_EVALUATIONS, self.penalty, self.limits)

        waiting = sorted((o for o in self._all if o.coarse_T is None), key=lambda o: -o.value)[:POLISHED]
        for k, _ in enumerate(self.workers.map(polish, waiting)):
            progress(0.6 + 0.3 * (k + 1) / len(waiting))
        self._polished += waiting
        self._polished.sort(key=lambda o: -o.value)
        self._rounds += 1

    def best(self) -> tuple[Matrix, int]:
        """The best extrinsic (4, 4) so far, and how many starts ended there."""
        unfinished = [o for o in self._polished[:FINALISTS] if o.final is None]
        for k, final in enumerate(self.workers.map(lambda o: self._finish(o.T), unfinished)):
            unfinished[k].final = final
        # Starts of later rounds may have ended there, too.
        finalists = [(*o.final, o.count) for o in self._polished if o.final is not None]
        top, value, _ = max(finalists, key=lambda f: f[1])
        if self._near is None or self._near[0] is not top:  # often the last round's, whose neighbourhood is known
            found, ends = self._search_nearby(top, value)
            self._near, self.nearby = (top, found), (*(T for T, _, _ in finalists), *ends)
        best = self._near[1]
        return best, sum(count for T, _, count in finalists if _same(T, best) or _same(T, top))

    def seed_starts(self, strategy: Strategy, with_prior: bool, progress: Progress = SILENT) -> list[Matrix]:
        """The best starts by a strategy that differ. with_prior: the centre of the box is among the candidates."""
        (ranking, score, level), searched = strategy, self.half > 0
        times = float(np.sqrt(np.prod(self.half[searched] / BASE_BOX[searched])))
        n = int(self.config.starts * np.clip(times, 1, MOST_TIMES))
        unit = self._points.next(1 << (n - 1).bit_length())  # (n, 6) of the box, -1..1
        if len(unit) > BEST_RANKED:
            ranked = self._score_starts(ranking, level, unit, progress.part(0, 0.7))
            unit = unit[np.sort(np.argsort(-ranked, kind="stable")[:BEST_RANKED])]
        if with_prior:
            unit = np.vstack([np.zeros(6), unit])
        scores = self._score_starts(score, level, unit, progress.part(0.7, 1))
        picked: list[int] = []
        for k in np.argsort(-scores, kind="stable"):
            if not picked or (np.abs(unit[k] - unit[picked]).max(axis=1) > SAME_START).all():
                picked.append(int(k))
                if len(picked) == DISTINCT:
                    break
        return [self.limits.clip(se3.exp(unit[k] * self.half) @ self.T_prior) for k in picked]

    def _score_starts(self, score: PointScore, level: int, unit: Matrix, progress: Progress = SILENT) -> Matrix:
        """Scores (n,) of starts (n, 6) in units of the box."""

        def scores_of(k: int) -> Matrix:
            return score.values(se3.exp_many(unit[k : k + BATCH] * self.half) @ self.T_prior, level)

        batches, scores = range(0, len(unit), BATCH), np.empty(len(unit))
        for k, batch in zip(batches, self.workers.map(scores_of, batches), strict=True):
            scores[k : k + BATCH] = batch
            progress(k / len(unit))
        return scores

    def _optimise(self, starts: Sequence[Matrix], level: int, progress: Progress) -> None:
        """Add the optima of the coarse levels that the starts lead to, the worse part of them dropped after the first level."""

        def first(start: Transform) -> tuple[float, Matrix]:
            T = self._coarse_optimum(self.first, level, start, tolerance_deg=0.05)
            return self.coarse.at(1).value(T) - self.penalty(T), T

        def climbed(T: Transform) -> tuple[float, Matrix]:
            for own in range(max(level, 1), 3):
                T = self._coarse_optimum(self.coarse, own, T, tolerance_deg=0.02)
            return self.coarse.at(2).value(T) - self.penalty(T), T

        ends: list[tuple[float, Matrix]] = []
        for end in self.workers.map(first, starts):
            ends.append(end)
            progress(0.5 * len(ends) / len(starts))
        ends.sort(key=lambda end: -end[0])
        kept = [T for _, T in ends[:CLIMBED]]
        for k, (value, T) in enumerate(self.workers.map(climbed, kept)):
            for other in self._all:
                if _same(T, other.coarse_T if other.coarse_T is not None else other.T):
                    other.count += 1
                    if value > other.value and other.coarse_T is None:
                        other.value, other.T = value, T
                    break
            else:
                self._all.append(Optimum(value, T))
            progress(0.5 + 0.5 * (k + 1) / len(kept))
        self.optimised += len(kept)

    def _finish(self, T: Transform) -> tuple[Matrix, float]:
        """On the fine levels with all points: the extrinsic, and its penalised score."""
        value = 0.0
        for level in FINE_LEVELS:
            T, value = levenberg_marquardt(self.score.at(level), T, 20, self.user_prior, self.limits, tolerance_deg=0.01)
        return T, value - self.penalty(T)

    def _search_nearby(self, top: Transform, value: float) -> tuple[Matrix, list[Matrix]]:
        """Something better near the best finalist (4, 4), beyond a ridge, else itself; and all optima that were met."""
        best, ends = top, [top]
        half = np.where(self.half > 0, NEARBY, 0.0)
        candidates = se3.exp_many(EvenPoints(6, seed=self.config.seed).next(NEARBY_STARTS) * half) @ top
        order = np.argsort(-self.coarse.values(candidates, 2), kind="stable")

        def optimum_from(k: int) -> tuple[Matrix, float]:
            start = self.limits.clip(candidates[k])
            return self._finish(self._coarse_optimum(self.coarse, 2, start, tolerance_deg=0.02))

        for end, reached in self.workers.map(optimum_from, order[:NEARBY_OPTIMISED].tolist()):
            ends.append(end)
            if reached > value + MIN_IMPROVEMENT * abs(value):
                best, value = end, reached
        return best, ends

    def _coarse_optimum(self, score: PointScore, level: int, T: Transform, tolerance_deg: float) -> Transform:
        return levenberg_marquardt(score.at(level), T, 8, self.box_prior, self.limits, tolerance_deg)[0]


def _same(A: Matrix, B: Matrix) -> bool:
    gap = se3.log(A @ se3.inverse(B))
    return bool(np.linalg.norm(np.concatenate([np.rad2deg(gap[:3]), 5 * gap[3:]])) <= SAME_OPTIMUM_DEG)
