"""Objects of the synthetic scenes: what stands in them, vehicles and people; each is added at a Builder's current frame."""

from __future__ import annotations

import numpy as np

from calib_ros.frame import SemanticClass as Label
from calib_ros_synthetic.solids import Builder, Numbers, Surface, pick_colour

Rng = np.random.Generator
WALL_PAINTS = [
    (0.62, 0.70, 0.72), (0.45, 0.60, 0.70), (0.30, 0.42, 0.60), (0.18, 0.22, 0.42), (0.55, 0.55, 0.55),
    (0.72, 0.75, 0.76), (0.38, 0.55, 0.50), (0.22, 0.30, 0.36), (0.50, 0.66, 0.74),
]  # fmt: skip
CAR_PAINTS = [
    (0.60, 0.60, 0.60), (0.75, 0.75, 0.75), (0.06, 0.06, 0.06), (0.25, 0.25, 0.26), (0.10, 0.09, 0.45),
    (0.40, 0.18, 0.08), (0.30, 0.22, 0.16), (0.12, 0.30, 0.14), (0.35, 0.45, 0.50), (0.05, 0.35, 0.62),
]  # fmt: skip

CARTONS = [(0.22, 0.36, 0.50), (0.28, 0.42, 0.56), (0.16, 0.28, 0.42), (0.55, 0.57, 0.58), (0.40, 0.30, 0.20), (0.12, 0.14, 0.16)]
CONCRETE = (0.40, 0.41, 0.42)


def pole(b: Builder, rng: Rng) -> None:
    """A street lamp with an arm over the road (to the left: y > 0) or a plain post."""
    r, height = rng.uniform(0.06, 0.11), rng.uniform(5.0, 8.0)
    grey = np.full(3, rng.uniform(0.12, 0.4))
    b.cylinder(Label.POLE, (0, 0, height / 2), (r, r, height / 2), grey, Surface.METAL)
    b.cylinder(Label.POLE, (0, 0, 0.5), (1.5 * r, 1.5 * r, 0.5), grey, Surface.METAL)
    if rng.random() < 0.75:
        b.box(Label.POLE, (0, 0.8, height - 0.1), (0.04, 0.8, 0.04), grey, Surface.METAL)
        b.box(Label.POLE, (0, 1.5, height - 0.17), (0.14, 0.35, 0.06), grey, Surface.METAL)


def sign(b: Builder, rng: Rng) -> None:
    """A traffic sign that faces the traffic, retro-reflective as real ones."""
    height, size = rng.uniform(2.0, 2.6), rng.uniform(0.3, 0.42)
    b.cylinder(Label.POLE, (0, 0, height / 2 + 0.2), (0.035, 0.035, height / 2 + 0.2), (0.4, 0.4, 0.4), Surface.METAL)
    colour = [(0.08, 0.05, 0.7), (0.6, 0.25, 0.05), (0.1, 0.6, 0.8), (0.8, 0.8, 0.8)][rng.integers(4)]
    wide = size * (1.0 if rng.random() < 0.7 else 1.7)
    b.box(Label.SIGN, (-0.06, 0, height), (0.015, wide, size), colour, Surface.SIGN, style=rng)


def clump(b: Builder, rng: Rng, centre: Numbers, half: Numbers, green: Numbers) -> None:
    """Some leaves."""
    b.ellipsoid(Label.VEGETATION, centre, half, green, Surface.LEAF, style=rng)


def tree(b: Builder, rng: Rng) -> None:
    """A trunk and a crown of several clumps of leaves with gaps."""
    r, trunk, spread = rng.uniform(0.10, 0.26), rng.uniform(2.0, 3.2), rng.uniform(1.3, 2.4)
    green = np.array([0.07, 0.22, 0.13]) * rng.uniform(0.7, 1.5) + [0, 0, rng.uniform(0, 0.10)]
    bark = np.array([0.12, 0.16, 0.20]) * rng.uniform(0.7, 1.3)
    b.cylinder(Label.VEGETATION, (0, 0, trunk / 2 + 0.4), (r, r, trunk / 2 + 0.4), bark, Surface.BARK)
    clump(b, rng, (0, 0, trunk + spread), (0.8 * spread, 0.8 * spread, spread), green)
    for k in range(5):
        a, size = k * 2 * np.pi / 5 + rng.uniform(-0.4, 0.4), spread * rng.uniform(0.5, 0.75)
        centre = (0.6 * spread * np.cos(a), 0.6 * spread * np.sin(a), trunk + spread * rng.uniform(0.45, 1.3))
        clump(b, rng, centre, (size, size, 0.8 * size), green * rng.uniform(0.8, 1.2))


def bush(b: Builder, rng: Rng) -> None:
    """A low clump of leaves."""
    green = np.array([0.08, 0.24, 0.14]) * rng.uniform(0.6, 1.3)
    for _ in range(2):
        size = rng.uniform(0.4, 0.9)
        clump(b, rng, (rng.uniform(-0.6, 0.6), rng.uniform(-0.3, 0.3), 0.6 * size), (size, size, 0.9 * size), green)


def border(b: Builder, rng: Rng, length: float) -> None:
    """Hedge, wall or fence along the pavement, centred on the frame's origin."""
    kind = rng.integers(3)
    if kind == 0:
        b.box(Label.VEGETATION, (0, 0, 0.6), (length / 2, 0.35, rng.uniform(0.5, 0.9)), (0.06, 0.2, 0.1), Surface.LEAF, style=rng)
    elif kind == 1:
        b.box(Label.BUILDING, (0, 0, 0.45), (length / 2, 0.12, rng.uniform(0.35, 0.6)), pick_colour(rng, WALL_PAINTS))
    else:
        b.box(Label.OTHER, (0, 0, 0.7), (length / 2, 0.03, rng.uniform(0.5, 0.8)), (0.2, 0.3, 0.4), Surface.FENCE, style=rng)


def bin_or_box(b: Builder, rng: Rng) -> None:
    """A waste bin or a cabinet of the telephone company."""
    half = (rng.uniform(0.2, 0.5), rng.uniform(0.18, 0.3), rng.uniform(0.45, 0.7))
    b.frustum(Label.OTHER, (0, 0, half[2]), half, rng.uniform(0.05, 0.45, 3), taper=(0.06, 0.06))


def billboard(b: Builder, rng: Rng) -> None:
    """A poster on two legs: the print has edges that no LiDAR sees."""
    for x in (-0.7, 0.7):
        b.cylinder(Label.POLE, (x, 0, 0.5), (0.05, 0.05, 0.5), (0.2, 0.2, 0.2), Surface.METAL)
    b.box(Label.OTHER, (0, 0, 1.7), (1.1, 0.08, 0.9), rng.uniform(0.05, 0.5, 3), Surface.POSTER, style=rng)


def house(b: Builder, rng: Rng, length: float, depth: float, height: float) -> None:
    """A building whose front faces -y, centred on the frame's origin: walls, roof, steps, pipes and sometimes a bay."""
    B, wall, style = Label.BUILDING, pick_colour(rng, WALL_PAINTS), rng.random(4)
    b.box(B, (0, 0, height / 2), (length / 2, depth / 2, height / 2), wall, Surface.FACADE, style=style)
    if rng.random() < 0.75:
        tiles = np.array([0.12, 0.16, 0.34]) * rng.uniform(0.5, 1.3)
        rise = rng.uniform(1.2, 2.4)
        b.frustum(B, (0, 0, height + rise), (length / 2 + 0.2, depth / 2 + 0.4, rise), tiles, Surface.ROOF, taper=(0.05, 0.96),
                  style=style)  # fmt: skip
        b.box(B, (rng.uniform(-0.3, 0.3) * length, 0, height + 2 * rise), (0.35, 0.35, 0.8), tiles)
    else:
        b.box(B, (0, 0, height + 0.15), (length / 2 + 0.15, depth / 2 + 0.15, 0.15), wall * 0.7)
    x = rng.choice([-1, 1]) * (length / 2 - 0.25)
    b.cylinder(B, (x, -depth / 2 - 0.08, height / 2), (0.06, 0.06, height / 2), (0.3, 0.3, 0.3), Surface.METAL)
    if rng.random() < 0.45:
        size, x = rng.uniform(0.8, 1.4), rng.uniform(-0.25, 0.25) * length
        top = min(height, rng.uniform(3.0, 6.0))
        b.box(B, (x, -depth / 2, top / 2), (size, rng.uniform(0.4, 0.9), top / 2), wall * 0.95, Surface.FACADE, style=rng)
    if rng.random() < 0.6:
        x = rng.uniform(-0.35, 0.35) * length
        b.box(B, (x, -depth / 2 - 0.4, 0.17), (0.7, 0.4, 0.17), (0.4, 0.42, 0.44))


def car(b: Builder, rng: Rng) -> None:
    """A hatchback, saloon, estate or van: body, cabin, wheels, mirrors."""
    paint, style = pick_colour(rng, CAR_PAINTS), rng.random(4)
    van = rng.random() < 0.15
    length, width = (rng.uniform(4.7, 5.6), 2.0) if van else (rng.uniform(3.6, 4.8), rng.uniform(1.66, 1.86))
    height = rng.uniform(1.95, 2.5) if van else rng.uniform(1.4, 1.62)
    waist = 0.55 * height if van else rng.uniform(0.80, 0.92)  # height of the bonnet
    V = Label.VEHICLE
    b.frustum(V, (0, 0, (waist + 0.2) / 2), (length / 2, width / 2, (waist - 0.2) / 2), paint, Surface.BODY, taper=(0.04, 0.05),
              style=style)  # fmt: skip
    back, front = (0.02, 0.24) if van else (rng.uniform(0.02, 0.16), rng.uniform(0.24, 0.30))
    cabin = length * (1 - back - front)
    lean = (0.10, 0.10) if van else (rng.uniform(0.24, 0.40), 0.22)
    half = (cabin / 2, width / 2 * 0.96, (height - waist) / 2 + 0.01)
    middle = (length * (back - front) / 2, 0, (waist + height) / 2 - 0.01)
    b.frustum(V, middle, half, paint, Surface.CABIN, taper=lean, style=style)
    r = rng.uniform(0.29, 0.35)
    for x in (-0.5 * length + 0.17 * length, 0.5 * length - 0.18 * length):
        for y in (-1, 1):
            b.wheel(V, (x, y * (width / 2 - 0.09), r), (r, 0.11, r), (0.03, 0.03, 0.03), Surface.TYRE)
    for y in (-1, 1):
        x = length * (0.5 - front) - 0.25
        b.ellipsoid(V, (x, y * (width / 2 + 0.07), waist + 0.07), (0.07, 0.10, 0.07), paint)


def truck(b: Builder, rng: Rng) -> None:
    """A delivery truck with a box body."""
    V, length, style = Label.VEHICLE, rng.uniform(4.2, 5.8), rng.random(4)
    paint = pick_colour(rng, CAR_PAINTS)
    b.box(V, (-1.0, 0, 1.95), (length / 2, 1.15, 1.15), rng.uniform(0.05, 0.6, 3), Surface.POSTER, style=style)
    b.box(V, (-0.2, 0, 0.62), (length / 2 + 0.6, 0.9, 0.17), (0.08, 0.08, 0.08))
    b.frustum(V, (length / 2, 0, 1.9), (0.9, 1.03, 0.6), paint, Surface.CABIN, taper=(0.2, 0.1), style=style)
    b.box(V, (length / 2, 0, 0.85), (0.95, 1.05, 0.5), paint, Surface.BODY, style=style)
    for x in (-1.0 - length / 4, length / 2):
        for y in (-1, 1):
            b.wheel(V, (x, 0.95 * y, 0.45), (0.45, 0.14, 0.45), (0.03, 0.03, 0.03), Surface.TYRE)


def person(b: Builder, rng: Rng, label: Label = Label.PERSON, lean: float = 0.0, seat: float = 0.0) -> None:
    """Someone who stands or walks; `lean` moves the upper body forward and `seat` all of it up, as a rider's (m)."""
    trousers, coat = rng.uniform(0.03, 0.3, 3), rng.uniform(0.03, 0.6, 3)
    k, stride, style = rng.uniform(0.9, 1.08), rng.uniform(0.05, 0.22), rng.random(4)

    def limb(surface: Surface, x: float, y: float, z: float, half: tuple[float, float, float], colour: Numbers) -> None:
        b.ellipsoid(label, (x, y, seat + z * k), half, colour, surface, style=style)

    for side in (-1, 1):
        limb(Surface.CLOTH, side * stride, side * 0.09, 0.42, (0.11, 0.09, 0.47 * k), trousers)
        limb(Surface.CLOTH, lean - side * 0.08, side * 0.25, 1.10, (0.08, 0.06, 0.34 * k), coat)
    limb(Surface.CLOTH, 0.7 * lean, 0, 1.14, (0.15, 0.23, 0.38 * k), coat)
    limb(Surface.SKIN, 1.3 * lean, 0, 1.60, (0.11, 0.09, 0.14), (0.35, 0.45, 0.62))


def cyclist(b: Builder, rng: Rng) -> None:
    """A rider on a bicycle."""
    C, paint = Label.CYCLIST, rng.uniform(0.05, 0.6, 3)
    for x in (-0.52, 0.52):
        b.wheel(C, (x, 0, 0.34), (0.34, 0.02, 0.34), (0.04, 0.04, 0.04), Surface.TYRE)
    b.box(C, (0, 0, 0.62), (0.42, 0.025, 0.04), paint)
    b.box(C, (0.46, 0, 0.98), (0.03, 0.27, 0.02), (0.05, 0.05, 0.05))
    person(b, rng, C, lean=0.22, seat=0.32)


def broadleaf(b: Builder, rng: Rng) -> None:
    """An old tree: a thick trunk, boughs, and a wide crown of clumps of leaves that hangs low."""
    r, trunk, spread = rng.uniform(0.18, 0.42), rng.uniform(1.6, 3.4), rng.uniform(2.2, 4.2)
    green = np.array([0.06, 0.20, 0.12]) * rng.uniform(0.6, 1.5) + [0, 0, rng.uniform(0, 0.12)]
    bark = np.array([0.12, 0.16, 0.20]) * rng.uniform(0.6, 1.4)
    V = Label.VEGETATION
    b.cylinder(V, (0, 0, 0.7 * trunk), (r, r, 0.7 * trunk), bark, Surface.BARK)
    b.ellipsoid(V, (0, 0, 0.1), (1.7 * r, 1.5 * r, 0.35), bark, Surface.BARK)  # roots
    for k in range(6):
        a, size = k * 2 * np.pi / 5 + rng.uniform(-0.5, 0.5), spread * rng.uniform(0.4, 0.65)
        reach = 0.0 if k == 5 else spread * rng.uniform(0.4, 0.75)
        centre = (reach * np.cos(a), reach * np.sin(a), trunk + spread * rng.uniform(0.2, 1.3))
        clump(b, rng, centre, (size, size * rng.uniform(0.8, 1.2), 0.75 * size), green * rng.uniform(0.75, 1.25))


def conifer(b: Builder, rng: Rng) -> None:
    """A spruce: clumps of needles that get narrower upwards."""
    height, width = rng.uniform(5, 13), rng.uniform(1.2, 2.2)
    green = np.array([0.07, 0.15, 0.09]) * rng.uniform(0.7, 1.3)
    b.cylinder(Label.VEGETATION, (0, 0, 0.5), (0.15, 0.15, 0.5), (0.10, 0.13, 0.17), Surface.BARK)
    layers = 4
    for k in range(layers):
        w = width * (1 - k / layers) * rng.uniform(0.9, 1.1)
        centre = (0, 0, 0.4 + (k + 0.75) * height / (layers + 0.5))
        clump(b, rng, centre, (w, w, 0.75 * height / layers), green * rng.uniform(0.85, 1.15))


def thicket(b: Builder, rng: Rng) -> None:
    """Undergrowth: low clumps of leaves of several sizes."""
    green = np.array([0.07, 0.22, 0.13]) * rng.uniform(0.6, 1.4)
    for _ in range(rng.integers(1, 4)):
        size = rng.uniform(0.25, 1.1)
        centre = (rng.normal(0, 0.8), rng.normal(0, 0.8), 0.6 * size)
        half = (size, size * rng.uniform(0.7, 1.3), size * rng.uniform(0.6, 1.2))
        clump(b, rng, centre, half, green * rng.uniform(0.8, 1.2))


def boulder(b: Builder, rng: Rng) -> None:
    """A rock half in the ground."""
    size = rng.uniform(0.2, 0.7)
    b.ellipsoid(Label.OTHER, (0, 0, 0.2 * size), (size, size * rng.uniform(0.6, 1), 0.7 * size),
                np.full(3, rng.uniform(0.15, 0.35)))  # fmt: skip


def bench(b: Builder, rng: Rng) -> None:
    """A bench that faces -y."""
    wood = (0.14, 0.22, 0.32)
    b.box(Label.OTHER, (0, 0, 0.45), (0.8, 0.22, 0.03), wood, style=rng)
    b.box(Label.OTHER, (0, 0.24, 0.75), (0.8, 0.03, 0.18), wood, style=rng)
    for x in (-0.6, 0.6):
        b.box(Label.OTHER, (x, 0.02, 0.22), (0.04, 0.2, 0.22), (0.08, 0.08, 0.08), Surface.METAL)


def delineator(b: Builder, rng: Rng) -> None:
    """A post at the edge of a country road."""
    b.box(Label.POLE, (0, 0, 0.5), (0.06, 0.05, 0.5), (0.75, 0.75, 0.75))
    b.box(Label.POLE, (-0.055, 0, 0.8), (0.012, 0.04, 0.09), (0.1, 0.1, 0.1), Surface.SIGN, style=rng)


def pillar(b: Builder, rng: Rng, height: float) -> None:
    """A concrete pillar with a painted foot."""
    size = 0.5 * rng.uniform(0.4, 0.6)
    b.box(Label.BUILDING, (0, 0, height / 2), (size, size, height / 2), CONCRETE)
    b.box(Label.BUILDING, (0, 0, 0.55), (size + 0.01, size + 0.01, 0.45), (0.08, 0.55, 0.70))


def slab(b: Builder, length: float, width: float, height: float, beams: float) -> None:
    """A ceiling over length x width m with its underside at `height`, beams across every `beams` m, and rows of lamps."""
    C, B = Surface.CEILING, Label.BUILDING
    b.box(B, (0, 0, height + 0.15), (length / 2, width / 2, 0.15), (0.62, 0.63, 0.63), C)
    for x in np.arange(-length / 2 + beams / 2, length / 2, beams):
        b.box(B, (x, 0, height - 0.18), (0.15, width / 2, 0.18), CONCRETE, C)
        for y in np.arange(-width / 2 + 4, width / 2, 8.0):
            b.box(Label.OTHER, (x + beams / 2, y, height - 0.12), (0.75, 0.09, 0.05), (0.9, 0.9, 0.9), C)


def duct(b: Builder, rng: Rng, length: float, height: float) -> None:
    """A pipe along the ceiling."""
    size = rng.uniform(0.1, 0.3)
    b.box(Label.OTHER, (0, 0, height - 0.5 - size), (length / 2, size, size), (0.45, 0.46, 0.46), Surface.METAL)


def rack(b: Builder, rng: Rng, bay: float, depth: float, levels: int, step: float) -> None:
    """One bay of pallet racking that faces -y: uprights, beams, and goods on pallets."""
    top = levels * step
    blue, orange = (0.45, 0.22, 0.06), (0.05, 0.30, 0.75)
    other = Label.OTHER
    for y in (-depth / 2, depth / 2):
        b.box(other, (-bay / 2, y, top / 2), (0.05, 0.05, top / 2), blue, Surface.METAL)
    for level in range(levels):
        z = level * step
        if level:
            b.box(other, (0, -depth / 2, z), (bay / 2, 0.03, 0.06), orange, Surface.METAL)
            b.box(other, (0, 0, z + 0.02), (bay / 2, depth / 2 - 0.05, 0.02), (0.25, 0.30, 0.34))
        for x in (-bay / 4, bay / 4):
            if rng.random() < 0.82:
                b_x, height = x + rng.normal(0, 0.05), rng.uniform(0.35, 0.72) * step
                half = (rng.uniform(0.38, 0.58), rng.uniform(0.34, 0.48), height / 2)
                surface = Surface.POSTER if rng.random() < 0.35 else Surface.PLAIN
                b.box(other, (b_x, rng.normal(0, 0.04), z + 0.20 + height / 2), half, pick_colour(rng, CARTONS), surface,
                      style=rng)  # fmt: skip
                b.box(other, (b_x, 0, z + 0.12), (0.58, 0.46, 0.07), (0.20, 0.32, 0.44))


def pallet(b: Builder, rng: Rng) -> None:
    """Goods on the floor."""
    height = rng.uniform(0.3, 1.5)
    b.box(Label.OTHER, (0, 0, 0.08), (0.6, 0.4, 0.07), (0.20, 0.32, 0.44))
    b.box(Label.OTHER, (0, 0, 0.15 + height / 2), (0.55, 0.38, height / 2), pick_colour(rng, CARTONS), Surface.POSTER, style=rng)


def forklift(b: Builder) -> None:
    """A forklift with its mast to +x."""
    V, yellow = Label.VEHICLE, (0.04, 0.45, 0.70)
    b.box(V, (-0.3, 0, 0.7), (0.9, 0.55, 0.45), yellow)
    for x in (-0.9, 0.35):
        for y in (-0.5, 0.5):
            b.box(V, (x, y, 1.6), (0.04, 0.04, 0.55), (0.05, 0.05, 0.05), Surface.METAL)
            b.wheel(V, (x, y, 0.3), (0.3, 0.1, 0.3), (0.03, 0.03, 0.03), Surface.TYRE)
    b.box(V, (-0.3, 0, 2.15), (0.7, 0.55, 0.04), (0.05, 0.05, 0.05))
    for y in (-0.3, 0.3):
        b.box(V, (0.8, y, 1.2), (0.06, 0.05, 1.15), (0.10, 0.10, 0.10), Surface.METAL)
        b.box(V, (1.35, y, 0.1), (0.5, 0.06, 0.03), (0.10, 0.10, 0.10), Surface.METAL)


def wall(b: Builder, rng: Rng, length: float, height: float, colour: tuple[float, float, float] = (0.55, 0.56, 0.56)) -> None:
    """A wall along x, with pipes and a cabinet."""
    b.box(Label.BUILDING, (0, 0, height / 2), (length / 2, 0.12, height / 2), colour)
    for _ in range(int(length / 6)):
        x, r = rng.uniform(-length / 2, length / 2), rng.uniform(0.05, 0.12)
        b.cylinder(Label.BUILDING, (x, -0.2, height / 2), (r, r, height / 2), (0.25, 0.2, 0.3), Surface.METAL)
    b.box(Label.OTHER, (rng.uniform(-0.4, 0.4) * length, -0.2, 1.4), (0.5, 0.1, 0.7), rng.uniform(0.1, 0.6, 3), Surface.POSTER,
          style=rng)  # fmt: skip


def guard_rail(b: Builder, length: float) -> None:
    """A guard rail along x with a post every 4 m."""
    b.box(Label.OTHER, (0, 0, 0.68), (length / 2, 0.04, 0.15), (0.45, 0.46, 0.46), Surface.METAL)
    for x in np.arange(-length / 2 + 2, length / 2, 4.0):
        b.box(Label.POLE, (x, 0.08, 0.38), (0.05, 0.04, 0.38), (0.35, 0.35, 0.35), Surface.METAL)


def gantry(b: Builder, rng: Rng, span: float) -> None:
    """A sign bridge across the road, centred on it, that faces the traffic (-x)."""
    grey = (0.45, 0.46, 0.47)
    for y in (-span / 2, span / 2):
        b.cylinder(Label.POLE, (0, y, 3.4), (0.2, 0.2, 3.4), grey, Surface.METAL)
    for z in (5.6, 6.6):
        b.box(Label.POLE, (0, 0, z), (0.12, span / 2, 0.1), grey, Surface.METAL)
    for y in np.arange(-span / 2 + 4, span / 2 - 3, 6.5):
        b.box(Label.SIGN, (-0.3, y, 6.1), (0.05, 2.2, rng.uniform(0.9, 1.4)), (0.55, 0.22, 0.03), Surface.SIGN, style=rng)


def road_sign(b: Builder, rng: Rng) -> None:
    """A large sign on two posts beside a highway."""
    wide, high = rng.uniform(1.2, 2.2), rng.uniform(0.8, 1.4)
    for y in (-0.6 * wide, 0.6 * wide):
        b.cylinder(Label.POLE, (0.08, y, 1.9), (0.06, 0.06, 1.9), (0.4, 0.4, 0.4), Surface.METAL)
    b.box(Label.SIGN, (0, 0, 2.2 + high), (0.03, wide, high), (0.55, 0.22, 0.03), Surface.SIGN, style=rng)


def lorry(b: Builder, rng: Rng) -> None:
    """An articulated lorry."""
    V, paint = Label.VEHICLE, pick_colour(rng, CAR_PAINTS)
    b.box(V, (-2.2, 0, 2.55), (6.6, 1.27, 1.4), rng.uniform(0.05, 0.6, 3), Surface.POSTER, style=rng)
    b.box(V, (-2.0, 0, 0.9), (6.4, 1.0, 0.2), (0.08, 0.08, 0.08))
    b.frustum(V, (6.0, 0, 2.3), (1.1, 1.2, 1.4), paint, Surface.CABIN, taper=(0.1, 0.05), style=rng)
    b.box(V, (6.0, 0, 0.75), (1.15, 1.22, 0.35), paint, Surface.BODY, style=rng)
    for x in (-7.5, -6.2, -4.9, 3.6, 6.2):
        for y in (-1, 1):
            b.wheel(V, (x, 1.05 * y, 0.5), (0.5, 0.2, 0.5), (0.03, 0.03, 0.03), Surface.TYRE)
