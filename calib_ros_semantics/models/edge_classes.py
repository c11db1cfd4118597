"""What the classes of points and pixels mean for edges and frames: weights by class (thesis 3.6, eq. 3.16)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calib_ros.frame import MAIN_CLASSES, UNLABELLED
from calib_ros.frame import SemanticClass as C

Map = NDArray[np.float32]
Classes = NDArray[np.uint8]
EDGE_SHARE = 0.5  # of the edges of Segment Anything's masks in the edge maps of the fast score; the rest are gradients
LIGHT_CLASSES, LIGHT_WEIGHT = (C.VEGETATION, C.GROUND), 0.5  # leaves and kerbs are less exact; all other classes weigh 1
FEW_FRAMES_SHARE = 0.05  # added to the share of main classes, so that frames without any keep a part of their weight


def edge_weights(label: Classes) -> Map:
    """Classes of edge points (n,) -> their weights (n,)."""
    table = np.ones(256, np.float32)
    table[list(LIGHT_CLASSES)] = LIGHT_WEIGHT
    return np.asarray(table[label])


def importance(classes: Classes) -> float | None:
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
