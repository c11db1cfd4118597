"""The own vehicle: what of it the camera sees at the edge of the picture, and what of it the scanner hits.

It is rigid with both sensors. Its shapes are given in the vehicle's frame (x forward, y left, z up, origin on the ground below
its middle) and cast there once for all frames.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calib_ros.frame import SemanticClass as Label
from calib_ros_synthetic import surfaces
from calib_ros_synthetic.rays import SAMPLES, SKY, CameraView, Ints, Jobs, cast, changes, unmet
from calib_ros_synthetic.solids import Builder, Float32, Floats, Solids, Surface
from calib_ros_synthetic.surfaces import Lighting

SILVER, WHITE, BLACK = (0.42, 0.42, 0.42), (0.66, 0.66, 0.66), (0.04, 0.04, 0.04)


def _car(b: Builder) -> None:
    """A tall car of 4.7 m: bonnet 1 m high, roof 1.62 m high from 1.9 m behind to 0.5 m before the middle, with rails."""
    V, style = Label.VEHICLE, (0.5, 0.5, 0.5, 0.5)
    b.frustum(V, (0, 0, 0.6), (2.35, 0.93, 0.38), SILVER, Surface.BODY, taper=(0.03, 0.05), style=style)
    b.frustum(V, (1.55, 0, 0.99), (0.72, 0.80, 0.035), SILVER, taper=(0.10, 0.12))
    b.frustum(V, (-0.65, 0, 1.29), (1.55, 0.88, 0.33), SILVER, Surface.CABIN, taper=(0.26, 0.20), style=style)
    for y in (-0.62, 0.62):
        b.box(V, (-0.65, y, 1.66), (1.0, 0.03, 0.04), BLACK, Surface.METAL)
        b.ellipsoid(V, (0.75, y * 1.62, 1.08), (0.09, 0.13, 0.09), SILVER)


def _truck(b: Builder) -> None:
    """The cab of a truck, 3 m high, its front 1.5 m before the middle, with mirrors on arms."""
    V, style = Label.VEHICLE, (0.5, 0.5, 0.5, 0.5)
    b.box(V, (0.4, 0, 0.85), (1.1, 1.22, 0.45), WHITE, Surface.BODY, style=style)
    b.frustum(V, (0.35, 0, 2.15), (1.1, 1.22, 0.85), WHITE, Surface.CABIN, taper=(0.08, 0.05), style=style)
    b.box(V, (-6.0, 0, 2.4), (4.8, 1.25, 1.5), WHITE, Surface.POSTER, style=style)
    for y in (-1.45, 1.45):
        b.box(V, (1.25, y, 2.0), (0.08, 0.13, 0.28), BLACK)


def _robot(b: Builder) -> None:
    """A wheeled platform 0.7 m long and 0.35 m high with a mast."""
    other = Label.OTHER
    b.box(other, (0, 0, 0.22), (0.36, 0.27, 0.13), BLACK)
    b.box(other, (0, 0, 0.36), (0.34, 0.25, 0.012), SILVER, Surface.METAL)
    for x in (-0.28, 0.28):
        for y in (-0.16, 0.16):
            b.cylinder(other, (x, y, 0.42), (0.02, 0.02, 0.05), SILVER, Surface.METAL)


def _forklift(b: Builder) -> None:
    """An automated forklift: its mast before the sensors, and a protective roof."""
    other = Label.OTHER
    b.box(other, (-0.6, 0, 0.75), (0.8, 0.5, 0.6), (0.05, 0.45, 0.68))
    for y in (-0.42, 0.42):
        b.box(other, (0.55, y, 1.3), (0.06, 0.05, 1.2), BLACK, Surface.METAL)
        b.box(other, (1.2, y * 0.8, 0.12), (0.55, 0.06, 0.03), BLACK, Surface.METAL)


BODIES: dict[str, Callable[[Builder], None]] = {"car": _car, "truck": _truck, "robot": _robot, "forklift": _forklift}


def body(name: str) -> Solids | None:
    """The solids of an own vehicle in its frame; None for "" (it is nowhere near the sensors' views, or there is none)."""
    if not name:
        return None
    b = Builder()
    BODIES[name](b)
    return b.solids()


@dataclass(frozen=True, eq=False)
class OwnLayer:
    """What a camera sees of its vehicle.

    pixels: (m,) flat indices. cover: (m,) share of each. ray: (k,) index of the pixel that a ray belongs to. weight: (k,) share
    of the ray in its pixel. directions: (3, k) in the vehicle's frame. t, ids: (k,) as `cast` writes them. solids: from the
    lens.
    """

    pixels: Ints
    cover: Float32
    ray: Ints
    weight: Float32
    directions: Float32
    t: Float32
    ids: Ints
    solids: Solids

    def colour(self, sun: Floats, lighting: Lighting, height: float) -> Float32:
        """Grey levels (3, m). sun: in the vehicle's frame. height: of the lens, m."""
        xyz = self.directions * self.t
        here = surfaces.spots(None, self.solids, self.ids, xyz, np.array([0.0, 0.0, height]))
        lit = np.ones(len(self.ids), np.float32)
        light = surfaces.light(self.solids, self.ids, xyz, here, lit, sun, lighting, None)
        grey = surfaces.display(light * np.float32(lighting.exposure))
        out = np.stack([np.bincount(self.ray, self.weight * g, len(self.pixels)) for g in grey])
        return np.asarray(out, np.float32)


def own_layer(solids: Solids, view: CameraView, T_base_camera: Floats) -> OwnLayer | None:
    """The layer of a camera at T_base_camera (4, 4) on its vehicle; None if it does not see any of it."""
    around = solids.moved(-T_base_camera[:3, 3])
    R = T_base_camera[:3, :3]
    rays = view.rays(R)
    jobs = view.jobs(around, R)
    if not len(jobs.window):
        return None
    t, ids = unmet(rays.shape)
    cast(rays, around, jobs, t, ids)
    hit = (ids != SKY) & view.seen
    border = changes(hit) & view.seen
    if not (hit | border).any():
        return None
    inner = np.flatnonzero(hit & ~border)
    outline = np.flatnonzero(border)
    fine = view.between(outline, SAMPLES, R)
    ft, fids = unmet(fine.shape)
    cast(fine, around, Jobs.whole(len(around), fine.shape), ft, fids)
    met = fids != SKY
    cover = met.mean(axis=0)
    some = np.flatnonzero(cover > 0)
    sample, which = np.nonzero(met[:, some])
    number = len(inner) + np.arange(len(some))
    fine_ray = np.stack([d[sample, some[which]] for d in fine.direction])
    whole_ray = np.stack([np.broadcast_to(d, rays.shape).ravel()[inner] for d in rays.direction])
    return OwnLayer(
        np.r_[inner, outline[some]].astype(np.int32),
        np.r_[np.ones(len(inner)), cover[some]].astype(np.float32),
        np.r_[np.arange(len(inner)), number[which]].astype(np.int32),
        np.r_[np.ones(len(inner)), 1 / met[:, some].sum(axis=0)[which]].astype(np.float32),
        np.concatenate([whole_ray, fine_ray], axis=1),
        np.r_[t.ravel()[inner], ft[sample, some[which]]],
        np.r_[ids.ravel()[inner], fids[sample, some[which]]],
        around,
    )
