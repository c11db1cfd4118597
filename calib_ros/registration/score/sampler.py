"""Map values under projected points, and their derivatives: the inner loop of every score.

kernel.c does it in one pass per extrinsic without temporaries, in float32; setup.py has it compiled.
"""

from __future__ import annotations

import ctypes
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib_ros.arrays import Matrix, Transform
from calib_ros.errors import MissingDependencyError
from calib_ros.image.edges import UNIT
from calib_ros.registration.score.atlas import Atlas, AtlasLevel

Map = NDArray[np.float32]
Tiles = NDArray[np.int32]
MIN_DEPTH = 0.5  # m along the optical axis; nearer points are not scored, 1/z would let them outweigh all others
ALL_POINTS = np.zeros(1, np.int64)  # one group


def slope_step(level: AtlasLevel) -> float:
    """Half the distance, px, over which the slope of a map is taken."""
    return max(level.sigma / 2, 0.5)


class _View(ctypes.Structure):
    """The struct View of kernel.c: change both together."""

    _fields_ = (
        ("image", ctypes.c_void_p),
        ("stride", ctypes.c_ssize_t),
        *((name, ctypes.c_void_p) for name in ("x", "y", "z", "weight", "left", "top")),
        ("count", ctypes.c_ssize_t),
        *((name, ctypes.c_float) for name in ("fx", "fy", "cx", "cy", "width", "height", "step", "unit")),
        ("sphere", ctypes.c_int),
    )


def load_library(source: Path, size_function: str, struct: type[ctypes.Structure]) -> ctypes.CDLL:
    """The library made of a C file; its size_function gives the size of the struct that both sides know. Raises
    MissingDependencyError where it was not built from these sources."""
    path = source.with_suffix(".abi3.so")
    library = None
    with suppress(OSError, AttributeError):  # absent, built for another machine, or something else
        library = ctypes.CDLL(str(path))
        library[size_function].restype = ctypes.c_ssize_t
        if library[size_function]() != ctypes.sizeof(struct):
            library = None
    if library is None:
        state = f"({path}) was built from other sources or for another machine" if path.exists() else "was not built"
        raise MissingDependencyError(
            f"the compiled kernel of calib_ros {state}: install gcc, then `pip install .` or `colcon build` in the sources"
        )
    return library


def load_kernel() -> ctypes.CDLL:
    """The library made of kernel.c, see load_library."""
    library = load_library(Path(__file__).with_name("kernel.c"), "calib_view_size", _View)
    address, count = ctypes.c_void_p, ctypes.c_ssize_t
    view = ctypes.POINTER(_View)
    library.calib_samples.argtypes = (view, address, count, address)
    library.calib_values.argtypes = (view, address, count, address, count, address)
    library.calib_jacobian.argtypes = (view, address, address)
    library.calib_linearise.argtypes = (view, address, count, address, address)
    for function in (library.calib_samples, library.calib_values, library.calib_jacobian, library.calib_linearise):
        function.restype = None
    return library


KERNEL = load_kernel()


class Sampler:
    """The maps of an atlas under its points, by kernel.c. T is T_camera_lidar (4, 4). Calls release the interpreter lock.

    points: (3, n). weights: (n,).
    """

    def __init__(self, points: Map, weights: Map, tiles: Tiles, atlas: Atlas) -> None:
        """tiles: (n,) of the atlas, those that the points look at."""
        self.atlas, self._tiles = atlas, tiles
        # The views hold addresses: these arrays must live as long, and lie in memory as C expects.
        self.points, self.weights = np.ascontiguousarray(points, np.float32), np.ascontiguousarray(weights, np.float32)
        self._made: dict[int, ctypes._Pointer[_View]] = {}

    def _view(self, level: int) -> ctypes._Pointer[_View]:
        """The view of a level, made when it is asked for: few samplers are used on all of them."""
        if (made := self._made.get(level)) is not None:
            return made
        own, row = self.atlas.levels[level], self.points.strides[0]
        points, K = self.points.ctypes.data, own.K
        left, top = (np.ascontiguousarray(edge[self._tiles], np.float32) for edge in own.corner.T)
        if own.image.dtype != np.int16 or own.image.strides[1] != own.image.itemsize:
            raise TypeError("the maps of an atlas must be int16 without gaps within a row")
        view = _View(
            image=own.image.ctypes.data, stride=own.image.strides[0] // own.image.itemsize,
            x=points, y=points + row, z=points + 2 * row, weight=self.weights.ctypes.data,
            left=left.ctypes.data, top=top.ctypes.data, count=self.points.shape[1],
            fx=K[0, 0], fy=K[1, 1], cx=K[0, 2], cy=K[1, 2], width=own.width, height=own.height, step=slope_step(own),
            unit=UNIT, sphere=self.atlas.camera.is_sphere,
        )  # fmt: skip
        view.corners = left, top  # which live as long as the view
        return self._made.setdefault(level, ctypes.pointer(view))

    def samples(self, T: Transform, level: int) -> Map:
        """Map value (n,) under every point; 0 outside the frame."""
        rows, out = _rows(T[None]), np.empty(self.points.shape[1], np.float32)
        KERNEL.calib_samples(self._view(level), rows.ctypes.data, 1, out.ctypes.data)
        return out

    def values(self, transforms: Matrix, level: int) -> Matrix:
        """Weighted sum (k,) of the map values at each of (k, 4, 4): for the starts of a search, where calls would cost most."""
        return self.group_values(transforms, level, ALL_POINTS)[:, 0]

    def group_values(self, transforms: Matrix, level: int, first: NDArray[np.intp]) -> Matrix:
        """Weighted sums (k, m) of groups of consecutive points, which begin at the points `first` (m,)."""
        rows, starts, out = _rows(transforms), np.ascontiguousarray(first, np.int64), np.empty((len(transforms), len(first)))
        KERNEL.calib_values(self._view(level), rows.ctypes.data, len(rows), starts.ctypes.data, len(starts), out.ctypes.data)
        return out

    def jacobian(self, T: Transform, level: int) -> Map:
        """Derivative of every map value by a left twist at T, (6, n): over half the blur, or fine structure makes it noise."""
        rows, out = _rows(T[None]), np.empty((6, self.points.shape[1]), np.float32)
        KERNEL.calib_jacobian(self._view(level), rows.ctypes.data, out.ctypes.data)
        return out

    def linearise(self, transforms: Matrix, level: int) -> tuple[Matrix, Matrix]:
        """Gradients (k, 6) of the weighted sums, and the weighted outer products of the derivatives (k, 6, 6)."""
        rows, n = _rows(transforms), len(transforms)
        gradients, scales = np.empty((n, 6)), np.empty((n, 6, 6))
        KERNEL.calib_linearise(self._view(level), rows.ctypes.data, n, gradients.ctypes.data, scales.ctypes.data)
        return gradients, scales

    def gradients(self, transforms: Matrix, level: int) -> Matrix:
        """The gradients (k, 6) alone."""
        rows, out = _rows(transforms), np.empty((len(transforms), 6))
        KERNEL.calib_linearise(self._view(level), rows.ctypes.data, len(rows), out.ctypes.data, None)
        return out


def _rows(transforms: Matrix) -> Matrix:
    """The upper three rows (k, 3, 4) of transforms (k, 4, 4), one after the other in memory."""
    return np.ascontiguousarray(transforms[:, :3], np.float64)
