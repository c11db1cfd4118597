"""A scan as a range image of elevation x azimuth, whatever the scanner and the order of its points."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib_ros.arrays import quantile
from calib_ros.config import LidarConfig
from calib_ros.errors import TooFewFeaturesError
from calib_ros.frame import PointCloud
from calib_ros.lidar.rings import Angles, angles, azimuth_step, by_ring, columns_of, even_rows, find_rings, scan_rings
from calib_ros.lidar.scanner_pose import CLOUD_FRAME, ScannerPose, hangs_upside_down, ring_cones

Ranges = NDArray[np.float32]
Mask = NDArray[np.bool_]
FARTHEST_MEDIAN_M = 500.0  # beyond what scanners of vehicles measure at all; a room of 1 m in millimetres is farther away
MIN_POINTS = 100  # returns a scan needs
SAME_SURFACE = 0.05  # share of the range by which neighbours on one surface may differ
JUMP_MIN = 0.3  # m; smallest range jump of an edge: 0.08 to 0.3 lead to the same errors with 32 to 128 rings
# Times the 90 % quantile: of a scanner that neither clips nor compensates for the range, near ground returns 7 times as much, but
# retroreflectors 1e5 times, beside which all other surfaces would be black.
BRIGHT = 8.0
HOLE_JUMP = 0.5  # m; a single lost return is filled in if its neighbours differ by less
# Cells of a scanner without rings.
DIRECTIONS_PER_CELL = 1.5  # distinct directions per hit cell; larger cells hide thin things: at 1.9 a rosette loses one of three
DISTINCT_PART = 4  # directions closer than this part of a cell are one: second returns, and firings along one line
CELL_SIZES = np.deg2rad(np.geomspace(0.05, 4.0, 45))  # rad; widths tried
COARSE_SIZES = 5  # of these, every so many are tried first
SIZE_POINTS, SIZE_SECTOR = 40_000, np.deg2rad(10.0)  # points that tell the size, of whole sectors wider than any likely cell
# Limit of cells. Spinning scanners need 1 to 4 per point, a sparse rosette that covers a fifth of the azimuths 100.
CELLS_PER_POINT, SPARE_CELLS, MAX_CELLS = 160, 2**18, 2**23


@dataclass(frozen=True, eq=False)
class RangeImage:
    """Range image of a scan; row 0 is the highest, columns run counter-clockwise from azimuth -180 deg.

    Attributes
    ----------
    range : (rows, columns) float32, m; NaN without a return. Single holes are interpolated.
    index : (rows, columns) int32 into `cloud`; -1 where no surface point was measured (interpolated holes, isolated returns).
    elevation : (rows,) rad, median of each row. azimuth_step : rad, width of a column.
    reflectivity : (n,) 0..1 per point of `cloud`, or None.
    cones : (rows, 2) as of `scanner_pose.ring_cones`.
    samples : None for the layout "rings", in which a row is a ring. For the layout "projection" (scanners without rings) rows
        and columns are cells about as wide as neighbouring points are apart, `range` is the range at the centre of the cell,
        and samples holds the points of each cell.
    pose : of the scanner in the frame of `cloud`. Range, elevation, azimuth and cones are the scanner's.
    """

    range: NDArray[np.float32]
    index: NDArray[np.int32]
    elevation: NDArray[np.float64]
    azimuth_step: float
    cloud: PointCloud
    reflectivity: NDArray[np.float32] | None
    cones: NDArray[np.float64]
    samples: Samples | None = None
    pose: ScannerPose = CLOUD_FRAME

    @property
    def layout(self) -> str:
        """ "rings" or "projection"."""
        return "rings" if self.samples is None else "projection"


def range_image(cloud: PointCloud, config: LidarConfig) -> RangeImage:
    """Range image of a point cloud; the nearest return wins a cell. Raises TooFewFeaturesError for fewer than MIN_POINTS returns
    beyond ``config.min_range``."""
    given = None if config.scanner_pose == "auto" else ScannerPose.given(config.scanner_position_m, config.scanner_rpy_deg)
    pose, ring = given or CLOUD_FRAME, None
    cloud, own, distance = _beyond(cloud.finite(), pose, config.min_range)
    seen = angles(own)
    if config.layout != "projection":
        ring, pose = scan_rings(cloud, seen) if given is None else (find_rings(cloud, *seen, own), given)
        if given is None and not pose.is_cloud_frame:
            cloud, own, distance = _beyond(replace(cloud, ring=ring), pose, config.min_range)
            ring, seen = cloud.ring, angles(own)
    middle = float(quantile(distance[:: 1 + len(distance) // 4096], 0.5))
    if middle > FARTHEST_MEDIAN_M:
        raise TooFewFeaturesError(
            f"half of the points are {middle:.0f} m away or more, as if their coordinates were in millimetres, "
            "or of a map; give metres in the LiDAR's frame"
        )
    if hangs_upside_down(own):
        pose, own = pose.turned_over(), own * np.array([1, -1, -1], np.float32)
        seen = angles(own)
    if ring is None and config.layout != "rings":
        return _project(cloud, *seen, distance, pose)
    return _from_rings(cloud, own, even_rows(seen[1]) if ring is None else ring, seen, distance, pose)


def _beyond(cloud: PointCloud, pose: ScannerPose, min_range: float) -> tuple[PointCloud, Ranges, Ranges]:
    """The points of a finite cloud at least min_range from the scanner; in its frame (n, 3), and their distances (n,)."""
    own = pose.to_scanner(cloud.xyz)
    x, y, z = np.ascontiguousarray(own.T)
    distance = np.sqrt(x * x + y * y + z * z)  # faster than its norm
    keep = distance >= min_range
    if (count := int(np.count_nonzero(keep))) < MIN_POINTS:
        raise _too_few(count)
    return (cloud, own, distance) if count == len(keep) else (cloud.select(keep), own[keep], distance[keep])


def require_returns(cloud: PointCloud) -> None:
    """Raise TooFewFeaturesError for a cloud of fewer than MIN_POINTS finite points; far cheaper than the range image."""
    usable = int(cloud.finite_mask().sum())
    if usable < MIN_POINTS:
        raise _too_few(usable)


def reflectivity(intensity: NDArray[np.float32] | None) -> NDArray[np.float32] | None:
    """Intensity (n,) in the driver's unit -> 0..1. Units in use: 0..1 (KITTI), 0..255 (most drivers), counts (Ouster). None
    without intensity, or if it is constant (drivers without intensity fill in a constant)."""
    if intensity is None or len(intensity) == 0:
        return None
    values = np.nan_to_num(intensity, nan=0.0, posinf=0.0, neginf=0.0)
    low, high = values.min(), values.max()
    if np.count_nonzero(values > low) <= 0.001 * (len(values) - 1):
        return None
    full_scale = 1.0 if high <= 1.5 else 255.0
    if high > 256:
        full_scale = min(float(quantile(values, 0.999)), BRIGHT * float(quantile(values, 0.9)) or np.inf)
    return np.asarray(np.clip(values / np.float32(full_scale), 0, 1), np.float32)


def isolated_returns(ranges: Ranges) -> Mask:
    """Mask (rows, columns) of returns that show no surface: rain, dust, and beams that hit a near and a far surface at once. A
    pole one column wide is not isolated: it continues above or below."""
    limit = np.maximum(np.float32(JUMP_MIN), np.float32(SAME_SURFACE) * ranges)
    alone = ~_near(ranges, np.roll(ranges, 1, 1), limit) & ~_near(ranges, np.roll(ranges, -1, 1), limit)
    alone &= ~np.isnan(ranges)
    row, column = np.divmod(np.flatnonzero(alone), alone.shape[1])
    if not len(row):
        return alone
    # Few cells are left; their other neighbours are tested one by one.
    rows, columns = ranges.shape
    R, own = ranges[row, column], limit[row, column]
    upright, diagonal = np.zeros((2, len(row)), bool)
    for up in (-1, 1):
        inside = (row + up >= 0) & (row + up < rows)
        beyond = np.clip(row + up, 0, rows - 1)
        upright |= inside & _near(R, ranges[beyond, column], own)
        for aside in (-1, 1):
            diagonal |= inside & _near(R, ranges[beyond, (column + aside) % columns], own)
    for aside in (-2, 2):
        diagonal |= _near(R, ranges[row, (column + aside) % columns], own)
    left, right = ranges[row, (column + 1) % columns], ranges[row, (column - 1) % columns]
    # Inverse ranges: linear on a plane, in small angles.
    middle, step = 0.5 * (1 / left + 1 / right), np.abs(1 / left - 1 / right)
    with np.errstate(invalid="ignore"):
        mixed = ((left - R) * (right - R) < 0) & ~(np.abs(1 / R - middle) < 0.2 * step)
    alone[row, column] = ~upright & (mixed | ~diagonal)
    return alone


def _from_rings(
    cloud: PointCloud, own: Ranges, ring: NDArray[np.int32], seen: tuple[Angles, Angles], distance: Ranges, pose: ScannerPose
) -> RangeImage:
    """own: the points (n, 3) in the scanner's frame, and their angles as seen from there."""
    azimuth, elevation = seen
    row, row_elevation = _rows_from_top(ring, elevation)
    step = azimuth_step(row, azimuth)
    columns = max(min(round(2 * np.pi / step), most_cells(len(row)) // len(row_elevation)), 1)
    step = max(step, 2 * np.pi / (columns + 0.5))  # wider only where there would have been too many columns
    column = columns_of(row, azimuth, columns)
    cell = row * np.intp(columns) + column
    ranges = np.full((len(row_elevation), columns), np.nan, np.float32)
    index = np.full(ranges.shape, -1, np.int32)
    np.fmin.at(ranges.ravel(), cell, distance)
    shown = np.flatnonzero(ranges.take(cell) == distance.astype(np.float32))
    index.ravel()[cell[shown]] = shown
    index[isolated_returns(ranges)] = -1
    left, right = np.roll(ranges, 1, 1), np.roll(ranges, -1, 1)
    with np.errstate(invalid="ignore"):
        hole = np.isnan(ranges) & (np.abs(left - right) < HOLE_JUMP)
    ranges[hole] = 0.5 * (left[hole] + right[hole])
    cones = ring_cones(row, own, len(row_elevation))
    return RangeImage(ranges, index, row_elevation, step, cloud, reflectivity(cloud.intensity), cones, None, pose)


def _rows_from_top(ring: NDArray[np.int32], elevation: NDArray[np.floating]) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Ring numbers (n,) in any order -> row from the top (n,) and the median elevation of each row, rad."""
    order, starts = by_ring(ring)
    medians = np.array([quantile(part, 0.5) for part in np.split(elevation[order], starts)], elevation.dtype)
    from_top = np.argsort(-medians, kind="stable")
    row = np.empty(len(ring), np.int32)
    row[order] = np.repeat(np.argsort(from_top), np.diff([0, *starts, len(ring)]))
    return row, medians[from_top]


@dataclass(frozen=True, eq=False)
class Samples:
    """Points of a scan: azimuth, elevation (n,) rad, distance (n,) m; order, start: the points of each cell, row *
    columns + column, nearest first."""

    azimuth: Angles
    elevation: Angles
    distance: Angles
    order: NDArray[np.intp]
    start: NDArray[np.intp]


def _project(cloud: PointCloud, azimuth: Angles, elevation: Angles, distance: Angles, pose: ScannerPose) -> RangeImage:
    """Range image of a scanner without rings: the nearest return wins a cell, single holes are interpolated."""
    step = cell_size(azimuth, elevation)
    columns = max(round(2 * np.pi / step), 3)
    step = 2 * np.pi / columns
    top = float(elevation.max()) + step / 2
    row = np.floor((top - elevation) / step).astype(np.intp)
    column = np.floor((azimuth + np.pi) / step).astype(np.intp) % columns
    rows = int(row.max()) + 1
    cell = row * columns + column
    order = np.lexsort((distance, cell))  # the nearest first in each cell
    start = np.searchsorted(cell[order], np.arange(rows * columns + 1))
    hit = start[1:] > start[:-1]
    index = np.where(hit, order[start[:-1].clip(max=len(order) - 1)], -1).astype(np.int32).reshape(rows, columns)
    centre = np.asarray(top - (np.arange(rows) + 0.5) * step, np.float64)
    measured = np.where(index >= 0, distance[index], np.nan).astype(np.float32)
    samples = Samples(azimuth, elevation, distance, order, start)
    # Ranges at the centres of cells are extrapolated on the plane through neighbours, on which the inverse range is linear:
    # on a road, points at different heights of one cell lie metres apart, and that is not an edge.
    q = 1 / measured.astype(np.float64)
    up = np.where(index >= 0, elevation[index], np.nan)
    left = np.where(index >= 0, azimuth[index], np.nan)
    off_left = (np.arange(columns) + 0.5)[None] * step - np.pi - left
    q_centre = q + _slope(q, up, 0, step) * (centre[:, None] - up) + _slope(q, left, 1, step) * off_left
    with np.errstate(invalid="ignore"):
        ranges = np.asarray(1 / np.clip(q_centre, 0.5 * q, 2 * q), np.float32)
    index[isolated_returns(ranges)] = -1
    _fill(ranges)
    cones = np.stack([np.zeros(rows), np.tan(centre)], axis=1)
    return RangeImage(ranges, index, centre, step, cloud, reflectivity(cloud.intensity), cones, samples, pose)


def cell_size(azimuth: Angles, elevation: Angles) -> float:
    """Cell width (rad) at which a hit cell holds DIRECTIONS_PER_CELL distinct directions; wider if there were too many cells."""
    height, limit = float(np.ptp(elevation)), most_cells(len(elevation))
    every = -(-len(azimuth) // SIZE_POINTS)
    sector = np.floor((azimuth + np.pi) / SIZE_SECTOR).astype(np.intp)
    hit = np.bincount(sector) > 0
    if every > 1 and hit.sum() >= 2 * every:  # a narrow field has too few sectors to leave some out
        some = np.cumsum(hit)[sector] % every == 0
        azimuth, elevation = azimuth[some], elevation[some]

    def wide_enough(size: float) -> bool:
        if (height / size + 1) * (2 * np.pi / size) > limit:
            return False
        return _cells_hit(azimuth, elevation, size / DISTINCT_PART) >= DIRECTIONS_PER_CELL * _cells_hit(azimuth, elevation, size)

    # Coarse steps first, then the ones between: the count of all sizes would take most of the time of a scan without rings.
    last = len(CELL_SIZES) - 1
    coarse = next((k for k in range(0, last, COARSE_SIZES) if wide_enough(CELL_SIZES[k])), last)
    between = range(max(coarse - COARSE_SIZES + 1, 0), coarse)
    return float(CELL_SIZES[next((k for k in between if wide_enough(CELL_SIZES[k])), coarse)])


def most_cells(points: int) -> int:
    """Limit of cells for so many points: a few broken points must not cost the memory of millions."""
    return min(CELLS_PER_POINT * points + SPARE_CELLS, MAX_CELLS)


def _cells_hit(azimuth: Angles, elevation: Angles, size: float) -> int:
    """Number of cells of this width that hold points."""
    columns = int(2 * np.pi / size) + 2
    row, column = ((elevation + np.pi / 2) / size).astype(np.int64), ((azimuth + np.pi) / size).astype(np.int64)
    cells = np.sort((row * columns + column).astype(np.uint32))  # np.unique hashes, which takes fifty times as long
    return int(np.count_nonzero(cells[1:] != cells[:-1])) + 1


def _slope(q: NDArray[np.float64], angle: NDArray[np.float64], axis: int, step: float) -> NDArray[np.float64]:
    """Slope of q per rad along an axis: the smaller of both sides, 0 where their signs differ or one is missing."""
    sides = []
    for direction in (1, -1):
        slope = np.full(q.shape, np.nan)
        for k in (2, 1):  # across one empty cell if need be
            gap = np.roll(angle, direction * k, axis) - angle
            gap = np.where(np.abs(gap) > np.pi, np.nan, gap)
            if axis == 0:
                edge = slice(0, k) if direction > 0 else slice(-k, None)
                gap[edge] = np.nan
            with np.errstate(invalid="ignore"):
                value = (np.roll(q, direction * k, axis) - q) / np.where(np.abs(gap) > 0.3 * step, gap, np.nan)
            slope = np.where(np.isnan(value), slope, value)
        sides.append(slope)
    a, b = sides
    with np.errstate(invalid="ignore"):
        both = np.where(np.abs(a) < np.abs(b), a, b)
        return np.where(a * b > 0, both, 0.0)


def _fill(ranges: Ranges) -> None:
    """Interpolate empty cells whose neighbours left and right, or above and below, lie on one surface."""
    with np.errstate(invalid="ignore"):
        for axis in (1, 0):
            before, after = np.roll(ranges, 1, axis), np.roll(ranges, -1, axis)
            if axis == 0:
                before[0], after[-1] = np.nan, np.nan
            hole = np.isnan(ranges) & (np.abs(before - after) < SAME_SURFACE * 0.5 * (before + after))
            ranges[hole] = 2 / (1 / before[hole] + 1 / after[hole])


def _near(a: Ranges, b: Ranges, limit: Ranges) -> Mask:
    with np.errstate(invalid="ignore"):
        return np.asarray(np.abs(a - b) < limit)


def _too_few(usable: int) -> TooFewFeaturesError:
    return TooFewFeaturesError(f"the cloud has {usable} usable points; check that the LiDAR is not covered")
