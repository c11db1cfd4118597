"""The inverse distance transform of an image's edges (Levinson and Thrun 2013; thesis eq. 4.2)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Map = NDArray[np.float32]
AROUND = np.ones((3, 3), np.uint8)


def edge_image(gray: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """E: the largest absolute difference of every pixel of (h, w) to any of its 8 neighbours, grey levels."""
    highest, lowest = cv2.dilate(gray, AROUND), cv2.erode(gray, AROUND)
    return np.asarray(np.maximum(highest - gray, gray - lowest), np.uint8)


def edginess(E: NDArray[np.uint8], alpha: float, gamma: float) -> Map:
    """D of eq. 4.2: alpha E + (1 - alpha) max over all pixels of E gamma^distance, chessboard distance; (h, w) float32."""
    return np.asarray(np.float32(alpha) * E + np.float32(1 - alpha) * spread(E, gamma), np.float32)


def spread(E: NDArray[np.uint8], gamma: float) -> Map:
    """The maximum over all pixels of E gamma^distance, 0 < gamma < 1, exactly; (h, w) -> (h, w) float32.

    With B_r the maximum in the square of radius r, it is that of gamma^d B_d E over all d. Those below some n being done in F,
    the next n are gamma^n B_n F, since B_n B_d = B_(n+d): as many steps as a distance has binary digits.
    """
    F, n = E.astype(np.float32), 1
    while n < max(F.shape):
        fade = np.float32(gamma**n)
        if fade * F.max() <= F.min():  # nothing from so far away can be the largest
            break
        square = np.ones(2 * n + 1, np.uint8)
        wide = cv2.dilate(cv2.dilate(F, square[None]), square[:, None])
        F = np.maximum(F, fade * wide)
        n *= 2
    return np.asarray(F, np.float32)
