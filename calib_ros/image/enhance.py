"""Image preparation before edge detection (thesis 3.2): grey, histogram equalisation, noise filter."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
NO_LIMIT = 0.0  # of OpenCV's CLAHE: plain adaptive equalisation
CLAHE_CLIP, CLAHE_TILES = 2.0, 8  # clip limit, and tiles per axis, also of adaptive equalisation: common in the literature
GAUSSIAN_SIGMA = 1.0  # px; more would blur thin poles
BILATERAL_DIAMETER = 5  # px; the time grows with its square
BILATERAL_COLOR, BILATERAL_SPACE = 40.0, 5.0  # sigmas in grey levels (edges of objects are higher) and px (all of the diameter)


def prepare(image: Image) -> Image:
    """Image (H, W[, 3]) as recorded -> grey (H, W), equalised by CLAHE, which leaves flat areas calm, and filtered bilaterally,
    which keeps edges: of the thesis's methods those that serve every picture."""
    return smooth(equalize(to_gray(image)))


def to_gray(image: Image) -> Image:
    """BGR (H, W, 3) or grey (H, W) uint8 -> grey (H, W) uint8."""
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)


def equalize(image: Image, method: str = "clahe") -> Image:
    """Histogram equalisation (eq. 3.1 to 3.4) of grey (H, W), or channel by channel of (H, W, 3). method: none, global, adaptive
    (local, no clip limit) or clahe (local, clip limit)."""
    if method == "none":
        return image
    if image.ndim == 3:
        return np.dstack([equalize(np.ascontiguousarray(image[:, :, k]), method) for k in range(image.shape[2])])
    if method == "global":
        # Eq. 3.1 to 3.4; cv2.equalizeHist leaves the darkest level out of the distribution, so that it always becomes black.
        share = np.cumsum(np.bincount(image.ravel(), minlength=256)) / image.size
        return np.asarray(np.rint(255 * share).astype(np.uint8)[image])
    limit = CLAHE_CLIP if method == "clahe" else NO_LIMIT
    clahe = cv2.createCLAHE(limit, (CLAHE_TILES, CLAHE_TILES))
    return np.asarray(clahe.apply(image), np.uint8)


def smooth(gray: Image, method: str = "bilateral") -> Image:
    """Noise filter of grey (H, W) uint8: bilateral (eq. 3.5; keeps edges) or gaussian (eq. 3.6, 3.7)."""
    if method == "gaussian":
        return np.asarray(cv2.GaussianBlur(gray, (0, 0), GAUSSIAN_SIGMA), np.uint8)
    filtered = cv2.bilateralFilter(gray, BILATERAL_DIAMETER, BILATERAL_COLOR, BILATERAL_SPACE)
    return np.asarray(filtered, np.uint8)
