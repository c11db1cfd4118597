"""Which laser measured a point, for sources that do not say it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import find_peaks

from calib_ros.frame import PointCloud

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
