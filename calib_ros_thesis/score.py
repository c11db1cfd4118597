"""The thesis's objective: the edge registration score of eq. 3.12 over several frames (eq. 3.16)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import Config
from calib_ros.errors import BadInputError, TooFewFeaturesError
from calib_ros.registration.score.atlas import Atlas
from calib_ros.registration.score.point_score import MARGIN, MIN_POINTS, PointScore, near_image, nearest_per_pixel, project
from calib_ros_thesis.config import ThesisConfig, thesis_of
from calib_ros_thesis.features import ThesisFeatures
from calib_ros_thesis.maps import EdgeMaps, FastEdgeMaps, PointLevels, edge_maps

Matrix = NDArray[np.float64]
Map = NDArray[np.float32]
MAX_DISCONTINUITY = 3.0  # m; at which eq. 3.10 saturates: from a car to the wall behind it
KEPT = 4  # extrinsics whose edges are kept: an estimate asks for those of its start and of its optimum again and again


class ThesisScore:
    """J of eq. 3.12, summed over frames by eq. 3.16, at the smoothings of ``thesis.smoothing``.

    Equal to RegistrationMaps to rounding: only pixels with a projected point count, so that E^L is computed at these alone.
    features: of one camera. T_prior: (4, 4); points it projects far outside the image are left out. weights: w_j of eq. 3.16,
    (n_frames,), scaled to sum 1; None = equal. TooFewFeaturesError for fewer than MIN_POINTS points, BadInputError for weights.
    """

    def __init__(
        self, features: Sequence[ThesisFeatures], T_prior: Matrix, config: Config, weights: Sequence[float] | None = None
    ):
        if not features:
            raise TooFewFeaturesError("no frame can be used; give others")
        self.features, self.thesis, self.camera = features, thesis_of(config), features[0].camera
        self.n_frames, self.n_levels = len(features), len(self.thesis.smoothing)
        self.frame_weights = _frame_weights(weights, len(features))
        self._frames = [self._near(f, T_prior) for f in features]
        found = sum(len(xyz) for xyz, *_ in self._frames)
        if found < MIN_POINTS:
            raise TooFewFeaturesError(
                f"only {found} points near the image in {len(features)} frames (need {MIN_POINTS}); "
                "check the initial extrinsic and the thresholds of the stage thesis"
            )
        self._maps = FastEdgeMaps(self.camera.height, self.camera.width, self.thesis)
        self._kept: dict[bytes, list[Shown]] = {}

    def _near(self, features: ThesisFeatures, T_prior: Matrix) -> tuple[Map, Map, PointLevels]:
        """Points of a frame near the image, their W D, and levels."""
        keep = near_image(features.points.xyz, T_prior, self.camera, MARGIN)
        points = features.points.select(keep)
        matched = points.weight(self.thesis.min_depth) * normalized_discontinuity(points.discontinuity)
        return points.xyz, matched, features.map_levels.select(keep)

    def leave_out(self, frames: NDArray[np.intp]) -> None:
        """Leave out frames (m,): their w_j becomes 0."""
        weights = self.frame_weights.copy()
        weights[frames] = 0
        self.frame_weights = weights / weights.sum()

    def at(self, level: int) -> ThesisLevelScore:
        """The score at one smoothing."""
        return ThesisLevelScore(self, level % self.n_levels)

    def shown(self, T: Matrix) -> list[Shown]:
        """Every frame at T_camera_lidar (4, 4); of the last KEPT extrinsics the same again costs nothing."""
        key = T.tobytes()
        if key not in self._kept:
            if len(self._kept) == KEPT:
                del self._kept[next(iter(self._kept))]
            self._kept[key] = [self._shown(j, T) for j in range(self.n_frames)]
        return self._kept[key]

    def _shown(self, j: int, T: Matrix) -> Shown:
        (xyz, matched, levels), K = self._frames[j], self.camera.K
        M = (K @ T[:3]).astype(np.float32)
        u, v, points = self._maps.visible(M[:, :3] @ xyz.T + M[:, 3:])
        pixels = v.astype(np.intp) * self.camera.width + u
        return Shown(pixels, points, matched[points] + self._maps(u, v, points, levels))

    def frame_scores(self, T: Matrix, level: int = -1) -> Matrix:
        """J_j (n_frames,) at T_camera_lidar (4, 4), normalised if so configured; 0 for a frame without a point in the image."""
        scores = np.zeros(self.n_frames)
        for j, (features, (pixels, _, edges)) in enumerate(zip(self.features, self.shown(T), strict=True)):
            J = float(np.sum(edges * features.image_edges[level].ravel()[pixels], dtype=np.float64))
            mass = float(np.sum(edges, dtype=np.float64)) if self.thesis.normalize else 1.0
            scores[j] = J / max(mass, 1e-12)
        return scores

    @cached_property
    def _atlas(self) -> Atlas:
        return Atlas([f.levels for f in self.features], self.camera)

    def attached(self, T: Matrix) -> PointScore:
        """The approximation "dense edges once per level": W D + E^L at T, attached to the visible points. It is differentiable.

        Points hidden at T stay hidden; edge maps are interpolated, standardised and at all resolutions of image.edges.SIGMAS.
        """
        xyz, weight, frame = [], [], []
        for j, ((near, *_), (_, points, edges)) in enumerate(zip(self._frames, self.shown(T), strict=True)):
            some = np.flatnonzero(edges > 0)
            if not len(some):
                continue
            xyz.append(near[points[some]])
            weight.append(edges[some].astype(np.float64) * (self.frame_weights[j] / edges[some].sum(dtype=np.float64)))
            frame.append(np.full(len(some), j, np.int32))
        if not xyz:
            raise TooFewFeaturesError(
                "no LiDAR edge falls into the image; check the initial extrinsic and the thresholds of the stage thesis"
            )
        weights = np.concatenate(weight)
        normalised, channels = (weights / weights.sum()).astype(np.float32), np.zeros(len(weights), np.intp)
        return PointScore(np.concatenate(xyz).T, normalised, np.concatenate(frame), channels, self._atlas)


@dataclass(frozen=True, eq=False)
class ThesisLevelScore:
    """ThesisScore at one smoothing; a Score."""

    score: ThesisScore
    level: int

    def value(self, T: Matrix) -> float:
        """Weighted sum of the frames' J, eq. 3.16."""
        return float(self.score.frame_weights @ self.score.frame_scores(T, self.level))


class Shown(NamedTuple):
    """A frame at an extrinsic. pixels: flat (m,), those with a point. points: (m,) visible ones. edges: (m,) their W D + E^L."""

    pixels: NDArray[np.intp]
    points: NDArray[np.intp]
    edges: Map


def _frame_weights(weights: Sequence[float] | None, n: int) -> Matrix:
    w = np.ones(n) if weights is None else np.asarray(weights, float)
    if w.shape != (n,) or not np.isfinite(w).all() or (w < 0).any() or not w.any():
        raise BadInputError(f"weights of {n} frames must be {n} numbers from 0, not all 0, got {weights!r}")
    return np.asarray(w / w.sum())


@dataclass(frozen=True, eq=False)
class RegistrationMaps:
    """All maps (h, w) of a frame at an extrinsic: D^L and W^L of 3.4.4, E^L and the maps before it, E^I. Eq. 3.12 written out."""

    discontinuity: Map
    weight: Map
    lidar: EdgeMaps
    image_edges: Map

    def edge_registration_score(self) -> float:
        """J of eq. 3.12: the sum over all pixels of W D E^I + E^L E^I."""
        matched = (self.weight * self.discontinuity) * self.image_edges + self.lidar.lidar_edges * self.image_edges
        return float(np.sum(matched, dtype=np.float64))

    def lidar_mass(self) -> float:
        """The sum of W D + E^L: J of an image that is all edge. J divided by it is the normalised score."""
        return float(np.sum(self.weight * self.discontinuity + self.lidar.lidar_edges, dtype=np.float64))


def registration_maps(features: ThesisFeatures, T: Matrix, config: ThesisConfig, smoothing: int = -1) -> RegistrationMaps:
    """All maps of a frame at T_camera_lidar (4, 4). smoothing: which of ``thesis.smoothing``."""
    points, camera = features.points, features.camera
    shape = (camera.height, camera.width)
    u, v, inside = project(points.xyz, T, camera)
    pixels, kept = nearest_per_pixel(v * camera.width + u, inside, camera.height * camera.width)
    discontinuity, weight = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    discontinuity.ravel()[pixels] = normalized_discontinuity(points.discontinuity)[kept]
    weight.ravel()[pixels] = points.weight(config.min_depth)[kept]
    lidar = edge_maps(pixels, features.map_levels.select(kept), shape, config)
    return RegistrationMaps(discontinuity, weight, lidar, features.image_edges[smoothing])


def normalized_discontinuity(xi: Map) -> Map:
    """xi of eq. 3.10 (n,) m -> 0..1, as the grey value of D^L: a jump of MAX_DISCONTINUITY and more is 1."""
    return np.asarray(np.minimum(xi / np.float32(MAX_DISCONTINUITY), 1), np.float32)
