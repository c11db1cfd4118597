"""Eq. 3.12 as an objective: how it is climbed, and when it is not to be trusted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.config import Config
from calib_ros.frame import Frame
from calib_ros.lidar.deskew import deskewed_points
from calib_ros.registration.constraints import PoseConstraints, SearchBox, unlimited
from calib_ros.registration.covariance import THESIS_SYSTEMATIC_ERROR
from calib_ros.registration.features import Features, FrameFeatures, frame_weights
from calib_ros.registration.objective import AFTER_SEARCH, FIRST_STEP_DEG, FastObjective, Report, WithPrior, smooth_ascent
from calib_ros.registration.optimizers import barzilai_borwein, nelder_mead
from calib_ros.registration.registry import ObjectiveKind
from calib_ros.registration.score import Atlas, PointScore, Score
from calib_ros.registration.search import SearchResult
from calib_ros.semantics.segmentation import OF_MASKS, FrameSemantics
from calib_ros.thesis.features import ThesisFeatures, thesis_features
from calib_ros.thesis.score import ThesisScore

Matrix = NDArray[np.float64]
FIRST_ATTACHED = 2  # level of the attached form; on the coarser, edges of no direction lead degrees away on some scenes

# Synthetic streets, 3 to 8 frames: where eq. 3.12 found the truth it differed by up to 0.65 deg / 12 cm, where it went astray
# by 1.2 deg and more.
DISAGREEMENT_DEG, DISAGREEMENT_M = 0.75, 0.15


class ThesisObjective:
    """Eq. 3.12 over frames. weights: w_j of eq. 3.16; None = by the frames' classes, where these are known.

    Raises TooFewFeaturesError when hardly a point is near the image.
    """

    systematic_error = THESIS_SYSTEMATIC_ERROR

    def __init__(
        self,
        features: Sequence[ThesisFeatures],
        T_prior: Matrix,
        config: Config,
        constraints: PoseConstraints | None = None,
        weights: Sequence[float] | None = None,
    ) -> None:
        self.config, self.constraints = config, constraints or PoseConstraints(unlimited(T_prior))
        # The fast form finds and judges; how eq. 3.12 is optimised must not sway it.
        auto = replace(config, refine=replace(config.refine, optimizer="auto"))
        self.fast = FastObjective([f.fast for f in features], T_prior, auto, self.constraints)
        if weights is None:
            weights = frame_weights([f.fast.importance for f in features]).tolist()
        self.score = ThesisScore(features, T_prior, config, weights)
        self.exact = config.thesis.dense_edges == "every_evaluation"

    def value(self, T: Matrix) -> float:
        """J at the last smoothing; with edges attached once per level, the smooth score of those attached at T."""
        return self.score.at(-1).value(T) if self.exact else self.score.attached(T).at(-1).value(T)

    def frame_scores(self, T: Matrix) -> Matrix:
        """J_j frame by frame."""
        return self.score.frame_scores(T)

    def search(self, T: Matrix, box: SearchBox, report: Report) -> SearchResult:
        """By the fast form. Eq. 3.12 has to be near already, which is what the thesis's first guess is for (3.5): in boxes of
        3 deg / 0.3 m and more a search of its own, edges attached, found 8 of 36 KITTI calibrations, the fast form all."""
        return self.fast.search(T, box, report)

    def optimise(self, T: Matrix, searched: bool, report: Report) -> Matrix:
        """Smoothing by smoothing; or level by level, with edges attached anew on each."""
        if self.exact:
            for level in range(self.score.n_levels):
                T = self._ascent(level, T, report)
            return T
        for level in range(AFTER_SEARCH if searched else FIRST_ATTACHED, len(self.config.score.sigma)):
            report("refinement", level / len(self.config.score.sigma))
            T = smooth_ascent(self.score.attached(T).at(level), T, FIRST_STEP_DEG / 2**level, self.config, self.constraints)
        return T

    def refine(self, T: Matrix, report: Report) -> Matrix:
        """As climb, on the last smoothing or the finest level. T itself if edges attached anew score less there: else a
        calibration that has been found would be refused time and again."""
        if self.exact:
            return self._ascent(-1, T, report)
        found = smooth_ascent(self.score.attached(T).at(-1), T, FIRST_STEP_DEG / 16, self.config, self.constraints)
        return found if self.value(found) >= self.value(T) else T

    def _ascent(self, level: int, T: Matrix, report: Report) -> Matrix:
        evaluations, optimizer = self.config.thesis.evaluations, self.config.refine.optimizer
        watched = _Watched(self.score.at(level), evaluations, report)
        step = self.config.thesis.first_step_deg / 2 ** (level % self.score.n_levels)
        if optimizer == "barzilai_borwein":
            score = WithPrior(watched, self.constraints)
            return barzilai_borwein(score, T, step, evaluations=evaluations, limits=self.constraints.limits)[0]
        prior = self.constraints.prior
        return nelder_mead(watched, T, step, evaluations, None if prior is None else prior.value, self.constraints.limits)[0]

    def smooth_score(self, T: Matrix) -> PointScore:
        """Edges as they are at T, attached to the points."""
        return self.score.attached(T)

    def exclude(self, frames: NDArray[np.intp]) -> None:
        """Their weights w_j become 0."""
        self.fast.exclude(frames)
        self.constraints = self.fast.constraints
        self.score.leave_out(frames)

    def edge_score(self) -> PointScore:
        """The fast score of the same frames."""
        return self.fast.score

    def cross_check(self, T: Matrix, report: Report) -> str:
        """If the fast form, begun at T, ends far away: one of the two is wrong. With few rings that is often eq. 3.12."""
        other = self.fast.optimise(T, False, report)
        deg, m = se3.rotation_error_deg(T, other), se3.translation_error_m(T, other)
        if deg <= DISAGREEMENT_DEG and m <= DISAGREEMENT_M:
            return ""
        return (
            f"the optimum of eq. 3.12 lies {deg:.1f} deg / {m:.2f} m from that of the fast form, which begins there: use more "
            "scenes, start nearer, or take refine.objective: fast"
        )


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


class _Thesis:
    """Eq. 3.12 in the registry of objectives."""

    def features(
        self,
        frame: Frame,
        image: NDArray[np.uint8],
        fast: FrameFeatures,
        edges: NDArray[np.float32] | None,
        semantics: FrameSemantics | None,
        config: Config,
    ) -> ThesisFeatures:
        semantic = None if edges is None else np.asarray(np.minimum(edges.sum(axis=0), 1), np.float32)
        at_image = deskewed_points(frame, config.motion)
        kind = OF_MASKS if semantics is None else semantics.edges_of
        return thesis_features(frame.cloud, image, fast, config, semantic, at_image, kind)

    def objective(
        self, features: Sequence[Features], T_prior: Matrix, config: Config, constraints: PoseConstraints, atlas: Atlas | None
    ) -> ThesisObjective:
        return ThesisObjective([f for f in features if isinstance(f, ThesisFeatures)], T_prior, config, constraints)


THESIS: ObjectiveKind = _Thesis()
