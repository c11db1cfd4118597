"""The scenes of the synthetic drive: the street of houses and what else a vehicle drives through, made block by block like it."""

from __future__ import annotations

import numpy as np

from calib_ros.frame import SemanticClass as Label
from calib_ros_synthetic import objects
from calib_ros_synthetic.solids import Builder, Floats
from calib_ros_synthetic.street import BLOCK, Street

Rng = np.random.Generator
LAMPS = np.deg2rad(75.0)  # elevation of the light indoors; rows of lamps throw short shadows


class Trees(Street):
    """A country road through woods: trunks, crowns and undergrowth, hardly a straight edge but those of the road."""

    ground = "country"
    kerb = 0.0
    cruise = 8.0

    def _lay_out(self, rng: Rng) -> None:
        self.road = 3.3
        self.lane = -1.5
        self._density, self._conifers = rng.uniform(14, 24), rng.uniform(0.1, 0.6)

    def _fill(self, b: Builder, rng: Rng, start: float) -> None:
        for side in (-1, 1):
            for _ in range(rng.poisson(self._density)):
                d = self.road + 2.2 + 22.0 * rng.random() ** 1.6
                self._at(b, start + rng.uniform(0, BLOCK), side * d, rng.uniform(0, 2 * np.pi))
                (objects.conifer if rng.random() < self._conifers else objects.broadleaf)(b, rng)
            for _ in range(rng.poisson(self._density)):
                self._at(b, start + rng.uniform(0, BLOCK), side * (self.road + 1.5 + rng.exponential(5.0)))
                objects.thicket(b, rng)
            objects.delineator(self._at(b, start + rng.uniform(0, BLOCK), side * (self.road + 0.8)), rng)
        if rng.random() < 0.35:
            self._at(b, start + rng.uniform(0, BLOCK), 1.6, np.pi)
            (objects.car if rng.random() < 0.7 else objects.cyclist)(b, rng)


class Park(Street):
    """A path through a park: lawns, old trees, bushes and people; vegetation everywhere."""

    ground = "path"
    kerb = 0.0
    cruise = 3.0
    bend = 1.2

    def _lay_out(self, rng: Rng) -> None:
        self.road = float(rng.uniform(1.6, 2.4))
        self.lane = 0.0
        self._density = rng.uniform(13, 20)

    def _fill(self, b: Builder, rng: Rng, start: float) -> None:
        for side in (-1, 1):
            for _ in range(rng.poisson(self._density)):
                self._beside(b, rng, start, side * (self.road + 1.5 + 34.0 * rng.random() ** 1.5))
                (objects.conifer if rng.random() < 0.2 else objects.broadleaf)(b, rng)
            for _ in range(rng.poisson(14)):
                self._beside(b, rng, start, side * (self.road + 1.2 + rng.exponential(7.0)))
                objects.thicket(b, rng)
            if rng.random() < 0.5:
                self._beside(b, rng, start, side * (self.road + rng.uniform(1.0, 10.0)))
                objects.boulder(b, rng)
            if rng.random() < 0.5:
                self._at(b, start + rng.uniform(0, BLOCK), side * (self.road + 0.6), 0.0 if side > 0 else np.pi)
                objects.bench(b, rng)
            if rng.random() < 0.6:
                self._beside(b, rng, start, side * (self.road + rng.uniform(0.5, 6.0)))
                objects.person(b, rng)
        if rng.random() < 0.6:
            objects.pole(self._at(b, start + rng.uniform(0, BLOCK), self.road + 0.5, np.pi), rng)

    def _beside(self, b: Builder, rng: Rng, start: float, d: float) -> None:
        self._at(b, start + rng.uniform(0, BLOCK), d, rng.uniform(0, 2 * np.pi))


class CarPark(Street):
    """A deck of a car park: parked cars, pillars and a low ceiling, again and again; far walls."""

    ground = "parking"
    kerb = 0.0
    cruise = 3.0
    bend = 0.05
    view = (60.0, 90.0)
    indoors = True
    height = 3.1  # m, of the ceiling

    def _lay_out(self, rng: Rng) -> None:
        self.road = float(rng.uniform(3.0, 3.4))
        self.lane = -0.8
        self._full = rng.uniform(0.5, 0.85)
        self.sun = _overhead(rng)

    def _fill(self, b: Builder, rng: Rng, start: float) -> None:
        bay = self.road + 2.5  # offset of the middle of a bay from that of its aisle
        aisle = 2 * (self.road + 5.0)
        for row, side in ((0, -1), (0, 1), (-1, 1), (1, -1)):
            middle = row * aisle + side * bay
            for s in np.arange(start + 1.25, start + BLOCK, 2.5):
                if rng.random() < self._full:
                    nose_in = rng.random() < 0.7
                    turn = side * (np.pi / 2 if nose_in else -np.pi / 2) + np.deg2rad(rng.normal(0, 2))
                    self._at(b, s + rng.normal(0, 0.1), middle + rng.normal(0, 0.15), turn)
                    (objects.truck if rng.random() < 0.02 and row == 0 else objects.car)(b, rng)
        for side in (-1, 1):
            for s in np.arange(start, start + BLOCK, 7.5):
                objects.pillar(self._at(b, s, side * (self.road + 0.7)), rng, self.height)
                objects.pillar(self._at(b, s, side * (self.road + 5.0)), rng, self.height)
            self._at(b, start + BLOCK / 2, side * (1.5 * aisle), 0.0 if side > 0 else np.pi)
            objects.wall(b, rng, BLOCK + 0.5, self.height)
        for s in np.arange(start + 5, start + BLOCK, 10.0):
            objects.slab(self._at(b, s, 0.0), 10.05, 3 * aisle, self.height, 5.0)
        objects.duct(self._at(b, start + BLOCK / 2, rng.uniform(-1, 1) * self.road), rng, BLOCK, self.height)
        _bulkhead(self._at(b, start, 0.0), self.road + 0.4, 1.5 * aisle, self.height)
        if rng.random() < 0.7:
            self._at(b, start + rng.uniform(0, BLOCK), rng.uniform(1.0, self.road), rng.uniform(0, 2 * np.pi))
            objects.person(b, rng)


class Warehouse(Street):
    """An aisle between pallet racks: everything straight, repeated, near, and under a ceiling."""

    ground = "hall"
    kerb = 0.0
    cruise = 2.0
    bend = 0.02
    view = (42.0, 80.0)
    indoors = True
    height = 7.6  # m, of the ceiling

    def _lay_out(self, rng: Rng) -> None:
        self.road = float(rng.uniform(1.9, 2.6))
        self.lane = 0.0
        self._bay, self._step = float(rng.uniform(2.5, 2.9)), float(rng.uniform(1.35, 1.7))
        self.sun = _overhead(rng)

    def _fill(self, b: Builder, rng: Rng, start: float) -> None:
        depth = 1.1
        for side in (-1, 1):
            turn = 0.0 if side > 0 else np.pi
            # A passage crosses the racks in each block; behind them, the next aisle's stand.
            passage = start + rng.uniform(10, 28)
            for s in np.arange(start + 1.6 + self._bay / 2, start + BLOCK - 1.5, self._bay):
                if abs(s - passage) > 2.4:
                    objects.rack(self._at(b, s, side * (self.road + depth / 2), turn), rng, self._bay, depth, 4, self._step)
            objects.wall(self._at(b, start + BLOCK / 2, side * (self.road + 9.0), turn), rng, BLOCK + 0.5, self.height)
            for _ in range(rng.poisson(1.5)):
                self._at(b, start + rng.uniform(2, BLOCK), side * (self.road - 0.5), rng.uniform(-0.2, 0.2))
                objects.pallet(b, rng)
            for _ in range(rng.poisson(2.0)):  # behind the racks, seen through the passages
                self._at(b, passage + rng.normal(0, 2.0), side * (self.road + rng.uniform(2.5, 8.0)), rng.uniform(0, 6))
                objects.pallet(b, rng)
        for s in np.arange(start + 5, start + BLOCK, 10.0):
            objects.slab(self._at(b, s, 0.0), 10.05, 2 * (self.road + 9.2), self.height, 5.0)
        _bulkhead(self._at(b, start, 0.0), self.road + 0.2, self.road + 9.1, self.height)
        if rng.random() < 0.6:
            objects.person(self._at(b, start + rng.uniform(3, BLOCK), self.road - 0.6, rng.uniform(0, 2 * np.pi)), rng)
        if rng.random() < 0.4:
            objects.forklift(self._at(b, passage, self.road + 0.5, rng.uniform(0, 2 * np.pi)))


class Highway(Street):
    """A carriageway of three lanes: guard rails, signs, few vehicles, and nothing else near."""

    ground = "highway"
    kerb = 0.0
    cruise = 22.0
    bend = 0.35

    def _lay_out(self, rng: Rng) -> None:
        self.road = 7.4
        self._lane = (2 * self.road - 3.6) / 3
        self.lane = self.road - 0.6 - 2.5 * self._lane

    def _fill(self, b: Builder, rng: Rng, start: float) -> None:
        for side in (-1, 1):
            for s in np.arange(start + 4, start + BLOCK, 8.0):
                objects.guard_rail(self._at(b, s, side * (self.road + 0.9), 0.0 if side > 0 else np.pi), 8.05)
            objects.delineator(self._at(b, start, side * (self.road + 0.6)), rng)
            for _ in range(rng.poisson(2.0)):
                self._at(b, start + rng.uniform(0, BLOCK), side * (self.road + rng.uniform(9, 45)))
                (objects.thicket if rng.random() < 0.6 else objects.broadleaf)(b, rng)
        if rng.random() < 0.25:
            objects.gantry(self._at(b, start + rng.uniform(0, BLOCK), 0.0), rng, 2 * self.road + 3.0)
        if rng.random() < 0.45:
            objects.road_sign(self._at(b, start + rng.uniform(0, BLOCK), -(self.road + 3.2)), rng)
        for lane in (0, 1):  # the own lane stays free
            if rng.random() < 0.4:
                self._at(b, start + rng.uniform(0, BLOCK), self.road - 0.6 - (lane + 0.5) * self._lane, rng.normal(0, 0.01))
                (objects.lorry if rng.random() < 0.3 else objects.car)(b, rng)
        if rng.random() < 0.3:
            self._at(b, start + rng.uniform(0, BLOCK), self.road + 14.0, np.pi)  # the other carriageway
            (objects.lorry if rng.random() < 0.4 else objects.car)(b, rng)


SCENES: dict[str, type[Street]] = {
    "street": Street, "trees": Trees, "park": Park, "car_park": CarPark, "warehouse": Warehouse, "highway": Highway,
}  # fmt: skip


def _overhead(rng: Rng) -> Floats:
    azimuth = rng.uniform(0, 2 * np.pi)
    return np.array([np.cos(LAMPS) * np.cos(azimuth), np.cos(LAMPS) * np.sin(azimuth), np.sin(LAMPS)])


def _bulkhead(b: Builder, gate: float, half: float, height: float) -> None:
    """A wall across, half m to either side of the Builder's frame, with a gate of `gate` m to either side."""
    white = (0.52, 0.53, 0.53)
    lintel = min(height - 0.2, 4.2)
    for side in (-1, 1):
        middle, wide = side * (gate + half) / 2, (half - gate) / 2
        b.box(Label.BUILDING, (0, middle, height / 2), (0.12, wide, height / 2), white)
        b.box(Label.BUILDING, (-0.14, side * (gate + 0.1), lintel / 2), (0.03, 0.1, lintel / 2), (0.06, 0.5, 0.65))
    b.box(Label.BUILDING, (0, 0, (height + lintel) / 2), (0.12, gate, (height - lintel) / 2), white)
