"""Weights of frames by what they show (thesis 3.6, eq. 3.16)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calib_ros.frame import MAIN_CLASSES, UNLABELLED

FEW_FRAMES_SHARE = 0.05  # added to the share of main classes, so that frames without any keep a part of their weight


def importance(classes: NDArray[np.uint8]) -> float | None:
    """w_j of eq. 3.16: the share of the main classes among the pixels (H, W) whose class is known; None if none is."""
    count = np.bincount(classes.ravel(), minlength=256)
    known = count.sum() - count[UNLABELLED]
    return None if known == 0 else float(count[list(MAIN_CLASSES)].sum() / known)


def frame_weights(shares: Sequence[float | None]) -> NDArray[np.float64]:
    """w_j of several frames (n,), of mean 1. One whose classes are not known, as they come later than the frame, weighs 1."""
    known = np.array([s for s in shares if s is not None])
    if not len(known):
        return np.ones(len(shares))
    mean = float(known.mean()) + FEW_FRAMES_SHARE
    return np.array([1.0 if s is None else (s + FEW_FRAMES_SHARE) / mean for s in shares])
