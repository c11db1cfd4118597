"""The edge map E^I of an image (thesis 3.4.2, figure 3.10), and the edge operators (3.4.1) of images and dense maps."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import BadInputError
from calib_ros.image.edges import GRADIENT_PERCENTILE
from calib_ros_thesis.config import ThesisConfig

Map = NDArray[np.float32]
Grey = NDArray[np.uint8] | NDArray[np.int16]
OPERATORS = ("sobel", "canny", "mix")
SOBEL_GAIN = 4.0  # response of the kernels of eq. 3.9 to a step of one grey level: 1 + 2 + 1
MIN_STEP = 2.0  # grey levels; smaller strong edges are rounding noise


def gradient_edges(gray: NDArray[np.uint8], thesis: ThesisConfig, percentile: float = GRADIENT_PERCENTILE) -> Map:
    """Prepared grey image (H, W) -> gradient edges in 0..1 by the edge detector (algorithm 5).

    A full edge is this percentile of the Sobel magnitude, so that images of low contrast have edges too.
    """
    strength = magnitude(*gradients(gray))
    full = float(np.percentile(strength, percentile)) / SOBEL_GAIN
    return edges(gray, thesis.operator, max(full, MIN_STEP), thesis.canny_low, thesis.canny_high)


def blend(gradient: Map, semantic: Map | None, share: float) -> Map:
    """Gradient edges (H, W) with a `share` of semantic edges (H, W, both 0..1), if there are any (figure 3.10)."""
    if semantic is None:
        return gradient
    if semantic.shape != gradient.shape:
        raise BadInputError(f"semantic edges are {semantic.shape}, the image is {gradient.shape}; make them of the same image")
    return np.asarray((1 - share) * gradient + share * semantic, np.float32)


def smoothed(edges: Map, sigma: float) -> Map:
    """Gaussian smoothing of an edge map (figure 3.11). sigma: px, 0 = none, at most the size of the image."""
    return edges if sigma == 0 else np.asarray(cv2.GaussianBlur(edges, (0, 0), min(sigma, max(edges.shape))), np.float32)


def edges(image: Grey, operator: str, full_step: float, low: float, high: float) -> Map:
    """Edge detector, algorithm 5: (H, W) float32 in 0..1.

    operator: sobel (algorithm 3), canny (algorithm 4: 0 or 1) or mix, the mean of both. full_step: grey levels of a step that
    counts as 1 for Sobel; the thesis leaves the scale open. low, high: hysteresis thresholds of Canny as shares of full_step:
    above high is an edge, below low is not, in between is one if connected to an edge (docs/departures.md).
    """
    gx, gy = gradients(image)
    if operator == "canny":
        return _canny(gx, gy, full_step, low, high)
    strength = share(magnitude(gx, gy), full_step)
    if operator == "sobel":
        return strength
    return np.asarray(0.5 * strength + 0.5 * _canny(gx, gy, full_step, low, high), np.float32)


def gradients(image: Grey) -> tuple[NDArray[np.int16], NDArray[np.int16]]:
    """Grey levels (H, W), uint8 or int16 below 8192 -> G_x, G_y (H, W) of the Sobel kernels, eq. 3.9. Border: mirrored."""
    gx, gy = (np.asarray(cv2.Sobel(image, cv2.CV_16S, dx, 1 - dx), np.int16) for dx in (1, 0))
    return gx, gy


def magnitude(gx: NDArray[np.int16], gy: NDArray[np.int16]) -> Map:
    """sqrt(G_x^2 + G_y^2), algorithm 3; (H, W) float32."""
    # cv2.magnitude rounds by the alignment of the array in memory: not repeatable.
    x, y = gx.astype(np.float32), gy.astype(np.float32)
    return np.asarray(np.sqrt(x * x + y * y), np.float32)


def share(strength: Map, full_step: float) -> Map:
    """Gradient magnitude, any shape -> 0..1, where that of a step of `full_step` grey levels is 1."""
    return np.asarray(np.minimum(strength / np.float32(SOBEL_GAIN * full_step), np.float32(1)), np.float32)


def _canny(gx: NDArray[np.int16], gy: NDArray[np.int16], full_step: float, low: float, high: float) -> Map:
    unit = SOBEL_GAIN * full_step
    found = cv2.Canny(gx, gy, low * unit, high * unit, L2gradient=True)
    return np.asarray(found / np.float32(255), np.float32)
