"""A scan as the sensor saw it: a range image of elevation x azimuth, whatever the scanner and the order of its points."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.signal import find_peaks

from calib_ros.config import LidarConfig
from calib_ros.errors import TooFewFeaturesError
from calib_ros.frame import PointCloud

# Which laser measured a point, for sources that do not say it.
MIN_RINGS, MAX_RINGS = 4, 256
RING_SPREAD = 0.3  # of the whole scan's spread of elevation: rings keep theirs better, even tilted by motion compensation (0.16)
LEVEL_SPREAD = (
    0.6  # the same for the source's own rings, which may be given in the frame of a vehicle, tilted against the scanner's
)
EVEN_ROWS = 64  # rows for a scanner without rings, where it must have some
BIN = float(np.deg2rad(0.05))  # of the elevation's histogram
TIPS = np.arange(-30, 31) / 100  # m; heights where the rays may meet, the origin in the middle
BACKWARD = 0.25  # share of steps against the turn that runs of rings may have: KITTI 0.02, lines drawn to and fro 0.5
CLEARLY = 1.1  # times sharper must a histogram be than that of the origin
ENOUGH = 20_000  # points that tell the height
Angles = NDArray[np.floating]


def ring_of_points(cloud: PointCloud, azimuth: Angles, elevation: Angles) -> NDArray[np.int32]:
    """Ring number of each point (n,) int32, as of find_rings; rows of equal height where the scanner has no rings."""
    ring = find_rings(cloud, azimuth, elevation)
    return even_rows(elevation) if ring is None else ring


def find_rings(cloud: PointCloud, azimuth: Angles, elevation: Angles) -> NDArray[np.int32] | None:
    """Ring number of each point (n,) int32: the source's own, else from the order of the points (ring after ring, as KITTI
    stores them), else from the elevation. None if there are no rings. azimuth, elevation: (n,) rad."""
    ring = cloud.ring
    # Drivers of scanners without rings number their lasers or scan lines there: each sweeps the whole field of view.
    if ring is not None and 2 <= len(np.unique(ring)) <= MAX_RINGS and is_level(ring, elevation):
        return ring
    by_order = rings_by_order(azimuth, elevation)
    return rings_by_elevation(cloud.xyz, elevation) if by_order is None else by_order


def is_level(ring: NDArray[np.int32], elevation: Angles) -> bool:
    """Whether most rings keep their elevation, compared with the whole scan."""
    return _spread(np.unique(ring, return_inverse=True)[1].astype(np.int32), elevation) <= LEVEL_SPREAD * _deviation(elevation)


def _deviation(elevation: Angles) -> float:
    return float(np.abs(elevation - np.mean(elevation)).mean())


def rings_by_order(azimuth: Angles, elevation: Angles) -> NDArray[np.int32] | None:
    """Rings as runs of steadily turning azimuth; None if the points are not stored so.

    A revolution may start at any azimuth and turn either way: the starts tried are forward, backward and the first point's;
    the one whose runs keep their elevation best is taken.
    """
    turn = np.angle(np.exp(1j * np.diff(azimuth)))
    sign = 1.0 if np.count_nonzero(turn > 0) >= np.count_nonzero(turn < 0) else -1.0
    if np.count_nonzero(sign * turn < 0) > BACKWARD * len(turn):
        return None
    limit = RING_SPREAD * _deviation(elevation)
    best: tuple[float, NDArray[np.int32]] | None = None
    for start in (0.0, np.pi, float(azimuth[0]) - sign * 1e-3):
        angle = np.mod(sign * (azimuth - start), 2 * np.pi)
        span = float(np.ptp(angle))
        ring = np.concatenate([[0], np.cumsum(np.diff(angle) < -0.5 * span)]).astype(np.int32)
        count = int(ring[-1]) + 1
        if not MIN_RINGS <= count <= MAX_RINGS or span < 0.1:
            continue
        spread = _spread(ring, elevation)
        if spread < limit and (best is None or spread < best[0]):
            best = (spread, ring)
    return None if best is None else best[1]


def _spread(ring: NDArray[np.int32], elevation: Angles) -> float:
    """Median over the rings of the mean deviation of the elevation, rad."""
    count = np.bincount(ring)
    mean = np.bincount(ring, elevation) / np.maximum(count, 1)
    return float(np.median((np.bincount(ring, np.abs(elevation - mean[ring])) / np.maximum(count, 1))[count > 0]))


def rings_by_elevation(xyz: NDArray[np.float32], elevation: Angles) -> NDArray[np.int32] | None:
    """Rings as peaks of the elevation's histogram (n,) int32; None where it has no clear peaks.

    Rays need not meet in the origin of the cloud: the histogram is that of the height where they do best.
    """
    some = xyz[:: max(len(xyz) // ENOUGH, 1)].astype(np.float64)
    distance, height = np.hypot(some[:, 0], some[:, 1]), some[:, 2]
    sharp = [_sharpness(np.arctan2(height - z, distance)) for z in TIPS]
    best = int(np.argmax(sharp))
    if sharp[best] < CLEARLY * sharp[len(TIPS) // 2]:
        return _peaks(elevation)
    return _peaks(np.arctan2(xyz[:, 2] - TIPS[best], np.hypot(xyz[:, 0], xyz[:, 1])))


def _sharpness(elevation: Angles) -> float:
    count = np.histogram(elevation, np.arange(-np.pi / 2, np.pi / 2, BIN))[0]
    return float((count.astype(np.float64) ** 2).sum())


def _peaks(elevation: Angles) -> NDArray[np.int32] | None:
    low, high = np.quantile(elevation, [0.0005, 0.9995])
    bins = np.arange(low - 0.01, high + 0.01, BIN)
    if len(bins) < MIN_RINGS:
        return None
    count, edges = np.histogram(elevation, bins)
    smooth = np.convolve(count, [0.25, 0.5, 0.25], "same")
    peaks, _ = find_peaks(np.concatenate([[0], smooth, [0]]), prominence=max(0.05 * smooth.max(), 3.0))
    centres = 0.5 * (edges[:-1] + edges[1:])[peaks - 1]
    if not MIN_RINGS <= len(centres) <= MAX_RINGS:
        return None
    nearest = np.searchsorted(0.5 * (centres[:-1] + centres[1:]), elevation)
    if np.mean(np.abs(elevation - centres[nearest]) < 0.25 * np.median(np.diff(centres))) <= 0.8:
        return None
    return np.asarray(nearest, np.int32)


def even_rows(elevation: Angles) -> NDArray[np.int32]:
    """Rows of equal height (n,) int32, for a scanner without rings."""
    low, high = np.quantile(elevation, [0.0005, 0.9995])
    height = max((high - low) / EVEN_ROWS, 1e-6)
    return np.asarray(np.clip((elevation - low) / height, 0, EVEN_ROWS - 1), np.int32)


# Columns of the range image of a spinning scanner: its azimuth step, and the column of each firing.
ENOUGH_POINTS = 30_000  # points that tell the azimuth step
MAX_COLUMNS = 16384
LEVELS = 25.0  # bins of gaps per unit of their logarithm: each 4 % wide
USUAL_STEP = float(np.deg2rad(0.2))  # where no ring has two points


def azimuth_step(row: NDArray[np.int32], azimuth: NDArray[np.floating]) -> float:
    """The most frequent azimuth difference of neighbours in a ring, rad.

    Lost returns leave multiples of the step, and second returns of one firing leave differences near 0 of all sizes: neither
    is as frequent.
    """
    every = max(len(row) // ENOUGH_POINTS, 1)
    some = row % every == 0
    if not some.any():
        some = np.ones(len(row), bool)
    row, azimuth = row[some], azimuth[some]
    order = np.lexsort((azimuth, row))
    gap = np.diff(azimuth[order])
    gap = gap[(np.diff(row[order]) == 0) & (gap > 2 * np.pi / MAX_COLUMNS)]
    if not len(gap):
        return USUAL_STEP
    level = np.rint(np.log(gap / gap.min()) * LEVELS).astype(np.intp)
    count = np.convolve(np.bincount(level), [1, 1, 1], "same")
    usual = gap[np.abs(level - count.argmax()) <= 4]
    return float(np.median(usual))


def columns_of(row: NDArray[np.int32], azimuth: NDArray[np.floating], columns: int) -> NDArray[np.intp]:
    """Column (n,) of each point, its ring's firings in the middle of the cells.

    Firings that fall on the borders of cells (simulators start at exactly -180 deg) would by rounding share a cell here and
    leave one empty there, and the jump across the empty one is no edge.
    """
    turn = azimuth.astype(np.float64) * columns
    rings = np.bincount(row, np.cos(turn)) + 1j * np.bincount(row, np.sin(turn))
    # Relative to the mean of all rings, so that rings which fire together stay in the same columns.
    common = np.angle(rings.sum())
    phase = common + np.angle(rings * np.exp(-1j * common))
    return np.asarray(np.rint((turn - phase[row]) / (2 * np.pi) + columns // 2).astype(np.intp) % columns)


# Where the rays of a ring run: on a cone about the sensor's axis, whose tip need not be the origin of the cloud.
TIP_SIGMA, HEIGHT_SIGMA = 0.15, 0.02  # m; how far tips lie from the origin, and points from their cone


def ring_cones(row: NDArray[np.int32], xyz: NDArray[np.float32], rows: int) -> NDArray[np.float64]:
    """Cones z = offset + slope * distance from the axis of each row's points (n, 3) -> (rows, 2) offset in m and slope.

    Lasers of one sensor sit at different heights, 0.12 m to 0.21 m above the origin in an HDL-64E: near points of a ring then
    have another elevation than far ones, and the next ring's ray is not where the elevations would have it.
    """
    z = xyz[:, 2].astype(np.float64)
    rho = np.hypot(xyz[:, 0], xyz[:, 1]).astype(np.float64)
    weight = 1 / np.maximum(rho, 0.1)  # errors grow with the distance where rays are tilted
    count, s_r, s_rr = (
        np.bincount(row, weight, rows),
        np.bincount(row, weight * rho, rows),
        np.bincount(row, weight * rho * rho, rows),
    )
    s_z, s_rz = np.bincount(row, weight * z, rows), np.bincount(row, weight * rho * z, rows)
    n = np.asarray(count + (HEIGHT_SIGMA / TIP_SIGMA) ** 2)  # where a ring shows one distance only, its tip is the origin
    determinant = np.maximum(n * s_rr - s_r**2, 1e-12)
    return np.stack([(s_z * s_rr - s_r * s_rz) / determinant, (n * s_rz - s_r * s_z) / determinant], axis=1)


# Returns of a range image that show no surface: rain and dust, and beams that hit two surfaces at once.
Ranges = NDArray[np.float32]
Mask = NDArray[np.bool_]


def isolated_returns(ranges: Ranges, jump: float, ratio: float) -> Mask:
    """Cells (rows, columns) whose return is alone, or lies between a near and a far surface.

    jump, ratio: ranges that differ less than `jump` m, or than this share of the range, are of one surface. A pole one
    column wide is no stray: it goes on above or below.
    """
    limit = np.maximum(np.float32(jump), np.float32(ratio) * ranges)
    alone = ~_near(ranges, np.roll(ranges, 1, 1), limit) & ~_near(ranges, np.roll(ranges, -1, 1), limit)
    alone &= ~np.isnan(ranges)
    row, column = np.nonzero(alone)
    if not len(row):
        return alone
    # Few are left: their other neighbours are looked up one by one.
    rows, columns = ranges.shape
    R, own = ranges[row, column], limit[row, column]
    upright = np.zeros(len(row), bool)
    diagonal = np.zeros(len(row), bool)
    for up in (-1, 1):
        inside = (row + up >= 0) & (row + up < rows)
        beyond = np.clip(row + up, 0, rows - 1)
        upright |= inside & _near(R, ranges[beyond, column], own)
        for aside in (-1, 1):
            diagonal |= inside & _near(R, ranges[beyond, (column + aside) % columns], own)
    for aside in (-2, 2):
        diagonal |= _near(R, ranges[row, (column + aside) % columns], own)
    left, right = ranges[row, (column + 1) % columns], ranges[row, (column - 1) % columns]
    with np.errstate(invalid="ignore"):
        mixed = ((left - R) * (right - R) < 0) & ~_steady(R, left, right)
    alone[row, column] = ~upright & (mixed | ~diagonal)
    return alone


def _near(a: Ranges, b: Ranges, limit: Ranges) -> Mask:
    with np.errstate(invalid="ignore"):
        return np.asarray(np.abs(a - b) < limit)


def _steady(R: Ranges, left: Ranges, right: Ranges) -> Mask:
    """Whether the three lie on one flat surface, along which the inverse range is linear."""
    middle, step = 0.5 * (1 / left + 1 / right), np.abs(1 / left - 1 / right)
    return np.asarray(np.abs(1 / R - middle) < 0.2 * step)


# A range image of scanners without rings: cells of elevation x azimuth, as wide as neighbouring points are apart.
CROWDING = 1.5  # distinct directions per cell hit: larger cells hide thin things (synthetic rosettes: 1.9 loses one of three)
FINE = 4  # directions nearer than this part of a cell are one: second returns, and firings along one line
SIZES = np.deg2rad(np.geomspace(0.05, 4.0, 45))  # cells tried, rad
# Cells of a range image. Spinning scanners need 1 to 4 per point, a sparse rosette that sees a fifth of the azimuths 100.
CELLS_PER_POINT, SPARE_CELLS, MOST_CELLS = 160, 2**18, 2**23


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
    stray = isolated_returns(ranges, jump, ratio)
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


MIN_POINTS = 100  # a scan with fewer returns shows nothing
SAME_SURFACE = 0.05  # share of the range by which neighbours on one surface may differ


@dataclass(frozen=True, eq=False)
class RangeImage:
    """Range image of a scan; row 0 is the highest, columns run counter-clockwise from azimuth -180 deg.

    range: (rows, cols) float32 metres, NaN where nothing returned; isolated holes are interpolated.
    index: (rows, cols) int32 into `cloud`, -1 where there is no measured point of a surface (interpolated holes
    and stray returns).
    elevation: (rows,) rad, median per ring. azimuth_step: rad. reflectivity: (n,) 0..1 per point of `cloud`, or None.
    layout: "rings" = a row is a ring and its rays run on a cone, cones: (rows, 2) as of ring_cones; "projection" = no rings,
    rows and columns are cells as wide as the points are apart; `range` then holds the range at the middle of the cell, and
    samples knows what lies in it.
    """

    range: NDArray[np.float32]
    index: NDArray[np.int32]
    elevation: NDArray[np.float64]
    azimuth_step: float
    cloud: PointCloud
    reflectivity: NDArray[np.float32] | None
    cones: NDArray[np.float64]
    samples: Samples | None = None

    @property
    def layout(self) -> str:
        """ "rings" or "projection"."""
        return "rings" if self.samples is None else "projection"


def range_image(cloud: PointCloud, config: LidarConfig) -> RangeImage:
    """Point cloud -> range image; the nearest return wins a cell. TooFewFeaturesError when hardly anything returned."""
    cloud = cloud.finite()
    distance = np.linalg.norm(cloud.xyz, axis=1)
    keep = distance >= config.min_range
    if int(keep.sum()) < MIN_POINTS:
        raise _too_few(int(keep.sum()))
    cloud, distance = cloud.select(keep), distance[keep]
    azimuth = np.arctan2(cloud.xyz[:, 1], cloud.xyz[:, 0])
    elevation = np.arcsin(cloud.xyz[:, 2] / distance)
    ring = None if config.layout == "projection" else find_rings(cloud, azimuth, elevation)
    if ring is None and config.layout != "rings":
        return _projection(cloud, Samples(azimuth, elevation, distance), config)
    return _rings(cloud, even_rows(elevation) if ring is None else ring, azimuth, elevation, distance, config)


def _rings(
    cloud: PointCloud,
    ring: NDArray[np.int32],
    azimuth: NDArray[np.floating],
    elevation: NDArray[np.floating],
    distance: NDArray[np.floating],
    config: LidarConfig,
) -> RangeImage:
    row, row_elevation = _rows_from_top(ring, elevation)
    step = azimuth_step(row, azimuth)
    columns = max(min(round(2 * np.pi / step), most_cells(len(row)) // len(row_elevation)), 1)
    step = max(step, 2 * np.pi / (columns + 0.5))  # wider only where there would have been too many columns
    column = columns_of(row, azimuth, columns)
    ranges = np.full((len(row_elevation), columns), np.nan, np.float32)
    index = np.full(ranges.shape, -1, np.int32)
    order = np.argsort(-distance, kind="stable")  # later writes win: nearest last
    ranges[row[order], column[order]] = distance[order]
    index[row[order], column[order]] = order
    stray = isolated_returns(ranges, config.jump_min, SAME_SURFACE)
    index[stray] = -1
    _fill_single_holes(ranges, config.hole_jump)
    cones = ring_cones(row, cloud.xyz, len(row_elevation))
    return RangeImage(ranges, index, row_elevation, step, cloud, reflectivity(cloud.intensity), cones)


def _projection(cloud: PointCloud, samples: Samples, config: LidarConfig) -> RangeImage:
    image = project(samples, config.jump_min, SAME_SURFACE)
    cones = np.stack([np.zeros(len(image.elevation)), np.tan(image.elevation)], axis=1)
    light = reflectivity(cloud.intensity)
    return RangeImage(image.range, image.index, image.elevation, image.step, cloud, light, cones, image.samples)


def require_returns(cloud: PointCloud) -> None:
    """TooFewFeaturesError if hardly a point of the cloud is a return; far cheaper than the range image."""
    usable = len(cloud.finite())
    if usable < MIN_POINTS:
        raise _too_few(usable)


def _too_few(usable: int) -> TooFewFeaturesError:
    return TooFewFeaturesError(f"the cloud has {usable} usable points; check that the LiDAR sees something and is not covered")


def _rows_from_top(ring: NDArray[np.int32], elevation: NDArray[np.floating]) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Ring numbers of any order (n,) -> row from the top (n,) and the median elevation of each row."""
    order = np.argsort(ring, kind="stable")
    names, first = np.unique(ring[order], return_index=True)
    medians = np.array([np.median(part) for part in np.split(elevation[order], first[1:])])
    from_top = np.argsort(-medians, kind="stable")
    row_of_name = np.empty(len(names), np.int32)
    row_of_name[from_top] = np.arange(len(names), dtype=np.int32)
    return row_of_name[np.searchsorted(names, ring)], medians[from_top]


def _fill_single_holes(ranges: NDArray[np.float32], hole_jump: float) -> None:
    left, right = np.roll(ranges, 1, 1), np.roll(ranges, -1, 1)
    with np.errstate(invalid="ignore"):
        hole = np.isnan(ranges) & (np.abs(left - right) < hole_jump)
    ranges[hole] = 0.5 * (left[hole] + right[hole])


def reflectivity(intensity: NDArray[np.float32] | None) -> NDArray[np.float32] | None:
    """Intensity in the driver's unit -> 0..1. Units in use: 0..1 (KITTI), 0..255 (most drivers), counts (Ouster).

    None when there is no intensity, or it is the same everywhere (drivers without it fill in a constant).
    """
    if intensity is None or len(intensity) == 0:
        return None
    values = np.nan_to_num(intensity, nan=0.0, posinf=0.0, neginf=0.0)
    high = float(np.percentile(values, 99.9))
    if high <= float(values.min()):
        return None
    full_scale = 1.0 if values.max() <= 1.5 else 255.0 if values.max() <= 256 else high
    return np.asarray(np.clip(values / np.float32(full_scale), 0, 1), np.float32)
