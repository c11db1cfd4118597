"""Which laser measured a point, for sources that do not say it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import find_peaks

from calib_ros.frame import PointCloud

MIN_RINGS, MAX_RINGS = 4, 256
RING_SPREAD = 0.3  # of the whole scan's spread of elevation: rings keep theirs better, even tilted by motion compensation (0.16)
UNIFORM_ROWS = 64  # rows for a scanner without rings
Angles = NDArray[np.floating]


def ring_of_points(cloud: PointCloud, azimuth: Angles, elevation: Angles) -> NDArray[np.int32]:
    """Ring number of each point (n,) int32: the source's own, else from the order of the points (ring after ring, as KITTI
    stores them), else from the elevation. azimuth, elevation: (n,) rad."""
    if cloud.ring is not None and 2 <= len(np.unique(cloud.ring)) <= MAX_RINGS:
        return cloud.ring
    by_order = rings_by_order(azimuth, elevation)
    return rings_by_elevation(elevation) if by_order is None else by_order


def rings_by_order(azimuth: Angles, elevation: Angles) -> NDArray[np.int32] | None:
    """Rings as runs of steadily turning azimuth; None if the points are not stored so.

    A revolution may start at any azimuth and turn either way: the starts tried are forward, backward and the first point's;
    the one whose runs keep their elevation best is taken.
    """
    turn = np.angle(np.exp(1j * np.diff(azimuth)))
    sign = 1.0 if np.count_nonzero(turn > 0) >= np.count_nonzero(turn < 0) else -1.0
    limit = RING_SPREAD * float(np.abs(elevation - np.mean(elevation)).mean())
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


def rings_by_elevation(elevation: Angles) -> NDArray[np.int32]:
    """Rings as peaks of the elevation's histogram (n,) int32; rows of equal height where it has no clear peaks."""
    low, high = np.quantile(elevation, [0.0005, 0.9995])
    bins = np.arange(low - 0.01, high + 0.01, np.deg2rad(0.05))
    if len(bins) >= MIN_RINGS:
        count, edges = np.histogram(elevation, bins)
        smooth = np.convolve(count, [0.25, 0.5, 0.25], "same")
        peaks, _ = find_peaks(np.concatenate([[0], smooth, [0]]), prominence=max(0.05 * smooth.max(), 3.0))
        centres = 0.5 * (edges[:-1] + edges[1:])[peaks - 1]
        if MIN_RINGS <= len(centres) <= MAX_RINGS:
            nearest = np.searchsorted(0.5 * (centres[:-1] + centres[1:]), elevation)
            if np.mean(np.abs(elevation - centres[nearest]) < 0.25 * np.median(np.diff(centres))) > 0.8:
                return nearest.astype(np.int32)
    height = max((high - low) / UNIFORM_ROWS, 1e-6)
    return np.asarray(np.clip((elevation - low) / height, 0, UNIFORM_ROWS - 1), np.int32)
