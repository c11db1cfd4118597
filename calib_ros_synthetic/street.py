"""The street of a seed: its winding centre line, its objects, generated block by block, and how a vehicle drives along it.

Blocks do not depend on each other, so that the street has no end.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import partial
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from calib_ros import se3
from calib_ros.datasets.recent import Recent
from calib_ros_synthetic import objects
from calib_ros_synthetic.solids import Builder, Solids

Rng = np.random.Generator
Floats = NDArray[np.float64]
Float32 = NDArray[np.float32]
STEP = 0.25  # m between the samples of the centre line
BEHIND, AHEAD = 260.0, 260.0  # m of centre line known before the first and after the last frame
REACH = 240.0  # m of it that a sensor may ask for at either side
LIDAR_HEIGHT = 1.73  # m above the ground
BLOCK = 40.0  # m of street per block
KERB = 0.12  # m that the pavement lies above the road
VIEW_BEHIND, VIEW_AHEAD = 110.0, 150.0  # m of street that the sensors may see
CACHED_BLOCKS = 32
STEADY, WEAVING = RIDES = ("steady", "weaving")
SPINS = ("clockwise", "counterclockwise")
SWERVE, SWERVE_LENGTH = 0.8, 35.0  # m; at 5 m/s the vehicle turns at up to 7 deg/s
SPEED_CHANGE, SPEED_PERIOD_S = 0.5, 12.0  # of the mean speed, up and down
STAMP_AT = {"start": -0.5, "middle": 0.0, "end": 0.5}  # share of a revolution after the scanner has faced ahead


class Street:
    """What stands where. `road`: half width of the road; `pavement`: width of each pavement; metres.

    Other scenes are streets with other furniture. ground: a name in materials.GROUNDS. kerb: m that all beyond the road lies
    above it. bend: factor on the bends of the centre line. view: m of it behind and ahead that sensors may see. cruise: usual
    speed, m/s. indoors: lamps at the ceiling instead of sun and sky.
    """

    ground: ClassVar[str] = "street"
    kerb: ClassVar[float] = KERB
    bend: ClassVar[float] = 1.0
    view: ClassVar[tuple[float, float]] = (VIEW_BEHIND, VIEW_AHEAD)
    cruise: ClassVar[float] = 5.0
    indoors: ClassVar[bool] = False

    def __init__(self, seed: int, length: float) -> None:
        self.seed = seed
        self.path = Path(seed, length, self.bend)
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
        self._blocks = Recent(CACHED_BLOCKS)
        self._lay_out(np.random.default_rng([seed, 8]))

    def _lay_out(self, rng: Rng) -> None:
        """What other scenes make otherwise."""

    def around(self, s: float) -> Solids:
        """All solids in `view` of station s, by whole blocks."""
        first, last = int((s - self.view[0]) // BLOCK), int((s + self.view[1]) // BLOCK)
        blocks = [self._blocks(k, partial(self._furnish, k)) for k in range(first, last + 1)]
        return Solids(*(np.concatenate([getattr(block, f.name) for block in blocks]) for f in fields(Solids)))

    def _furnish(self, k: int) -> Solids:
        # Block numbers before the start are negative, seeds must not be.
        rng = np.random.default_rng([self.seed, 4, k + 1_000_000])
        b, start = Builder(), k * BLOCK
        self._fill(b, rng, start)
        return b.solids()

    def _fill(self, b: Builder, rng: Rng, start: float) -> None:
        """Adds what stands between the stations start and start + BLOCK."""
        for side in (-1, 1):
            self._houses(b, rng, start, side)
            s = start + rng.uniform(2.5, 4)
            while s < start + BLOCK - 3:  # what is parked
                if rng.random() < self._parking:
                    turn = (0.0 if rng.random() < 0.8 else np.pi) + (0 if side < 0 else np.pi) + np.deg2rad(rng.normal(0, 1.5))
                    self._at(b, s, side * (self.road - 1.05 + rng.normal(0, 0.06)), turn, z=0.0)
                    (objects.truck if rng.random() < 0.06 else objects.car)(b, rng)
                    s += 1.2
                s += rng.uniform(4.8, 6.5)
            self._furniture(b, rng, start, side)
        # People on the pavements, now and then one in the opposite lane, and cyclists.
        for _ in range(rng.poisson(2.5 * self._walkers)):
            side = rng.choice([-1, 1])
            self._at(b, start + rng.uniform(0, BLOCK), side * (self.road + rng.uniform(1.2, self.pavement - 0.4)),
                     rng.uniform(0, 2 * np.pi))  # fmt: skip
            objects.person(b, rng)
        if rng.random() < 0.3:
            self._at(b, start + rng.uniform(0, BLOCK), rng.uniform(1.0, self.road - 2.6), rng.uniform(0, 2 * np.pi), z=0.0)
            objects.person(b, rng)
        if rng.random() < 0.5:
            objects.cyclist(self._at(b, start + rng.uniform(0, BLOCK), self.road - 2.5, np.pi, z=0.0), rng)

    def _at(self, b: Builder, s: float, d: float, turn: float = 0.0, z: float | None = None) -> Builder:
        """The Builder, with its frame at a station and an offset; z: m, beside the road's level the kerb's."""
        x, y, heading = self.path.place(s, d)
        b.at(x, y, heading + turn, self.kerb if z is None else z)
        return b

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
                objects.house(b, rng, length - rng.choice([0.0, 0.4, 2.5]), depth, height)
            else:  # a garden; a row of houses behind closes the view
                objects.house(self._at(b, middle, side * (front + rng.uniform(22, 40)), turn), rng, length + 6, depth, height + 1)
                for _ in range(rng.integers(1, 4)):
                    self._at(b, s + rng.uniform(0, length), side * (front + rng.uniform(2.5, 14)))
                    (objects.tree if rng.random() < 0.5 else objects.bush)(b, rng)
            if setback > 1.2 and rng.random() < 0.7:
                objects.border(self._at(b, middle, side * (front + 0.3)), rng, length - rng.uniform(1, 4))
            s += length + rng.choice([0.0, 0.0, 1.2, 3.5])

    def _furniture(self, b: Builder, rng: np.random.Generator, start: float, side: int) -> None:
        """Everything upright near the kerb, and bins at the inner edge of the pavement."""
        inward = 0.0 if side < 0 else np.pi  # poles turn their arms over the road
        s = start + rng.uniform(0.5, 4)
        while s < start + BLOCK - 1:
            choice = rng.random()
            self._at(b, s, side * (self.road + rng.uniform(0.35, 0.6)), inward)
            if choice < self._trees * 0.6:
                objects.tree(self._at(b, s, side * (self.road + rng.uniform(0.7, 0.9))), rng)
            elif choice < self._trees * 0.6 + 0.25:
                objects.pole(b, rng)
            elif choice < self._trees * 0.6 + 0.40:
                objects.sign(b, rng)
            elif choice < self._trees * 0.6 + 0.55:
                objects.bin_or_box(self._at(b, s, side * (self.road + self.pavement - 0.3), rng.uniform(-0.1, 0.1)), rng)
            elif choice < self._trees * 0.6 + 0.62:
                self._at(b, s, side * (self.road + self.pavement - 0.1), rng.uniform(-0.4, 0.4) + np.pi / 2)
                objects.billboard(b, rng)
            s += rng.uniform(3.5, 8)


class Path:
    """Centre line y = f(x), a sum of two sine waves, so that a street can be extended without end.

    A station s is the length along the line from x = 0; the offset d is positive to the left. Offsets are measured
    across the heading at the same x: exact on straight parts, centimetres off in bends, and the same for every sensor.
    """

    def __init__(self, seed: int, length: float, bend: float = 1.0) -> None:
        rng = np.random.default_rng([seed, 1])
        self._k = 2 * np.pi / rng.uniform([140.0, 65.0], [230.0, 100.0])
        self._amplitude = rng.uniform([0.22, 0.04], [0.42, 0.12]) / self._k * rng.choice([-1, 1], 2) * bend
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
    """The vehicle's way along a street: a lane offset in metres, and slow swaying in yaw, pitch, roll and height.

    speed: m/s on average. weaving: it accelerates and brakes, and swerves to either side, by heading where it goes.
    """

    seed: int
    speed: float
    weaving: bool = False

    def station(self, seconds: float) -> float:
        """m from the start."""
        if not self.weaving:
            return self.speed * seconds
        wave, phase = 2 * np.pi / SPEED_PERIOD_S, self._phase
        return float(self.speed * (seconds + SPEED_CHANGE * (np.sin(wave * seconds + phase) - np.sin(phase)) / wave))

    def speed_at(self, seconds: float) -> float:
        """m/s."""
        if not self.weaving:
            return self.speed
        return float(self.speed * (1 + SPEED_CHANGE * np.cos(2 * np.pi * seconds / SPEED_PERIOD_S + self._phase)))

    @property
    def _phase(self) -> float:
        return float(np.random.default_rng([self.seed, 12]).uniform(0, 2 * np.pi))

    def pose(self, street: Street, s: float) -> Floats:
        """T_world_lidar (4, 4) at station s."""
        rng = np.random.default_rng([self.seed, 2])
        phase = rng.uniform(0, 2 * np.pi, (5, 2))
        wave = 2 * np.pi / rng.uniform([[40, 17]] * 2 + [[13, 7]] * 3, [[70, 29]] * 2 + [[29, 11]] * 3)
        size = np.array([[0.25, 0.1], [1.5, 0.4], [0.5, 0.25], [0.7, 0.3], [0.012, 0.006]])  # m, deg, deg, deg, m
        lane, yaw, pitch, roll, bump = (np.sin(wave * s + phase) * size).sum(axis=1)
        if self.weaving:
            angle = 2 * np.pi * s / SWERVE_LENGTH + phase[0, 0]
            lane += SWERVE * np.sin(angle)
            yaw += np.rad2deg(np.arctan(SWERVE * np.cos(angle) * 2 * np.pi / SWERVE_LENGTH))
        x, y, heading = street.path.place(s, street.lane + lane)
        angles = [np.rad2deg(heading) + yaw, pitch, roll]
        R = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
        return se3.from_parts(R, [x, y, LIDAR_HEIGHT + bump])

    def twist(self, street: Street, s: float, speed: float) -> Floats:
        """(rx, ry, rz, tx, ty, tz) in rad/s and m/s in the LiDAR's own frame: T(t) = T(0) exp(twist t)."""
        h = 0.05  # m; short against the waves, long against rounding
        step = se3.log(se3.inverse(self.pose(street, s - h)) @ self.pose(street, s + h))
        return np.asarray(step * (speed / (2 * h)))
