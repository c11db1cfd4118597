"""Materials of the synthetic scenes and their colours, BGR."""

from __future__ import annotations

from enum import IntEnum

import numpy as np


class Part(IntEnum):
    """Materials, finer than solids: borders between them are edges in the image, and steps in the LiDAR's intensity."""

    (
        SKY, ASPHALT, PATCH, MARKING, SLAB, JOINT, GRASS, STONE, WALL, WINDOW, FRAME, DOOR, TILES, PAINT, GLASS,
        RUBBER, RIM, LAMP, BARK, LEAF, CLOTH, SKIN, HAIR, METAL, BOARD, SYMBOL, SLAT, PRINT, PLAIN, GRAVEL, CONCRETE,
        LINE
    ) = range(32)  # fmt: skip


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
