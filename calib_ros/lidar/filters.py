"""Depth and threshold filters of a point cloud (thesis 3.3, eq. 3.8, 3.3.1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float32]
Mask = NDArray[np.bool_]


def depth(xyz: Points) -> NDArray[np.float32]:
    """Horizontal distance from the LiDAR's axis, eq. 3.8; (n, 3) m -> (n,) m."""
    return np.hypot(xyz[:, 0], xyz[:, 1])


def by_range(xyz: Points, low: float, high: float) -> Mask:
    """Points whose depth (eq. 3.8, m) lies in low..high; (n,) bool."""
    d = depth(xyz)
    return np.asarray((d >= low) & (d <= high))


def by_height(xyz: Points, low: float, high: float) -> Mask:
    """Points whose height above the LiDAR (its z, m) lies in low..high; (n,) bool."""
    return np.asarray((xyz[:, 2] >= low) & (xyz[:, 2] <= high))


def by_reflectivity(reflectivity: NDArray[np.float32], low: float, high: float = 1.0) -> Mask:
    """Points whose reflectivity (n,) lies in low..high; keeps signs and lane markings, or what is not one; (n,) bool."""
    return np.asarray((reflectivity >= low) & (reflectivity <= high))


def by_angle(xyz: Points, center_deg: float, half_width_deg: float) -> Mask:
    """Points whose azimuth lies within half_width_deg of center_deg (0 = the LiDAR's +x, counter-clockwise); (n,) bool.

    A camera sees only part of the turn; the window may run across 180 deg.
    """
    if half_width_deg >= 180:
        return np.ones(len(xyz), bool)
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    away = np.abs(np.angle(np.exp(1j * (azimuth - np.deg2rad(center_deg)))))
    return np.asarray(away <= np.deg2rad(half_width_deg))
