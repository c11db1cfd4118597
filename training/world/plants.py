"""Trees, hedges and bushes."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, pi, sin

from training.world import looks
from training.world.looks import Rng
from training.world.stage import TREE, Cover, Stage


def _bark(stage: Stage, rng: Rng) -> int:
    colour = looks.hsv(rng.uniform(0.04, 0.14), rng.uniform(0.05, 0.5), rng.uniform(0.03, 0.3))
    return stage.add(looks.Finish(colour, looks.scaled(colour, 0.5), looks.Pattern.BLOTCH, (0.15, 0.5), fine=0.3, grain=40))


def _leaves(stage: Stage, centre: Sequence[float], half: Sequence[float], finish: int, openness: float) -> None:
    stage.ellipsoid(TREE, centre, half, finish, cover=Cover.LEAF, openness=openness, tint=stage.rng.uniform(0.7, 1.3))


def broadleaf(stage: Stage, rng: Rng, size: float) -> None:
    """A tree of several clumps; how open they are differs from tree to tree, up to bare twigs."""
    r, trunk = rng.uniform(0.08, 0.32) * size, rng.uniform(1.4, 3.6) * (0.6 + 0.4 * size)
    spread, tall = rng.uniform(1.3, 3.4) * size, rng.uniform(0.8, 1.7)
    bark = _bark(stage, rng)
    openness = float(rng.choice([rng.uniform(0.2, 0.7), rng.uniform(0.7, 1.2), rng.uniform(1.2, 1.6)], p=[0.45, 0.4, 0.15]))
    leaf = stage.add(looks.foliage(rng))
    lean = rng.normal(0, 0.06)
    stage.cylinder(TREE, (0, 0, 0.6 * trunk + 0.3), (r, r, 0.6 * trunk + 0.3), bark)
    stage.ellipsoid(TREE, (0, 0, trunk + 0.5 * spread), (r * 0.7, r * 0.7, 0.9 * spread * tall), bark)
    count = int(rng.integers(7, 16))
    for k in range(count):
        a, reach = k * 4.4 * pi / count + rng.uniform(-0.5, 0.5), 0.0 if k == count - 1 else spread * rng.uniform(0.2, 0.95)
        part = spread * (0.7 if k == count - 1 else rng.uniform(0.2, 0.55))
        z = trunk + spread * tall * rng.uniform(0.15, 1.4 - 0.4 * reach / spread)
        centre = (reach * cos(a) + lean * z, reach * sin(a), z)
        _leaves(stage, centre, (part, part * rng.uniform(0.8, 1.2), part * rng.uniform(0.6, 1.0)), leaf, openness)


def bare(stage: Stage, rng: Rng) -> None:
    """A tree in winter: a trunk, boughs as thin upright cones, and a haze of twigs."""
    r, trunk, tall = rng.uniform(0.1, 0.3), rng.uniform(1.5, 3), rng.uniform(3, 7)
    bark = _bark(stage, rng)
    stage.cylinder(TREE, (0, 0, trunk / 2), (r, r, trunk / 2), bark)
    colour = looks.hsv(rng.uniform(0.03, 0.12), rng.uniform(0.1, 0.5), rng.uniform(0.03, 0.2))
    twig = stage.add(looks.Finish(colour, looks.scaled(colour, 0.5), looks.Pattern.BLOTCH, (0.3, 1), fine=0.4, grain=20))
    for _ in range(int(rng.integers(3, 7))):
        a, reach = rng.uniform(0, 2 * pi), rng.uniform(0.1, 1.3)
        z = trunk + tall * rng.uniform(0.25, 0.45)
        stage.ellipsoid(TREE, (reach * cos(a), reach * sin(a), z), (0.05, 0.05, tall * rng.uniform(0.25, 0.45)), bark)
    for _ in range(int(rng.integers(4, 8))):
        a, reach = rng.uniform(0, 2 * pi), rng.uniform(0.2, 1.8)
        centre = (reach * cos(a), reach * sin(a), trunk + tall * rng.uniform(0.2, 0.8))
        half = (rng.uniform(0.8, 1.8), rng.uniform(0.8, 1.8), rng.uniform(0.9, 2.0))
        _leaves(stage, centre, half, twig, rng.uniform(1.2, 1.9))


def conifer(stage: Stage, rng: Rng) -> None:
    """A spruce, a cypress or a pine: a cone of clumps."""
    height, width = rng.uniform(3, 15), rng.uniform(0.7, 2.4)
    leaf, layers = stage.add(looks.foliage(rng)), int(rng.integers(2, 6))
    stage.cylinder(TREE, (0, 0, 0.6), (0.16, 0.16, 0.6), _bark(stage, rng))
    openness = rng.uniform(0.2, 1.0)
    for k in range(layers):
        w = width * (1 - 0.85 * k / layers)
        _leaves(stage, (0, 0, 0.4 + (k + 0.7) * height / layers), (w, w, 0.8 * height / layers), leaf, openness)


def palm(stage: Stage, rng: Rng) -> None:
    """A bare stem with a tuft."""
    high, leaf = rng.uniform(3, 9), stage.add(looks.foliage(rng))
    stage.cylinder(TREE, (0, 0, high / 2), (0.17, 0.17, high / 2), _bark(stage, rng))
    for k in range(7):
        a = k * 2 * pi / 7
        stage.shift(0, 0, a)
        stage.ellipsoid(TREE, (0.9, 0, high + rng.uniform(-0.5, 0.4)), (1.0, 0.25, 0.25), leaf, cover=Cover.LEAF, openness=0.4)
        stage.shift(0, 0, -a)


def bush(stage: Stage, rng: Rng) -> None:
    """Low clumps of leaves."""
    leaf, openness = stage.add(looks.foliage(rng)), rng.uniform(0.2, 1.2)
    for _ in range(int(rng.integers(1, 5))):
        size = rng.uniform(0.25, 1.2)
        centre = (rng.normal(0, 0.7), rng.normal(0, 0.4), 0.6 * size)
        _leaves(stage, centre, (size, size * rng.uniform(0.7, 1.2), size * rng.uniform(0.6, 1.2)), leaf, openness)


def hedge(stage: Stage, rng: Rng, length: float) -> None:
    """A clipped or a grown hedge along x, centred on the frame."""
    leaf, high, deep = stage.add(looks.foliage(rng)), rng.uniform(0.3, 1.3), rng.uniform(0.25, 0.7)
    openness = rng.uniform(0, 0.9)
    stage.box(TREE, (0, 0, high), (length / 2, deep, high), leaf, cover=Cover.LEAF, openness=openness, tint=rng.uniform(0.7, 1.3))
    if rng.random() < 0.5:
        for k in range(int(length / 1.2)):
            size = rng.uniform(0.4, 0.8)
            centre = (-length / 2 + 0.6 + 1.2 * k, rng.normal(0, 0.1), 1.8 * high)
            _leaves(stage, centre, (size, deep * 1.1, size * 0.7), leaf, openness)


def any_tree(stage: Stage, rng: Rng, winter: float) -> None:
    """winter: share of bare ones."""
    kind = rng.random()
    if kind < winter + 0.13:
        (bare if kind < winter else conifer if kind < winter + 0.12 else palm)(stage, rng)
    else:
        broadleaf(stage, rng, float(rng.choice([0.5, 1.0, 1.5], p=[0.2, 0.5, 0.3])))
