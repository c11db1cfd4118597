"""Finishes: colour, pattern, grain and gloss of what a world is made of, drawn anew for every world."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

Rng = np.random.Generator
Float32 = NDArray[np.float32]
Colour = tuple[float, float, float]
ODD = 0.10  # share of colours that nobody would choose: shape and texture must do, too


class Pattern(IntEnum):
    """How the two colours of a finish are laid out."""

    NONE = 0
    BRICK = 1  # rows, every other one shifted, with joints of the second colour
    GRID = 2  # tiles, slabs, panels
    ROWS = 3  # siding, planks, louvres
    COLUMNS = 4  # corrugated sheet, pickets
    BLOTCH = 5  # patches of the second colour, by noise
    PRINT = 6  # lettering and pictures of posters


@dataclass(frozen=True)
class Finish:
    """a, b: colours. size: m of a cell of the pattern along and up. joint: m. spread: of the brightness from cell to cell.

    fine, broad: size of the noise with `grain` entries per metre, and with two. gloss: share mirrored. emit: light of its own.
    """

    a: Colour
    b: Colour
    pattern: int = Pattern.NONE
    size: tuple[float, float] = (1.0, 1.0)
    joint: float = 0.02
    spread: float = 0.0
    fine: float = 0.08
    grain: float = 25.0
    broad: float = 0.06
    gloss: float = 0.0
    emit: float = 0.0


def hsv(hue: float, saturation: float, value: float) -> Colour:
    """BGR of a hue (0 red, 1/3 green, 2/3 blue; repeats), all 0..1."""
    r, g, b = colorsys.hsv_to_rgb(hue % 1.0, min(max(saturation, 0.0), 1.0), min(max(value, 0.01), 0.95))
    return b, g, r


def any_colour(rng: Rng) -> Colour:
    """Any colour at all."""
    return hsv(rng.random(), rng.random() ** 1.5, rng.uniform(0.03, 0.9))


def scaled(colour: Colour, factor: float) -> Colour:
    """A lighter or darker one of the same hue."""
    b, g, r = (min(max(c * factor, 0.005), 0.95) for c in colour)
    return b, g, r


def wall_colour(rng: Rng) -> Colour:
    """Plaster and stone: often near white, else greys, ochres, reds and pastels."""
    kind = rng.random()
    if kind < ODD:
        return any_colour(rng)
    if kind < 0.38:
        return hsv(rng.uniform(0.05, 0.18), rng.uniform(0.0, 0.12), rng.uniform(0.6, 0.93))
    if kind < 0.58:
        return hsv(rng.uniform(0.0, 0.7), rng.uniform(0.0, 0.12), rng.uniform(0.12, 0.6))
    if kind < 0.88:
        return hsv(rng.uniform(0.02, 0.14), rng.uniform(0.1, 0.6), rng.uniform(0.2, 0.75))
    return hsv(rng.random(), rng.uniform(0.08, 0.35), rng.uniform(0.3, 0.75))


def wall(rng: Rng) -> Finish:
    """Plaster, brick, stone, siding, panels or concrete."""
    colour, kind = wall_colour(rng), rng.random()
    common: dict[str, Any] = {"fine": rng.uniform(0.01, 0.14), "grain": rng.uniform(8, 50), "broad": rng.uniform(0.01, 0.12)}
    joint = scaled(colour, rng.choice([rng.uniform(0.4, 0.85), rng.uniform(1.1, 1.7)]))
    if kind < 0.42:
        return Finish(colour, joint, Pattern.NONE, **common)
    if kind < 0.68:
        if rng.random() < 0.8:  # bricks are mostly red, brown or yellow
            colour = hsv(rng.uniform(0.01, 0.12), rng.uniform(0.25, 0.7), rng.uniform(0.12, 0.5))
            joint = hsv(0.1, rng.uniform(0, 0.2), rng.uniform(0.15, 0.6))
        low, high = ((0.2, 0.065), (0.3, 0.1)) if rng.random() < 0.7 else ((0.3, 0.2), (0.9, 0.5))
        size = (rng.uniform(low[0], high[0]), rng.uniform(low[1], high[1]))
        return Finish(colour, joint, Pattern.BRICK, size, 0.012 + 0.03 * size[1], rng.uniform(0.03, 0.25), **common)
    if kind < 0.82:
        size = (rng.uniform(0.6, 3.0), rng.uniform(0.5, 2.0))
        return Finish(colour, joint, Pattern.GRID, size, rng.uniform(0.015, 0.05), rng.uniform(0, 0.12), **common)
    pattern = Pattern.ROWS if rng.random() < 0.6 else Pattern.COLUMNS
    size = (rng.uniform(0.1, 0.5),) * 2
    return Finish(colour, joint, pattern, size, rng.uniform(0.01, 0.05), rng.uniform(0, 0.15), **common)


def roof(rng: Rng) -> Finish:
    """Tiles, slate, sheet metal or felt."""
    if rng.random() < ODD:
        colour = any_colour(rng)
    elif rng.random() < 0.5:
        colour = hsv(rng.uniform(0.0, 0.08), rng.uniform(0.3, 0.7), rng.uniform(0.12, 0.45))
    else:
        colour = hsv(rng.uniform(0.5, 0.7), rng.uniform(0, 0.2), rng.uniform(0.04, 0.3))
    size = (rng.uniform(0.2, 0.4), rng.uniform(0.2, 0.4))
    pattern = (Pattern.BRICK, Pattern.ROWS, Pattern.COLUMNS, Pattern.NONE)[int(rng.integers(4))]
    return Finish(colour, scaled(colour, 0.6), pattern, size, 0.04, rng.uniform(0.05, 0.25), rng.uniform(0.05, 0.2), 30, 0.12)


def paint(rng: Rng) -> Finish:
    """Of vehicles: mostly white, grey, silver and black."""
    kind = rng.random()
    if kind < 0.62:
        hue, grey = rng.uniform(0.5, 0.7), rng.uniform(0, 0.12)
        colour = hsv(hue, grey, rng.choice([0.02, 0.05, 0.1, 0.25, 0.4, 0.55, 0.8]) * rng.uniform(0.8, 1.2))
    elif kind < 0.92:
        hue = rng.choice([0.0, 0.02, 0.58, 0.62, 0.66, 0.35, 0.12]) + rng.normal(0, 0.02)
        colour = hsv(hue, rng.uniform(0.5, 1), rng.uniform(0.05, 0.6))
    else:
        colour = any_colour(rng)
    fine, broad = rng.uniform(0, 0.03), rng.uniform(0, 0.05)
    return Finish(colour, scaled(colour, 0.5), fine=fine, broad=broad, gloss=rng.uniform(0.04, 0.22))


def asphalt(rng: Rng) -> Finish:
    """Of roads: dark when new, light grey when old, seldom red or concrete."""
    colour = hsv(rng.uniform(0.0, 0.7), rng.uniform(0, 0.12), rng.uniform(0.05, 0.32))
    if rng.random() < 0.1:
        colour = hsv(rng.uniform(0, 0.12), rng.uniform(0.1, 0.4), rng.uniform(0.1, 0.4))
    kind = rng.random()
    noise: dict[str, Any] = {"fine": rng.uniform(0.04, 0.28), "grain": rng.uniform(25, 70), "broad": rng.uniform(0.02, 0.16)}
    if kind < 0.78:
        return Finish(colour, scaled(colour, rng.uniform(0.5, 1.5)), Pattern.NONE, **noise)
    if kind < 0.9:  # setts
        size = (rng.uniform(0.1, 0.25), rng.uniform(0.1, 0.18))
        return Finish(colour, scaled(colour, rng.uniform(0.4, 0.8)), Pattern.BRICK, size, 0.012, rng.uniform(0.1, 0.3), **noise)
    return Finish(colour, scaled(colour, 0.5), Pattern.GRID, (rng.uniform(3, 6), rng.uniform(2.5, 5)), 0.04, 0.1, **noise)


def paving(rng: Rng) -> Finish:
    """Of pavements: slabs, bricks, setts, asphalt."""
    colour = hsv(rng.uniform(0.0, 0.15), rng.uniform(0, 0.3), rng.uniform(0.1, 0.55)) if rng.random() > ODD else any_colour(rng)
    size = rng.choice([rng.uniform(0.08, 0.2), rng.uniform(0.25, 0.6), rng.uniform(0.4, 1.0)])
    pattern = (Pattern.BRICK, Pattern.GRID, Pattern.NONE)[int(rng.choice(3, p=[0.35, 0.4, 0.25]))]
    return Finish(colour, scaled(colour, rng.uniform(0.4, 0.9)), pattern, (size * rng.uniform(1, 2), size), 0.008 + 0.02 * size,
                  rng.uniform(0.02, 0.2), rng.uniform(0.03, 0.2), rng.uniform(20, 60), rng.uniform(0.03, 0.18))  # fmt: skip


def turf(rng: Rng) -> Finish:
    """Lawn, meadow, soil or gravel."""
    kind = rng.random()
    if kind < 0.7:
        colour = hsv(rng.uniform(0.17, 0.36), rng.uniform(0.35, 0.8), rng.uniform(0.08, 0.3))
    else:
        colour = hsv(rng.uniform(0.05, 0.14), rng.uniform(0.1, 0.6), rng.uniform(0.08, 0.45))
    other = hsv(rng.uniform(0.07, 0.3), rng.uniform(0.2, 0.7), rng.uniform(0.08, 0.35))
    size, fine = (rng.uniform(0.3, 3), 1), rng.uniform(0.15, 0.4)
    return Finish(colour, other, Pattern.BLOTCH, size, fine=fine, grain=rng.uniform(25, 70), broad=0.15)


def foliage(rng: Rng) -> Finish:
    """Leaves: greens of every kind, some autumn, blossom or bare twigs."""
    kind = rng.random()
    if kind < 0.75:
        colour = hsv(rng.uniform(0.17, 0.36), rng.uniform(0.35, 0.85), rng.uniform(0.05, 0.3))
    elif kind < 0.88:
        colour = hsv(rng.uniform(0.03, 0.15), rng.uniform(0.4, 0.9), rng.uniform(0.1, 0.5))
    elif kind < 0.96:
        colour = hsv(rng.uniform(0.03, 0.12), rng.uniform(0.1, 0.4), rng.uniform(0.04, 0.2))
    else:
        colour = any_colour(rng)
    other = scaled(colour, rng.uniform(0.3, 0.8)) if rng.random() < 0.85 else any_colour(rng)  # flowers
    size, fine = (rng.uniform(0.15, 1.0), 1), rng.uniform(0.3, 0.7)
    return Finish(colour, other, Pattern.BLOTCH, size, fine=fine, grain=rng.uniform(10, 30), broad=0.2)


def plain(rng: Rng, colour: Colour | None = None, gloss: float = 0.0, fine: float = 0.05) -> Finish:
    """One colour with a little noise; any colour if none is given."""
    colour = any_colour(rng) if colour is None else colour
    return Finish(colour, scaled(colour, 0.7), fine=fine, gloss=gloss)


def cloth(rng: Rng) -> Finish:
    """Clothes: mostly dark, some light or garish, some striped."""
    value = rng.choice([rng.uniform(0.015, 0.12), rng.uniform(0.1, 0.4), rng.uniform(0.4, 0.85)], p=[0.55, 0.25, 0.2])
    colour = hsv(rng.random(), rng.random() ** 1.5, float(value))
    pattern = Pattern.ROWS if rng.random() < 0.1 else Pattern.NONE
    return Finish(colour, any_colour(rng), pattern, (0.1, rng.uniform(0.06, 0.2)), 0.04, 0.0, 0.12, 30, 0.12)


def poster(rng: Rng) -> Finish:
    """A print of two colours."""
    size = rng.uniform(0.05, 0.35)
    return Finish(any_colour(rng), any_colour(rng), Pattern.PRINT, (size, size), 0.02, rng.uniform(0, 0.4), 0.04, 20, 0.1)
