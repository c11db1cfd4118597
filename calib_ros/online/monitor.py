"""Is the current extrinsic still right?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3

# A shift of this size is one unit of drift; measured on KITTI subsets, see the area under ROC of the "LM shift" test.
UNIT_ROTATION_DEG = 0.25
UNIT_TRANSLATION_M = 0.06


def drift(T_current: NDArray[np.float64], T_estimate: NDArray[np.float64]) -> float:
    """How far the estimate (4, 4) lies from the current extrinsic (4, 4): |dr| / 0.25 deg + |dt| / 6 cm, no unit.

    Below 1 the difference is within what frames of a good calibration show; above 2 the calibration has most likely moved.
    """
    rotation = se3.rotation_error_deg(T_current, T_estimate) / UNIT_ROTATION_DEG
    return rotation + se3.translation_error_m(T_current, T_estimate) / UNIT_TRANSLATION_M
