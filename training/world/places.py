"""Places: what stands where along a random road, in towns, suburbs, parks, works, car parks and along highways."""

from __future__ import annotations

from dataclasses import replace
from math import cos, pi

import numpy as np

from training.world import buildings, furniture, looks, people, plants, vehicles
from training.world.cameras import RandomCamera
from training.world.grounds import layout_of
from training.world.stage import OTHER, Stage

KINDS = ("town", "suburb", "blocks", "park", "works", "lot", "highway")
SHARES = (0.27, 0.28, 0.12, 0.09, 0.08, 0.09, 0.07)
KERBSIDE = (furniture.lamp, furniture.mast, furniture.sign, furniture.board, furniture.traffic_light, furniture.bollard)
AHEAD, BEHIND = 105.0, 22.0  # m along the road that is furnished


class Place:
    """Furnishes a stage about a camera at the origin."""

    def __init__(self, stage: Stage, camera: RandomCamera) -> None:
        rng = stage.rng
        self.stage, self.rng = stage, rng
        self.kind = KINDS[int(rng.choice(len(KINDS), p=SHARES))]
        lane = -rng.uniform(0.1, 0.6) * (1 if rng.random() < 0.6 else -1)
        layout = layout_of(rng, self.kind)
        if rng.random() < 0.1:  # on the pavement
            offset = rng.choice([-1, 1]) * (layout.road + layout.verge + 0.6 * max(layout.walk, 1))
        else:
            offset = lane * layout.road
        self.layout = replace(layout, y=-offset)
        ahead = cos(camera.yaw)
        self.first, self.last = -BEHIND, AHEAD
        if abs(camera.yaw) >= 0.5:
            self.first, self.last = -AHEAD * max(-ahead, 0.4), AHEAD * max(ahead, 0.4)
        self.winter = float(rng.choice([0.0, rng.uniform(0.2, 1.0)], p=[0.7, 0.3]))
        self._furnish()
        if rng.random() < 0.15:
            self._bonnet(camera)

    def _at(self, s: float, d: float, turn: float = 0.0, raised: bool = True) -> Stage:
        """The stage, with its frame at a station and an offset."""
        x, y, heading = self.layout.place(s, d)
        self.stage.at(x, y, heading + turn, self.layout.kerb if raised else 0.0)
        return self.stage

    def _spread(self, step: tuple[float, float]) -> list[float]:
        """Stations with random steps between them."""
        out, s = [], self.first + self.rng.uniform(0, step[1])
        while s < self.last:
            out.append(float(s))
            s += self.rng.uniform(*step)
        return out

    def _furnish(self) -> None:
        a, rng, kind = self.layout, self.rng, self.kind
        for side in (-1, 1):
            if kind in ("town", "suburb", "blocks", "works", "lot"):
                self._houses(side)
            self._greenery(side)
            self._kerbside(side)
            if kind not in ("highway", "park"):
                self._parked(side)
            if kind == "highway":
                for s in self._spread((8.0, 8.0)) if rng.random() < 0.7 else []:
                    furniture.rail(self._at(s, side * (a.road + 0.7), 0 if side < 0 else pi), 8.0)
        self._lots()
        self._traffic()
        self._people()
        if kind == "highway" and rng.random() < 0.4:
            furniture.gantry(self._at(rng.uniform(20, 80), 0), rng, a.road + 1.5)
        for s, half in a.crossings:
            if rng.random() < 0.8:  # what closes the view along a crossing road
                for side in (-1, 1):
                    self._at(s, side * rng.uniform(45, 80), 0 if side > 0 else pi)
                    buildings.house(self.stage, rng, rng.uniform(8, 20), 9, int(rng.integers(1, 5)))
                    self._at(s + rng.normal(0, half), side * (a.road + rng.uniform(4, 30)), pi / 2, False)
                    if rng.random() < 0.6:
                        vehicles.any_vehicle(self.stage, rng)

    def _houses(self, side: int) -> None:
        a, rng, kind = self.layout, self.rng, self.kind
        low, high = {"town": (2, 6), "suburb": (1, 4), "blocks": (3, 16), "works": (1, 3), "lot": (1, 4)}[kind]
        storeys, row = rng.uniform(low, high), rng.random() < {"town": 0.8, "suburb": 0.25}.get(kind, 0.3)
        setback = {"town": rng.uniform(0, 2), "suburb": rng.uniform(1, 9)}.get(kind, rng.uniform(1, 14))
        front, gaps, edges = a.road + a.verge + a.walk, rng.uniform(0, 0.3), rng.random()
        s = self.first - 6.0
        while s < self.last + 10:
            length = rng.uniform(5, 13) if kind in ("town", "suburb") else rng.uniform(10, 32)
            middle, depth, back = s + length / 2, rng.uniform(7, 13), setback * rng.uniform(0.6, 1.4)
            if any(s0 - 2 < middle + length / 2 and middle - length / 2 < s1 + 2 and d0 * side >= 0 for s0, s1, d0, _ in a.lots):
                back += max(abs(d) for _, _, d0, d1 in a.lots for d in (d0, d1) if d0 * side >= 0) - front + 3
            if not a.free(middle, length / 2 + 1.0) or rng.random() < gaps:
                s += length * 0.7
                continue
            self._at(middle, side * (front + back + depth / 2), (0 if side > 0 else pi) + np.deg2rad(rng.normal(0, 1.5)))
            if kind in ("works", "lot") and rng.random() < 0.6:
                buildings.hall(self.stage, rng, length, depth * 1.5, rng.uniform(3.5, 10))
            else:
                buildings.house(self.stage, rng, length, depth, max(1, round(storeys + rng.uniform(-1, 1))))
            if back > 1.5 and rng.random() < edges:
                self._at(middle, side * (front + 0.3))
                if rng.random() < 0.4:
                    plants.hedge(self.stage, rng, length)
                else:
                    buildings.border(self.stage, rng, length)
            if back > 3:
                for _ in range(int(rng.poisson(1.2))):
                    self._at(s + rng.uniform(0, length), side * (front + rng.uniform(1.2, back - 0.8)))
                    plants.bush(self.stage, rng) if rng.random() < 0.6 else plants.any_tree(self.stage, rng, self.winter)
            s += length + (0.0 if row else rng.choice([0.3, rng.uniform(2, 9)]))

    def _greenery(self, side: int) -> None:
        a, rng = self.layout, self.rng
        density = {"park": 1.0, "highway": 0.8, "suburb": 0.6}.get(self.kind, 0.35) * rng.uniform(0.2, 1.3)
        front = a.road + a.verge + a.walk
        far = {"park": 25.0, "highway": 45.0}.get(self.kind, 0.0)
        if rng.random() < density:  # a row of trees at the kerb
            d = a.road + 0.6 + 0.5 * a.verge
            for s in self._spread((5, 16)):
                if a.free(s, 2):
                    plants.any_tree(self._at(s, side * d), rng, self.winter)
        if far:
            for _ in range(int(rng.poisson(22 * density))):
                s, d = rng.uniform(self.first, self.last), front + 1.5 + far * rng.random() ** 1.5
                if a.free(s, 2):
                    stage = self._at(s, side * d)
                    plants.bush(stage, rng) if rng.random() < 0.35 else plants.any_tree(stage, rng, self.winter)
            if rng.random() < 0.5:
                for s in self._spread((7, 9)):
                    if a.free(s, 4):
                        self._at(s, side * (front + 0.8))
                        plants.hedge(self.stage, rng, 7.5) if rng.random() < 0.5 else buildings.border(self.stage, rng, 7.5)
            return
        for _ in range(int(rng.poisson(7 * rng.random()))):  # behind the houses
            plants.any_tree(self._at(rng.uniform(self.first, self.last), side * (front + rng.uniform(14, 40))), rng, self.winter)
        for _ in range(int(rng.poisson(5 * rng.random()))):
            self._at(rng.uniform(self.first, self.last), side * (front + rng.uniform(26, 60)), 0 if side > 0 else pi)
            buildings.house(self.stage, rng, rng.uniform(8, 25), 9, int(rng.integers(1, 9)))

    def _kerbside(self, side: int) -> None:
        a, rng = self.layout, self.rng
        inward = 0.0 if side < 0 else pi
        shares = np.array([0.24, 0.08, 0.24, 0.05, 0.07, 0.14, 0.1, 0.08]) * rng.uniform(0.2, 1.8, 8)
        for s in self._spread((4, 14)):
            if not a.free(s, 0.5) or rng.random() < 0.15:
                continue
            what = int(rng.choice(8, p=shares / shares.sum()))
            self._at(s, side * (a.road + rng.uniform(0.3, 0.8)), inward)
            if what < 6:
                KERBSIDE[what](self.stage, rng)
            elif what == 6:
                self._at(s, side * (a.road + a.verge + 0.8 * a.walk), inward + rng.normal(0, 0.2))
                buildings.kiosk(self.stage, rng) if rng.random() < 0.2 else furniture.clutter(self.stage, rng)
            elif rng.random() < 0.6:
                buildings.border(self._at(s, side * (a.road + 0.3), inward), rng, rng.uniform(2, 8))
            else:
                people.bicycle(self._at(s, side * (a.road + 0.9 * a.walk), inward + rng.uniform(-1, 1)), rng)
        for s, half in a.crossings:
            if rng.random() < 0.5:
                self._at(s - half - 1, side * (a.road + 0.6), inward)
                furniture.traffic_light(self.stage, rng) if rng.random() < 0.5 else furniture.sign(self.stage, rng)

    def _parked(self, side: int) -> None:
        a, rng = self.layout, self.rng
        share = rng.choice([0.0, rng.uniform(0.2, 0.6), rng.uniform(0.6, 1.0)], p=[0.25, 0.4, 0.35])
        across = rng.random() < 0.08
        d = a.road - 1.0 if a.bay or rng.random() < 0.5 else a.road + 0.6
        if across:
            d = a.road + 1.6
        for s in self._spread((2.7, 3.2) if across else (5.2, 6.6)):
            near = abs(s) < 3.5 and abs(self.layout.y + side * d) < 2.2  # the camera is no parked car
            if rng.random() < share and a.free(s, 3) and not near:
                turn = pi / 2 if across else rng.choice([0.0, pi], p=[0.75, 0.25]) + (0 if side < 0 else pi)
                vehicles.any_vehicle(self._at(s, side * d, turn + np.deg2rad(rng.normal(0, 2)), d > a.road), rng, 0.03)

    def _lots(self) -> None:
        rng = self.rng
        for s0, s1, d0, d1 in self.layout.lots:
            share = rng.uniform(0.2, 0.95)
            for row in np.arange(d0 + 2.7, d1 - 2, 8.0):
                for s in np.arange(s0 + 1.4, s1 - 1, 2.6):
                    if rng.random() < share and abs(row) > self.layout.road + 2.4 and self.first < s < self.last:
                        self._at(s, row, pi / 2 * rng.choice([-1, 1]) + rng.normal(0, 0.03), False)
                        if np.hypot(*self.layout.place(s, row)[:2]) > 3.5:
                            vehicles.any_vehicle(self.stage, rng, 0.01)
                if rng.random() < 0.4:
                    self._at(rng.uniform(s0, s1), row + 2.6)
                    (furniture.lamp if rng.random() < 0.5 else furniture.board)(self.stage, rng)

    def _traffic(self) -> None:
        a, rng = self.layout, self.rng
        jam = rng.random() < 0.2
        count = int(rng.poisson(6 if jam else 2.0))
        lanes = 3 if self.kind == "highway" else 1
        for _ in range(count):
            direction = rng.choice([-1, 1])
            s = rng.uniform(6, 30) if jam else rng.uniform(self.first, self.last)
            middle = -direction * (a.road - a.bay) * rng.uniform(0.35, 0.55)
            d = middle * (rng.integers(1, lanes + 1) / lanes * 2 if lanes > 1 else 1)
            x, y, _ = a.place(s, d)
            if np.hypot(x, y) > 5.5 and abs(d) < a.road - 0.8:
                vehicles.any_vehicle(self._at(s, d, (0 if direction > 0 else pi) + rng.normal(0, 0.04), False), rng, 0.18)

    def _people(self) -> None:
        a, rng = self.layout, self.rng
        crowd = {"town": 6.0, "highway": 0.0, "park": 4.0}.get(self.kind, 2.5) * rng.uniform(0, 2)
        for _ in range(int(rng.poisson(crowd))):
            side = rng.choice([-1, 1])
            s = (self.last - 2) * rng.random() ** 1.4 if rng.random() < 0.8 else rng.uniform(self.first, 0)
            d = side * (a.road + a.verge + rng.uniform(0.3, max(a.walk, 0.8)))
            if rng.random() < 0.12:
                d = rng.uniform(-a.road, a.road)
            x, y, _ = a.place(s, d)
            if np.hypot(x, y) > 2.0:
                self._at(s, d, rng.choice([0, pi, rng.uniform(0, 6)]) + rng.normal(0, 0.2), abs(d) > a.road)
                people.group(self.stage, rng) if rng.random() < 0.3 else people.person(self.stage, rng)
        for _ in range(int(rng.poisson(0.2 if self.kind == "highway" else 1.3))):
            s, d = rng.uniform(3, 45), rng.choice([-1, 1]) * a.road * rng.uniform(0.3, 0.95)
            if np.hypot(*a.place(s, d)[:2]) > 2.5:
                self._at(s, d, (0 if d < 0 else pi) + rng.normal(0, 0.3), False)
                people.motorcyclist(self.stage, rng) if rng.random() < 0.3 else people.cyclist(self.stage, rng)

    def _bonnet(self, camera: RandomCamera) -> None:
        """The own vehicle below the view; it has no class."""
        rng, stage = self.rng, self.stage
        stage.at(0, 0, camera.yaw)
        drop = max(0.2, camera.height - rng.uniform(0.6, 1.0))
        finish = stage.add(looks.paint(rng))
        stage.ellipsoid(OTHER, (rng.uniform(1.1, 1.6), rng.normal(0, 0.2), drop - 0.15), (0.9, 0.95, 0.2), finish)
