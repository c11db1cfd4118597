"""Traffic signs by their light: small upright plates that throw it back as nothing else of their size and height does."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_ros.lidar.clusters import cluster
from calib_ros.semantics.cluster_shapes import box, grouped

Floats = NDArray[np.float32]
BRIGHT = 0.8  # reflectivity; retro-reflective foil fills the scale, white paint comes to 0.75
FROM = 1.5  # m; number plates, lamps and the stripes on clothes are lower
NEAREST = 4.0  # m; nearer, everything is bright
JOINED, CELL = 0.4, 0.05  # m between the points of a plate, and what counts once
FEWEST = 4  # points
LENGTH, DEPTH, HEIGHT = (0.2, 1.8), 0.3, 0.1  # m; of a plate, the noise of ranges included. A single ring shows no plate
SHARE = 0.4  # of what is there and beside it that must be bright: a wall has bright spots
BESIDE = 0.4  # m


def find_signs(xyz: Floats, light: Floats | None) -> NDArray[np.bool_]:
    """Which of the points (n, 3), z = height above the ground (m), lie on signs.

    light: (n,) reflectivity 0..1, None = unknown. Raises MissingDependencyError without scikit-learn.
    """
    found = np.zeros(len(xyz), bool)
    if light is None:
        return found
    high = np.nonzero((xyz[:, 2] > FROM) & (np.hypot(xyz[:, 0], xyz[:, 1]) > NEAREST))[0]
    bright = high[light[high] >= BRIGHT]
    for part in grouped(bright, cluster(xyz[bright], JOINED, 1, CELL)):
        if len(part) < FEWEST:
            continue
        length, depth = box(xyz[part, :2])
        low, top = xyz[part].min(axis=0), xyz[part].max(axis=0)
        near = high[((xyz[high] >= low - BESIDE) & (xyz[high] <= top + BESIDE)).all(axis=1)]
        if LENGTH[0] <= length <= LENGTH[1] and depth <= DEPTH and top[2] - low[2] >= HEIGHT and len(part) >= SHARE * len(near):
            found[near[(xyz[near, 2] >= low[2]) & (xyz[near, 2] <= top[2])]] = True
    return found
