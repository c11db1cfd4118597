"""The rings of a spinning scanner: which ring measured a point, and where the rays of a ring run.

Drivers differ in what they say about rings, so each property is estimated from the points where the source does not give it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib_ros.arrays import quantile
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
MAX_NUMBERS = 2**16  # up to which ring numbers are counted, not sorted
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


def scan_rings(cloud: PointCloud, seen: tuple[Angles, Angles]) -> tuple[NDArray[np.int32] | None, ScannerPose]:
    """Ring number of each point, (n,) int32, or None if the scan has no rings; and the pose of the scanner in the cloud's frame.

    That is the cloud's frame itself, unless another pose makes the rings cones. It may be known without the rings. seen: `angles`
    of the points, in the cloud's frame.
    """
    xyz, ring = cloud.xyz, find_rings(cloud, *seen)
    if len(xyz) < FEWEST_POINTS:
        return ring, CLOUD_FRAME
    known = None if ring is None else ring_fit(xyz, ring)
    if ring is not None and known is not None:
        in_own_frame = known.spread <= min(MAX_BEAM_SPREAD, MAX_OWN_SPREAD * known.spacing)
        if in_own_frame or stays(xyz, ring, MUCH_SHARPER * known.spread):
            return ring, CLOUD_FRAME
    for candidate, apart in ((_ring_field(cloud), FIELD_APART), (rings_by_order(*seen, posed=False), RUNS_APART)):
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
        ring = _ring_field(cloud, elevation)
        if ring is not None:
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
    x, y, z = np.ascontiguousarray(xyz.T)
    return np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))


def find_rings(
    cloud: PointCloud, azimuth: Angles, elevation: Angles, xyz: NDArray[np.floating] | None = None
) -> NDArray[np.int32] | None:
    """Ring number of each point, (n,) int32, or None if the scan has no rings: by the driver's ring field, the order of the
    points, or peaks of the elevation histogram.

    azimuth, elevation: (n,) rad, and xyz: (n, 3) m, in the scanner's frame; by default that is the cloud's.
    """
    # Drivers of scanners without rings fill the field with laser or scan line numbers, each of which sweeps the whole view.
    ring = _ring_field(cloud, elevation)
    if ring is None:
        ring = rings_by_order(azimuth, elevation)
    return rings_by_elevation(cloud.xyz if xyz is None else xyz, elevation) if ring is None else ring


def ring_of_points(cloud: PointCloud, azimuth: Angles, elevation: Angles) -> NDArray[np.int32]:
    """Ring number of each point, (n,) int32, as of `find_rings`; rows of equal height for a scanner without rings."""
    ring = find_rings(cloud, azimuth, elevation)
    return even_rows(elevation) if ring is None else ring


def even_rows(elevation: Angles) -> NDArray[np.int32]:
    """Rows of equal height, (n,) int32, for a scanner without rings."""
    low, high = np.quantile(elevation, [0.0005, 0.9995])
    height = max((high - low) / EVEN_ROWS, 1e-6)
    return np.asarray(np.clip((elevation - low) / height, 0, EVEN_ROWS - 1), np.int32)


def rings_by_order(azimuth: Angles, elevation: Angles, posed: bool = True) -> NDArray[np.int32] | None:
    """Rings as runs of monotonic azimuth, (n,) int32; None if the points are not stored ring after ring. Of the starts tried, the
    one whose runs spread least in elevation wins. posed: False = as seen from a wrong pose."""
    turn, whole = np.diff(azimuth), azimuth.dtype.type(2 * np.pi)
    turn -= (2 * np.pi * np.rint(turn / (2 * np.pi))).astype(turn.dtype)
    forward, backward = np.count_nonzero(turn > 0), np.count_nonzero(turn < 0)
    sign = 1.0 if forward >= backward else -1.0
    if min(forward, backward) > MAX_BACKWARD_SHARE * len(turn):
        return None
    starts = [0.0, np.pi, float(azimuth[0]) - sign * 1e-3]
    every, best = max(len(azimuth) // HISTOGRAM_POINTS, 1) | 1, None
    if posed:
        least = MAX_RUN_SPREAD * float(np.abs(elevation - elevation.mean()).mean())
    else:
        step, least = np.abs(np.diff(elevation)), np.inf
        starts.append(_cut(azimuth, step, sign * float(np.median(np.abs(turn)))))
    for start in starts:
        angle = sign * (azimuth - start)
        angle -= whole * (angle >= whole)  # within 0..2 pi, to the same bits as by np.mod, which takes five times as long
        while angle.min() < 0:
            angle += whole * (angle < 0)
        span = float(np.ptp(angle))
        ring = np.cumsum(np.diff(angle, prepend=angle[:1]) < -0.5 * span, dtype=np.int32)
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


def _ring_field(cloud: PointCloud, elevation: Angles | None = None) -> NDArray[np.int32] | None:
    """The driver's ring field, if it may number rings, and if most of them have a nearly constant elevation (n,), where given,
    compared with the whole scan."""
    ring = cloud.ring
    if ring is None:
        return None
    low, high = int(ring.min()), int(ring.max())
    place = ring - low if high - low < MAX_NUMBERS else np.unique(ring, return_inverse=True)[1].astype(np.int32)
    if not 2 <= np.count_nonzero(np.bincount(place)) <= MAX_RINGS:
        return None
    if elevation is None:
        return ring
    every, whole = max(len(ring) // HISTOGRAM_POINTS, 1) | 1, float(np.abs(elevation - elevation.mean()).mean())
    return ring if _ring_spread(place[::every], elevation[::every]) <= MAX_RING_SPREAD * whole else None


def by_ring(ring: NDArray[np.int32]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Order of the points (n,) ring after ring, as stored within each; and where in it the second and further rings begin."""
    short = ring.astype(np.int16) if ring.min() >= -(2**15) and ring.max() < 2**15 else ring  # 16 bits sort in linear time
    order = np.argsort(short, kind="stable")
    return order, np.flatnonzero(np.diff(ring.take(order))) + 1


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
    if some.any():
        row, azimuth = row[some], azimuth[some]
    order, starts = by_ring(row)
    gap = np.concatenate([np.diff(np.sort(part)) for part in np.split(azimuth[order], starts)])
    gap = gap[gap > 2 * np.pi / MAX_COLUMNS]
    if not len(gap):
        return DEFAULT_STEP
    level = np.rint(np.log(gap / gap.min()) * GAP_BINS).astype(np.intp)
    count = np.convolve(np.bincount(level), [1, 1, 1], "same")
    return float(quantile(gap[np.abs(level - count.argmax()) <= 4], 0.5))


def columns_of(row: NDArray[np.int32], azimuth: NDArray[np.floating], columns: int) -> NDArray[np.intp]:
    """Column of each point, (n,), such that the firings of its ring fall on cell centres."""
    # On cell borders they would by rounding share one cell and leave the next empty, across which no edge is seen.
    place = azimuth.astype(np.float64) * (columns / (2 * np.pi))
    every = max(len(row) // PHASE_POINTS, 1) | 1  # odd: a power of two would take the same lasers of every firing
    some, rows = row[::every].astype(np.intp), int(row.max(initial=0)) + 1
    angle = (2 * np.pi * (place[::every] - np.rint(place[::every]))).astype(np.float32)
    rings = np.bincount(some, np.cos(angle), rows) + 1j * np.bincount(some, np.sin(angle), rows)
    # Relative to the mean phase of all rings, so that rings which fire together stay in the same columns.
    common = np.angle(rings.sum())
    phase = common + np.angle(rings * np.exp(-1j * common))
    place += columns // 2 - (phase / (2 * np.pi)).take(row)
    return np.asarray(np.rint(place, out=place).astype(np.intp) % columns)


def _ring_spread(ring: NDArray[np.int32], elevation: Angles) -> float:
    """Mean absolute deviation of the elevation in the ring of the median point, rad."""
    count = np.bincount(ring)
    mean = np.bincount(ring, elevation) / np.maximum(count, 1)
    deviation = np.bincount(ring, np.abs(elevation - mean.take(ring))) / np.maximum(count, 1)
    order = np.argsort(deviation)
    middle = np.searchsorted(np.cumsum(count[order]), [(len(ring) - 1) // 2, len(ring) // 2], "right")
    return float(deviation[order[middle]].mean())


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
