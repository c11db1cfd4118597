"""Image preparation before edges are taken (thesis 3.2)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.config import ImageConfig


def to_gray(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """BGR (H, W, 3) or grey (H, W) uint8 -> grey (H, W) uint8."""
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)


def equalize(gray: NDArray[np.uint8], config: ImageConfig) -> NDArray[np.uint8]:
    """Contrast-limited adaptive histogram equalisation (thesis 3.2, figure 3.3) of grey (H, W) uint8."""
    clahe = cv2.createCLAHE(config.clahe_clip, (config.clahe_tiles, config.clahe_tiles))
    return np.asarray(clahe.apply(gray), np.uint8)


def smooth(gray: NDArray[np.uint8], config: ImageConfig) -> NDArray[np.uint8]:
    """Bilateral filter (thesis eq. 3.5): noise goes, edges stay. Grey (H, W) uint8."""
    filtered = cv2.bilateralFilter(gray, config.bilateral_diameter, config.bilateral_color, config.bilateral_space)
    return np.asarray(filtered, np.uint8)
