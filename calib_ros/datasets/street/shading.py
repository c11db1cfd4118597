"""Colours of the synthetic street in the camera: materials, textures, sun and sky. Values are BGR."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_ros.datasets.street.noise import noise2
from calib_ros.datasets.street.parts import Part
from calib_ros.datasets.street.solids import Float32, Floats, Solids
from calib_ros.datasets.street.surface import Spots

# Material -> albedo (BGR; None: the solid's own colour), size of the texture's contrast, its grain per metre, gloss.
MATERIALS: dict[Part, tuple[tuple[float, float, float] | None, float, float, float]] = {
    Part.SKY: ((0.0, 0.0, 0.0), 0.0, 1, 0.0),
    Part.ASPHALT: ((0.125, 0.12, 0.115), 0.13, 45, 0.0),
    Part.PATCH: ((0.07, 0.068, 0.066), 0.10, 60, 0.0),
    Part.MARKING: ((0.60, 0.62, 0.62), 0.12, 25, 0.0),
    Part.SLAB: ((0.24, 0.26, 0.27), 0.08, 20, 0.0),
    Part.JOINT: ((0.13, 0.14, 0.15), 0.08, 20, 0.0),
    Part.GRASS: ((0.05, 0.17, 0.10), 0.30, 55, 0.0),
    Part.STONE: ((0.34, 0.35, 0.36), 0.08, 25, 0.0),
    Part.WALL: (None, 0.07, 18, 0.0),
    Part.WINDOW: ((0.035, 0.03, 0.03), 0.9, 3, 0.30),
    Part.FRAME: ((0.62, 0.64, 0.65), 0.04, 30, 0.0),
    Part.DOOR: ((0.08, 0.12, 0.22), 0.10, 30, 0.05),
    Part.TILES: (None, 0.16, 40, 0.0),
    Part.PAINT: (None, 0.0, 5, 0.16),
    Part.GLASS: ((0.03, 0.03, 0.028), 0.5, 4, 0.28),
    Part.RUBBER: ((0.03, 0.03, 0.03), 0.1, 40, 0.0),
    Part.RIM: ((0.42, 0.42, 0.42), 0.05, 40, 0.1),
    Part.LAMP: ((0.45, 0.45, 0.55), 0.2, 60, 0.3),
    Part.BARK: (None, 0.32, 45, 0.0),
    Part.LEAF: (None, 0.55, 28, 0.0),
    Part.CLOTH: (None, 0.14, 35, 0.0),
    Part.SKIN: (None, 0.05, 40, 0.0),
    Part.HAIR: ((0.05, 0.06, 0.08), 0.2, 90, 0.0),
    Part.METAL: (None, 0.05, 30, 0.05),
    Part.BOARD: (None, 0.02, 30, 0.05),
    Part.SYMBOL: ((0.8, 0.8, 0.8), 0.02, 30, 0.05),
    Part.SLAT: (None, 0.2, 30, 0.0),
    Part.PRINT: ((0.62, 0.63, 0.64), 0.05, 30, 0.0),
    Part.PLAIN: (None, 0.06, 25, 0.0),
}
_OWN = np.array([MATERIALS[p][0] is None for p in Part])
_ALBEDO = np.array([MATERIALS[p][0] or (0, 0, 0) for p in Part], np.float32)
_CONTRAST, _GRAIN, _GLOSS = (np.array([MATERIALS[p][k] for p in Part], np.float32) for k in (1, 2, 3))
SUN = np.array([0.95, 1.10, 1.20], np.float32)
AMBIENT = np.array([0.52, 0.44, 0.40], np.float32)
ZENITH = np.array([0.72, 0.45, 0.26], np.float32)
HAZE = np.array([0.80, 0.74, 0.68], np.float32)
CLOUD = np.array([0.98, 0.97, 0.96], np.float32)
WOODS = np.array([0.16, 0.20, 0.15], np.float32)  # far trees on the horizon, too far for any LiDAR
HAZE_RANGE = 450.0  # m over which two thirds of the contrast are lost
FOCAL = 720.0  # px; the pixel size that textures fade for


def display(linear: Float32) -> Float32:
    """Light 0..1 -> grey level 0..255 by a camera's gamma, here 2."""
    return np.asarray(np.sqrt(np.clip(linear, 0, 1)) * np.float32(255))


def sky(direction: Float32, seed: int) -> Float32:
    """Light (3, n) from the directions (3, n) of any length: gradient, clouds, and woods at the horizon."""
    x, y, z = direction / np.sqrt((direction * direction).sum(axis=0))
    up = np.clip(z, 0, 1)
    blend = np.sqrt(up)
    out = HAZE[:, None] + (ZENITH - HAZE)[:, None] * blend
    height = 1 / (up + np.float32(0.08))
    cover = np.clip(0.45 * noise2(x * height + seed, y * height, 40) + 0.1, 0, 1) * np.minimum(1, 6 * up)
    out += (CLOUD[:, None] - out) * cover
    low = np.flatnonzero(z < 0.09)
    around = np.arctan2(y[low], x[low])
    wood = z[low] < 0.035 + 0.016 * noise2(around, np.full_like(around, seed * 0.37), 60)
    out[:, low[wood]] = (WOODS * 0.55 + HAZE * 0.25)[:, None]
    return np.asarray(out, np.float32)


def light(solids: Solids, ids: NDArray[np.int32], xyz: Float32, here: Spots, lit: Float32, sun: Floats, seed: int) -> Float32:
    """Light (3, n) that reaches the lens from hits at xyz (3, n) relative to the lens. lit: (n,) share of the sun seen."""
    part, normal = here.part, here.normal
    own = _OWN.take(part) & (ids >= 0)
    # One table: the solids' own colours, then those of the materials.
    row = np.where(own, ids, part + np.int32(len(solids)))
    distance = np.sqrt(xyz[0] * xyz[0] + xyz[1] * xyz[1] + xyz[2] * xyz[2])

    grain = _GRAIN.take(part)
    texels = grain * distance * np.float32(1 / FOCAL)  # per pixel; finer than that, only the mean is left
    offset = np.float32(0.618) * ids
    fine = noise2(here.u * grain + offset * 91, here.v * grain, 1)
    broad = noise2(here.u + offset * 7, here.v, 2.5)
    texture = 1 + _CONTRAST.take(part) * fine / (1 + texels * texels) + np.float32(0.06) * broad
    texture = np.clip(texture, 0.25, 2.2)

    sx, sy, sz = (np.float32(v) for v in sun)
    direct = np.maximum(normal[0] * sx + normal[1] * sy + normal[2] * sz, 0) * lit
    leaf = np.flatnonzero(part == Part.LEAF)
    direct[leaf] = 0.35 * lit[leaf] + 0.55 * direct[leaf]  # leaves point everywhere and let light through
    ambient = np.float32(0.62) + np.float32(0.38) * normal[2]
    body = ids >= 0
    ambient *= np.where(body, np.float32(0.7) + np.float32(0.3) * np.clip(here.v / 1.5, 0, 1), 1)
    out = np.empty_like(xyz)
    for k in range(3):
        albedo = np.concatenate([solids.colour[:, k], _ALBEDO[:, k]]).take(row)
        out[k] = albedo * texture * (SUN[k] * direct + AMBIENT[k] * ambient)

    shiny = np.flatnonzero((_GLOSS > 0).take(part))
    if len(shiny):
        ray, n = xyz[:, shiny] / distance[shiny], normal[:, shiny]
        cosine = (ray * n).sum(axis=0)
        mirror = ray - 2 * cosine * n
        fresnel = _GLOSS[part[shiny]] + np.float32(0.7) * (1 - np.abs(cosine)) ** 5
        up = np.clip(4 * mirror[2] + 0.2 + 0.25 * broad[shiny], 0.08, 1)  # below the roofs the street is mirrored
        out[:, shiny] += fresnel * up * (0.5 * HAZE + 0.5 * ZENITH)[:, None]
        glint = np.maximum(mirror[0] * sx + mirror[1] * sy + mirror[2] * sz, 0) ** 60 * lit[shiny]
        out[:, shiny] += np.minimum(fresnel * 4, 1) * glint
    clear = np.exp(distance * np.float32(-1 / HAZE_RANGE))
    out *= clear
    out += (HAZE * np.float32(0.8))[:, None] * (1 - clear)
    return out
