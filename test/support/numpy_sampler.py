"""The inner loop of the scores with NumPy and OpenCV: what kernel.c is compared with.

Both work in float32, and agree to its rounding with OpenCV 5, whose cv2.remap interpolates exactly.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.image.edges import UNIT
from calib_ros.registration.score.atlas import Atlas
from calib_ros.registration.score.sampler import MIN_DEPTH, slope_step

Matrix = NDArray[np.float64]
Map = NDArray[np.float32]
FAR = np.float32(1e9)  # m; depth given to points behind the camera, which then have no slope
REMAP_WIDTH = 1024  # the points are laid out in rows of this length for cv2.remap


class NumpySampler:
    """See Sampler, pose by pose."""

    def __init__(self, points: Map, weights: Map, tiles: NDArray[np.int32], atlas: Atlas) -> None:
        self._points, self._weights, self._levels, self._sphere = points, weights, atlas.levels, atlas.camera.is_sphere
        self._corners = [np.ascontiguousarray(level.corner[tiles].T, np.float32) for level in atlas.levels]
        self._images = [level.image * np.float32(UNIT) for level in atlas.levels]

    def samples(self, T: Matrix, level: int) -> Map:
        u, v, _, _ = self._project(T, level)
        return self._sample(level, u, v)

    def values(self, transforms: Matrix, level: int) -> Matrix:
        return np.array([self.samples(T, level) @ self._weights for T in transforms], float)

    def group_values(self, transforms: Matrix, level: int, first: NDArray[np.intp]) -> Matrix:
        return np.array([np.add.reduceat(self.samples(T, level) * self._weights, first) for T in transforms], float)

    def linearise(self, transforms: Matrix, level: int) -> tuple[Matrix, Matrix]:
        scaled = [self.jacobian(T, level) * np.sqrt(self._weights) for T in transforms]
        return self.gradients(transforms, level), np.array([J @ J.T for J in scaled], float)

    def gradients(self, transforms: Matrix, level: int) -> Matrix:
        return np.array([self.jacobian(T, level) @ self._weights for T in transforms], float)

    def _project(self, T: Matrix, level: int) -> tuple[Map, Map, Map, Map]:
        """Pixels (u, v), u far outside for points too near or behind; depth, on a sphere the distance; points (3, n)."""
        K = self._levels[level].K.astype(np.float32)
        y = T[:3, :3].astype(np.float32) @ self._points + T[:3, 3].astype(np.float32)[:, None]
        depth = np.sqrt((y * y).sum(axis=0)) if self._sphere else y[2]
        hidden = (depth < MIN_DEPTH) | (self._sphere & (y[2] < np.float32(-0.95) * depth))
        z = np.where(hidden, FAR, depth)
        stretch = self._stretch(y, z) if self._sphere else 1 / z
        return np.where(hidden, np.float32(-9), K[0, 0] * (y[0] * stretch) + K[0, 2]), K[1, 1] * (y[1] * stretch) + K[1, 2], z, y

    @staticmethod
    def _stretch(y: Map, distance: Map) -> Map:
        """Angle from the axis per distance from it, rad/m (n,), of points (3, n) so far away (n,)."""
        r = np.hypot(y[0], y[1])
        near = r <= 1e-6
        return np.where(near, 1 / distance, np.arctan2(r, y[2]) / np.where(near, 1, r)).astype(np.float32)

    def _sample(self, level: int, u: Map, v: Map) -> Map:
        """Map value (n,) of a level under the pixels."""
        own, maps = self._levels[level], []
        for pixel, size, offset in zip((u, v), (own.width, own.height), self._corners[level], strict=True):
            row = np.full(-(-len(u) // REMAP_WIDTH) * REMAP_WIDTH, -9, np.float32)
            row[: len(u)] = np.clip(pixel, -1, size) + offset
            maps.append(row.reshape(-1, REMAP_WIDTH))
        return np.asarray(cv2.remap(self._images[level], *maps, cv2.INTER_LINEAR)).ravel()[: len(u)]

    def jacobian(self, T: Matrix, level: int) -> Map:
        own, h = self._levels[level], np.float32(slope_step(self._levels[level]))
        u, v, z, (X, Y, Z) = self._project(T, level)
        inside = (u >= 0) & (u <= own.width - 1) & (v >= 0) & (v <= own.height - 1)
        per_depth = inside / (2 * h * z)
        jx = (self._sample(level, u + h, v) - self._sample(level, u - h, v)) * per_depth * np.float32(own.K[0, 0])
        jy = (self._sample(level, u, v + h) - self._sample(level, u, v - h)) * per_depth * np.float32(own.K[1, 1])
        if self._sphere:
            r = np.hypot(X, Y)
            x, y = np.where(r > 1e-6, (X, Y) / np.maximum(r, 1e-6), [[1], [0]])
            outward, around = jx * x + jy * y, np.where(inside, (jy * x - jx * y) * z * self._stretch(np.stack([X, Y, Z]), z), 0)
            jx, jy, jz = outward * Z / z * x - around * y, outward * Z / z * y + around * x, -outward * r / z
        else:
            jz, Z = -(jx * X + jy * Y) / z, z
        return np.stack([Y * jz - Z * jy, Z * jx - X * jz, X * jy - Y * jx, jx, jy, jz]).astype(np.float32)
