"""Eq. 3.12 as an objective: how it is optimised, and when it is not to be trusted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.config import Config
from calib_ros.frame import Frame
from calib_ros.image.edges import SIGMAS
from calib_ros.lidar.deskew import deskewed_points
from calib_ros.registration.acceptance.refusal import ObjectivesDisagree
from calib_ros.registration.features import Features, FrameFeatures
from calib_ros.registration.objective import AFTER_SEARCH, FIRST_STEP_DEG, FastObjective, WithPrior, optimise_smooth
from calib_ros.registration.progress import SILENT, Observer, Progress
from calib_ros.registration.score.atlas import Atlas
from calib_ros.registration.score.point_score import PointScore, Score
from calib_ros.registration.search.constraints import PoseConstraints, SearchBox, unlimited
from calib_ros.registration.search.optimizers import barzilai_borwein, nelder_mead
from calib_ros.registration.search.search import SearchResult
from calib_ros_semantics.models.edge_classes import frame_weights
from calib_ros_semantics.models.segmentation import OF_MASKS, FrameSemantics
from calib_ros_thesis.features import ThesisFeatures, thesis_features
from calib_ros_thesis.registry import ObjectiveKind
from calib_ros_thesis.score import ThesisScore

Matrix = NDArray[np.float64]
# Size of the first simplex and largest gradient step, and 17 cm per degree, halved on each level: more leaves the basin.
FIRST_SIMPLEX_DEG = 1.6
# rad, m; 0.13-0.18 deg and 3.6-4.9 cm remain on 4 to 10 spread KITTI scenes.
SYSTEMATIC_ERROR = np.array([np.deg2rad(0.1)] * 3 + [0.03] * 3)
FIRST_ATTACHED = 2  # level of the attached form; on the coarser, edges of no direction lead degrees away on some scenes

# Synthetic streets, 3 to 8 frames: where eq. 3.12 found the truth it differed by up to 0.65 deg / 12 cm, where it went astray
# by 1.2 deg and more.
DISAGREEMENT_DEG, DISAGREEMENT_M = 0.75, 0.15


class ThesisObjective:
    """Eq. 3.12 over frames as an Objective. The fast form searches, and tests whether LiDAR and image match at all.

    features: ThesisFeatures of one or more frames of one camera. T_prior: (4, 4). constraints: None = none. atlas, observer: of
    the fast form. weights: w_j of eq. 3.16; None = by the frames' classes, where these are known. Raises TooFewFeaturesError when
    hardly a point is near the image.
    """

    systematic_error = SYSTEMATIC_ERROR
    tolerance_checked = False  # attached edges of dense maps are not independent, and cross_check judges instead

    def __init__(
        self,
        features: Sequence[Features],
        T_prior: Matrix,
        config: Config,
        constraints: PoseConstraints | None = None,
        atlas: Atlas | None = None,
        observer: Observer | None = None,
        weights: Sequence[float] | None = None,
    ) -> None:
        self.config, self.constraints = config, constraints or PoseConstraints(unlimited(T_prior))
        # The fast form searches and validates; how eq. 3.12 is optimised must not change it.
        auto = replace(config, refine=replace(config.refine, optimizer="auto"))
        own = [f for f in features if isinstance(f, ThesisFeatures)]
        self.fast = FastObjective(own, T_prior, auto, self.constraints, atlas, observer)
        if weights is None:
            weights = frame_weights([f.fast.importance for f in own]).tolist()
        self.score = ThesisScore(own, T_prior, config, weights)
        self.exact = config.thesis.dense_edges == "every_evaluation"

    @staticmethod
    def extract(
        frame: Frame,
        image: NDArray[np.uint8],
        fast: FrameFeatures,
        edges: NDArray[np.float32] | None,
        semantics: FrameSemantics | None,
        config: Config,
    ) -> ThesisFeatures:
        """See ObjectiveKind. Semantic edges of both directions count alike."""
        semantic = None if edges is None else np.asarray(np.minimum(edges.sum(axis=0), 1), np.float32)
        at_image = deskewed_points(frame, config.motion)
        kind = OF_MASKS if semantics is None else semantics.edges_of
        return thesis_features(frame.cloud, image, fast, config, semantic, at_image, kind)

    def value(self, T: Matrix) -> float:
        """J at the last smoothing; with edges attached once per level, the smooth score of those attached at T."""
        return self.score.at(-1).value(T) if self.exact else self.score.attached(T).at(-1).value(T)

    def frame_scores(self, T: Matrix) -> Matrix:
        """J_j frame by frame."""
        return self.score.frame_scores(T)

    def search(self, T: Matrix, box: SearchBox, progress: Progress = SILENT) -> SearchResult:
        """By the fast form. Eq. 3.12 has to be near already, which is what the thesis's first guess is for (3.5): in boxes of
        3 deg / 0.3 m and more a search of its own, edges attached, found 8 of 36 KITTI calibrations, the fast form all."""
        return self.fast.search(T, box, progress)

    def optimise(self, T: Matrix, searched: bool = False, progress: Progress = SILENT) -> Matrix:
        """Smoothing by smoothing; or level by level, with edges attached anew on each."""
        if self.exact:
            for level in range(self.score.n_levels):
                T = self._smoothing(level, T, progress)
            return T
        levels = len(SIGMAS)
        for level in range(AFTER_SEARCH if searched else FIRST_ATTACHED, levels):
            progress.of("refinement")(level / levels)
            T = self._attached_level(level, T, FIRST_STEP_DEG / 2**level)
        return T

    def refine(self, T: Matrix, progress: Progress = SILENT) -> Matrix:
        """As optimise, on the last smoothing or the finest level. T itself if edges attached anew score less there: else a
        calibration that has been found would be refused time and again."""
        if self.exact:
            return self._smoothing(-1, T, progress)
        found = self._attached_level(-1, T, FIRST_STEP_DEG / 16)
        return found if self.value(found) >= self.value(T) else T

    def exclude(self, frames: NDArray[np.intp]) -> None:
        """Their weights w_j become 0."""
        self.fast.exclude(frames)
        self.constraints = self.fast.constraints
        self.score.leave_out(frames)

    def smooth_score(self, T: Matrix) -> PointScore:
        """Edges as they are at T, attached to the points."""
        return self.score.attached(T)

    def edge_score(self) -> PointScore:
        """The fast score of the same frames."""
        return self.fast.score

    def cross_check(self, T: Matrix, progress: Progress = SILENT) -> ObjectivesDisagree | None:
        """If the fast form, begun at T, ends far away, one of the two is wrong. With few rings that is often eq. 3.12."""
        other = self.fast.optimise(T, False, progress)
        deg, m = se3.rotation_error_deg(T, other), se3.translation_error_m(T, other)
        return None if deg <= DISAGREEMENT_DEG and m <= DISAGREEMENT_M else ObjectivesDisagree(deg, m)

    def _smoothing(self, level: int, T: Matrix, progress: Progress) -> Matrix:
        """The optimum of eq. 3.12 on one smoothing, by simplex or by gradients."""
        evaluations, optimizer = self.config.thesis.evaluations, self.config.refine.optimizer
        score = _Reporting(self.score.at(level), evaluations, progress.of("refinement"))
        step, limits = FIRST_SIMPLEX_DEG / 2 ** (level % self.score.n_levels), self.constraints.limits
        if optimizer == "barzilai_borwein":
            return barzilai_borwein(WithPrior(score, self.constraints), T, step, evaluations=evaluations, limits=limits)[0]
        prior = self.constraints.prior
        return nelder_mead(score, T, step, evaluations, None if prior is None else prior.value, limits)[0]

    def _attached_level(self, level: int, T: Matrix, step_deg: float) -> Matrix:
        """The optimum on one level with edges attached at T."""
        return optimise_smooth(self.score.attached(T).at(level), T, step_deg, self.config, self.constraints)


@dataclass(eq=False)
class _Reporting:
    """A score that reports every evaluation: they take long enough for a person to wait, or to interrupt."""

    score: Score
    total: int
    progress: Progress
    done: int = 0

    def value(self, T: Matrix) -> float:
        self.done += 1
        self.progress(min(self.done / self.total, 1.0))
        return self.score.value(T)


_: ObjectiveKind = ThesisObjective
