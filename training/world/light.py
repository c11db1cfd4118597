"""Sun, sky and air of a world, and what of their light reaches the lens."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros_synthetic.solids import noise2
from training.world import looks
from training.world.looks import Float32, Rng
from training.world.stage import BUILDING, SKY, TREE


@dataclass(frozen=True, eq=False)
class Light:
    """sun: unit vector towards it (3,). direct, ambient: their light, BGR (3,). zenith, horizon, cloud: of the sky (3,).

    cover: share of clouds, scale: their entries per unit, sharp: of their borders. haze: m over which 1/e of a colour is left.
    far: heights of woods and of houses on the horizon (rad), and their colours. night: lamps are on. headlights: their power.
    """

    sun: NDArray[np.float64]
    direct: Float32
    ambient: Float32
    zenith: Float32
    horizon: Float32
    cloud: Float32
    cover: float
    scale: float
    sharp: float
    glow: float
    haze: float
    woods: float
    houses: float
    wood_colour: Float32
    house_colour: Float32
    night: bool
    headlights: float
    seed: float


def light_of(rng: Rng) -> Light:
    """Day with and without sun, dusk, night; clear, hazy, overcast."""
    kind = rng.choice(["sun", "clouds", "overcast", "dusk", "night"], p=[0.38, 0.2, 0.24, 0.12, 0.06])
    azimuth = rng.uniform(0, 2 * np.pi)
    elevation = np.deg2rad(rng.uniform(3, 14) if kind == "dusk" else rng.uniform(14, 65))
    c = np.cos(elevation)
    sun = np.array([c * np.cos(azimuth), c * np.sin(azimuth), np.sin(elevation)])
    warm = rng.uniform(0.0, 0.25) if kind != "dusk" else rng.uniform(0.2, 0.6)
    direct = np.array([1 - warm, 1 - 0.4 * warm, 1.0]) * rng.uniform(0.8, 1.6)
    blue = rng.uniform(0.0, 0.35)
    ambient = np.array([1 + blue / 2, 1.0, 1 - blue / 2]) * rng.uniform(0.22, 0.5)
    horizon = np.array(looks.hsv(rng.uniform(0.05, 0.65), rng.uniform(0, 0.2), 0.9)) * rng.uniform(0.7, 1.3)
    zenith = np.array(looks.hsv(rng.uniform(0.54, 0.62), rng.uniform(0.2, 0.85), 0.9)) * rng.uniform(0.35, 1.0)
    cloud = np.full(3, rng.uniform(0.7, 1.3))
    cover = {"sun": rng.uniform(-0.8, 0.1), "clouds": rng.uniform(-0.1, 0.5)}.get(str(kind), rng.uniform(-0.5, 0.8))
    if kind == "clouds":
        direct *= rng.uniform(0.1, 1.0)
    if kind == "overcast":
        direct *= rng.uniform(0.0, 0.12)
        ambient = ambient * 1.3
        zenith = np.full(3, rng.uniform(0.5, 1.4)) * (1 + 0.1 * rng.normal(0, 1, 3).clip(-1, 1))
        horizon = zenith * rng.uniform(0.7, 1.3)
        cloud = zenith * rng.uniform(0.6, 1.2)
    if kind == "dusk":
        horizon = np.array(looks.hsv(rng.uniform(0.0, 0.14), rng.uniform(0.2, 0.8), 0.9)) * rng.uniform(0.5, 1.4)
        zenith = zenith * rng.uniform(0.2, 0.7)
        ambient = ambient * rng.uniform(0.3, 0.8)
        cloud = cloud * rng.uniform(0.2, 0.9)
    if kind == "night":
        direct = direct * 0.02
        ambient, zenith = ambient * rng.uniform(0.04, 0.2), zenith * rng.uniform(0.005, 0.05)
        horizon, cloud = horizon * rng.uniform(0.01, 0.1), cloud * rng.uniform(0.01, 0.08)
    haze = float(np.exp(rng.uniform(np.log(45), np.log(180)))) if rng.random() < 0.08 else float(rng.uniform(350, 2500))
    f = np.float32
    return Light(
        sun, direct.astype(f), ambient.astype(f), zenith.astype(f), horizon.astype(f), cloud.astype(f), float(cover),
        float(rng.uniform(15, 80)), float(rng.uniform(0.3, 1.5)), float(rng.uniform(0, 0.8)), haze,
        float(rng.choice([0.0, rng.uniform(0.02, 0.1)], p=[0.35, 0.65])), float(rng.choice([0.0, rng.uniform(0.01, 0.06)])),
        np.array(looks.foliage(rng).a, f), np.array(looks.wall_colour(rng), f),
        kind == "night" or (kind == "dusk" and rng.random() < 0.6), float(rng.uniform(3, 40)) if kind == "night" else 0.0,
        float(rng.uniform(0, 500)),
    )  # fmt: skip


def sky(light: Light, direction: Float32) -> tuple[Float32, NDArray[np.uint8]]:
    """Light (3, n) and labels (n,) from directions (3, n) of any length: gradient, clouds, the sun, far woods and houses."""
    x, y, z = unit = direction / np.sqrt((direction * direction).sum(axis=0))
    up = np.clip(z, 0, 1)
    out = light.horizon[:, None] + (light.zenith - light.horizon)[:, None] * np.sqrt(up)
    height = 1 / (up + np.float32(0.1))
    noise = noise2(x * height + np.float32(light.seed), y * height, light.scale)
    cover = np.clip((0.45 * noise + light.cover) * light.sharp, 0, 1) * np.minimum(1, 6 * up)
    shade = 1 + np.float32(0.12) * noise2(x * height, y * height + np.float32(light.seed), light.scale * 2)
    out += (light.cloud[:, None] * shade - out) * cover
    towards = np.clip((unit * light.sun.astype(np.float32)[:, None]).sum(axis=0), 0, 1)
    out += (light.glow * towards**12 + 8 * light.glow * towards**900) * light.direct[:, None] * (1 - 0.8 * cover)
    label = np.full(len(x), SKY, np.uint8)
    low = np.flatnonzero(z < 0.2)
    around = np.arctan2(y[low], x[low])
    aerial = light.horizon * 0.45
    if light.woods:
        line = light.woods * (0.5 + 0.35 * noise2(around, np.full_like(around, light.seed), 90))
        some = low[z[low] < line]
        tone = 1 + 0.3 * noise2(around[z[low] < line] * 40, z[some] * 40, 30)
        out[:, some] = (light.wood_colour * light.ambient)[:, None] * tone + 0.35 * aerial[:, None]
        label[some] = TREE
    if light.houses:
        block = np.floor(around * 30 + np.float32(light.seed))
        line = light.houses * (0.3 + 0.7 * np.abs(np.sin(block * 12.9)))
        some = low[(z[low] < line) & (np.sin(block * 4.7) > -0.5)]
        out[:, some] = (light.house_colour * light.ambient)[:, None] * 1.3 + 0.4 * aerial[:, None]
        label[some] = BUILDING
    return np.asarray(np.maximum(out, 0), np.float32), label


def shine(
    light: Light, albedo: Float32, normal: Float32, ray: Float32, distance: Float32, lit: Float32, near: Float32, gloss: Float32,
    emit: Float32, leaf: NDArray[np.bool_], forward: Float32,
) -> Float32:  # fmt: skip
    """Light (3, n) that reaches the lens from n places.

    albedo, normal, ray: (3, n), the ray a unit vector from the lens. distance, gloss, emit: (n,). lit: (n,) share of the sun that
    is seen. near: (n,) share of the ambient light that is not hidden by what stands near. leaf: (n,). forward: (3,) where the
    own headlights shine.
    """
    sun = light.sun.astype(np.float32)
    direct = np.maximum((normal * sun[:, None]).sum(axis=0), 0) * lit
    direct = np.where(leaf, 0.35 * lit + 0.5 * direct, direct)  # leaves point everywhere and let light through
    ambient = (np.float32(0.65) + np.float32(0.35) * normal[2]) * near
    out = albedo * (light.direct[:, None] * direct + light.ambient[:, None] * ambient * 1.6)
    # What the sun lights on the ground lights the walls from below.
    out += albedo * light.direct[:, None] * (0.10 * (1 - normal[2]) * max(float(sun[2]), 0))
    if light.headlights:
        ahead = np.clip((ray * forward[:, None]).sum(axis=0), -1, 1)
        beam = np.exp(-np.square(np.arccos(ahead) / 0.45)) * np.abs((ray * normal).sum(axis=0))
        out += albedo * light.headlights * beam / (25 + distance**2)
    shiny = np.flatnonzero(gloss > 0)
    if len(shiny):
        r, n = ray[:, shiny], normal[:, shiny]
        cosine = (r * n).sum(axis=0)
        mirror = r - 2 * cosine * n
        fresnel = gloss[shiny] + np.float32(0.6) * (1 - np.abs(cosine)) ** 5
        up = np.clip(3 * mirror[2] + 0.3 + 0.35 * noise2(mirror[0] * 3, mirror[2] * 3 + mirror[1], 8), 0.06, 1)
        out[:, shiny] += fresnel * up * (0.5 * light.horizon + 0.5 * light.zenith)[:, None]
        glint = np.maximum((mirror * sun[:, None]).sum(axis=0), 0) ** 80 * lit[shiny]
        out[:, shiny] += np.minimum(fresnel * 5, 1) * glint * light.direct[:, None]
    out += emit * albedo
    clear = np.exp(-distance / np.float32(light.haze))
    return np.asarray(out * clear + light.horizon[:, None] * np.float32(0.75) * (1 - clear), np.float32)
