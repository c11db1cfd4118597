"""The edge map E^I of an image (thesis 3.4.2, figure 3.10)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.config import ImageConfig, ThesisConfig
from calib_ros.errors import BadInputError
from calib_ros.image import operators

Map = NDArray[np.float32]
FLAT = 2.0  # grey levels; an image whose strong edges are no higher shows nothing but rounding


def gradient_edges(gray: NDArray[np.uint8], image: ImageConfig, thesis: ThesisConfig) -> Map:
    """Prepared grey image (H, W) -> gradient edges in 0..1 by the edge detector (algorithm 5).

    A full edge is the `gradient_percentile` of the Sobel magnitude, so that dull pictures have edges too.
    """
    strength = operators.magnitude(*operators.gradients(gray))
    full = float(np.percentile(strength, image.gradient_percentile)) / operators.SOBEL_GAIN
    return operators.edges(gray, thesis.operator, max(full, FLAT), thesis.canny_low, thesis.canny_high)


def blend(gradient: Map, semantic: Map | None, share: float) -> Map:
    """Gradient edges (H, W) with `share` of semantic ones (H, W, both 0..1), where there are any (figure 3.10)."""
    if semantic is None:
        return gradient
    if semantic.shape != gradient.shape:
        raise BadInputError(f"semantic edges are {semantic.shape}, the image is {gradient.shape}; make them of the same image")
    return np.asarray((1 - share) * gradient + share * semantic, np.float32)


def smoothed(edges: Map, sigma: float) -> Map:
    """Gaussian smoothing of an edge map (figure 3.11): strong edges fade into none. sigma: px, 0 = none, at most the picture."""
    return edges if sigma == 0 else np.asarray(cv2.GaussianBlur(edges, (0, 0), min(sigma, max(edges.shape))), np.float32)
