"""How far the estimate may be off: covariance from how much the frames disagree."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_ros.registration.point_score import PointScore

# Measured on 245 KITTI frames: the sandwich is 2-4 times overconfident, since neighbouring frames are not independent, and
# no number of frames goes below a floor of bias.
INFLATION = 2.5
FLOOR = np.array([np.deg2rad(0.04)] * 3 + [0.018] * 3)  # rad, m


# Of the thesis's objective: 0.13-0.18 deg and 3.6-4.9 cm remain on 4 to 10 spread KITTI scenes.
THESIS_FLOOR = np.array([np.deg2rad(0.1)] * 3 + [0.03] * 3)


def covariance(
    score: PointScore, T: NDArray[np.float64], level: int = -1, floor: NDArray[np.float64] = FLOOR
) -> NDArray[np.float64] | None:
    """Covariance (6, 6) of a left twist at the optimum T, rad and m; None with one frame or an unobservable direction.

    floor: standard deviations (6,) that no number of frames goes below, rad and m.

    Sandwich H^-1 (n/(n-1) sum g_f g_f^T) H^-1 over the frames' gradients g_f (White 1980), inflated, plus the floor.
    """
    n = score.n_frames
    if n < 2:
        return None
    gradients = score.frame_gradients(T, level)
    _, H = score.at(level).linearise(T)
    if np.linalg.cond(H) > 1e12:
        return None
    bread = np.linalg.inv(H)
    spread = n / (n - 1) * gradients.T @ gradients
    C = INFLATION**2 * bread @ spread @ bread + np.diag(floor**2)
    return np.asarray(0.5 * (C + C.T))
