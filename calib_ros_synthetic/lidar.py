"""The LiDARs of the synthetic street: spinning scanners, and one without rings whose beam draws a rosette by two prisms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from calib_ros import se3
from calib_ros.frame import PointCloud
from calib_ros_synthetic.materials import Part
from calib_ros_synthetic.rays import OWN, SKY, Ints, Jobs, Rays, cast, cast_ground, nearest_first
from calib_ros_synthetic.solids import Float32, Floats, Solids
from calib_ros_synthetic.street import Street
from calib_ros_synthetic.surfaces import spots
from calib_ros_synthetic.windows import lidar_jobs

POINTS = 24_000  # per scan
FIELD = float(np.deg2rad(80.0))  # diameter of the field of view, rad
TURNS = 121.567, -77.731  # of the two prisms per second; no common period within a drive
PERIOD = 0.1  # s per turn
RANGE_NOISE = 0.02  # m
RANGE_LIMITS = 0.9, 100.0  # m
WEAKEST = 1.2e-5  # reflectivity / m^2 of the weakest return that is noticed
DROPPED = 0.004  # share of returns that are lost for no reason
MIXED = 0.15  # share of returns at an edge that fall between foreground and background
MIXED_STEP = 2.0  # m; across larger steps the two echoes are told apart
ROSETTE = 0  # instead of a number of rings: a scanner without any
# Rings from the top, in degrees, and firings per turn, after the OS1-128, HDL-64E, HDL-32E and VLP-16; at last, points per scan.
MODELS: dict[int, tuple[Floats, int]] = {
    128: (np.linspace(22.5, -22.5, 128), 1024),
    64: (np.r_[np.linspace(2.0, -8.33, 32), np.linspace(-8.83, -24.8, 32)], 2083),
    32: (np.linspace(10.0, -30.0, 32), 2170),
    16: (np.linspace(15.0, -15.0, 16), 1800),
    ROSETTE: (np.empty(0), POINTS),
}
# Diffuse reflectivity near 905 nm where it is not the mean of the albedo; above 1: retro-reflective.
REFLECTIVITY: dict[Part, float] = {
    Part.ASPHALT: 0.17, Part.PATCH: 0.12, Part.MARKING: 0.75, Part.SLAB: 0.30, Part.JOINT: 0.25, Part.GRASS: 0.42,
    Part.STONE: 0.35, Part.WINDOW: 0.05, Part.FRAME: 0.45, Part.DOOR: 0.25, Part.TILES: 0.3, Part.GLASS: 0.04,
    Part.RUBBER: 0.06, Part.RIM: 0.4, Part.LAMP: 1.2, Part.BARK: 0.3, Part.LEAF: 0.5, Part.CLOTH: 0.4, Part.SKIN: 0.5,
    Part.HAIR: 0.2, Part.METAL: 0.35, Part.BOARD: 3.0, Part.SYMBOL: 3.0, Part.SLAT: 0.35, Part.GRAVEL: 0.28, Part.CONCRETE: 0.35,
    Part.LINE: 0.6,
}  # fmt: skip
_KNOWN = np.array([REFLECTIVITY.get(p, np.nan) for p in Part], np.float32)


class Pattern(Protocol):
    """What `scan` asks of a scanner. Rays are in a grid of rows x columns; without rings, in one row by azimuth."""

    @property
    def noise(self) -> float:
        """Standard deviation of the range, m."""

    @property
    def limits(self) -> tuple[float, float]:
        """Shortest and longest range, m."""

    @property
    def weakest(self) -> float:
        """Reflectivity / m^2 of the weakest return that is noticed."""

    def beams(self) -> tuple[Float32, Floats]:
        """Unit vectors (3, rows, columns) in the LiDAR frame, and their times, of each column (columns,) or ray, s."""

    def order(self, time: Floats) -> NDArray[np.intp]:
        """The columns in the order in which points of a row are stored."""

    def stored(self, row: NDArray[np.intp], time: Float32) -> NDArray[np.intp] | None:
        """The order (n,) of points that lie in the rows row (n,) and were measured at time (n,); None = row by row."""

    def ring(self, row: NDArray[np.intp]) -> NDArray[np.int32] | None:
        """Ring numbers of rows (n,); None = no rings."""

    def jobs(self, solids: Solids, beams: Float32, pose: Floats, shift: float, turn: float) -> Jobs:
        """Windows for `cast`. pose: as in `scan`. shift (m), turn (rad): how far the scanner moves from its pose."""

    def describe(self) -> str:
        """For people."""


@dataclass(frozen=True, eq=False)
class Scanner:
    """Firing directions of a model with `rings` rings. number: of the scan, for the pattern that never repeats.

    With rings, the head turns clockwise seen from above, once per PERIOD, and faces +x at time 0. Columns here run against
    the time, with azimuth rising from -pi to pi, so that a column's azimuth is -2 pi time / PERIOD.
    """

    rings: int
    number: int = 0
    noise: ClassVar[float] = RANGE_NOISE
    limits: ClassVar[tuple[float, float]] = RANGE_LIMITS
    weakest: ClassVar[float] = WEAKEST

    def describe(self) -> str:
        """For people."""
        if self.rings == ROSETTE:
            return f"no rings, {POINTS} points per scan of {PERIOD:g} s in a rosette {np.rad2deg(FIELD):g} deg wide"
        return f"{self.rings} rings, {MODELS[self.rings][1]} firings per turn of {PERIOD:g} s"

    @property
    def elevation(self) -> Floats:
        """(rings,) rad from the top ring down."""
        return np.deg2rad(MODELS[self.rings][0])

    @property
    def azimuth(self) -> Floats:
        """(firings,) rad, rising."""
        n = MODELS[self.rings][1]
        return (np.arange(n, dtype=float) + 0.5) * (2 * np.pi / n) - np.pi

    def beams(self) -> tuple[Float32, Floats]:
        """(3, rings, firings) unit vectors in the LiDAR frame, columns by azimuth, and the time of each column (firings,) s."""
        if self.rings == ROSETTE:
            time = ((np.arange(POINTS) + 0.5) / POINTS - 0.5) * PERIOD
            azimuth, elevation = rosette(time + (self.number + 0.5) * PERIOD)
            order = np.argsort(azimuth, kind="stable")
            return directions(azimuth[order], elevation[order]), time[order]
        return self.directions(), -self.azimuth * (PERIOD / (2 * np.pi))

    def order(self, time: Floats) -> NDArray[np.intp]:
        """The columns in the order in which their points are stored."""
        if self.rings == ROSETTE:
            return np.argsort(time, kind="stable")
        return np.roll(np.arange(len(time)), -int(np.searchsorted(self.azimuth, 0.0)))

    def stored(self, row: NDArray[np.intp], time: Float32) -> NDArray[np.intp] | None:
        """None: row by row."""
        return None

    def ring(self, row: NDArray[np.intp]) -> NDArray[np.int32] | None:
        """Rings are counted from the top."""
        return None if self.rings == ROSETTE else row.astype(np.int32)

    def jobs(self, solids: Solids, beams: Float32, pose: Floats, shift: float, turn: float) -> Jobs:
        """Windows for `cast`; see lidar_jobs. The head is nearly upright."""
        yaw = float(np.arctan2(pose[1, 0], pose[0, 0]))
        tilt = float(np.arccos(np.clip(pose[2, 2], -1, 1)))
        # A tilt of the head also turns its azimuth a little where beams are steep.
        margin = shift, turn + tilt, turn + 1.5 * tilt
        if self.rings == ROSETTE:
            return jobs(solids, np.arctan2(beams[1, 0], beams[0, 0]).astype(float), yaw, margin[:2])
        return lidar_jobs(solids, self.elevation, beams.shape[2], yaw, margin)

    def directions(self) -> Float32:
        """(3, rings, firings) unit vectors of a model with rings."""
        e, a = self.elevation[:, None], self.azimuth[None]
        return np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e) + 0 * a]).astype(np.float32)


def scan(
    street: Street,
    solids: Solids,
    scanner: Pattern,
    pose: Floats,
    twist: Floats,
    noise: float,
    rng: np.random.Generator,
    *,
    visibility: float = np.inf,
    own: OwnReturns | None = None,
    reverse: bool = False,
) -> tuple[PointCloud, NDArray[np.int32]]:
    """One scan -> the cloud, and what each point lies on (n,) as `cast` writes it, OWN for the own vehicle.

    solids: relative to the scanner's position at time 0, in world axes. pose: T_world_lidar (4, 4) at time 0. twist: (6,)
    rad/s and m/s in the LiDAR frame. The points stay in the frame of the moving scanner, each at its own time. They are
    sorted as the scanner stores them; those of `Scanner` as in KITTI's files: ring by ring from the top, in each ring with
    azimuth from 0 to 2 pi; without rings, by time. Returns that get lost are left out. Intensity is 0..1, with the distance
    compensated. visibility: m at which haze leaves 1/e of the light. own: returns of the own vehicle.
    reverse: the head turns the other way.
    """
    beams, time = scanner.beams()
    time = -time if reverse else time
    # 64 poses, a millisecond and a half apart, and straight lines between them: below 1e-7 rad and 1e-5 m from the exact screw.
    knots = np.linspace(time.min(), time.max(), 65)
    motion = np.array([(pose @ se3.exp(twist * s))[:3] for s in knots])
    motion[:, :, 3] -= pose[:3, 3]
    R, moved = (make_interp_spline(knots, m, k=1)(time) for m in (motion[:, :, :3], motion[:, :, 3]))
    turned = R.astype(np.float32)
    direction = tuple(sum(turned[..., k, j] * beams[j] for j in range(3)) for k in range(3))
    if moved.ndim == 2:
        moved = moved[None]
    rays = Rays(tuple(moved[..., k].astype(np.float32) for k in range(3)), direction)
    t = np.full(rays.shape, np.inf, np.float32)
    ids = np.full(rays.shape, SKY, np.int32)
    turn = float(np.linalg.norm(twist[:3])) * float(knots[-1])
    cast(rays, solids, scanner.jobs(solids, beams, pose, float(np.linalg.norm(moved, axis=-1).max()), turn), t, ids)
    cast_ground(rays, street, pose[:3, 3], t, ids)
    if own is not None:
        hidden = own.t < t
        t[hidden], ids[hidden] = own.t[hidden], OWN

    order = scanner.order(time)
    ring, column = np.nonzero((ids != SKY)[:, order])
    column_stored, column = column, order[column]
    at = (ring, column)
    part, rho, cosine = _surface(street, solids, rays, t, ids, at, pose[:3, 3])
    if own is not None:
        mine = np.flatnonzero(ids[at] == OWN)
        part[mine], rho[mine], cosine[mine] = (a[ring[mine], column[mine]] for a in (own.part, own.rho, own.cosine))
    pane = (part == Part.WINDOW) | (part == Part.GLASS)  # a mirror: little comes back unless hit squarely
    lobe = np.where(pane, 0.05 + 0.95 * cosine**6, 0.15 + 0.85 * cosine)
    shine = rho * np.where(part == Part.LEAF, np.float32(0.7), lobe)

    distance = t[at].copy()
    power = shine / np.square(distance)
    if np.isfinite(visibility):
        power *= np.exp(distance * np.float32(-2 / visibility))
    keep = (distance > scanner.limits[0]) & (distance < scanner.limits[1])
    intensity = np.clip(shine, 0, 1)
    if noise > 0:
        power *= np.exp(np.float32(0.3 * min(noise, 2)) * rng.standard_normal(len(power), np.float32))
        keep &= rng.random(len(power), np.float32) >= DROPPED * noise
        distance += _scatter(t[:, order], (ring, column_stored), part, scanner.noise * noise, noise, rng)
        intensity = np.clip(intensity + np.float32(0.02 * noise) * rng.standard_normal(len(power), np.float32), 0, 1)
    keep &= power > scanner.weakest
    points = (beams[:, ring, column] * distance).T
    times = (time[column] if time.ndim == 1 else time[at]).astype(np.float32)
    cloud = PointCloud(points, intensity.astype(np.float32), scanner.ring(ring), times)
    stored = scanner.stored(ring, times)
    select = np.flatnonzero(keep) if stored is None else stored[keep[stored]]
    return cloud.select(select), ids[at][select]


def _surface(
    street: Street,
    solids: Solids,
    rays: Rays,
    t: Float32,
    ids: Ints,
    at: tuple[NDArray[np.intp], NDArray[np.intp]],
    origin: Floats,
) -> tuple[NDArray[np.uint8], Float32, Float32]:
    """Material, reflectivity and cosine of the incidence, each (n,), of the rays at the rows and columns `at`."""
    what = ids[at]
    xyz = np.stack([np.broadcast_to(o, t.shape)[at] + t[at] * d[at] for o, d in zip(rays.origin, rays.direction, strict=True)])
    here = spots(street, solids, what, xyz, origin)
    cosine = np.abs(sum(here.normal[k] * rays.direction[k][at] for k in range(3)))
    rho = _KNOWN[here.part]
    plain = np.flatnonzero(np.isnan(rho) & (what >= 0))
    rho[plain] = 0.1 + 0.9 * solids.colour[what[plain]].mean(axis=1)
    return here.part, rho, np.asarray(cosine, np.float32)


def own_returns(solids: Solids, beams: Float32, T_base_lidar: Floats) -> OwnReturns:
    """What rays (3, rows, columns) of a scanner at T_base_lidar (4, 4) meet of its vehicle, the solids in the vehicle's frame."""
    R = T_base_lidar[:3, :3].astype(np.float32)
    direction = tuple(sum(R[k, j] * beams[j] for j in range(3)) for k in range(3))
    zero = np.zeros((1, 1), np.float32)
    rays = Rays((zero, zero, zero), direction)
    around = solids.moved(-T_base_lidar[:3, 3])
    t = np.full(rays.shape, np.inf, np.float32)
    ids = np.full(rays.shape, SKY, np.int32)
    rows, columns = rays.shape
    n = len(solids)
    whole = np.stack([np.arange(n), np.zeros(n), np.full(n, rows), np.zeros(n), np.full(n, columns)], 1).astype(np.int32)
    cast(rays, around, Jobs(whole, np.zeros(n)), t, ids)
    at = np.nonzero(ids != SKY)
    out = OwnReturns(t, np.zeros(t.shape, np.uint8), np.zeros(t.shape, np.float32), np.zeros(t.shape, np.float32))
    xyz = np.stack([t[at] * d[at] for d in direction])
    here = spots(None, around, ids[at], xyz, T_base_lidar[:3, 3])
    rho = _KNOWN[here.part]
    plain = np.flatnonzero(np.isnan(rho))
    rho[plain] = 0.1 + 0.9 * around.colour[ids[at][plain]].mean(axis=1)
    out.part[at], out.rho[at] = here.part, rho
    out.cosine[at] = np.abs(sum(here.normal[k] * direction[k][at] for k in range(3)))
    return out


@dataclass(frozen=True, eq=False)
class OwnReturns:
    """Rays that meet the own vehicle: distance t (rows, columns) m, inf for the others; material, reflectivity, cosine."""

    t: Float32
    part: NDArray[np.uint8]
    rho: Float32
    cosine: Float32


def _scatter(
    t: Float32,
    at: tuple[NDArray[np.intp], NDArray[np.intp]],
    part: NDArray[np.uint8],
    clock: float,
    noise: float,
    rng: np.random.Generator,
) -> Float32:
    """Errors of the range (n,): noise of the clock (m), echoes from within foliage, and beams that hit two things at an edge."""
    n = len(part)
    error = np.float32(clock) * rng.standard_normal(n, np.float32)
    depth = np.float32(0.15 * noise) * np.abs(rng.standard_normal(n, np.float32))
    error += np.where(part == Part.LEAF, np.minimum(depth, 0.5), 0)
    for side in (-1, 1):
        beside = np.roll(t, side, axis=1)[at] - t[at]
        split = (rng.random(n, np.float32) < min(MIXED * noise, 1)) & (beside > 0.2) & (beside < MIXED_STEP)
        error[split] += rng.random(int(split.sum()), np.float32) * beside[split]
    return np.asarray(error, np.float32)


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
