"""Buildings and vegetation: what is tall and flat, and what is rough."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.classes import UNLABELLED, SemanticClass
from calib_ros.semantics.cluster_shapes import Surfaces

Floats = NDArray[np.float32]
CELL = 1.0  # m; of the votes, seen from above
# Scatter of a flat surface: of walls' points 0.01 in the median, of leaves' 0.1, and windows, steps and corners lie between.
# Halfway on a logarithmic scale would be 0.03; but a real hedge is never so flat, and a real wall often is not.
FLAT = 0.05
VOTES = 1.0  # m; reach of the votes: a wall's windows and the flat spots of a hedge are smaller
UPRIGHT = 0.5  # `level` of a wall at most
HIGH = 2.0  # m; of a wall that is a building's. Fences and garden walls are lower


def backdrop(xyz: Floats, shape: Surfaces, cut: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """BUILDING, VEGETATION or UNLABELLED for points (n, 3), z = height above the ground (m) -> (n,).

    cut: (n,) points at the upper edge of the field of view; what they lie on counts as high.
    """
    labels = np.full(len(xyz), UNLABELLED, np.uint8)
    if len(xyz) == 0:
        return labels
    known = np.isfinite(shape.scatter)
    cell = np.floor(xyz[:, :2] / CELL).astype(np.intp)
    cell -= cell.min(axis=0)
    place = (cell[:, 1], cell[:, 0])
    rows, columns = cell[:, ::-1].max(axis=0) + 1
    total, flat, top = np.zeros((3, rows, columns), np.float32)
    np.add.at(total, place, known.astype(np.float32))
    np.add.at(flat, place, (known & (shape.scatter <= FLAT)).astype(np.float32))
    np.maximum.at(top, place, np.where(cut, np.float32(np.inf), xyz[:, 2]))
    total, flat = (cv2.GaussianBlur(votes, (0, 0), VOTES / CELL) for votes in (total, flat))
    top = cv2.dilate(top, np.ones((3, 3), np.uint8))
    smooth = (flat > 0.5 * total)[place]
    labels[known & ~smooth] = SemanticClass.VEGETATION
    labels[known & smooth & (shape.level < UPRIGHT) & (top[place] > HIGH)] = SemanticClass.BUILDING
    return labels
