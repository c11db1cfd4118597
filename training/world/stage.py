"""The stage of a world: solids with finishes, and the styles that its painters look up by number."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from enum import IntEnum
from functools import partialmethod
from math import cos, sin

import numpy as np

from calib_ros_synthetic.solids import Builder, Kind, Solids, Surface
from training.data import NAMES, VOID
from training.world.looks import Finish, Float32, Rng, hsv, plain, scaled

SKY, BUILDING, POLE, ROAD, PAVEMENT, TREE, SIGN, FENCE, CAR, PEDESTRIAN, CYCLIST = range(len(NAMES))
OTHER = VOID


class Cover(IntEnum):
    """What paints a solid. LEAF and CEILING are those of the ray caster; the others mean nothing to it."""

    LEAF = Surface.LEAF
    CEILING = Surface.CEILING
    PLAIN = 32
    FACADE = 33
    BODY = 34  # lower part of a car: lamps, plate, wheel arches
    CABIN = 35  # its upper part with the windows
    COACH = 36  # a bus: windows along the side
    WHEEL = 37
    SHAPE = 38  # a thin plate cut to a triangle, disc, octagon ...; variant: the shape
    GRATE = 39  # bars upright or across; variant: their kind
    SPOKES = 40  # a wheel that one sees through
    HEAD = 41
    LIGHTS = 42  # of a traffic light


POROUS = (Cover.SHAPE, Cover.GRATE, Cover.SPOKES)


class Stage:
    """Collects what stands in a world. `finish` holds the finishes that every world has, by name."""

    def __init__(self, rng: Rng) -> None:
        self.rng = rng
        self._builder = Builder()
        self._finishes: list[Finish] = []
        self.facades: list[dict[str, float]] = []  # styles, by the names that the painter looks up
        self.bodies: list[dict[str, float]] = []
        self.at(0.0, 0.0)
        grey = hsv(0.6, rng.uniform(0, 0.2), rng.uniform(0.05, 0.6))
        glass = hsv(rng.uniform(0.4, 0.7), rng.uniform(0, 0.4), rng.uniform(0.01, 0.09))
        named = {
            "glass": plain(rng, glass, rng.uniform(0.1, 0.45), 0.3),
            "car glass": plain(rng, hsv(0.5, 0.2, rng.uniform(0.008, 0.05)), rng.uniform(0.04, 0.22), 0.3),
            "curtain": plain(rng, hsv(0.1, 0.1, rng.uniform(0.2, 0.7)), 0.1),
            "dark": plain(rng, hsv(0.6, 0.1, rng.uniform(0.01, 0.05))),
            "rim": plain(rng, hsv(0.6, 0.05, rng.uniform(0.15, 0.6)), 0.1),
            "lamp": plain(rng, hsv(0.6, 0.05, rng.uniform(0.4, 0.8)), 0.3, 0.3),
            "tail": plain(rng, hsv(0.99, 0.9, rng.uniform(0.2, 0.6)), 0.15, 0.2),
            "plate": plain(rng, hsv(rng.choice([0.12, 0.16, 0.6]), rng.choice([0.0, 0.1, 0.8]), rng.uniform(0.4, 0.85))),
            "chrome": plain(rng, hsv(0.6, 0.0, rng.uniform(0.2, 0.5)), 0.35),
            "metal": plain(rng, grey, 0.05),
            "skin": plain(rng, hsv(rng.uniform(0.03, 0.07), rng.uniform(0.3, 0.6), rng.uniform(0.1, 0.65))),
            "hair": plain(rng, hsv(rng.uniform(0.02, 0.12), rng.uniform(0.2, 0.7), rng.uniform(0.01, 0.3)), 0, 0.2),
            "white": plain(rng, hsv(0.1, 0.04, rng.uniform(0.6, 0.9))),
            "red": plain(rng, hsv(rng.uniform(0.97, 1.02), rng.uniform(0.7, 1), rng.uniform(0.3, 0.7))),
            "lit": Finish(hsv(rng.uniform(0.06, 0.15), rng.uniform(0.1, 0.6), 0.8), (0.5, 0.6, 0.7), emit=rng.uniform(0.3, 1.2)),
            "red light": Finish(hsv(0.0, 0.9, 0.9), (0, 0, 0), emit=1.0),
            "green light": Finish(hsv(0.42, 0.9, 0.9), (0, 0, 0), emit=1.0),
        }
        self.finish = {name: self.add(f) for name, f in named.items()}

    def at(self, x: float, y: float, yaw: float = 0.0, z: float = 0.0) -> None:
        """Sets the frame of the next solids: x forward, y left, metres, rad."""
        self._frame = (x, y, yaw, z)
        self._builder.at(x, y, yaw, z)

    def shift(self, x: float, y: float, turn: float = 0.0) -> None:
        """Moves the frame within itself."""
        x0, y0, yaw, z = self._frame
        self.at(x0 + cos(yaw) * x - sin(yaw) * y, y0 + sin(yaw) * x + cos(yaw) * y, yaw + turn, z)

    def put(
        self,
        kind: Kind,
        label: int,
        centre: Sequence[float],
        half: Sequence[float],
        finish: int,
        *,
        cover: Cover = Cover.PLAIN,
        taper: tuple[float, float] = (0.0, 0.0),
        variant: float = 0.0,
        openness: float = 0.5,
        tint: float = 1.0,
    ) -> None:
        """One solid: centre and half sizes (3,) in the frame. label: CamVid's number. variant: of its painter, below 4096."""
        half, style = tuple(max(h, 0.004) for h in half), (openness, finish, variant, float(self.rng.random()))
        self._builder.add(kind, label, centre, half, (tint, tint, tint), cover, taper=taper, style=style)  # type: ignore[arg-type]

    box, frustum, ellipsoid = partialmethod(put, Kind.BOX), partialmethod(put, Kind.FRUSTUM), partialmethod(put, Kind.ELLIPSOID)
    cylinder, wheel = partialmethod(put, Kind.CYLINDER), partialmethod(put, Kind.WHEEL)

    def add(self, finish: Finish) -> int:
        """A finish of this world's own; its number."""
        self._finishes.append(finish)
        return len(self._finishes) - 1

    def darker(self, finish: Finish, factor: float) -> int:
        """The same finish, darker or lighter."""
        return self.add(replace(finish, a=scaled(finish.a, factor), b=scaled(finish.b, factor)))

    def table(self) -> dict[str, Float32]:
        """Each field of all finishes by number: (k,), (k, 2) or (k, 3) float32."""
        return {f.name: np.array([getattr(row, f.name) for row in self._finishes], np.float32) for f in fields(Finish)}

    def solids(self) -> Solids:
        """Everything put so far."""
        return self._builder.solids()
