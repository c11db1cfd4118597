"""Edge points of a scan. They do not depend on the extrinsic: found once per scan, projected for every candidate.

Depth discontinuities along the rings (thesis 3.4.3, eq. 3.10), extended by upward jumps, reflectivity steps and edges against
the sky. Of each, the cells of the range image on its near side are found; `between_rays` and `between_points` place each edge
point between the last ray on the near surface and the first ray past it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from calib_ros.arrays import quantile
from calib_ros.config import LidarConfig
from calib_ros.lidar.range_image import JUMP_MIN, RangeImage
from calib_ros.lidar.scanner_pose import CLOUD_FRAME, ScannerPose

Mask = NDArray[np.bool_]
SIDE_JUMP_RATIO, TOP_JUMP_RATIO = 0.02, 0.05  # smallest range jumps relative to the range: less is a surface seen at an angle
JUMP_SATURATION = 3.0  # m; range jump of full edge strength, which is the square root of the ratio
OUTWARD_SHIFT = 0.5  # share of the angular step by which edge points move outward: the last return lies inside the object
TOP_SPREAD = 1.0  # share of the step to the next ring that upward edges spread over: one height would bias by its error
GAP_STEPS = 6  # empty columns that make an edge against the sky; fewer are lost returns
CLEAR_RINGS = 3  # rings without a return above a cell that make an edge against the sky
GRAZING = float(np.deg2rad(15.0))  # of the light that a matt surface returns head-on, a quarter comes back
LEAST_ALONG = 0.05  # m from one ring to the next; less is noise
R2_STEPS = (0.7548776662466927, 0.5698402909980532)  # of the two-dimensional sequence that fills 0..1 most evenly (R2)
PART_HEIGHT = float(np.deg2rad(0.4))  # rad; of the parts into which an upward edge is divided
MAX_PARTS = 8
MAX_CELL_POINTS = 12  # points of a cell that are examined, without rings
# How many times the noise a reflectivity edge exceeds, share of unusually large steps, noise below which intensities are rounded.
ABOVE_NOISE, UNUSUAL_SHARE, LEAST_NOISE = 6.4, 0.05, 6e-5
NOISE_STEPS, NOISE_PARTS = 20_000, 16  # steps of a scan that tell its noise, and parts into which their levels are divided
MAX_RANGE = 60.0  # m; the points of a thing farther away are too few and too coarse for an edge
REFLECTIVITY_STEP = 0.12  # share of full scale that makes an edge wherever it exceeds the noise: lane markings of usual paint
REFLECTIVITY_MAX_RANGE = 40.0  # m; farther, the beam is wider than a lane marking
REFLECTIVITY_MAX_JUMP = 0.2  # m; a step of the reflectivity at a larger one of the range is a range edge
USUAL_STRENGTH, MAX_STRENGTH = 0.12, 0.5  # of a step that is just unusual, and of any
# Columns between a reflectivity edge and the border of its surface, where rays return less: the image has no edge there.
SURFACE_COLUMNS = 3


class EdgeKind(IntEnum):
    """What makes an edge; it determines the direction of the image gradient that the edge must meet."""

    SIDE = 0  # the range jumps to the left or right
    TOP = 1  # the range jumps above
    REFLECTIVITY = 2  # the reflectivity changes along the ring, the range does not
    SKY_SIDE = 3  # nothing returns to the left or right
    SKY_TOP = 4  # nothing returns above


UPWARD = (EdgeKind.TOP, EdgeKind.SKY_TOP)


@dataclass(frozen=True, eq=False)
class EdgePoints:
    """Edge points of a scan.

    Attributes
    ----------
    xyz : (n, 3) float32, m in the LiDAR frame, shifted onto the edge.
    strength : (n,) float32. kind : (n,) uint8, EdgeKind.
    ring_spacing : rad, median of the sensor; upward edges are known only to half of it.
    time : (n,) float32, s after the cloud's stamp at which each point was measured, s after the image's stamp once
        `deskew.deskewed_edges` has moved them; None if unknown.
    label : (n,) uint8, SemanticClass of the object with the edge; None if the cloud has no classes.
    pose : of the scanner in the LiDAR frame.
    azimuth_step : rad between rays of a ring, within which side edges may lie anywhere; 0 = they lie between measured points.
    """

    xyz: NDArray[np.float32]
    strength: NDArray[np.float32]
    kind: NDArray[np.uint8]
    ring_spacing: float = float(np.deg2rad(0.4))
    time: NDArray[np.float32] | None = None
    label: NDArray[np.uint8] | None = None
    pose: ScannerPose = CLOUD_FRAME
    azimuth_step: float = 0.0

    def __len__(self) -> int:
        return len(self.xyz)

    def select(self, keep: NDArray[np.intp]) -> EdgePoints:
        """The points of these indices."""
        time = None if self.time is None else self.time[keep]
        label = None if self.label is None else self.label[keep]
        return replace(self, xyz=self.xyz[keep], strength=self.strength[keep], kind=self.kind[keep], time=time, label=label)


def edge_points(scan: RangeImage, config: LidarConfig) -> EdgePoints:
    """Edge points of a range image, of every kind that the scan allows."""
    cells = [*_side_edges(scan, config), _top_edges(scan, config)]
    if scan.layout == "rings":  # a cell of a scanner without rings may be empty by chance, which is no edge against the sky
        cells += _sky_edges(scan, config)
    if scan.reflectivity is not None:
        cells.append(_reflectivity_edges(scan, config))
    locate = between_points if scan.layout == "projection" else between_rays
    samples = [locate(scan, found) for found in cells]
    P, index, strength = (np.concatenate(parts) for parts in zip(*samples, strict=True))
    xyz, strength = scan.pose.to_cloud(P).astype(np.float32), strength.astype(np.float32)
    kind = np.repeat(np.array([found.kind for found in cells], np.uint8), [len(own) for _, own, _ in samples])
    spacing = float(quantile(-np.diff(scan.elevation), 0.5)) if len(scan.elevation) > 1 else np.pi
    time, label = (None if values is None else values[index] for values in (scan.cloud.time, scan.cloud.label))
    step = scan.azimuth_step if scan.layout == "rings" else 0.0
    return EdgePoints(xyz, strength, kind, spacing, time, label, scan.pose, step)


@dataclass(frozen=True, eq=False)
class EdgeCells:
    """Cells (m,) of a range image on the near side of edges of one kind. side: +1 if the edge is counter-clockwise of the cell,
    -1 clockwise, 0 above. strength: (m,) float32."""

    row: NDArray[np.intp]
    column: NDArray[np.intp]
    kind: EdgeKind
    side: int
    strength: NDArray[np.float32]


def _side_edges(scan: RangeImage, config: LidarConfig) -> list[EdgeCells]:
    """The near side of each left/right range jump from the continued surface; without rings also across one empty cell."""
    R = scan.range
    usable = _measured(scan, config)
    found: list[EdgeCells] = []
    for side in (1, -1):  # +1: the neighbour at the next column, counter-clockwise
        beside = np.roll(R, -side, 1)
        steps = np.ones_like(R)
        if scan.layout == "projection":
            lost = np.isnan(beside)
            beside[lost] = np.roll(R, -2 * side, 1)[lost]
            steps += lost
        expected = _extrapolated(R, np.roll(R, side, 1), steps)
        jump = beside - expected
        with np.errstate(invalid="ignore"):
            mask = usable & (jump > JUMP_MIN) & (jump > SIDE_JUMP_RATIO * expected)
            found.append(_cells(mask, EdgeKind.SIDE, side, np.sqrt(np.clip(jump, 0, JUMP_SATURATION))))
    return found


def _top_edges(scan: RangeImage, config: LidarConfig) -> EdgeCells:
    """Cells above which the range grows more than the continued surface below (sloping ground is not an edge)."""
    R = scan.range * np.cos(scan.elevation)[:, None].astype(np.float32)  # horizontal: its inverse is linear in the tangent
    height = np.tan(scan.elevation)[:, None]
    steps = np.ones_like(height)  # ring spacing above over ring spacing below
    steps[1:-1] = (height[:-2] - height[1:-1]) / np.maximum(height[1:-1] - height[2:], 1e-6)
    above, far = _above(R, 1), _above(R, 2)
    # A cell on the surface through the two cells above it does not occlude it: pavement behind a kerb would become edges a whole
    # ring above the kerb.
    down = np.ones_like(height)  # ring spacing below over ring spacing above
    down[2:] = (height[1:-1] - height[2:]) / np.maximum(height[:-2] - height[1:-1], 1e-6)
    with np.errstate(invalid="ignore", divide="ignore"):
        continued = 1 / (1 / above + np.maximum(1 / above - 1 / far, 0) * down)
    if scan.layout == "projection":
        lost = np.isnan(above)
        above[lost] = far[lost]
        steps = steps + lost
    expected = _extrapolated(R, _above(R, -1), steps)
    jump = above - expected
    with np.errstate(invalid="ignore"):
        mask = _measured(scan, config) & (jump > np.maximum(JUMP_MIN, TOP_JUMP_RATIO * expected))
        mask &= ~(continued - R < np.maximum(JUMP_MIN, TOP_JUMP_RATIO * R))
        strength = np.sqrt(np.clip(jump, 0, JUMP_SATURATION))
    return _cells(mask & ~np.isnan(_above(R, -1)), EdgeKind.TOP, 0, strength)


def _sky_edges(scan: RangeImage, config: LidarConfig) -> list[EdgeCells]:
    """Cells, but for those of surfaces that fade (see _grazed), beside a gap of GAP_STEPS cells that is not the border of the
    field of view; and those above which CLEAR_RINGS rings have no return, straight up and one column to either side."""
    empty, usable = np.isnan(scan.range), _measured(scan, config) & ~_grazed(scan)
    # Columns next to a sector without any return: the end of the field of view, or lost packets.
    covered = (scan.index >= 0).any(axis=0)
    near_gap = np.zeros_like(covered)
    for k in range(1, GAP_STEPS + 1):
        near_gap |= ~np.roll(covered, k) | ~np.roll(covered, -k)
    found = []
    for side in (1, -1):
        gap = np.roll(empty, -side, 1)
        for k in range(2, GAP_STEPS + 1):
            gap &= np.roll(empty, -side * k, 1)
        solid = ~np.roll(empty, side, 1) & ~np.roll(empty, 2 * side, 1)
        found.append(_cells(usable & ~near_gap & gap & solid, EdgeKind.SKY_SIDE, side))
    clear = usable & ~np.isnan(_above(scan.range, -1))
    clear[: CLEAR_RINGS - 1] = False  # nothing is measured above the top rings
    for rows in range(1, CLEAR_RINGS + 1):
        above = np.isnan(_above(scan.range, rows))
        clear &= above & np.roll(above, 1, 1) & np.roll(above, -1, 1)
    return [*found, _cells(clear & ~empty, EdgeKind.SKY_TOP, 0)]


def _grazed(scan: RangeImage) -> Mask:
    """Cells whose surface, from the cell below to them, is seen at less than GRAZING; False where the cell below is empty."""
    # Ground that is seen so flat returns too little from some distance on: where it ends on an open road, there is no edge.
    below = _above(scan.range, -1)
    step = np.diff(scan.elevation, append=scan.elevation[-1:])[:, None].astype(np.float32)  # to the ring below
    # Of the triangle of scanner, cell and cell below: the angle at the cell.
    across, along = below * np.abs(np.sin(step)), scan.range - below * np.cos(step)
    with np.errstate(invalid="ignore"):
        flat = (across < np.tan(GRAZING) * along) & (along > LEAST_ALONG)
    # A surface, not the jump from one thing to another above it: it goes on below, if anything is measured there.
    goes_on = np.isnan(_above(below, -1))
    goes_on[:-1] |= flat[1:]
    return np.asarray(flat & goes_on)


def _reflectivity_edges(scan: RangeImage, config: LidarConfig) -> EdgeCells:
    """Reflectivity steps along a ring (lane markings, signs) where the range is smooth, away from the surface's border."""
    assert scan.reflectivity is not None
    R = scan.range
    value = np.append(scan.reflectivity, np.float32(np.nan)).take(scan.index)
    ahead, behind = 0.5 * (value + np.roll(value, -1, 1)), 0.5 * (np.roll(value, 1, 1) + np.roll(value, 2, 1))
    step, level = np.abs(ahead - behind), np.asarray(0.5 * (ahead + behind), np.float32)
    before = np.roll(R, 1, 1)
    with np.errstate(invalid="ignore"):
        border = np.abs(R - before) > np.maximum(JUMP_MIN, SIDE_JUMP_RATIO * np.minimum(R, before))
        border |= np.isnan(R) & np.isnan(before)
        near = border.copy()
        for k in range(1, SURFACE_COLUMNS + 1):
            near |= np.roll(border, k, 1) | np.roll(border, -k, 1)
        flat = np.maximum(np.abs(before - R), np.abs(np.roll(R, -1, 1) - R)) < REFLECTIVITY_MAX_JUMP
        peak = (step >= np.roll(step, 1, 1)) & (step >= np.roll(step, -1, 1))
        usable = _measured(scan, config, REFLECTIVITY_MAX_RANGE) & flat
        some = np.flatnonzero(usable)
        some = some[:: max(len(some) // NOISE_STEPS, 1)]
        at_zero, slope = _reflectivity_noise(step.take(some), level.take(some))
        ratio = step / np.maximum(at_zero + slope * level, np.float32(LEAST_NOISE))
        counted = ratio[usable & ~np.isnan(ratio)]
        unusual = max(ABOVE_NOISE, float(quantile(counted, 1 - UNUSUAL_SHARE))) if len(counted) else np.inf
        large = (ratio > unusual) | ((ratio > ABOVE_NOISE) & (step > REFLECTIVITY_STEP))
        mask = usable & large & peak & ~near
        strength = np.maximum(ratio * np.float32(USUAL_STRENGTH / unusual), step)
    return _cells(mask, EdgeKind.REFLECTIVITY, -1, np.minimum(strength, np.float32(MAX_STRENGTH)))


def _reflectivity_noise(steps: NDArray[np.float32], levels: NDArray[np.float32]) -> tuple[np.float32, np.float32]:
    """Noise of a scan's reflectivity, by its steps (n,) and the mean reflectivities (n,) around them: at level 0, and its slope.
    The highest rising line below the median steps of parts of the levels: edges raise the medians, and nothing lowers them."""
    known = ~np.isnan(steps) & ~np.isnan(levels)
    steps, levels = steps[known], levels[known] + np.float32(0)
    # By level, equal ones as they come: bits of a level above a number are sorted ten times as fast as by a stable argsort.
    bits = levels.view(np.uint32).astype(np.uint64) << np.uint64(32)
    order = np.sort(bits + np.arange(len(bits), dtype=np.uint64)).astype(np.uint32)
    parts = [part for part in np.array_split(order, NOISE_PARTS) if len(part)]
    medians = np.array([[quantile(a[part], 0.5) for a in (levels, steps)] for part in parts]).reshape(-1, 2)
    x, y = medians[medians[:, 1] > 0].T  # where whole numbers hide the noise, they do not tell it
    if not len(x):
        return np.float32(0), np.float32(0)
    # The line a + b x with the least total distance from them solves a linear program, at a corner: a line through two points,
    # through one and the origin, or level at the lowest.
    x, y = x.astype(np.float64), y.astype(np.float64)
    i, j = np.triu_indices(len(x), 1)
    apart = x[j] != x[i]
    i, j = i[apart], j[apart]
    b = np.concatenate([(y[j] - y[i]) / (x[j] - x[i]), y[x > 0] / x[x > 0], [0.0]])
    b = b[b >= 0]
    a = (y - b[:, None] * x).min(axis=1)
    total = np.where(a >= -1e-9 * y.max(), len(x) * a + x.sum() * b, -np.inf)
    best = int(np.argmax(total))
    return np.float32(max(a[best], 0.0)), np.float32(b[best])


def _cells(mask: Mask, kind: EdgeKind, side: int, strength: NDArray[np.float32] | None = None) -> EdgeCells:
    row, column = np.divmod(np.flatnonzero(mask), mask.shape[1])  # takes half the time of np.nonzero
    own = np.ones(len(row), np.float32) if strength is None else strength[row, column]
    return EdgeCells(row, column, kind, side, own)


def _measured(scan: RangeImage, config: LidarConfig, max_range: float = MAX_RANGE) -> Mask:
    """Cells that may be edges."""
    # The vehicle's own are none, but stay in the range image: what is beside them would be an edge against the sky.
    measured = (scan.index >= 0) & (scan.range < max_range)
    if any(config.ego_box):
        low, high = np.reshape(config.ego_box, (3, 2)).T
        own = ((scan.cloud.xyz >= low) & (scan.cloud.xyz <= high)).all(axis=1)
        measured &= ~own[np.maximum(scan.index, 0)]
    return np.asarray(measured)


def _extrapolated(R: NDArray[np.float32], before: NDArray[np.float32], steps: NDArray[np.floating]) -> NDArray[np.floating]:
    """Range of the next cell, `steps` spacings on, if the surface through `before` and R continues: at least R, inf beyond its
    horizon, R where `before` is empty."""
    # The inverse range is extrapolated, which is linear in small angles on a plane.
    with np.errstate(invalid="ignore", divide="ignore"):
        inverse = 1 / R
        return np.asarray(1 / np.maximum(inverse + np.fmin(inverse - 1 / before, 0) * steps, 0))


def _above(values: NDArray[np.float32], rows: int) -> NDArray[np.float32]:
    """Of each cell the value so many rows above, -1 = below; NaN beyond the ends."""
    out = np.roll(values, rows, 0)
    out[slice(rows) if rows > 0 else slice(rows, None)] = np.nan
    return out


# Points on edges, of which an upward edge may give several: (m, 3) in the scanner's frame, m, index (m,) into the cloud, and
# strength (m,).
EdgeSamples = tuple[NDArray[np.float64], NDArray[np.integer], NDArray[np.float32]]


def between_rays(scan: RangeImage, found: EdgeCells) -> EdgeSamples:
    """Edge points of a scanner with rings: moved outward by a share of the step to the next ray, along the ring or upward."""
    # The edge lies between the last ray that hits the near surface and the first that misses it. Upward, where rings are far
    # apart, neighbouring points are spread over all heights that the edge may have: a single one would bias by its error.
    row, column = found.row, found.column
    if found.kind not in UPWARD:
        index = scan.index[row, column]
        P = _in_scanner(scan, index)
        angle = OUTWARD_SHIFT * scan.azimuth_step * found.side
        P += angle * np.c_[-P[:, 1], P[:, 0], np.zeros(len(P))]
        return P, index, found.strength
    parts = upward_parts(float(quantile(-np.diff(scan.elevation), 0.5)) if len(scan.elevation) > 1 else 0.0)
    part = np.tile(np.arange(parts), len(row))
    row, column, strength = (np.repeat(a, parts) for a in (row, column, found.strength / np.float32(parts)))
    index = scan.index[row, column]
    P = _in_scanner(scan, index)
    even = (part + (row * R2_STEPS[0] + column * R2_STEPS[1]) % 1) / parts
    share = OUTWARD_SHIFT + TOP_SPREAD * (even - 0.5)
    cones = np.vstack([2 * scan.cones[:1] - scan.cones[1:2], scan.cones])
    gap = cones[row] - cones[row + 1]  # to the next ring above
    P[:, 2] += share * (gap[:, 0] + gap[:, 1] * np.hypot(P[:, 0], P[:, 1]))
    return P, index, strength


def _in_scanner(scan: RangeImage, index: NDArray[np.integer]) -> NDArray[np.float64]:
    """Points of the cloud in the scanner's frame."""
    return np.asarray(scan.pose.to_scanner(scan.cloud.xyz.take(index, axis=0).astype(np.float64)))


def upward_parts(spacing: float) -> int:
    """Number of points that share the strength of an upward edge, of rings so far apart (rad): fewer where they are close."""
    return int(np.clip(round(spacing / PART_HEIGHT), 1, MAX_PARTS))


def between_points(scan: RangeImage, found: EdgeCells) -> EdgeSamples:
    """Edge points of a scanner without rings, whose points lie anywhere in their cells: between the outermost point of the near
    surface and the innermost point of the far one, by the same share."""
    row, column, columns, samples = found.row, found.column, scan.range.shape[1], scan.samples
    index = scan.index[row, column]
    assert samples is not None
    near = samples.distance[index] + 0.5 * JUMP_MIN
    upward = found.kind in UPWARD
    along = samples.elevation if upward else found.side * samples.azimuth
    centre = along[index]
    cells = [row * columns + column]
    for k in (1, 2):
        cells.append((row - k).clip(0) * columns + column if upward else row * columns + (column + found.side * k) % columns)
    last, outermost = np.full(len(row), -np.inf), index.copy()
    offsets, far = [], []
    for k, cell in enumerate(cells):
        at = samples.start[cell][:, None] + np.arange(MAX_CELL_POINTS)  # nearest first
        valid = at < samples.start[cell + 1][:, None]
        points = samples.order[np.minimum(at, len(samples.order) - 1)]
        offset = along[points] - centre[:, None]
        offset = np.where(np.abs(offset) > np.pi, offset - np.sign(offset) * 2 * np.pi, offset)
        close = samples.distance[points] < near[:, None]
        if k == 0:
            own = np.where(valid & close, offset, -np.inf)
            best = own.argmax(axis=1)
            last, outermost = own[np.arange(len(row)), best], points[np.arange(len(row)), best]
        offsets.append(offset)
        far.append(valid & ~close)
    beyond, passing = np.concatenate(offsets, axis=1), np.concatenate(far, axis=1)
    first = np.where(passing & (beyond > last[:, None]), beyond, np.inf).min(axis=1, initial=np.inf)
    first = np.where(np.isfinite(first), first, last + scan.azimuth_step)
    angle = OUTWARD_SHIFT * (first - last)
    P = _in_scanner(scan, outermost)
    if upward:
        rho = np.hypot(P[:, 0], P[:, 1])
        P[:, 2] = rho * np.tan(np.arctan2(P[:, 2], rho) + angle)
    else:
        P += (found.side * angle)[:, None] * np.c_[-P[:, 1], P[:, 0], np.zeros(len(P))]
    return P, outermost, found.strength
