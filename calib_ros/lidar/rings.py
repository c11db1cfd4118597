"""The rings of a spinning scanner: which ring measured a point, and where the rays of a ring run.

Drivers differ in what they say about rings, so each property is estimated from the points where the source does not give it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import find_peaks

from calib_ros.frame import PointCloud

Angles = NDArray[np.floating]
MIN_RINGS, MAX_RINGS = 4, 256
# Spread of elevation within rings, as a share of that of the whole scan. Rings found by order: real ones keep theirs well below,
# even tilted by motion compensation (0.16). Rings of the source: higher, since the cloud may be given in the frame of a vehicle
# that is tilted against the scanner.
MAX_RUN_SPREAD, MAX_RING_SPREAD = 0.3, 0.6
MAX_BACKWARD_SHARE = 0.25  # of azimuth steps against the turn in rings stored in order: KITTI 0.02, lines scanned to and fro 0.5
EVEN_ROWS = 64  # rows of a scanner without rings, where rows are needed
HISTOGRAM_BIN = float(np.deg2rad(0.05))  # rad; of the elevation histogram
HISTOGRAM_POINTS = 20_000  # points enough to find the apex height
APEX_HEIGHTS = np.arange(-30, 31) / 100  # m; tried heights of the apex of the rays, the origin in the middle
MIN_SHARPENING = 1.1  # a histogram must be this much sharper than that of the origin to move the apex
STEP_POINTS = 30_000  # points enough to find the azimuth step
MAX_COLUMNS = 16384
GAP_BINS = 25.0  # bins per unit of the logarithm of an azimuth gap: each 4 % wide
DEFAULT_STEP = float(np.deg2rad(0.2))  # rad; if no ring has two points
APEX_SIGMA, HEIGHT_SIGMA = 0.15, 0.02  # m; spread of apex heights about the origin, and of points about their cone


def find_rings(cloud: PointCloud, azimuth: Angles, elevation: Angles) -> NDArray[np.int32] | None:
    """Ring number of each point, (n,) int32, or None if the scan has no rings. azimuth, elevation: (n,) rad.

    Taken from the driver's ring field, else from the order of the points (ring after ring, as KITTI stores them), else from
    peaks of the elevation histogram.
    """
    ring = cloud.ring
    # Drivers of scanners without rings fill the field with laser or scan line numbers, each of which sweeps the whole view.
    if ring is not None and 2 <= len(np.unique(ring)) <= MAX_RINGS and keeps_elevation(ring, elevation):
        return ring
    by_order = rings_by_order(azimuth, elevation)
    return rings_by_elevation(cloud.xyz, elevation) if by_order is None else by_order


def ring_of_points(cloud: PointCloud, azimuth: Angles, elevation: Angles) -> NDArray[np.int32]:
    """Ring number of each point, (n,) int32, as of `find_rings`; rows of equal height for a scanner without rings."""
    ring = find_rings(cloud, azimuth, elevation)
    return even_rows(elevation) if ring is None else ring


def even_rows(elevation: Angles) -> NDArray[np.int32]:
    """Rows of equal height, (n,) int32, for a scanner without rings."""
    low, high = np.quantile(elevation, [0.0005, 0.9995])
    height = max((high - low) / EVEN_ROWS, 1e-6)
    return np.asarray(np.clip((elevation - low) / height, 0, EVEN_ROWS - 1), np.int32)


def keeps_elevation(ring: NDArray[np.int32], elevation: Angles) -> bool:
    """Whether most rings have a nearly constant elevation, compared with the whole scan."""
    compact = np.unique(ring, return_inverse=True)[1].astype(np.int32)
    return _ring_spread(compact, elevation) <= MAX_RING_SPREAD * _mean_deviation(elevation)


def rings_by_order(azimuth: Angles, elevation: Angles) -> NDArray[np.int32] | None:
    """Rings as runs of monotonic azimuth, (n,) int32; None if the points are not stored ring after ring.

    A revolution may start at any azimuth and turn either way. The starts tried are forward, backward and the first point; the
    one whose runs spread least in elevation wins.
    """
    turn = np.angle(np.exp(1j * np.diff(azimuth)))
    sign = 1.0 if np.count_nonzero(turn > 0) >= np.count_nonzero(turn < 0) else -1.0
    if np.count_nonzero(sign * turn < 0) > MAX_BACKWARD_SHARE * len(turn):
        return None
    limit = MAX_RUN_SPREAD * _mean_deviation(elevation)
    best: tuple[float, NDArray[np.int32]] | None = None
    for start in (0.0, np.pi, float(azimuth[0]) - sign * 1e-3):
        angle = np.mod(sign * (azimuth - start), 2 * np.pi)
        span = float(np.ptp(angle))
        ring = np.concatenate([[0], np.cumsum(np.diff(angle) < -0.5 * span)]).astype(np.int32)
        count = int(ring[-1]) + 1
        if not MIN_RINGS <= count <= MAX_RINGS or span < 0.1:
            continue
        spread = _ring_spread(ring, elevation)
        if spread < limit and (best is None or spread < best[0]):
            best = (spread, ring)
    return None if best is None else best[1]


def rings_by_elevation(xyz: NDArray[np.float32], elevation: Angles) -> NDArray[np.int32] | None:
    """Rings as peaks of the elevation histogram, (n,) int32; None if it has no clear peaks. xyz: (n, 3) m.

    Rays need not meet in the origin of the cloud: of several apex heights, that with the sharpest histogram is used.
    """
    sample = xyz[:: max(len(xyz) // HISTOGRAM_POINTS, 1)].astype(np.float64)
    distance, height = np.hypot(sample[:, 0], sample[:, 1]), sample[:, 2]
    sharp = [_histogram_sharpness(np.arctan2(height - z, distance)) for z in APEX_HEIGHTS]
    best = int(np.argmax(sharp))
    if sharp[best] < MIN_SHARPENING * sharp[len(APEX_HEIGHTS) // 2]:
        return _histogram_peaks(elevation)
    return _histogram_peaks(np.arctan2(xyz[:, 2] - APEX_HEIGHTS[best], np.hypot(xyz[:, 0], xyz[:, 1])))


def azimuth_step(row: NDArray[np.int32], azimuth: NDArray[np.floating]) -> float:
    """Most frequent azimuth difference of neighbours in a ring, rad. row: (n,) ring of each point, azimuth: (n,) rad.

    Lost returns leave multiples of the step, and second returns of one firing differences of all sizes near 0; neither is as
    frequent.
    """
    every = max(len(row) // STEP_POINTS, 1)
    some = row % every == 0
    if not some.any():
        some = np.ones(len(row), bool)
    row, azimuth = row[some], azimuth[some]
    order = np.lexsort((azimuth, row))
    gap = np.diff(azimuth[order])
    gap = gap[(np.diff(row[order]) == 0) & (gap > 2 * np.pi / MAX_COLUMNS)]
    if not len(gap):
        return DEFAULT_STEP
    level = np.rint(np.log(gap / gap.min()) * GAP_BINS).astype(np.intp)
    count = np.convolve(np.bincount(level), [1, 1, 1], "same")
    usual = gap[np.abs(level - count.argmax()) <= 4]
    return float(np.median(usual))


def columns_of(row: NDArray[np.int32], azimuth: NDArray[np.floating], columns: int) -> NDArray[np.intp]:
    """Column of each point, (n,), such that the firings of its ring fall on cell centres.

    Firings on cell borders (simulators start at exactly -180 deg) would by rounding share one cell and leave the next empty,
    and a range jump across an empty cell is not detected as an edge.
    """
    turn = azimuth.astype(np.float64) * columns
    rings = np.bincount(row, np.cos(turn)) + 1j * np.bincount(row, np.sin(turn))
    # Relative to the mean phase of all rings, so that rings which fire together stay in the same columns.
    common = np.angle(rings.sum())
    phase = common + np.angle(rings * np.exp(-1j * common))
    return np.asarray(np.rint((turn - phase[row]) / (2 * np.pi) + columns // 2).astype(np.intp) % columns)


def ring_cones(row: NDArray[np.int32], xyz: NDArray[np.float32], rows: int) -> NDArray[np.float64]:
    """Cone z = offset + slope * distance from the axis, fitted to the points (n, 3) of each row -> (rows, 2), offset m and slope.

    The rays of a ring run on a cone about the sensor's axis whose apex need not be the origin of the cloud: the lasers of an
    HDL-64E sit 0.12 m to 0.21 m above it. Near points of a ring then have another elevation than far ones, and the next ring
    is not where the elevations would put it.
    """
    z = xyz[:, 2].astype(np.float64)
    rho = np.hypot(xyz[:, 0], xyz[:, 1]).astype(np.float64)
    weight = 1 / np.maximum(rho, 0.1)  # errors of tilted rays grow with the distance
    count, s_r, s_rr = (
        np.bincount(row, weight, rows),
        np.bincount(row, weight * rho, rows),
        np.bincount(row, weight * rho * rho, rows),
    )
    s_z, s_rz = np.bincount(row, weight * z, rows), np.bincount(row, weight * rho * z, rows)
    n = np.asarray(count + (HEIGHT_SIGMA / APEX_SIGMA) ** 2)  # a ring at a single distance: apex at the origin
    determinant = np.maximum(n * s_rr - s_r**2, 1e-12)
    return np.stack([(s_z * s_rr - s_r * s_rz) / determinant, (n * s_rz - s_r * s_z) / determinant], axis=1)


def _mean_deviation(elevation: Angles) -> float:
    return float(np.abs(elevation - np.mean(elevation)).mean())


def _ring_spread(ring: NDArray[np.int32], elevation: Angles) -> float:
    """Median over the rings of the mean absolute deviation of the elevation, rad."""
    count = np.bincount(ring)
    mean = np.bincount(ring, elevation) / np.maximum(count, 1)
    return float(np.median((np.bincount(ring, np.abs(elevation - mean[ring])) / np.maximum(count, 1))[count > 0]))


def _histogram_sharpness(elevation: Angles) -> float:
    count = np.histogram(elevation, np.arange(-np.pi / 2, np.pi / 2, HISTOGRAM_BIN))[0]
    return float((count.astype(np.float64) ** 2).sum())


def _histogram_peaks(elevation: Angles) -> NDArray[np.int32] | None:
    low, high = np.quantile(elevation, [0.0005, 0.9995])
    bins = np.arange(low - 0.01, high + 0.01, HISTOGRAM_BIN)
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
