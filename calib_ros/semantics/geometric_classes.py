"""Classes of points by the shape of clusters, for LiDARs without a network.

The ground is what lies low; poles, signs, vehicles, cyclists and people are found by size and shape; the rest is vegetation
where it is rough, and a building where it is flat, upright and high. What shapes do not tell apart: a cyclist seen from ahead or
behind is a person, a lorry a building, and a slender trunk whose crown is out of sight a pole.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.frame import UNLABELLED, Frame, PointCloud, SemanticClass
from calib_ros.lidar.range_image import MIN_POINTS, reflectivity
from calib_ros.lidar.segmentation import Plane, cluster, fit_ground
from calib_ros.semantics.cluster_shapes import Surfaces, box, cells_of, find_poles, find_signs, grouped, spans, surfaces
from calib_ros.semantics.onnx_model import Deadline

# What a cluster of points is by its measures: a vehicle, a cyclist, a person, or nothing that can be told.
Floats = NDArray[np.float32]
HEAD = 0.25  # m; the uppermost part, which tells cars, people and riders from boxes, walls and hedges
STANDS = 0.6  # m above the ground at most where a thing's lowest point is seen: a bumper
CUT = 0.01  # share of points at the edge of the field of view: the top is not seen, so that it may be anything
# Head of a vehicle as a share of its length; what is as long at its top is a wall or a hedge, unless it is as deep as a van.
NARROWER = 0.85
WIDEST, LONGEST = 2.4, 5.8  # m; with mirrors, and of a van
CAR_TOP, VAN_TOP = 1.9, 2.3  # m
ROOF, BONNET = 1.15, 0.95  # m; lowest top of a vehicle, and of one whose roof lies between two rings
SIDE, END, DEEP = (3.0, 5.3), 1.4, 1.2  # m; lengths of a side, width of an end, and depth that shows more than one of them
THIN_SIDE, THIN_END = 0.4, 0.3  # m; depth of the least that is seen of a side or an end: both are curved, and walls are not
CABIN = 0.5  # m; length of a vehicle's head at least. Riders' and bushes' are smaller
# Scatter as of Surfaces: cars 0.02 to 0.06 near, more where rings are farther apart than cars are curved; bushes 0.1.
SMOOTH, SMOOTH_PER_M, SMOOTH_FAR = 0.06, 0.001, 0.09
LYING = 0.9  # `level` of the slope of a bank; cars seen from above come to 0.8
RIDER = (1.1, 2.1), (0.25, 1.0), (1.55, 2.1)  # m; length, width and height of a two-wheeler with its rider
RIDER_SCATTER, RIDER_LEVEL, RIDER_LOW, RIDER_HEAD = 0.13, 0.35, 0.35, 0.4  # the last is a share of the length; 0.35 m: wheels
PERSON = (0.4, 0.95), (0.2, 0.75), (1.35, 2.05)  # m; from a child beside the road to a stride, its depth, and heights
PERSON_HEAD, PERSON_SLIM = 0.4, 1.7  # m, and times as high as long: bushes and bins are stouter
FARTHEST = 40.0  # m; people beyond are a few points that trunks and posts could be


@dataclass(frozen=True)
class Thing:
    """A cluster's length, width, bottom, top and distance (m), length of its HEAD (m), scatter and level (median, as of
    Surfaces), and whether the field of view cuts its top off."""

    length: float
    width: float
    bottom: float
    top: float
    distance: float
    head: float
    scatter: float
    level: float
    cut: bool

    @property
    def kind(self) -> int:
        """VEHICLE, CYCLIST, PERSON or UNLABELLED."""
        if self.cut or self.bottom > STANDS:
            return UNLABELLED
        if self._is_vehicle():
            return SemanticClass.VEHICLE
        if self.distance > FARTHEST:
            return UNLABELLED
        if self._is_rider():
            return SemanticClass.CYCLIST
        return SemanticClass.PERSON if self._is_person() else UNLABELLED

    def _is_vehicle(self) -> bool:
        whole = self.width >= DEEP
        boxy = self.head > NARROWER * self.length and not (whole and self.length >= SIDE[0])
        if boxy or self.level > LYING or not END <= self.length <= LONGEST or self.width > WIDEST:
            return False
        if whole and self.top <= CAR_TOP and self.scatter < min(SMOOTH + SMOOTH_PER_M * self.distance, SMOOTH_FAR):
            return self.top >= (BONNET if self.length >= SIDE[0] else ROOF)
        if self.scatter >= SMOOTH or not ROOF <= self.top <= (VAN_TOP if whole else CAR_TOP) or self.head < CABIN:
            return False
        if self.length >= SIDE[0]:
            return whole or (self.length <= SIDE[1] and self.width >= THIN_SIDE)
        return self.width >= THIN_END

    def _is_rider(self) -> bool:
        shape = self.scatter < RIDER_SCATTER and self.level < RIDER_LEVEL and self.bottom < RIDER_LOW
        return shape and self._measures(RIDER) and self.head <= RIDER_HEAD * self.length

    def _is_person(self) -> bool:
        return self._measures(PERSON) and self.top > PERSON_SLIM * self.length and self.head < PERSON_HEAD

    def _measures(self, limits: tuple[tuple[float, float], ...]) -> bool:
        return all(low <= m <= high for m, (low, high) in zip((self.length, self.width, self.top), limits, strict=True))


def measure(xyz: Floats, shape: Surfaces, cut: NDArray[np.bool_]) -> Thing:
    """The Thing that points (n, 3) are, z = height above the ground (m), with their shape and whether they are cut off (n,)."""
    length, width = box(xyz[:, :2])
    bottom, top = float(xyz[:, 2].min()), float(xyz[:, 2].max())
    known = shape.scatter[np.isfinite(shape.scatter)]
    scatter = float(np.median(known)) if len(known) else np.inf
    head = box(xyz[xyz[:, 2] > top - HEAD, :2])[0]
    distance = float(np.hypot(*xyz[:, :2].mean(axis=0)))
    cut_off = np.count_nonzero(cut) > CUT * len(cut)
    return Thing(length, width, bottom, top, distance, head, scatter, float(np.median(shape.level)), bool(cut_off))


# Vehicles, people and cyclists: clusters, seen from above, of the size and shape of one (thesis 3.3.3, algorithm 2).
Classes = NDArray[np.uint8]
EPS = 0.5  # m between parts of one thing seen from above; cars park farther apart
OBJECT_CELL = 0.2  # m; what is nearer, seen from above, counts once
COLUMN = 0.4  # m; edge of the columns whose height tells what is too tall for a vehicle
GAP, GAP_SHARE = 0.6, 0.03  # m and share of the range that is empty under a crown or a cable; rings are 2 deg apart at most
PANES = 0.7  # m; as far up a column may be hidden, by the body of a car before its cabin and roof
TALLEST = 2.4  # m; of cars and vans. Lorries are taller, but so are walls
FEWEST = 20  # points that have a shape
CAR = (4.5, 1.8, 1.6)  # m; length, width and height that a car has at least behind what is seen of it
LEAST_SIDE = 2.5  # m; what is seen of a car is its side if it is longer than this, an end if not
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
    number = cluster(xyz[low] * FROM_ABOVE, EPS, 1, OBJECT_CELL)
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
    depth = max(width, CAR[1] if length >= LEAST_SIDE else CAR[0])
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


# Buildings and vegetation: what is tall and flat, and what is rough.
BACKDROP_CELL = 1.0  # m; of the votes, seen from above
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
    cell = np.floor(xyz[:, :2] / BACKDROP_CELL).astype(np.intp)
    cell -= cell.min(axis=0)
    place = (cell[:, 1], cell[:, 0])
    rows, columns = cell[:, ::-1].max(axis=0) + 1
    total, flat, top = np.zeros((3, rows, columns), np.float32)
    np.add.at(total, place, known.astype(np.float32))
    np.add.at(flat, place, (known & (shape.scatter <= FLAT)).astype(np.float32))
    np.maximum.at(top, place, np.where(cut, np.float32(np.inf), xyz[:, 2]))
    total, flat = (cv2.GaussianBlur(votes, (0, 0), VOTES / BACKDROP_CELL) for votes in (total, flat))
    top = cv2.dilate(top, np.ones((3, 3), np.uint8))
    smooth = (flat > 0.5 * total)[place]
    labels[known & ~smooth] = SemanticClass.VEGETATION
    labels[known & smooth & (shape.level < UPRIGHT) & (top[place] > HIGH)] = SemanticClass.BUILDING
    return labels


# How high points lie above a ground that undulates: the plane of algorithm 1, corrected by the lowest points around.
GROUND_CELL = 1.0  # m; the ground is seen within a cell even where cars stand side by side
REACH = 80.0  # m; farther off a spinning scanner leaves whole cells between its rings
# The plane: kerbs and crowned roads lie within 0.2 m of it; a road climbs by less than 15 deg under a vehicle on it.
THRESHOLD, TILT_DEG, SHARE, ITERATIONS = 0.2, 15.0, 0.05, 128
SAMPLED = 20_000  # points that the plane is found from; more of them change it by millimetres
# The correction, from coarse to fine: the reach of the average (m), and how far above the ground so far (m, and as a share of the
# distance, for the slope of the plane and of the road) the lowest point of a cell may lie to be ground.
STEPS = ((12.0, 0.8, 0.05), (8.0, 0.5, 0.03), (5.0, 0.35, 0.015), (3.0, 0.25, 0.01), (1.5, 0.2, 0.005), (1.5, 0.15, 0.005))
BELOW = 2.0  # times as far may it lie below: nothing stands there, but mirror images of the scene do
FAINT = 1e-3  # weight of the ground so far in the average, which fills in where no cell is near


def heights(xyz: Floats, seed: int = 0) -> Floats | None:
    """Points (n, 3) m in the LiDAR's frame -> (n, 3) in axes whose z is the height above the local ground, x and y horizontal
    about the sensor. None where there is no ground in sight.

    The residual of each cell's lowest point against the ground so far is averaged over ever smaller neighbourhoods, and what is
    too high to be ground is left out each time.
    """
    if len(xyz) == 0:
        return None
    plane = fit_ground(xyz[:: -(-len(xyz) // SAMPLED)], THRESHOLD, ITERATIONS, TILT_DEG, SHARE, seed)
    if plane is None:
        return None
    flat = np.asarray(xyz @ _upright(plane).T.astype(np.float32), np.float32)
    flat[:, 2] -= np.float32(plane.offset)
    flat[:, 2] -= _sample(_ground(flat), flat)
    return flat


def _upright(plane: Plane) -> NDArray[np.float64]:
    """Rotation (3, 3) that makes the plane's normal the z axis and turns as little as it can."""
    n = plane.normal
    v = np.array([n[1], -n[0], 0.0])  # the axis, n x z, as long as the sine of the angle
    K = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.asarray(np.eye(3) + K + K @ K / (1 + n[2]))


def _ground(flat: Floats) -> Floats:
    """Height (rows, cols) of the ground above the plane, by cells of y and x."""
    size = round(2 * REACH / GROUND_CELL)
    lowest = np.full((size, size), np.inf, np.float32)
    near = np.abs(flat[:, :2]).max(axis=1) < REACH
    cell = np.floor((flat[near, :2] + REACH) / GROUND_CELL).astype(np.int64)
    np.minimum.at(lowest, (cell[:, 1], cell[:, 0]), flat[near, 2])
    seen = np.isfinite(lowest)
    lowest = np.where(seen, lowest, np.float32(0))
    axis = (np.arange(size) + 0.5) * GROUND_CELL - REACH
    distance = np.hypot(axis[:, None], axis[None]).astype(np.float32)
    ground = np.zeros_like(lowest)
    for reach, base, slope in STEPS:
        residual, limit = lowest - ground, base + slope * distance
        weight = (seen & (residual < limit) & (residual > -BELOW * limit)).astype(np.float32)
        total = cv2.GaussianBlur(weight, (0, 0), reach / GROUND_CELL) + np.float32(FAINT)
        ground += cv2.GaussianBlur(residual * weight, (0, 0), reach / GROUND_CELL) / total
    return ground


def _sample(ground: Floats, flat: Floats) -> Floats:
    """The ground (rows, cols) at points (n, 3), linear between the cells' middles -> (n,)."""
    place = np.clip((flat[:, :2] + REACH) / GROUND_CELL - 0.5, 0, len(ground) - 1.001)
    column, row = np.floor(place).astype(np.intp).T
    u, v = (place - np.floor(place)).T
    upper = (1 - u) * ground[row, column] + u * ground[row, column + 1]
    lower = (1 - u) * ground[row + 1, column] + u * ground[row + 1, column + 1]
    return np.asarray((1 - v) * upper + v * lower, np.float32)


RANGE = 60.0  # m; farther off a car has too few points to have a shape
GROUND = 0.2  # m; kerbs and rough grass are lower
TOP = 8.0  # m; higher up there are only houses and crowns, which what is below tells apart
SHELLS = (3.0, 5.0, 8.0, 12.0, 18.0, 26.0, 40.0)  # m; distances between which the edge of the field of view is sought
HIGHEST = 99.7  # percentile of the elevations there; a ring of 128 has 0.8 percent of the points, and above it there are strays
EDGE = np.float32(np.deg2rad(0.6))  # elevation below the highest returns that still belongs to the edge of the field of view


def cluster_classes(cloud: PointCloud, seed: int = 0) -> Classes:
    """SemanticClass of each point (n,) uint8; UNLABELLED where its shape tells nothing, beyond RANGE, and for no return.

    The cloud may come from any LiDAR that sees the ground and stands upright to 15 deg; only xyz and, for signs, the intensity
    are used. Without ground in sight nothing is labelled. Deterministic for a seed (of the ground's RANSAC). Raises
    MissingDependencyError without scikit-learn.
    """
    labels = np.full(len(cloud), UNLABELLED, np.uint8)
    seen = np.nonzero(cloud.finite_mask())[0]
    if len(seen) < MIN_POINTS:
        return labels
    xyz = heights(cloud.xyz[seen], seed)
    if xyz is None:
        return labels
    near = np.hypot(xyz[:, 0], xyz[:, 1]) < RANGE
    labels[seen[near & (xyz[:, 2] < GROUND)]] = SemanticClass.GROUND
    standing = near & (xyz[:, 2] >= GROUND) & (xyz[:, 2] < TOP)
    if standing.any():
        light = reflectivity(cloud.intensity)
        of_standing = None if light is None else light[seen[standing]]
        labels[seen[standing]] = _standing(xyz[standing], of_standing, _cut_off(cloud.xyz[seen])[standing])
    return labels


class ClusterClasses:
    """cluster_classes in place of a loaded network."""

    fallback = ""  # there is nothing that could run elsewhere

    def __call__(self, frame: Frame, deadline: Deadline) -> Classes:
        """Classes (n,) of the points of the frame's cloud. BudgetError when the time is up already."""
        deadline.check()
        return cluster_classes(frame.cloud)

    def describe(self) -> str:
        """For people."""
        return "shapes of clusters: ground, vehicles, people, cyclists, poles, signs, buildings, vegetation"


def _standing(xyz: Floats, light: Floats | None, cut: NDArray[np.bool_]) -> Classes:
    """Classes (n,) of points (n, 3) above the ground, z = height (m), reflectivity (n,) and whether they are cut off."""
    shape = surfaces(xyz)
    poles = find_poles(xyz)
    signs = find_signs(xyz, light) | poles.plate
    labels = backdrop(xyz, shape, cut)
    labels[poles.trunk] = SemanticClass.VEGETATION
    labels[poles.pole] = SemanticClass.POLE
    labels[signs] = SemanticClass.SIGN
    objects = find_objects(xyz, shape, cut, ~(poles.pole | poles.trunk | signs))
    return np.where(objects == UNLABELLED, labels, objects)


def _cut_off(xyz: Floats) -> NDArray[np.bool_]:
    """Points (n,) at the upper edge of the field of view, so that what they lie on may be taller. xyz: (n, 3) as measured.

    The edge is told by the highest returns as far off and farther: the lasers of many scanners lie some decimetres above or
    below its origin, which turns the edge up where it is near.
    """
    distance = np.hypot(xyz[:, 0], xyz[:, 1])
    elevation = np.arctan2(xyz[:, 2], distance)
    shell = np.digitize(distance, SHELLS)
    # Only above the horizon: every scanner sees that far up, and then the highest return may be the top of a car.
    edge = np.zeros(len(SHELLS) + 1)
    for k in range(len(edge)):
        inside = elevation[shell == k]
        if len(inside) >= MIN_POINTS:
            edge[k] = max(np.percentile(inside, HIGHEST), 0.0)
    edge = np.maximum.accumulate(edge[::-1])[::-1]
    return np.asarray(elevation > np.maximum(edge[shell] - EDGE, 0.0))
