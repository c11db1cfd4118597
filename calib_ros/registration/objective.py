"""What the calibrator knows of an objective: the fast form and the thesis's eq. 3.12 behind one interface."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import Config
from calib_ros.frame import Frame
from calib_ros.registration.constraints import PoseConstraints, SearchBox, unlimited
from calib_ros.registration.covariance import SYSTEMATIC_ERROR
from calib_ros.registration.features import Features, FrameFeatures
from calib_ros.registration.optimizers import barzilai_borwein, levenberg_marquardt, nelder_mead
from calib_ros.registration.registry import ObjectiveKind
from calib_ros.registration.score import Atlas, FastScore, PointScore, Score, SmoothScore
from calib_ros.registration.search import SearchResult
from calib_ros.registration.search import search as global_search
from calib_ros.registration.validation import semantic_consistency_score
from calib_ros.semantics.segmentation import FrameSemantics

Matrix = NDArray[np.float64]
Report = Callable[[str, float], None]
FIRST_STEP_DEG = 3.2  # of simplexes and ascents on the coarsest level of a smooth score; half of it on the next, and so on
NEAR = (1, 2)  # levels to begin with, near the optimum
AFTER_SEARCH = 3  # the level to go on with after a search


class Objective(Protocol):
    """What is maximised, and how. T is T_camera_lidar (4, 4) throughout; report(stage, 0..1) tells progress.

    floor: standard deviations (6,) of its bias, rad and m. known: limits and prior, which search and ascents obey.
    """

    systematic_error: Matrix
    constraints: PoseConstraints

    def value(self, T: Matrix) -> float:
        """The score."""
        ...

    def frame_scores(self, T: Matrix) -> Matrix:
        """The score frame by frame (n_frames,)."""
        ...

    def search(self, T: Matrix, box: SearchBox, report: Report) -> SearchResult:
        """The best extrinsic in a box around T, to be climbed from."""
        ...

    def optimise(self, T: Matrix, searched: bool, report: Report) -> Matrix:
        """The optimum uphill from T. searched: T is the result of a search, and near."""
        ...

    def refine(self, T: Matrix, report: Report) -> Matrix:
        """The optimum right at T, on the finest level alone."""
        ...

    def smooth_score(self, T: Matrix) -> PointScore:
        """A score with a slope that equals, or approximates, the objective near T: for the covariance."""
        ...

    def exclude(self, frames: NDArray[np.intp]) -> None:
        """Leave frames out from now on."""
        ...

    def edge_score(self) -> PointScore:
        """The fast score, which tells whether LiDAR and image match at all."""
        ...

    def cross_check(self, T: Matrix, report: Report) -> str:
        """Why the optimum T may be no calibration; empty if nothing speaks against it."""
        ...


@dataclass(frozen=True, eq=False)
class WithPrior:
    """A score less the cost of a prior, for optimisers that know of no prior; a Score."""

    score: Score
    constraints: PoseConstraints

    def value(self, T: Matrix) -> float:
        """At T (4, 4)."""
        return self.score.value(T) - self.constraints.cost(T)


def smooth_ascent(
    score: SmoothScore, T: Matrix, step_deg: float, config: Config, constraints: PoseConstraints, tolerance_deg: float = 0.001
) -> Matrix:
    """By the configured optimiser, which is Levenberg-Marquardt where nothing is asked for."""
    evaluations, prior = 4 * config.search.simplex_evaluations, constraints.prior
    if config.refine.optimizer == "nelder_mead":
        return nelder_mead(score, T, step_deg, evaluations, None if prior is None else prior.value, constraints.limits)[0]
    if config.refine.optimizer == "barzilai_borwein":
        return barzilai_borwein(WithPrior(score, constraints), T, step_deg, evaluations=evaluations, limits=constraints.limits)[0]
    return levenberg_marquardt(score, T, config.refine.iterations, prior, constraints.limits, tolerance_deg, near=True)[0]


# The fast form as an objective: how it is searched and climbed.
LAST_OF_FEW = 3  # up to this level some of the points are enough; the finer ones decide
COARSE_TOLERANCE_DEG = 0.01  # where a level need not be climbed to the very top, since a finer one follows


class FastObjective:
    """Oriented edges of sparse points. atlas: of the features, if there is one. Raises TooFewFeaturesError when there are too
    few points."""

    systematic_error = SYSTEMATIC_ERROR

    def __init__(
        self,
        features: Sequence[FrameFeatures],
        T_prior: Matrix,
        config: Config,
        constraints: PoseConstraints | None = None,
        atlas: Atlas | None = None,
    ) -> None:
        self.features, self.config, self.constraints = list(features), config, constraints or PoseConstraints(unlimited(T_prior))
        self.score = self.scored(T_prior, atlas)
        self.left_out: list[int] = []

    def scored(self, T: Matrix, atlas: Atlas | None, margin: float | None = None) -> PointScore:
        """The score of all frames with the points that are near the image at T; as FastScore."""
        return FastScore(self.features, T, self.config.score, margin, atlas)

    def value(self, T: Matrix) -> float:
        """Score on the finest level."""
        return self.score.at(-1).value(T)

    def frame_scores(self, T: Matrix) -> Matrix:
        """Score frame by frame; NaN without edge points, or left out."""
        return self.score.frame_scores(T)

    def search(self, T: Matrix, box: SearchBox, report: Report) -> SearchResult:
        """See search.search; with the points that may come into view anywhere in the box."""
        camera, (deg, m) = self.score.camera, box.reach
        reach = 1.6 * camera.K[0, 0] / camera.width * (np.tan(np.deg2rad(deg)) + m / 5)
        margin = max(self.config.score.margin, float(reach))
        score = self.scored(T, self.score.atlas, margin)
        return global_search(
            score,
            T,
            box,
            self.config.search,
            self.constraints.limits,
            self.config.refine.min_peak_ratio,
            self.constraints.prior,
            lambda share: report("search", share),
            self.guide(),
        )

    def guide(self) -> PointScore | None:
        """What the classes of the frames tell; None if they do not, or are not to be asked."""
        views = [f.view for f in self.features if f.view is not None]
        return semantic_consistency_score(views) if self.config.semantics.consistency_check else None

    def optimise(self, T: Matrix, searched: bool, report: Report) -> Matrix:
        """Level by level. From 1.5 deg / 15 cm per axis, starting at 8 px instead of the next level lifts the success of
        Levenberg-Marquardt from 14 to 19 of 20 on KITTI. But a scene seen again and again may have its optimum on the coarse
        level elsewhere: from 0.3 deg / 3 cm, 15 of 30 runs of consecutive frames climbed away. So both, unless after a search.
        """
        few = self.score.subset(self.config.search.middle_points, np.random.default_rng(self.config.search.seed))
        ends = [self._approach(few, first, T) for first in ((AFTER_SEARCH,) if searched else NEAR)]
        T = max(ends, key=lambda end: self.value(end) - self.constraints.cost(end))
        # Which points are near the image, and so their weights, must not depend on where the climb began.
        self.score = self.scored(T, self.score.atlas)
        if self.left_out:
            self.score = self.score.select(~np.isin(self.score.frame, self.left_out))
        return self._ascent(self.score, self.score.n_levels - 1, T)

    def _approach(self, few: PointScore, first: int, T: Matrix) -> Matrix:
        """Up to the last level but one."""
        for level in range(first, self.score.n_levels - 1):
            T = self._ascent(few if level <= LAST_OF_FEW else self.score, level, T)
        return T

    def _ascent(self, score: PointScore, level: int, T: Matrix) -> Matrix:
        last = level == score.n_levels - 1
        tolerance = 0.001 if last else COARSE_TOLERANCE_DEG
        return smooth_ascent(score.at(level), T, FIRST_STEP_DEG / 2**level, self.config, self.constraints, tolerance)

    def exclude(self, frames: NDArray[np.intp]) -> None:
        """Leave frames out from now on."""
        self.left_out += [int(j) for j in frames]
        self.constraints = self.constraints.with_frames(max(len(self.features) - len(self.left_out), 1))
        self.score = self.score.select(~np.isin(self.score.frame, frames))

    def refine(self, T: Matrix, report: Report) -> Matrix:
        """On the finest level alone; with all frames again, and the points that are near the image there."""
        self.left_out, self.constraints = [], self.constraints.with_frames(len(self.features))
        self.score = self.scored(T, self.score.atlas)
        return self._ascent(self.score, self.score.n_levels - 1, T)

    def smooth_score(self, T: Matrix) -> PointScore:
        """The score itself."""
        return self.score

    def edge_score(self) -> PointScore:
        """The score itself."""
        return self.score

    def cross_check(self, T: Matrix, report: Report) -> str:
        """None by itself."""
        return ""


class _Fast:
    """The fast form in the registry of objectives."""

    def features(
        self,
        frame: Frame,
        image: NDArray[np.uint8],
        fast: FrameFeatures,
        edges: NDArray[np.float32] | None,
        semantics: FrameSemantics | None,
        config: Config,
    ) -> FrameFeatures:
        return fast

    def objective(
        self, features: Sequence[Features], T_prior: Matrix, config: Config, constraints: PoseConstraints, atlas: Atlas | None
    ) -> FastObjective:
        return FastObjective([f.fast for f in features], T_prior, config, constraints, atlas)


FAST: ObjectiveKind = _Fast()
