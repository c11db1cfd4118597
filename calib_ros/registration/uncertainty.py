"""How far the estimate may be off: covariance from how much the frames disagree, and from what is known of such scores."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_ros.registration.constraints import SCORE_NOISE, Known
from calib_ros.registration.point_score import PointScore

# Measured on 245 KITTI frames: the sandwich is 2-4 times overconfident, since neighbouring frames are not independent, and
# no number of frames goes below a floor of bias.
INFLATION = 2.5
FLOOR = np.array([np.deg2rad(0.04)] * 3 + [0.018] * 3)  # rad, m

# Of the thesis's objective: 0.13-0.18 deg and 3.6-4.9 cm remain on 4 to 10 spread KITTI scenes.
THESIS_FLOOR = np.array([np.deg2rad(0.1)] * 3 + [0.03] * 3)

# Frames that the usual noise of a score counts for: fewer than 6 cannot even span all directions by their disagreement.
USUAL_FRAMES = 5


def covariance(
    score: PointScore,
    T: NDArray[np.float64],
    level: int = -1,
    floor: NDArray[np.float64] = FLOOR,
    known: Known | None = None,
) -> NDArray[np.float64] | None:
    """Covariance (6, 6) of a left twist at the optimum T, rad and m; None with a direction that cannot be observed.

    floor: standard deviations (6,) that no number of frames goes below, rad and m. known: axes that are fixed have variance
    0, and a prior adds its information.

    Sandwich H^-1 (n/(n-1) sum g_f g_f^T) H^-1 over the frames' gradients g_f (White 1980), inflated, averaged with what a
    score of n frames usually has, SCORE_NOISE / n H^-1, plus the floor.
    """
    axes = np.flatnonzero(known.limits.open_axes) if known else np.arange(6)
    n = len(np.unique(score.frame))
    gradients = score.frame_gradients(T, level)[:, axes]
    H = score.at(level).linearise(T)[1][np.ix_(axes, axes)]
    if not len(axes) or np.linalg.cond(H) > 1e12:
        return None if len(axes) else np.zeros((6, 6))
    bread = np.linalg.inv(H)
    inner = SCORE_NOISE / n * bread
    if n > 1:
        spread = INFLATION**2 * n / (n - 1) * gradients.T @ gradients
        inner = ((n - 1) * bread @ spread @ bread + USUAL_FRAMES * inner) / (n - 1 + USUAL_FRAMES)
    inner = inner + np.diag(floor[axes] ** 2)
    if known and known.prior:
        inner = np.linalg.inv(np.linalg.inv(inner) + np.diag(known.told()[axes]))
    C = np.zeros((6, 6))
    C[np.ix_(axes, axes)] = 0.5 * (inner + inner.T)
    return C
