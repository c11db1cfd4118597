"""The fast edge registration score: sparse edge points of all frames, one atlas image, one remap.

The edge maps of all frames stand as tiles in one large image per level (the atlas). Every edge point knows its tile, so
projecting all points and adding the tile's offset lets a single cv2.remap sample all frames at once. The score is the
weighted mean of the standardised edge strength under the edge points: 0 by chance, about 1 when well aligned.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.config import ScoreConfig
from calib_ros.errors import TooFewFeaturesError
from calib_ros.lidar.edge_points import UPWARD, EdgeKind, EdgePoints
from calib_ros.registration.features import FrameFeatures

Matrix = NDArray[np.float64]
Map = NDArray[np.float32]
PAD = 2  # empty rows and columns between tiles, so that samples outside a frame read 0
MIN_DEPTH = 0.5  # m; nearer points are not scored, 1/z would let them outweigh all others
REMAP_LIMIT = 32000  # px; cv2.remap takes images of less than 2^15 pixels a side
REMAP_WIDTH = 1024  # the points are laid out in rows of this length for cv2.remap


class Score(Protocol):
    """A score of an extrinsic, to be maximised."""

    def value(self, T: Matrix) -> float:
        """Score at T_camera_lidar (4, 4)."""
        ...


class SmoothScore(Score, Protocol):
    """A score that knows its slope."""

    def linearise(self, T: Matrix) -> tuple[Matrix, Matrix]:
        """Gradient (6,) of the score by a left twist at T and a positive matrix (6, 6) that scales the step."""
        ...


@dataclass(frozen=True, eq=False)
class _Atlas:
    image: Map  # all tiles
    u0: Map  # (n,) left edge of each point's tile
    v0: Map  # (n,) top edge
    K: NDArray[np.float64]  # intrinsics at the level's scale
    width: int
    height: int
    sigma: float  # blur in pixels of the level


class FastScore:
    """Score of an extrinsic over several frames at several resolutions.

    features: of one camera. T_prior: (4, 4); edge points that it projects far outside the image are left out. Raises
    TooFewFeaturesError when fewer than ``score.min_points`` edge points remain.
    """

    def __init__(self, features: list[FrameFeatures], T_prior: Matrix, config: ScoreConfig) -> None:
        if not features:
            raise TooFewFeaturesError("no frame to score; give at least one")
        self.camera = features[0].camera
        kept = [
            _near_image(f.points, self.camera.K, self.camera.width, self.camera.height, T_prior, config.margin) for f in features
        ]
        self.frame = np.concatenate([np.full(len(p), j, np.int32) for j, p in enumerate(kept)])
        self.n_frames = len(features)
        if len(self.frame) < config.min_points:
            raise TooFewFeaturesError(
                f"only {len(self.frame)} edge points near the image in {len(features)} frames (need {config.min_points}); "
                "wait for a scene with objects, or check the initial extrinsic"
            )
        self.points = np.ascontiguousarray(np.concatenate([p.xyz for p in kept]).T)
        weights = np.concatenate([_weights(p, config) for p in kept])
        self.weights = (weights / weights.sum()).astype(np.float32)
        upward = np.concatenate([np.isin(p.kind, UPWARD) for p in kept])
        self._atlases = [
            _atlas([f.levels[k].maps for f in features], self, upward, features[0], k) for k in range(len(features[0].levels))
        ]
        self._allocate()

    def _allocate(self) -> None:
        """Buffers of the score loop, made once: an allocation of this size costs as much as the arithmetic."""
        n = self.points.shape[1]
        padded = -(-n // REMAP_WIDTH) * REMAP_WIDTH
        self._y = np.empty((3, n), np.float32)
        self._map_u, self._map_v = (np.full(padded, -9, np.float32) for _ in range(2))
        self._sampled = np.empty((padded // REMAP_WIDTH, REMAP_WIDTH), np.float32)

    @property
    def n_levels(self) -> int:
        """Number of resolutions, coarse to fine."""
        return len(self._atlases)

    def at(self, level: int) -> LevelScore:
        """The score at one resolution."""
        return LevelScore(self, level % self.n_levels)

    def subset(self, n: int, rng: np.random.Generator) -> FastScore:
        """The same on n random points; itself if there are no more than n."""
        total = self.points.shape[1]
        if total <= n:
            return self
        keep = np.sort(rng.choice(total, n, replace=False))
        part = copy.copy(self)
        part.points, part.frame = np.ascontiguousarray(self.points[:, keep]), self.frame[keep]
        part.weights = self.weights[keep] / self.weights[keep].sum()
        part._atlases = [_Atlas(a.image, a.u0[keep], a.v0[keep], a.K, a.width, a.height, a.sigma) for a in self._atlases]
        part._allocate()
        return part

    def _project(self, T: Matrix, atlas: _Atlas) -> tuple[Map, Map, Map]:
        """Pixels (u, v) at the level's scale and depth z; points too near or behind get u far outside."""
        y, n = self._y, self.points.shape[1]
        np.matmul(T[:3, :3].astype(np.float32), self.points, out=y)
        y += T[:3, 3].astype(np.float32)[:, None]
        z = y[2]
        behind = z < MIN_DEPTH
        z[behind] = 1e9
        u, v, K = self._map_u[:n], self._map_v[:n], atlas.K
        np.divide(y[0], z, out=u)
        u *= np.float32(K[0, 0])
        u += np.float32(K[0, 2])
        np.divide(y[1], z, out=v)
        v *= np.float32(K[1, 1])
        v += np.float32(K[1, 2])
        u[behind] = -9
        return u, v, z

    def _sample(self, atlas: _Atlas, u: Map, v: Map) -> Map:
        """Edge strength (n,) under the pixels; 0 outside the frame. Overwrites the map buffers."""
        n = len(u)
        mu, mv = self._map_u[:n], self._map_v[:n]
        np.clip(u, -1, atlas.width, out=mu)
        np.clip(v, -1, atlas.height, out=mv)
        mu += atlas.u0
        mv += atlas.v0
        shape = self._sampled.shape
        cv2.remap(atlas.image, self._map_u.reshape(shape), self._map_v.reshape(shape), cv2.INTER_LINEAR, dst=self._sampled)
        return np.asarray(self._sampled.ravel()[:n])

    def sample(self, T: Matrix, level: int) -> Map:
        """Standardised edge strength under every edge point (n,) at T; valid until the next call."""
        atlas = self._atlases[level]
        u, v, _ = self._project(T, atlas)
        return self._sample(atlas, u, v)

    def jacobian(self, T: Matrix, level: int) -> Map:
        """Derivative of every sample by a left twist at T, (6, n).

        The map's gradient is taken over +- half the blur: the finest structure then does not make it noise.
        """
        atlas = self._atlases[level]
        u, v, z = (a.copy() for a in self._project(T, atlas))
        h = np.float32(max(atlas.sigma / 2, 0.5))
        fx, fy = np.float32(atlas.K[0, 0]), np.float32(atlas.K[1, 1])
        gu = self._sample(atlas, u + h, v).copy()
        gu -= self._sample(atlas, u - h, v)
        gv = self._sample(atlas, u, v + h).copy()
        gv -= self._sample(atlas, u, v - h)
        outside = (u < 0) | (u > atlas.width - 1) | (v < 0) | (v > atlas.height - 1)
        gu[outside] = 0
        gv[outside] = 0
        gu *= fx / (2 * h)
        gv *= fy / (2 * h)
        X, Y = self._y[0], self._y[1]  # z is the copy, with points behind pushed to infinity
        jx, jy = gu / z, gv / z
        jz = -(jx * X + jy * Y) / z
        return np.stack([Y * jz - z * jy, z * jx - X * jz, X * jy - Y * jx, jx, jy, jz])

    def frame_scores(self, T: Matrix, level: int = -1) -> Matrix:
        """Score of every frame alone (n_frames,); NaN for a frame without edge points."""
        e = self.sample(T, level % self.n_levels)
        weight = np.bincount(self.frame, self.weights, self.n_frames)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.bincount(self.frame, self.weights * e, self.n_frames) / weight)

    def frame_gradients(self, T: Matrix, level: int = -1) -> Matrix:
        """Gradient of the score by a left twist, frame by frame (n_frames, 6); they sum up to the score's gradient."""
        J = self.jacobian(T, level % self.n_levels) * self.weights
        return np.stack([np.bincount(self.frame, row, self.n_frames) for row in J], axis=1)


@dataclass(frozen=True, eq=False)
class LevelScore:
    """FastScore at one resolution; a SmoothScore."""

    score: FastScore
    level: int

    def value(self, T: Matrix) -> float:
        """Weighted mean of the edge strength under the edge points."""
        return float(self.score.sample(T, self.level) @ self.score.weights)

    def linearise(self, T: Matrix) -> tuple[Matrix, Matrix]:
        """Gradient (6,) and the weighted outer product of the point derivatives (6, 6), the Gauss-Newton scale."""
        J = self.score.jacobian(T, self.level)
        weighted = J * self.score.weights
        return weighted.sum(axis=1, dtype=np.float64), (weighted @ J.T).astype(np.float64)


def _near_image(points: EdgePoints, K: Matrix, width: int, height: int, T: Matrix, margin: float) -> EdgePoints:
    """Points that project into the image or within margin * width around it; the rest cannot come into play."""
    P = points.xyz @ T[:3, :3].T + T[:3, 3]
    z = np.maximum(P[:, 2], 1e-6)
    u, v, m = K[0, 0] * P[:, 0] / z + K[0, 2], K[1, 1] * P[:, 1] / z + K[1, 2], margin * width
    keep = (P[:, 2] > MIN_DEPTH) & (u > -m) & (u < width + m) & (v > -m) & (v < height + m)
    return EdgePoints(points.xyz[keep], points.strength[keep], points.kind[keep], points.ring_spacing)


def _weights(points: EdgePoints, config: ScoreConfig) -> NDArray[np.float64]:
    """Weights (n,) of one frame's points: every kind shares its weight out, unless it has hardly any points.

    Upward edges are known to half a ring spacing only, so that they count less for scanners of few rings.
    """
    upward = float(np.sqrt(min(1.0, np.deg2rad(config.ring_spacing_deg) / max(points.ring_spacing, 1e-6))))
    of_kind = {
        EdgeKind.SIDE: config.weight_side,
        EdgeKind.TOP: config.weight_top * upward,
        EdgeKind.REFLECTIVITY: config.weight_reflectivity,
        EdgeKind.SKY_SIDE: config.weight_sky_side,
        EdgeKind.SKY_TOP: config.weight_sky_top * upward,
    }
    out = points.strength.astype(np.float64)
    for kind, weight in of_kind.items():
        own = points.kind == kind
        if own.any():
            out[own] *= weight / max(out[own].sum(), config.weight_floor * out[own].mean())
    return out


def _atlas(maps: list[Map], score: FastScore, upward: NDArray[np.bool_], features: FrameFeatures, level: int) -> _Atlas:
    """Lay the maps (2, h, w) of all frames out in columns of tiles that cv2.remap can address."""
    _, h, w = maps[0].shape
    per_column = max(REMAP_LIMIT // (h + PAD), 1)
    tiles = 2 * len(maps)
    columns = -(-tiles // per_column)
    if columns * (w + PAD) > REMAP_LIMIT:
        raise TooFewFeaturesError(
            f"{len(maps)} frames of {w}x{h} do not fit one score; use fewer frames or a smaller image.max_width"
        )
    image = np.zeros((min(tiles, per_column) * (h + PAD) + PAD, columns * (w + PAD) + PAD), np.float32)
    corner = np.array([(PAD + t // per_column * (w + PAD), PAD + t % per_column * (h + PAD)) for t in range(tiles)], np.float32)
    for t in range(tiles):
        u0, v0 = corner[t].astype(int)
        image[v0 : v0 + h, u0 : u0 + w] = maps[t // 2][t % 2]
    tile = 2 * score.frame + upward
    scale, K = features.levels[level].scale, features.camera.K
    S = np.array([[1 / scale, 0, (1 / scale - 1) / 2], [0, 1 / scale, (1 / scale - 1) / 2], [0, 0, 1]])
    return _Atlas(image, corner[tile, 0].copy(), corner[tile, 1].copy(), S @ K, w, h, features.levels[level].sigma / scale)
