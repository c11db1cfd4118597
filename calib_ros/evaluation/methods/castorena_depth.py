"""A dense depth map from projected points, and how steep it is at them (Castorena et al. 2016)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Map = NDArray[np.float32]
Pixels = NDArray[np.intp]


def slopes(image: Map) -> tuple[Map, Map]:
    """|grad_x|, |grad_y| of (h, w): absolute forward differences; 0 in the last column and row, which have no next one."""
    return np.abs(np.diff(image, axis=1, append=image[:, -1:])), np.abs(np.diff(image, axis=0, append=image[-1:]))


class DepthCompletion:
    """phi of eq. 4.4 for pictures of one size, by normalised convolution (Knutsson and Westin 1993).

    phi at a pixel is the mean of the measured depths around it, weighed by a Gaussian of `sigma` px. Where a point and its
    neighbours to the right and below lie there is always one in reach, and phi is asked for nowhere else.
    """

    def __init__(self, height: int, width: int, sigma: float) -> None:
        self.height, self.width, self.sigma = height, width, sigma
        self._reach = max(round(3 * sigma), 1)  # px; of the kernel, beyond which a Gaussian is nearly 0
        kernel = np.asarray(cv2.getGaussianKernel(2 * self._reach + 1, sigma, cv2.CV_32F), np.float32)
        # Scaled to 1 in the middle: the share of a lonely point must not get lost in rounding.
        self._kernel = kernel / kernel.max()
        self._sparse, self._measured, self._depth, self._share = (np.empty(height * width, np.float32) for _ in range(4))

    def slopes_at_points(self, u: Pixels, v: Pixels, depth: Map) -> tuple[Pixels, Map, Map]:
        """Flat pixels (m,) with a point, and there |grad_x phi| and |grad_y phi|, m per px.

        u, v, depth: (n,) column, row and depth in m of points in the picture, far ones first: the nearest hides the others.
        Pixels in the last column and row are left out.
        """
        if len(u) == 0:
            return np.zeros(0, np.intp), np.zeros(0, np.float32), np.zeros(0, np.float32)
        w = self.width
        top = max(int(v.min()) - self._reach, 0)
        rows = min(int(v.max()) + self._reach + 1, self.height) - top  # nothing lies above and below
        part = slice(0, rows * w)
        sparse, measured = self._sparse[part], self._measured[part]
        sparse.fill(0)
        measured.fill(0)
        pixels = (v - top) * w + u
        sparse[pixels] = depth
        measured[pixels] = 1
        for of, into in ((sparse, self._depth), (measured, self._share)):
            cv2.sepFilter2D(of.reshape(rows, w), -1, self._kernel, self._kernel, dst=into[part].reshape(rows, w))
        measured = measured.reshape(rows, w)
        measured[:, -1] = 0
        if top + rows == self.height:
            measured[-1] = 0
        shown = np.flatnonzero(measured)
        here = self._phi(shown)
        return shown + top * w, np.abs(self._phi(shown + 1) - here), np.abs(self._phi(shown + w) - here)

    def _phi(self, pixels: Pixels) -> Map:
        return np.asarray(self._depth[pixels] / self._share[pixels], np.float32)
