"""Names of arrays by their shape, for type hints: numpy's types do not know it. Others say their shape beside. Quantiles."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
"""Any shape."""
Transform = NDArray[np.float64]
"""(4, 4), rigid, T_target_source, m."""
Covariance = NDArray[np.float64]
"""(6, 6), of a left twist, which is (rx, ry, rz, tx, ty, tz) in rad and m."""


def quantile(values: NDArray[Any], share: float) -> Any:
    """The value below which a share of (n,) lies, interpolated as by np.quantile and np.median, which take ten times as long."""
    low = int(share * (len(values) - 1))
    part = np.partition(values, low)  # of one rank at a time: only that is made of vector instructions
    t = values.dtype.type(share * (len(values) - 1) - low)
    a, b = part[low], part[low + 1 :].min() if t else part[low]
    return 0.5 * (a + b) if t == 0.5 else a + (b - a) * t if t < 0.5 else b - (b - a) * (1 - t)
