"""Vehicles, people and cyclists: clusters, seen from above, of the size and shape of one (thesis 3.3.3, algorithm 2)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.classes import UNLABELLED, SemanticClass
from calib_ros.lidar.clusters import cluster
from calib_ros.semantics.cluster_shapes import Surfaces, cells_of, grouped, spans
from calib_ros.semantics.cluster_things import measure

Floats = NDArray[np.float32]
Classes = NDArray[np.uint8]
EPS = 0.5  # m between parts of one thing seen from above; cars park farther apart
CELL = 0.2  # m; what is nearer, seen from above, counts once
COLUMN = 0.4  # m; edge of the columns whose height tells what is too tall for a vehicle
GAP, GAP_SHARE = 0.6, 0.03  # m and share of the range that is empty under a crown or a cable; rings are 2 deg apart at most
PANES = 0.7  # m; as far up a column may be hidden, by the body of a car before its cabin and roof
TALLEST = 2.4  # m; of cars and vans. Lorries are taller, but so are walls
FEWEST = 20  # points that have a shape
CAR = (4.5, 1.8, 1.6)  # m; length, width and height that a car has at least behind what is seen of it
SIDE = 2.5  # m; what is seen of a car is its side if it is longer than this, an end if not
FROM_ABOVE = np.array([1, 1, 0], np.float32)
MOST = 0.9  # share of a cluster within the box of a car that makes it part of the car


def find_objects(xyz: Floats, shape: Surfaces, cut: NDArray[np.bool_], free: NDArray[np.bool_]) -> Classes:
    """SemanticClass (n,) of points (n, 3), z = height above ground (m); UNLABELLED for what is none of them.

    cut: (n,) points at the upper edge of the field of view. free: (n,) points that belong to nothing yet. Raises
    MissingDependencyError without scikit-learn.
    """
    labels = np.full(len(xyz), UNLABELLED, np.uint8)
    top = _column_tops(xyz)
    low = np.nonzero((top < TALLEST) & (xyz[:, 2] <= top) & free)[0]
    if len(low) == 0:
        return labels
    number = cluster(xyz[low] * FROM_ABOVE, EPS, 1, CELL)
    parts = grouped(low, number)
    kinds = np.full(len(parts), UNLABELLED, np.uint8)
    for k, part in enumerate(parts):
        if len(part) >= FEWEST:
            kinds[k] = measure(xyz[part], shape.select(part), cut[part]).kind
    for v in np.nonzero(kinds == SemanticClass.VEHICLE)[0]:
        inside = _behind(xyz[low], xyz[parts[v]])
        share = np.bincount(number[inside], minlength=len(parts)) / np.bincount(number)
        kinds[(kinds == UNLABELLED) & (share >= MOST)] = SemanticClass.VEHICLE
    labels[low] = kinds[number]
    return labels


def _behind(xyz: Floats, seen: Floats) -> NDArray[np.bool_]:
    """Which of the points (n, 3) lie where the rest of a car must be of which the points `seen` (m, 3) are known.

    Panes return nothing, so roof and bonnet are apart from the side. They lie within the box around what is seen, made as wide,
    or as long, as a car away from the sensor.
    """
    (x, y), (a, b), turn = cv2.minAreaRect(np.ascontiguousarray(seen[:, :2]))
    along = np.deg2rad(turn) + (0.0 if a >= b else 0.5 * np.pi)
    length, width = max(a, b), min(a, b)
    axis = np.array([np.cos(along), np.sin(along)])
    away = np.array([-axis[1], axis[0]])
    away *= 1.0 if away @ (x, y) >= 0 else -1.0
    off = xyz[:, :2] - np.array([x, y])
    u, v = off @ axis, off @ away
    depth = max(width, CAR[1] if length >= SIDE else CAR[0])
    low = xyz[:, 2] <= max(float(seen[:, 2].max()), CAR[2])
    return np.asarray(low & (np.abs(u) <= 0.5 * length) & (v >= -0.5 * width) & (v <= depth - 0.5 * width))


def _column_tops(xyz: Floats) -> Floats:
    """Height (n,) m up to which the column that each point (n, 3) belongs to reaches without a gap."""
    member, n = cells_of(xyz * FROM_ABOVE, (COLUMN, COLUMN, 1.0))
    order = np.lexsort((xyz[:, 2], member))
    z, column = xyz[order, 2], member[order]
    first = np.r_[True, column[1:] != column[:-1]]
    below = np.where(first, PANES, np.r_[np.float32(0), z[:-1]])
    gaps = np.cumsum(z - below > GAP + GAP_SHARE * np.hypot(xyz[order, 0], xyz[order, 1]))
    before = np.r_[0, gaps[:-1]][first]
    _, high = spans(np.where(gaps > before[column], 0, z).astype(np.float32), column, n)
    return high[member]
