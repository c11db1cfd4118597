"""The solids of the synthetic street, upright and rotated about the vertical axis only, and the noise of their textures.

The tables of the noise are made once from a fixed seed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import lru_cache, partialmethod
from math import cos, sin

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.frame import SemanticClass as Label

Floats = NDArray[np.float64]
Float32 = NDArray[np.float32]
Numbers = Sequence[float] | Floats
PLANE_SIZE = 512  # entries per side of the plane table, which repeats
SPACE_SIZE = 32  # entries per side of the space table, which repeats
LEAF_SIZE = 0.08  # m; grain of foliage
MAX_ROW = 1024  # OpenCV refuses to remap very long rows


class Kind(IntEnum):
    """Shapes inside the unit cube, scaled by the half sizes of a solid.

    FRUSTUM: a box whose sides lean inwards by `taper` (share of the half size lost at the top). The axis of a CYLINDER points up,
    that of a WHEEL to the left.
    """

    BOX, FRUSTUM, ELLIPSOID, CYLINDER, WHEEL = range(5)


class Surface(IntEnum):
    """What covers a solid; decides its materials, see surfaces.py. CEILING throws no shadow: the lamps hang below it."""

    PLAIN, FACADE, ROOF, BODY, CABIN, TYRE, BARK, LEAF, CLOTH, SKIN, SIGN, FENCE, POSTER, METAL, CEILING = range(15)


@dataclass(frozen=True, eq=False)
class Solids:
    """n solids. centre, half: (n, 3) metres. yaw: (n,) rad. taper: (n, 2) shares in x and y. colour: (n, 3) BGR albedo 0..1.

    style: (n, 4) numbers in 0..1 that vary the texture. kind, surface, label: (n,) members of the enums above.
    """

    kind: NDArray[np.uint8]
    surface: NDArray[np.uint8]
    label: NDArray[np.uint8]
    centre: Floats
    half: Floats
    yaw: Floats
    taper: Floats
    colour: Float32
    style: Float32

    def __len__(self) -> int:
        return len(self.kind)

    def moved(self, offset: Floats) -> Solids:
        """The same solids with `offset` (3,) added to their centres."""
        return replace(self, centre=self.centre + offset)

    def corners(self) -> Floats:
        """(n, 8, 3) corners of the bounding boxes; bit 0, 1, 2 of the corner's number is the side in x, y, z."""
        unit = np.array([[(k >> b & 1) * 2 - 1 for b in range(3)] for k in range(8)], float)
        local = unit * self.half[:, None]
        c, s = np.cos(self.yaw)[:, None], np.sin(self.yaw)[:, None]
        turned = np.stack([c * local[..., 0] - s * local[..., 1], s * local[..., 0] + c * local[..., 1], local[..., 2]], -1)
        return np.asarray(turned + self.centre[:, None])


class Builder:
    """Collects solids given in the frame of the object they belong to (x forward, y left, z up from the ground)."""

    def __init__(self) -> None:
        self._rows: list[tuple[object, ...]] = []
        self.at(0.0, 0.0)

    def at(self, x: float, y: float, yaw: float = 0.0, z: float = 0.0) -> None:
        """Sets the frame of the object that the next solids belong to: metres, rad."""
        self._origin, self._yaw = (x, y, z), yaw

    def add(
        self,
        kind: Kind,
        label: Label,
        centre: Numbers,
        half: Numbers,
        colour: Numbers,
        surface: Surface = Surface.PLAIN,
        *,
        taper: Numbers = (0.0, 0.0),
        style: Numbers | np.random.Generator = (0.0, 0.0, 0.0, 0.0),
    ) -> None:
        """One solid: centre and half sizes (3,) in metres in the object's frame. style: (4,), or what draws it."""
        style = style.random(4) if isinstance(style, np.random.Generator) else style
        c, s, (x, y, z) = cos(self._yaw), sin(self._yaw), centre
        where = (self._origin[0] + c * x - s * y, self._origin[1] + s * x + c * y, self._origin[2] + z)
        self._rows.append((kind, surface, label, where, tuple(half), self._yaw, tuple(taper), tuple(colour), tuple(style)))

    box, frustum, ellipsoid = partialmethod(add, Kind.BOX), partialmethod(add, Kind.FRUSTUM), partialmethod(add, Kind.ELLIPSOID)
    cylinder, wheel = partialmethod(add, Kind.CYLINDER), partialmethod(add, Kind.WHEEL)

    def solids(self) -> Solids:
        """Everything added so far."""
        columns = list(zip(*self._rows, strict=True)) if self._rows else [()] * 9
        shapes: list[tuple[type, tuple[int, ...]]] = [
            (np.uint8, ()), (np.uint8, ()), (np.uint8, ()), (np.float64, (3,)), (np.float64, (3,)),
            (np.float64, ()), (np.float64, (2,)), (np.float32, (3,)), (np.float32, (4,)),
        ]  # fmt: skip
        return Solids(*(np.array(c, t).reshape(len(self._rows), *s) for c, (t, s) in zip(columns, shapes, strict=True)))


def pick_colour(rng: np.random.Generator, colours: Sequence[tuple[float, float, float]]) -> Floats:
    """One of the colours (BGR), slightly varied -> (3,)."""
    return np.clip(np.array(colours[int(rng.integers(len(colours)))]) * rng.uniform(0.85, 1.15, 3), 0.02, 0.9)


@lru_cache(maxsize=1)
def _plane() -> Float32:
    """Fractal noise (PLANE_SIZE, PLANE_SIZE), mean 0, standard deviation 1, without seams."""
    rng = np.random.default_rng(0)
    spectrum = np.fft.rfft2(rng.standard_normal((PLANE_SIZE, PLANE_SIZE)))
    frequency = np.hypot(np.fft.fftfreq(PLANE_SIZE)[:, None], np.fft.rfftfreq(PLANE_SIZE))
    frequency[0, 0] = 1
    noise = np.fft.irfft2(spectrum / frequency, (PLANE_SIZE, PLANE_SIZE))
    return np.asarray((noise - noise.mean()) / noise.std(), np.float32)


@lru_cache(maxsize=1)
def _space() -> Float32:
    """Smoothed random numbers (SPACE_SIZE**3,) with values spread evenly over 0..1."""
    noise = np.random.default_rng(1).standard_normal((SPACE_SIZE,) * 3)
    for axis in range(3):
        noise = noise + 0.6 * (np.roll(noise, 1, axis) + np.roll(noise, -1, axis))
    return (np.argsort(np.argsort(noise, axis=None)) / noise.size).astype(np.float32)


@lru_cache(maxsize=1)
def _hash() -> Float32:
    return np.random.default_rng(2).random(4096).astype(np.float32)


def noise2(u: Float32, v: Float32, scale: float) -> Float32:
    """Fractal noise at u, v (n,) metres, `scale` table entries per metre, between the entries linear -> (n,)."""
    n = u.size
    if n == 0:
        return np.zeros(0, np.float32)
    maps = []
    for a in (u, v):
        a = a * np.float32(scale / PLANE_SIZE)
        padded = np.zeros(-(-n // MAX_ROW) * MAX_ROW, np.float32)
        padded[:n] = (a - np.floor(a)) * np.float32(PLANE_SIZE)
        maps.append(padded.reshape(-1, MAX_ROW))
    return np.asarray(cv2.remap(_plane(), maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)).ravel()[:n]


def cell(*index: Float32 | Floats | float) -> Float32:
    """A random number in 0..1 for each combination of whole numbers, given as float arrays or scalars."""
    primes = (73, 179, 283, 419)
    total = sum(np.floor(np.asarray(i, np.float32)).astype(np.int64) * p for i, p in zip(index, primes, strict=False))
    return np.asarray(_hash()[np.asarray(total) & 4095], np.float32)


def leaf_gap(x: Float32, y: Float32, z: Float32, openness: float) -> NDArray[np.bool_]:
    """Whether there is no leaf at x, y, z (n,) metres in foliage. openness: 0..1, how open this clump is."""
    a = 1 / LEAF_SIZE
    # Skewed axes, for a person sees grains that lie in rows.
    i = np.floor(a * x + (0.37 * a) * z + 64 * openness).astype(np.int32) & (SPACE_SIZE - 1)
    j = np.floor(a * y + (0.31 * a) * x).astype(np.int32) & (SPACE_SIZE - 1)
    k = np.floor(a * z + (0.43 * a) * y).astype(np.int32) & (SPACE_SIZE - 1)
    return np.asarray(_space().take((i * SPACE_SIZE + j) * SPACE_SIZE + k) < 0.40 + 0.25 * openness)
