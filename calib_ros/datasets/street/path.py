"""The winding centre line of the synthetic street and the vehicle's way along it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from calib_ros import se3

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
