"""Which material is where on the things of the synthetic street: windows in walls, markings on asphalt, lamps on cars."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from calib_ros.datasets.street.blocks import Street
from calib_ros.datasets.street.noise import cell, noise2
from calib_ros.datasets.street.rays import CURB, PAVEMENT, ROAD
from calib_ros.datasets.street.solids import Float32, Surface

Bytes = NDArray[np.uint8]


class Part(IntEnum):
    """Materials, finer than solids: borders between them are edges in the image, and steps in the LiDAR's intensity."""

    SKY = 0
    ASPHALT = 1
    PATCH = 2  # mended asphalt
    MARKING = 3
    SLAB = 4
    JOINT = 5
    GRASS = 6
    STONE = 7  # kerbs
    WALL = 8
    WINDOW = 9
    FRAME = 10
    DOOR = 11
    TILES = 12
    PAINT = 13
    GLASS = 14
    RUBBER = 15
    RIM = 16
    LAMP = 17
    BARK = 18
    LEAF = 19
    CLOTH = 20
    SKIN = 21
    HAIR = 22
    METAL = 23
    BOARD = 24  # face of a traffic sign
    SYMBOL = 25
    SLAT = 26
    PRINT = 27
    PLAIN = 28


def ground_parts(street: Street, ids: NDArray[np.int32], s: Float32, d: Float32) -> Bytes:
    """Materials (n,) of the ground ids (n,) at stations s and offsets d (n,) in metres."""
    style, width = street.style, street.road
    part = np.where(ids == CURB, Part.STONE, Part.ASPHALT).astype(np.uint8)

    road = np.flatnonzero(ids == ROAD)
    x, y = s[road], d[road]
    a = np.abs(y)
    patch = (cell(x / 7, np.floor(y / 1.7), 3) < 0.06 + 0.1 * style[0]) | (np.hypot(x % 31 - 9, y - 0.9) < 0.33)
    dash, period = (1.5, 4.5) if style[1] < 0.5 else (4.0, 10.0)
    marking = (a < 0.07) & (x % period < dash)
    bays = width - 2.05
    marking |= (np.abs(a - bays) < 0.05) & (x % 1.0 < 0.55)
    if style[2] < 0.6:
        marking |= (a > bays) & (x % 5.6 < 0.09) & (a < width - 0.15)
    crossing = (x - 60 * style[3]) % (70 + 50 * style[4])
    marking |= (crossing < 3.2) & (y % 1.0 < 0.5) & (a < width - 0.3)
    along, across = (x - 20 * style[5]) % 33 - 14, y - street.lane  # an arrow: shaft and head
    marking |= (np.abs(across) < 0.08) & (np.abs(along) < 1.5)
    marking |= (np.abs(across) < 0.35 * (2.7 - along)) & (np.abs(across) < 0.42) & (along > 1.5) & (along < 2.7)
    part[road] = np.where(marking, Part.MARKING, np.where(patch, Part.PATCH, Part.ASPHALT))

    rest = np.flatnonzero(ids == PAVEMENT)
    x, y = s[rest], d[rest]
    a = np.abs(y) - width
    size = 0.5 + 0.5 * np.floor(2 * style[6])
    joint = (x % size < 0.02) | (a % size < 0.02)
    grass = (cell(x / 13, np.sign(y), 5) < 0.55) & (a > street.pavement)
    part[rest] = np.where(grass, Part.GRASS, np.where(a < 0.15, Part.STONE, np.where(joint, Part.JOINT, Part.SLAB)))
    return part


@dataclass(frozen=True, eq=False)
class Place:
    """Where on its solid a hit is: q (3, n) in -1..1, face (n,) axis, u, v (n,) m, style (4, n)."""

    q: Float32
    face: Bytes
    u: Float32
    v: Float32
    style: Float32


def _facade(a: Place) -> Bytes:
    pitch, storey = 1.7 + 1.4 * a.style[0], np.float32(3.0)
    column, row = np.floor(a.u / pitch), np.floor(a.v / storey)
    x, y = np.abs(a.u - (column + 0.5) * pitch), a.v - row * storey
    wide, sill = pitch * (0.2 + 0.14 * a.style[1]), 0.75 + 0.3 * a.style[2]
    door = (row == 0) & (cell(column, 7, a.style[3] * 999) < 0.22)
    lintel = np.float32(2.4)
    sill = np.where(door, 0.1, sill)
    blind = cell(column, row, a.style[3] * 999) < 0.12
    hole = (x < wide) & (y > sill) & (y < lintel)
    pane = hole & (x < wide - 0.07) & (y > sill + 0.07) & (y < lintel - 0.07) & (x > 0.025)
    opening = np.where(door, Part.DOOR, np.where(pane, Part.WINDOW, Part.FRAME))
    band = (y < 0.12) & (row > 0) & (a.style[2] > 0.5)  # a string course between the storeys
    wall = np.where(band, Part.FRAME, Part.WALL)
    return np.where((a.face == 2) | blind | ~hole, wall, opening).astype(np.uint8)


def _body(a: Place) -> Bytes:
    x, y, z = a.q
    ends = a.face == 0
    lamp = ends & (np.abs(y) > 0.62) & (z > 0.15) & (z < 0.62)
    plate = ends & (np.abs(y) < 0.3) & (np.abs(z + 0.2) < 0.16)
    seam = (a.face == 1) & ((np.abs(x - 0.02) < 0.006) | (np.abs(x - 0.42) < 0.006) | (np.abs(x + 0.38) < 0.006))
    dark = (z < -0.72) | (ends & (x > 0) & (np.abs(z - 0.3) < 0.14) & (np.abs(y) < 0.5)) | seam
    return np.select([lamp, plate, dark], [Part.LAMP, Part.BOARD, Part.RUBBER], Part.PAINT).astype(np.uint8)


def _cabin(a: Place) -> Bytes:
    x, y, z = a.q
    pillar = (np.abs(np.abs(x) - 0.9 + 0.2 * (z + 1)) < 0.07) | (np.abs(x) < 0.05)
    glass = np.where(a.face == 1, ~pillar & (np.abs(x) < 0.85), np.abs(y) < 0.84) & (z > -0.75) & (z < 0.72)
    return np.where(glass & (a.face < 2), Part.GLASS, Part.PAINT).astype(np.uint8)


def _wheel(a: Place) -> Bytes:
    r = np.hypot(a.q[0], a.q[2])
    spokes = np.cos(5 * np.arctan2(a.q[0], a.q[2])) > -0.3
    return np.where((np.abs(a.q[1]) > 0.99) & (r < 0.68) & spokes, Part.RIM, Part.RUBBER).astype(np.uint8)


def _sign(a: Place) -> Bytes:
    x, y = np.abs(a.q[1]), np.abs(a.q[2])
    border = (x > 0.84) | (y > 0.84)
    symbol = np.where(a.style[0] < 0.5, (y < 0.2) & (x < 0.65), np.hypot(x, y) < 0.5)
    front = np.where(border | symbol, Part.SYMBOL, Part.BOARD)
    return np.where((a.face == 0) & (a.q[0] < 0), front, Part.METAL).astype(np.uint8)


def _poster(a: Place) -> Bytes:
    noise = noise2(a.u + 9 * a.style[0], a.v + 9 * a.style[1], 40)
    text = (cell(a.u * 6, a.v * 5, a.style[2] * 99) < 0.45) & (a.v % 0.6 < 0.3)
    return np.where((noise > 1.2) | text, Part.PRINT, Part.PLAIN).astype(np.uint8)


def _skin(a: Place) -> Bytes:
    return np.where((a.q[2] > 0.35) | (a.q[0] < -0.3), Part.HAIR, Part.SKIN).astype(np.uint8)


def _fence(a: Place) -> Bytes:
    return np.where((a.u % 0.16 < 0.03) & (a.q[2] < 0.8), Part.RUBBER, Part.SLAT).astype(np.uint8)


PLAIN_PARTS = {
    int(Surface.PLAIN): Part.PLAIN,
    int(Surface.ROOF): Part.TILES,
    int(Surface.BARK): Part.BARK,
    int(Surface.LEAF): Part.LEAF,
    int(Surface.CLOTH): Part.CLOTH,
    int(Surface.METAL): Part.METAL,
}
PAINTERS: dict[int, Callable[[Place], Bytes]] = {
    int(Surface.FACADE): _facade,
    int(Surface.BODY): _body,
    int(Surface.CABIN): _cabin,
    int(Surface.TYRE): _wheel,
    int(Surface.SKIN): _skin,
    int(Surface.SIGN): _sign,
    int(Surface.FENCE): _fence,
    int(Surface.POSTER): _poster,
}
