"""What Levinson and Thrun (2013) do with a score: the search by the 3^6 neighbours of an extrinsic."""

from __future__ import annotations

from itertools import product
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.evaluation.methods.method import Watched
from calib_ros.registration.scores import Score

Matrix = NDArray[np.float64]
NEIGHBOURS = np.array(sorted(product((-1, 0, 1), repeat=6), key=np.count_nonzero), np.float64)  # (729, 6), the centre first

# Of the test of a calibration. Area under the ROC of single frames, 30 of KITTI and 12 synthetic, for errors of 0.5 deg, of
# 10 cm, and of both: 0.94, 0.93, 0.98; 0.99 by the mean of five frames. With 0.1 deg and 2 cm 0.88, 0.88, 0.91, with 0.3 deg and
# 6 cm 0.93, 0.92, 0.97, with 0.5 deg and 10 cm 0.89, 0.85, 0.94.
STEP_DEG, STEP_M = 0.2, 0.04


class ManyScore(Score, Protocol):
    """A score that takes many extrinsics at once."""

    def values(self, transforms: Matrix) -> Matrix:
        """Scores (k,) of (k, 4, 4)."""
        ...


def grid_search(score: ManyScore, watched: Watched, T: Matrix, half_width: Matrix, finest: Matrix) -> Matrix:
    """The best extrinsic (4, 4) by grid search around T: of the 729 neighbours the best is moved to; while that is the centre
    itself, the step is halved, as long as it is above `finest` on any axis.

    The grid is laid out in the twist from T. half_width, finest: (6,) rad and m. The first step is half of half_width, and
    beyond half_width nothing is tried; an axis of half width 0 stays. watched: counts the evaluations of `score`.
    """
    centre, step = np.zeros(6), half_width / 2
    watched.value(T)
    while (step > finest).any():
        twists = centre + step * NEIGHBOURS[_differ(step)]
        twists = twists[(np.abs(twists) <= half_width + 1e-12).all(axis=1)]
        transforms = se3.exp_many(twists) @ T
        best = int(np.argmax(score.values(transforms)))
        watched.evaluations += len(transforms) - 1
        if best == 0:
            step = step / 2
        else:
            centre = twists[best]
        watched.value(transforms[best])
    return np.asarray(se3.exp(centre) @ T)


def _differ(step: Matrix) -> NDArray[np.intp]:
    """Rows of NEIGHBOURS that differ, given that axes of step 0 do not move."""
    return np.flatnonzero(~NEIGHBOURS[:, step == 0].any(axis=1))


def worse_share(score: ManyScore, T: Matrix, step_deg: float = STEP_DEG, step_m: float = STEP_M) -> float:
    """F_C: the share of the 728 neighbours of T (4, 4), one step away along any of the axes, whose score is lower than that of T.

    Without structure it is about one half; at the optimum of a score that is well-behaved it is 1.
    """
    step = np.repeat([np.deg2rad(step_deg), step_m], 3)
    values = score.values(se3.exp_many(step * NEIGHBOURS) @ T)
    return float(np.mean(values[1:] < values[0]))
