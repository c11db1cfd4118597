"""Vehicles, cyclists and people: clusters in plan view of their size and shape (thesis 3.3.3, algorithm 2)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.frame import UNLABELLED, SemanticClass
from calib_ros.lidar.segmentation import cluster
from calib_ros_semantics.models.cluster_shapes import Surfaces, bounding_rectangle, cell_numbers, extents, split_by_group

Floats = NDArray[np.float32]
Classes = NDArray[np.uint8]
HEAD_HEIGHT = 0.25  # m; uppermost part, which separates cars, people and riders from boxes, walls and hedges
MAX_BOTTOM = 0.6  # m above the ground; lowest point of an object: a bumper
MAX_CUT_SHARE = 0.01  # of points at the edge of the field of view: with more, the top is unknown, and so is the class
# Vehicles. Head as a share of the length; what is as long at its top is a wall or a hedge, unless it is as deep as a van.
MAX_HEAD_RATIO = 0.85
MAX_VEHICLE_WIDTH, MAX_VEHICLE_LENGTH = 2.4, 5.8  # m; with mirrors, and of a van
CAR_TOP, VAN_TOP = 1.9, 2.3  # m; highest tops
MIN_ROOF, MIN_BONNET = 1.15, 0.95  # m; lowest top of a vehicle, and of one whose roof lies between two rings
SIDE_LENGTH, MIN_END, MIN_WHOLE_DEPTH = (3.0, 5.3), 1.4, 1.2  # m; of a side, of an end, and depth that shows more than one side
MIN_SIDE_DEPTH, MIN_END_DEPTH = 0.4, 0.3  # m; of a visible side or end: both are curved, and walls are not
MIN_CABIN = 0.5  # m; length of a vehicle's head. Those of riders and bushes are shorter
# Scatter as of Surfaces: cars 0.02 to 0.06 near, more where rings are farther apart than cars are curved; bushes 0.1.
MAX_SCATTER, SCATTER_PER_M, MAX_FAR_SCATTER = 0.06, 0.001, 0.09
MAX_VEHICLE_LEVEL = 0.9  # the slope of a bank has more; cars from above come to 0.8
CAR_SIZE = (4.5, 1.8, 1.6)  # m; length, width and height of a car, of which less is visible
MIN_SIDE = 2.5  # m; a visible part of a car longer than this is its side, a shorter one an end
MIN_SHARE_IN_CAR = 0.9  # of a cluster within the rectangle of a car, to be part of it
# Cyclists: length, width and height of a two-wheeler with its rider, m. The bottom is that of wheels, m; the head a share of
# the length.
RIDER = (1.1, 2.1), (0.25, 1.0), (1.55, 2.1)
MAX_RIDER_SCATTER, MAX_RIDER_LEVEL, MAX_RIDER_BOTTOM, MAX_RIDER_HEAD = 0.13, 0.35, 0.35, 0.4
# People: length, width and height, m, from a child beside the road to a stride.
PERSON = (0.4, 0.95), (0.2, 0.75), (1.35, 2.05)
MAX_PERSON_HEAD, MIN_PERSON_SLIMNESS = 0.4, 1.7  # m, and height per length: bushes and bins are stouter
MAX_PERSON_DISTANCE = 40.0  # m; farther people are a few points that trunks and posts could be, too
# Clusters, in plan view.
OBJECT_EPS = 0.5  # m between parts of an object; cars park farther apart
OBJECT_CELL = 0.2  # m; points nearer than this count once
MIN_OBJECT_POINTS = 20
MAX_OBJECT_HEIGHT = 2.4  # m; of cars and vans. Lorries are taller, but so are walls
COLUMN_CELL = 0.4  # m; edge of the columns whose height excludes what is too tall
MAX_COLUMN_GAP, MAX_COLUMN_GAP_SHARE = 0.6, 0.03  # m, share of the range, empty below a crown or cable; rings: up to 2 deg
MAX_HIDDEN = 0.7  # m; hidden lower part of a column, by the body of a car before its cabin and roof
PLAN = np.array([1, 1, 0], np.float32)


def find_objects(xyz: Floats, shape: Surfaces, cut: NDArray[np.bool_], free: NDArray[np.bool_]) -> Classes:
    """Vehicles, cyclists and people among points (n, 3), z = height above the ground (m) -> SemanticClass (n,), else UNLABELLED.

    cut: (n,) points at the upper edge of the field of view. free: (n,) points without a class so far.
    """
    labels = np.full(len(xyz), UNLABELLED, np.uint8)
    # Height up to which the column of each point reaches without a gap.
    member, n = cell_numbers(xyz * PLAN, (COLUMN_CELL, COLUMN_CELL, 1.0))
    order = np.lexsort((xyz[:, 2], member))
    z, column = xyz[order, 2], member[order]
    first = np.r_[True, column[1:] != column[:-1]]
    below = np.where(first, MAX_HIDDEN, np.r_[np.float32(0), z[:-1]])
    gaps = np.cumsum(z - below > MAX_COLUMN_GAP + MAX_COLUMN_GAP_SHARE * np.hypot(xyz[order, 0], xyz[order, 1]))
    before = np.r_[0, gaps[:-1]][first]
    top = extents(np.where(gaps > before[column], 0, z).astype(np.float32), column, n)[1][member]
    low = np.nonzero((top < MAX_OBJECT_HEIGHT) & (xyz[:, 2] <= top) & free)[0]
    if len(low) == 0:
        return labels
    number = cluster(xyz[low] * PLAN, OBJECT_EPS, 1, OBJECT_CELL)
    parts = split_by_group(low, number)
    kinds = np.full(len(parts), UNLABELLED, np.uint8)
    for k, part in enumerate(parts):
        if len(part) >= MIN_OBJECT_POINTS:
            kinds[k] = _kind(xyz[part], Surfaces(*(values[part] for values in shape)), cut[part])
    for v in np.nonzero(kinds == SemanticClass.VEHICLE)[0]:
        inside = _within_car(xyz[low], xyz[parts[v]])
        share = np.bincount(number[inside], minlength=len(parts)) / np.bincount(number)
        kinds[(kinds == UNLABELLED) & (share >= MIN_SHARE_IN_CAR)] = SemanticClass.VEHICLE
    labels[low] = kinds[number]
    return labels


def _kind(xyz: Floats, shape: Surfaces, at_edge: NDArray[np.bool_]) -> int:
    """VEHICLE, CYCLIST, PERSON or UNLABELLED: what a cluster of points (n, 3), z = height above the ground (m), is. at_edge: (n,)
    whether they are at the edge of the field of view."""
    bottom, top = float(xyz[:, 2].min()), float(xyz[:, 2].max())
    # With its top outside the field of view it may be anything.
    if np.count_nonzero(at_edge) > MAX_CUT_SHARE * len(at_edge) or bottom > MAX_BOTTOM:
        return UNLABELLED
    length, width = bounding_rectangle(xyz[:, :2])
    distance = float(np.hypot(*xyz[:, :2].mean(axis=0)))
    head = bounding_rectangle(xyz[xyz[:, 2] > top - HEAD_HEIGHT, :2])[0]
    known = shape.scatter[np.isfinite(shape.scatter)]
    scatter, level = float(np.median(known)) if len(known) else np.inf, float(np.median(shape.level))
    if _is_vehicle(length, width, top, head, distance, scatter, level):
        return SemanticClass.VEHICLE
    if distance > MAX_PERSON_DISTANCE:
        return UNLABELLED
    sizes = length, width, top
    rider, person = (all(low <= m <= high for m, (low, high) in zip(sizes, own, strict=True)) for own in (RIDER, PERSON))
    calm = scatter < MAX_RIDER_SCATTER and level < MAX_RIDER_LEVEL and bottom < MAX_RIDER_BOTTOM
    if rider and calm and head <= MAX_RIDER_HEAD * length:
        return SemanticClass.CYCLIST
    slim = top > MIN_PERSON_SLIMNESS * length and head < MAX_PERSON_HEAD
    return SemanticClass.PERSON if person and slim else UNLABELLED


def _is_vehicle(length: float, width: float, top: float, head: float, distance: float, scatter: float, level: float) -> bool:
    whole = width >= MIN_WHOLE_DEPTH
    boxy = head > MAX_HEAD_RATIO * length and not (whole and length >= SIDE_LENGTH[0])
    sized = MIN_END <= length <= MAX_VEHICLE_LENGTH and width <= MAX_VEHICLE_WIDTH
    if boxy or level > MAX_VEHICLE_LEVEL or not sized:
        return False
    if whole and top <= CAR_TOP and scatter < min(MAX_SCATTER + SCATTER_PER_M * distance, MAX_FAR_SCATTER):
        return top >= (MIN_BONNET if length >= SIDE_LENGTH[0] else MIN_ROOF)
    if scatter >= MAX_SCATTER or not MIN_ROOF <= top <= (VAN_TOP if whole else CAR_TOP) or head < MIN_CABIN:
        return False
    if length >= SIDE_LENGTH[0]:
        return whole or (length <= SIDE_LENGTH[1] and width >= MIN_SIDE_DEPTH)
    return width >= MIN_END_DEPTH


def _within_car(xyz: Floats, visible: Floats) -> NDArray[np.bool_]:
    """Which of the points (n, 3) lie where the rest of a car must be whose points `visible` (m, 3) are known."""
    # Windows return nothing, so that roof and bonnet are apart from the side: within the rectangle around the visible points,
    # extended away from the sensor to the width, or length, of a car.
    (x, y), (a, b), turn = cv2.minAreaRect(np.ascontiguousarray(visible[:, :2]))
    along = np.deg2rad(turn) + (0.0 if a >= b else 0.5 * np.pi)
    length, width = max(a, b), min(a, b)
    axis = np.array([np.cos(along), np.sin(along)])
    away = np.array([-axis[1], axis[0]])
    away *= 1.0 if away @ (x, y) >= 0 else -1.0
    off = xyz[:, :2] - np.array([x, y])
    u, v = off @ axis, off @ away
    depth = max(width, CAR_SIZE[1] if length >= MIN_SIDE else CAR_SIZE[0])
    low = xyz[:, 2] <= max(float(visible[:, 2].max()), CAR_SIZE[2])
    return np.asarray(low & (np.abs(u) <= 0.5 * length) & (v >= -0.5 * width) & (v <= depth - 0.5 * width))
