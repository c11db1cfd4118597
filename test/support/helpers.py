"""Small exact worlds for tests: a scanner that casts rays at planes and boxes, and pictures of the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib_ros.frame import PointCloud

HEIGHT = 1.7  # m; of the scanner above the ground


@dataclass(frozen=True)
class Plane:
    """Points p with normal . p == offset; `reflectivity` of (n, 3) points is a number or a function of them."""

    normal: tuple[float, float, float]
    offset: float
    reflectivity: object = 0.3

    def cast(self, D: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore"):
            t = self.offset / (D @ np.array(self.normal))
        return np.where(t > 0, t, np.inf)


@dataclass(frozen=True)
class Box:
    """Axis-parallel box between two corners."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    reflectivity: object = 0.3

    def cast(self, D: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = np.array(self.low) / D, np.array(self.high) / D
        near, far = np.fmin(a, b).max(axis=1), np.fmax(a, b).min(axis=1)
        return np.where((near < far) & (near > 0), near, np.inf)


GROUND = Plane((0, 0, 1), -HEIGHT)


def cast(D: np.ndarray, shapes: Sequence[Plane | Box]) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions (n, 3) -> range (n,), inf where nothing is hit, and reflectivity (n,) of the nearest surface."""
    ranges = np.stack([shape.cast(D) for shape in shapes])
    nearest, r = ranges.argmin(axis=0), ranges.min(axis=0)
    value = np.zeros(len(D))
    for k, shape in enumerate(shapes):
        own = (nearest == k) & np.isfinite(r)
        value[own] = shape.reflectivity(D[own] * r[own, None]) if callable(shape.reflectivity) else shape.reflectivity
    return r, value


def directions(azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """Angles in rad, broadcast -> unit vectors (..., 3)."""
    azimuth, elevation = np.broadcast_arrays(azimuth, elevation)
    return np.stack([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], axis=-1)


@dataclass(frozen=True)
class Spinner:
    """An ideal spinning scanner. Angles in deg; `field` and `start` are azimuths, counter-clockwise from +x."""

    rings: int = 32
    low: float = -20.0
    high: float = 4.0
    step: float = 0.25
    start: float = 0.0
    clockwise: bool = False
    field: tuple[float, float] | None = None

    @property
    def elevations(self) -> np.ndarray:
        """(rings,) rad, from the top."""
        return np.deg2rad(np.linspace(self.high, self.low, self.rings))

    @property
    def azimuths(self) -> np.ndarray:
        """(columns,) rad, in the order of time."""
        a = self.start + self.step * np.arange(round(360 / self.step)) * (-1 if self.clockwise else 1)
        a = (a + 180) % 360 - 180
        return np.deg2rad(a if self.field is None else a[(a >= self.field[0]) & (a <= self.field[1])])

    def scan(self, shapes: Sequence[Plane | Box], order: str = "ring", with_ring: bool = True) -> PointCloud:
        """Points ring after ring ("ring"), column after column ("column"), or shuffled; lost rays are left out."""
        ring, column = np.meshgrid(np.arange(self.rings), np.arange(len(self.azimuths)), indexing="ij")
        if order == "column":
            ring, column = ring.T, column.T
        ring, column = ring.ravel(), column.ravel()
        D = directions(self.azimuths[column], self.elevations[ring])
        r, value = cast(D, shapes)
        keep = np.nonzero(np.isfinite(r))[0]
        if order == "shuffled":
            keep = np.random.default_rng(0).permutation(keep)
        xyz = (D[keep] * r[keep, None]).astype(np.float32)
        return PointCloud(xyz, value[keep].astype(np.float32), ring[keep].astype(np.int32) if with_ring else None)


@dataclass(frozen=True)
class Rosette:
    """An ideal scanner whose beam two prisms bend: no rings, and no scan like the other. number: of the scan."""

    number: int = 0
    points: int = 24000
    reach: float = 40.0  # deg off the middle

    def scan(self, shapes: Sequence[Plane | Box]) -> PointCloud:
        """Points in the order of time."""
        t = 0.1 * (np.arange(self.points) / self.points + self.number)
        a, b = 2 * np.pi * 121.567 * t, -2 * np.pi * 77.731 * t
        half = np.deg2rad(self.reach) / 2
        D = directions(half * (np.cos(a) + np.cos(b)), half * (np.sin(a) + np.sin(b)))
        r, value = cast(D, shapes)
        hit = np.isfinite(r) & (r < 100)
        return PointCloud((D[hit] * r[hit, None]).astype(np.float32), value[hit].astype(np.float32))
