"""Edges of a completed depth map on image edges (Castorena et al. 2016; thesis eq. 4.4 and 4.5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera
from calib_ros.config import Config
from calib_ros.errors import TooFewFeaturesError
from calib_ros.evaluation.methods.castorena_depth import DepthCompletion, slopes
from calib_ros.evaluation.methods.fista import fista
from calib_ros.evaluation.methods.method import Outcome, Watched
from calib_ros.evaluation.methods.view import Viewer
from calib_ros.frame import Frame
from calib_ros.registration.projection import near_image, project
from calib_ros.registration.search_box import SearchBox

Matrix = NDArray[np.float64]
Map = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class CastorenaFeatures:
    """Of one frame. gray: (h, w) uint8. xyz: (n, 3) float32 m, LiDAR frame, far ones first."""

    camera: Camera
    gray: NDArray[np.uint8]
    xyz: NDArray[np.float32]


@dataclass(frozen=True)
class Castorena:
    """Method: -F of eq. 4.4, by FISTA.

    w: F has to be small where the depth is steep at edges of the image, so w must be small there: exp(-gamma |grad I|). Eq. 4.5
    as the thesis prints it has no minus, and F would be smallest where depth edges avoid those of the image.
    F: as printed it falls as 1/|Omega|, though the denominator is to make the number of points not count; the score is
    -|Omega| F, that is, with means for the sums. Of the peaks of the single-axis curves of 12 KITTI frames 92 % lie within
    0.4 deg or 12 cm of the truth, of those of F as printed 78 %, and 53 % at gamma 10.

    gamma: for I in 0..1; 5 to 50 do alike. image_sigma, depth_sigma: px, the blur of I and of the completion. A little blur keeps
    the noise of the camera from weighing as an edge, and a step of I no narrower than the steps of phi, which are as wide as
    points are apart. By the same peaks 0 and 1 px do alike for I, 2 px worse (87 %); 1.5 and 3 px alike for the depth,
    morphological completion worse (79 to 88 %). scales: of both blurs, one search after the other; the last is
    the score. With (4, 2, 1) 58 % of 19 KITTI frames end within 0.5 deg and 15 cm from up to 1 deg and 0.1 m per axis, with 1
    alone 47 %; from twice as far 37 % and none. finest_deg: half width of the last differences, half a pixel of KITTI's camera.
    margin: points within this share of the image width around it are kept, enough for 10 deg or 0.5 m.
    """

    gamma: float = 50.0
    image_sigma: float = 1.0
    depth_sigma: float = 1.5
    scales: tuple[float, ...] = (4.0, 2.0, 1.0)
    finest_deg: float = 0.05
    evaluations: int = 500  # per scale; most searches end after 100 to 300
    margin: float = 0.3
    min_points: int = 500  # per frame; of fewer no map can be completed
    config: Config = field(default_factory=Config)
    name: str = "castorena"
    title: str = "Castorena et al. (2016): edges of the completed depth map on image edges"

    @cached_property
    def _viewer(self) -> Viewer:
        return Viewer(self.config)

    def features(self, frame: Frame) -> CastorenaFeatures:
        """Picture and points. TooFewFeaturesError if hardly anything returned."""
        view = self._viewer(frame)
        order = np.argsort(-np.linalg.norm(view.xyz, axis=1), kind="stable")
        return CastorenaFeatures(view.camera, view.gray, view.xyz[order])

    def score(self, features: Sequence[CastorenaFeatures], T_prior: Matrix) -> CastorenaScore:
        """Mean of the frames' scores. TooFewFeaturesError for fewer than min_points per frame near the image at T_prior."""
        return CastorenaScore(self, features, T_prior, self.scales[-1])

    def optimise(self, features: Sequence[CastorenaFeatures], T: Matrix, reach: SearchBox) -> Outcome:
        """FISTA within reach, coarse to fine. The trace holds the start and the steps of the last search; all are counted."""
        watched, found = Watched(self.score(features, T)), T
        start = watched.value(T)
        for scale in self.scales[:-1]:
            coarse = Watched(CastorenaScore(self, features, T, scale))
            found, _ = fista(coarse, T, reach.half_width(), self.finest_deg * scale, self.evaluations, found)
            watched.evaluations += coarse.evaluations
        found, end = fista(watched, T, reach.half_width(), self.finest_deg, self.evaluations, found)
        return watched.outcome(found if end > start else T)


def edge_weights(gray: NDArray[np.uint8], gamma: float, sigma: float) -> Map:
    """w_x and w_y of eq. 4.5, (2, h, w): exp(-gamma |grad_k I|), I in 0..1 and blurred by a Gaussian of sigma px, 0 = not."""
    image = gray.astype(np.float32) / np.float32(255)
    if sigma > 0:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), np.float32)
    return np.asarray(np.exp(np.float32(-gamma) * np.stack(slopes(image))), np.float32)


def misfit(weights: tuple[Map, Map], steepness: tuple[Map, Map]) -> float:
    """|Omega| F of eq. 4.4 by w_k and |grad_k phi| at the pixels of Omega, (m,) for k = x and y.

    1 per direction where depth and image edges have nothing to do with each other; so it counts, too, where there is no edge.
    """
    total = 0.0
    for w, slope in zip(weights, steepness, strict=True):
        N = float(w.sum(dtype=np.float64)) * float(slope.sum(dtype=np.float64))
        total += len(w) * float(w @ slope) / N if N > 0 else 1.0
    return total


class CastorenaScore:
    """-|Omega| F, the mean over frames, with both blurs `scale` times as wide as the method says; a Score."""

    def __init__(self, method: Castorena, features: Sequence[CastorenaFeatures], T_prior: Matrix, scale: float) -> None:
        if not features:
            raise TooFewFeaturesError("no frame to score; give at least one")
        self.camera = camera = features[0].camera
        self._complete = DepthCompletion(camera.height, camera.width, method.depth_sigma * scale)
        self._frames = []
        for own in features:
            xyz = own.xyz[near_image(own.xyz, T_prior, camera, method.margin)]
            weights = edge_weights(own.gray, method.gamma, method.image_sigma * scale)
            self._frames.append((xyz, weights.reshape(2, -1)))
        found, needed = sum(len(xyz) for xyz, _ in self._frames), method.min_points * len(features)
        if found < needed:
            raise TooFewFeaturesError(f"only {found} points near the image (need {needed}); check the initial extrinsic")

    def value(self, T: Matrix) -> float:
        """At T_camera_lidar (4, 4)."""
        return -float(np.mean([self._misfit(T, xyz, weights) for xyz, weights in self._frames]))

    def _misfit(self, T: Matrix, xyz: Map, weights: Map) -> float:
        u, v, points = project(xyz, T, self.camera)
        depth = xyz[points] @ T[2, :3].astype(np.float32) + np.float32(T[2, 3])
        pixels, x, y = self._complete.slopes_at_points(u, v, depth)
        return misfit((weights[0][pixels], weights[1][pixels]), (x, y))
