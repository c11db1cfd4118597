"""How an objective is made of frames' features: within a trust region, under the constraints, on maps that may be kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from calib_ros.arrays import Transform
from calib_ros.camera import Camera
from calib_ros.config import Config
from calib_ros.registration.features import FrameFeatures, other_objective
from calib_ros.registration.nuisance.rolling_shutter import seen_by_rows
from calib_ros.registration.objective import FastObjective, Objective
from calib_ros.registration.progress import Observer
from calib_ros.registration.score.atlas import Atlas, AtlasCache
from calib_ros.registration.search.constraints import (
    REFINEMENT_DEG,
    REFINEMENT_M,
    PoseConstraints,
    SearchBox,
    pose_constraints,
    unlimited,
)

BEYOND_BOX = 1.5  # half widths of the search box; beyond, an optimum is none of the box


def trust_region(box: SearchBox | None = None) -> tuple[float, float]:
    """How far in deg and m, per axis, an optimisation may go from the start: a refinement as far as it is meant to, a search
    somewhat out of its box."""
    deg, m = box.reach if box is not None else (0.0, 0.0)
    return max(BEYOND_BOX * deg, REFINEMENT_DEG), max(BEYOND_BOX * m, REFINEMENT_M)


class ObjectiveMaker:
    """Makes the configured objective of frames of one camera, as they were recorded; the maps of the last frames are kept.

    observer: gets every evaluation.
    """

    def __init__(self, config: Config, camera: Camera, observer: Observer | None) -> None:
        self.config, self._camera, self.observer = config, camera, observer
        self._atlases = AtlasCache()

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
            atlas = self._atlases.atlas([f.levels for f in features], features[0].camera)
        seen = seen_by_rows(features, T_prior if T_rows is None else T_rows, self._camera, config.motion)
        if other is None:
            return FastObjective(seen, T_prior, config, constraints, atlas, self.observer)
        # How another objective is optimised must not change how the edges search and validate.
        of_edges = replace(config, refine=replace(config.refine, optimizer="auto"))
        return other(FastObjective(seen, T_prior, of_edges, constraints, atlas, self.observer), T_prior, config)

    def of_edges(self, features: Sequence[FrameFeatures], T_prior: Transform, anchor: Transform | None = None) -> FastObjective:
        """The edges' own objective around T_prior (4, 4), whatever the configured one. Raises TooFewFeaturesError.

        anchor: None = constraints do not count. The maps that are kept are left to estimates: this is for another thread.
        """
        config = self.config
        constraints = pose_constraints(T_prior if anchor is None else anchor, config.constraints, max(len(features), 1))
        if anchor is None:
            constraints = PoseConstraints(unlimited(T_prior))
        constraints = constraints.within_trust_region(T_prior, *trust_region())
        # Semantics come later than the keyframe, if at all: with them, the score would tell new keyframes from older ones.
        plain = [(f.plain or f).edges_only for f in features]
        return FastObjective(seen_by_rows(plain, T_prior, self._camera, config.motion), T_prior, config, constraints)

    def keep_maps(self, objective: Objective) -> None:
        """Keep the maps of an objective that is done with: the next one may be of mostly the same frames."""
        self._atlases.give_back(objective.edges.score.atlas)

    def free_memory(self) -> None:
        """Free them: as much as the maps of all frames take."""
        self._atlases.clear()
