"""The ray caster: which solid or piece of ground a ray hits first, and the rays of the camera.

Rays come in two-dimensional grids (image rows x columns, rings x firings, texels of a shadow map). A solid is only tried
on the window of the grid that its bounding box covers, so that no step tests all rays against all solids.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import cos, sin
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros_synthetic.solids import Kind, Solids, Surface, leaf_gap
from calib_ros_synthetic.street import Street

Float32 = NDArray[np.float32]
Vectors = tuple[Float32, Float32, Float32]
Ints = NDArray[np.int32]
# What a ray meets that is no solid of the street; solids have their index from 0.
SKY, ROAD, PAVEMENT, CURB, OWN = (-1, -2, -3, -4, -5)
ZERO = np.zeros((1, 1), np.float32)
ORIGIN = (ZERO, ZERO, ZERO)  # of rays that start where solids are relative to
SHALLOWEST = 1e-3  # z of unit directions that x/z and y/z are taken of
NEAREST = np.float32(0.05)  # ray parameter below which nothing is seen: the sensor's own housing
TINY = 1e-20  # keeps a ray along an axis from dividing zero by zero
LEAF_STEP, LEAF_STEPS = 0.2, 5  # m between the places where a ray looks for leaves, and their greatest number
# Enum members are slow to look up and to compare with numpy's numbers.
BOX, FRUSTUM, ELLIPSOID, CYLINDER, LEAF = (int(k) for k in (Kind.BOX, Kind.FRUSTUM, Kind.ELLIPSOID, Kind.CYLINDER, Surface.LEAF))
Floats = NDArray[np.float64]
# Sub-pixel rays, in pixels from the centre. Symmetric about it, so that averaging moves no edge.
SAMPLES = np.array([(-0.125, -0.375), (0.375, -0.125), (-0.375, 0.125), (0.125, 0.375)])
BLOCK_PIXELS = 1 << 20  # looked through the lens at a time: in double precision 12 Mpx would need gigabytes
NEAR = 0.1  # m; solids are cut at this depth before they are projected
SMALLEST = 0.3  # of a pixel or firing step: smaller solids are left out


@dataclass(frozen=True, eq=False)
class Rays:
    """Origins and directions: x, y and z parts, each (rows, columns) float32 or with 1 where they do not vary.

    Distances along a ray are in units of its direction's length.
    """

    origin: Vectors
    direction: Vectors

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the grid."""
        rows, columns = np.broadcast_shapes(*(a.shape for a in (*self.origin, *self.direction)))
        return rows, columns

    def window(self, rows: slice, columns: slice | NDArray[np.intp]) -> Rays:
        """The rays of some rows and columns."""

        def cut(a: Float32) -> Float32:
            return a[rows if a.shape[0] > 1 else slice(None), columns if a.shape[1] > 1 else slice(None)]

        return Rays(tuple(map(cut, self.origin)), tuple(map(cut, self.direction)))  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class Jobs:
    """What `cast` shall try. window: (m, 5) solid, first and past-the-last row, first and past-the-last column. nearest: (m,)
    a lower bound of the distance to each solid; the nearest should come first, for what they hide is skipped."""

    window: Ints
    nearest: Floats

    @classmethod
    def whole(cls, count: int, shape: tuple[int, int]) -> Jobs:
        """All of so many solids on all rays of a grid."""
        window = np.zeros((count, 5), np.int32)
        window[:, 0], window[:, 2], window[:, 4] = np.arange(count), *shape
        return cls(window, np.zeros(count))


def unmet(shape: tuple[int, ...]) -> tuple[Float32, Ints]:
    """Distances and ids of rays that have met nothing."""
    return np.full(shape, np.inf, np.float32), np.full(shape, SKY, np.int32)


def cast(rays: Rays, solids: Solids, jobs: Jobs, t: Float32, ids: Ints) -> None:
    """Lowers t (rows, columns) to the first hit of the solids and writes their indices to ids, in place."""
    for (i, r0, r1, c0, c1), nearest in zip(jobs.window.tolist(), jobs.nearest.tolist(), strict=True):
        rows, columns = slice(r0, r1), slice(c0, c1)
        old = t[rows, columns]
        if old.max() <= nearest:
            continue
        new = intersect(solids, i, rays.window(rows, columns), old)
        hit = new < old
        np.copyto(old, new, where=hit)
        np.copyto(ids[rows, columns], i, where=hit)


def intersect(solids: Solids, i: int, rays: Rays, limit: Float32 | None = None) -> Float32:
    """Distance to solid i along each ray, infinite where the ray misses it. limit: distances of the rays' grid from which on a
    hit need not be found."""
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
            near, far = _slab(o[0], d[0])
            for low, high in (_slab(o[1], d[1]), _slab(o[2], d[2])):
                near, far = np.maximum(near, low), np.minimum(far, high)
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
        if limit is not None:  # leaves behind something nearer are not worth the walk
            hit &= near < limit
        return _through_leaves(solids, i, rays, near, far, hit)
    return np.where(hit, near, np.float32(np.inf))


def _slab(o: Float32, d: Float32) -> tuple[Float32, Float32]:
    inverse = 1 / (d + TINY)
    middle, reach = -o * inverse, np.abs(inverse)
    return np.asarray(middle - reach), np.asarray(middle + reach)


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
        some_rows, some_columns = np.nonzero((dz < -1e-4) & (t * dz < street.kerb - height))

    def pick(a: Float32) -> Float32:
        return np.broadcast_to(a, t.shape)[some_rows, some_columns]

    x, y, dx, dy = (pick(a) for a in (*rays.origin[:2], *rays.direction[:2]))
    drop, level, first = -pick(dz), pick(height), pick(t)
    high, low = (level - street.kerb) / drop, level / drop
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


def pixel_directions(camera: Camera) -> tuple[Float32, Float32, NDArray[np.bool_]]:
    """Directions (x/z, y/z) through the pixel centres, each (H, W), and whether the lens sees that pixel (H, W).

    A pixel's centre is at integer coordinates, as in Camera.project. Where a distortion polynomial has no inverse the
    lens sees nothing, as in the black corners of real wide-angle images.
    """
    x, y = np.zeros((2, camera.height, camera.width), np.float32)
    seen = np.zeros(x.shape, bool)
    step = max(1, BLOCK_PIXELS // camera.width)
    for rows in (slice(first, min(first + step, camera.height)) for first in range(0, camera.height, step)):
        pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(rows.start, rows.stop)), axis=-1)
        rays = camera.unproject(pixels).reshape((*pixels.shape[:2], 3))
        seen[rows] = rays[..., 2] > SHALLOWEST
        for k, out in enumerate((x, y)):
            out[rows] = np.divide(rays[..., k], rays[..., 2], where=seen[rows], out=np.zeros(seen[rows].shape))
    return x, y, seen


def turned(M: Float32, directions: Vectors) -> Vectors:
    """Directions, x, y and z parts, of a camera with attitudes M (..., 3, 3) in the world."""
    x, y, z = directions
    return tuple(M[..., k, 0] * x + M[..., k, 1] * y + M[..., k, 2] * z for k in range(3))


def changes(key: NDArray[Any]) -> NDArray[np.bool_]:
    """Pixels (H, W) with another key beside, above or below them."""
    out = np.zeros(key.shape, bool)
    for a, b in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        differs = key[a] != key[b]
        out[a] |= differs
        out[b] |= differs
    return out


def nearest_first(window: Ints, nearest: Floats) -> Jobs:
    order = np.argsort(nearest, kind="stable")
    return Jobs(window[order], nearest[order])


@dataclass(frozen=True, eq=False)
class RowMotion:
    """Poses of a camera with a rolling shutter, one per row: R (rows, 3, 3) world from camera, origin (rows, 3) m relative to the
    lens at the middle row; shift (m) and turn (rad): how far they are from the middle at most."""

    R: Float32
    origin: Float32
    shift: float
    turn: float


def row_motion(T_world_camera: Floats, twist: Floats, readout: float, rows: int) -> RowMotion | None:
    """Poses of the rows of a picture that is read within `readout` s, by a camera at T_world_camera (4, 4) at its middle row that
    moves with a twist (6,) in its own frame; None if they are all the same."""
    if readout == 0 or not twist.any():
        return None
    time = ((np.arange(rows) + 0.5) / rows - 0.5) * readout
    poses = T_world_camera @ se3.exp_many(time[:, None] * twist)
    origin = poses[:, :3, 3] - T_world_camera[:3, 3]
    shift, turn = float(np.linalg.norm(origin, axis=1).max()), float(np.linalg.norm(twist[:3])) * readout / 2
    return RowMotion(poses[:, :3, :3].astype(np.float32), origin.astype(np.float32), shift, turn)


class CameraView:
    """All pixels of a camera. Coordinates of solids and rays are world axes with the origin at the lens.

    x, y, z: directions (H, W); z is 1 but in wide.py.
    """

    def __init__(self, camera: Camera) -> None:
        self.x, self.y, self.seen = pixel_directions(camera)
        # Change of the direction per pixel down (0) and to the right (1), for rays between the pixels' centres.
        self.dx, self.dy = np.gradient(self.x), np.gradient(self.y)
        self.z: Float32 = np.broadcast_to(np.float32(1), self.x.shape)
        self.dz: Any = (np.broadcast_to(np.float32(0), self.x.shape),) * 2
        self.K = camera.K
        self._columns = self._limits(self.x, 0)
        self._rows = self._limits(self.y, 1)
        self._smallest = SMALLEST / max(camera.K[0, 0], camera.K[1, 1])

    def _limits(self, a: Float32, axis: int) -> tuple[Floats, Floats]:
        """Lowest and highest direction in each column (axis 0) or row (axis 1) of the seen pixels."""
        low = np.where(self.seen, a, np.inf).min(axis=axis)
        high = np.where(self.seen, a, -np.inf).max(axis=axis)
        return low.astype(float), high.astype(float)

    def rays(self, R_world_camera: Floats, motion: RowMotion | None = None) -> Rays:
        """The rays with their depth as distance: directions have z = 1 in the camera. motion: instead of one attitude."""
        return self._rays(R_world_camera, motion, np.s_[:, None], (self.x, self.y, self.z))

    def _rays(self, R: Floats, motion: RowMotion | None, rows: Any, directions: Vectors) -> Rays:
        if motion is None:
            return Rays(ORIGIN, turned(R.astype(np.float32), directions))
        x, y, z = (motion.origin[rows][..., k] for k in range(3))
        return Rays((x, y, z), turned(motion.R[rows], directions))

    def between(self, pixels: NDArray[np.intp], samples: Floats, R_world_camera: Floats, motion: RowMotion | None = None) -> Rays:
        """Rays (s, n) through flat pixels (n,) at s offsets (down, right) in pixels from their centres, samples (s, 2)."""
        at = np.divmod(pixels, self.x.shape[1])
        x, y, z = (
            np.stack([a[at] + u * step[1][at] + v * step[0][at] for u, v in samples]).astype(np.float32)
            for a, step in ((self.x, self.dx), (self.y, self.dy), (self.z, self.dz))
        )
        return self._rays(R_world_camera, motion, at[0][None], (x, y, z))

    def pixels(self, points: Vectors) -> Float32:
        """Where points (x, y, z parts of any shape) in the camera's frame are in the picture, for blur: the lens taken as a
        pinhole -> (..., 2) px."""
        x, y, z = points
        depth = np.maximum(z, np.float32(0.2))
        return np.stack([np.float32(self.K[0, 0]) * x / depth, np.float32(self.K[1, 1]) * y / depth], axis=-1)

    def jobs(self, solids: Solids, R_world_camera: Floats, motion: RowMotion | None = None) -> Jobs:
        """Windows for `cast`."""
        if motion is not None:
            solids = replace(solids, half=solids.half + motion.shift)
        corners = solids.corners() @ R_world_camera
        edges = np.array([(a, a | 1 << b) for a in range(8) for b in range(3) if not a >> b & 1])
        p, q = corners[:, edges[:, 0]], corners[:, edges[:, 1]]
        depth = q[..., 2] - p[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            cut = p + (q - p) * ((NEAR - p[..., 2]) / depth)[..., None]
            crosses = (p[..., 2] < NEAR) != (q[..., 2] < NEAR)
            points = np.concatenate([corners, cut], axis=1)
            valid = np.concatenate([corners[..., 2] >= NEAR, crosses], axis=1)
            low = [np.where(valid, points[..., k] / points[..., 2], np.inf).min(axis=1) for k in (0, 1)]
            high = [np.where(valid, points[..., k] / points[..., 2], -np.inf).max(axis=1) for k in (0, 1)]
        if motion is not None:
            # A turn moves a direction x / z by at most turn (1 + x^2), and a little more beside the middle.
            with np.errstate(invalid="ignore"):  # infinite where nothing of a solid is ahead
                low = [a - 1.5 * motion.turn * (1 + a * a) for a in low]
                high = [a + 1.5 * motion.turn * (1 + a * a) for a in high]
        keep = valid.any(axis=1) & (high[0] - low[0] > self._smallest) & (high[1] - low[1] > self._smallest)
        spans = []
        for (first, last), lo, hi in ((self._rows, low[1], high[1]), (self._columns, low[0], high[0])):
            inside = (last >= lo[:, None]) & (first <= hi[:, None])
            spans += [inside.argmax(axis=1), inside.shape[1] - inside[:, ::-1].argmax(axis=1)]
            keep &= inside.any(axis=1)
        nearest = np.where(valid, points[..., 2], np.inf).min(axis=1)
        jobs = np.stack([np.arange(len(solids)), *spans], axis=1).astype(np.int32)[keep]
        return nearest_first(jobs, nearest[keep])
