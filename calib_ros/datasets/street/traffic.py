"""Vehicles and people of the synthetic street. Each function adds one to a Builder whose frame is already set.

Sizes are metres, colours BGR albedos. The x axis points forward, y to the left.
"""

from __future__ import annotations

import numpy as np

from calib_ros.classes import SemanticClass as Label
from calib_ros.datasets.street.solids import Builder, Kind, Numbers, Surface, pick_colour

Rng = np.random.Generator

CAR_PAINTS = [
    (0.60, 0.60, 0.60), (0.75, 0.75, 0.75), (0.06, 0.06, 0.06), (0.25, 0.25, 0.26), (0.10, 0.09, 0.45),
    (0.40, 0.18, 0.08), (0.30, 0.22, 0.16), (0.12, 0.30, 0.14), (0.35, 0.45, 0.50), (0.05, 0.35, 0.62),
]  # fmt: skip


def car(b: Builder, rng: Rng) -> None:
    """A hatchback, saloon, estate or van: body, cabin, wheels, mirrors."""
    paint, style = pick_colour(rng, CAR_PAINTS), rng.random(4)
    van = rng.random() < 0.15
    length, width = (rng.uniform(4.7, 5.6), 2.0) if van else (rng.uniform(3.6, 4.8), rng.uniform(1.66, 1.86))
    height = rng.uniform(1.95, 2.5) if van else rng.uniform(1.4, 1.62)
    waist = 0.55 * height if van else rng.uniform(0.80, 0.92)  # height of the bonnet
    V = Label.VEHICLE
    b.add(Kind.FRUSTUM, Surface.BODY, V, (0, 0, (waist + 0.2) / 2), (length / 2, width / 2, (waist - 0.2) / 2),
          paint, taper=(0.04, 0.05), style=style)  # fmt: skip
    back, front = (0.02, 0.24) if van else (rng.uniform(0.02, 0.16), rng.uniform(0.24, 0.30))
    cabin = length * (1 - back - front)
    b.add(Kind.FRUSTUM, Surface.CABIN, V, (length * (back - front) / 2, 0, (waist + height) / 2 - 0.01),
          (cabin / 2, width / 2 * 0.96, (height - waist) / 2 + 0.01), paint,
          taper=(0.10 if van else rng.uniform(0.24, 0.40), 0.10 if van else 0.22), style=style)  # fmt: skip
    r = rng.uniform(0.29, 0.35)
    for x in (-0.5 * length + 0.17 * length, 0.5 * length - 0.18 * length):
        for y in (-1, 1):
            b.add(Kind.WHEEL, Surface.TYRE, V, (x, y * (width / 2 - 0.09), r), (r, 0.11, r), (0.03, 0.03, 0.03))
    for y in (-1, 1):
        x = length * (0.5 - front) - 0.25
        b.add(Kind.ELLIPSOID, Surface.PLAIN, V, (x, y * (width / 2 + 0.07), waist + 0.07), (0.07, 0.10, 0.07), paint)


def truck(b: Builder, rng: Rng) -> None:
    """A delivery truck with a box body."""
    V, length, style = Label.VEHICLE, rng.uniform(4.2, 5.8), rng.random(4)
    paint = pick_colour(rng, CAR_PAINTS)
    b.add(Kind.BOX, Surface.POSTER, V, (-1.0, 0, 1.95), (length / 2, 1.15, 1.15), rng.uniform(0.05, 0.6, 3), style=style)
    b.add(Kind.BOX, Surface.PLAIN, V, (-0.2, 0, 0.62), (length / 2 + 0.6, 0.9, 0.17), (0.08, 0.08, 0.08))
    b.add(Kind.FRUSTUM, Surface.CABIN, V, (length / 2, 0, 1.9), (0.9, 1.03, 0.6), paint, taper=(0.2, 0.1), style=style)
    b.add(Kind.BOX, Surface.BODY, V, (length / 2, 0, 0.85), (0.95, 1.05, 0.5), paint, style=style)
    for x in (-1.0 - length / 4, length / 2):
        for y in (-1, 1):
            b.add(Kind.WHEEL, Surface.TYRE, V, (x, 0.95 * y, 0.45), (0.45, 0.14, 0.45), (0.03, 0.03, 0.03))


def person(b: Builder, rng: Rng, label: Label = Label.PERSON, lean: float = 0.0, seat: float = 0.0) -> None:
    """Someone who stands or walks; `lean` moves the upper body forward and `seat` all of it up, as a rider's (m)."""
    trousers, coat = rng.uniform(0.03, 0.3, 3), rng.uniform(0.03, 0.6, 3)
    k, stride, style = rng.uniform(0.9, 1.08), rng.uniform(0.05, 0.22), rng.random(4)

    def limb(surface: Surface, x: float, y: float, z: float, half: tuple[float, float, float], colour: Numbers) -> None:
        b.add(Kind.ELLIPSOID, surface, label, (x, y, seat + z * k), half, colour, style=style)

    for side in (-1, 1):
        limb(Surface.CLOTH, side * stride, side * 0.09, 0.42, (0.11, 0.09, 0.47 * k), trousers)
        limb(Surface.CLOTH, lean - side * 0.08, side * 0.25, 1.10, (0.08, 0.06, 0.34 * k), coat)
    limb(Surface.CLOTH, 0.7 * lean, 0, 1.14, (0.15, 0.23, 0.38 * k), coat)
    limb(Surface.SKIN, 1.3 * lean, 0, 1.60, (0.11, 0.09, 0.14), (0.35, 0.45, 0.62))


def cyclist(b: Builder, rng: Rng) -> None:
    """A rider on a bicycle."""
    C, paint = Label.CYCLIST, rng.uniform(0.05, 0.6, 3)
    for x in (-0.52, 0.52):
        b.add(Kind.WHEEL, Surface.TYRE, C, (x, 0, 0.34), (0.34, 0.02, 0.34), (0.04, 0.04, 0.04))
    b.add(Kind.BOX, Surface.PLAIN, C, (0, 0, 0.62), (0.42, 0.025, 0.04), paint)
    b.add(Kind.BOX, Surface.PLAIN, C, (0.46, 0, 0.98), (0.03, 0.27, 0.02), (0.05, 0.05, 0.05))
    person(b, rng, C, lean=0.22, seat=0.32)
