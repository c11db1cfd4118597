"""The rings of a spinning scanner: which ring measured a point, and where the rays of a ring run.

Drivers differ in what they say about rings, so each property is estimated from the points where the source does not give it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib_ros.frame import PointCloud
from calib_ros.lidar.scanner_pose import CLOUD_FRAME, ScannerPose, fitted_pose, pose_by_neighbours, ring_fit, stays

Angles = NDArray[np.floating]
MIN_RINGS, MAX_RINGS = 4, 256
# Spread of elevation within rings, as a share of the whole scan's: of rings by order (0.16 where motion compensation tilts them),
# and of the source's, whose cloud may be in the frame of a vehicle that is tilted against the scanner.
MAX_RUN_SPREAD, MAX_RING_SPREAD = 0.3, 0.6
MAX_BACKWARD_SHARE = 0.25  # of azimuth steps against the turn in rings stored in order: KITTI 0.02, lines scanned to and fro 0.5
EVEN_ROWS = 64  # rows of a scanner without rings, where rows are needed
HISTOGRAM_BIN = float(np.deg2rad(0.05))  # rad; of the elevation histogram
HISTOGRAM_POINTS = 20_000  # points enough to find the apex height
APEX_HEIGHTS = np.arange(-30, 31) / 100  # m; tried heights of the apex of the rays, the origin in the middle
MIN_SHARPENING = 1.1  # a histogram must be this much sharper than that of the origin to move the apex
LARGE_STEPS = 0.99  # quantile of the elevation steps among which ends of rings are sought
CUT_BIN = float(np.deg2rad(0.5))  # rad; of the histogram of azimuths at which rings may end
STEP_POINTS = 30_000  # points enough to find the azimuth step
PHASE_POINTS = 40_000  # that tell at which azimuths rings fire: hundreds of each
MAX_COLUMNS = 16384
GAP_BINS = 25.0  # bins per unit of the logarithm of an azimuth gap: each 4 % wide
DEFAULT_STEP = float(np.deg2rad(0.2))  # rad; if no ring has two points
# Spread of rings in the scanner's own frame, rad, and as a share of their spacing: HDL-32E 0.12 deg, 0.09; de-skewed HDL-64E 0.10
# deg, 0.24; others below. Clouds of roof scanners in the frame of the vehicle: from 0.15 deg and 0.4 upwards.
MAX_BEAM_SPREAD, MAX_OWN_SPREAD = float(np.deg2rad(0.15)), 0.35
FEWEST_POINTS = 1000  # from which a pose is sought
SETTLING_ROUNDS = 3
# As RINGS_APART: of rings that the driver numbers (0.05), and of runs by order, which may mix two. Scan lines: 0.3 to 0.4.
FIELD_APART, RUNS_APART = 0.2, 0.5
MUCH_SHARPER = 0.5  # share to which another pose of the scanner must lower the spread of the rings


def scan_rings(cloud: PointCloud, given: ScannerPose | None = None) -> tuple[NDArray[np.int32] | None, ScannerPose]:
    """Ring number of each point, (n,) int32, or None if the scan has no rings; and the pose of the scanner in the cloud's frame.

    That is the cloud's frame itself, unless `given`, or unless another pose makes the rings cones. It may be known without the
    rings.
    """
    xyz = cloud.xyz
    if given is not None:
        own = given.to_scanner(xyz)
        return find_rings(cloud, *angles(own), own), given
    ring = find_rings(cloud, *angles(xyz))
    if len(xyz) < FEWEST_POINTS:
        return ring, CLOUD_FRAME
    known = None if ring is None else ring_fit(xyz, ring)
    if ring is not None and known is not None:
        in_own_frame = known.spread <= min(MAX_BEAM_SPREAD, MAX_OWN_SPREAD * known.spacing)
        if in_own_frame or stays(xyz, ring, MUCH_SHARPER * known.spread):
            return ring, CLOUD_FRAME
    for candidate, apart in ((_ring_field(cloud), FIELD_APART), (rings_by_order(*angles(xyz), posed=False), RUNS_APART)):
        if candidate is not None:
            fit = fitted_pose(xyz, candidate)
            sharper = fit.spread < MUCH_SHARPER * ring_fit(xyz, candidate).spread
            settled = _settled(cloud, fit.pose) if sharper and fit.spread < apart * fit.spacing else None
            if settled is not None:
                return settled
    if known is None or not known.apart:
        rough = pose_by_neighbours(xyz)
        if rough is not None:
            return _settled(replace(cloud, ring=None), rough) or (None, rough)  # its ring numbers are none
    return ring, CLOUD_FRAME


def _settled(cloud: PointCloud, pose: ScannerPose) -> tuple[NDArray[np.int32], ScannerPose] | None:
    """Rings and pose that agree with each other, from a rough pose; None if there are none."""
    count, runs = 0, None
    # Rings by order or elevation, found at a rough pose, are in part mixed up: their fit is better than it, and so in turn.
    for _ in range(SETTLING_ROUNDS):
        own = pose.to_scanner(cloud.xyz)
        azimuth, elevation = angles(own)
        ring = _ring_field(cloud)
        if ring is not None and keeps_elevation(ring, elevation):
            return ring, pose
        runs = rings_by_order(azimuth, elevation, posed=False)
        fit = None if runs is None else fitted_pose(cloud.xyz, runs, pose)
        if runs is None or fit is None or not fit.apart:
            runs = rings_by_elevation(own, elevation)
            fit = None if runs is None else fitted_pose(cloud.xyz, runs, pose)
        if runs is None or fit is None or not fit.apart:
            return None
        pose, before, count = fit.pose, count, int(runs.max()) + 1
        if count == before:
            break
    return None if runs is None else (runs, pose)


def angles(xyz: NDArray[np.floating]) -> tuple[Angles, Angles]:
    """Azimuth and elevation (n,) in rad of points (n, 3) in the scanner's frame."""
    x, y, z = xyz.T
    return np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))


def find_rings(
    cloud: PointCloud, azimuth: Angles, elevation: Angles, xyz: NDArray[np.floating] | None = None
) -> NDArray[np.int32] | None:
    """Ring number of each point, (n,) int32, or None if the scan has no rings: by the driver's ring field, the order of the
    points, or peaks of the elevation histogram.

    azimuth, elevation: (n,) rad, and xyz: (n, 3) m, in the scanner's frame; by default that is the cloud's.
    """
    ring = _ring_field(cloud)
    # Drivers of scanners without rings fill the field with laser or scan line numbers, each of which sweeps the whole view.
    if ring is not None and keeps_elevation(ring, elevation):
        return ring
    by_order = rings_by_order(azimuth, elevation)
    if by_order is not None:
        return by_order
    return rings_by_elevation(cloud.xyz if xyz is None else xyz, elevation)


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


def rings_by_order(azimuth: Angles, elevation: Angles, posed: bool = True) -> NDArray[np.int32] | None:
    """Rings as runs of monotonic azimuth, (n,) int32; None if the points are not stored ring after ring. Of the starts tried, the
    one whose runs spread least in elevation wins. posed: False = as seen from a wrong pose."""
    turn = np.diff(azimuth)
    turn -= (2 * np.pi * np.rint(turn / (2 * np.pi))).astype(turn.dtype)
    sign = 1.0 if np.count_nonzero(turn > 0) >= np.count_nonzero(turn < 0) else -1.0
    if np.count_nonzero(sign * turn < 0) > MAX_BACKWARD_SHARE * len(turn):
        return None
    starts = [0.0, np.pi, float(azimuth[0]) - sign * 1e-3]
    every, best = max(len(azimuth) // HISTOGRAM_POINTS, 1) | 1, None
    if posed:
        least = MAX_RUN_SPREAD * _mean_deviation(elevation)
    else:
        step, least = np.abs(np.diff(elevation)), np.inf
        starts.append(_cut(azimuth, step, sign * float(np.median(np.abs(turn)))))
    for start in starts:
        angle = np.mod(sign * (azimuth - start), 2 * np.pi)
        span = float(np.ptp(angle))
        ring = np.concatenate([[0], np.cumsum(np.diff(angle) < -0.5 * span)]).astype(np.int32)
        if not (MIN_RINGS <= int(ring[-1]) + 1 <= MAX_RINGS and span >= 0.1):
            continue
        # From a wrong pose the spread does not tell, since a start half a turn aside mixes evenly; but runs end where the
        # elevation jumps to another ring's.
        cost = _ring_spread(ring[::every], elevation[::every]) if posed else -float(np.median(step[np.diff(ring) > 0]))
        if cost < least:
            least, best = cost, ring
    return best


def _cut(azimuth: Angles, step: Angles, turn: float) -> float:
    """The azimuth at which many of the largest steps (n - 1,) of the elevation are, rad. turn: usual step of the azimuth."""
    after = azimuth[1:][step >= np.quantile(step, LARGE_STEPS)]
    cell = ((after + np.pi) / CUT_BIN).astype(np.intp)
    count = np.bincount(cell, minlength=round(2 * np.pi / CUT_BIN) + 1)
    best = int(np.argmax(count + np.roll(count, 1)))
    near = after[(cell == best) | (cell == (best - 1) % len(count))]
    near = np.where(near > best * CUT_BIN, near - 2 * np.pi, near)  # both sides of half a turn, if the cell is the first
    return float(np.median(near) - 0.5 * turn)


def _ring_field(cloud: PointCloud) -> NDArray[np.int32] | None:
    """The driver's ring field, if it may number rings."""
    return cloud.ring if cloud.ring is not None and 2 <= len(np.unique(cloud.ring)) <= MAX_RINGS else None


def rings_by_elevation(xyz: NDArray[np.floating], elevation: Angles) -> NDArray[np.int32] | None:
    """Rings as peaks of the elevation histogram, from the apex height where it is sharpest, (n,) int32; None if it has no clear
    peaks. xyz: (n, 3) m."""
    sample = xyz[:: max(len(xyz) // HISTOGRAM_POINTS, 1)].astype(np.float64)
    distance, height = np.hypot(sample[:, 0], sample[:, 1]), sample[:, 2]
    sharp = []
    for z in APEX_HEIGHTS:
        count = np.bincount(((np.arctan2(height - z, distance) + np.pi / 2) / HISTOGRAM_BIN).astype(np.intp))
        smooth = np.convolve(count, [0.25, 0.5, 0.25])  # a ring on the border of two bins is as sharp as one within a bin
        sharp.append(float((smooth**2).sum()))
    best = int(np.argmax(sharp))
    if sharp[best] < MIN_SHARPENING * sharp[len(APEX_HEIGHTS) // 2]:
        return _histogram_peaks(elevation)
    return _histogram_peaks(np.arctan2(xyz[:, 2] - APEX_HEIGHTS[best], np.hypot(xyz[:, 0], xyz[:, 1])))


def azimuth_step(row: NDArray[np.int32], azimuth: NDArray[np.floating]) -> float:
    """Most frequent azimuth difference of neighbours in a ring, rad. row: (n,) ring of each point, azimuth: (n,) rad."""
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
    """Column of each point, (n,), such that the firings of its ring fall on cell centres."""
    # On cell borders they would by rounding share one cell and leave the next empty, across which no edge is seen.
    turn = azimuth.astype(np.float64) * columns
    every = max(len(row) // PHASE_POINTS, 1) | 1  # odd: a power of two would take the same lasers of every firing
    some, rows = row[::every], int(row.max(initial=0)) + 1
    rings = np.bincount(some, np.cos(turn[::every]), rows) + 1j * np.bincount(some, np.sin(turn[::every]), rows)
    # Relative to the mean phase of all rings, so that rings which fire together stay in the same columns.
    common = np.angle(rings.sum())
    phase = common + np.angle(rings * np.exp(-1j * common))
    return np.asarray(np.rint((turn - phase[row]) / (2 * np.pi) + columns // 2).astype(np.intp) % columns)


def _mean_deviation(elevation: Angles) -> float:
    return float(np.abs(elevation - np.mean(elevation)).mean())


def _ring_spread(ring: NDArray[np.int32], elevation: Angles) -> float:
    """Mean absolute deviation of the elevation in the ring of the median point, rad."""
    count = np.bincount(ring)
    mean = np.bincount(ring, elevation) / np.maximum(count, 1)
    deviation = np.bincount(ring, np.abs(elevation - mean[ring])) / np.maximum(count, 1)
    return float(np.median(np.repeat(deviation, count)))


def _histogram_peaks(elevation: Angles) -> NDArray[np.int32] | None:
    from scipy.signal import find_peaks  # takes half a second to import, and clouds with rings need none

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
