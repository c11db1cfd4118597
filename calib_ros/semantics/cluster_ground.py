"""How high points lie above a ground that undulates: the plane of algorithm 1, corrected by the lowest points around."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.lidar.ground import Plane, fit_ground

Floats = NDArray[np.float32]
CELL = 1.0  # m; the ground is seen within a cell even where cars stand side by side
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
    size = round(2 * REACH / CELL)
    lowest = np.full((size, size), np.inf, np.float32)
    near = np.abs(flat[:, :2]).max(axis=1) < REACH
    cell = np.floor((flat[near, :2] + REACH) / CELL).astype(np.int64)
    np.minimum.at(lowest, (cell[:, 1], cell[:, 0]), flat[near, 2])
    seen = np.isfinite(lowest)
    lowest = np.where(seen, lowest, np.float32(0))
    axis = (np.arange(size) + 0.5) * CELL - REACH
    distance = np.hypot(axis[:, None], axis[None]).astype(np.float32)
    ground = np.zeros_like(lowest)
    for reach, base, slope in STEPS:
        residual, limit = lowest - ground, base + slope * distance
        weight = (seen & (residual < limit) & (residual > -BELOW * limit)).astype(np.float32)
        total = cv2.GaussianBlur(weight, (0, 0), reach / CELL) + np.float32(FAINT)
        ground += cv2.GaussianBlur(residual * weight, (0, 0), reach / CELL) / total
    return ground


def _sample(ground: Floats, flat: Floats) -> Floats:
    """The ground (rows, cols) at points (n, 3), linear between the cells' middles -> (n,)."""
    place = np.clip((flat[:, :2] + REACH) / CELL - 0.5, 0, len(ground) - 1.001)
    column, row = np.floor(place).astype(np.intp).T
    u, v = (place - np.floor(place)).T
    upper = (1 - u) * ground[row, column] + u * ground[row, column + 1]
    lower = (1 - u) * ground[row + 1, column] + u * ground[row + 1, column + 1]
    return np.asarray((1 - v) * upper + v * lower, np.float32)
