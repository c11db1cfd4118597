"""The furnished street of a seed, made block by block, so that it has no end and no block depends on another."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np
from numpy.typing import NDArray

from calib_ros.datasets.street import objects as things
from calib_ros.datasets.street import traffic
from calib_ros.datasets.street.path import Path
from calib_ros.datasets.street.solids import Builder, Solids, concatenate

BLOCK = 40.0  # m of street per block
KERB = 0.12  # m that the pavement lies above the road
VIEW_BEHIND, VIEW_AHEAD = 110.0, 150.0  # m of street that the sensors may see
CACHED_BLOCKS = 32


class Street:
    """What stands where. `road`: half width of the road; `pavement`: width of each pavement; metres.

    empty: stations (from, to) in metres between which nothing stands; the rest of the street is the same as without it.
    """

    def __init__(self, seed: int, length: float, empty: tuple[float, float] | None = None) -> None:
        self.seed = seed
        self.empty = empty
        self.path = Path(seed, length)
        rng = np.random.default_rng([seed, 3])
        self.road = float(rng.uniform(4.9, 6.2))
        self.pavement = float(rng.uniform(1.9, 3.2))
        self.lane = -0.5 * (self.road - 2.1)  # right-hand traffic; 2.1 m at either side are for parking
        self.style: NDArray[np.float32] = rng.random(8).astype(np.float32)
        self._storeys = rng.uniform(1.6, 3.6)
        self._setback = rng.uniform(0.3, 5.0)
        self._gaps, self._parking, self._trees, self._walkers = rng.uniform([0.08, 0.35, 0.15, 0.5], [0.35, 0.85, 0.6, 1.5])
        azimuth, elevation = rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(28, 58))
        c = np.cos(elevation)
        self.sun: NDArray[np.float64] = np.array([c * np.cos(azimuth), c * np.sin(azimuth), np.sin(elevation)])
        self._blocks: OrderedDict[int, Solids] = OrderedDict()

    def around(self, s: float) -> Solids:
        """All solids between VIEW_BEHIND before and VIEW_AHEAD after station s."""
        first, last = int((s - VIEW_BEHIND) // BLOCK), int((s + VIEW_AHEAD) // BLOCK)
        return concatenate([self._block(k) for k in range(first, last + 1)])

    def _block(self, k: int) -> Solids:
        block = self._blocks.pop(k, None)
        self._blocks[k] = block = self._furnish(k) if block is None else block
        while len(self._blocks) > CACHED_BLOCKS:
            self._blocks.popitem(last=False)
        return block

    def _furnish(self, k: int) -> Solids:
        # Block numbers before the start are negative, seeds must not be.
        rng = np.random.default_rng([self.seed, 4, k + 1_000_000])
        b, start = Builder(), k * BLOCK
        for side in (-1, 1):
            self._houses(b, rng, start, side)
            self._parked(b, rng, start, side)
            self._furniture(b, rng, start, side)
        self._crowd(b, rng, start)
        return b.solids()

    def _at(self, b: Builder, s: float, d: float, turn: float = 0.0, z: float = KERB) -> None:
        x, y, heading = self.path.place(s, d)
        # What is left out is made all the same: the numbers it draws belong to what comes after it.
        b.at(x, y, heading + turn, z, hidden=self.empty is not None and self.empty[0] <= s <= self.empty[1])

    def _houses(self, b: Builder, rng: np.random.Generator, start: float, side: int) -> None:
        front = self.road + self.pavement
        s = start
        while s < start + BLOCK - 5:
            length = min(rng.uniform(7, 16), start + BLOCK - s)
            setback, depth = self._setback * rng.uniform(0.3, 1.6), rng.uniform(7, 11)
            height = 3.0 * max(1, round(self._storeys + rng.uniform(-1, 1))) + rng.uniform(0, 0.8)
            # A house's front faces its own -y: right as it is on the left side, turned round on the right one.
            turn = (0.0 if side > 0 else np.pi) + np.deg2rad(rng.normal(0, 1.5))
            middle = s + length / 2
            if rng.random() > self._gaps:
                self._at(b, middle, side * (front + setback + depth / 2), turn)
                things.house(b, rng, length - rng.choice([0.0, 0.4, 2.5]), depth, height)
            else:  # a garden; a row of houses behind closes the view
                self._at(b, middle, side * (front + rng.uniform(22, 40)), turn)
                things.house(b, rng, length + 6, depth, height + 1)
                for _ in range(rng.integers(1, 4)):
                    self._at(b, s + rng.uniform(0, length), side * (front + rng.uniform(2.5, 14)))
                    (things.tree if rng.random() < 0.5 else things.bush)(b, rng)
            if setback > 1.2 and rng.random() < 0.7:
                self._at(b, middle, side * (front + 0.3))
                things.border(b, rng, length - rng.uniform(1, 4))
            s += length + rng.choice([0.0, 0.0, 1.2, 3.5])

    def _parked(self, b: Builder, rng: np.random.Generator, start: float, side: int) -> None:
        s = start + rng.uniform(2.5, 4)
        while s < start + BLOCK - 3:
            if rng.random() < self._parking:
                turn = (0.0 if rng.random() < 0.8 else np.pi) + (0 if side < 0 else np.pi) + np.deg2rad(rng.normal(0, 1.5))
                self._at(b, s, side * (self.road - 1.05 + rng.normal(0, 0.06)), turn, z=0.0)
                (traffic.truck if rng.random() < 0.06 else traffic.car)(b, rng)
                s += 1.2
            s += rng.uniform(4.8, 6.5)

    def _furniture(self, b: Builder, rng: np.random.Generator, start: float, side: int) -> None:
        """Everything upright near the kerb, and bins at the inner edge of the pavement."""
        inward = 0.0 if side < 0 else np.pi  # poles turn their arms over the road
        s = start + rng.uniform(0.5, 4)
        while s < start + BLOCK - 1:
            choice = rng.random()
            self._at(b, s, side * (self.road + rng.uniform(0.35, 0.6)), inward)
            if choice < self._trees * 0.6:
                self._at(b, s, side * (self.road + rng.uniform(0.7, 0.9)))
                things.tree(b, rng)
            elif choice < self._trees * 0.6 + 0.25:
                things.pole(b, rng)
            elif choice < self._trees * 0.6 + 0.40:
                things.sign(b, rng)
            elif choice < self._trees * 0.6 + 0.55:
                self._at(b, s, side * (self.road + self.pavement - 0.3), rng.uniform(-0.1, 0.1))
                things.bin_or_box(b, rng)
            elif choice < self._trees * 0.6 + 0.62:
                self._at(b, s, side * (self.road + self.pavement - 0.1), rng.uniform(-0.4, 0.4) + np.pi / 2)
                things.billboard(b, rng)
            s += rng.uniform(3.5, 8)

    def _crowd(self, b: Builder, rng: np.random.Generator, start: float) -> None:
        """People on the pavements, now and then one in the opposite lane, and cyclists."""
        for _ in range(rng.poisson(2.5 * self._walkers)):
            side = rng.choice([-1, 1])
            self._at(b, start + rng.uniform(0, BLOCK), side * (self.road + rng.uniform(1.2, self.pavement - 0.4)),
                     rng.uniform(0, 2 * np.pi))  # fmt: skip
            traffic.person(b, rng)
        if rng.random() < 0.3:
            self._at(b, start + rng.uniform(0, BLOCK), rng.uniform(1.0, self.road - 2.6), rng.uniform(0, 2 * np.pi), z=0.0)
            traffic.person(b, rng)
        if rng.random() < 0.5:
            self._at(b, start + rng.uniform(0, BLOCK), self.road - 2.5, np.pi, z=0.0)
            traffic.cyclist(b, rng)
