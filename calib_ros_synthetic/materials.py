"""Materials of the synthetic scenes and their colours, BGR."""

from __future__ import annotations

from enum import IntEnum

import numpy as np


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
    GRAVEL = 29
    CONCRETE = 30
    LINE = 31  # yellow, on floors


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
    Part.GRAVEL: ((0.24, 0.30, 0.34), 0.35, 70, 0.0),
    Part.CONCRETE: ((0.30, 0.31, 0.32), 0.10, 14, 0.02),
    Part.LINE: ((0.06, 0.42, 0.55), 0.10, 25, 0.0),
}
OWN_COLOUR = np.array([MATERIALS[p][0] is None for p in Part])
ALBEDO = np.array([MATERIALS[p][0] or (0, 0, 0) for p in Part], np.float32)
CONTRAST, GRAIN, GLOSS = (np.array([MATERIALS[p][k] for p in Part], np.float32) for k in (1, 2, 3))
