"""Scans of the synthetic street: what comes back to a scanner's beams, with noise, losses and the distortion of motion, as
drivers and data sets hand it out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from calib_ros import se3
from calib_ros.frame import PointCloud
from calib_ros_synthetic.materials import REFLECTIVITY, Bytes, Part
from calib_ros_synthetic.rays import ORIGIN, OWN, SKY, Ints, Jobs, Rays, cast, cast_ground, unmet
from calib_ros_synthetic.rigs import BYTE, FIELDS, SIGNAL, WIDE, Rig
from calib_ros_synthetic.scanners import SpinningScanner
from calib_ros_synthetic.solids import Float32, Floats, Solids
from calib_ros_synthetic.street import Street
from calib_ros_synthetic.surfaces import spots

At = tuple[NDArray[np.intp], ...]  # rows and columns
OwnReturns = tuple[Float32, Bytes, Float32, Float32]  # see own_returns
DROPPED = 0.004  # share of returns that are lost for no reason
MIXED = 0.15  # share of returns at an edge that fall between foreground and background
PHOTONS, BRIGHTEST = 2000.0, 70_000.0  # from a white wall 10 m away; of a retro-reflector, where intensity is WIDE
MIXED_STEP = 2.0  # m; across larger steps the two echoes are told apart


def scan(
    street: Street,
    solids: Solids,
    scanner: SpinningScanner,
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
    sorted as the scanner stores them; those of a plain one as in KITTI's files: ring by ring from the top, in each ring with
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
    t, ids = unmet(rays.shape)
    turn = float(np.linalg.norm(twist[:3])) * float(knots[-1])
    cast(rays, solids, scanner.jobs(solids, beams, pose, float(np.linalg.norm(moved, axis=-1).max()), turn), t, ids)
    cast_ground(rays, street, pose[:3, 3], t, ids)
    if own is not None:
        hidden = own[0] < t
        t[hidden], ids[hidden] = own[0][hidden], OWN

    order = scanner.order(time)
    ring, column = np.nonzero((ids != SKY)[:, order])
    column_stored, column = column, order[column]
    at = (ring, column)
    part, rho, cosine = _surface(street, solids, rays, t, ids, at, pose[:3, 3])
    if own is not None:
        mine = np.flatnonzero(ids[at] == OWN)
        part[mine], rho[mine], cosine[mine] = (a[ring[mine], column[mine]] for a in own[1:])
    pane = (part == Part.WINDOW) | (part == Part.GLASS)  # a mirror: little comes back unless hit squarely
    lobe = np.where(pane, 0.05 + 0.95 * cosine**6, 0.15 + 0.85 * cosine)
    shine = rho * np.where(part == Part.LEAF, np.float32(0.7), lobe)

    distance = t[at].copy()
    power = shine / np.square(distance)
    if np.isfinite(visibility):
        power *= np.exp(distance * np.float32(-2 / visibility))
    keep = (distance > scanner.model.near) & (distance < scanner.model.far)
    intensity = np.clip(shine, 0, 1)
    if noise > 0:
        power *= np.exp(np.float32(0.3 * min(noise, 2)) * rng.standard_normal(len(power), np.float32))
        keep &= rng.random(len(power), np.float32) >= DROPPED * noise
        distance += _scatter(t[:, order], (ring, column_stored), part, scanner.model.noise * noise, noise, rng)
        intensity = np.clip(intensity + np.float32(0.02 * noise) * rng.standard_normal(len(power), np.float32), 0, 1)
    keep &= power > scanner.model.weakest
    points = (beams[:, ring, column] * distance).T
    times = (time[column] if time.ndim == 1 else time[at]).astype(np.float32)
    cloud = PointCloud(points, intensity.astype(np.float32), scanner.ring(ring), times)
    stored = scanner.stored(ring, times)
    select = np.flatnonzero(keep) if stored is None else stored[keep[stored]]
    return cloud.select(select), ids[at][select]


def _surface(
    street: Street | None, solids: Solids, rays: Rays, t: Float32, ids: Ints, at: At, origin: Floats
) -> tuple[Bytes, Float32, Float32]:
    """Material, reflectivity and cosine of the incidence, each (n,), of the rays at the rows and columns `at`."""
    what = ids[at]
    xyz = np.stack([np.broadcast_to(o, t.shape)[at] + t[at] * d[at] for o, d in zip(rays.origin, rays.direction, strict=True)])
    here = spots(street, solids, what, xyz, origin)
    cosine = np.abs(sum(here.normal[k] * rays.direction[k][at] for k in range(3)))
    rho = REFLECTIVITY[here.part]
    plain = np.flatnonzero(np.isnan(rho) & (what >= 0))
    rho[plain] = 0.1 + 0.9 * solids.colour[what[plain]].mean(axis=1)
    return here.part, rho, np.asarray(cosine, np.float32)


def own_returns(solids: Solids, beams: Float32, T_base_lidar: Floats) -> OwnReturns:
    """What rays (3, rows, columns) of a scanner at T_base_lidar (4, 4) meet of its vehicle, the solids in the vehicle's frame:
    distance (rows, columns) m, inf for those that do not; material, reflectivity, cosine of the incidence."""
    R = T_base_lidar[:3, :3].astype(np.float32)
    direction = tuple(sum(R[k, j] * beams[j] for j in range(3)) for k in range(3))
    rays = Rays(ORIGIN, direction)
    around = solids.moved(-T_base_lidar[:3, 3])
    t, ids = unmet(rays.shape)
    cast(rays, around, Jobs.whole(len(solids), rays.shape), t, ids)
    at = np.nonzero(ids != SKY)
    out = (np.zeros(t.shape, np.uint8), np.zeros(t.shape, np.float32), np.zeros(t.shape, np.float32))
    out[0][at], out[1][at], out[2][at] = _surface(None, around, rays, t, ids, at, T_base_lidar[:3, 3])
    return t, *out


def _scatter(t: Float32, at: At, part: Bytes, clock: float, noise: float, rng: np.random.Generator) -> Float32:
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


def delivered(
    rig: Rig, T_base_lidar: Floats, cloud: PointCloud, twist: Floats, fields: str, rng: np.random.Generator
) -> tuple[PointCloud, NDArray[np.intp]]:
    """A scan as the driver or the data set hands it out, and which of its points (n,) are left.

    cloud: in the frame of the moving scanner, which is at T_base_lidar (4, 4) on the vehicle; twist: (6,) of the scanner.
    """
    assert cloud.intensity is not None
    xyz, intensity = cloud.xyz.astype(float), cloud.intensity
    if rig.intensity == BYTE:
        intensity = np.rint(255 * intensity).astype(np.float32)
    elif rig.intensity == SIGNAL:
        photons = PHOTONS * 100.0 * intensity / np.maximum(np.square(cloud.xyz).sum(axis=1), 1.0)
        intensity = np.asarray(rng.poisson(np.minimum(photons, 60_000.0)), np.float32)
    elif rig.intensity == WIDE:
        bright = BRIGHTEST * rng.random(len(intensity)) ** 3
        intensity = np.asarray(np.where(intensity > 0.97, bright, intensity), np.float32)
    if rig.compensated and cloud.time is not None and twist.any() and len(xyz):  # to where they are at time 0
        time = cloud.time.astype(float)
        knots = np.linspace(time.min(), time.max(), 65)
        at = make_interp_spline(knots, np.array([se3.exp(twist * s)[:3] for s in knots]), k=1)(time)
        xyz = np.einsum("nij,nj->ni", at[:, :, :3], xyz) + at[:, :, 3]
    base = se3.transform(T_base_lidar, xyz)
    keep = np.flatnonzero(np.abs(base[:, 1]) <= rig.crop)
    left_out = ("time", "ring", "intensity")[: FIELDS.index(fields)]
    whole = replace(cloud, xyz=(base if rig.base_frame else xyz).astype(np.float32), intensity=intensity)
    return replace(whole, **dict.fromkeys(left_out)).select(keep), keep  # type: ignore[arg-type]
