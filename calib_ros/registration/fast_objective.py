"""The fast form as an objective: how it is searched and climbed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import Config
from calib_ros.registration.atlas import Atlas
from calib_ros.registration.constraints import Known, unlimited
from calib_ros.registration.fast_score import FastScore
from calib_ros.registration.frame_features import FrameFeatures
from calib_ros.registration.objectives import AFTER_SEARCH, FIRST_STEP_DEG, NEAR, Report, smooth_ascent
from calib_ros.registration.point_score import PointScore
from calib_ros.registration.search import Found
from calib_ros.registration.search import search as global_search
from calib_ros.registration.search_box import SearchBox
from calib_ros.registration.uncertainty import FLOOR
from calib_ros.registration.witness import class_witness

Matrix = NDArray[np.float64]
LAST_OF_FEW = 3  # up to this level some of the points are enough; the finer ones decide
COARSE_TOLERANCE_DEG = 0.01  # where a level need not be climbed to the very top, since a finer one follows


class FastObjective:
    """Oriented edges of sparse points. atlas: of the features, if there is one. Raises TooFewFeaturesError when there are too
    few points."""

    floor = FLOOR

    def __init__(
        self,
        features: Sequence[FrameFeatures],
        T_prior: Matrix,
        config: Config,
        known: Known | None = None,
        atlas: Atlas | None = None,
    ) -> None:
        self.features, self.config, self.known = list(features), config, known or Known(unlimited(T_prior))
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

    def search(self, T: Matrix, box: SearchBox, report: Report) -> Found:
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
            self.known.limits,
            self.config.refine.min_distinctness,
            self.known.prior,
            lambda share: report("search", share),
            self.guide(),
        )

    def guide(self) -> PointScore | None:
        """What the classes of the frames tell; None if they do not, or are not to be asked."""
        views = [f.view for f in self.features if f.view is not None]
        return class_witness(views) if self.config.semantics.witness else None

    def climb(self, T: Matrix, searched: bool, report: Report) -> Matrix:
        """Level by level. From 1.5 deg / 15 cm per axis, starting at 8 px instead of the next level lifts the success of
        Levenberg-Marquardt from 14 to 19 of 20 on KITTI. But a scene seen again and again may have its optimum on the coarse
        level elsewhere: from 0.3 deg / 3 cm, 15 of 30 runs of consecutive frames climbed away. So both, unless after a search.
        """
        few = self.score.subset(self.config.search.middle_points, np.random.default_rng(self.config.search.seed))
        ends = [self._approach(few, first, T) for first in ((AFTER_SEARCH,) if searched else NEAR)]
        T = max(ends, key=lambda end: self.value(end) - self.known.cost(end))
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
        return smooth_ascent(score.at(level), T, FIRST_STEP_DEG / 2**level, self.config, self.known, tolerance)

    def drop(self, frames: NDArray[np.intp]) -> None:
        """Leave frames out from now on."""
        self.left_out += [int(j) for j in frames]
        self.known = self.known.with_frames(max(len(self.features) - len(self.left_out), 1))
        self.score = self.score.select(~np.isin(self.score.frame, frames))

    def stay(self, T: Matrix, report: Report) -> Matrix:
        """On the finest level alone; with all frames again, and the points that are near the image there."""
        self.left_out, self.known = [], self.known.with_frames(len(self.features))
        self.score = self.scored(T, self.score.atlas)
        return self._ascent(self.score, self.score.n_levels - 1, T)

    def smooth(self, T: Matrix) -> PointScore:
        """The score itself."""
        return self.score

    def match(self) -> PointScore:
        """The score itself."""
        return self.score

    def doubt(self, T: Matrix, report: Report) -> str:
        """None by itself."""
        return ""
