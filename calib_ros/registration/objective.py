"""Objectives, as the calibrator knows them; the fast form, oriented edges of sparse points on multi-level maps; their making."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.arrays import Matrix, Transform
from calib_ros.camera import Camera
from calib_ros.config import Config, ScoreConfig
from calib_ros.errors import TooFewFeaturesError
from calib_ros.lidar.deskew import moved
from calib_ros.lidar.edges import UPWARD, EdgeKind, EdgePoints
from calib_ros.registration.classes import consistency_score
from calib_ros.registration.features import FrameFeatures, other_objective, search_margin, views_of
from calib_ros.registration.progress import SILENT, Progress
from calib_ros.registration.score.atlas import Atlas
from calib_ros.registration.score.point_score import MARGIN, MIN_POINTS, PointScore, SmoothScore, near_image
from calib_ros.registration.search.constraints import (
    REFINEMENT_DEG,
    REFINEMENT_M,
    PoseConstraints,
    SearchBox,
    pose_constraints,
    unlimited,
)
from calib_ros.registration.search.optimizers import barzilai_borwein, levenberg_marquardt, nelder_mead
from calib_ros.registration.search.search import MIDDLE_POINTS, SIMPLEX_EVALUATIONS, SearchResult
from calib_ros.registration.search.search import search as global_search

# Levels count from the coarsest, 0.
FIRST_STEP_DEG = 3.2  # of simplexes and gradient steps on the coarsest level of a smooth score; half of it on the next, and so on
NEAR = (1, 2)  # levels to begin with, near the optimum
AFTER_SEARCH = 3  # the level to go on with after a search
LAST_OF_FEW = 3  # up to this level some of the points are enough; the finer ones decide
COARSE_TOLERANCE_DEG = 0.01  # where a level need not be optimised to the very top, since a finer one follows
TOLERANCE_DEG = 0.001
ITERATIONS = 20  # of Levenberg-Marquardt per level, which ends most often after 3 to 7
BEYOND_BOX = 1.5  # half widths of the search box; beyond, an optimum is none of the box
# Of the edges, rad and m; what their placing within a pixel and an azimuth step leaves on synthetic streets, of any length.
SYSTEMATIC_ERROR = np.array([np.deg2rad(0.01)] * 3 + [0.004] * 3)

# Weights of the kinds of edges, beside that of reflectivity, which users set: what is often no edge in the image weighs less.
WEIGHT_SIDE, WEIGHT_TOP, WEIGHT_SKY_SIDE, WEIGHT_SKY_TOP = 1.0, 0.6, 0.5, 0.3
RING_SPACING_DEG = 0.4  # deg; upward edges of sparser rings weigh less by the square root of the ratio: they are less exact
WEIGHT_FLOOR = 150  # edge points of a frame and kind below which its weight fades, so that a few do not dominate
# By the number of a kind: a set of them takes np.isin longer than all else that is done with few points.
_IS_UPWARD = np.isin(np.arange(max(EdgeKind) + 1), UPWARD)


class Objective(Protocol):
    """What is maximised over the extrinsic, near an optimum that the edges have found. T is T_camera_lidar (4, 4) throughout.

    edges: the score of edges of the same frames, which searches, and tests whether LiDAR and image match at all. constraints:
    limits and prior, which it obeys. systematic_error: standard deviations (6,) of its bias, rad and m. agreement: deg and m
    within which the edges' own optimum has to lie for this one to be trusted; None = its covariance is validated. remark: for
    the reason of every result, or "". Every method may raise TooFewFeaturesError if too little falls into the image.
    """

    systematic_error: Matrix
    agreement: tuple[float, float] | None
    constraints: PoseConstraints

    @property
    def remark(self) -> str: ...

    @property
    def edges(self) -> FastObjective: ...

    def value(self, T: Transform) -> float:
        """The score."""

    def frame_scores(self, T: Transform) -> Matrix:
        """The score frame by frame (n_frames,); NaN for a frame without edge points, or excluded."""

    def optimise(self, T: Transform, searched: bool = False, progress: Progress = SILENT) -> Transform:
        """The local optimum from T, coarse to fine. searched: T is the result of a search, and near."""

    def refine(self, T: Transform, progress: Progress = SILENT) -> Transform:
        """The local optimum from T on the finest level alone, with all frames again."""

    def exclude(self, frames: NDArray[np.intp]) -> None:
        """Leave frames out of the score from now on; those of `edges` too."""

    def smooth_score(self, T: Transform) -> PointScore:
        """A score with a slope that equals, or approximates, the objective near T: for the covariance."""


def penalised(objective: Objective, T: Transform) -> float:
    """What is maximised: the score less the cost of the prior."""
    return objective.value(T) - objective.constraints.cost(T)


class FastScore(PointScore):
    """The score of the method: sparse edge points of several frames on oriented edge maps.

    features: of one camera. T_prior: (4, 4); edge points that it projects farther than `margin` (share of the image width; None =
    MARGIN) outside the image are left out. atlas: of the same features, if there is one already.
    Raises TooFewFeaturesError when fewer than MIN_POINTS edge points remain.
    """

    def __init__(
        self,
        features: list[FrameFeatures],
        T_prior: Transform,
        config: ScoreConfig,
        margin: float | None = None,
        atlas: Atlas | None = None,
    ) -> None:
        if not features:
            raise TooFewFeaturesError("no frame can be used; give others")
        camera, margin = features[0].camera, MARGIN if margin is None else margin
        kept = [f.points.select(near_image(f.points.xyz, T_prior, camera, margin)) for f in features]
        frame = np.concatenate([np.full(len(p), j, np.int32) for j, p in enumerate(kept)])
        if len(frame) < MIN_POINTS:
            raise TooFewFeaturesError(
                f"{len(frame) or 'no'} edge points near the image in {len(features)} frames, {MIN_POINTS} are needed; "
                "wait for a scene with objects, or check the initial extrinsic"
            )
        weights = np.concatenate([_weights(p, config) for p in kept])
        # A camera mounted on its side sees side and upward edges exchanged.
        axes = [np.abs(T_prior[:3, :3] @ p.pose.axis) for p in kept]
        channels = [(_IS_UPWARD[p.kind] != (axis[0] > axis[1])).astype(np.intp) for p, axis in zip(kept, axes, strict=True)]
        super().__init__(
            np.concatenate([p.xyz for p in kept]).T,
            (weights / weights.sum()).astype(np.float32),
            frame,
            np.concatenate(channels),
            atlas or Atlas([f.levels for f in features], camera),
        )


def _weights(points: EdgePoints, config: ScoreConfig) -> NDArray[np.float64]:
    """Weights (n,) of one frame's points: every kind shares its weight out; upward edges of few rings, less exact, count less."""
    upward = float(np.sqrt(min(1.0, np.deg2rad(RING_SPACING_DEG) / max(points.ring_spacing, 1e-6))))
    of_kind = {
        EdgeKind.SIDE: WEIGHT_SIDE,
        EdgeKind.TOP: WEIGHT_TOP * upward,
        EdgeKind.REFLECTIVITY: config.weight_reflectivity,
        EdgeKind.SKY_SIDE: WEIGHT_SKY_SIDE,
        EdgeKind.SKY_TOP: WEIGHT_SKY_TOP * upward,
    }
    strength, share = points.strength.astype(np.float64), np.zeros(max(EdgeKind) + 1)
    for kind, weight in of_kind.items():
        own = strength[points.kind == kind]
        if len(own):
            share[kind] = weight / max(own.sum(), WEIGHT_FLOOR * own.mean())
    return strength * share[points.kind]


class FastObjective:
    """The method's own objective: oriented edges of sparse points (FastScore).

    features: of one camera. T_prior: (4, 4), decides which points are near the image. atlas: of the edge maps, if there is one
    already. TooFewFeaturesError with too few points near the image.
    """

    systematic_error = SYSTEMATIC_ERROR
    agreement: tuple[float, float] | None = None
    remark = ""

    def __init__(
        self,
        features: Sequence[FrameFeatures],
        T_prior: Transform,
        config: Config,
        constraints: PoseConstraints,
        atlas: Atlas | None = None,
    ) -> None:
        self.features, self.config = list(features), config
        self.constraints = constraints
        self.score: PointScore = self._score_near(T_prior, atlas)
        self._excluded: list[int] = []

    @property
    def edges(self) -> FastObjective:
        return self

    def value(self, T: Transform) -> float:
        """Score on the finest level."""
        return self.score.at(-1).value(T)

    def frame_scores(self, T: Transform) -> Matrix:
        return self.score.frame_scores(T)

    def search(self, T: Transform, box: SearchBox, progress: Progress = SILENT) -> SearchResult:
        """See search.search; with the points that may come into view anywhere in the box."""
        margin = search_margin(self.score.camera, box)
        return global_search(
            self._score_near(T, self.score.atlas, margin),
            T,
            box,
            self.config.search,
            self.constraints.limits,
            self.config.refine.max_p_value,
            self.constraints.prior,
            progress.of("search"),
            consistency_score(views_of(self.features)),
        )

    def optimise(self, T: Transform, searched: bool = False, progress: Progress = SILENT) -> Transform:
        """Level by level, from each of NEAR unless after a search: the coarser one lifts successes from 14 to 19 of 20 on KITTI,
        but a scene seen again and again may have its optimum elsewhere there."""
        few = self.score.subset(MIDDLE_POINTS, np.random.default_rng(self.config.search.seed))
        ends = []
        for first in (AFTER_SEARCH,) if searched else NEAR:
            end = T
            for level in range(first, self.score.n_levels - 1):  # the coarser of them with a few points
                end = self._level(few if level <= LAST_OF_FEW else self.score, level, end)
            ends.append(end)
        T = max(ends, key=lambda end: penalised(self, end))
        # Which points are near the image, and so their weights, must not depend on where the optimisation began.
        self.score = self._score_near(T, self.score.atlas)
        if self._excluded:
            self.score = self.score.select(~np.isin(self.score.frame, self._excluded))
        return self._level(self.score, self.score.n_levels - 1, T)

    def refine(self, T: Transform, progress: Progress = SILENT) -> Transform:
        """On the finest level alone; with all frames again, and the points that are near the image there."""
        self._excluded, self.constraints = [], self.constraints.with_frames(len(self.features))
        self.score = self._score_near(T, self.score.atlas)
        return self._level(self.score, self.score.n_levels - 1, T)

    def exclude(self, frames: NDArray[np.intp]) -> None:
        self._excluded += [int(j) for j in frames]
        self.constraints = self.constraints.with_frames(max(len(self.features) - len(self._excluded), 1))
        self.score = self.score.select(~np.isin(self.score.frame, frames))

    def smooth_score(self, T: Transform) -> PointScore:
        """The score itself."""
        return self.score

    def _score_near(self, T: Transform, atlas: Atlas | None, margin: float | None = None) -> PointScore:
        """The score of all frames with the points that are near the image at T; see FastScore."""
        return FastScore(self.features, T, self.config.score, margin, atlas)

    def _level(self, score: PointScore, level: int, T: Transform) -> Transform:
        """The optimum on one level."""
        tolerance = TOLERANCE_DEG if level == score.n_levels - 1 else COARSE_TOLERANCE_DEG
        return optimise_smooth(score.at(level), T, FIRST_STEP_DEG / 2**level, self.config, self.constraints, tolerance)


def optimise_smooth(
    score: SmoothScore,
    T: Transform,
    step_deg: float,
    config: Config,
    constraints: PoseConstraints,
    tolerance_deg: float = TOLERANCE_DEG,
) -> Transform:
    """The optimum from T (4, 4) by ``refine.optimizer``, which is Levenberg-Marquardt where nothing is asked for."""
    evaluations, limits, optimizer = 4 * SIMPLEX_EVALUATIONS, constraints.limits, config.refine.optimizer
    if optimizer == "nelder_mead":
        return nelder_mead(score, T, step_deg, evaluations, constraints.cost, limits)[0]
    if optimizer == "barzilai_borwein":
        return barzilai_borwein(score, T, step_deg, evaluations=evaluations, limits=limits, penalty=constraints.cost)[0]
    return levenberg_marquardt(score, T, ITERATIONS, constraints.prior, limits, tolerance_deg, near=True)[0]


def trust_region(box: SearchBox | None = None) -> tuple[float, float]:
    """How far in deg and m, per axis, an optimisation may go from the start: a refinement as far as it is meant to, a search
    somewhat out of its box."""
    deg, m = box.reach if box is not None else (0.0, 0.0)
    return max(BEYOND_BOX * deg, REFINEMENT_DEG), max(BEYOND_BOX * m, REFINEMENT_M)


class ObjectiveMaker:
    """Makes the configured objective of frames of one camera, as they were recorded. maps: of an objective that is done with,
    whose memory is lent to the next one, mostly of the same frames; other threads meanwhile lay out their own."""

    def __init__(self, config: Config, camera: Camera) -> None:
        self.config, self._camera = config, camera
        self.maps: Atlas | None = None

    def __call__(
        self,
        features: Sequence[FrameFeatures],
        T_prior: Transform,
        anchor: Transform,
        box: SearchBox | None = None,
        T_rows: Transform | None = None,
        atlas: Atlas | None = None,
    ) -> Objective:
        """The configured objective around T_prior (4, 4). anchor: T_camera_lidar (4, 4) that the stage ``constraints`` counts
        from. box: to be searched. T_rows: (4, 4), where points fall in the image, for a rolling shutter; None = T_prior. atlas:
        of these features, if there is one already that others may use as well. Raises TooFewFeaturesError."""
        config, other = self.config, other_objective(self.config)
        constraints = pose_constraints(anchor, config.constraints, max(len(features), 1))
        constraints = constraints.within_trust_region(T_prior, *trust_region(box))
        if atlas is None and features:
            last, self.maps = self.maps, None
            atlas = Atlas([f.levels for f in features], features[0].camera, last)
        seen = self._seen_by_rows(features, T_prior if T_rows is None else T_rows)
        if other is None:
            return FastObjective(seen, T_prior, config, constraints, atlas)
        edges = FastObjective(seen, T_prior, self._of_edges, constraints, atlas)
        objective: Objective = other(edges, T_prior, config)
        return objective

    def of_edges(self, features: Sequence[FrameFeatures], T_prior: Transform, anchor: Transform | None = None) -> FastObjective:
        """The edges' own objective around T_prior (4, 4), whatever the configured one. Raises TooFewFeaturesError.

        anchor: None = constraints do not count. The maps that are kept are left to estimates: this is for another thread.
        """
        if anchor is None:
            constraints = PoseConstraints(unlimited(T_prior))
        else:
            constraints = pose_constraints(anchor, self.config.constraints, max(len(features), 1))
        constraints = constraints.within_trust_region(T_prior, *trust_region())
        # Semantics come later than the keyframe, if at all: with them, the score would tell new keyframes from older ones.
        plain = [(f.plain or f).edges_only for f in features]
        return FastObjective(self._seen_by_rows(plain, T_prior), T_prior, self._of_edges, constraints)

    @property
    def _of_edges(self) -> Config:
        """How another objective is optimised must not change how the edges search and validate."""
        config, other = self.config, other_objective(self.config)
        return config if other is None else replace(config, refine=replace(config.refine, optimizer="auto"))

    def _seen_by_rows(self, features: Sequence[FrameFeatures], T: Transform) -> list[FrameFeatures]:
        """Features whose points are where the rows of the image see them at T_camera_lidar (4, 4); the same where the shutter is
        global, the LiDAR's velocity is not known, or another objective keeps points of its own.

        The row t seconds after the middle one sees a static point at exp(-twist t) p in the LiDAR frame. Which row depends on
        the extrinsic, but weakly: that of the start tells it well enough for a search, its result for the final optimum.
        """
        readout_s, height, out = self.config.motion.readout_s, self._camera.height, list(features)
        for k, f in enumerate(features):
            if not readout_s or f.twist is None or f.own is not None:
                continue
            row = self._camera.project(se3.transform(T, f.points.xyz))[0][:, 1]
            share = (np.clip(row, 0, height - 1) + 0.5) / height - 0.5
            time = np.nan_to_num(share) * readout_s  # beside the image as on its border, behind it as in its middle
            out[k] = replace(f, points=replace(f.points, xyz=moved(f.points.xyz, f.twist, -time).astype(np.float32)))
        return out
