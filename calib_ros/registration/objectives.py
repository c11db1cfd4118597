"""The two objectives behind one interface: the fast form and the thesis's eq. 3.12. The calibrator knows no more of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.config import Config
from calib_ros.registration.fast_score import FastScore
from calib_ros.registration.frame_features import FrameFeatures
from calib_ros.registration.optimizers import barzilai_borwein, levenberg_marquardt, nelder_mead
from calib_ros.registration.point_score import PointScore
from calib_ros.registration.scores import Score, SmoothScore
from calib_ros.registration.search import SearchBox
from calib_ros.registration.search import search as global_search
from calib_ros.registration.thesis_features import ThesisFeatures
from calib_ros.registration.thesis_score import ThesisScore
from calib_ros.registration.uncertainty import FLOOR, THESIS_FLOOR

Matrix = NDArray[np.float64]
Report = Callable[[str, float], None]
FIRST_STEP_DEG = 1.6  # of simplexes and ascents on the coarsest level of a smooth score; half of it on the next, and so on
AFTER_SEARCH = 2  # the level to go on with after a search
FIRST_ATTACHED = 1  # level of the attached form; on the coarsest, edges of no direction lead degrees away on some scenes

# Synthetic streets, 3 to 8 frames: where eq. 3.12 found the truth it differed by up to 0.65 deg / 12 cm, where it went astray
# by 1.2 deg and more.
DISAGREEMENT_DEG, DISAGREEMENT_M = 0.75, 0.15


class Objective(Protocol):
    """What is maximised, and how. T is T_camera_lidar (4, 4) throughout; report(stage, 0..1) tells progress.

    floor: standard deviations (6,) of its bias, rad and m.
    """

    floor: Matrix

    def value(self, T: Matrix) -> float:
        """The score that decides."""
        ...

    def frame_scores(self, T: Matrix) -> Matrix:
        """The score frame by frame (n_frames,)."""
        ...

    def search(self, T: Matrix, box: SearchBox, report: Report) -> Matrix:
        """The best extrinsic in a box around T, to be climbed from."""
        ...

    def climb(self, T: Matrix, searched: bool, report: Report) -> Matrix:
        """The optimum uphill from T. searched: T is the result of a search, and near."""
        ...

    def stay(self, T: Matrix, report: Report) -> Matrix:
        """The optimum right at T, on the finest level alone."""
        ...

    def smooth(self, T: Matrix) -> PointScore:
        """A score with a slope that equals, or approximates, the objective near T: for the covariance."""
        ...

    def match(self) -> PointScore:
        """The fast score, which tells whether LiDAR and image match at all."""
        ...

    def doubt(self, T: Matrix, report: Report) -> str:
        """Why the optimum T may be no calibration; empty if nothing speaks against it."""
        ...


class FastObjective:
    """Oriented edges of sparse points. Raises TooFewFeaturesError when there are too few."""

    floor = FLOOR

    def __init__(self, features: Sequence[FrameFeatures], T_prior: Matrix, config: Config) -> None:
        self.config = config
        self.score = FastScore(list(features), T_prior, config.score)

    def value(self, T: Matrix) -> float:
        """Score on the finest level."""
        return self.score.at(-1).value(T)

    def frame_scores(self, T: Matrix) -> Matrix:
        """Score frame by frame; NaN without edge points."""
        return self.score.frame_scores(T)

    def search(self, T: Matrix, box: SearchBox, report: Report) -> Matrix:
        """See search.search."""
        return global_search(self.score, T, box, self.config.search, lambda share: report("search", share))

    def climb(self, T: Matrix, searched: bool, report: Report) -> Matrix:
        """Level by level. From 1.5 deg / 15 cm per axis, starting on the coarsest level instead of the next lifts the success
        of Levenberg-Marquardt from 14 to 19 of 20 on KITTI at the same cost; after a search it is not needed."""
        for level in range(AFTER_SEARCH if searched else 0, self.score.n_levels):
            T = _smooth_ascent(self.score.at(level), T, FIRST_STEP_DEG / 2**level, self.config)
        return T

    def stay(self, T: Matrix, report: Report) -> Matrix:
        """Levenberg-Marquardt on the finest level."""
        return levenberg_marquardt(self.score.at(-1), T)[0]

    def smooth(self, T: Matrix) -> PointScore:
        """The score itself."""
        return self.score

    def match(self) -> PointScore:
        """The score itself."""
        return self.score

    def doubt(self, T: Matrix, report: Report) -> str:
        """None by itself."""
        return ""


class ThesisObjective:
    """Eq. 3.12 over frames. weights: w_j of eq. 3.16. Raises TooFewFeaturesError when hardly a point is near the image."""

    floor = THESIS_FLOOR

    def __init__(
        self, features: Sequence[ThesisFeatures], T_prior: Matrix, config: Config, weights: Sequence[float] | None = None
    ) -> None:
        self.config = config
        # The fast form finds and judges; how eq. 3.12 is optimised must not sway it.
        auto = replace(config, refine=replace(config.refine, optimizer="auto"))
        self.fast = FastObjective([f.fast for f in features], T_prior, auto)
        self.score = ThesisScore(features, T_prior, config, weights)
        self.exact = config.thesis.dense_edges == "every_evaluation"

    def value(self, T: Matrix) -> float:
        """J at the last smoothing; with edges attached once per level, the smooth score of those attached at T."""
        return self.score.at(-1).value(T) if self.exact else self.score.attached(T).at(-1).value(T)

    def frame_scores(self, T: Matrix) -> Matrix:
        """J_j frame by frame."""
        return self.score.frame_scores(T)

    def search(self, T: Matrix, box: SearchBox, report: Report) -> Matrix:
        """By the fast form. Eq. 3.12 has to be near already, which is what the thesis's first guess is for (3.5): in boxes of
        3 deg / 0.3 m and more a search of its own, edges attached, found 8 of 36 KITTI calibrations, the fast form all."""
        return self.fast.search(T, box, report)

    def climb(self, T: Matrix, searched: bool, report: Report) -> Matrix:
        """Smoothing by smoothing; or level by level, with edges attached anew on each."""
        if self.exact:
            for level in range(self.score.n_levels):
                T = self._ascent(level, T, report)
            return T
        for level in range(AFTER_SEARCH if searched else FIRST_ATTACHED, len(self.config.score.sigma)):
            report("refinement", level / len(self.config.score.sigma))
            T = _smooth_ascent(self.score.attached(T).at(level), T, FIRST_STEP_DEG / 2**level, self.config)
        return T

    def stay(self, T: Matrix, report: Report) -> Matrix:
        """As climb, on the last smoothing or the finest level. T itself if edges attached anew score less there: else a
        calibration that has been found would be refused time and again."""
        if self.exact:
            return self._ascent(-1, T, report)
        found = levenberg_marquardt(self.score.attached(T).at(-1), T)[0]
        return found if self.value(found) >= self.value(T) else T

    def _ascent(self, level: int, T: Matrix, report: Report) -> Matrix:
        evaluations, optimizer = self.config.thesis.evaluations, self.config.refine.optimizer
        watched = _Watched(self.score.at(level), evaluations, report)
        step = self.config.thesis.first_step_deg / 2 ** (level % self.score.n_levels)
        if optimizer == "barzilai_borwein":
            return barzilai_borwein(watched, T, step, evaluations=evaluations)[0]
        return nelder_mead(watched, T, step, evaluations)[0]

    def smooth(self, T: Matrix) -> PointScore:
        """Edges as they are at T, attached to the points."""
        return self.score.attached(T)

    def match(self) -> PointScore:
        """The fast score of the same frames."""
        return self.fast.score

    def doubt(self, T: Matrix, report: Report) -> str:
        """If the fast form, begun at T, ends far away: one of the two is wrong. With few rings that is often eq. 3.12."""
        other = self.fast.climb(T, False, report)
        deg, m = se3.rotation_error_deg(T, other), se3.translation_error_m(T, other)
        if deg <= DISAGREEMENT_DEG and m <= DISAGREEMENT_M:
            return ""
        return (
            f"the optimum of eq. 3.12 lies {deg:.1f} deg / {m:.2f} m from that of the fast form, which begins there: use more "
            "scenes, start nearer, or take refine.objective: fast"
        )


def _smooth_ascent(score: SmoothScore, T: Matrix, step_deg: float, config: Config) -> Matrix:
    """By the configured optimiser, which is Levenberg-Marquardt where nothing is asked for."""
    if config.refine.optimizer == "nelder_mead":
        return nelder_mead(score, T, step_deg, 4 * config.search.simplex_evaluations)[0]
    if config.refine.optimizer == "barzilai_borwein":
        return barzilai_borwein(score, T, step_deg, evaluations=4 * config.search.simplex_evaluations)[0]
    return levenberg_marquardt(score, T, config.refine.iterations)[0]


@dataclass(eq=False)
class _Watched:
    """A score that reports every evaluation: they take long enough for a person to wait, or to interrupt."""

    score: Score
    total: int
    report: Report
    done: int = 0

    def value(self, T: Matrix) -> float:
        self.done += 1
        self.report("refinement", min(self.done / self.total, 1.0))
        return self.score.value(T)
