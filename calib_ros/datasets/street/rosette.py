"""Where a scanner looks that has no rings: two prisms turn against each other, and the beam draws a rosette.

The petals never repeat: over time they fill the whole field of view (Livox: Avia, Horizon).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_ros.datasets.street.rays import Jobs
from calib_ros.datasets.street.solids import Float32, Floats, Solids
from calib_ros.datasets.street.views import nearest_first

POINTS = 24_000  # per scan
FIELD = float(np.deg2rad(80.0))  # diameter of the field of view, rad
TURNS = 121.567, -77.731  # of the two prisms per second; no common period within a drive


def rosette(times: Floats) -> tuple[Floats, Floats]:
    """Azimuth and elevation (n,) rad of the beam at times (n,) s since the scanner was switched on."""
    first, second = (2 * np.pi * turns * times for turns in TURNS)
    reach = FIELD / 4  # each prism bends the beam by this angle
    return reach * (np.cos(first) + np.cos(second)), reach * (np.sin(first) + np.sin(second))


def directions(azimuth: Floats, elevation: Floats) -> Float32:
    """(3, 1, n) unit vectors."""
    c = np.cos(elevation)
    return np.stack([c * np.cos(azimuth), c * np.sin(azimuth), np.sin(elevation)])[:, None].astype(np.float32)


def jobs(solids: Solids, azimuth: Floats, yaw: float, margin: tuple[float, float]) -> Jobs:
    """Windows for `cast` in one row of rays whose azimuth (n,) rises. margin: of the scanner's origin (m) and of azimuths (rad).

    Solids are in world axes with the origin at the scanner.
    """
    shift, turn = margin
    corners = solids.corners()
    around = np.arctan2(corners[..., 1], corners[..., 0])
    centre = np.arctan2(solids.centre[:, 1], solids.centre[:, 0])
    spread = np.mod(around - centre[:, None] + np.pi, 2 * np.pi) - np.pi
    c, s = np.cos(solids.yaw), np.sin(solids.yaw)
    x, y = solids.centre[:, 0], solids.centre[:, 1]
    beside = np.maximum(np.abs(np.stack([c * x + s * y, c * y - s * x])) - solids.half[:, :2].T, 0)
    near = np.maximum(np.hypot(*beside) - shift, 0.1)
    side = np.arcsin(np.minimum(shift / near, 1)) + turn
    within = near < 0.5
    low = np.where(within, -np.pi, spread.min(axis=1) - side)
    high = np.where(within, np.pi, spread.max(axis=1) + side)
    middle = np.mod(centre - yaw + np.pi, 2 * np.pi) - np.pi
    windows: list[NDArray[np.int64]] = []
    for around_once in (-2 * np.pi, 0.0, 2 * np.pi):
        first = np.searchsorted(azimuth, middle + low + around_once)
        past = np.searchsorted(azimuth, middle + high + around_once, side="right")
        keep = np.flatnonzero(past > first)
        zero = np.zeros(len(keep), np.int64)
        windows.append(np.stack([keep, zero, zero + 1, first[keep], past[keep]], axis=1))
    window = np.concatenate(windows).astype(np.int32)
    return nearest_first(window, near[window[:, 0]])
