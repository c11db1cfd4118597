"""E^L of a scan where it counts: at the pixels of the points, in the part of the picture where there are any.

Equal to the bit to `edge_maps(...).lidar_edges` at these pixels, at a fraction of its time: buffers are kept, maps are
cropped to the points and what they act upon, gradient magnitudes are taken at the points only.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.config import ThesisConfig
from calib_ros.image import operators
from calib_ros.lidar.density import EMPTY, REACH, DensityCompletion, close_gaps
from calib_ros.lidar.edge_maps import DEPTH_UNITS, OBJECT_STEP, REFLECTIVITY_UNITS, PointLevels, far_level, low_level

Pixels = NDArray[np.intp]
Floats = NDArray[np.float32]
Grey = NDArray[np.uint8] | NDArray[np.int16]


class FastEdgeMaps:
    """Makes E^L for pictures of one size, (height, width) px."""

    def __init__(self, height: int, width: int, config: ThesisConfig) -> None:
        self.height, self.width, self.config = height, width, config
        size = height * width
        self._sparse, self._gx, self._gy = (np.empty(size, np.int16) for _ in range(3))
        self._labels, self._closed, self._canny = (np.empty(size, np.uint8) for _ in range(3))
        self._complete = DensityCompletion(size)
        self._far, self._low = far_level(config), low_level(config)
        # Beyond what points act upon, and the three pixels that the operators look around, all maps are empty.
        self._margin = max(REACH, 2 * (config.closing // 2)) + 3

    def __call__(self, u: Pixels, v: Pixels, levels: PointLevels) -> Floats:
        """E^L (n,) at pixels (u, v), each at most once: the nearest point's. levels: of these points."""
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
        total[:] = self._edges(dense, pixels, config.depth_step * DEPTH_UNITS)

        sparse[pixels] = levels.reflectivity
        dense = self._complete(sparse.reshape(h, w))
        cv2.threshold(dense, self._low, 0, cv2.THRESH_TOZERO, dst=dense)
        total += self._edges(dense, pixels, config.reflectivity_step * REFLECTIVITY_UNITS)

        labels = self._labels[: h * w]
        labels.fill(0)
        labels[pixels] = levels.label
        closed = close_gaps(labels.reshape(h, w), config.closing, self._closed[: h * w].reshape(h, w))
        total += self._edges(closed, pixels, OBJECT_STEP)
        return np.asarray(total * np.float32(1 / 3), np.float32)

    def _edges(self, dense: Grey, pixels: Pixels, step: float) -> Floats:
        """operators.edges of a map at some of its pixels."""
        gx, gy = (buffer[: dense.size].reshape(dense.shape) for buffer in (self._gx, self._gy))
        cv2.Sobel(dense, cv2.CV_16S, 1, 0, dst=gx)
        cv2.Sobel(dense, cv2.CV_16S, 0, 1, dst=gy)
        config = self.config
        if config.operator != "sobel":
            unit, found = operators.SOBEL_GAIN * step, self._canny[: dense.size].reshape(dense.shape)
            cv2.Canny(gx, gy, config.canny_low * unit, config.canny_high * unit, edges=found, L2gradient=True)
            thin = np.asarray(found.ravel()[pixels] / np.float32(255), np.float32)
            if config.operator == "canny":
                return thin
        strength = operators.share(operators.magnitude(gx.ravel()[pixels], gy.ravel()[pixels]), step)
        return strength if config.operator == "sobel" else np.asarray(0.5 * strength + 0.5 * thin, np.float32)
