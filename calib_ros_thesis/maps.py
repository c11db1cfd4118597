"""Edge maps of a scan in the image: sparse maps, density completion, edge operator (thesis 3.4.3, figures 3.13 to 3.16).

A map (h, w) int16 holds levels above 0 at projected points and EMPTY elsewhere. Where structuring elements overlap, the larger
level wins: depth is inverted first, so that near objects keep their outline.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.registration.score.sampler import load_library
from calib_ros_thesis.cloud import PointAttributes
from calib_ros_thesis.config import ThesisConfig
from calib_ros_thesis.image import SOBEL_GAIN
from calib_ros_thesis.image import edges as operator_edges

Levels = NDArray[np.int16]
Floats = NDArray[np.float32]
Places = NDArray[np.int32]
Points = NDArray[np.int64]
MAX_GRADIENT = 32767.0  # of cv2.Canny's thresholds
EMPTY = 0
DEPTH_UNITS = 100.0  # levels per metre
REFLECTIVITY_UNITS = 1000.0  # levels of full scale; 1 is added, since 0 is EMPTY
FAR_LEVEL = 8190  # the Sobel kernels sum four times a level, which has to fit 16 bit
# m, share of full scale; steps of the dense maps that count as a full edge: from one object to the next, not along a surface.
DEPTH_STEP, REFLECTIVITY_STEP = 3.0, 0.2
OBJECT_STEP = 1.0  # any change of the object is a full edge: labels are names, not sizes
NEAREST = np.array([[0, 0, 1, 0, 0], [0, 1, 1, 1, 0], [1, 1, 1, 1, 1], [0, 1, 1, 1, 0], [0, 0, 1, 0, 0]], np.uint8)
# Structuring elements of small, middle and large holes, and of the median, px. With the Gaussian blur that Ku et al. add, the
# error against left-out KITTI points doubles (median 2 to 3.5 cm, 90 % 0.4 to 0.8 m).
SMALL, MIDDLE, LARGE, BLUR = 5, 7, 31, 5
REACH = 2 + 2 * (SMALL // 2) + MIDDLE // 2 + LARGE // 2 + BLUR // 2  # px; of a point in a dense map


@dataclass(frozen=True, eq=False)
class PointLevels:
    """Attributes of points (n,) as integer levels of the maps; EMPTY for what is not in the map: depth of the ground (3.3.2)."""

    depth: Levels
    reflectivity: Levels
    label: NDArray[np.uint8]

    @staticmethod
    def of(points: PointAttributes) -> PointLevels:
        """The levels of points."""
        depth = np.clip(np.rint(points.depth * np.float32(DEPTH_UNITS)), 1, FAR_LEVEL).astype(np.int16)
        depth[points.ground] = EMPTY
        reflectivity = 1 + np.rint(points.reflectivity * np.float32(REFLECTIVITY_UNITS)).astype(np.int16)
        return PointLevels(depth, reflectivity, points.label)

    def select(self, keep: NDArray[np.intp]) -> PointLevels:
        """The levels of these points."""
        return PointLevels(self.depth[keep], self.reflectivity[keep], self.label[keep])


@dataclass(frozen=True, eq=False)
class EdgeMaps:
    """All maps (h, w) from projected points to E^L: sparse Psi, dense Phi, edges delta (float32, 0..1)."""

    sparse_depth: Levels
    sparse_reflectivity: Levels
    sparse_object: NDArray[np.uint8]
    dense_depth: Levels
    dense_reflectivity: Levels
    dense_object: NDArray[np.uint8]
    depth_edges: Floats
    reflectivity_edges: Floats
    object_edges: Floats
    occupied: NDArray[np.bool_]

    @property
    def lidar_edges(self) -> Floats:
        """E^L (h, w): the mean of the three edge maps where a point was projected, 0 elsewhere."""
        total = self.depth_edges + self.reflectivity_edges + self.object_edges
        return np.asarray(np.where(self.occupied, total * np.float32(1 / 3), np.float32(0)), np.float32)


def edge_maps(pixels: NDArray[np.intp], levels: PointLevels, shape: tuple[int, int], config: ThesisConfig) -> EdgeMaps:
    """All maps of an image of `shape` (h, w). The readable form; FastEdgeMaps gives the same E^L.

    pixels: (n,) flat indices, each at most once, of the nearest points. levels: of these points.
    """
    empty = np.zeros(shape[0] * shape[1], np.int16)
    depth, reflectivity, label = empty.copy(), empty.copy(), empty.astype(np.uint8)
    depth[pixels], reflectivity[pixels], label[pixels] = levels.depth, levels.reflectivity, levels.label
    occupied = np.zeros(len(empty), bool)
    occupied[pixels] = True

    dense_depth = complete_depth(depth.reshape(shape), far_level(config))
    completed = complete(reflectivity.reshape(shape))
    dense_reflectivity = np.where(completed > low_level(config), completed, np.int16(0))
    dense_object = close_gaps(label.reshape(shape), config.closing)

    def edges(dense: Levels | NDArray[np.uint8], step: float) -> Floats:
        return operator_edges(dense, config.operator, step, config.canny_low, config.canny_high)

    return EdgeMaps(
        depth.reshape(shape),
        reflectivity.reshape(shape),
        label.reshape(shape),
        dense_depth,
        dense_reflectivity,
        dense_object,
        edges(dense_depth, DEPTH_STEP * DEPTH_UNITS),
        edges(dense_reflectivity, REFLECTIVITY_STEP * REFLECTIVITY_UNITS),
        edges(dense_object, OBJECT_STEP),
        occupied.reshape(shape),
    )


def far_level(config: ThesisConfig) -> int:
    """Level about which depth is inverted: the maximum depth of the filters."""
    return min(round(config.max_depth * DEPTH_UNITS), FAR_LEVEL)


def low_level(config: ThesisConfig) -> int:
    """Level up to which the dense reflectivity map is set to 0."""
    return round(config.low_reflectivity * REFLECTIVITY_UNITS)


def complete_depth(sparse: Levels, far: int) -> Levels:
    """Sparse depth (h, w), 1 to `far` levels -> dense depth: inversion, completion, inversion back."""
    inverted = np.where(sparse != EMPTY, np.int16(far + 1) - sparse, np.int16(EMPTY))
    dense = complete(inverted)
    return np.asarray(np.where(dense != EMPTY, np.int16(far + 1) - dense, np.int16(EMPTY)), np.int16)


def complete(sparse: Levels) -> Levels:
    """Sparse map -> dense map (eq. 3.11; Ku et al. 2018): dilation, closing of small holes, filling of larger ones, median."""
    dense = np.asarray(cv2.dilate(sparse, NEAREST), np.int16)
    dense = np.asarray(cv2.morphologyEx(dense, cv2.MORPH_CLOSE, _square(SMALL)), np.int16)
    for size in (MIDDLE, LARGE):
        dense = np.where(dense == EMPTY, np.asarray(cv2.dilate(dense, _square(size)), np.int16), dense)
    return np.asarray(cv2.medianBlur(dense, BLUR), np.int16)


def close_gaps(labels: NDArray[np.uint8], size: int, out: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
    """Morphological closing (h, w) by a square of `size` px, odd or even; into `out` if given."""
    # cv2.morphologyEx does not mirror the square for the erosion, so that even sizes would move the map by a pixel.
    square, mirrored = _square(size), (size - 1 - size // 2,) * 2
    dilated = cv2.dilate(labels, square, dst=out)
    return np.asarray(cv2.erode(dilated, square, dst=out, anchor=mirrored), np.uint8)


def _square(size: int) -> NDArray[np.uint8]:
    return np.ones((size, size), np.uint8)


class _Rule(ctypes.Structure):
    """The struct Rule of kernel.c: change both together."""

    _fields_ = (
        *((name, ctypes.c_int32) for name in ("inverse", "least", "weak", "strong")),
        ("full", ctypes.c_float),
        *((name, ctypes.c_int32) for name in ("sobel", "canny")),
    )

    @classmethod
    def of(cls, config: ThesisConfig, step: float, inverse: int = 0, least: int = 0) -> _Rule:
        """How edges of a map are found where a step of so many levels is a full one."""
        full, operator = SOBEL_GAIN * step, config.operator
        weak, strong = (int(min(part * full, MAX_GRADIENT) ** 2) for part in (config.canny_low, config.canny_high))
        return cls(inverse, least, weak, strong, full, operator != "canny", operator != "sobel")


def _load_kernel() -> ctypes.CDLL:
    library = load_library(Path(__file__).with_name("kernel.c"), "thesis_rule_size", _Rule)
    address, count, number = ctypes.c_void_p, ctypes.c_ssize_t, ctypes.c_int32
    shape, points = (address, count, count), (address, count, address)
    library.thesis_space.argtypes, library.thesis_space.restype = (count, count), count
    library.thesis_visible.argtypes = (address, count, count, count, *[address] * 4)
    library.thesis_visible.restype = count
    library.thesis_places.argtypes = (count, address, address, count, number, number, address)
    library.thesis_complete.argtypes = (*shape, number, number, address, address)
    library.thesis_level_edges.argtypes = (*shape, ctypes.POINTER(_Rule), address, address, *points)
    library.thesis_object_edges.argtypes = (*shape, ctypes.POINTER(_Rule), address, *points)
    for name in ("places", "complete", "level_edges", "object_edges"):
        library[f"thesis_{name}"].restype = None
    return library


KERNEL = _load_kernel()


def _space(width: int, height: int) -> NDArray[np.uint8]:
    """Memory that kernel.c works in, for maps of up to this size."""
    return np.empty(KERNEL.thesis_space(width, height), np.uint8)


def complete_fast(sparse: Levels, inverse: int = 0) -> Levels:
    """As `complete`, by kernel.c and to the bit. inverse: far + 1 = as `complete_depth`, but for depth inverted about it."""
    (h, w), sparse = sparse.shape, np.ascontiguousarray(sparse)
    out, space = np.empty_like(sparse), _space(w, h)
    KERNEL.thesis_complete(space.ctypes.data, w, h, inverse, EMPTY, sparse.ctypes.data, out.ctypes.data)
    return out


class FastEdgeMaps:
    """E^L at the pixels of the points only, by kernel.c, in the part of the image that has points; images have one size (px)."""

    def __init__(self, height: int, width: int, config: ThesisConfig) -> None:
        self.height, self.width, self.config = height, width, config
        self._space, self._last = _space(width, height), np.empty(height * width, np.int32)
        self._labels, self._closed = (np.empty(height * width, np.uint8) for _ in range(2))
        self._depth = _Rule.of(config, DEPTH_STEP * DEPTH_UNITS, far_level(config) + 1)
        self._reflectivity = _Rule.of(config, REFLECTIVITY_STEP * REFLECTIVITY_UNITS, least=low_level(config))
        self._object = _Rule.of(config, OBJECT_STEP)
        # Farther than this from points - their reach, and three pixels of the operators - all maps are empty.
        self._margin = max(REACH, 2 * (config.closing // 2)) + 3

    def visible(self, xyz: Floats) -> tuple[Places, Places, Points]:
        """Points (3, n) times the intrinsics, far first -> columns, rows and indices of the nearest on each pixel."""
        n, xyz = xyz.shape[1], np.ascontiguousarray(xyz)
        u, v, points = np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n, np.int64)
        into = (a.ctypes.data for a in (self._last, u, v, points))
        m = KERNEL.thesis_visible(xyz.ctypes.data, n, self.width, self.height, *into)
        return u[:m], v[:m], points[:m]

    def __call__(self, u: Places, v: Places, points: Points, levels: PointLevels) -> Floats:
        """E^L (n,) at pixels (u, v), each at most once, of these of the points. levels: of all points."""
        n, total = len(u), np.zeros(len(u), np.float32)
        if n == 0:
            return total
        left, top = max(int(u.min()) - self._margin, 0), max(int(v.min()) - self._margin, 0)
        w = min(int(u.max()) + self._margin + 1, self.width) - left
        h = min(int(v.max()) + self._margin + 1, self.height) - top
        at = np.empty(n, np.int32)
        KERNEL.thesis_places(w, u.ctypes.data, v.ctypes.data, n, left, top, at.ctypes.data)
        shape, where = (self._space.ctypes.data, w, h), (at.ctypes.data, n, total.ctypes.data)
        for rule, of_points in ((self._depth, levels.depth), (self._reflectivity, levels.reflectivity)):
            KERNEL.thesis_level_edges(*shape, rule, of_points.ctypes.data, points.ctypes.data, *where)
        labels = self._labels[: h * w]
        labels.fill(0)
        labels[(v - top) * w + (u - left)] = levels.label[points]
        closed = close_gaps(labels.reshape(h, w), self.config.closing, self._closed[: h * w].reshape(h, w))
        KERNEL.thesis_object_edges(*shape, self._object, closed.ctypes.data, *where)
        return np.asarray(total * np.float32(1 / 3), np.float32)
