"""A score of points on maps: points of all frames, one atlas image per resolution, one remap.

The maps of all frames stand as tiles in one large image per level (the atlas). Every point knows its tile, so projecting
all points and adding the tile's offset lets a single cv2.remap sample all frames at once.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera
from calib_ros.errors import TooFewFeaturesError
from calib_ros.image.edges import EdgeLevel
from calib_ros.registration.projection import MIN_DEPTH

Matrix = NDArray[np.float64]
Map = NDArray[np.float32]
PAD = 2  # empty rows and columns between tiles, so that samples outside a frame read 0
REMAP_LIMIT = 32000  # px; cv2.remap takes images of less than 2^15 pixels a side
REMAP_WIDTH = 1024  # the points are laid out in rows of this length for cv2.remap


@dataclass(frozen=True, eq=False)
class ScoredPoints:
    """Points of several frames, frame after frame.

    xyz: (3, n) float32 m, LiDAR frame. weight: (n,) float32, sums up to 1. frame: (n,) number of the frame. channel: (n,)
    which of the frame's maps is sampled.
    """

    xyz: NDArray[np.float32]
    weight: NDArray[np.float32]
    frame: NDArray[np.int32]
    channel: NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class _Atlas:
    image: Map  # all tiles
    u0: Map  # (n,) left edge of each point's tile
    v0: Map  # (n,) top edge
    K: NDArray[np.float64]  # intrinsics at the level's scale
    width: int
    height: int
    sigma: float  # blur in pixels of the level


class PointScore:
    """Weighted mean of the map values under the points, at several resolutions.

    points: of all frames. levels: per frame, its maps coarse to fine. camera: pinhole of the maps at full size.
    """

    def __init__(self, points: ScoredPoints, levels: Sequence[Sequence[EdgeLevel]], camera: Camera) -> None:
        self.camera, self.n_frames = camera, len(levels)
        self.points, self.weights, self.frame = points.xyz, points.weight, points.frame
        self._atlases = [_atlas([own[k] for own in levels], points, camera) for k in range(len(levels[0]))]
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

    def subset(self, n: int, rng: np.random.Generator) -> PointScore:
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
        """Map value (n,) under the pixels; 0 outside the frame. Overwrites the map buffers."""
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
        """Map value under every point (n,) at T; valid until the next call."""
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
        """Score of every frame alone (n_frames,); NaN for a frame without points."""
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
    """PointScore at one resolution; a SmoothScore."""

    score: PointScore
    level: int

    def value(self, T: Matrix) -> float:
        """Weighted mean of the map under the points."""
        return float(self.score.sample(T, self.level) @ self.score.weights)

    def linearise(self, T: Matrix) -> tuple[Matrix, Matrix]:
        """Gradient (6,) and the weighted outer product of the point derivatives (6, 6), the Gauss-Newton scale."""
        J = self.score.jacobian(T, self.level)
        weighted = J * self.score.weights
        return weighted.sum(axis=1, dtype=np.float64), (weighted @ J.T).astype(np.float64)


def _atlas(levels: Sequence[EdgeLevel], points: ScoredPoints, camera: Camera) -> _Atlas:
    """Lay the maps (c, h, w) of all frames out in columns of tiles that cv2.remap can address."""
    c, h, w = levels[0].maps.shape
    per_column = max(REMAP_LIMIT // (h + PAD), 1)
    tiles = c * len(levels)
    columns = -(-tiles // per_column)
    if columns * (w + PAD) > REMAP_LIMIT:
        raise TooFewFeaturesError(
            f"{len(levels)} frames of {w}x{h} do not fit one score; use fewer frames or a smaller image.max_width"
        )
    image = np.zeros((min(tiles, per_column) * (h + PAD) + PAD, columns * (w + PAD) + PAD), np.float32)
    corner = np.array([(PAD + t // per_column * (w + PAD), PAD + t % per_column * (h + PAD)) for t in range(tiles)], np.float32)
    for t in range(tiles):
        u0, v0 = corner[t].astype(int)
        image[v0 : v0 + h, u0 : u0 + w] = levels[t // c].maps[t % c]
    tile = c * points.frame + points.channel
    scale, sigma = levels[0].scale, levels[0].sigma
    S = np.array([[1 / scale, 0, (1 / scale - 1) / 2], [0, 1 / scale, (1 / scale - 1) / 2], [0, 0, 1]])
    return _Atlas(image, corner[tile, 0].copy(), corner[tile, 1].copy(), S @ camera.K, w, h, sigma / scale)
