"""Renders the camera image of the synthetic street, with sub-pixel exact silhouettes."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.datasets.street import shading
from calib_ros.datasets.street.blocks import Street
from calib_ros.datasets.street.parts import Part
from calib_ros.datasets.street.rays import SKY, Rays, cast, cast_ground, intersect
from calib_ros.datasets.street.shadows import Shadows
from calib_ros.datasets.street.solids import Float32, Floats, Solids
from calib_ros.datasets.street.surface import spots
from calib_ros.datasets.street.views import CameraView, towards

Ids = NDArray[np.int32]

# Sub-pixel rays, in pixels from the centre. Symmetric about it, so that averaging moves no edge.
SAMPLES = np.array([(-0.125, -0.375), (0.375, -0.125), (-0.375, 0.125), (0.125, 0.375)])
BLUR = 0.5  # px, standard deviation of the lens and the sensor
READ_NOISE = 1.8  # grey levels


@dataclass(frozen=True, eq=False)
class Scene:
    """What the camera looks at. solids: relative to the lens. origin: of the lens in the world (3,). R: world from camera."""

    street: Street
    solids: Solids
    origin: Floats
    R: Floats


def render(scene: Scene, view: CameraView, noise: float, rng: np.random.Generator) -> tuple[NDArray[np.uint8], Ids]:
    """-> image (H, W, 3) BGR, and what each pixel's centre sees (H, W) as `cast` writes it."""
    rays = view.rays(scene.R)
    t = np.full(rays.shape, np.inf, np.float32)
    ids = np.full(rays.shape, SKY, np.int32)
    cast(rays, scene.solids, view.jobs(scene.solids, scene.R), t, ids)
    cast_ground(rays, scene.street, scene.origin, t, ids)
    shadows = Shadows(scene.solids, scene.street.sun, scene.R[:, 2], float(scene.origin[2]))
    directions = np.stack([d.ravel() for d in rays.direction])
    colour, part = _shade(scene, shadows, directions, t.ravel(), ids.ravel())
    # Clumps of one crown grow through each other; only the crown's outline is a silhouette.
    part = part.reshape(ids.shape)
    key = np.where(part == Part.LEAF, SKY - 100, ids * 64 + part)
    edge = np.flatnonzero(_borders(key))
    colour[:, edge] = _antialias(scene, shadows, view, ids, edge)
    image = np.ascontiguousarray(colour.reshape(3, *ids.shape).transpose(1, 2, 0))
    image[~view.seen] = 0
    image = cv2.GaussianBlur(image, (0, 0), BLUR)
    if noise > 0:
        image += np.float32(READ_NOISE * noise) * rng.standard_normal(image.shape, np.float32)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8), np.where(view.seen, ids, SKY)


def _shade(scene: Scene, shadows: Shadows, directions: Float32, t: Float32, ids: Ids) -> tuple[Float32, NDArray[np.uint8]]:
    """Grey levels (3, n) and materials (n,) of rays: directions (3, n), distances t (n,), ids (n,)."""
    colour = np.empty((3, len(ids)), np.float32)
    part = np.zeros(len(ids), np.uint8)
    free = np.flatnonzero(ids == SKY)
    colour[:, free] = shading.sky(directions[:, free], scene.street.seed)
    hit = np.flatnonzero(ids != SKY)
    xyz, what = directions[:, hit] * t[hit], ids[hit]
    here = spots(scene.street, scene.solids, what, xyz, scene.origin)
    sun = scene.street.sun.tolist()
    facing = here.normal[0] * sun[0] + here.normal[1] * sun[1] + here.normal[2] * sun[2] > 0
    lit = shadows.lit(xyz, what, facing)
    colour[:, hit] = shading.light(scene.solids, what, xyz, here, lit, scene.street.sun, scene.street.seed)
    part[hit] = here.part
    return shading.display(colour), part


def _borders(key: Ids) -> NDArray[np.bool_]:
    """Pixels (H, W) with another key beside, above or below them."""
    out = np.zeros(key.shape, bool)
    for a, b in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        differs = key[a] != key[b]
        out[a] |= differs
        out[b] |= differs
    return out


def _antialias(scene: Scene, shadows: Shadows, view: CameraView, ids: Ids, edge: NDArray[np.intp]) -> Float32:
    """Mean grey level (3, n) of the sub-pixel rays of the pixels with flat indices edge (n,).

    Only solids that a pixel or one of its eight neighbours sees are tried. Levels are averaged after the gamma: averaged
    light would push every border a tenth of a pixel towards its dark side.
    """
    rows, columns = np.divmod(edge, ids.shape[1])
    at = (rows, columns)
    x, y = (
        np.stack([a[at] + u * step[1][at] + v * step[0][at] for u, v in SAMPLES]).astype(np.float32)
        for a, step in ((view.x, view.dx), (view.y, view.dy))
    )
    zero = np.zeros((1, 1), np.float32)
    rays = Rays((zero, zero, zero), towards(scene.R, x, y))
    t = np.full(x.shape, np.inf, np.float32)
    found = np.full(x.shape, SKY, np.int32)

    padded = np.pad(ids, 1, mode="edge")
    around: list[Ids] = []
    pixels, candidates = [], []
    for j in range(3):
        for i in range(3):
            seen = padded[rows + j, columns + i]
            new = seen >= 0
            for earlier in around:
                new &= seen != earlier
            around.append(seen)
            pixels.append(np.flatnonzero(new))
            candidates.append(seen[pixels[-1]])
    pixel, candidate = np.concatenate(pixels), np.concatenate(candidates)
    order = np.argsort(candidate, kind="stable")
    pixel, candidate = pixel[order], candidate[order]
    for group in np.split(np.arange(len(pixel)), np.flatnonzero(np.diff(candidate)) + 1):
        if len(group):
            which, i = pixel[group], int(candidate[group[0]])
            some = Rays(rays.origin, tuple(d[:, which] for d in rays.direction))  # type: ignore[arg-type]
            new_t, old_t, old = intersect(scene.solids, i, some), t[:, which], found[:, which]
            hit = new_t < old_t
            t[:, which], found[:, which] = np.where(hit, new_t, old_t), np.where(hit, np.int32(i), old)
    cast_ground(rays, scene.street, scene.origin, t, found)
    directions = np.stack([d.ravel() for d in rays.direction])
    colour, _ = _shade(scene, shadows, directions, t.ravel(), found.ravel())
    return np.asarray(colour.reshape(3, *x.shape).mean(axis=1))
