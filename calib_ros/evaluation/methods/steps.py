"""How far off a start may be, as step lengths and limits for the optimisers of several methods."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_ros.registration.constraints import Limits, unlimited
from calib_ros.registration.optimizers import METRES_PER_RADIAN
from calib_ros.registration.search_box import SearchBox

Matrix = NDArray[np.float64]
REFINED_DEG = 0.4  # of a reach of zero, where the start is said to be right: a few pixels


def typical_step_deg(reach: SearchBox) -> float:
    """One length for all axes (deg, and METRES_PER_RADIAN times that in translation) of the size of the reach: the geometric
    mean of what it allows in rotation and in translation; where only one of the two is open, that one."""
    deg, m = reach.reach
    of_shift = float(np.rad2deg(m / METRES_PER_RADIAN))
    if deg and of_shift:
        return float(np.sqrt(deg * of_shift))
    return max(deg, of_shift) or REFINED_DEG


def within(T: Matrix, reach: SearchBox) -> Limits:
    """The start T (4, 4) is off by no more than the reach, axis by axis: no optimiser needs to look farther. A reach of zero
    bounds nothing."""
    return unlimited(T) if reach.is_empty else Limits(T, reach.half_width())
