"""Per-point times of a LiDAR scan, whatever their unit and origin -> seconds from the header stamp."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

SCAN_NS = (5e5, 5e9)  # a scan lasts between 0.5 ms (a packet of points) and 5 s (a solid-state unit that accumulates)
RELATIVE_NS = 2e9  # times within this of zero count from the header stamp, else they are absolute
SAME_CLOCK_NS = 5e9  # an absolute time farther than this from the header stamp comes from another clock
# Nanoseconds per count, the usual one of the type first: Ouster's `t` is uint32 nanoseconds, Velodyne's
# `time` float32 seconds, Hesai's and Robosense's `timestamp` float64 seconds, Livox's `timestamp` float64
# nanoseconds.
INTEGER_UNITS = (1, 10**3, 10**6)
FLOAT_UNITS = (10**9, 10**6, 10**3, 1)


def seconds_from_stamp(values: NDArray[Any], stamp: int) -> NDArray[np.float32] | None:
    """Times (n,) of any number type and the header's stamp in ns -> (n,) float32 seconds from that stamp.

    PointField has no unit, so the span of the scan decides it: the first unit that makes it last as long as
    a scan can. Absolute times of another clock than the header's are counted from the earliest point.
    Points without a time (zero or NaN) get 0. None when no unit makes sense.
    """
    integers = values.dtype.kind in "iub"
    counts = values.astype(np.int64 if integers else np.float64)
    valid = (counts != 0) & np.isfinite(counts)
    if not valid.any():
        return np.zeros(len(counts), np.float32)
    number = int if integers else float  # Python's int cannot overflow in the differences below
    first, last = number(counts[valid].min()), number(counts[valid].max())
    unit = _unit(last - first, INTEGER_UNITS if integers else FLOAT_UNITS)
    if unit is None:
        return None
    if max(abs(first), abs(last)) * unit <= RELATIVE_NS:
        origin = 0 * first
    elif abs(first * unit - stamp) <= SAME_CLOCK_NS:
        origin = stamp // unit if integers else stamp / unit
    else:
        origin = first
    seconds = ((counts - origin) * (unit * 1e-9)).astype(np.float32)
    seconds[~valid] = 0
    return seconds


def _unit(span: float, units: tuple[int, ...]) -> int | None:
    shortest, longest = SCAN_NS
    for unit in units:
        if shortest <= span * unit <= longest:
            return unit
    return units[0] if span * units[0] < shortest else None
