"""Buildings: their facades' styles, houses, blocks, halls, and what sticks out of them."""

from __future__ import annotations

from training.world import looks
from training.world.looks import Rng
from training.world.stage import BUILDING, FENCE, OTHER, POLE, SIGN, Cover, Stage


def facade_style(stage: Stage, rng: Rng) -> int:
    """A new style of windows; its number."""
    storey = rng.uniform(2.6, 4.2)
    tall = rng.random() < 0.3  # windows down to the floor
    sill = rng.uniform(0.1, 0.3) if tall else rng.uniform(0.6, 1.2)
    trim = stage.add(looks.plain(rng, looks.hsv(0.1, 0.05, rng.uniform(0.5, 0.9))) if rng.random() < 0.65 else looks.plain(rng))
    door = stage.add(looks.plain(rng, gloss=0.05))
    pane = looks.hsv(rng.uniform(0.4, 0.7), rng.uniform(0, 0.5), rng.uniform(0.01, 0.12))
    glass = stage.add(looks.plain(rng, pane, rng.uniform(0.05, 0.5), 0.4))
    stage.facades.append({
        "pitch": rng.uniform(1.3, 4.5), "storey": storey, "wide": rng.uniform(0.14, 0.42), "sill": sill,
        "lintel": storey - rng.uniform(0.2, 0.7),
        "frame": rng.choice([0.0, rng.uniform(0.03, 0.09), rng.uniform(0.1, 0.22)], p=[0.15, 0.6, 0.25]),
        "shop": rng.random() < 0.35, "shutter": rng.uniform(0.2, 0.5) if rng.random() < 0.2 else 0.0,
        "bars_x": rng.integers(0, 4), "bars_y": rng.integers(0, 4), "doors": rng.uniform(0.0, 0.35),
        "band": rng.choice([0.0, rng.uniform(0.08, 0.3)]), "blind": rng.choice([0.02, rng.uniform(0.05, 0.5)]),
        "curtain": rng.uniform(0, 0.6), "glass": glass, "trim": trim, "door": door,
        "ribbon": rng.random() < 0.15,  # windows without wall in between
        "lit": rng.uniform(0.0, 0.5),
    })  # fmt: skip
    return len(stage.facades) - 1


def house(stage: Stage, rng: Rng, length: float, depth: float, storeys: int) -> None:
    """A building whose front faces -y, centred on the frame: walls, roof, chimneys, balconies, bays, steps, gutters."""
    style = facade_style(stage, rng) if rng.random() < 0.6 or not stage.facades else int(rng.integers(len(stage.facades)))
    height = storeys * stage.facades[style]["storey"] + rng.uniform(0, 0.8)
    wall = looks.wall(rng)
    facade = {"finish": stage.add(wall), "cover": Cover.FACADE, "variant": style}
    stage.box(BUILDING, (0, 0, height / 2), (length / 2, depth / 2, height / 2), **facade)
    if rng.random() < 0.4:  # a base of another material
        base = rng.uniform(0.3, 1.1)
        stage.box(BUILDING, (0, 0, base / 2), (length / 2 + 0.04, depth / 2 + 0.04, base / 2), stage.add(looks.wall(rng)))
    _roof(stage, rng, length, depth, height, storeys, stage.darker(wall, 0.8))
    front = -depth / 2
    if rng.random() < 0.35 and storeys > 1:
        _balconies(stage, rng, length, front, storeys, stage.facades[style]["storey"])
    if rng.random() < 0.25:
        wide, top = rng.uniform(0.7, 1.6), min(height, rng.uniform(2.8, 7))
        x = rng.uniform(-0.3, 0.3) * length
        stage.box(BUILDING, (x, front, top / 2), (wide, rng.uniform(0.3, 1.0), top / 2), **facade)
    if rng.random() < 0.5:
        x = rng.choice([-1, 1]) * (length / 2 - 0.2)
        stage.cylinder(BUILDING, (x, front - 0.08, height / 2), (0.05, 0.05, height / 2), stage.finish["metal"])
    if rng.random() < 0.35:
        x = rng.uniform(-0.35, 0.35) * length
        stage.box(BUILDING, (x, front - 0.4, 0.15), (rng.uniform(0.6, 1.2), 0.45, 0.15), stage.add(looks.paving(rng)))
        if rng.random() < 0.5:
            stage.box(BUILDING, (x, front - 0.5, 2.5), (rng.uniform(0.7, 1.3), 0.6, 0.06), stage.add(looks.plain(rng)))
    if rng.random() < 0.2:
        _garage(stage, length, depth)
    if stage.facades[style]["shop"]:
        _shop(stage, rng, length, front)
    for _ in range(int(rng.integers(0, 4)) if rng.random() < 0.15 else 0):  # air conditioners
        where = (rng.uniform(-0.45, 0.45) * length, front - 0.2, rng.uniform(0.3, 0.9) * height)
        stage.box(BUILDING, where, (0.42, 0.2, 0.3), stage.finish["white"])


def _roof(stage: Stage, rng: Rng, length: float, depth: float, height: float, storeys: int, flat: int) -> None:
    if rng.random() < (0.75 if storeys < 4 else 0.3):
        rise, tiles = rng.uniform(0.8, 2.6), stage.add(looks.roof(rng))
        over = rng.uniform(0.1, 0.6)
        taper = (rng.choice([0.02, 0.4, 0.8]), 0.97) if rng.random() < 0.7 else (0.97, 0.02)  # gable towards the street
        stage.frustum(BUILDING, (0, 0, height + rise), (length / 2 + 0.1, depth / 2 + over, rise), tiles, taper=taper)
        if rng.random() < 0.5:
            chimney = stage.add(looks.wall(rng))
            stage.box(BUILDING, (rng.uniform(-0.4, 0.4) * length, 0, height + 2 * rise), (0.4, 0.4, 0.9), chimney)
        for _ in range(int(rng.integers(0, 4))):  # dormers and roof windows
            x = rng.uniform(-0.4, 0.4) * length
            where = (x, -depth / 4, height + 0.75 * rise)
            stage.box(BUILDING, where, (0.6, depth / 5, 0.6), flat)
            stage.box(BUILDING, (x, -depth / 4 - depth / 5, where[2]), (0.42, 0.02, 0.4), stage.finish["glass"])
        return
    stage.box(BUILDING, (0, 0, height + 0.15), (length / 2 + 0.1, depth / 2 + 0.1, rng.uniform(0.1, 0.4)), flat)
    for _ in range(int(rng.integers(0, 3))):
        where = (rng.uniform(-0.4, 0.4) * length, 0, height + 1.0)
        stage.box(BUILDING, where, (rng.uniform(0.5, 2), rng.uniform(0.5, 2), 1.0), flat)


def _balconies(stage: Stage, rng: Rng, length: float, front: float, storeys: int, storey: float) -> None:
    deep, wide = rng.uniform(0.6, 1.5), rng.uniform(1.0, 2.2)
    slab, rail = stage.add(looks.plain(rng, looks.wall_colour(rng))), stage.add(looks.plain(rng))
    solid = rng.random() < 0.5
    columns = [rng.uniform(-0.35, 0.35)] if length < 9 else [-0.3, 0.0, 0.3][: rng.integers(1, 4)]
    for k in range(1, min(storeys, 7)):
        for x, z in ((x * length, k * storey) for x in columns):
            stage.box(BUILDING, (x, front - deep / 2, z), (wide, deep / 2, 0.1), slab)
            cover = Cover.PLAIN if solid else Cover.GRATE
            stage.box(BUILDING, (x, front - deep, z + 0.5), (wide, 0.02, 0.45), rail, cover=cover, variant=1)


def _garage(stage: Stage, length: float, depth: float) -> None:
    x = stage.rng.choice([-1, 1]) * (length / 2 + 1.7)
    wall, door = stage.add(looks.wall(stage.rng)), stage.add(looks.wall(stage.rng))
    stage.box(BUILDING, (x, -depth / 4, 1.35), (1.7, depth / 3, 1.35), wall)
    stage.box(BUILDING, (x, -depth / 4 - depth / 3 - 0.02, 1.1), (1.3, 0.03, 1.1), door)


def _shop(stage: Stage, rng: Rng, length: float, front: float) -> None:
    """A fascia with lettering, an awning, a sign on a bracket."""
    wide = length * rng.uniform(0.3, 0.49)
    fascia = stage.add(looks.poster(rng))
    stage.box(BUILDING, (0, front - 0.08, rng.uniform(2.7, 3.4)), (wide, 0.08, rng.uniform(0.2, 0.45)), fascia)
    if rng.random() < 0.35:
        stripes = looks.Finish(looks.any_colour(rng), looks.any_colour(rng), looks.Pattern.COLUMNS, (0.5, 0.5), 0.25)
        deep = rng.uniform(0.7, 1.6)
        stage.frustum(BUILDING, (0, front - deep / 2, 2.65), (wide, deep / 2, 0.25), stage.add(stripes), taper=(0.05, 0.6))
    if rng.random() < 0.4:
        where = (rng.uniform(-0.4, 0.4) * length, front - 0.55, rng.uniform(3, 4.5))
        stage.box(SIGN, where, (0.06, 0.45, rng.uniform(0.25, 0.9)), stage.add(looks.poster(rng)))


def hall(stage: Stage, rng: Rng, length: float, depth: float, height: float) -> None:
    """A supermarket, a works or an office of few storeys, with gates and lettering; its front faces -y."""
    style = facade_style(stage, rng)
    cover = Cover.FACADE if rng.random() < 0.5 else Cover.PLAIN
    wall = stage.add(looks.wall(rng))
    stage.box(BUILDING, (0, 0, height / 2), (length / 2, depth / 2, height / 2), wall, cover=cover, variant=style)
    front = -depth / 2
    for _ in range(int(rng.integers(0, 4))):
        x, wide = rng.uniform(-0.42, 0.42) * length, rng.uniform(1.2, 3.5)
        door = stage.add(looks.wall(rng)) if rng.random() < 0.6 else stage.finish["glass"]
        stage.box(BUILDING, (x, front - 0.03, 1.6), (wide, 0.04, 1.6), door)
    if rng.random() < 0.6:
        where = (rng.uniform(-0.3, 0.3) * length, front - 0.1, height - 0.8)
        stage.box(BUILDING, where, (rng.uniform(1, 4), 0.08, 0.6), stage.add(looks.poster(rng)))
    if rng.random() < 0.3:  # a canopy on columns
        deep, z = rng.uniform(1.5, 5), rng.uniform(2.6, 4.5)
        stage.box(BUILDING, (0, front - deep / 2, z), (length * 0.4, deep / 2, 0.15), stage.add(looks.plain(rng)))
        for x in (-0.38, -0.12, 0.12, 0.38):
            stage.cylinder(POLE, (x * length, front - deep + 0.2, z / 2), (0.08, 0.08, z / 2), stage.finish["metal"])


def border(stage: Stage, rng: Rng, length: float) -> None:
    """Wall, fence, rails or mesh along x, centred on the frame."""
    kind, high = rng.random(), rng.uniform(0.35, 1.0)
    if kind < 0.3:
        stage.box(BUILDING, (0, 0, high), (length / 2, rng.uniform(0.08, 0.25), high), stage.add(looks.wall(rng)))
        if rng.random() < 0.4:
            bars = stage.add(looks.plain(rng))
            stage.box(FENCE, (0, 0, 2 * high + 0.35), (length / 2, 0.03, 0.4), bars, cover=Cover.GRATE, variant=1)
        return
    colour = None if rng.random() < 0.4 else looks.hsv(0.08, rng.uniform(0, 0.5), rng.uniform(0.02, 0.6))
    finish = stage.add(looks.plain(rng, colour))
    variant = int(rng.integers(0, 5))
    if kind < 0.45:
        planks = looks.Finish(looks.hsv(0.08, rng.uniform(0.1, 0.6), rng.uniform(0.05, 0.5)), looks.hsv(0.08, 0.4, 0.03),
                              looks.Pattern.COLUMNS, (rng.uniform(0.08, 0.2),) * 2, 0.02, 0.2, 0.2)  # fmt: skip
        stage.box(FENCE, (0, 0, high), (length / 2, 0.04, high), stage.add(planks))
    else:
        stage.box(FENCE, (0, 0, high + 0.05), (length / 2, 0.025, high), finish, cover=Cover.GRATE, variant=variant)
    step = rng.uniform(1.5, 3.0)
    for k in range(int(length / step) + 1):
        stage.box(FENCE, (-length / 2 + k * step, 0, high + 0.06), (0.04, 0.04, high + 0.06), finish)


def kiosk(stage: Stage, rng: Rng) -> None:
    """A bus shelter or a kiosk."""
    finish, wide = stage.add(looks.plain(rng)), rng.uniform(1.2, 2.4)
    stage.box(BUILDING, (0, 0, 2.45), (wide, 0.8, 0.08), finish)
    for x in (-wide, 0, wide):
        stage.box(BUILDING, (x, 0.7, 1.2), (0.05, 0.05, 1.2), finish)
    stage.box(BUILDING, (0, 0.75, 1.3), (wide, 0.02, 0.9), stage.finish["glass"])
    stage.box(SIGN, (wide, 0, 1.3), (0.06, 0.6, 0.9), stage.add(looks.poster(rng)))
    stage.box(OTHER, (0, 0.4, 0.45), (wide * 0.8, 0.2, 0.04), finish)
