"""Classes of points by the shape of surfaces and clusters, for LiDARs without a network.

Shape does not separate a cyclist from ahead or behind from a person, a lorry from a building, and a slender trunk whose crown is
not visible from a pole.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.frame import UNLABELLED, Frame, PointCloud, SemanticClass
from calib_ros.lidar.range_image import MIN_POINTS, reflectivity
from calib_ros.lidar.segmentation import fit_ground
from calib_ros_semantics.models.cluster_objects import find_objects
from calib_ros_semantics.models.cluster_shapes import Surfaces, find_poles, find_signs, surface_shape
from calib_ros_semantics.models.onnx_model import Deadline, SegmentationModel

Floats = NDArray[np.float32]
Classes = NDArray[np.uint8]
MAX_RANGE = 60.0  # m; farther cars have too few points to have a shape
MAX_GROUND_HEIGHT = 0.2  # m; kerbs and rough grass are lower
MAX_HEIGHT = 8.0  # m; higher up are only houses and crowns, which their lower parts identify
EDGE_SHELLS = (3.0, 5.0, 8.0, 12.0, 18.0, 26.0, 40.0)  # m; distances between which the edge of the field of view is estimated
EDGE_PERCENTILE = 99.7  # of the elevations there; a ring of 128 has 0.8 percent of the points, and above it are isolated returns
EDGE_MARGIN = np.float32(np.deg2rad(0.6))  # below the highest returns that belongs to the edge of the field of view
# Buildings and vegetation.
BACKDROP_CELL = 1.0  # m; of the votes, in plan view
# Scatter of a flat surface: of walls 0.01 in the median, of foliage 0.1, windows, steps and corners in between. Halfway on a
# logarithmic scale would be 0.03; but real hedges are never so flat, and real walls often are not.
MAX_WALL_SCATTER = 0.05
VOTE_REACH = 1.0  # m; a wall's windows and the flat spots of a hedge are smaller
MAX_WALL_LEVEL = 0.5
MIN_BUILDING_HEIGHT = 2.0  # m; fences and garden walls are lower
# Ground.
GROUND_CELL = 1.0  # m; some ground is visible within a cell even where cars park side by side
GROUND_REACH = 80.0  # m; farther off a spinning scanner leaves whole cells between its rings
# The plane: kerbs and crowned roads lie within 0.2 m of it; a road is inclined by less than 15 deg under a vehicle on it.
GROUND_THRESHOLD, MAX_TILT_DEG, MIN_GROUND_SHARE, GROUND_ITERATIONS = 0.2, 15.0, 0.05, 128
GROUND_SAMPLE = 20_000  # points the plane is fitted to; more of them change it by millimetres
# The correction, from coarse to fine: the reach of the average (m), and how far above the current ground (m, and as a share of
# the distance, for the slope of plane and road) the lowest point of a cell may lie to be ground.
GROUND_STEPS = (
    (12.0, 0.8, 0.05), (8.0, 0.5, 0.03), (5.0, 0.35, 0.015), (3.0, 0.25, 0.01), (1.5, 0.2, 0.005), (1.5, 0.15, 0.005),
)  # fmt: skip
BELOW_FACTOR = 2.0  # it may lie so many times as far below: nothing is there but mirror images of the scene
PRIOR_WEIGHT = 1e-3  # of the current ground in the average, which fills cells without near ones


class ClusterClasses(SegmentationModel):
    """`cluster_classes` as a model."""

    def __call__(self, frame: Frame, deadline: Deadline, borders: bool = True) -> Classes:
        """Classes (n,) of the points of a frame's cloud. Raises BudgetError if the time is up already."""
        deadline.check()
        return cluster_classes(frame.cloud)

    def describe(self) -> str:
        """What it finds, as text."""
        return "shapes of clusters: ground, vehicles, people, cyclists, poles, signs, buildings, vegetation"


def cluster_classes(cloud: PointCloud) -> Classes:
    """SemanticClass of each point, (n,) uint8; UNLABELLED where the shape is ambiguous, beyond MAX_RANGE, and without a return.

    The cloud may come from any LiDAR that measures the ground and is upright to 15 deg; only xyz and, for signs, the intensity
    are used. Without ground nothing is labelled.
    """
    labels = np.full(len(cloud), UNLABELLED, np.uint8)
    returns = np.nonzero(cloud.finite_mask())[0]
    if len(returns) < MIN_POINTS:
        return labels
    xyz = heights(cloud.xyz[returns])
    if xyz is None:
        return labels
    near = np.hypot(xyz[:, 0], xyz[:, 1]) < MAX_RANGE
    labels[returns[near & (xyz[:, 2] < MAX_GROUND_HEIGHT)]] = SemanticClass.GROUND
    standing = near & (xyz[:, 2] >= MAX_GROUND_HEIGHT) & (xyz[:, 2] < MAX_HEIGHT)
    if standing.any():
        light, cut, xyz = reflectivity(cloud.intensity), _cut_off(cloud.xyz[returns])[standing], xyz[standing]
        shape = surface_shape(xyz)
        pole, plate, trunk = find_poles(xyz)
        signs = find_signs(xyz, None if light is None else light[returns[standing]]) | plate
        own = buildings_and_vegetation(xyz, shape, cut)
        own[trunk] = SemanticClass.VEGETATION
        own[pole] = SemanticClass.POLE
        own[signs] = SemanticClass.SIGN
        objects = find_objects(xyz, shape, cut, ~(pole | trunk | signs))
        labels[returns[standing]] = np.where(objects == UNLABELLED, own, objects)
    return labels


def _cut_off(xyz: Floats) -> NDArray[np.bool_]:
    """Mask (n,) of points at the upper edge of the field of view, whose objects may be taller. xyz: (n, 3) as measured."""
    # By the highest returns at the same distance and beyond: lasers above or below the origin raise the edge at close range.
    distance = np.hypot(xyz[:, 0], xyz[:, 1])
    elevation = np.arctan2(xyz[:, 2], distance)
    shell = np.digitize(distance, EDGE_SHELLS)
    # Not below the horizon: every scanner covers that, and the highest return may be the top of a car.
    edge = np.zeros(len(EDGE_SHELLS) + 1)
    for k in range(len(edge)):
        inside = elevation[shell == k]
        if len(inside) >= MIN_POINTS:
            edge[k] = max(np.percentile(inside, EDGE_PERCENTILE), 0.0)
    edge = np.maximum.accumulate(edge[::-1])[::-1]
    return np.asarray(elevation > np.maximum(edge[shell] - EDGE_MARGIN, 0.0))


def buildings_and_vegetation(xyz: Floats, shape: Surfaces, cut: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """BUILDING, VEGETATION or UNLABELLED for points (n, 3), z = height above the ground (m) -> (n,).

    cut: (n,) points at the upper edge of the field of view; their surfaces count as high.
    """
    labels = np.full(len(xyz), UNLABELLED, np.uint8)
    known = np.isfinite(shape.scatter)
    cell = np.floor(xyz[:, :2] / BACKDROP_CELL).astype(np.intp)
    cell -= cell.min(axis=0)
    columns, rows = cell.max(axis=0) + 1
    place = cell[:, 1] * columns + cell[:, 0]
    of_wall = known & (shape.scatter <= MAX_WALL_SCATTER)
    votes = (np.bincount(place, counted, rows * columns).astype(np.float32) for counted in (known, of_wall))
    total, flat = (cv2.GaussianBlur(v.reshape(rows, columns), (0, 0), VOTE_REACH / BACKDROP_CELL) for v in votes)
    top = np.zeros(rows * columns, np.float32)
    np.maximum.at(top, place, np.where(cut, np.float32(np.inf), xyz[:, 2]))
    top = cv2.dilate(top.reshape(rows, columns), np.ones((3, 3), np.uint8)).ravel()
    smooth = (flat > 0.5 * total).ravel()[place]
    labels[known & ~smooth] = SemanticClass.VEGETATION
    labels[known & smooth & (shape.level < MAX_WALL_LEVEL) & (top[place] > MIN_BUILDING_HEIGHT)] = SemanticClass.BUILDING
    return labels


def heights(xyz: Floats) -> Floats | None:
    """Points (n, 3) m in the LiDAR frame -> (n, 3): x and y horizontal, z the height above the local ground; None without ground.

    The ground is the plane of algorithm 1, corrected by the lowest points of cells, averaged over ever smaller neighbourhoods.
    """
    few = xyz[:: (len(xyz) // GROUND_SAMPLE) | 1]
    plane = fit_ground(few, GROUND_THRESHOLD, GROUND_ITERATIONS, MAX_TILT_DEG, MIN_GROUND_SHARE, 0)
    if plane is None:
        return None
    # The smallest rotation that maps its normal to the z axis: about n x z, as long as the sine of the angle.
    n = plane.normal
    v = np.array([n[1], -n[0], 0.0])
    K = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    R = np.asarray(np.eye(3) + K + K @ K / (1 + n[2]))
    flat = np.asarray(xyz @ R.T.astype(np.float32), np.float32)
    flat[:, 2] -= np.float32(plane.offset)
    ground = _ground(flat)  # bilinear between the centres of its cells
    place = np.clip((flat[:, :2] + GROUND_REACH) / GROUND_CELL - 0.5, 0, len(ground) - 1.001)
    column, row = np.floor(place).astype(np.intp).T
    u, v = (place - np.floor(place)).T
    upper = (1 - u) * ground[row, column] + u * ground[row, column + 1]
    lower = (1 - u) * ground[row + 1, column] + u * ground[row + 1, column + 1]
    flat[:, 2] -= np.asarray((1 - v) * upper + v * lower, np.float32)
    return flat


def _ground(flat: Floats) -> Floats:
    """Height (rows, columns) of the ground above the plane, by cells of y and x."""
    size = round(2 * GROUND_REACH / GROUND_CELL)
    cells = np.full(size * size, np.inf, np.float32)
    near = np.abs(flat[:, :2]).max(axis=1) < GROUND_REACH
    cell = np.floor((flat[near, :2] + GROUND_REACH) / GROUND_CELL).astype(np.int64)
    np.minimum.at(cells, cell[:, 1] * size + cell[:, 0], flat[near, 2])
    lowest = cells.reshape(size, size)
    covered = np.isfinite(lowest)
    lowest = np.where(covered, lowest, np.float32(0))
    axis = (np.arange(size) + 0.5) * GROUND_CELL - GROUND_REACH
    distance = np.hypot(axis[:, None], axis[None]).astype(np.float32)
    ground = np.zeros_like(lowest)
    for reach, base, slope in GROUND_STEPS:
        residual, limit = lowest - ground, base + slope * distance
        weight = (covered & (residual < limit) & (residual > -BELOW_FACTOR * limit)).astype(np.float32)
        total = cv2.GaussianBlur(weight, (0, 0), reach / GROUND_CELL) + np.float32(PRIOR_WEIGHT)
        ground += cv2.GaussianBlur(residual * weight, (0, 0), reach / GROUND_CELL) / total
    return ground
