"""Events of a drive: a source whose true extrinsic changes and whose sensors fail.

Times are seconds of the drive, from the stamp of its first cloud. A mount that moves is a left perturbation in the camera's
frame: T' = exp(xi) T. Synthetic drives are rendered anew with the camera where it then is. Recorded frames are changed so
that T' is their true extrinsic, see events_recorded.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from benchmarks.events_recorded import covered_image, moved
from benchmarks.sources import Changed
from calib_ros import se3
from calib_ros.datasets.source import Source
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros_synthetic.drive import SyntheticDrive
from calib_ros_synthetic.scanners import PERIOD

Floats = NDArray[np.float64]
Axis = tuple[float, float, float]
DOWN: Axis = (0.0, 1.0, 0.0)  # the camera's y: a turn about it is a yaw


def _unit(axis: Axis) -> Floats:
    return np.asarray(np.array(axis, float) / np.linalg.norm(axis))


@dataclass(frozen=True)
class Event:
    """Something between start (s) and end (s)."""

    start: float
    end: float
    label: ClassVar[str] = "event"

    def holds(self, time: float) -> bool:
        """True from start until just before the end."""
        return self.start <= time < self.end

    def describe(self) -> str:
        """For people."""
        return f"{self.label} {self.start:g}-{self.end:g} s"


@dataclass(frozen=True)
class Drift(Event):
    """The camera turns slowly about `axis` (in its own frame), by `deg` in all, and stays so."""

    deg: float = 0.5
    axis: Axis = DOWN
    label: ClassVar[str] = "drift"

    def xi(self, time: float) -> Floats:
        """Left perturbation (6,) at `time`, rad and m."""
        share = min(max((time - self.start) / (self.end - self.start), 0.0), 1.0)
        return np.concatenate([np.deg2rad(self.deg * share) * _unit(self.axis), np.zeros(3)])


@dataclass(frozen=True)
class MountDisplacement(Event):
    """At `start` the camera turns by `deg` about `axis` and moves by `m` along `direction`, and stays so.

    Both are parts of one left perturbation, in the camera's frame. end is the same as start.
    """

    end: float = math.nan
    deg: float = 2.0
    axis: Axis = (1.0, 2.0, 1.0)
    m: float = 0.05
    direction: Axis = (1.0, -1.0, 1.0)
    label: ClassVar[str] = "mount displacement"

    def __post_init__(self) -> None:
        object.__setattr__(self, "end", self.start)

    def xi(self, time: float) -> Floats:
        """Left perturbation (6,) at `time`, rad and m."""
        if time < self.start:
            return np.zeros(6)
        turn, shift = _unit(self.axis), _unit(self.direction)
        return np.concatenate([np.deg2rad(self.deg) * turn, self.m * shift])

    def describe(self) -> str:
        """For people."""
        return f"{self.label} at {self.start:g} s"


@dataclass(frozen=True)
class Covered(Event):
    """The image shows nothing but a sensor's noise."""

    label: ClassVar[str] = "covered lens"


@dataclass(frozen=True)
class LostClouds(Event):
    """A share of the clouds never arrives."""

    share: float = 0.2
    label: ClassVar[str] = "lost clouds"


@dataclass(frozen=True)
class LateCamera(Event):
    """The image shows what was there delay_s before its stamp."""

    delay_s: float = 0.08
    label: ClassVar[str] = "late camera"


@dataclass(frozen=True)
class EmptyRoad(Event):
    """Nothing in sight but the road and the sky."""

    label: ClassVar[str] = "empty road"


def default_events(synthetic: bool = True) -> list[Event]:
    """Those of a drive of 180 s; without the empty road for a recording."""
    events: list[Event] = [
        Drift(20, 80, deg=0.5), MountDisplacement(90), Covered(115, 125), LateCamera(126, 138), LostClouds(138, 150),
    ]  # fmt: skip
    return [*events, EmptyRoad(150, 180)] if synthetic else events


Kind = TypeVar("Kind", bound=Event)


def drive_times(source: Source) -> Floats:
    """Time (n,) in s of every frame's cloud after the first one's. Recordings are read through for it."""
    if isinstance(source, SyntheticDrive):
        return np.asarray(np.arange(len(source)) * (source.stride * PERIOD))
    known = getattr(source, "times", None)
    if known is not None:
        return np.asarray(known, float)
    stamps = np.array([source[i].moment_of_cloud for i in range(len(source))], np.int64)
    return np.asarray((stamps - stamps[:1]) / NANOSECONDS)


def mount(events: Sequence[Event], time: float) -> Floats:
    """(4, 4) by which the camera has moved at `time`: T_true = mount @ T_at_the_start, the earlier event first."""
    T = np.eye(4)
    for event in sorted(events, key=lambda e: e.start):
        if isinstance(event, Drift | MountDisplacement):
            T = se3.exp(event.xi(time)) @ T
    return T


class EventSource(Changed):
    """The frames of another source, with events. Frames without a cloud are missing; `positions` says which are there.

    times: (n,) s of the drive, one per frame. Frame.reference is the true extrinsic of that very frame, if the source knows it;
    `reference` that at the start of the drive. Only a synthetic drive can lead along an empty road.
    """

    def __init__(self, base: Source, events: Sequence[Event]) -> None:
        self.events = tuple(sorted(events, key=lambda e: e.start))
        for road in self._of(EmptyRoad):
            assert isinstance(base, SyntheticDrive)
            base = base.emptied(road.start, road.end)
        super().__init__(base)
        self._every = drive_times(base)
        lost = [self._lost(number, event) for number, event in enumerate(self._of(LostClouds))]
        self.positions = np.setdiff1d(np.arange(len(self._every)), np.concatenate([np.zeros(0, int), *lost]))
        self.times = self._every[self.positions]

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, index: int) -> Frame:
        """Frame `index`, counted from the end if negative. IndexError past either end."""
        position = int(self.positions[index])
        frame = self._seen(position)
        if any(event.holds(float(self._every[position])) for event in self._of(Covered)):
            return replace(frame, image=covered_image(frame.image, np.random.default_rng([0, 8, position])))
        return frame

    def _seen(self, position: int) -> Frame:
        """The frame through an uncovered lens."""
        time = float(self._every[position])
        delay = next((e.delay_s for e in self._of(LateCamera) if e.holds(time)), 0.0)
        mounted, mounted_before = mount(self.events, time), mount(self.events, time - delay)
        if not isinstance(self.source, SyntheticDrive):
            return moved(self.source, position, mounted, mounted_before, delay)
        frame = self.source.moved(position, mounted_before @ self.source.reference, delay)
        return replace(frame, reference=mounted @ self.source.reference)

    def _lost(self, number: int, event: LostClouds) -> NDArray[np.intp]:
        inside = np.flatnonzero((self._every >= event.start) & (self._every < event.end))
        return np.random.default_rng([0, 9, number]).choice(inside, round(event.share * len(inside)), replace=False)

    def _of(self, kind: type[Kind]) -> list[Kind]:
        return [e for e in self.events if isinstance(e, kind)]
