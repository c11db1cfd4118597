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
from calib_ros.lidar.range_image import RangeImage


# What can make an edge of a scan.
class EdgeKind(IntEnum):
    """What makes an edge, and with it the direction of the image gradient that it must meet."""

    SIDE = 0  # the range jumps to the left or right
    TOP = 1  # the range jumps above
    REFLECTIVITY = 2  # the reflectivity changes along the ring, the range does not
    SKY_SIDE = 3  # nothing returns to the left or right
    SKY_TOP = 4  # nothing returns above


UPWARD = (EdgeKind.TOP, EdgeKind.SKY_TOP)


# The cells of a range image that lie on the near side of an edge.
Mask = NDArray[np.bool_]
CLEAR_RINGS = 3  # rings without a return above a point that make an edge against the sky


@dataclass(frozen=True, eq=False)
class EdgeCells:
    """Cells (m,) of one kind. side: +1 if the edge is counter-clockwise of them, -1 clockwise, 0 above.

    row, column: of the range image. strength: float32.
    """

    row: NDArray[np.intp]
    column: NDArray[np.intp]
    kind: EdgeKind
    side: int
    strength: NDArray[np.float32]


def edge_cells(scan: RangeImage, config: LidarConfig) -> list[EdgeCells]:
    """All cells on edges, of every kind that the scan allows.

    Where a projection has no point, that may be chance: edges against the sky are for scanners of rings.
    """
    found = [*_side_edges(scan, config), _top_edges(scan, config)]
    if scan.layout == "rings":
        found += [*_sky_side_edges(scan, config), _sky_top_edges(scan, config)]
    if scan.reflectivity is not None:
        found.append(_reflectivity_edges(scan, config))
    return found


def _cells(mask: Mask, kind: EdgeKind, side: int, strength: NDArray[np.float32] | None = None) -> EdgeCells:
    row, column = np.nonzero(mask)
    own = np.ones(len(row), np.float32) if strength is None else strength[row, column]
    return EdgeCells(row, column, kind, side, own)


def _jump_strength(jump: NDArray[np.float32], config: LidarConfig) -> NDArray[np.float32]:
    with np.errstate(invalid="ignore"):
        return np.sqrt(np.clip(jump, 0, config.jump_saturation))


def _measured(scan: RangeImage, max_range: float) -> Mask:
    return (scan.index >= 0) & (scan.range < max_range)


def _foretold(
    R: NDArray[np.float32], before: NDArray[np.float32], steps: NDArray[np.floating] | float = 1.0
) -> NDArray[np.floating]:
    """Range of the next cell if the surface through `before` and R goes on; at least R, inf beyond its horizon.

    On a plane the inverse range is linear in small angles, so that it is what is extrapolated. steps: spacing to the next cell
    over spacing to the one before. Where `before` is empty, R.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        inverse = 1 / R + np.fmin(1 / R - 1 / before, 0) * steps
        return np.where(inverse <= 0, np.inf, 1 / inverse)


def _side_edges(scan: RangeImage, config: LidarConfig) -> list[EdgeCells]:
    """The near side of each left/right jump, in a projection also across one empty cell.

    A wall seen at a grazing angle is no edge: the jump counts from where the wall goes on.
    """
    R = scan.range
    usable = _measured(scan, config.max_range)
    found: list[EdgeCells] = []
    for side in (1, -1):  # +1: the neighbour at the next column, counter-clockwise
        beside = np.roll(R, -side, 1)
        steps = np.ones_like(R)
        if scan.layout == "projection":
            lost = np.isnan(beside)
            beside[lost] = np.roll(R, -2 * side, 1)[lost]
            steps += lost
        expected = _foretold(R, np.roll(R, side, 1), steps)
        jump = beside - expected
        with np.errstate(invalid="ignore"):
            mask = usable & (jump > config.jump_min) & (jump > config.side_jump_ratio * expected)
        found.append(_cells(mask, EdgeKind.SIDE, side, _jump_strength(jump, config)))
    return found


def _sky_side_edges(scan: RangeImage, config: LidarConfig) -> list[EdgeCells]:
    """Cells beside a gap that is no border of the field of view."""
    empty = np.isnan(scan.range)
    usable = _measured(scan, config.max_range) & _inside_field(scan, config.gap_steps)
    found = []
    for side in (1, -1):
        gap = np.logical_and.reduce([np.roll(empty, -side * k, 1) for k in range(1, config.gap_steps + 1)])
        solid = ~np.roll(empty, side, 1) & ~np.roll(empty, 2 * side, 1)
        found.append(_cells(usable & gap & solid, EdgeKind.SKY_SIDE, side))
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


def _top_edges(scan: RangeImage, config: LidarConfig) -> EdgeCells:
    """Points above which the range grows more than the surface below foretells (a slanted ground is no edge).

    Extrapolating the range itself would call a whole flat road an edge for scanners of few rings.
    """
    R = scan.range * np.cos(scan.elevation)[:, None].astype(np.float32)  # horizontal: its inverse is linear in the tangent
    height = np.tan(scan.elevation)[:, None]
    steps = np.ones_like(height)  # ring spacing above over ring spacing below
    steps[1:-1] = (height[:-2] - height[1:-1]) / np.maximum(height[1:-1] - height[2:], 1e-6)
    above = _above(R, 1)
    if scan.layout == "projection":
        lost = np.isnan(above)
        above[lost] = _above(R, 2)[lost]
        steps = steps + lost
    expected = _foretold(R, _below(R), steps)
    jump = above - expected
    with np.errstate(invalid="ignore"):
        mask = _measured(scan, config.max_range) & (jump > np.maximum(config.jump_min, config.top_jump_ratio * expected))
        mask &= ~(_continued_down(R, height) - R < np.maximum(config.jump_min, config.top_jump_ratio * R))
    return _cells(mask & ~np.isnan(_below(R)), EdgeKind.TOP, 0, _jump_strength(jump, config))


def _continued_down(R: NDArray[np.float32], height: NDArray[np.floating]) -> NDArray[np.floating]:
    """Horizontal range where the surface through the two cells above comes down to each cell's ring; NaN where one is empty.

    A cell on that surface hides nothing of it: behind a kerb the pavement goes on, though higher than the road foretold, and
    its points would be called edges a whole ring above the kerb.
    """
    above, far = _above(R, 1), _above(R, 2)
    steps = np.ones_like(height)  # ring spacing below over ring spacing above
    steps[2:] = (height[1:-1] - height[2:]) / np.maximum(height[:-2] - height[1:-1], 1e-6)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(1 / (1 / above + np.maximum(1 / above - 1 / far, 0) * steps))


def _sky_top_edges(scan: RangeImage, config: LidarConfig) -> EdgeCells:
    """Points above which CLEAR_RINGS rings return nothing, straight up and one column aside."""
    empty = np.isnan(scan.range)
    clear = np.ones_like(empty)
    for rows in range(1, CLEAR_RINGS + 1):
        above = np.isnan(_above(scan.range, rows))
        clear &= above & np.roll(above, 1, 1) & np.roll(above, -1, 1)
    mask = _measured(scan, config.max_range) & clear & ~np.isnan(_below(scan.range))
    mask[: CLEAR_RINGS - 1] = False  # above the top rings there is always emptiness
    return _cells(mask & ~empty, EdgeKind.SKY_TOP, 0)


def _reflectivity_edges(scan: RangeImage, config: LidarConfig) -> EdgeCells:
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
    return _cells(mask, EdgeKind.REFLECTIVITY, -1, np.minimum(step, 0.5))


# Where exactly an edge runs: between the last ray that hits the near surface and the first that passes it.
GOLDEN = (0.7548776662466927, 0.5698402909980532)  # steps of the two-dimensional sequence that fills 0..1 most evenly (R2)
PART = float(np.deg2rad(0.4))  # rad; height of the parts of an upward edge
MOST_PARTS = 8
MOST = 12  # points of a cell that are looked at


@dataclass(frozen=True, eq=False)
class EdgeSamples:
    """xyz: (m, 3) float32 m, on the edges. index: (m,) the points of the cloud that they come from.
    strength: (m,). An upward edge may become several of them."""

    xyz: NDArray[np.float32]
    index: NDArray[np.int32]
    strength: NDArray[np.float32]


def between_rays(scan: RangeImage, found: EdgeCells, config: LidarConfig) -> EdgeSamples:
    """Edges of a scanner of rings: moved outward by a share of the step to the next ray, along the ring or up to the next.

    Leaving this out is the largest single error. Upward, where rings are far apart, one height for a whole outline would pull
    the estimate by that height's error: neighbouring points are spread over all heights that the edge may have.
    """
    row, column = found.row, found.column
    if found.kind not in UPWARD:
        index = scan.index[row, column]
        P = scan.cloud.xyz[index].astype(np.float64)
        angle = config.outward_shift * scan.azimuth_step * found.side
        P += angle * np.c_[-P[:, 1], P[:, 0], np.zeros(len(P))]
        return EdgeSamples(P.astype(np.float32), index, found.strength)
    parts = _parts(scan)
    part = np.tile(np.arange(parts), len(row))
    row, column, strength = (np.repeat(a, parts) for a in (row, column, found.strength / np.float32(parts)))
    index = scan.index[row, column]
    P = scan.cloud.xyz[index].astype(np.float64)
    even = (part + (row * GOLDEN[0] + column * GOLDEN[1]) % 1) / parts
    share = config.outward_shift + config.top_spread * (even - 0.5)
    P[:, 2] += share * _rise(scan, row, np.hypot(P[:, 0], P[:, 1]))
    return EdgeSamples(P.astype(np.float32), index, strength)


def _parts(scan: RangeImage) -> int:
    """Into how many points an upward edge is divided, which share its strength: few where rings are near each other."""
    spacing = float(np.median(-np.diff(scan.elevation))) if len(scan.elevation) > 1 else 0.0
    return int(np.clip(round(spacing / PART), 1, MOST_PARTS))


def _rise(scan: RangeImage, row: NDArray[np.intp], distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far above ring `row` the next higher ring runs, (m,) in m, at distances (m,) from the axis."""
    cones = np.vstack([2 * scan.cones[:1] - scan.cones[1:2], scan.cones])
    gap = cones[row] - cones[row + 1]
    return np.asarray(gap[:, 0] + gap[:, 1] * distance)


def between_points(scan: RangeImage, found: EdgeCells, config: LidarConfig) -> EdgeSamples:
    """Edges of a projection, whose points lie anywhere in their cells: between the outermost point of the near surface and the
    innermost of the far one, by the same share."""
    row, column = found.row, found.column
    columns = scan.range.shape[1]
    index = scan.index[row, column]
    samples = scan.samples
    assert samples is not None
    near = samples.distance[index] + 0.5 * config.jump_min
    along = samples.elevation if found.kind in UPWARD else found.side * samples.azimuth
    centre = along[index]
    cells = [row * columns + column]
    for k in (1, 2):
        cells.append(
            (row - k).clip(0) * columns + column if found.kind in UPWARD else row * columns + (column + found.side * k) % columns
        )
    last, at = np.full(len(row), -np.inf), index.copy()
    offsets, far = [], []
    for k, cell in enumerate(cells):
        points, valid = samples.inside(cell, MOST)
        offset = along[points] - centre[:, None]
        offset = np.where(np.abs(offset) > np.pi, offset - np.sign(offset) * 2 * np.pi, offset)
        close = samples.distance[points] < near[:, None]
        if k == 0:
            own = np.where(valid & close, offset, -np.inf)
            best = own.argmax(axis=1)
            last, at = own[np.arange(len(row)), best], points[np.arange(len(row)), best]
        offsets.append(offset)
        far.append(valid & ~close)
    beyond, passing = np.concatenate(offsets, axis=1), np.concatenate(far, axis=1)
    first = np.where(passing & (beyond > last[:, None]), beyond, np.inf).min(axis=1, initial=np.inf)
    first = np.where(np.isfinite(first), first, last + scan.azimuth_step)
    angle = config.outward_shift * (first - last)
    P = scan.cloud.xyz[at].astype(np.float64)
    if found.kind in UPWARD:
        rho = np.hypot(P[:, 0], P[:, 1])
        P[:, 2] = rho * np.tan(np.arctan2(P[:, 2], rho) + angle)
    else:
        P += (found.side * angle)[:, None] * np.c_[-P[:, 1], P[:, 0], np.zeros(len(P))]
    return EdgeSamples(P.astype(np.float32), at.astype(np.int32), found.strength)


__all__ = ["UPWARD", "EdgeKind", "EdgePoints", "edge_points"]


@dataclass(frozen=True, eq=False)
class EdgePoints:
    """xyz: (n, 3) float32 in the LiDAR frame, shifted onto the edge. strength: (n,) float32. kind: (n,) uint8 EdgeKind.

    ring_spacing: rad, the sensor's median; upward edges are known only to half of it. time: (n,) float32, when each point was
    measured, s after the cloud's stamp as found in a scan, s after the image's moment once lidar/deskew.py has moved them there;
    None if not known. label: (n,) uint8 SemanticClass of what has the edge, None if the cloud has no classes.
    """

    xyz: NDArray[np.float32]
    strength: NDArray[np.float32]
    kind: NDArray[np.uint8]
    ring_spacing: float = float(np.deg2rad(0.4))
    time: NDArray[np.float32] | None = None
    label: NDArray[np.uint8] | None = None

    def __len__(self) -> int:
        return len(self.xyz)

    def select(self, keep: NDArray[np.intp]) -> EdgePoints:
        """Some of the points."""
        time = None if self.time is None else self.time[keep]
        label = None if self.label is None else self.label[keep]
        return EdgePoints(self.xyz[keep], self.strength[keep], self.kind[keep], self.ring_spacing, time, label)


def edge_points(scan: RangeImage, config: LidarConfig) -> EdgePoints:
    """All edge points of a range image, of every kind that the scan allows."""
    cells = edge_cells(scan, config)
    place = between_points if scan.layout == "projection" else between_rays
    placed = [place(scan, found, config) for found in cells]
    index = np.concatenate([p.index for p in placed])
    spacing = float(np.median(-np.diff(scan.elevation))) if len(scan.elevation) > 1 else np.pi
    return EdgePoints(
        np.concatenate([p.xyz for p in placed]),
        np.concatenate([p.strength for p in placed]).astype(np.float32),
        np.concatenate([np.full(len(p.index), found.kind, np.uint8) for found, p in zip(cells, placed, strict=True)]),
        spacing,
        None if scan.cloud.time is None else scan.cloud.time[index],
        None if scan.cloud.label is None else scan.cloud.label[index],
    )
