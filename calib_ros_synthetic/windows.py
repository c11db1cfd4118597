"""Which rays of a scanner can meet a solid: windows of its grid of rings x firings, or of its one row of rays.

A solid is bounded by the corners of its box in the scanner's frame. Windows are never too small; slack only costs time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros_synthetic.rays import SMALLEST, Jobs, nearest_first
from calib_ros_synthetic.solids import Floats

CLOSE = 0.5  # m from the vertical axis; nearer solids are tried all around
_ANGLES = np.arange(32) * (2 * np.pi / 32)
SIDES = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)])  # directions in which the distance of a footprint is looked at


@dataclass(frozen=True, eq=False)
class Bounds:
    """n solids seen from a scanner: azimuth of their middle, its lowest and highest value relative to that, lowest and highest
    elevation, the width in azimuth at time 0 (rad), each (n,), and a lower bound of their distance (n,), m."""

    middle: Floats
    left: Floats
    right: Floats
    low: Floats
    high: Floats
    width: Floats
    near: Floats


def bounds(corners: Floats, shift: float, turn: float) -> Bounds:
    """Bounds of boxes with corners (n, 8, 3) in the scanner's frame at time 0.

    shift: m that the scanner moves during the scan, to either side. turn: rad that it rotates.
    """
    flat, z = corners[..., :2], corners[..., 2]
    far = np.linalg.norm(flat, axis=-1).max(axis=1) + shift
    # The footprint is convex: a line that separates it from the axis tells how far away it is at least.
    clear = (flat @ SIDES).min(axis=1).max(axis=1) - shift
    near = np.maximum(clear, 0.1)
    azimuth = np.arctan2(corners[..., 1], corners[..., 0])
    mean = flat.mean(axis=1)
    middle = np.arctan2(mean[:, 1], mean[:, 0])
    spread = np.mod(azimuth - middle[:, None] + np.pi, 2 * np.pi) - np.pi
    bottom, top = z.min(axis=1) - shift, z.max(axis=1) + shift
    high = np.arctan2(top, np.where(top > 0, near, far)) + turn
    low = np.arctan2(bottom, np.where(bottom < 0, near, far)) - turn
    # A turn about a level axis moves the azimuth of steep rays more than that of level ones.
    steep = np.tan(np.minimum(np.maximum(np.abs(high), np.abs(low)), 1.4))
    side = np.arcsin(np.minimum(shift / near, 1)) + turn * (1 + steep)
    around = clear < CLOSE
    first, last = spread.min(axis=1), spread.max(axis=1)
    left, right = np.where(around, -np.pi, first - side), np.where(around, np.pi, last + side)
    return Bounds(middle, left, right, low, high, np.where(around, 2 * np.pi, last - first), near)


def grid_windows(
    corners: Floats, elevation: Floats, firings: int, shift: float, turn: float, stagger: float, *, no_thin: bool = False
) -> Jobs:
    """Windows for `cast` in a grid of rings (elevations falling) x firings, whose azimuth rises evenly from -pi to pi.

    corners: (n, 8, 3) in the scanner's frame. stagger: rad that a laser's azimuth may be from that of its column. no_thin: what
    is too thin is left out however far the scanner moves.
    """
    b = bounds(corners, shift, turn)
    step = 2 * np.pi / firings
    r0 = np.searchsorted(-elevation, -b.high)
    r1 = np.searchsorted(-elevation, -b.low, side="right")
    start = b.middle + np.pi
    c0 = np.floor((start + b.left - stagger) / step).astype(int)
    c1 = np.minimum(np.ceil((start + b.right + stagger) / step).astype(int) + 1, c0 + firings)
    keep = np.flatnonzero((r1 > r0) & ((b.width if no_thin else b.right - b.left) > SMALLEST * step))
    windows = [np.zeros((0, 5), np.int64)]
    for k in (-firings, 0, firings):  # a window that leaves the grid on one side comes in again on the other
        first, past = np.maximum(c0[keep] + k, 0), np.minimum(c1[keep] + k, firings)
        some = past > first
        windows.append(np.stack([keep[some], r0[keep][some], r1[keep][some], first[some], past[some]], axis=1))
    return _jobs(np.concatenate(windows), b)


def row_windows(corners: Floats, azimuth: Floats, shift: float, turn: float) -> Jobs:
    """Windows for `cast` in one row of rays whose azimuth (m,) rises. corners: (n, 8, 3) in the scanner's frame."""
    b = bounds(corners, shift, turn)
    windows = []
    for around in (-2 * np.pi, 0.0, 2 * np.pi):
        first = np.searchsorted(azimuth, b.middle + b.left + around)
        past = np.searchsorted(azimuth, b.middle + b.right + around, side="right")
        keep = np.flatnonzero(past > first)
        zero = np.zeros(len(keep), np.int64)
        windows.append(np.stack([keep, zero, zero + 1, first[keep], past[keep]], axis=1))
    return _jobs(np.concatenate(windows), b)


def _jobs(window: NDArray[np.int64], b: Bounds) -> Jobs:
    window32 = window.astype(np.int32)
    return nearest_first(window32, b.near[window32[:, 0]])
