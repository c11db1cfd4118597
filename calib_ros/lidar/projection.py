"""A range image of scanners without rings: cells of elevation x azimuth, as wide as neighbouring points are apart."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calib_ros.lidar.strays import strays

CROWDING = 1.5  # distinct directions per cell hit: larger cells hide thin things (synthetic rosettes: 1.9 loses one of three)
FINE = 4  # directions nearer than this part of a cell are one: second returns, and firings along one line
SIZES = np.deg2rad(np.geomspace(0.05, 4.0, 45))  # cells tried, rad
# Cells of a range image. Spinning scanners need 1 to 4 per point, a sparse rosette that sees a fifth of the azimuths 100.
CELLS_PER_POINT, SPARE_CELLS, MOST_CELLS = 160, 2**18, 2**23
Angles = NDArray[np.floating]
Ranges = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Samples:
    """What the points of a scan are: azimuth, elevation (n,) rad and distance (n,) m; and which of them lie in each cell."""

    azimuth: Angles
    elevation: Angles
    distance: Angles
    order: NDArray[np.intp] = field(default_factory=lambda: np.empty(0, np.intp))
    start: NDArray[np.intp] = field(default_factory=lambda: np.zeros(1, np.intp))

    def inside(self, cell: NDArray[np.intp], most: int) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """Points of cells (m,), given as row * columns + column: (m, most), and which of those entries are points."""
        at = self.start[cell][:, None] + np.arange(most)
        valid = at < self.start[cell + 1][:, None]
        return self.order[np.minimum(at, len(self.order) - 1)], valid


@dataclass(frozen=True, eq=False)
class Projection:
    """range, index: (rows, columns) as in RangeImage. elevation: (rows,) rad of the cells' middles. step: rad, their width."""

    range: Ranges
    index: NDArray[np.int32]
    elevation: NDArray[np.float64]
    step: float
    samples: Samples


def project(samples: Samples, jump: float, ratio: float) -> Projection:
    """Samples -> cells. The nearest return wins; stray ones (see strays) have no index; single holes are filled where what
    surrounds them agrees. Ranges are those of the surface at the middle of the cell: on a road, points at different heights
    of one cell lie metres apart, and that is no edge."""
    azimuth, elevation, distance = samples.azimuth, samples.elevation, samples.distance
    step = cell_size(azimuth, elevation)
    columns = max(round(2 * np.pi / step), 3)
    step = 2 * np.pi / columns
    top = float(elevation.max()) + step / 2
    row = np.floor((top - elevation) / step).astype(np.intp)
    column = np.floor((azimuth + np.pi) / step).astype(np.intp) % columns
    rows = int(row.max()) + 1
    cell = row * columns + column
    # The nearest first in each cell.
    order = np.lexsort((distance, cell))
    start = np.searchsorted(cell[order], np.arange(rows * columns + 1))
    hit = start[1:] > start[:-1]
    index = np.where(hit, order[start[:-1].clip(max=len(order) - 1)], -1).astype(np.int32).reshape(rows, columns)
    middle = np.asarray(top - (np.arange(rows) + 0.5) * step, np.float64)
    raw = np.where(index >= 0, distance[index], np.nan).astype(np.float32)
    ranges = _at_middle(raw, index, samples, middle, step)
    stray = strays(ranges, jump, ratio)
    index[stray] = -1
    _fill(ranges, ratio)
    return Projection(ranges, index, middle, step, Samples(azimuth, elevation, distance, order, start))


def cell_size(azimuth: Angles, elevation: Angles) -> float:
    """Width of cells (rad) that hold CROWDING distinct directions where they hold any; wider if there were too many cells."""
    height = float(np.ptp(elevation))
    for size in SIZES:
        if (height / size + 1) * (2 * np.pi / size) > most_cells(len(elevation)):
            continue
        if _hit(azimuth, elevation, size / FINE) >= CROWDING * _hit(azimuth, elevation, size):
            return float(size)
    return float(SIZES[-1])


def most_cells(points: int) -> int:
    """Cells that a range image of so many points may have: a few broken points must not cost the memory of millions."""
    return min(CELLS_PER_POINT * points + SPARE_CELLS, MOST_CELLS)


def _hit(azimuth: Angles, elevation: Angles, size: float) -> int:
    """How many cells of this width hold points."""
    columns = int(2 * np.pi / size) + 2
    row, column = ((elevation + np.pi / 2) / size).astype(np.int64), ((azimuth + np.pi) / size).astype(np.int64)
    return len(np.unique(row * columns + column))


def _at_middle(raw: Ranges, index: NDArray[np.int32], samples: Samples, middle: NDArray[np.float64], step: float) -> Ranges:
    """Ranges at the middle of the cells. On a plane the inverse range is linear in small angles; of the slopes to both sides
    the smaller one counts, so that a surface is not bent towards what lies behind it."""
    q = 1 / raw.astype(np.float64)
    up = np.where(index >= 0, samples.elevation[index], np.nan)
    left = np.where(index >= 0, samples.azimuth[index], np.nan)
    off_up = middle[:, None] - up
    off_left = (np.arange(raw.shape[1]) + 0.5)[None] * step - np.pi - left
    out = q + _slope(q, up, 0, step) * off_up + _slope(q, left, 1, step) * off_left
    with np.errstate(invalid="ignore"):
        return np.asarray(1 / np.clip(out, 0.5 * q, 2 * q), np.float32)


def _slope(q: NDArray[np.float64], angle: NDArray[np.float64], axis: int, step: float) -> NDArray[np.float64]:
    """Change of q per rad along an axis: the smaller of both sides, 0 where they differ in sign or one is missing."""
    sides = []
    for way in (1, -1):
        slope = np.full(q.shape, np.nan)
        for k in (2, 1):  # across one empty cell if need be
            gap = np.roll(angle, way * k, axis) - angle
            gap = np.where(np.abs(gap) > np.pi, np.nan, gap)
            if axis == 0:
                edge = slice(0, k) if way > 0 else slice(-k, None)
                gap[edge] = np.nan
            with np.errstate(invalid="ignore"):
                value = (np.roll(q, way * k, axis) - q) / np.where(np.abs(gap) > 0.3 * step, gap, np.nan)
            slope = np.where(np.isnan(value), slope, value)
        sides.append(slope)
    a, b = sides
    with np.errstate(invalid="ignore"):
        both = np.where(np.abs(a) < np.abs(b), a, b)
        return np.where(a * b > 0, both, 0.0)


def _fill(ranges: Ranges, ratio: float) -> None:
    """Empty cells whose neighbours left and right, or above and below, lie on one surface."""
    with np.errstate(invalid="ignore"):
        for axis in (1, 0):
            before, after = np.roll(ranges, 1, axis), np.roll(ranges, -1, axis)
            if axis == 0:
                before[0], after[-1] = np.nan, np.nan
            hole = np.isnan(ranges) & (np.abs(before - after) < ratio * 0.5 * (before + after))
            ranges[hole] = 2 / (1 / before[hole] + 1 / after[hole])
