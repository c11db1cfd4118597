"""The ground: roads, junctions, car parks, pavements and what lies beyond, laid out about the camera and met by rays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros_synthetic.rays import NEAREST, Rays
from calib_ros_synthetic.solids import cell, noise2
from training.world import looks
from training.world.looks import Finish, Float32, Pattern, Rng
from training.world.stage import PAVEMENT, ROAD, Stage

GROUND = -2  # what rays met; solids have their number from 0, the sky is -1
STRAIGHT = 160.0  # m; further away the road goes straight on
HALVINGS = 5  # of the way over a kerb: 1/32 of it
NONE = 9.0  # as a bound of noise: never reached


@dataclass(frozen=True)
class Layout:
    """Where the ground is what. Offsets d from the road's centre line are positive to the left, stations s are along x.

    y, slope, bend: the line y + slope x + bend x^2 / 2. road: half width of the road; walk: width of each pavement; verge: of the
    grass between them (0 = none); bay: of the parking bays at the road's edges. crossings: stations and half widths of crossing
    roads. lots: car parks as (s from, s to, d from, d to). kerb: m by which all but roads is higher.
    """

    y: float
    slope: float
    bend: float
    road: float
    walk: float
    verge: float
    bay: float
    kerb: float
    crossings: tuple[tuple[float, float], ...]
    lots: tuple[tuple[float, float, float, float], ...]

    def place(self, s: float, d: float) -> tuple[float, float, float]:
        """x, y and heading at a station and an offset."""
        x = min(max(s, -STRAIGHT), STRAIGHT)
        slope = self.slope + self.bend * x
        y, heading = self.y + self.slope * x + self.bend * x * x / 2 + slope * (s - x), float(np.arctan(slope))
        return s - d * float(np.sin(heading)), y + d * float(np.cos(heading)), heading

    def offset(self, x: Float32, y: Float32) -> Float32:
        """Offsets (n,) of points (n,)."""
        c = np.clip(x, -STRAIGHT, STRAIGHT)
        slope = np.float32(self.slope) + np.float32(self.bend) * c
        line = np.float32(self.y) + np.float32(self.slope) * c + np.float32(self.bend / 2) * c * c + slope * (x - c)
        return np.asarray((y - line) / np.sqrt(1 + slope * slope), np.float32)

    def is_road(self, x: Float32, y: Float32) -> NDArray[np.bool_]:
        """Whether points (n,) lie on what is not raised by a kerb."""
        d = self.offset(x, y)
        road: NDArray[np.bool_] = np.abs(d) < self.road
        for s, half in self.crossings:
            # Corners are rounded: the crossing road widens near the other one.
            wide = half + 3.0 * np.clip(1 - (np.abs(d) - self.road) / 3.0, 0, 1) ** 2
            road |= np.abs(x - s) < wide
        for s0, s1, d0, d1 in self.lots:
            road |= (x > s0) & (x < s1) & (d > d0) & (d < d1)
        return road

    def free(self, s: float, half: float) -> bool:
        """Whether no crossing road or car park's entry comes within `half` of a station."""
        return all(abs(s - c) > w + half for c, w in self.crossings)


def cast_ground(rays: Rays, layout: Layout, height: float, t: Float32, ids: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Lowers t and writes GROUND to ids, both (rows, columns), in place, where a ray meets the ground first -> kerbs (the same).

    height: of the rays' origin above the road.
    """
    kerbs = np.zeros(t.shape, bool)
    dz = np.broadcast_to(rays.direction[2], t.shape)
    rows, columns = np.nonzero((dz < -1e-4) & (t * np.minimum(dz, -1e-9) < layout.kerb - height))
    dx, dy, drop = (np.broadcast_to(a, t.shape)[rows, columns] for a in (*rays.direction[:2], -dz))
    high, low = np.float32(height - layout.kerb) / drop, np.float32(height) / drop
    road = layout.is_road(high * dx, high * dy)
    new, kerb = np.where(road, low, high), np.zeros(len(rows), bool)
    if layout.kerb > 0:
        on = np.flatnonzero(road)
        raised = ~layout.is_road(low[on] * dx[on], low[on] * dy[on])  # came down on the road, and through a kerb
        some = on[raised]
        a, b = high[some], low[some]
        for _ in range(HALVINGS):
            middle = (a + b) / 2
            above = layout.is_road(middle * dx[some], middle * dy[some])
            a, b = np.where(above, middle, a), np.where(above, b, middle)
        new[some], kerb[some] = a, True
    hit = (new < t[rows, columns]) & (new > NEAREST)
    rows, columns = rows[hit], columns[hit]
    t[rows, columns], ids[rows, columns], kerbs[rows, columns] = new[hit], GROUND, kerb[hit]
    return kerbs


class GroundPainter:
    """What the ground is made of, for the finishes of one stage."""

    def __init__(self, stage: Stage, layout: Layout) -> None:
        rng = stage.rng
        self._layout, self._rng_key = layout, int(rng.integers(1 << 16))
        road = looks.asphalt(rng)
        self._road, self._patch = stage.add(road), stage.darker(road, rng.uniform(0.5, 1.5))
        self._side = self._road if rng.random() < 0.6 else stage.add(looks.asphalt(rng))
        self._bay = self._road if rng.random() < 0.5 else stage.add(looks.asphalt(rng))
        self._lot = self._road if rng.random() < 0.4 else stage.add(looks.asphalt(rng))
        self._walk = stage.add(looks.paving(rng))
        self._beyond, self._verge = stage.add(looks.turf(rng)), stage.add(looks.turf(rng))
        if rng.random() < 0.35:
            self._beyond = stage.add(looks.paving(rng))
        self._kerb = stage.add(looks.plain(rng, looks.hsv(rng.uniform(0.05, 0.6), 0.06, rng.uniform(0.15, 0.6)), 0, 0.1))
        worn = rng.uniform(0.3, 0.85)
        mark = looks.hsv(0.13, rng.choice([0.02, 0.03, 0.7], p=[0.5, 0.35, 0.15]), worn)
        self._mark = stage.add(Finish(mark, looks.scaled(road.a, 1.0), Pattern.BLOTCH, (0.4, 1.0), fine=0.15, grain=30))
        self._crack, self._cover = stage.add(looks.plain(rng, looks.scaled(road.a, rng.uniform(0.2, 0.7)))), stage.finish["metal"]
        self._wet = stage.add(looks.plain(rng, looks.scaled(road.a, 0.5), gloss=rng.uniform(0.1, 0.4)))
        self._leaves = stage.add(looks.foliage(rng))
        self._width = rng.uniform(0.09, 0.2)
        self._dash, self._gap = rng.uniform(1.0, 6.0), rng.uniform(1.0, 9.0)
        self._marks = rng.random(8)
        worn_out = rng.uniform(0.6, 2.6, 2) if rng.random() < 0.7 else np.array([NONE, NONE])
        self._patches, self._cracks = worn_out[0], worn_out[1]
        self._puddles = rng.uniform(0.3, 1.2) if rng.random() < 0.2 else NONE
        self._litter = rng.uniform(1.8, 3.2) if rng.random() < 0.2 else NONE
        ends = [(s, half, side) for s, half in layout.crossings for side in (-1, 1)]
        self._zebras = [(s + side * (half + rng.uniform(1, 4)), rng.uniform(1.2, 2.2)) for s, half, side in ends]
        if rng.random() < 0.3:
            self._zebras.append((float(rng.uniform(4, 40)), float(rng.uniform(1.2, 2.2))))
        self._zebra = rng.random() < 0.6

    def paint(self, x: Float32, y: Float32, kerb: NDArray[np.bool_]) -> tuple[NDArray[np.int32], NDArray[np.uint8], Float32]:
        """Finishes and labels (n,) of points (n,) m, kerb where they are on a kerb's side, and their offsets (n,)."""
        a = self._layout
        d, n = a.offset(x, y), len(x)
        far, road = np.abs(d), a.is_road(x, y)
        finish, label = np.full(n, self._beyond, np.int32), np.full(n, PAVEMENT, np.uint8)
        edge = a.road + a.verge
        finish[far < edge + a.walk] = self._walk
        finish[far < edge] = self._verge if a.verge else self._walk
        beside = np.zeros(n, bool)
        for dx, dy in ((0.14, 0), (-0.14, 0), (0, 0.14), (0, -0.14)):
            beside |= a.is_road(x + np.float32(dx), y + np.float32(dy))
        finish[(~road & beside & (a.kerb > 0)) | kerb] = self._kerb
        own = far < a.road
        finish[road] = self._side
        for s0, s1, d0, d1 in a.lots:
            inside = road & ~own & (x > s0) & (x < s1) & (d > d0) & (d < d1)
            finish[inside] = self._lot
            lines = ((x - s0) % 2.5 < self._width) & ((d - d0) % 11.0 < 5.0)
            finish[inside & lines & (self._marks[5] < 0.8)] = self._mark
        finish[own] = self._road
        if a.bay:
            finish[own & (far > a.road - a.bay)] = self._bay
        self._spoil(finish, road, x, y, d)
        self._lines(finish, own, x, d)
        label[road & ~kerb] = ROAD
        return finish, label, d

    def _spoil(self, finish: NDArray[np.int32], road: NDArray[np.bool_], x: Float32, y: Float32, d: Float32) -> None:
        """Patches, cracks, manholes, wet places, fallen leaves."""
        k = np.float32(self._rng_key)
        if self._patches < NONE:
            patch = cell(x / 4 + k, d / 1.6 + k, 5) < 0.04 * self._patches
            finish[road & patch] = self._patch
            crack = np.abs(noise2(x + k, y, 6)) < 0.012 * self._cracks
            finish[road & crack & (noise2(x, y + k, 0.7) > 0.4)] = self._crack
        hole = (np.hypot((x + k) % 9.0 - 4, d % 4.0 - 2) < 0.33) & (cell((x + k) / 9, d / 4, 3) < 0.12)
        finish[hole] = self._cover
        if self._puddles < NONE:
            finish[road & (noise2(x + 2 * k, y, 1.2) > self._puddles)] = self._wet
        if self._litter < NONE:
            finish[noise2(x - k, y, 9) + noise2(x, y - k, 1.0) > self._litter] = self._leaves

    def _lines(self, finish: NDArray[np.int32], own: NDArray[np.bool_], x: Float32, d: Float32) -> None:
        """Centre line, edge lines, zebras, stop lines, arrows."""
        a, m, w = self._layout, self._marks, self._width
        clear = own.copy()
        for s, half in a.crossings:
            clear &= np.abs(x - s) > half + 0.5
        dash = (x % (self._dash + self._gap)) < self._dash
        mark = np.zeros(len(x), bool)
        if m[0] < 0.75:
            solid = m[0] < 0.2
            mark |= (np.abs(d) < w / 2) & (dash | solid)
            if m[0] < 0.1:
                mark |= np.abs(np.abs(d) - w) < w / 3
        if m[1] < 0.4:
            mark |= np.abs(np.abs(d) - (a.road - a.bay - 0.3)) < w / 2
        if m[1] > 0.8:
            mark |= (np.abs(np.abs(d) - a.road / 2) < w / 2) & dash
        if a.bay and m[2] < 0.5:
            mark |= (np.abs(d) > a.road - a.bay) & (x % 5.5 < w)
        if m[3] < 0.35:  # arrows, letters, hatching: blots of paint
            at = (np.abs(np.abs(d) - a.road / 2) < 0.5) & (cell(x / 6 + self._rng_key, 9) < 0.25)
            mark |= at & (cell(x * 1.5, np.abs(d) * 5 + self._rng_key, 7) < 0.5)
        mark &= clear
        for s, half in self._zebras:
            if self._zebra:
                mark |= own & (np.abs(x - s) < half) & (d % 1.0 < 0.5)
            else:
                mark |= own & (np.abs(x - s) < 0.2)
        finish[mark] = self._mark


def layout_of(rng: Rng, kind: str) -> Layout:
    """A random layout for a kind of place, with the camera on the road's centre line."""
    wide = {"highway": (5.5, 9.0), "lot": (2.6, 4.0), "park": (1.5, 3.5)}.get(kind, (2.8, 7.0))
    road = float(rng.uniform(*wide))
    bay = 2.1 if kind in ("town", "suburb", "blocks") and road > 4.5 and rng.random() < 0.7 else 0.0
    crossings: list[tuple[float, float]] = []
    if kind != "highway":
        s = float(rng.uniform(-20, 60))
        while s < 110 and len(crossings) < 3:
            if rng.random() < 0.7:
                crossings.append((s, float(rng.uniform(2.2, 6.0))))
            s += float(rng.uniform(25, 90))
    walk = float(rng.uniform(1.2, 4.5)) if kind != "highway" else 0.0
    verge = float(rng.uniform(0.6, 3.0)) if rng.random() < (0.3 if kind != "highway" else 1.0) else 0.0
    lots: list[tuple[float, float, float, float]] = []
    for side in (-1, 1):
        if rng.random() < {"lot": 0.9, "works": 0.5, "town": 0.08}.get(kind, 0.05):
            first, near, deep = float(rng.uniform(-25, 12)), road - 0.3, float(rng.uniform(12, 40))
            span = (near, near + deep) if side > 0 else (-near - deep, -near)
            lots.append((first, first + float(rng.uniform(20, 70)), *span))
    kerb = 0.0 if rng.random() < 0.2 or kind in ("highway", "park") else float(rng.uniform(0.04, 0.17))
    bend = float(rng.normal(0, 0.0025))
    return Layout(0.0, float(rng.normal(0, 0.03)), bend, road, walk, verge, bay, kerb, tuple(crossings), tuple(lots))
