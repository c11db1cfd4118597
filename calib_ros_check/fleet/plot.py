"""The six axes of a vehicle's extrinsic over time, as inline SVG in the colours of the page."""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from calib_ros.arrays import Matrix
from calib_ros_check.fleet.history import Vehicle
from calib_ros_check.tolerance import AXES

WIDTH, HEIGHT = 380, 150  # px, where a phone shows it
LEFT, RIGHT, TOP, BOTTOM = 44, 8, 18, 18
SCALES = np.r_[np.rad2deg([1.0] * 3), [100.0] * 3]  # to deg and cm
SMALLEST = (0.1, 1.0)  # half of the range that is shown at least, deg and cm


def plots(vehicle: Vehicle, variances: Matrix) -> list[dict[str, Any]]:
    """Six plots, one per axis, against the mean of the first segment; none without an estimate. variances: (6,) between
    recordings.

    Of each, px: points, with two standard deviations to either side (low, high), cut off at the edges; means: (x from, x to, y)
    of the segments; changes: x of each; ticks: (y, text).
    """
    if not vehicle.known:
        return []
    own, found = vehicle.sequence.with_scatter(variances), vehicle.segments
    x = _places(np.array([row.time_ns for row in vehicle.known], float)).tolist()
    values = (own.values - found.means[0]) * SCALES
    bars = 2 * np.sqrt(np.diagonal(own.covariances, axis1=1, axis2=2)) * SCALES
    means = (found.means - found.means[0]) * SCALES
    inside = np.array([k not in found.outliers for k in range(len(values))])
    spans = [np.flatnonzero(found.labels == label) for label in range(len(means))]
    divisions = [(x[span[0]] + x[before[-1]]) / 2 for before, span in pairwise(spans)]
    out = []
    for axis, name in enumerate(AXES):
        unit = "deg" if axis < 3 else "cm"
        # A recording that tells little must not flatten all others.
        reach = np.abs(values[inside, axis]) + np.minimum(bars[inside, axis], 2 * np.median(bars[inside, axis]))
        half = max(float(np.quantile(reach, 0.95)), float(np.abs(means[:, axis]).max()) * 1.2, SMALLEST[axis // 3]) * 1.1
        at = partial(_height, half)
        points = [
            {
                **{"x": x[k], "y": at(value), "low": at(value - bar), "high": at(value + bar), "row": row},
                "title": f"{row.recording}, {row.time}: {value:+.2f} +- {bar:.2f} {unit}",
            }
            for k, (row, value, bar) in enumerate(zip(vehicle.known, values[:, axis], bars[:, axis], strict=True))
        ]
        lines = [(x[span[0]] - 4, x[span[-1]] + 4, at(mean)) for mean, span in zip(means[:, axis], spans, strict=True)]
        tick = _round(half / 1.5)
        ticks = [(at(value), f"{value:+g}" if value else "0") for value in (-tick, 0.0, tick)]
        drawn = {"points": points, "means": lines, "changes": divisions, "ticks": ticks}
        out.append({"axis": name, "unit": unit, **drawn})
    return out


def _height(half: float, value: float) -> float:
    """px from the top, cut off at the edges."""
    share = float(np.clip(value / half, -1, 1))
    return round(TOP + (HEIGHT - TOP - BOTTOM) * (1 - share) / 2, 1)


def _places(times: Matrix) -> Matrix:
    """px from the left: by time, or in even steps where the times tell no two apart."""
    known = np.ptp(times) > 0 and (times > 0).all()
    share = (times - times.min()) / np.ptp(times) if known else np.arange(len(times)) / max(len(times) - 1, 1)
    return np.round(LEFT + 8 + (WIDTH - LEFT - RIGHT - 16) * share, 1)


def _round(value: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not larger."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(step for step in (1, 2, 5) if step * power <= value * (1 + 1e-9)) * power)
