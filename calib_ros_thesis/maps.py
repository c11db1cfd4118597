"""Edge maps of a scan in the image: sparse maps, density completion, edge operator (thesis 3.4.3, figures 3.13 to 3.16).

A map (h, w) int16 holds levels above 0 at projected points and EMPTY elsewhere. Where structuring elements overlap, the larger
level wins: depth is inverted first, so that near objects keep their outline.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros_thesis.cloud import PointAttributes
from calib_ros_thesis.config import ThesisConfig
from calib_ros_thesis.image import SOBEL_GAIN, Grey, magnitude, share
from calib_ros_thesis.image import edges as operator_edges

Levels = NDArray[np.int16]
Floats = NDArray[np.float32]
Pixels = NDArray[np.intp]
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


def edge_maps(
    pixels: NDArray[np.intp],
    levels: PointLevels,
    shape: tuple[int, int],
    config: ThesisConfig,
    learned: Floats | None = None,
) -> EdgeMaps:
    """All maps of an image of `shape` (h, w). The readable form; FastEdgeMaps gives the same E^L several times faster.

    pixels: (n,) flat indices, each at most once, of the nearest points. levels: of these points. learned: dense depth of a
    network (h, w), m, 0 = unknown, in place of that of eq. 3.11 where that reaches: so the ground and the sky stay empty.
    """
    empty = np.zeros(shape[0] * shape[1], np.int16)
    depth, reflectivity, label = empty.copy(), empty.copy(), empty.astype(np.uint8)
    depth[pixels], reflectivity[pixels], label[pixels] = levels.depth, levels.reflectivity, levels.label
    occupied = np.zeros(len(empty), bool)
    occupied[pixels] = True

    dense_depth = complete_depth(depth.reshape(shape), far_level(config))
    if learned is not None:
        found = np.clip(np.rint(learned * np.float32(DEPTH_UNITS)), 1, far_level(config)).astype(np.int16)
        dense_depth = np.where((dense_depth != EMPTY) & (learned > 0), found, dense_depth)
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


class FastEdgeMaps:
    """E^L at the pixels of the points only, computed in the part of the image that has points, for images of one size (px)."""

    def __init__(self, height: int, width: int, config: ThesisConfig) -> None:
        self.height, self.width, self.config, size = height, width, config, height * width
        self._sparse, self._gx, self._gy = (np.empty(size, np.int16) for _ in range(3))
        self._labels, self._closed, self._canny = (np.empty(size, np.uint8) for _ in range(3))
        self._complete = DensityCompletion(size)
        self._far, self._low = far_level(config), low_level(config)
        # Farther than this from points - their reach, and three pixels of the operators - all maps are empty.
        self._margin = max(REACH, 2 * (config.closing // 2)) + 3

    def __call__(self, u: Pixels, v: Pixels, levels: PointLevels) -> Floats:
        """E^L (n,) at pixels (u, v), each at most once, of the nearest points. levels: of these points."""
        if len(u) == 0:
            return np.zeros(0, np.float32)
        left, top = max(int(u.min()) - self._margin, 0), max(int(v.min()) - self._margin, 0)
        w = min(int(u.max()) + self._margin + 1, self.width) - left
        h = min(int(v.max()) + self._margin + 1, self.height) - top
        pixels = (v - top) * w + (u - left)

        config, total = self.config, np.empty(len(u), np.float32)
        sparse = self._sparse[: h * w]
        sparse.fill(EMPTY)
        sparse[pixels] = np.where(levels.depth != EMPTY, np.int16(self._far + 1) - levels.depth, np.int16(EMPTY))
        dense = self._complete.depth(sparse.reshape(h, w), self._far)
        total[:] = self._edges(dense, pixels, DEPTH_STEP * DEPTH_UNITS)

        sparse[pixels] = levels.reflectivity
        dense = self._complete(sparse.reshape(h, w))
        cv2.threshold(dense, self._low, 0, cv2.THRESH_TOZERO, dst=dense)
        total += self._edges(dense, pixels, REFLECTIVITY_STEP * REFLECTIVITY_UNITS)

        labels = self._labels[: h * w]
        labels.fill(0)
        labels[pixels] = levels.label
        closed = close_gaps(labels.reshape(h, w), config.closing, self._closed[: h * w].reshape(h, w))
        total += self._edges(closed, pixels, OBJECT_STEP)
        return np.asarray(total * np.float32(1 / 3), np.float32)

    def _edges(self, dense: Grey, pixels: Pixels, step: float) -> Floats:
        """`image.edges` of a map at some of its pixels."""
        gx, gy = (buffer[: dense.size].reshape(dense.shape) for buffer in (self._gx, self._gy))
        cv2.Sobel(dense, cv2.CV_16S, 1, 0, dst=gx)
        cv2.Sobel(dense, cv2.CV_16S, 0, 1, dst=gy)
        config = self.config
        if config.operator != "sobel":
            unit, found = SOBEL_GAIN * step, self._canny[: dense.size].reshape(dense.shape)
            cv2.Canny(gx, gy, config.canny_low * unit, config.canny_high * unit, edges=found, L2gradient=True)
            thin = np.asarray(found.ravel()[pixels] / np.float32(255), np.float32)
            if config.operator == "canny":
                return thin
        strength = share(magnitude(gx.ravel()[pixels], gy.ravel()[pixels]), step)
        return strength if config.operator == "sobel" else np.asarray(0.5 * strength + 0.5 * thin, np.float32)


class DensityCompletion:
    """`complete` and `complete_depth` with reused buffers, for maps of up to `size` pixels; the results are bit-identical."""

    def __init__(self, size: int) -> None:
        self._a, self._b = np.empty(size, np.int16), np.empty(size, np.int16)
        self._empty = np.empty(size, np.uint8)

    def depth(self, inverted: Levels, far: int) -> Levels:
        """As `complete_depth`, for inverted depth (far + 1 - depth); valid until the next call."""
        dense = self(inverted)
        out = self._a[: dense.size].reshape(dense.shape)
        np.subtract(np.int16(far + 1), dense, out=out)
        cv2.copyTo(dense, self._where_empty(dense), out)
        return np.asarray(out)

    def __call__(self, sparse: Levels) -> Levels:
        """As `complete`; valid until the next call."""
        a, b = (buffer[: sparse.size].reshape(sparse.shape) for buffer in (self._a, self._b))
        cv2.dilate(sparse, NEAREST, dst=b)
        cv2.dilate(b, _square(SMALL), dst=a)
        cv2.erode(a, _square(SMALL), dst=b)
        for size in (MIDDLE, LARGE):
            cv2.dilate(b, _square(size), dst=a)
            cv2.copyTo(a, self._where_empty(b), b)
        cv2.medianBlur(b, BLUR, dst=a)
        self._a, self._b = self._b, self._a
        return np.asarray(a, np.int16)

    def _where_empty(self, dense: Levels) -> NDArray[np.uint8]:
        """Mask (h, w), valid until the next call. cv2.compare fails for a map of one pixel."""
        empty = self._empty[: dense.size].reshape(dense.shape)
        np.equal(dense, EMPTY, out=empty.view(np.bool_))
        return empty
