"""The ray caster: which solid or piece of ground a ray meets first, and where.

Rays come in two-dimensional grids (image rows x columns, rings x firings, texels of a shadow map). A solid is only tried
on the window of the grid that its bounding box covers, so that no step looks at all rays for all solids.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import cos, sin

import numpy as np
from numpy.typing import NDArray

from calib_ros.datasets.street.blocks import KERB, Street
from calib_ros.datasets.street.noise import leaf_gap
from calib_ros.datasets.street.solids import Kind, Solids, Surface

Float32 = NDArray[np.float32]
Ints = NDArray[np.int32]

SKY, ROAD, PAVEMENT, CURB = (-1, -2, -3, -4)  # what a ray meets that is no solid; solids have their index from 0
NEAREST = np.float32(0.05)  # ray parameter below which nothing is seen: the sensor's own housing
TINY = 1e-20  # keeps a ray along an axis from dividing zero by zero
LEAF_STEP, LEAF_STEPS = 0.2, 5  # m between the places where a ray looks for leaves, and their greatest number
# Enum members are slow to look up and to compare with numpy's numbers.
BOX, FRUSTUM, ELLIPSOID, CYLINDER, LEAF = (int(k) for k in (Kind.BOX, Kind.FRUSTUM, Kind.ELLIPSOID, Kind.CYLINDER, Surface.LEAF))


@dataclass(frozen=True, eq=False)
class Rays:
    """Origins and directions: x, y and z parts, each (rows, columns) float32 or with 1 where they do not vary.

    Distances along a ray are in units of its direction's length.
    """

    origin: tuple[Float32, Float32, Float32]
    direction: tuple[Float32, Float32, Float32]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the grid."""
        rows, columns = np.broadcast_shapes(*(a.shape for a in (*self.origin, *self.direction)))
        return rows, columns

    def window(self, rows: slice, columns: slice) -> Rays:
        """The rays of some rows and columns."""

        def cut(a: Float32) -> Float32:
            return a[rows if a.shape[0] > 1 else slice(None), columns if a.shape[1] > 1 else slice(None)]

        return Rays(tuple(map(cut, self.origin)), tuple(map(cut, self.direction)))  # type: ignore[arg-type]

    def at(self, t: Float32) -> tuple[Float32, Float32, Float32]:
        """The points at distances t (rows, columns): x, y, z."""
        return tuple(o + t * d for o, d in zip(self.origin, self.direction, strict=True))  # type: ignore[return-value]


@dataclass(frozen=True, eq=False)
class Jobs:
    """What `cast` shall try. window: (m, 5) solid, first and past-the-last row, first and past-the-last column. nearest: (m,)
    a lower bound of the distance to each solid; the nearest should come first, for what they hide is skipped."""

    window: Ints
    nearest: NDArray[np.float64]


def cast(rays: Rays, solids: Solids, jobs: Jobs, t: Float32, ids: Ints) -> None:
    """Lowers t (rows, columns) to the first hit of the solids and writes their indices to ids, in place."""
    for (i, r0, r1, c0, c1), nearest in zip(jobs.window.tolist(), jobs.nearest.tolist(), strict=True):
        rows, columns = slice(r0, r1), slice(c0, c1)
        old = t[rows, columns]
        if old.max() <= nearest:
            continue
        new = intersect(solids, i, rays.window(rows, columns))
        hit = new < old
        np.copyto(old, new, where=hit)
        np.copyto(ids[rows, columns], i, where=hit)


def intersect(solids: Solids, i: int, rays: Rays) -> Float32:
    """Distance to solid i along each ray, infinite where the ray misses it."""
    yaw, (x, y, z), (hx, hy, hz) = (float(solids.yaw[i]), solids.centre[i].tolist(), (1 / solids.half[i]).tolist())
    c, s = cos(yaw), sin(yaw)
    ox, oy, oz = rays.origin
    ox, oy, oz = ox - x, oy - y, oz - z
    dx, dy, dz = rays.direction
    o = ((c * hx) * ox + (s * hx) * oy, (c * hy) * oy - (s * hy) * ox, hz * oz)
    d = ((c * hx) * dx + (s * hx) * dy, (c * hy) * dy - (s * hy) * dx, hz * dz)
    kind = int(solids.kind[i])
    with np.errstate(divide="ignore", invalid="ignore"):
        if kind == BOX:
            near, far = _box(o, d)
        elif kind == FRUSTUM:
            near, far = _frustum(o, d, solids.taper[i].tolist())
        elif kind == ELLIPSOID:
            near, far = _round(o, d, (0, 1, 2))
        else:
            axis, axes = (2, (0, 1)) if kind == CYLINDER else (1, (0, 2))
            near, far = _round(o, d, axes)
            low, high = _slab(o[axis], d[axis])
            near, far = np.maximum(near, low), np.minimum(far, high)
        hit = (near < far) & (near > NEAREST)
    if solids.surface[i] == LEAF:
        return _through_leaves(solids, i, rays, near, far, hit)
    return np.where(hit, near, np.float32(np.inf))


def _slab(o: Float32, d: Float32) -> tuple[Float32, Float32]:
    inverse = 1 / (d + TINY)
    middle, reach = -o * inverse, np.abs(inverse)
    return np.asarray(middle - reach), np.asarray(middle + reach)


def _box(o: Sequence[Float32], d: Sequence[Float32]) -> tuple[Float32, Float32]:
    near, far = _slab(o[0], d[0])
    for k in (1, 2):
        low, high = _slab(o[k], d[k])
        near, far = np.maximum(near, low), np.minimum(far, high)
    return near, far


def _frustum(o: Sequence[Float32], d: Sequence[Float32], taper: Sequence[float]) -> tuple[Float32, Float32]:
    near, far = _slab(o[2], d[2])
    for k in (0, 1):
        lean = taper[k] / 2
        oz, dz = lean * o[2] - (1 - lean), lean * d[2]
        for outward in (1.0, -1.0):  # the side is where outward * p[k] + lean * (p[z] + 1) = 1
            slope = outward * d[k] + dz + TINY
            t = -(outward * o[k] + oz) / slope
            near = np.where(slope < 0, np.maximum(near, t), near)
            far = np.where(slope < 0, far, np.minimum(far, t))
    return near, far


def _round(o: Sequence[Float32], d: Sequence[Float32], axes: tuple[int, ...]) -> tuple[Float32, Float32]:
    """Unit circle or sphere over the axes. The point nearest to the centre comes first: the textbook discriminant loses
    all digits of float32 for a thin pole far away."""
    scale = np.asarray(1 / (sum(d[k] * d[k] for k in axes) + TINY))
    middle = np.asarray(-sum(o[k] * d[k] for k in axes) * scale)
    gap = np.asarray(sum(np.square(o[k] + middle * d[k]) for k in axes))
    reach = np.sqrt((1 - gap) * scale)  # NaN, hence no hit, where the ray passes by
    return np.asarray(middle - reach), np.asarray(middle + reach)


def _through_leaves(solids: Solids, i: int, rays: Rays, near: Float32, far: Float32, hit: NDArray[np.bool_]) -> Float32:
    """Walks into a clump of leaves until a leaf is met: ragged outlines, gaps and depth, the same for every sensor."""
    out = np.full(hit.shape, np.inf, np.float32)
    rows, columns = np.nonzero(hit)
    if not len(rows):
        return out

    def pick(a: Float32) -> Float32:
        return np.asarray(a[rows if a.shape[0] > 1 else 0, columns if a.shape[1] > 1 else 0])

    dx, dy, dz = (np.broadcast_to(pick(a), rows.shape) for a in rays.direction)
    step = LEAF_STEP / np.sqrt(dx * dx + dy * dy + dz * dz)
    t, end = near[rows, columns] + 0.5 * step, far[rows, columns]
    ox, oy, oz = (pick(a) - c for a, c in zip(rays.origin, solids.centre[i].tolist(), strict=True))
    x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
    at = rows * hit.shape[1] + columns
    for _ in range(LEAF_STEPS):
        gap = leaf_gap(x, y, z, float(solids.style[i, 0]))
        out.ravel()[at[~gap]] = t[~gap]
        on = np.flatnonzero(gap & (t + step < end))
        if not len(on):
            break
        x, y, z, t, end, step, at, dx, dy, dz = (a[on] for a in (x, y, z, t, end, step, at, dx, dy, dz))
        x, y, z, t = x + step * dx, y + step * dy, z + step * dz, t + step
    return out


def cast_ground(rays: Rays, street: Street, origin: NDArray[np.float64], t: Float32, ids: Ints) -> None:
    """As `cast`, for the road, the kerbs and the pavements with all that lies behind them. origin: (3,) world position of
    the rays' coordinates."""
    dz, height = rays.direction[2], rays.origin[2] + np.float32(origin[2])
    # The pavement's level is the higher one: where a solid comes before it, the ray cannot reach any ground.
    with np.errstate(invalid="ignore"):
        some_rows, some_columns = np.nonzero((dz < -1e-4) & (t * dz < KERB - height))

    def pick(a: Float32) -> Float32:
        return np.broadcast_to(a, t.shape)[some_rows, some_columns]

    x, y, dx, dy = (pick(a) for a in (*rays.origin[:2], *rays.direction[:2]))
    drop, level, first = -pick(dz), pick(height), pick(t)
    high, low = (level - KERB) / drop, level / drop
    width = street.road
    d_high, d_low = (np.abs(street.path.offset(x + q * dx, y + q * dy, origin)) for q in (high, low))
    pavement, road = d_high > width, d_low <= width
    with np.errstate(divide="ignore", invalid="ignore"):
        curb = high + (low - high) * np.clip((width - d_high) / (d_low - d_high), 0, 1)
    new = np.where(pavement, high, np.where(road, low, curb))
    kind = np.where(pavement, PAVEMENT, np.where(road, ROAD, CURB))
    hit = (new < first) & (new > NEAREST)
    rows, columns = some_rows[hit], some_columns[hit]
    t[rows, columns], ids[rows, columns] = new[hit], kind[hit]
