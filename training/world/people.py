"""People on foot, on bicycles and on motorcycles. x is forward."""

from __future__ import annotations

from training.world import looks
from training.world.looks import Rng
from training.world.stage import CYCLIST, OTHER, PEDESTRIAN, Cover, Stage


def person(stage: Stage, rng: Rng) -> None:
    """Someone who stands or walks; a child now and then, with a bag, a skirt or a long coat."""
    k = rng.uniform(0.6, 0.85) if rng.random() < 0.1 else rng.uniform(0.9, 1.1)
    stout = rng.uniform(0.85, 1.3)
    stride = rng.choice([rng.uniform(0.0, 0.08), rng.uniform(0.12, 0.34)])
    trousers, coat = stage.add(looks.cloth(rng)), stage.add(looks.cloth(rng))
    shoes = stage.add(looks.plain(rng))
    for side in (-1, 1):
        y, x = side * 0.09 * stout, side * stride
        stage.ellipsoid(PEDESTRIAN, (0.35 * x, y, 0.68 * k), (0.1 * stout, 0.09 * stout, 0.27 * k), trousers)
        stage.ellipsoid(PEDESTRIAN, (0.85 * x, y, 0.28 * k), (0.075, 0.07, 0.28 * k), trousers)
        stage.ellipsoid(PEDESTRIAN, (x + 0.06, y, 0.05), (0.14, 0.06, 0.06), shoes)
        swing = -side * stride
        stage.ellipsoid(PEDESTRIAN, (0.3 * swing, side * 0.23 * stout, 1.22 * k), (0.07, 0.06, 0.2 * k), coat)
        stage.ellipsoid(PEDESTRIAN, (0.8 * swing + 0.03, side * 0.25 * stout, 0.92 * k), (0.06, 0.05, 0.2 * k), coat)
    half = (0.13 * stout, 0.2 * stout, 0.34 * k)
    stage.frustum(PEDESTRIAN, (0, 0, 1.14 * k), (half[0], half[1] * 0.95, half[2] * 0.8), coat, taper=(0.15, -0.12))
    stage.ellipsoid(PEDESTRIAN, (0, 0, 1.17 * k), half, coat)
    if rng.random() < 0.25:  # a skirt or a long coat
        stage.frustum(PEDESTRIAN, (0, 0, 0.7 * k), (0.2, 0.24, 0.24 * k), coat, taper=(0.3, 0.3))
    _head(stage, rng, PEDESTRIAN, 0.02, 1.58 * k, 0.0)
    if rng.random() < 0.35:
        bag = stage.add(looks.plain(rng))
        where = (-0.2, 0, 1.2 * k) if rng.random() < 0.5 else (0.05, 0.33, 0.75 * k)
        stage.box(PEDESTRIAN, where, (0.1, 0.13, 0.2), bag)


def group(stage: Stage, rng: Rng) -> None:
    """Some people beside each other."""
    for _ in range(int(rng.integers(1, 5))):
        stage.shift(rng.normal(0, 0.5), rng.uniform(0.4, 0.9), rng.normal(0, 0.3))
        person(stage, rng)


def cyclist(stage: Stage, rng: Rng) -> None:
    """A rider on a bicycle; the bicycle belongs to the class."""
    bicycle(stage, rng, CYCLIST)
    _rider(stage, rng, rng.uniform(0.05, 0.3), 0.38)


def bicycle(stage: Stage, rng: Rng, label: int = OTHER) -> None:
    """A bicycle that stands."""
    paint, dark = stage.add(looks.plain(rng, gloss=0.05)), stage.finish["dark"]
    for x in (-0.52, 0.52):
        stage.wheel(label, (x, 0, 0.34), (0.34, 0.025, 0.34), dark, cover=Cover.SPOKES)
    stage.box(label, (0.05, 0, 0.72), (0.38, 0.025, 0.03), paint)
    stage.box(label, (-0.08, 0, 0.5), (0.025, 0.025, 0.28), paint)
    stage.box(label, (0.46, 0, 0.65), (0.025, 0.025, 0.35), paint)
    stage.box(label, (-0.28, 0, 0.36), (0.26, 0.02, 0.02), paint)
    stage.box(label, (0.42, 0, 1.0), (0.03, 0.28, 0.02), dark)
    stage.ellipsoid(label, (-0.2, 0, 0.9), (0.14, 0.09, 0.04), dark)


def motorcyclist(stage: Stage, rng: Rng) -> None:
    """A motorcycle or a scooter, mostly with a rider."""
    paint, dark = stage.add(looks.paint(rng)), stage.finish["dark"]
    for x in (-0.65, 0.65):
        stage.wheel(CYCLIST, (x, 0, 0.32), (0.32, 0.07, 0.32), dark, cover=Cover.WHEEL, variant=5)
    stage.ellipsoid(CYCLIST, (0.2, 0, 0.75), (0.45, 0.16, 0.22), paint)
    stage.box(CYCLIST, (0, 0, 0.45), (0.35, 0.15, 0.2), stage.finish["metal"])
    stage.ellipsoid(CYCLIST, (-0.45, 0, 0.8), (0.4, 0.14, 0.1), dark)
    stage.box(CYCLIST, (0.55, 0, 1.0), (0.05, 0.35, 0.03), dark)
    stage.ellipsoid(CYCLIST, (0.68, 0, 0.85), (0.1, 0.12, 0.12), stage.finish["lamp"])
    if rng.random() < 0.8:
        _rider(stage, rng, rng.uniform(0.0, 0.2), 0.3)


def _rider(stage: Stage, rng: Rng, lean: float, seat: float) -> None:
    trousers, coat = stage.add(looks.cloth(rng)), stage.add(looks.cloth(rng))
    for side in (-1, 1):
        up = rng.uniform(-0.12, 0.12) * side
        stage.ellipsoid(CYCLIST, (0.08, side * 0.11, 0.5 + seat + up), (0.22, 0.09, 0.14), trousers)
        stage.ellipsoid(CYCLIST, (0.2, side * 0.11, 0.22 + seat + up), (0.08, 0.07, 0.26), trousers)
        stage.ellipsoid(CYCLIST, (0.25 + lean, side * 0.23, 0.86 + seat), (0.22, 0.06, 0.12), coat)
    stage.ellipsoid(CYCLIST, (-0.1 + 0.5 * lean, 0, 0.82 + seat), (0.17, 0.2, 0.32), coat)
    _head(stage, rng, CYCLIST, 0.05 + lean, 1.22 + seat, 0.5)


def _head(stage: Stage, rng: Rng, label: int, x: float, z: float, helmet: float) -> None:
    skin = stage.add(looks.plain(rng, looks.hsv(rng.uniform(0.03, 0.07), rng.uniform(0.3, 0.6), rng.uniform(0.08, 0.65))))
    stage.ellipsoid(label, (x, 0, z), (0.1, 0.085, 0.13), skin, cover=Cover.HEAD)
    if rng.random() < max(helmet, 0.2):
        stage.ellipsoid(label, (x, 0, z + 0.07), (0.13, 0.11, 0.09), stage.add(looks.plain(rng, gloss=0.05)))
