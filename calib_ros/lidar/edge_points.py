"""Edge points of a scan. They do not depend on the extrinsic: found once per scan, re-projected ever after.

Source: depth discontinuity along the rings (thesis 3.4.3, eq. 3.10), extended by upward jumps, reflectivity steps and
edges against the sky.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import LidarConfig
from calib_ros.lidar.scan import RangeImage

Mask = NDArray[np.bool_]


class EdgeKind(IntEnum):
    """What makes an edge, and with it the direction of the image gradient that it must meet."""

    SIDE = 0  # the range jumps to the left or right
    TOP = 1  # the range jumps above
    REFLECTIVITY = 2  # the reflectivity changes along the ring, the range does not
    SKY_SIDE = 3  # nothing returns to the left or right
    SKY_TOP = 4  # nothing returns above


UPWARD = (EdgeKind.TOP, EdgeKind.SKY_TOP)


@dataclass(frozen=True, eq=False)
class EdgePoints:
    """xyz: (n, 3) float32 in the LiDAR frame, shifted onto the edge. strength: (n,) float32. kind: (n,) uint8 EdgeKind.

    ring_spacing: rad, the sensor's median; upward edges are known only to half of it.
    """

    xyz: NDArray[np.float32]
    strength: NDArray[np.float32]
    kind: NDArray[np.uint8]
    ring_spacing: float = float(np.deg2rad(0.4))

    def __len__(self) -> int:
        return len(self.xyz)

    def select(self, keep: NDArray[np.intp]) -> EdgePoints:
        """Some of the points."""
        return EdgePoints(self.xyz[keep], self.strength[keep], self.kind[keep], self.ring_spacing)


def edge_points(scan: RangeImage, config: LidarConfig) -> EdgePoints:
    """All edge points of a range image, of every kind that the scan allows."""
    found = [*_side_edges(scan, config), _top_edges(scan, config), _sky_top_edges(scan, config)]
    if scan.reflectivity is not None:
        found.append(_reflectivity_edges(scan, config))
    xyz, strength, kind = [], [], []
    for mask, weight, edge_kind, side in found:
        row, column = np.nonzero(mask)
        xyz.append(_shifted(scan, row, column, edge_kind, side, config.outward_shift))
        strength.append(weight[row, column])
        kind.append(np.full(len(row), edge_kind, np.uint8))
    spacing = float(np.median(-np.diff(scan.elevation))) if len(scan.elevation) > 1 else np.pi
    return EdgePoints(np.concatenate(xyz), np.concatenate(strength).astype(np.float32), np.concatenate(kind), spacing)


Found = tuple[Mask, NDArray[np.float32], EdgeKind, int]


def _jump_strength(jump: NDArray[np.float32], config: LidarConfig) -> NDArray[np.float32]:
    with np.errstate(invalid="ignore"):
        return np.sqrt(np.clip(jump, 0, config.jump_saturation))


def _measured(scan: RangeImage, max_range: float) -> Mask:
    return (scan.index >= 0) & (scan.range < max_range)


def _foretold(
    R: NDArray[np.float32], before: NDArray[np.float32], steps: NDArray[np.float64] | float = 1.0
) -> NDArray[np.floating]:
    """Range of the next cell if the surface through `before` and R goes on; at least R, inf beyond its horizon.

    On a plane the inverse range is linear in small angles, so that it is what is extrapolated. steps: spacing to the next cell
    over spacing to the one before. Where `before` is empty, R.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        inverse = 1 / R + np.fmin(1 / R - 1 / before, 0) * steps
        return np.where(inverse <= 0, np.inf, 1 / inverse)


def _side_edges(scan: RangeImage, config: LidarConfig) -> list[Found]:
    """The near side of each left/right jump, and of each left/right gap that is no border of the field of view.

    A wall seen at a grazing angle is no edge: the jump counts from where the wall goes on.
    """
    R, empty = scan.range, np.isnan(scan.range)
    usable, in_field = _measured(scan, config.max_range), _inside_field(scan, config.gap_steps)
    found: list[Found] = []
    for side in (1, -1):  # +1: the neighbour at the next column, counter-clockwise
        expected = _foretold(R, np.roll(R, side, 1))
        jump = np.roll(R, -side, 1) - expected
        with np.errstate(invalid="ignore"):
            mask = usable & (jump > config.jump_min) & (jump > config.side_jump_ratio * expected)
        found.append((mask, _jump_strength(jump, config), EdgeKind.SIDE, side))
        gap = np.logical_and.reduce([np.roll(empty, -side * k, 1) for k in range(1, config.gap_steps + 1)])
        solid = ~np.roll(empty, side, 1) & ~np.roll(empty, 2 * side, 1)
        found.append((usable & gap & solid & in_field, np.ones_like(R), EdgeKind.SKY_SIDE, side))
    return found


def _inside_field(scan: RangeImage, gap_steps: int) -> Mask:
    """False for columns next to a sector where no ring returns: the field of view ends there, or packets were lost."""
    covered = (scan.index >= 0).any(axis=0)
    near_gap = np.zeros_like(covered)
    for k in range(1, gap_steps + 1):
        near_gap |= ~np.roll(covered, k) | ~np.roll(covered, -k)
    return ~near_gap[None, :]


def _above(values: NDArray[np.float32], rows: int) -> NDArray[np.float32]:
    out = np.full_like(values, np.nan)
    out[rows:] = values[: len(values) - rows]
    return out


def _below(values: NDArray[np.float32]) -> NDArray[np.float32]:
    out = np.full_like(values, np.nan)
    out[:-1] = values[1:]
    return out


def _top_edges(scan: RangeImage, config: LidarConfig) -> Found:
    """Points above which the range grows more than the surface below foretells (a slanted ground is no edge).

    Extrapolating the range itself would call a whole flat road an edge for scanners of few rings.
    """
    R = scan.range * np.cos(scan.elevation)[:, None].astype(np.float32)  # horizontal: its inverse is linear in the tangent
    height = np.tan(scan.elevation)[:, None]
    steps = np.ones_like(height)  # ring spacing above over ring spacing below
    steps[1:-1] = (height[:-2] - height[1:-1]) / np.maximum(height[1:-1] - height[2:], 1e-6)
    expected = _foretold(R, _below(R), steps)
    jump = _above(R, 1) - expected
    with np.errstate(invalid="ignore"):
        mask = _measured(scan, config.max_range) & (jump > np.maximum(config.jump_min, config.top_jump_ratio * expected))
    return mask & ~np.isnan(_below(R)), _jump_strength(jump, config), EdgeKind.TOP, 0


def _sky_top_edges(scan: RangeImage, config: LidarConfig) -> Found:
    """Points above which three rings return nothing, straight up and one column aside."""
    empty = np.isnan(scan.range)
    clear = np.ones_like(empty)
    for rows in (1, 2, 3):
        above = np.isnan(_above(scan.range, rows))
        clear &= above & np.roll(above, 1, 1) & np.roll(above, -1, 1)
    mask = _measured(scan, config.max_range) & clear & ~np.isnan(_below(scan.range))
    mask[:2] = False  # the top rings always have emptiness above
    return mask & ~empty, np.ones_like(scan.range), EdgeKind.SKY_TOP, 0


def _reflectivity_edges(scan: RangeImage, config: LidarConfig) -> Found:
    """Steps of the reflectivity along a ring (lane markings, signs) where the range is smooth."""
    assert scan.reflectivity is not None
    R = scan.range
    value = np.where(scan.index >= 0, scan.reflectivity[np.maximum(scan.index, 0)], np.nan)
    step = np.abs(0.5 * (value + np.roll(value, -1, 1)) - 0.5 * (np.roll(value, 1, 1) + np.roll(value, 2, 1)))
    with np.errstate(invalid="ignore"):
        flat = np.maximum(np.abs(np.roll(R, 1, 1) - R), np.abs(np.roll(R, -1, 1) - R)) < config.reflectivity_max_jump
        peak = (step >= np.roll(step, 1, 1)) & (step >= np.roll(step, -1, 1))
        usable = _measured(scan, min(config.reflectivity_max_range, config.max_range))
        mask = usable & (step > config.reflectivity_step) & peak & flat
    return mask, np.minimum(step, 0.5), EdgeKind.REFLECTIVITY, -1


def _shifted(
    scan: RangeImage, row: NDArray[np.intp], column: NDArray[np.intp], kind: EdgeKind, side: int, share: float
) -> NDArray[np.float32]:
    """Points of cells (row, column), moved outward by `share` of an angular step: sideways along the ring, or upward.

    The true edge lies between the last hit on the object and the next ray; leaving this out is the largest single error.
    """
    P = scan.cloud.xyz[scan.index[row, column]].astype(np.float64)
    if kind in (EdgeKind.SIDE, EdgeKind.SKY_SIDE, EdgeKind.REFLECTIVITY):
        angle = share * scan.azimuth_step * side
        P += angle * np.c_[-P[:, 1], P[:, 0], np.zeros(len(P))]
    else:
        height = np.tan(scan.elevation)  # at 1 m
        spacing = -np.diff(height, prepend=2 * height[:1] - height[1:2])
        P[:, 2] += share * spacing[row] * np.hypot(P[:, 0], P[:, 1])
    return P.astype(np.float32)
