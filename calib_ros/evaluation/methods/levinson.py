"""Depth discontinuities on image edges (Levinson and Thrun 2013; thesis eq. 4.2 and 4.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera
from calib_ros.config import Config
from calib_ros.errors import TooFewFeaturesError
from calib_ros.evaluation.methods.levinson_grid import grid_search
from calib_ros.evaluation.methods.levinson_image import edge_image, edginess
from calib_ros.evaluation.methods.method import Outcome, Watched
from calib_ros.evaluation.methods.view import Viewer
from calib_ros.frame import Frame
from calib_ros.lidar.discontinuity import discontinuity
from calib_ros.registration.projection import MIN_DEPTH, near_image
from calib_ros.registration.search_box import SearchBox

Matrix = NDArray[np.float64]
Map = NDArray[np.float32]
BLOCK = 32768  # points of several extrinsics at a time: their arrays stay in the processor's cache


@dataclass(frozen=True, eq=False)
class LevinsonFeatures:
    """Of one frame. xyz: (n, 3) float32 m, LiDAR frame, the points behind which it is far. xi: (n,) float32, eq. 4.3.
    edginess: D of eq. 4.2, (h, w) float32 grey levels."""

    camera: Camera
    xyz: NDArray[np.float32]
    xi: NDArray[np.float32]
    edginess: Map


@dataclass(frozen=True)
class Levinson:
    """Method: the sum of xi D, by grid search. alpha, gamma, exponent and least_m are the published ones.

    finest_deg, finest_m: the search ends below; a pixel of KITTI's camera is 0.08 deg wide, its LiDAR measures to 2 cm. margin:
    points within this share of the image width around it are kept, enough for 10 deg or 0.5 m.
    """

    alpha: float = 1 / 3
    gamma: float = 0.98
    exponent: float = 0.5
    least_m: float = 0.3
    finest_deg: float = 0.02
    finest_m: float = 0.003
    margin: float = 0.3
    min_points: int = 50  # per frame; fewer discontinuities are a wall or a covered sensor
    config: Config = field(default_factory=Config)
    name: str = "levinson"
    title: str = "Levinson and Thrun (2013): depth discontinuities on image edges"

    @cached_property
    def _viewer(self) -> Viewer:
        return Viewer(self.config)

    def features(self, frame: Frame) -> LevinsonFeatures:
        """Points in front of a depth discontinuity of more than least_m, and D. TooFewFeaturesError for fewer than min_points."""
        view = self._viewer(frame)
        jump = discontinuity(view.measured)
        keep = np.flatnonzero(jump > self.least_m)
        if len(keep) < self.min_points:
            raise _too_few(len(keep), self.min_points, "check that the LiDAR sees objects in front of others")
        D = edginess(edge_image(view.gray), self.alpha, self.gamma)
        return LevinsonFeatures(view.camera, view.xyz[keep], jump[keep] ** np.float32(self.exponent), D)

    def score(self, features: Sequence[LevinsonFeatures], T_prior: Matrix) -> LevinsonScore:
        """Mean of the frames' J. TooFewFeaturesError for fewer than min_points per frame near the image at T_prior."""
        return LevinsonScore(features, T_prior, self.margin, self.min_points)

    def optimise(self, features: Sequence[LevinsonFeatures], T: Matrix, reach: SearchBox) -> Outcome:
        """Grid search within reach, by steps from half of it."""
        score = self.score(features, T)
        watched = Watched(score)
        finest = np.repeat([np.deg2rad(self.finest_deg), self.finest_m], 3)
        return watched.outcome(grid_search(score, watched, T, reach.half_width(), finest))


@dataclass(frozen=True, eq=False)
class _FramePoints:
    """Of one frame, near the image. xyz: (3, n). xi: (n,). table: D (h + 1, w + 1) ravelled, 0 in the last row and column."""

    xyz: Map
    xi: Map
    table: Map


class LevinsonScore:
    """J of eq. 4.3, the mean over frames; a ManyScore. Points outside the image, or less than MIN_DEPTH in front of it, add 0."""

    def __init__(self, features: Sequence[LevinsonFeatures], T_prior: Matrix, margin: float, min_points: int) -> None:
        if not features:
            raise TooFewFeaturesError("no frame to score; give at least one")
        self.camera = features[0].camera
        self._K = self.camera.K.astype(np.float32)
        self._frames: list[_FramePoints] = []
        for own in features:
            near = near_image(own.xyz, T_prior, self.camera, margin)
            table = np.pad(own.edginess, ((0, 1), (0, 1))).ravel()
            self._frames.append(_FramePoints(np.ascontiguousarray(own.xyz[near].T), own.xi[near], table))
        found = sum(len(own.xi) for own in self._frames)
        if found < min_points * len(features):
            raise _too_few(found, min_points * len(features), "check the initial extrinsic")

    def value(self, T: Matrix) -> float:
        """At T_camera_lidar (4, 4)."""
        return float(self.values(T[None])[0])

    def values(self, transforms: Matrix) -> Matrix:
        """At many T_camera_lidar (k, 4, 4) at once: (k,)."""
        M = (self.camera.K @ transforms[:, :3]).astype(np.float32)
        total = np.zeros(len(M))
        for own in self._frames:
            step = max(BLOCK // max(len(own.xi), 1), 1)
            for k in range(0, len(M), step):
                total[k : k + step] += self._sampled(own, M[k : k + step]) @ own.xi
        return total / len(self._frames)

    def _sampled(self, own: _FramePoints, M: Map) -> Map:
        """D (k, n) under the points by projections M (k, 3, 4)."""
        width, height, n = self.camera.width, self.camera.height, len(own.xi)
        p = (M[:, :, :3].reshape(-1, 3) @ own.xyz).reshape(len(M), 3, n)
        p += M[:, :, 3:]
        u, v, z = p[:, 0], p[:, 1], p[:, 2]
        outside = z < MIN_DEPTH
        z[outside] = 1
        for row, size in ((u, width), (v, height)):
            row /= z
            np.rint(row, out=row)
            outside |= (row < 0) | (row >= size)
        u[outside], v[outside] = width, height
        v *= width + 1
        v += u  # exact: pictures of less than 2^24 pixels
        return own.table.take(v.astype(np.int32))


def _too_few(found: int, needed: int, remedy: str) -> TooFewFeaturesError:
    return TooFewFeaturesError(f"only {found} points before a depth discontinuity (need {needed}); {remedy}")
