"""Names of arrays by their shape, for type hints: numpy's types do not know it. What has another shape says so beside it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
"""Any shape."""
Transform = NDArray[np.float64]
"""(4, 4), rigid, T_target_source, m."""
Covariance = NDArray[np.float64]
"""(6, 6), of a left twist, which is (rx, ry, rz, tx, ty, tz) in rad and m."""
