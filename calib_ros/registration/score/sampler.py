"""Map values under projected points, and their derivatives: the inner loop of every score.

Written twice: in C, one pass per extrinsic without temporaries, and with NumPy and OpenCV, which is the reference, and what is
used where the package was installed without a C compiler. Both work in float32, and agree to its rounding with OpenCV 5, whose
cv2.remap interpolates exactly.
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Iterator
from functools import cache
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.image.edges import UNIT
from calib_ros.registration.score.atlas import REMAP_LIMIT, Atlas, AtlasLevel

Matrix = NDArray[np.float64]
Map = NDArray[np.float32]
Tiles = NDArray[np.int32]
MIN_DEPTH = 0.5  # m along the optical axis; nearer points are not scored, 1/z would let them outweigh all others
FAR = np.float32(1e9)  # m; depth given to points behind the camera, which then have no slope
REMAP_WIDTH = 1024  # the points are laid out in rows of this length for cv2.remap
ALL_POINTS = np.zeros(1, np.int64)  # one group
BATCH = 65536  # points of a batch of extrinsics; more fall out of the processor's cache


class Sampler(Protocol):
    """The maps of an atlas under its points. T is T_camera_lidar (4, 4). Returned arrays are valid until the same thread's next
    call; threads do not disturb each other."""

    def samples(self, T: Matrix, level: int) -> Map:
        """Map value (n,) under every point; 0 outside the frame."""
        ...

    def values(self, transforms: Matrix, level: int) -> Matrix:
        """Weighted sum (k,) of the map values at each of (k, 4, 4)."""
        ...

    def group_values(self, transforms: Matrix, level: int, first: NDArray[np.intp]) -> Matrix:
        """Weighted sums (k, m) of groups of consecutive points, which begin at the points `first` (m,)."""
        ...

    def jacobian(self, T: Matrix, level: int) -> Map:
        """Derivative of every map value by a left twist at T, (6, n).

        The map's gradient is taken over +- half the blur: the finest structure then does not make it noise.
        """
        ...

    def linearise(self, transforms: Matrix, level: int) -> tuple[Matrix, Matrix]:
        """Gradients (k, 6) of the weighted sums, and the weighted outer products of the derivatives (k, 6, 6)."""
        ...

    def gradients(self, transforms: Matrix, level: int) -> Matrix:
        """The gradients (k, 6) alone."""
        ...


def make_sampler(points: Map, weights: Map, tiles: Tiles, atlas: Atlas) -> Sampler:
    """The compiled one, where it is installed. points: (3, n). tiles: (n,) of the atlas, those that the points look at."""
    kernel = compiled_kernel()
    if kernel is None:
        return NumpySampler(points, weights, tiles, atlas)
    return CompiledSampler(kernel, points, weights, tiles, atlas)


def slope_step(level: AtlasLevel) -> float:
    """Half the distance, px, over which the slope of a map is taken."""
    return max(level.sigma / 2, 0.5)


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
        self._cylinder = atlas.camera.is_cylinder
        self._scratch = _Scratch(points.shape[1])

    def _corner(self, level: int) -> Map:
        """Left and top edge (2, n) of every point's tile."""
        if level not in self._corners:
            self._corners[level] = np.ascontiguousarray(self._atlas.levels[level].corner[self._tiles].T)
        return self._corners[level]

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
        cv2.remap(self._atlas.unpacked(k), own.map_u.reshape(out.shape), own.map_v.reshape(out.shape), cv2.INTER_LINEAR, dst=out)
        return np.asarray(out.ravel()[:n])

    def _samples_of_many(self, transforms: Matrix, level: int) -> Iterator[Map]:
        """Map values (k, n) of some extrinsics after the other."""
        n, own, corner = self._points.shape[1], self._atlas.levels[level], self._corner(level)
        if n > REMAP_LIMIT:
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
            yield np.asarray(cv2.remap(self._atlas.unpacked(level), u, v, cv2.INTER_LINEAR))

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


class _View(ctypes.Structure):
    """The struct View of kernel.c: change both together."""

    _fields_ = (
        ("image", ctypes.c_void_p),
        ("stride", ctypes.c_ssize_t),
        *((name, ctypes.c_void_p) for name in ("x", "y", "z", "weight", "left", "top")),
        ("count", ctypes.c_ssize_t),
        *((name, ctypes.c_float) for name in ("fx", "fy", "cx", "cy", "width", "height", "step", "unit")),
        ("cylinder", ctypes.c_int),
    )


class _Results(threading.local):
    """Arrays that CompiledSampler returns for n points, every thread its own; made when they are asked for."""

    def __init__(self, n: int) -> None:
        self._n = n
        self._samples: Map | None = None
        self._J: Map | None = None

    def samples(self) -> Map:
        """(n,)."""
        if self._samples is None:
            self._samples = np.empty(self._n, np.float32)
        return self._samples

    def jacobian(self) -> Map:
        """(6, n)."""
        if self._J is None:
            self._J = np.empty((6, self._n), np.float32)
        return self._J


class CompiledSampler:
    """Sampler by kernel.c. Its calls release the interpreter lock: ctypes does so for every function of a CDLL."""

    def __init__(self, kernel: ctypes.CDLL, points: Map, weights: Map, tiles: Tiles, atlas: Atlas) -> None:
        self._kernel, self._atlas, self._n = kernel, atlas, points.shape[1]
        # The views hold addresses: these arrays must live as long, and lie in memory as C expects.
        self._points, self._weights = np.ascontiguousarray(points, np.float32), np.ascontiguousarray(weights, np.float32)
        self._tiles = tiles
        self._made: dict[int, ctypes._Pointer[_View]] = {}
        self._results = _Results(self._n)

    def _view(self, level: int) -> ctypes._Pointer[_View]:
        """The view of a level, made when it is asked for: few samplers are used on all of them."""
        made = self._made.get(level)
        return made if made is not None else self._made.setdefault(level, ctypes.pointer(self._new_view(level)))

    def _new_view(self, level: int) -> _View:
        own, row = self._atlas.levels[level], self._points.strides[0]
        points, K = self._points.ctypes.data, own.K
        left, top = (np.ascontiguousarray(edge[self._tiles], np.float32) for edge in own.corner.T)
        if own.image.dtype != np.int16 or own.image.strides[1] != own.image.itemsize:
            raise TypeError("the maps of an atlas must be int16 without gaps within a row")
        view = _View(
            image=own.image.ctypes.data, stride=own.image.strides[0] // own.image.itemsize,
            x=points, y=points + row, z=points + 2 * row, weight=self._weights.ctypes.data,
            left=left.ctypes.data, top=top.ctypes.data, count=self._n,
            fx=K[0, 0], fy=K[1, 1], cx=K[0, 2], cy=K[1, 2], width=own.width, height=own.height, step=slope_step(own),
            unit=UNIT, cylinder=self._atlas.camera.is_cylinder,
        )  # fmt: skip
        view.corners = left, top  # which live as long as the view
        return view

    def samples(self, T: Matrix, level: int) -> Map:
        """See Sampler."""
        rows, out = _rows(T[None]), self._results.samples()
        self._kernel.calib_samples(self._view(level), rows.ctypes.data, 1, out.ctypes.data)
        return out

    def values(self, transforms: Matrix, level: int) -> Matrix:
        """See Sampler."""
        return self.group_values(transforms, level, ALL_POINTS)[:, 0]

    def group_values(self, transforms: Matrix, level: int, first: NDArray[np.intp]) -> Matrix:
        """See Sampler."""
        rows, starts, out = _rows(transforms), np.ascontiguousarray(first, np.int64), np.empty((len(transforms), len(first)))
        self._kernel.calib_values(
            self._view(level), rows.ctypes.data, len(rows), starts.ctypes.data, len(starts), out.ctypes.data
        )
        return out

    def jacobian(self, T: Matrix, level: int) -> Map:
        """See Sampler."""
        rows, out = _rows(T[None]), self._results.jacobian()
        self._kernel.calib_jacobian(self._view(level), rows.ctypes.data, out.ctypes.data)
        return out

    def linearise(self, transforms: Matrix, level: int) -> tuple[Matrix, Matrix]:
        """See Sampler."""
        rows, n = _rows(transforms), len(transforms)
        gradients, scales = np.empty((n, 6)), np.empty((n, 6, 6))
        self._kernel.calib_linearise(self._view(level), rows.ctypes.data, n, gradients.ctypes.data, scales.ctypes.data)
        return gradients, scales

    def gradients(self, transforms: Matrix, level: int) -> Matrix:
        """See Sampler."""
        rows, out = _rows(transforms), np.empty((len(transforms), 6))
        self._kernel.calib_linearise(self._view(level), rows.ctypes.data, len(rows), out.ctypes.data, None)
        return out


def _rows(transforms: Matrix) -> Matrix:
    """The upper three rows (k, 3, 4) of transforms (k, 4, 4), one after the other in memory."""
    return np.ascontiguousarray(transforms[:, :3], np.float64)


@cache
def compiled_kernel() -> ctypes.CDLL | None:
    """The library made of kernel.c; None where it was not built."""
    for suffix in EXTENSION_SUFFIXES:
        path = Path(__file__).with_name(f"kernel{suffix}")
        if path.exists():
            break
    else:
        return None
    try:
        library = ctypes.CDLL(str(path))
        library.calib_view_size.restype = ctypes.c_ssize_t
        if library.calib_view_size() != ctypes.sizeof(_View):
            return None  # built from another version of the sources
    except (OSError, AttributeError):  # built for another machine, or something else
        return None
    address, count = ctypes.c_void_p, ctypes.c_ssize_t
    view = ctypes.POINTER(_View)
    library.calib_samples.argtypes = (view, address, count, address)
    library.calib_values.argtypes = (view, address, count, address, count, address)
    library.calib_jacobian.argtypes = (view, address, address)
    library.calib_linearise.argtypes = (view, address, count, address, address)
    for function in (library.calib_samples, library.calib_values, library.calib_jacobian, library.calib_linearise):
        function.restype = None
    return library
