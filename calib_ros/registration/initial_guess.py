"""Where the search starts when nobody knows the extrinsic."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3

# Optical axes (x right, y down, z forward) in terms of the LiDAR's (x forward, y left, z up).
_OPTICAL_FROM_BODY = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])

NOMINAL = "nominal: no saved state, parameters or TF gave one"  # the reason of such an initial extrinsic
SEMANTIC = "semantic"  # instead of an extrinsic: nothing is known of it, the scenes' classes tell


def nominal(yaw_deg: float = 0.0) -> NDArray[np.float64]:
    """T_camera_lidar (4, 4) of a camera at the LiDAR that looks along the LiDAR's +x axis, turned left by yaw_deg."""
    turn = se3.rotation_from_euler(np.deg2rad(-yaw_deg), 0, 0)
    return se3.from_parts(_OPTICAL_FROM_BODY @ turn, np.zeros(3))
