"""The inner loop of the scores with NumPy and OpenCV: what kernel.c is compared with.

Both work in float32, and agree to its rounding with OpenCV 5, whose cv2.remap interpolates exactly.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.image.edges import UNIT
from calib_ros.registration.score.atlas import MAX_SIDE, Atlas, AtlasLevel
from calib_ros.registration.score.sampler import MIN_DEPTH, slope_step

Matrix = NDArray[np.float64]
Map = NDArray[np.float32]
Tiles = NDArray[np.int32]
FAR = np.float32(1e9)  # m; depth given to points behind the camera, which then have no slope
REMAP_WIDTH = 1024  # the points are laid out in rows of this length for cv2.remap
BATCH = 65536  # points of a batch of extrinsics; more fall out of the processor's cache


class _Scratch(threading.local):
    """Buffers of NumpySampler for n points, every thread its own."""

    def __init__(self, n: int) -> None:
        padded = -(-n // REMAP_WIDTH) * REMAP_WIDTH
        self.y = np.empty((3, n), np.float32)
        self.u, self.v = (np.empty(n, np.float32) for _ in range(2))
        self.map_u, self.map_v = (np.full(padded, -9, np.float32) for _ in range(2))
        self.sampled = np.empty((2, padded // REMAP_WIDTH, REMAP_WIDTH), np.float32)
        self.J: Map | None = None  # made when a slope is asked for


class NumpySampler:
    """Sampler with buffers that are made once: an allocation of this size costs as much as the arithmetic."""

    def __init__(self, points: Map, weights: Map, tiles: Tiles, atlas: Atlas) -> None:
        self._points, self._weights, self._tiles, self._atlas = points, weights, tiles, atlas
        self._corners: dict[int, Map] = {}
        self._unpacked: dict[int, Map] = {}
        self._cylinder = atlas.camera.is_cylinder
        self._scratch = _Scratch(points.shape[1])

    def _corner(self, level: int) -> Map:
        """Left and top edge (2, n) of every point's tile."""
        if level not in self._corners:
            self._corners[level] = np.ascontiguousarray(self._atlas.levels[level].corner[self._tiles].T)
        return self._corners[level]

    def _image(self, level: int) -> Map:
        """The image of a level as float32, for cv2.remap."""
        if level not in self._unpacked:
            self._unpacked[level] = self._atlas.levels[level].image * np.float32(UNIT)
        return self._unpacked[level]

    def samples(self, T: Matrix, level: int) -> Map:
        """See Sampler."""
        u, v, _ = self._project(T, self._atlas.levels[level])
        return self._sample(level, u, v)

    def values(self, transforms: Matrix, level: int) -> Matrix:
        """See Sampler."""
        if len(transforms) == 1:
            return np.array([self.samples(transforms[0], level) @ self._weights], float)
        return np.concatenate([sampled @ self._weights for sampled in self._samples_of_many(transforms, level)])

    def group_values(self, transforms: Matrix, level: int, first: NDArray[np.intp]) -> Matrix:
        """See Sampler."""
        parts = [np.add.reduceat(e * self._weights, first, axis=1) for e in self._samples_of_many(transforms, level)]
        return np.concatenate(parts).astype(np.float64)

    def linearise(self, transforms: Matrix, level: int) -> tuple[Matrix, Matrix]:
        """See Sampler."""
        gradients, scales = np.empty((len(transforms), 6)), np.empty((len(transforms), 6, 6))
        for k, T in enumerate(transforms):
            J = self.jacobian(T, level)
            gradients[k] = J @ self._weights
            J *= np.sqrt(self._weights)
            scales[k] = J @ J.T
        return gradients, scales

    def gradients(self, transforms: Matrix, level: int) -> Matrix:
        """See Sampler."""
        return np.array([self.jacobian(T, level) @ self._weights for T in transforms], np.float64)

    def _project(self, T: Matrix, level: AtlasLevel) -> tuple[Map, Map, Map]:
        """Pixels (u, v) at the level's scale and depth z, on a cylinder the distance from its axis; points too near or behind get
        u far outside."""
        y, u, v, K = self._scratch.y, self._scratch.u, self._scratch.v, level.K
        np.matmul(T[:3, :3].astype(np.float32), self._points, out=y)
        y += T[:3, 3].astype(np.float32)[:, None]
        if self._cylinder:
            return self._unrolled(K)
        z = y[2]
        behind = z < MIN_DEPTH
        z[behind] = FAR
        for row, out, f, c in ((y[0], u, K[0, 0], K[0, 2]), (y[1], v, K[1, 1], K[1, 2])):
            np.divide(row, z, out=out)
            out *= np.float32(f)
            out += np.float32(c)
        u[behind] = -9
        return u, v, z

    def _unrolled(self, K: Matrix) -> tuple[Map, Map, Map]:
        """_project on a cylinder, of the points in y of the scratch."""
        y, u, v = self._scratch.y, self._scratch.u, self._scratch.v
        z = np.hypot(y[0], y[2])
        near = z < MIN_DEPTH
        z[near] = FAR
        np.arctan2(y[0], y[2], out=u)
        np.divide(y[1], z, out=v)
        for out, f, c in ((u, K[0, 0], K[0, 2]), (v, K[1, 1], K[1, 2])):
            out *= np.float32(f)
            out += np.float32(c)
        u[near] = -9
        return u, v, z

    def _sample(self, k: int, u: Map, v: Map, du: float = 0, dv: float = 0, slot: int = 0) -> Map:
        """Map value (n,) of level k under the pixels, moved by (du, dv). Valid until the slot is used."""
        n, level, corner, own = len(u), self._atlas.levels[k], self._corner(k), self._scratch
        mu, mv = own.map_u[:n], own.map_v[:n]
        for pixel, moved, out, size, offset in ((u, du, mu, level.width, corner[0]), (v, dv, mv, level.height, corner[1])):
            np.add(pixel, np.float32(moved), out=out)
            np.maximum(out, np.float32(-1), out=out)
            np.minimum(out, np.float32(size), out=out)
            out += offset
        out = own.sampled[slot]
        cv2.remap(self._image(k), own.map_u.reshape(out.shape), own.map_v.reshape(out.shape), cv2.INTER_LINEAR, dst=out)
        return np.asarray(out.ravel()[:n])

    def _samples_of_many(self, transforms: Matrix, level: int) -> Iterator[Map]:
        """Map values (k, n) of some extrinsics after the other."""
        n, own, corner = self._points.shape[1], self._atlas.levels[level], self._corner(level)
        if n > MAX_SIDE:
            yield from (self.samples(T, level)[None] for T in transforms)
            return
        K = own.K.astype(np.float32)
        step = max(BATCH // n, 1)
        for k in range(0, len(transforms), step):
            T = transforms[k : k + step].astype(np.float32)
            M = np.eye(3, dtype=np.float32) if self._cylinder else K
            y = ((M @ T[:, :3, :3]).reshape(-1, 3) @ self._points).reshape(len(T), 3, n)
            y += M @ T[:, :3, 3:]
            depth = np.hypot(y[:, 0], y[:, 2]) if self._cylinder else y[:, 2]
            z = np.where(depth < MIN_DEPTH, np.float32(-1), depth)
            if self._cylinder:
                u, v = K[0, 0] * np.arctan2(y[:, 0], y[:, 2]) + K[0, 2], K[1, 1] * y[:, 1] / z + K[1, 2]
            else:
                u, v = y[:, 0] / z, y[:, 1] / z
            u[z < 0] = -1
            np.clip(u, -1, own.width, out=u)
            np.clip(v, -1, own.height, out=v)
            u += corner[0]
            v += corner[1]
            yield np.asarray(cv2.remap(self._image(level), u, v, cv2.INTER_LINEAR))

    def jacobian(self, T: Matrix, level: int) -> Map:
        """See Sampler."""
        own = self._atlas.levels[level]
        u, v, z = self._project(T, own)
        h = slope_step(own)
        scratch = self._scratch
        if scratch.J is None:
            scratch.J = np.empty((6, len(u)), np.float32)
        J = scratch.J
        jx, jy, jz = J[3], J[4], J[5]
        inside = (u >= 0) & (u <= own.width - 1) & (v >= 0) & (v <= own.height - 1)
        np.subtract(self._sample(level, u, v, h, 0, 0), self._sample(level, u, v, -h, 0, 1), out=jx)
        np.subtract(self._sample(level, u, v, 0, h, 0), self._sample(level, u, v, 0, -h, 1), out=jy)
        X, Y = scratch.y[0], scratch.y[1]
        per_depth = np.divide(inside, z, out=u)
        jx *= per_depth
        jy *= per_depth
        jx *= np.float32(own.K[0, 0] / (2 * h))
        jy *= np.float32(own.K[1, 1] / (2 * h))
        aside = v  # no longer needed
        if self._cylinder:
            sine, cosine, slope = X / z, scratch.y[2] / z, Y / z
            upward = jy * slope
            np.multiply(jx, -sine, out=jz)
            jz -= upward * cosine
            jx *= cosine
            jx -= upward * sine
            z = scratch.y[2]
        else:
            np.multiply(jx, X, out=jz)
            jz += np.multiply(jy, Y, out=aside)
            np.negative(jz, out=jz)
            jz /= z
        for k, (a, ja), (b, jb) in ((0, (Y, jz), (z, jy)), (1, (z, jx), (X, jz)), (2, (X, jy), (Y, jx))):
            np.multiply(a, ja, out=J[k])
            J[k] -= np.multiply(b, jb, out=aside)
        return J
