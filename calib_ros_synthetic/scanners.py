"""Real LiDARs for the synthetic rigs: ray tables, firing times, ring numbers, range noise and reach.

Windows say which rays can meet a solid, which is bounded by the corners of its box in the scanner's frame. They are never too
small; slack only costs time. A spinning scanner's lasers stand in columns beside each other (`azimuth`) and fire one after the
other (`delay`): the points of one firing lie on a zigzag, as in real clouds, not on a line.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros_synthetic import ray_tables as tables
from calib_ros_synthetic.rays import SMALLEST, Jobs, nearest_first
from calib_ros_synthetic.solids import Float32, Floats, Solids

RATE, PERIOD = 10.0, 0.1  # Hz and s of a turn; what the data sheets call usual
MICROSECOND = 1e-6
TEN_PERCENT = 0.1  # reflectivity that reach is stated for
CLOSE = 0.5  # m from the vertical axis; nearer solids are tried all around
_ANGLES = np.arange(32) * (2 * np.pi / 32)
SIDES = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)])  # directions in which the distance of a footprint is looked at


@dataclass(frozen=True)
class ScannerModel:
    """A scanner's data sheet.

    table: of its lasers, or of all rays of a scan if firings is 1. firings: per turn at RATE. noise: of the range, m (1 sigma).
    near, far: m. reach: m, at which a surface of 10 % reflectivity is just seen. from_top:
    the driver numbers the rings so, else from the bottom. by_rows: it stores a scan ring by ring, each in the order of time, else
    as it was measured.
    """

    name: str
    table: Callable[[], tables.Table] | None
    firings: int
    noise: float
    near: float
    far: float
    reach: float
    from_top: bool = False
    by_rows: bool = False

    @property
    def weakest(self) -> float:
        """Reflectivity / m^2 of the weakest return that is noticed."""
        return TEN_PERCENT / self.reach**2


MODELS = {
    "vlp16": ScannerModel("Velodyne VLP-16", tables.vlp16, 1808, 0.015, 0.5, 100.0, 60.0),
    "vlp32c": ScannerModel("Velodyne VLP-32C", tables.vlp32c, 1808, 0.015, 0.5, 200.0, 80.0),
    "hdl32e": ScannerModel("Velodyne HDL-32E", tables.hdl32e, 2170, 0.010, 0.9, 100.0, 70.0),
    "hdl64e": ScannerModel("Velodyne HDL-64E", tables.hdl64e, 2083, 0.015, 0.9, 120.0, 50.0),
    "vls128": ScannerModel("Velodyne VLS-128", tables.vls128, 1876, 0.015, 0.5, 245.0, 220.0),
    "pandar40p": ScannerModel("Hesai Pandar40P", tables.pandar40p, 1800, 0.010, 0.3, 200.0, 200.0, from_top=True),
    "pandar64": ScannerModel("Hesai Pandar64", tables.pandar64, 1800, 0.010, 0.3, 200.0, 200.0, from_top=True),
    "os1_64": ScannerModel("Ouster OS1-64", tables.os1_64, 1024, 0.015, 0.8, 120.0, 40.0, True, True),
    "os1_128": ScannerModel("Ouster OS1-128", tables.os1_128, 1024, 0.010, 0.3, 120.0, 45.0, True, True),
    "mid360": ScannerModel("Livox Mid-360", None, 20_000, 0.020, 0.1, 100.0, 40.0),
    "rs_m1": ScannerModel("RoboSense M1", tables.rs_m1, 1, 0.020, 0.5, 200.0, 150.0),
    "ft120": ScannerModel("Hesai FT120", tables.ft120, 1, 0.020, 0.1, 100.0, 22.0),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class SpinningScanner:
    """Firing directions of a spinning model that turns `rate` times a second, clockwise seen from above, facing +x at time 0.

    Rows are sorted by elevation, from the top; columns by the azimuth of the head, rising, thus against the time.
    """

    model: ScannerModel
    rate: float = RATE
    number: int = 0

    @property
    def firings(self) -> int:
        """Columns per turn: the firing rate is the laser's, so that a slower head fires more often in a turn."""
        return round(self.model.firings * RATE / self.rate)

    @cached_property
    def _table(self) -> tuple[Floats, Floats, Floats]:
        """Elevation (rad), azimuth (rad), delay (s, 0 in the mean) of each row (rings,)."""
        assert self.model.table is not None
        elevation, azimuth, delay = self.model.table()
        order = np.argsort(-elevation, kind="stable")
        delay = delay[order] * MICROSECOND
        return np.deg2rad(elevation[order]), np.deg2rad(azimuth[order]), delay - delay.mean()

    @property
    def _head(self) -> Floats:
        """Azimuth (firings,) of the head, rad."""
        return (np.arange(float(self.firings)) + 0.5) * (2 * np.pi / self.firings) - np.pi

    def beams(self) -> tuple[Float32, Floats]:
        """(3, rings, firings) unit vectors in the LiDAR frame and the time of each (rings, firings), s."""
        elevation, azimuth, delay = self._table
        speed = 2 * np.pi * self.rate  # rad/s
        a = self._head - (speed * delay - azimuth)[:, None]
        c = np.cos(elevation)[:, None]
        vectors = np.stack([c * np.cos(a), c * np.sin(a), np.broadcast_to(np.sin(elevation)[:, None], a.shape)])
        return vectors.astype(np.float32), delay[:, None] - self._head / speed

    def order(self, time: Floats) -> NDArray[np.intp]:
        """The columns in the order in which they were measured, the head turning clockwise."""
        return np.arange(time.shape[1])[::-1]

    def stored(self, row: NDArray[np.intp], time: Float32) -> NDArray[np.intp] | None:
        """The order (n,) of points that lie in the rows row (n,) and were measured at time (n,); None = as they are."""
        return None if self.model.by_rows else np.lexsort((row, time))

    def ring(self, row: NDArray[np.intp]) -> NDArray[np.int32] | None:
        """The driver's ring numbers of rows (n,)."""
        return (row if self.model.from_top else len(self._table[0]) - 1 - row).astype(np.int32)

    def jobs(self, solids: Solids, beams: Float32, pose: Floats, shift: float, turn: float) -> Jobs:
        """Windows for `cast` for a scanner at any attitude; shift (m) and turn (rad): how far it moves from time 0."""
        elevation, azimuth, delay = self._table
        stagger = float(np.abs(2 * np.pi * self.rate * delay - azimuth).max())
        corners = solids.corners() @ pose[:3, :3]
        return grid_windows(corners, elevation, self.firings, shift, turn, stagger)

    def describe(self) -> str:
        """For people."""
        name = f"{self.model.name}, " if self.model.name else ""
        return f"{name}{len(self._table[0])} rings, {self.firings} firings per turn of {1 / self.rate:g} s"


# Of the Mid-360's head about the vertical and of its mirror, per second; no common period within a drive. Livox does not publish
# the pattern: these give its density and its field, and a pattern of its kind.
HEAD, MIRROR = 17.317, 871.731
FIELD = np.deg2rad([-7.0, 52.0])
LASERS, STEP_AZIMUTH, STEP_ELEVATION = 4, np.deg2rad(0.9), np.deg2rad(0.5)  # fired in turns; between neighbours


@dataclass(frozen=True, eq=False)
class RosetteScanner(SpinningScanner):
    """A scanner without rings, all around, whose pattern never repeats. number: of the scan."""

    def pattern(self, times: Floats) -> tuple[Floats, Floats]:
        """Azimuth and elevation (n,) rad of the points at times (n,) s since the scanner was switched on."""
        laser = np.arange(self.firings) % LASERS - (LASERS - 1) / 2
        middle, reach = FIELD.mean(), np.ptp(FIELD) / 2 - STEP_ELEVATION * (LASERS - 1) / 2
        elevation = middle + laser * STEP_ELEVATION + reach * np.sin(2 * np.pi * MIRROR * times)
        return np.mod(2 * np.pi * HEAD * times + laser * STEP_AZIMUTH, 2 * np.pi) - np.pi, elevation

    def _points(self) -> tuple[Floats, Floats, Floats]:
        """Azimuth, elevation (n,) rad and time (n,) s of the points of the scan, in the order of time."""
        n, period = self.firings, 1 / self.rate
        time = ((np.arange(n) + 0.5) / n - 0.5) * period
        return *self.pattern(time + (self.number + 0.5) * period), time

    def beams(self) -> tuple[Float32, Floats]:
        """(3, 1, points) unit vectors in the LiDAR frame by azimuth, and the time of each (1, points), s."""
        azimuth, elevation, time = self._points()
        order = np.argsort(azimuth, kind="stable")
        a, e = azimuth[order], elevation[order]
        c = np.cos(e)
        return np.stack([c * np.cos(a), c * np.sin(a), np.sin(e)])[:, None].astype(np.float32), time[None, order]

    def order(self, time: Floats) -> NDArray[np.intp]:
        """The columns in the order in which they were measured."""
        return np.argsort(time[0], kind="stable")

    def ring(self, row: NDArray[np.intp]) -> NDArray[np.int32] | None:
        """None: it has no rings."""
        return None

    def jobs(self, solids: Solids, beams: Float32, pose: Floats, shift: float, turn: float) -> Jobs:
        """Windows for `cast` in one row of rays."""
        azimuth = np.arctan2(beams[1, 0], beams[0, 0]).astype(float)
        middle, left, right, *_, near = _bounds(solids.corners() @ pose[:3, :3], shift, turn)
        windows = []
        for around in (-2 * np.pi, 0.0, 2 * np.pi):
            first = np.searchsorted(azimuth, middle + left + around)
            past = np.searchsorted(azimuth, middle + right + around, side="right")
            keep = np.flatnonzero(past > first)
            zero = np.zeros(len(keep), np.int64)
            windows.append(np.stack([keep, zero, zero + 1, first[keep], past[keep]], axis=1))
        window = np.concatenate(windows).astype(np.int32)
        return nearest_first(window, near[window[:, 0]])

    def describe(self) -> str:
        """For people."""
        return f"{self.model.name}, no rings, {self.firings} points per scan of {1 / self.rate:g} s, all around"


@dataclass(frozen=True, eq=False)
class GridScanner(RosetteScanner):
    """A scanner that looks ahead along the same bent lines in every scan."""

    def _points(self) -> tuple[Floats, Floats, Floats]:
        """As of a rosette."""
        assert self.model.table is not None
        elevation, azimuth, delay = self.model.table()
        return np.deg2rad(azimuth), np.deg2rad(elevation), (delay - delay.mean()) * MICROSECOND

    def describe(self) -> str:
        """For people."""
        return f"{self.model.name}, no rings, a grid of {len(self._points()[0])} points"


# The plain drive's, by rings from the top, after the OS1-128, HDL-64E, HDL-32E and VLP-16; 0: without any, by two prisms.
PLAIN: dict[int, ScannerModel] = {
    rings: ScannerModel("", table, firings, 0.02, 0.9, 100.0, 91.28709291752769, True, True)
    for rings, table, firings in (
        (128, tables.above_each_other(np.linspace(22.5, -22.5, 128)), 1024),
        (64, tables.above_each_other(np.r_[np.linspace(2.0, -8.33, 32), np.linspace(-8.83, -24.8, 32)]), 2083),
        (32, tables.above_each_other(np.linspace(10.0, -30.0, 32)), 2170),
        (16, tables.above_each_other(np.linspace(15.0, -15.0, 16)), 1800),
        (0, None, 24_000),
    )
}
PRISMS = 121.567, -77.731  # turns per second; no common period within a drive
PRISM_FIELD = float(np.deg2rad(80.0))  # diameter of their field of view, rad


def _by_footprint(window: NDArray[np.int32], solids: Solids, shift: float) -> Jobs:
    """Of two surfaces at the same distance, that of the solid whose footprint is nearer is met first."""
    c, s, (x, y, _) = np.cos(solids.yaw), np.sin(solids.yaw), solids.centre.T
    beside = np.maximum(np.abs(np.stack([c * x + s * y, c * y - s * x])) - solids.half[:, :2].T, 0)
    near = np.maximum(np.hypot(*beside) - shift, 0.1)[window[:, 0]]
    order = np.lexsort((window[:, 0], near))
    return Jobs(window[order], near[order])


@dataclass(frozen=True, eq=False)
class PlainScanner(SpinningScanner):
    """Lasers above each other that fire together, in a head that is nearly upright; stored as in KITTI's files.

    A column's azimuth is -2 pi time / PERIOD.
    """

    def beams(self) -> tuple[Float32, Floats]:
        """(3, rings, firings) unit vectors in the LiDAR frame, columns by azimuth, and the time of each column (firings,) s."""
        e, a = self._table[0][:, None], self._head[None]
        vectors = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e) + 0 * a])
        return vectors.astype(np.float32), -self._head * (PERIOD / (2 * np.pi))

    def order(self, time: Floats) -> NDArray[np.intp]:
        """The columns with azimuth from 0 to 2 pi."""
        return np.roll(np.arange(len(time)), -int(np.searchsorted(self._head, 0.0)))

    def jobs(self, solids: Solids, beams: Float32, pose: Floats, shift: float, turn: float) -> Jobs:
        """Windows for `cast`, of solids that are not too thin."""
        level = se3.rotation_from_euler(float(np.arctan2(pose[1, 0], pose[0, 0])), 0.0, 0.0)
        tilt = float(np.arccos(np.clip(pose[2, 2], -1, 1)))
        # A tilt of the head also turns its azimuth a little where beams are steep.
        corners = solids.corners() @ level
        window = grid_windows(corners, self._table[0], self.firings, shift, turn + 1.5 * tilt, 0.0, no_thin=True).window
        return _by_footprint(window, solids, shift)


@dataclass(frozen=True, eq=False)
class PrismScanner(RosetteScanner):
    """The plain scanner without rings: two prisms draw a rosette ahead."""

    def pattern(self, times: Floats) -> tuple[Floats, Floats]:
        """As of any rosette."""
        first, second = (2 * np.pi * turns * times for turns in PRISMS)
        reach = PRISM_FIELD / 4  # each prism bends the beam by this angle
        return reach * (np.cos(first) + np.cos(second)), reach * (np.sin(first) + np.sin(second))

    def jobs(self, solids: Solids, beams: Float32, pose: Floats, shift: float, turn: float) -> Jobs:
        """As of any rosette, in the order of the plain scanners."""
        return _by_footprint(RosetteScanner.jobs(self, solids, beams, pose, shift, turn).window, solids, shift)

    def describe(self) -> str:
        """For people."""
        n, field = self.firings, np.rad2deg(PRISM_FIELD)
        return f"no rings, {n} points per scan of {PERIOD:g} s in a rosette {field:g} deg wide"


def scanner(name: str, rate: float = RATE) -> SpinningScanner:
    """The scanner of a name in MODELS, or of a plain drive with a number of rings in PLAIN, turning at `rate` Hz."""
    if name in MODELS:
        model = MODELS[name]
        kind = RosetteScanner if model.table is None else GridScanner if model.firings == 1 else SpinningScanner
        return kind(model, rate)
    return (PlainScanner if int(name) else PrismScanner)(PLAIN[int(name)], rate)


def _bounds(corners: Floats, shift: float, turn: float) -> tuple[Floats, ...]:
    """Bounds of boxes with corners (n, 8, 3) in the scanner's frame at time 0: azimuth of their middle, its lowest and highest
    value relative to that, lowest and highest elevation, the width in azimuth at time 0 (rad), and a lower bound of the distance.

    shift: m that the scanner moves during the scan, to either side. turn: rad that it rotates.
    """
    flat, z = corners[..., :2], corners[..., 2]
    far = np.linalg.norm(flat, axis=-1).max(axis=1) + shift
    # The footprint is convex: a line that separates it from the axis tells how far away it is at least.
    clear = (flat @ SIDES).min(axis=1).max(axis=1) - shift
    near = np.maximum(clear, 0.1)
    azimuth = np.arctan2(corners[..., 1], corners[..., 0])
    mean = flat.mean(axis=1)
    middle = np.arctan2(mean[:, 1], mean[:, 0])
    spread = np.mod(azimuth - middle[:, None] + np.pi, 2 * np.pi) - np.pi
    bottom, top = z.min(axis=1) - shift, z.max(axis=1) + shift
    high = np.arctan2(top, np.where(top > 0, near, far)) + turn
    low = np.arctan2(bottom, np.where(bottom < 0, near, far)) - turn
    # A turn about a level axis moves the azimuth of steep rays more than that of level ones.
    steep = np.tan(np.minimum(np.maximum(np.abs(high), np.abs(low)), 1.4))
    side = np.arcsin(np.minimum(shift / near, 1)) + turn * (1 + steep)
    around = clear < CLOSE
    first, last = spread.min(axis=1), spread.max(axis=1)
    left, right = np.where(around, -np.pi, first - side), np.where(around, np.pi, last + side)
    return middle, left, right, low, high, np.where(around, 2 * np.pi, last - first), near


def grid_windows(
    corners: Floats, elevation: Floats, firings: int, shift: float, turn: float, stagger: float, *, no_thin: bool = False
) -> Jobs:
    """Windows for `cast` in a grid of rings (elevations falling) x firings, whose azimuth rises evenly from -pi to pi.

    corners: (n, 8, 3) in the scanner's frame. stagger: rad that a laser's azimuth may be from that of its column. no_thin: what
    is too thin is left out however far the scanner moves.
    """
    middle, left, right, low, high, width, near = _bounds(corners, shift, turn)
    step = 2 * np.pi / firings
    r0 = np.searchsorted(-elevation, -high)
    r1 = np.searchsorted(-elevation, -low, side="right")
    start = middle + np.pi
    c0 = np.floor((start + left - stagger) / step).astype(int)
    c1 = np.minimum(np.ceil((start + right + stagger) / step).astype(int) + 1, c0 + firings)
    keep = np.flatnonzero((r1 > r0) & ((width if no_thin else right - left) > SMALLEST * step))
    windows = [np.zeros((0, 5), np.int64)]
    for k in (-firings, 0, firings):  # a window that leaves the grid on one side comes in again on the other
        first, past = np.maximum(c0[keep] + k, 0), np.minimum(c1[keep] + k, firings)
        some = past > first
        windows.append(np.stack([keep[some], r0[keep][some], r1[keep][some], first[some], past[some]], axis=1))
    window = np.concatenate(windows).astype(np.int32)
    return nearest_first(window, near[window[:, 0]])


def in_frame(twist: Floats, T: Floats) -> Floats:
    """A twist (6,) given in one frame, in the frame that T (4, 4) maps from: T = T_given_wanted."""
    back = se3.inverse(T)
    w = back[:3, :3] @ twist[:3]
    return np.asarray(np.r_[w, back[:3, :3] @ (twist[3:] + np.cross(twist[:3], T[:3, 3]))])
