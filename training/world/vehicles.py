"""Vehicles of many shapes: cars, vans, pick-ups, buses, lorries. x is forward, the frame on the ground below the middle."""

from __future__ import annotations

from training.world import looks
from training.world.looks import Rng
from training.world.stage import CAR, Cover, Stage


def _style(stage: Stage, rng: Rng, length: float, tall: float, radius: float, axles: tuple[float, float]) -> int:
    """A new style of lower parts; its number. x, z as shares of half the length and height, -1 to 1."""
    low = rng.uniform(-0.1, 0.3)
    # Nothing paints belt and chrome, but they are drawn: without them every picture of a seed would be another one.
    stage.bodies.append({
        "rear axle": axles[0] / (length / 2), "front axle": axles[1] / (length / 2),
        "arch x": 1.18 * radius / (length / 2), "arch z": 1.18 * radius / (tall / 2),
        "lamp in": rng.uniform(0.45, 0.75), "lamp low": low, "lamp high": low + rng.uniform(0.2, 0.55),
        "grille": rng.uniform(0.0, 0.6), "belt": rng.uniform(-0.3, 0.6), "sill": rng.uniform(-0.9, -0.6),
        "pillar": rng.uniform(0.03, 0.12), "chrome": rng.random(),
    })  # fmt: skip
    return len(stage.bodies) - 1


def _wheels(stage: Stage, axles: tuple[float, ...], width: float, radius: float, broad: float = 0.11) -> None:
    tyre = stage.finish["dark"]
    variant = int(stage.rng.integers(3, 12))
    for x in axles:
        for y in (-1, 1):
            where = (x, y * (width / 2 - broad + 0.01), radius)
            stage.wheel(CAR, where, (radius, broad, radius), tyre, cover=Cover.WHEEL, variant=variant)


def car(stage: Stage, rng: Rng) -> None:
    """A small car, hatchback, saloon, estate, off-road vehicle or sports car."""
    tall = rng.random() < 0.3
    length, width = rng.uniform(3.3, 5.0), rng.uniform(1.6, 1.95)
    height = rng.uniform(1.58, 1.95) if tall else rng.uniform(1.25, 1.6)
    waist, floor = height * rng.uniform(0.54, 0.66), rng.uniform(0.14, 0.3)
    radius = rng.uniform(0.27, 0.38)
    axles = (-length * rng.uniform(0.28, 0.34), length * rng.uniform(0.28, 0.34))
    body = (waist - floor) / 2
    style, paint = _style(stage, rng, length, 2 * body, radius, axles), stage.add(looks.paint(rng))
    shape = (rng.uniform(0.0, 0.06), rng.uniform(0.02, 0.1))
    stage.frustum(CAR, (0, 0, floor + body), (length / 2, width / 2, body), paint, cover=Cover.BODY, taper=shape, variant=style)
    rear, front = rng.choice([0.01, 0.05, 0.17]) + rng.uniform(0, 0.04), rng.uniform(0.2, 0.3)
    cabin, middle = length * (1 - rear - front), length * (rear - front) / 2
    glass = (height - waist) / 2
    lean = (rng.uniform(0.15, 0.42), rng.uniform(0.12, 0.3))
    upper = paint if rng.random() < 0.9 else stage.finish["dark"]
    half = (cabin / 2, width / 2 * 0.95, glass)
    stage.frustum(CAR, (middle, 0, waist + glass - 0.02), half, upper, cover=Cover.CABIN, taper=lean, variant=style)
    roof = (half[0] * (1 - lean[0]) * 0.98, half[1] * (1 - lean[1]) * 0.98, 0.05)
    stage.frustum(CAR, (middle, 0, height), roof, upper, taper=(0.25, 0.25))
    if front * length > 0.7:  # the bonnet's bulge, and the boot's
        wide = front * length * 0.55
        stage.ellipsoid(CAR, (length / 2 - wide, 0, waist - 0.05), (wide, width * 0.42, rng.uniform(0.08, 0.2)), paint)
    _wheels(stage, axles, width, radius)
    bumper = paint if rng.random() < 0.7 else stage.finish["dark"]
    for end in (-1, 1):
        where = (end * length / 2 * 0.97, 0, floor + 0.25)
        stage.ellipsoid(CAR, where, (0.14, width * 0.47, rng.uniform(0.1, 0.18)), bumper)
        x = length * (0.5 - front) - 0.2
        stage.ellipsoid(CAR, (x, end * (width / 2 + 0.06), waist + 0.08), (0.08, 0.11, 0.08), paint)
    extra = rng.random()
    if extra < 0.12:
        for y in (-0.5, 0.5):
            stage.box(CAR, (middle, y, height + 0.07), (half[0] * 0.5, 0.02, 0.02), stage.finish["chrome"])
    elif extra < 0.2:
        stage.frustum(CAR, (middle, 0, height + 0.2), (0.8, 0.4, 0.15), stage.add(looks.plain(rng)), taper=(0.2, 0.2))


def van(stage: Stage, rng: Rng) -> None:
    """A van, a minibus or a camper."""
    length, width, height = rng.uniform(4.2, 6.5), rng.uniform(1.75, 2.1), rng.uniform(1.8, 2.9)
    floor, radius = rng.uniform(0.2, 0.35), rng.uniform(0.3, 0.38)
    waist = rng.uniform(1.0, 1.35)
    axles = (-length * 0.31, length * 0.33)
    body, nose = (waist - floor) / 2, rng.uniform(0.08, 0.2)
    style, paint = _style(stage, rng, length, 2 * body, radius, axles), stage.add(looks.paint(rng))
    half = (length / 2, width / 2, body)
    stage.frustum(CAR, (0, 0, floor + body), half, paint, cover=Cover.BODY, taper=(0.03, 0.03), variant=style)
    half = (length * (1 - nose) / 2, width / 2 * 0.99, (height - waist) / 2)
    where = (-length * nose / 2, 0, (height + waist) / 2 - 0.02)
    cover = Cover.CABIN if rng.random() < 0.5 else Cover.COACH
    lean = (rng.uniform(0.06, 0.16), rng.uniform(0.04, 0.14))
    if rng.random() < 0.5:  # windows at the front only: a panel van
        stage.frustum(CAR, where, half, paint, cover=Cover.CABIN, taper=lean, variant=style)
        panel = stage.add(looks.poster(rng)) if rng.random() < 0.4 else paint
        back = half[0] * 0.62
        centre = (where[0] - half[0] + back, 0, where[2] + 0.03)
        stage.frustum(CAR, centre, (back, half[1] * 1.02, half[2]), panel, taper=(0.02, lean[1]))
    else:
        stage.frustum(CAR, where, half, paint, cover=cover, taper=lean, variant=style)
    _wheels(stage, axles, width, radius)
    for y in (-1, 1):
        x = length * (0.5 - nose) - 0.3
        stage.box(CAR, (x, y * (width / 2 + 0.1), waist + 0.2), (0.06, 0.1, 0.17), stage.finish["dark"])


def bus(stage: Stage, rng: Rng) -> None:
    """A bus or a coach; seldom with two decks, or a tram."""
    length, width, height = rng.uniform(8, 14), rng.uniform(2.4, 2.6), rng.uniform(2.8, 3.4)
    decks = 2 if rng.random() < 0.15 else 1
    paint, style = looks.paint(rng), _style(stage, rng, length, 1.0, 0.48, (-length * 0.25, length * 0.27))
    finish = stage.add(paint)
    for deck in range(decks):
        z = 0.35 + height * (0.5 + 0.75 * deck)
        half = (length / 2, width / 2, height / 2 - 0.15)
        stage.frustum(CAR, (0, 0, z), half, finish, cover=Cover.COACH, taper=(0.01, 0.03), variant=style)
    if rng.random() < 0.6:
        stripe = stage.add(looks.plain(rng, gloss=0.1))
        z = rng.uniform(0.6, 1.0)
        stage.box(CAR, (0, 0, z), (length / 2 + 0.01, width / 2 + 0.01, rng.uniform(0.1, 0.35)), stripe)
    _wheels(stage, (-length * 0.25, length * 0.27), width, 0.48, 0.15)
    stage.box(CAR, (length / 2, 0, height + 0.05), (0.03, width * 0.35, 0.15), stage.add(looks.poster(rng)))


def lorry(stage: Stage, rng: Rng) -> None:
    """A cab with a box, a flat bed, a tank, or a pick-up."""
    small = rng.random() < 0.4
    width, radius = (1.9, 0.36) if small else (2.5, 0.5)
    length, cab = (rng.uniform(4.8, 6.5), 0.9) if small else (rng.uniform(6.5, 14), 1.1)
    top = rng.uniform(1.7, 2.4) if small else rng.uniform(2.4, 3.4)
    paint = stage.add(looks.paint(rng))
    front = length / 2 - cab
    style = _style(stage, rng, 2 * cab, 1.0, radius, (-2 * cab, 0.0))
    z = radius + (top - radius) * 0.28
    stage.box(CAR, (front, 0, z), (cab, width / 2, (top - radius) * 0.28), paint, cover=Cover.BODY, variant=style)
    half = (cab, width / 2, (top - radius) * 0.24)
    stage.frustum(CAR, (front, 0, z + (top - radius) * 0.51), half, paint, cover=Cover.CABIN, taper=(0.15, 0.06), variant=style)
    stage.box(CAR, (-cab / 2, 0, radius + 0.1), (length / 2 - cab / 2, width * 0.35, 0.15), stage.finish["dark"])
    load, middle = (length - 2 * cab) / 2, -cab - 0.05
    kind = rng.random()
    finish = stage.add(looks.poster(rng) if rng.random() < 0.3 else looks.wall(rng))
    if kind < 0.65:
        high = (rng.uniform(2.4, 3.9) if not small else rng.uniform(2.0, 2.8)) - radius
        stage.box(CAR, (middle, 0, radius + 0.2 + high / 2), (load, width / 2 + 0.03, high / 2), finish)
        stage.box(CAR, (middle - load, 0, radius + 0.1), (0.04, width / 2, 0.12), stage.finish["tail"])
    elif kind < 0.85:
        stage.box(CAR, (middle, 0, radius + 0.55), (load, width / 2, 0.35), finish)
    else:
        stage.ellipsoid(CAR, (middle, 0, radius + 1.1), (load * 1.1, width / 2, 0.95), stage.finish["chrome"])
    axles = (-length * 0.3, front) if small or length < 8 else (-length * 0.36, -length * 0.26, front)
    _wheels(stage, axles, width, radius, 0.15)


def any_vehicle(stage: Stage, rng: Rng, large: float = 0.08) -> None:
    """Mostly a car. large: share of buses and lorries."""
    kind = rng.random()
    (bus if kind < large / 2 else lorry if kind < large else van if kind < large + 0.14 else car)(stage, rng)
