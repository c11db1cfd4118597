"""The furnished street of a seed, made block by block, so that it has no end and no block depends on another."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from calib_ros import se3
from calib_ros.datasets.synthetic.solids import Builder, Kind, Numbers, Solids, Surface, concatenate, pick_colour
from calib_ros.frame import SemanticClass as Label

# The things that stand along the synthetic street. Each function adds one to a Builder whose frame is already set.
Rng = np.random.Generator

WALL_PAINTS = [
    (0.62, 0.70, 0.72), (0.45, 0.60, 0.70), (0.30, 0.42, 0.60), (0.18, 0.22, 0.42), (0.55, 0.55, 0.55),
    (0.72, 0.75, 0.76), (0.38, 0.55, 0.50), (0.22, 0.30, 0.36), (0.50, 0.66, 0.74),
]  # fmt: skip


def pole(b: Builder, rng: Rng) -> None:
    """A street lamp with an arm over the road (to the left: y > 0) or a plain post."""
    r, height = rng.uniform(0.06, 0.11), rng.uniform(5.0, 8.0)
    grey = np.full(3, rng.uniform(0.12, 0.4))
    b.add(Kind.CYLINDER, Surface.METAL, Label.POLE, (0, 0, height / 2), (r, r, height / 2), grey)
    b.add(Kind.CYLINDER, Surface.METAL, Label.POLE, (0, 0, 0.5), (1.5 * r, 1.5 * r, 0.5), grey)
    if rng.random() < 0.75:
        b.add(Kind.BOX, Surface.METAL, Label.POLE, (0, 0.8, height - 0.1), (0.04, 0.8, 0.04), grey)
        b.add(Kind.BOX, Surface.METAL, Label.POLE, (0, 1.5, height - 0.17), (0.14, 0.35, 0.06), grey)


def sign(b: Builder, rng: Rng) -> None:
    """A traffic sign that faces the traffic, retro-reflective as real ones."""
    height, size = rng.uniform(2.0, 2.6), rng.uniform(0.3, 0.42)
    b.add(Kind.CYLINDER, Surface.METAL, Label.POLE, (0, 0, height / 2 + 0.2), (0.035, 0.035, height / 2 + 0.2), (0.4, 0.4, 0.4))
    colour = [(0.08, 0.05, 0.7), (0.6, 0.25, 0.05), (0.1, 0.6, 0.8), (0.8, 0.8, 0.8)][rng.integers(4)]
    wide = size * (1.0 if rng.random() < 0.7 else 1.7)
    b.add(Kind.BOX, Surface.SIGN, Label.SIGN, (-0.06, 0, height), (0.015, wide, size), colour, style=rng.random(4))


def tree(b: Builder, rng: Rng) -> None:
    """A trunk and a crown of several clumps of leaves with gaps."""
    r, trunk, spread = rng.uniform(0.10, 0.26), rng.uniform(2.0, 3.2), rng.uniform(1.3, 2.4)
    green = np.array([0.07, 0.22, 0.13]) * rng.uniform(0.7, 1.5) + [0, 0, rng.uniform(0, 0.10)]
    bark = np.array([0.12, 0.16, 0.20]) * rng.uniform(0.7, 1.3)
    b.add(Kind.CYLINDER, Surface.BARK, Label.VEGETATION, (0, 0, trunk / 2 + 0.4), (r, r, trunk / 2 + 0.4), bark)
    b.add(Kind.ELLIPSOID, Surface.LEAF, Label.VEGETATION, (0, 0, trunk + spread), (0.8 * spread, 0.8 * spread, spread),
          green, style=rng.random(4))  # fmt: skip
    for k in range(5):
        a, size = k * 2 * np.pi / 5 + rng.uniform(-0.4, 0.4), spread * rng.uniform(0.5, 0.75)
        centre = (0.6 * spread * np.cos(a), 0.6 * spread * np.sin(a), trunk + spread * rng.uniform(0.45, 1.3))
        b.add(Kind.ELLIPSOID, Surface.LEAF, Label.VEGETATION, centre, (size, size, 0.8 * size),
              green * rng.uniform(0.8, 1.2), style=rng.random(4))  # fmt: skip


def bush(b: Builder, rng: Rng) -> None:
    """A low clump of leaves."""
    green = np.array([0.08, 0.24, 0.14]) * rng.uniform(0.6, 1.3)
    for _ in range(2):
        size = rng.uniform(0.4, 0.9)
        b.add(Kind.ELLIPSOID, Surface.LEAF, Label.VEGETATION, (rng.uniform(-0.6, 0.6), rng.uniform(-0.3, 0.3), 0.6 * size),
              (size, size, 0.9 * size), green, style=rng.random(4))  # fmt: skip


def border(b: Builder, rng: Rng, length: float) -> None:
    """Hedge, wall or fence along the pavement, centred on the frame's origin."""
    kind = rng.integers(3)
    if kind == 0:
        b.add(Kind.BOX, Surface.LEAF, Label.VEGETATION, (0, 0, 0.6), (length / 2, 0.35, rng.uniform(0.5, 0.9)),
              (0.06, 0.2, 0.1), style=rng.random(4))  # fmt: skip
    elif kind == 1:
        b.add(Kind.BOX, Surface.PLAIN, Label.BUILDING, (0, 0, 0.45), (length / 2, 0.12, rng.uniform(0.35, 0.6)),
              pick_colour(rng, WALL_PAINTS))  # fmt: skip
    else:
        b.add(Kind.BOX, Surface.FENCE, Label.OTHER, (0, 0, 0.7), (length / 2, 0.03, rng.uniform(0.5, 0.8)),
              (0.2, 0.3, 0.4), style=rng.random(4))  # fmt: skip


def bin_or_box(b: Builder, rng: Rng) -> None:
    """A waste bin or a cabinet of the telephone company."""
    half = (rng.uniform(0.2, 0.5), rng.uniform(0.18, 0.3), rng.uniform(0.45, 0.7))
    b.add(Kind.FRUSTUM, Surface.PLAIN, Label.OTHER, (0, 0, half[2]), half, rng.uniform(0.05, 0.45, 3), taper=(0.06, 0.06))


def billboard(b: Builder, rng: Rng) -> None:
    """A poster on two legs: the print has edges that no LiDAR sees."""
    for x in (-0.7, 0.7):
        b.add(Kind.CYLINDER, Surface.METAL, Label.POLE, (x, 0, 0.5), (0.05, 0.05, 0.5), (0.2, 0.2, 0.2))
    b.add(Kind.BOX, Surface.POSTER, Label.OTHER, (0, 0, 1.7), (1.1, 0.08, 0.9), rng.uniform(0.05, 0.5, 3), style=rng.random(4))


def house(b: Builder, rng: Rng, length: float, depth: float, height: float) -> None:
    """A building whose front faces -y, centred on the frame's origin: walls, roof, steps, pipes and sometimes a bay."""
    B, wall, style = Label.BUILDING, pick_colour(rng, WALL_PAINTS), rng.random(4)
    b.add(Kind.BOX, Surface.FACADE, B, (0, 0, height / 2), (length / 2, depth / 2, height / 2), wall, style=style)
    if rng.random() < 0.75:
        tiles = np.array([0.12, 0.16, 0.34]) * rng.uniform(0.5, 1.3)
        rise = rng.uniform(1.2, 2.4)
        b.add(Kind.FRUSTUM, Surface.ROOF, B, (0, 0, height + rise), (length / 2 + 0.2, depth / 2 + 0.4, rise), tiles,
              taper=(0.05, 0.96), style=style)  # fmt: skip
        b.add(Kind.BOX, Surface.PLAIN, B, (rng.uniform(-0.3, 0.3) * length, 0, height + 2 * rise), (0.35, 0.35, 0.8), tiles)
    else:
        b.add(Kind.BOX, Surface.PLAIN, B, (0, 0, height + 0.15), (length / 2 + 0.15, depth / 2 + 0.15, 0.15), wall * 0.7)
    x = rng.choice([-1, 1]) * (length / 2 - 0.25)
    b.add(Kind.CYLINDER, Surface.METAL, B, (x, -depth / 2 - 0.08, height / 2), (0.06, 0.06, height / 2), (0.3, 0.3, 0.3))
    if rng.random() < 0.45:
        size, x = rng.uniform(0.8, 1.4), rng.uniform(-0.25, 0.25) * length
        top = min(height, rng.uniform(3.0, 6.0))
        b.add(Kind.BOX, Surface.FACADE, B, (x, -depth / 2, top / 2), (size, rng.uniform(0.4, 0.9), top / 2), wall * 0.95,
              style=rng.random(4))  # fmt: skip
    if rng.random() < 0.6:
        x = rng.uniform(-0.35, 0.35) * length
        b.add(Kind.BOX, Surface.PLAIN, B, (x, -depth / 2 - 0.4, 0.17), (0.7, 0.4, 0.17), (0.4, 0.42, 0.44))


# Vehicles and people of the synthetic street. Each function adds one to a Builder whose frame is already set.
CAR_PAINTS = [
    (0.60, 0.60, 0.60), (0.75, 0.75, 0.75), (0.06, 0.06, 0.06), (0.25, 0.25, 0.26), (0.10, 0.09, 0.45),
    (0.40, 0.18, 0.08), (0.30, 0.22, 0.16), (0.12, 0.30, 0.14), (0.35, 0.45, 0.50), (0.05, 0.35, 0.62),
]  # fmt: skip


def car(b: Builder, rng: Rng) -> None:
    """A hatchback, saloon, estate or van: body, cabin, wheels, mirrors."""
    paint, style = pick_colour(rng, CAR_PAINTS), rng.random(4)
    van = rng.random() < 0.15
    length, width = (rng.uniform(4.7, 5.6), 2.0) if van else (rng.uniform(3.6, 4.8), rng.uniform(1.66, 1.86))
    height = rng.uniform(1.95, 2.5) if van else rng.uniform(1.4, 1.62)
    waist = 0.55 * height if van else rng.uniform(0.80, 0.92)  # height of the bonnet
    V = Label.VEHICLE
    b.add(Kind.FRUSTUM, Surface.BODY, V, (0, 0, (waist + 0.2) / 2), (length / 2, width / 2, (waist - 0.2) / 2),
          paint, taper=(0.04, 0.05), style=style)  # fmt: skip
    back, front = (0.02, 0.24) if van else (rng.uniform(0.02, 0.16), rng.uniform(0.24, 0.30))
    cabin = length * (1 - back - front)
    b.add(Kind.FRUSTUM, Surface.CABIN, V, (length * (back - front) / 2, 0, (waist + height) / 2 - 0.01),
          (cabin / 2, width / 2 * 0.96, (height - waist) / 2 + 0.01), paint,
          taper=(0.10 if van else rng.uniform(0.24, 0.40), 0.10 if van else 0.22), style=style)  # fmt: skip
    r = rng.uniform(0.29, 0.35)
    for x in (-0.5 * length + 0.17 * length, 0.5 * length - 0.18 * length):
        for y in (-1, 1):
            b.add(Kind.WHEEL, Surface.TYRE, V, (x, y * (width / 2 - 0.09), r), (r, 0.11, r), (0.03, 0.03, 0.03))
    for y in (-1, 1):
        x = length * (0.5 - front) - 0.25
        b.add(Kind.ELLIPSOID, Surface.PLAIN, V, (x, y * (width / 2 + 0.07), waist + 0.07), (0.07, 0.10, 0.07), paint)


def truck(b: Builder, rng: Rng) -> None:
    """A delivery truck with a box body."""
    V, length, style = Label.VEHICLE, rng.uniform(4.2, 5.8), rng.random(4)
    paint = pick_colour(rng, CAR_PAINTS)
    b.add(Kind.BOX, Surface.POSTER, V, (-1.0, 0, 1.95), (length / 2, 1.15, 1.15), rng.uniform(0.05, 0.6, 3), style=style)
    b.add(Kind.BOX, Surface.PLAIN, V, (-0.2, 0, 0.62), (length / 2 + 0.6, 0.9, 0.17), (0.08, 0.08, 0.08))
    b.add(Kind.FRUSTUM, Surface.CABIN, V, (length / 2, 0, 1.9), (0.9, 1.03, 0.6), paint, taper=(0.2, 0.1), style=style)
    b.add(Kind.BOX, Surface.BODY, V, (length / 2, 0, 0.85), (0.95, 1.05, 0.5), paint, style=style)
    for x in (-1.0 - length / 4, length / 2):
        for y in (-1, 1):
            b.add(Kind.WHEEL, Surface.TYRE, V, (x, 0.95 * y, 0.45), (0.45, 0.14, 0.45), (0.03, 0.03, 0.03))


def person(b: Builder, rng: Rng, label: Label = Label.PERSON, lean: float = 0.0, seat: float = 0.0) -> None:
    """Someone who stands or walks; `lean` moves the upper body forward and `seat` all of it up, as a rider's (m)."""
    trousers, coat = rng.uniform(0.03, 0.3, 3), rng.uniform(0.03, 0.6, 3)
    k, stride, style = rng.uniform(0.9, 1.08), rng.uniform(0.05, 0.22), rng.random(4)

    def limb(surface: Surface, x: float, y: float, z: float, half: tuple[float, float, float], colour: Numbers) -> None:
        b.add(Kind.ELLIPSOID, surface, label, (x, y, seat + z * k), half, colour, style=style)

    for side in (-1, 1):
        limb(Surface.CLOTH, side * stride, side * 0.09, 0.42, (0.11, 0.09, 0.47 * k), trousers)
        limb(Surface.CLOTH, lean - side * 0.08, side * 0.25, 1.10, (0.08, 0.06, 0.34 * k), coat)
    limb(Surface.CLOTH, 0.7 * lean, 0, 1.14, (0.15, 0.23, 0.38 * k), coat)
    limb(Surface.SKIN, 1.3 * lean, 0, 1.60, (0.11, 0.09, 0.14), (0.35, 0.45, 0.62))


def cyclist(b: Builder, rng: Rng) -> None:
    """A rider on a bicycle."""
    C, paint = Label.CYCLIST, rng.uniform(0.05, 0.6, 3)
    for x in (-0.52, 0.52):
        b.add(Kind.WHEEL, Surface.TYRE, C, (x, 0, 0.34), (0.34, 0.02, 0.34), (0.04, 0.04, 0.04))
    b.add(Kind.BOX, Surface.PLAIN, C, (0, 0, 0.62), (0.42, 0.025, 0.04), paint)
    b.add(Kind.BOX, Surface.PLAIN, C, (0.46, 0, 0.98), (0.03, 0.27, 0.02), (0.05, 0.05, 0.05))
    person(b, rng, C, lean=0.22, seat=0.32)


# The winding centre line of the synthetic street and the vehicle's way along it.
Floats = NDArray[np.float64]
Float32 = NDArray[np.float32]

STEP = 0.25  # m between the samples of the centre line
BEHIND, AHEAD = 260.0, 260.0  # m of centre line known before the first and after the last frame
REACH = 240.0  # m of it that a sensor may ask for at either side
LIDAR_HEIGHT = 1.73  # m above the ground


class Path:
    """Centre line y = f(x), a sum of two sine waves, so that a street can be extended without end.

    A station s is the length along the line from x = 0; the offset d is positive to the left. Offsets are measured
    across the heading at the same x: exact on straight parts, centimetres off in bends, and the same for every sensor.
    """

    def __init__(self, seed: int, length: float) -> None:
        rng = np.random.default_rng([seed, 1])
        self._k = 2 * np.pi / rng.uniform([140.0, 65.0], [230.0, 100.0])
        self._amplitude = rng.uniform([0.22, 0.04], [0.42, 0.12]) / self._k * rng.choice([-1, 1], 2)
        self._phase = rng.uniform(0, 2 * np.pi, 2)
        zero = round(BEHIND / STEP)
        x = np.arange(-zero, round((length + AHEAD) / STEP), dtype=float) * STEP
        y, slope = self._line(x)
        ds = np.sqrt(1 + slope**2) * STEP
        # Sums start at x = 0 in both directions, so that the stations do not depend on the length asked for.
        s = np.concatenate([-np.cumsum(ds[:zero][::-1])[::-1], [0.0], np.cumsum(ds[zero:-1])])
        self._x, self._s = x, s
        self._table = np.stack([y, np.cos(np.arctan(slope)), s]).astype(np.float32)
        self._rise = np.diff(self._table, append=0)

    def _line(self, x: Floats) -> tuple[Floats, Floats]:
        angle = np.multiply.outer(x, self._k) + self._phase
        return np.sin(angle) @ self._amplitude, np.cos(angle) @ (self._amplitude * self._k)

    def station(self, s: ArrayLike) -> tuple[Floats, Floats, Floats]:
        """Stations in metres -> x, y of the centre line and its heading in rad."""
        x = np.interp(np.asarray(s, float), self._s, self._x)
        y, slope = self._line(x)
        return x, y, np.arctan(slope)

    def place(self, s: float, d: float) -> tuple[float, float, float]:
        """The point at station s and offset d: x, y, heading."""
        x, y, heading = (float(v) for v in self.station(s))
        return x - d * np.sin(heading), y + d * np.cos(heading), heading

    def offset(self, x: Float32, y: Float32, origin: Floats) -> Float32:
        """Offset (n,) in metres of points x, y (n,) relative to `origin` (3,), from a table, thus quick."""
        return self._across(*self._cell(x, origin), y, origin)

    def frenet(self, x: Float32, y: Float32, origin: Floats) -> tuple[Float32, Float32]:
        """Station and offset, each (n,) in metres, of points as for `offset`."""
        index, part = self._cell(x, origin)
        return self._at(2, index, part), self._across(index, part, y, origin)

    def _cell(self, x: Float32, origin: Floats) -> tuple[NDArray[np.int32], Float32]:
        # The street goes straight on where it is too far away to be seen, so that the length of the table shows nowhere.
        where = (np.clip(x, -REACH, REACH) + np.float32(origin[0] - self._x[0])) * np.float32(1 / STEP)
        index = where.astype(np.int32)
        return index, np.asarray(where - index, np.float32)

    def _across(self, index: NDArray[np.int32], part: Float32, y: Float32, origin: Floats) -> Float32:
        line = self._at(0, index, part) - np.float32(origin[1])
        return np.asarray((y - line) * self._at(1, index, part))

    def _at(self, row: int, index: NDArray[np.int32], part: Float32) -> Float32:
        return np.asarray(self._table[row].take(index) + part * self._rise[row].take(index))


@dataclass(frozen=True)
class Ride:
    """How the vehicle moves along a path: a lane offset in metres, and slow swaying in yaw, pitch, roll and height."""

    path: Path
    seed: int
    lane: float

    def pose(self, s: float) -> Floats:
        """T_world_lidar (4, 4) at station s."""
        rng = np.random.default_rng([self.seed, 2])
        phase = rng.uniform(0, 2 * np.pi, (5, 2))
        wave = 2 * np.pi / rng.uniform([[40, 17]] * 2 + [[13, 7]] * 3, [[70, 29]] * 2 + [[29, 11]] * 3)
        size = np.array([[0.25, 0.1], [1.5, 0.4], [0.5, 0.25], [0.7, 0.3], [0.012, 0.006]])  # m, deg, deg, deg, m
        lane, yaw, pitch, roll, bump = (np.sin(wave * s + phase) * size).sum(axis=1)
        x, y, heading = self.path.place(s, self.lane + lane)
        angles = [np.rad2deg(heading) + yaw, pitch, roll]
        R = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
        return se3.from_parts(R, [x, y, LIDAR_HEIGHT + bump])

    def twist(self, s: float, speed: float) -> Floats:
        """(rx, ry, rz, tx, ty, tz) in rad/s and m/s in the LiDAR's own frame: T(t) = T(0) exp(twist t)."""
        h = 0.05  # m; short against the waves, long against rounding
        step = se3.log(se3.inverse(self.pose(s - h)) @ self.pose(s + h))
        return np.asarray(step * (speed / (2 * h)))


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
                house(b, rng, length - rng.choice([0.0, 0.4, 2.5]), depth, height)
            else:  # a garden; a row of houses behind closes the view
                self._at(b, middle, side * (front + rng.uniform(22, 40)), turn)
                house(b, rng, length + 6, depth, height + 1)
                for _ in range(rng.integers(1, 4)):
                    self._at(b, s + rng.uniform(0, length), side * (front + rng.uniform(2.5, 14)))
                    (tree if rng.random() < 0.5 else bush)(b, rng)
            if setback > 1.2 and rng.random() < 0.7:
                self._at(b, middle, side * (front + 0.3))
                border(b, rng, length - rng.uniform(1, 4))
            s += length + rng.choice([0.0, 0.0, 1.2, 3.5])

    def _parked(self, b: Builder, rng: np.random.Generator, start: float, side: int) -> None:
        s = start + rng.uniform(2.5, 4)
        while s < start + BLOCK - 3:
            if rng.random() < self._parking:
                turn = (0.0 if rng.random() < 0.8 else np.pi) + (0 if side < 0 else np.pi) + np.deg2rad(rng.normal(0, 1.5))
                self._at(b, s, side * (self.road - 1.05 + rng.normal(0, 0.06)), turn, z=0.0)
                (truck if rng.random() < 0.06 else car)(b, rng)
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
                tree(b, rng)
            elif choice < self._trees * 0.6 + 0.25:
                pole(b, rng)
            elif choice < self._trees * 0.6 + 0.40:
                sign(b, rng)
            elif choice < self._trees * 0.6 + 0.55:
                self._at(b, s, side * (self.road + self.pavement - 0.3), rng.uniform(-0.1, 0.1))
                bin_or_box(b, rng)
            elif choice < self._trees * 0.6 + 0.62:
                self._at(b, s, side * (self.road + self.pavement - 0.1), rng.uniform(-0.4, 0.4) + np.pi / 2)
                billboard(b, rng)
            s += rng.uniform(3.5, 8)

    def _crowd(self, b: Builder, rng: np.random.Generator, start: float) -> None:
        """People on the pavements, now and then one in the opposite lane, and cyclists."""
        for _ in range(rng.poisson(2.5 * self._walkers)):
            side = rng.choice([-1, 1])
            self._at(b, start + rng.uniform(0, BLOCK), side * (self.road + rng.uniform(1.2, self.pavement - 0.4)),
                     rng.uniform(0, 2 * np.pi))  # fmt: skip
            person(b, rng)
        if rng.random() < 0.3:
            self._at(b, start + rng.uniform(0, BLOCK), rng.uniform(1.0, self.road - 2.6), rng.uniform(0, 2 * np.pi), z=0.0)
            person(b, rng)
        if rng.random() < 0.5:
            self._at(b, start + rng.uniform(0, BLOCK), self.road - 2.5, np.pi, z=0.0)
            cyclist(b, rng)
