"""Eq. 3.12 as an objective: how it is optimised, and when it is not to be trusted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import Config
from calib_ros.frame import Frame
from calib_ros.image.edges import SIGMAS
from calib_ros.lidar.deskew import deskewed_points
from calib_ros.registration.classes import IMAGE, MASKS, OF_CLASSES, OF_MASKS, FrameSemantics
from calib_ros.registration.features import FeatureExtractor, FrameFeatures
from calib_ros.registration.objective import AFTER_SEARCH, FIRST_STEP_DEG, FastObjective, optimise_smooth
from calib_ros.registration.progress import SILENT, Progress
from calib_ros.registration.score.point_score import PointScore, Score
from calib_ros.registration.search.optimizers import barzilai_borwein, nelder_mead
from calib_ros_thesis.config import thesis_of
from calib_ros_thesis.features import ThesisFeatures, frame_weights, thesis_features
from calib_ros_thesis.features import importance as share_of_main_classes
from calib_ros_thesis.score import ThesisScore

Matrix = NDArray[np.float64]
# Size of the first simplex and largest gradient step, and 17 cm per degree, halved on each level: more leaves the basin.
FIRST_SIMPLEX_DEG = 1.6
SET_MASKS = "set semantics.segment_anything to its ONNX file or a folder of masks"
LAST_SIZE = 0.005  # of it, when a simplex is done: a tenth of a pixel at 720 px focal length
# rad, m; 0.13-0.18 deg and 3.6-4.9 cm remain on 4 to 10 spread KITTI scenes.
SYSTEMATIC_ERROR = np.array([np.deg2rad(0.1)] * 3 + [0.03] * 3)
FIRST_ATTACHED = 2  # level of the attached form; on the coarser, edges of no direction lead degrees away on some scenes

# Synthetic streets, 3 to 8 frames: where eq. 3.12 found the truth, up to 0.65 deg / 12 cm, else 1.2 deg and more.
DISAGREEMENT_DEG, DISAGREEMENT_M = 0.75, 0.15


class ThesisObjective:
    """Eq. 3.12 over frames as an Objective, an `ObjectiveKind`. TooFewFeaturesError when hardly a point is near the image.

    edges: of frames whose features hold ThesisFeatures; they search, and test whether LiDAR and image match. T_prior: (4, 4).
    weights: w_j of eq. 3.16; None = by the frames' classes, where these are known.
    """

    pinholes_only, moves_points = True, False
    uses = (MASKS, IMAGE)  # points have objects of their own, algorithm 2
    systematic_error = SYSTEMATIC_ERROR
    # Attached edges of dense maps are not independent, so that the covariance says too little: of two objectives that end far
    # apart one is wrong, and with few rings that is often eq. 3.12.
    agreement: tuple[float, float] | None = (DISAGREEMENT_DEG, DISAGREEMENT_M)

    def __init__(self, edges: FastObjective, T_prior: Matrix, config: Config, weights: Sequence[float] | None = None) -> None:
        self.edges, self.constraints, self.config = edges, edges.constraints, config
        own: list[ThesisFeatures] = [f.own for f in edges.features]
        if weights is None:
            weights = frame_weights([f.importance for f in own]).tolist()
        self.score = ThesisScore(own, T_prior, config, weights)
        self.exact = thesis_of(config).dense_edges == "every_evaluation"

    @staticmethod
    def extract(
        frame: Frame,
        image: NDArray[np.uint8],
        features: FrameFeatures,
        semantics: FrameSemantics | None,
        extractor: FeatureExtractor,
    ) -> ThesisFeatures:
        """See ObjectiveKind. Semantic edges of both directions count alike."""
        config, edges, importance = extractor.config, None, None
        if semantics is not None:
            both = extractor.semantic_edges(semantics)
            edges = None if both is None else np.asarray(np.minimum(both.sum(axis=0), 1), np.float32)
            if semantics.classes is not None and config.semantics.frame_weights:
                importance = share_of_main_classes(extractor.working(semantics.classes, nearest=True))
        plain: ThesisFeatures | None = features.own
        at_image = deskewed_points(frame, config.motion) if plain is None else None
        kind = OF_MASKS if semantics is None else semantics.edges_of
        own = thesis_features(frame.cloud, image, features.camera, config, edges, at_image, kind, importance, plain)
        if semantics is not None:  # which are found on a thread that nothing waits for
            own.scan()
            own.edges()
        return own

    @property
    def remark(self) -> str:
        """What the semantic edges of 3.4.2 are, where they are not of Segment Anything in all frames."""
        blended = {f.own.blended for f in self.edges.features}
        ran = " and borders of classes, without" if OF_CLASSES in blended else ", without classes (semantics.segmentation) or"
        return "" if blended == {OF_MASKS} else f"eq. 3.12 ran on gradients{ran} masks of Segment Anything: {SET_MASKS}"

    def value(self, T: Matrix) -> float:
        """J at the last smoothing; with edges attached once per level, the smooth score of those attached at T."""
        return self.score.at(-1).value(T) if self.exact else self.score.attached(T).at(-1).value(T)

    def frame_scores(self, T: Matrix) -> Matrix:
        """J_j frame by frame."""
        return self.score.frame_scores(T)

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
        """As optimise, on the last smoothing or the finest level. T itself if edges attached anew score less there."""
        if self.exact:
            return self._smoothing(-1, T, progress)
        found = self._attached_level(-1, T, FIRST_STEP_DEG / 16)
        return found if self.value(found) >= self.value(T) else T

    def exclude(self, frames: NDArray[np.intp]) -> None:
        """Their weights w_j become 0."""
        self.edges.exclude(frames)
        self.constraints = self.edges.constraints
        self.score.leave_out(frames)

    def smooth_score(self, T: Matrix) -> PointScore:
        """Edges as they are at T, attached to the points."""
        return self.score.attached(T)

    def _smoothing(self, level: int, T: Matrix, progress: Progress) -> Matrix:
        """The optimum of eq. 3.12 on one smoothing, by simplex or by gradients."""
        evaluations, optimizer = thesis_of(self.config).evaluations, self.config.refine.optimizer
        score = _Reporting(self.score.at(level), evaluations, progress.of("refinement"))
        step, limits = FIRST_SIMPLEX_DEG / 2 ** (level % self.score.n_levels), self.constraints.limits
        if optimizer == "barzilai_borwein":
            return barzilai_borwein(score, T, step, evaluations=evaluations, limits=limits, penalty=self.constraints.cost)[0]
        # Points fall on whole pixels: scores of vertices differ until the simplex is nothing, and only its size tells.
        return nelder_mead(score, T, step, evaluations, self.constraints.cost, limits, (LAST_SIZE, np.inf))[0]

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
