"""Materials of the synthetic scenes, their colours, BGR, and what the ground of each scene is painted as."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from calib_ros_synthetic.rays import CURB, PAVEMENT, ROAD
from calib_ros_synthetic.solids import Float32, cell, noise2
from calib_ros_synthetic.street import Street


class Part(IntEnum):
    """Materials, finer than solids: borders between them are edges in the image, and steps in the LiDAR's intensity."""

    (
        SKY, ASPHALT, PATCH, MARKING, SLAB, JOINT, GRASS, STONE, WALL, WINDOW, FRAME, DOOR, TILES, PAINT, GLASS,
        RUBBER, RIM, LAMP, BARK, LEAF, CLOTH, SKIN, HAIR, METAL, BOARD, SYMBOL, SLAT, PRINT, PLAIN, GRAVEL, CONCRETE,
        LINE
    ) = range(32)  # fmt: skip


Bytes = NDArray[np.uint8]
Colour = tuple[float, float, float]
# Material -> albedo (BGR; None: the solid's own colour), size of the texture's contrast, its grain per metre, gloss, and diffuse
# reflectivity near 905 nm (None: it follows the albedo; above 1: retro-reflective).
MATERIALS: dict[Part, tuple[Colour | None, float, float, float, float | None]] = {
    Part.SKY: ((0.0, 0.0, 0.0), 0.0, 1, 0.0, None),
    Part.ASPHALT: ((0.125, 0.12, 0.115), 0.13, 45, 0.0, 0.17),
    Part.PATCH: ((0.07, 0.068, 0.066), 0.10, 60, 0.0, 0.12),  # mended asphalt
    Part.MARKING: ((0.60, 0.62, 0.62), 0.12, 25, 0.0, 0.75),
    Part.SLAB: ((0.24, 0.26, 0.27), 0.08, 20, 0.0, 0.3),
    Part.JOINT: ((0.13, 0.14, 0.15), 0.08, 20, 0.0, 0.25),
    Part.GRASS: ((0.05, 0.17, 0.10), 0.30, 55, 0.0, 0.42),
    Part.STONE: ((0.34, 0.35, 0.36), 0.08, 25, 0.0, 0.35),  # kerbs
    Part.WALL: (None, 0.07, 18, 0.0, None),
    Part.WINDOW: ((0.035, 0.03, 0.03), 0.9, 3, 0.30, 0.05),
    Part.FRAME: ((0.62, 0.64, 0.65), 0.04, 30, 0.0, 0.45),
    Part.DOOR: ((0.08, 0.12, 0.22), 0.10, 30, 0.05, 0.25),
    Part.TILES: (None, 0.16, 40, 0.0, 0.3),
    Part.PAINT: (None, 0.0, 5, 0.16, None),
    Part.GLASS: ((0.03, 0.03, 0.028), 0.5, 4, 0.28, 0.04),
    Part.RUBBER: ((0.03, 0.03, 0.03), 0.1, 40, 0.0, 0.06),
    Part.RIM: ((0.42, 0.42, 0.42), 0.05, 40, 0.1, 0.4),
    Part.LAMP: ((0.45, 0.45, 0.55), 0.2, 60, 0.3, 1.2),
    Part.BARK: (None, 0.32, 45, 0.0, 0.3),
    Part.LEAF: (None, 0.55, 28, 0.0, 0.5),
    Part.CLOTH: (None, 0.14, 35, 0.0, 0.4),
    Part.SKIN: (None, 0.05, 40, 0.0, 0.5),
    Part.HAIR: ((0.05, 0.06, 0.08), 0.2, 90, 0.0, 0.2),
    Part.METAL: (None, 0.05, 30, 0.05, 0.35),
    Part.BOARD: (None, 0.02, 30, 0.05, 3.0),  # face of a traffic sign
    Part.SYMBOL: ((0.8, 0.8, 0.8), 0.02, 30, 0.05, 3.0),
    Part.SLAT: (None, 0.2, 30, 0.0, 0.35),
    Part.PRINT: ((0.62, 0.63, 0.64), 0.05, 30, 0.0, None),
    Part.PLAIN: (None, 0.06, 25, 0.0, None),
    Part.GRAVEL: ((0.24, 0.30, 0.34), 0.35, 70, 0.0, 0.28),
    Part.CONCRETE: ((0.30, 0.31, 0.32), 0.10, 14, 0.02, 0.35),
    Part.LINE: ((0.06, 0.42, 0.55), 0.10, 25, 0.0, 0.6),  # yellow, on floors
}
OWN_COLOUR = np.array([MATERIALS[p][0] is None for p in Part])
ALBEDO = np.array([MATERIALS[p][0] or (0, 0, 0) for p in Part], np.float32)
CONTRAST, GRAIN, GLOSS = (np.array([MATERIALS[p][k] for p in Part], np.float32) for k in (1, 2, 3))
REFLECTIVITY = np.array([MATERIALS[p][4] for p in Part], np.float32)  # NaN for None


def _street(street: Street, ids: NDArray[np.int32], s: Float32, d: Float32) -> Bytes:
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


def _country(street: Street, ids: NDArray[np.int32], s: Float32, d: Float32) -> Bytes:
    """A road without kerbs through the woods: a dashed line, soft edges of gravel, then grass and bare soil."""
    a = np.abs(d)
    edge = street.road - 0.25 + 0.12 * noise2(s, d, 6)
    dash = (a < 0.06) & (s % 9.0 < 3.0)
    patch = cell(s / 6, np.floor(d / 1.6), 3) < 0.12
    road = np.where(dash, Part.MARKING, np.where(patch, Part.PATCH, Part.ASPHALT))
    verge = np.where(noise2(s, d, 9) > 0.9, Part.BARK, Part.GRASS)
    return np.where(a < edge, road, np.where(a < edge + 0.5, Part.GRAVEL, verge)).astype(np.uint8)


def _path(street: Street, ids: NDArray[np.int32], s: Float32, d: Float32) -> Bytes:
    """A gravel path through a lawn, with worn spots."""
    edge = street.road + 0.15 * noise2(s, d, 7)
    worn = noise2(s, d, 8) > 1.5
    return np.where((np.abs(d) < edge) | worn, Part.GRAVEL, Part.GRASS).astype(np.uint8)


def _parking(street: Street, ids: NDArray[np.int32], s: Float32, d: Float32) -> Bytes:
    """A deck of a car park: bays 2.5 m wide and 5 m deep on both sides of each aisle, arrows, joints and oil."""
    aisle = np.float32(2 * (street.road + 5.0))  # from the middle of one aisle to that of the next
    across = np.abs(np.mod(d + aisle / 2, aisle) - aisle / 2)
    bay = across > street.road
    line = bay & (s % 2.5 < 0.1)
    line |= np.abs(across - street.road) < 0.05
    along = s % 20.0 - 10.0
    arrow = (across < 0.1) & (np.abs(along) < 1.0)
    oil = bay & (noise2(s, d, 14) > 1.7)
    joint = (s % 8.0 < 0.03) | (d % 8.0 < 0.03)
    return np.select([line | arrow, oil, joint], [Part.MARKING, Part.PATCH, Part.JOINT], Part.CONCRETE).astype(np.uint8)


def _hall(street: Street, ids: NDArray[np.int32], s: Float32, d: Float32) -> Bytes:
    """A concrete floor with yellow lines along the racks, joints, and tyre marks."""
    a = np.abs(d)
    line = np.abs(a - street.road + 0.12) < 0.05
    line |= (a < street.road) & (np.abs(s % 40.0 - 1.2) < 0.05)
    joint = (s % 6.0 < 0.015) | (d % 6.0 < 0.015)
    mark = (a < street.road) & (noise2(s * 0.2, d, 20) > 1.9)
    return np.select([line, joint, mark], [Part.LINE, Part.JOINT, Part.PATCH], Part.CONCRETE).astype(np.uint8)


def _highway(street: Street, ids: NDArray[np.int32], s: Float32, d: Float32) -> Bytes:
    """Three lanes and a hard shoulder to the right, lines, and grass beyond."""
    half = street.road
    edge = (np.abs(d - (half - 0.6)) < 0.1) | (np.abs(d + (half - 3.0)) < 0.1)
    lane = (2 * half - 3.6) / 3
    inner = np.mod(half - 0.6 - d, lane)
    dash = ((inner < 0.075) | (inner > lane - 0.075)) & (s % 18.0 < 6.0) & (d > -(half - 3.2)) & (d < half - 0.8)
    patch = cell(s / 40, np.floor(d / lane), 3) < 0.2
    road = np.where(edge | dash, Part.MARKING, np.where(patch, Part.PATCH, Part.ASPHALT))
    return np.where(np.abs(d) < half, road, np.where(np.abs(d) < half + 0.8, Part.GRAVEL, Part.GRASS)).astype(np.uint8)


# Name of a ground -> the materials (n,) of ground ids (n,) at stations and offsets (n,) m.
GROUNDS: dict[str, Callable[[Street, NDArray[np.int32], Float32, Float32], Bytes]] = {
    "street": _street, "country": _country, "path": _path, "parking": _parking, "hall": _hall, "highway": _highway,
}  # fmt: skip
