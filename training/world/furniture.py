"""What stands along roads: poles, lamps, signs, traffic lights, bins, barriers. x is along the road, the road lies at +y."""

from __future__ import annotations

from training.world import looks
from training.world.looks import Rng
from training.world.stage import FENCE, OTHER, POLE, SIGN, Cover, Stage

SHAPES = 6  # of plates: oblong, disc, triangle, triangle on its head, octagon, diamond; as paint.py cuts them


def _post(stage: Stage, radius: float, height: float, finish: int, x: float = 0.0, y: float = 0.0) -> None:
    stage.cylinder(POLE, (x, y, height / 2), (radius, radius, height / 2), finish)


def _metal(stage: Stage, rng: Rng) -> int:
    if rng.random() < 0.25:
        return stage.add(looks.plain(rng, gloss=0.05))
    return stage.add(looks.plain(rng, looks.hsv(rng.uniform(0.2, 0.7), rng.uniform(0, 0.25), rng.uniform(0.03, 0.6)), 0.05))


def lamp(stage: Stage, rng: Rng) -> None:
    """A street lamp with an arm, a globe or two heads; or a mast of wood."""
    height, r, finish = rng.uniform(3, 10), rng.uniform(0.045, 0.14), _metal(stage, rng)
    _post(stage, r, height, finish)
    _post(stage, 1.6 * r, rng.uniform(0.3, 1.3), finish)
    if height > 5 and rng.random() < 0.8:
        arm = rng.uniform(0.4, 1.3)
        stage.box(POLE, (0, arm, height - 0.05), (0.035, arm, 0.035), finish)
        stage.ellipsoid(POLE, (0, 2 * arm, height - 0.1), (0.15, 0.4, 0.09), finish)
    else:
        stage.ellipsoid(POLE, (0, 0, height + 0.2), (0.22, 0.22, 0.28), stage.finish["lit" if rng.random() < 0.5 else "white"])


def mast(stage: Stage, rng: Rng) -> None:
    """A mast of wood, concrete or steel without anything, or with a cross-bar."""
    height, r = rng.uniform(4, 11), rng.uniform(0.06, 0.2)
    steel = rng.random() < 0.5
    finish = _metal(stage, rng) if steel else stage.add(looks.plain(rng, looks.hsv(0.08, 0.4, rng.uniform(0.05, 0.3)), 0, 0.2))
    _post(stage, r, height, finish)
    if rng.random() < 0.4:
        stage.box(POLE, (0, 0, height - 0.6), (0.05, rng.uniform(0.6, 1.3), 0.05), finish)


def sign(stage: Stage, rng: Rng) -> None:
    """One to three plates on a post, seen from either side of the road."""
    height, finish = rng.uniform(1.8, 3.2), _metal(stage, rng)
    _post(stage, rng.uniform(0.025, 0.06), height + 0.1, finish)
    z, facing = height, rng.choice([-1.0, 1.0], p=[0.75, 0.25])
    for _ in range(int(rng.choice([1, 2, 3], p=[0.6, 0.3, 0.1]))):
        size = rng.uniform(0.22, 0.45)
        shape = int(rng.integers(SHAPES))
        wide, high = (rng.uniform(0.7, 1.8), rng.uniform(0.5, 1.2)) if shape == 0 else (1.0, 1.0)
        half = (0.015, size * wide, size * high)
        palette = [(0.0, 0.85), (0.61, 0.85), (0.13, 0.9), (0.4, 0.8), (0.0, 0.0)][int(rng.integers(5))]
        face = looks.hsv(palette[0], palette[1] * rng.uniform(0.8, 1.1), rng.uniform(0.2, 0.85))
        other = looks.hsv(0.1, 0.03, rng.uniform(0.6, 0.9)) if rng.random() < 0.7 else looks.any_colour(rng)
        if rng.random() < 0.4:
            face, other = other, face
        plate = stage.add(looks.Finish(face, other, looks.Pattern.PRINT, (size * 0.3, size * 0.3), fine=0.03))
        stage.box(SIGN, (facing * 0.05, 0, z - half[2] + 0.1), half, plate, cover=Cover.SHAPE, variant=shape)
        z -= 2 * half[2] + 0.03
        if z < 1.0:
            break


def traffic_light(stage: Stage, rng: Rng) -> None:
    """A signal on a post, perhaps another one above the road on an arm."""
    finish, height = _metal(stage, rng), rng.uniform(2.6, 3.4)
    arm = rng.random() < 0.35
    _post(stage, rng.uniform(0.05, 0.1), 5.8 if arm else height, finish)
    case = stage.add(looks.plain(rng, looks.hsv(rng.uniform(0.1, 0.5), rng.uniform(0, 0.5), rng.uniform(0.01, 0.1))))
    spots = [(0.0, 0.0, height - 0.4)]
    if arm:
        reach = rng.uniform(1.5, 3)
        stage.box(POLE, (0, reach, 5.6), (0.05, reach, 0.05), finish)
        spots.append((0.0, 2 * reach - 0.3, 5.4))
    for x, y, z in spots:
        stage.box(SIGN, (x - 0.08, y, z), (0.12, 0.16, 0.46), case, cover=Cover.LIGHTS, variant=int(rng.integers(3)))


def board(stage: Stage, rng: Rng) -> None:
    """A poster, a direction board or a banner on legs."""
    wide, high, low = rng.uniform(0.5, 2.2), rng.uniform(0.4, 1.3), rng.uniform(0.2, 2.4)
    finish = _metal(stage, rng)
    for y in (-0.7, 0.7):
        _post(stage, 0.05, low + high, finish, 0.0, y * wide)
    stage.box(SIGN, (0, 0, low + high), (0.06, wide, high), stage.add(looks.poster(rng)))


def gantry(stage: Stage, rng: Rng, half: float) -> None:
    """A beam with boards across the road; half m to either side of the frame."""
    finish, high = _metal(stage, rng), rng.uniform(5.2, 6.5)
    for y in (-half, half):
        stage.box(POLE, (0, y, high / 2), (0.15, 0.15, high / 2), finish)
    stage.box(POLE, (0, 0, high), (0.15, half, 0.25), finish)
    for _ in range(int(rng.integers(1, 4))):
        colour = looks.hsv(rng.choice([0.6, 0.4]), 0.8, 0.3)
        plate = stage.add(looks.Finish(colour, (0.8, 0.8, 0.8), looks.Pattern.PRINT, (0.4, 0.4)))
        stage.box(SIGN, (-0.3, rng.uniform(-0.8, 0.8) * half, high), (0.05, rng.uniform(0.8, 2), rng.uniform(0.5, 1.2)), plate)


def clutter(stage: Stage, rng: Rng) -> None:
    """A bin, a box, a bench, a stone, a plant pot: nothing that has a class."""
    kind, finish = rng.integers(4), stage.add(looks.plain(rng))
    if kind == 0:
        half = (rng.uniform(0.2, 0.6), rng.uniform(0.18, 0.4), rng.uniform(0.35, 0.75))
        stage.frustum(OTHER, (0, 0, half[2]), half, finish, taper=(rng.uniform(-0.1, 0.1),) * 2)
    elif kind == 1:
        stage.cylinder(OTHER, (0, 0, 0.45), (0.25, 0.25, 0.45), finish)
    elif kind == 2:
        stage.box(OTHER, (0, 0, 0.45), (0.8, 0.22, 0.03), finish)
        stage.box(OTHER, (0, -0.22, 0.75), (0.8, 0.03, 0.18), finish)
        stage.box(OTHER, (0, 0, 0.2), (0.6, 0.05, 0.2), finish)
    else:
        size = rng.uniform(0.2, 0.6)
        stage.ellipsoid(OTHER, (0, 0, 0.2 * size), (size, size * 0.8, 0.7 * size), finish)


def bollard(stage: Stage, rng: Rng) -> None:
    """A short post."""
    r, high = rng.uniform(0.04, 0.14), rng.uniform(0.35, 0.6)
    finish = _metal(stage, rng)
    stage.cylinder(POLE, (0, 0, high), (r, r, high), finish)
    if rng.random() < 0.5:
        band = stage.finish["white" if rng.random() < 0.5 else "red"]
        stage.cylinder(POLE, (0, 0, 1.6 * high), (r + 0.005, r + 0.005, 0.08), band)


def rail(stage: Stage, length: float) -> None:
    """A guard rail along x."""
    finish = _metal(stage, stage.rng)
    stage.box(FENCE, (0, 0, 0.6), (length / 2, 0.04, 0.16), finish)
    for k in range(int(length / 2)):
        stage.box(FENCE, (-length / 2 + 2 * k, -0.08, 0.35), (0.05, 0.05, 0.35), finish)
