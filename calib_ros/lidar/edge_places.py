"""Where exactly an edge runs: between the last ray that hits the near surface and the first that passes it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import LidarConfig
from calib_ros.lidar.edge_cells import EdgeCells
from calib_ros.lidar.edge_kinds import UPWARD
from calib_ros.lidar.scan import RangeImage

GOLDEN = (0.7548776662466927, 0.5698402909980532)  # steps of the two-dimensional sequence that fills 0..1 most evenly (R2)
PART = float(np.deg2rad(0.4))  # rad; height of the parts of an upward edge
MOST_PARTS = 8
MOST = 12  # points of a cell that are looked at


@dataclass(frozen=True, eq=False)
class Placed:
    """xyz: (m, 3) float32 m, on the edges. index: (m,) the points of the cloud that they come from.
    strength: (m,). An upward edge may become several of them."""

    xyz: NDArray[np.float32]
    index: NDArray[np.int32]
    strength: NDArray[np.float32]


def between_rays(scan: RangeImage, found: EdgeCells, config: LidarConfig) -> Placed:
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
        return Placed(P.astype(np.float32), index, found.strength)
    parts = _parts(scan)
    part = np.tile(np.arange(parts), len(row))
    row, column, strength = (np.repeat(a, parts) for a in (row, column, found.strength / np.float32(parts)))
    index = scan.index[row, column]
    P = scan.cloud.xyz[index].astype(np.float64)
    even = (part + (row * GOLDEN[0] + column * GOLDEN[1]) % 1) / parts
    share = config.outward_shift + config.top_spread * (even - 0.5)
    P[:, 2] += share * _rise(scan, row, np.hypot(P[:, 0], P[:, 1]))
    return Placed(P.astype(np.float32), index, strength)


def _parts(scan: RangeImage) -> int:
    """Into how many points an upward edge is divided, which share its strength: few where rings are near each other."""
    spacing = float(np.median(-np.diff(scan.elevation))) if len(scan.elevation) > 1 else 0.0
    return int(np.clip(round(spacing / PART), 1, MOST_PARTS))


def _rise(scan: RangeImage, row: NDArray[np.intp], distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far above ring `row` the next higher ring runs, (m,) in m, at distances (m,) from the axis."""
    cones = np.vstack([2 * scan.cones[:1] - scan.cones[1:2], scan.cones])
    gap = cones[row] - cones[row + 1]
    return np.asarray(gap[:, 0] + gap[:, 1] * distance)


def between_points(scan: RangeImage, found: EdgeCells, config: LidarConfig) -> Placed:
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
    return Placed(P.astype(np.float32), at.astype(np.int32), found.strength)
