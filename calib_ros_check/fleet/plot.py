"""The six axes of a vehicle's extrinsic over time, as inline SVG in the colours of the page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np

from calib_ros.arrays import Matrix
from calib_ros_check.fleet.history import Vehicle
from calib_ros_check.tolerance import AXES

WIDTH, HEIGHT = 380, 150  # px, where a phone shows it
LEFT, RIGHT, TOP, BOTTOM = 44, 8, 18, 18
SCALES = np.r_[np.rad2deg([1.0] * 3), [100.0] * 3]  # to deg and cm
SMALLEST = (0.1, 1.0)  # half of the range that is shown at least, deg and cm


@dataclass(frozen=True)
class Point:
    """A recording in a plot, px. low, high: two standard deviations to either side, cut off at the edges."""

    x: float
    y: float
    low: float
    high: float
    verdict: str
    outlier: bool
    title: str


@dataclass(frozen=True)
class AxisPlot:
    """One axis of a vehicle, px. means: (x from, x to, y) of the segments. changes: x of each. ticks: (y, text)."""

    axis: str
    unit: str
    points: Sequence[Point]
    means: Sequence[tuple[float, float, float]]
    changes: Sequence[float]
    ticks: Sequence[tuple[float, str]]


def plots(vehicle: Vehicle, variances: Matrix) -> list[AxisPlot]:
    """Six plots, against the mean of the first segment; none without an estimate. variances: (6,) between recordings."""
    if not vehicle.known:
        return []
    own, found = vehicle.sequence.with_scatter(variances), vehicle.segments
    x = _places(np.array([row.time_ns for row in vehicle.known], float))
    values = (own.values - found.means[0]) * SCALES
    bars = 2 * np.sqrt(np.diagonal(own.covariances, axis1=1, axis2=2)) * SCALES
    means = (found.means - found.means[0]) * SCALES
    inside = np.array([k not in found.outliers for k in range(len(values))])
    out = []
    for axis, name in enumerate(AXES):
        unit = "deg" if axis < 3 else "cm"
        # A recording that tells little must not flatten all others.
        reach = np.abs(values[inside, axis]) + np.minimum(bars[inside, axis], 2 * np.median(bars[inside, axis]))
        half = max(float(np.quantile(reach, 0.95)), float(np.abs(means[:, axis]).max()) * 1.2, SMALLEST[axis // 3]) * 1.1
        at = partial(_height, half)
        points = [
            Point(
                *(float(x[k]), at(values[k, axis])),
                *(at(values[k, axis] - bars[k, axis]), at(values[k, axis] + bars[k, axis])),
                *(row.verdict, row.outlier),
                f"{row.recording}, {row.time}: {values[k, axis]:+.2f} +- {bars[k, axis]:.2f} {unit}",
            )
            for k, row in enumerate(vehicle.known)
        ]
        spans = [np.flatnonzero(found.labels == label) for label in range(len(means))]
        lines = [(float(x[span[0]]) - 4, float(x[span[-1]]) + 4, at(means[k, axis])) for k, span in enumerate(spans)]
        divisions = [float(x[span[0]] + x[before[-1]]) / 2 for before, span in pairwise(spans)]
        tick = _round(half / 1.5)
        ticks = [(at(value), f"{value:+g}" if value else "0") for value in (-tick, 0.0, tick)]
        out.append(AxisPlot(name, unit, points, lines, divisions, ticks))
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
