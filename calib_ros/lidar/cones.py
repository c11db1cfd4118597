"""Where the rays of a ring run: on a cone about the sensor's axis, whose tip need not be the origin of the cloud."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

TIP_SIGMA, HEIGHT_SIGMA = 0.15, 0.02  # m; how far tips lie from the origin, and points from their cone


def ring_cones(row: NDArray[np.int32], xyz: NDArray[np.float32], rows: int) -> NDArray[np.float64]:
    """Cones z = offset + slope * distance from the axis of each row's points (n, 3) -> (rows, 2) offset in m and slope.

    Lasers of one sensor sit at different heights, 0.12 m to 0.21 m above the origin in an HDL-64E: near points of a ring then
    have another elevation than far ones, and the next ring's ray is not where the elevations would have it.
    """
    z = xyz[:, 2].astype(np.float64)
    rho = np.hypot(xyz[:, 0], xyz[:, 1]).astype(np.float64)
    weight = 1 / np.maximum(rho, 0.1)  # errors grow with the distance where rays are tilted
    count, s_r, s_rr = (
        np.bincount(row, weight, rows),
        np.bincount(row, weight * rho, rows),
        np.bincount(row, weight * rho * rho, rows),
    )
    s_z, s_rz = np.bincount(row, weight * z, rows), np.bincount(row, weight * rho * z, rows)
    n = np.asarray(count + (HEIGHT_SIGMA / TIP_SIGMA) ** 2)  # where a ring shows one distance only, its tip is the origin
    determinant = np.maximum(n * s_rr - s_r**2, 1e-12)
    return np.stack([(s_z * s_rr - s_r * s_rz) / determinant, (n * s_rz - s_r * s_z) / determinant], axis=1)
