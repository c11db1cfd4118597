"""Events of a drive: a source whose true extrinsic changes and whose sensors fail.

Times are seconds of the drive, from the stamp of its first cloud. A mount that moves is a left perturbation in the camera's
frame: T' = exp(xi) T. Synthetic drives are rendered anew with the camera where it then is. Recorded frames are changed so
that T' is their true extrinsic, see events_recorded.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from benchmarks.events_recorded import Recorded, covered_image
from benchmarks.sources import Changed
from calib_ros import se3
from calib_ros.datasets.source import Source
from calib_ros.errors import BadInputError
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros_synthetic.drive import SyntheticDrive
from calib_ros_synthetic.scanners import PERIOD

Floats = NDArray[np.float64]
Axis = tuple[float, float, float]
DOWN: Axis = (0.0, 1.0, 0.0)  # the camera's y: a turn about it is a yaw
LOOKS = ("dark", "white", "frozen")


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
    """The image shows nothing: "dark" and "white" with a sensor's noise, or "frozen", the last image again and again."""

    look: str = "dark"
    label: ClassVar[str] = "covered lens"

    def describe(self) -> str:
        """For people."""
        return f"{self.label} ({self.look}) {self.start:g}-{self.end:g} s"


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
    `reference` that at the start of the drive. BadInputError: overlapping events of one kind that cannot both be, an empty road
    in a recording, or nothing left of the source.
    """

    def __init__(self, base: Source, events: Sequence[Event], seed: int = 0) -> None:
        self.events = tuple(sorted(events, key=lambda e: e.start))
        self._seed = seed
        for kind in (Covered, LateCamera, EmptyRoad, LostClouds):
            _refuse_overlaps(self._of(kind))
        super().__init__(_emptied(base, self._of(EmptyRoad)))
        self.name += f" with {', '.join(e.label for e in self.events) or 'no events'}"
        self._recorded = Recorded(self.source, drive_times(self.source))
        every = self._recorded.times
        lost = [self._lost(number, event, every) for number, event in enumerate(self._of(LostClouds))]
        self.positions = np.setdiff1d(np.arange(len(every)), np.concatenate([np.zeros(0, int), *lost]))
        if not len(self.positions):
            raise BadInputError(f"{base.name}: the events leave no frame")
        self.times = every[self.positions]
        self._frozen: tuple[int, NDArray[np.uint8]] | None = None

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, index: int) -> Frame:
        """Frame `index`, counted from the end if negative. IndexError past either end."""
        position = int(self.positions[index])
        frame = self._seen(position)
        for event in self._of(Covered):
            if event.holds(float(self._recorded.times[position])):
                return replace(frame, image=self._covered(event, position, frame.image))
        return frame

    def describe(self) -> dict[str, str]:
        """The source's facts, and the events."""
        facts = self.source.describe() | {"frames": f"{len(self)}, over {self.times[-1]:g} s"}
        return facts | {"events": "; ".join(e.describe() for e in self.events) or "none"}

    def truth(self, index: int) -> Floats | None:
        """T_camera_lidar (4, 4) of frame `index`, without rendering it; None if the source does not know its own."""
        return None if self.reference is None else mount(self.events, float(self.times[index])) @ self.reference

    def _seen(self, position: int) -> Frame:
        """The frame through an uncovered lens."""
        time = float(self._recorded.times[position])
        delay = next((e.delay_s for e in self._of(LateCamera) if e.holds(time)), 0.0)
        moved, moved_before = mount(self.events, time), mount(self.events, time - delay)
        if not isinstance(self.source, SyntheticDrive):
            return self._recorded.moved(position, moved, moved_before, delay)
        frame = self.source.moved(position, moved_before @ self.source.reference, delay)
        return replace(frame, reference=moved @ self.source.reference)

    def _covered(self, event: Covered, position: int, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        if event.look != "frozen":
            return covered_image(image, event.look == "white", np.random.default_rng([self._seed, 8, position]))
        last = max(int(np.searchsorted(self._recorded.times, event.start)) - 1, 0)  # the last one before it froze
        if self._frozen is None or self._frozen[0] != last:
            self._frozen = last, self._seen(last).image
        return np.array(self._frozen[1])

    def _lost(self, number: int, event: LostClouds, times: Floats) -> NDArray[np.intp]:
        inside = np.flatnonzero((times >= event.start) & (times < event.end))
        rng = np.random.default_rng([self._seed, 9, number])
        return rng.choice(inside, round(event.share * len(inside)), replace=False)

    def _of(self, kind: type[Kind]) -> list[Kind]:
        return [e for e in self.events if isinstance(e, kind)]


def _refuse_overlaps(events: Sequence[Event]) -> None:
    for a, b in pairwise(events):
        if b.start < a.end:
            raise BadInputError(f"events: '{a.describe()}' and '{b.describe()}' overlap; let one end before the other begins")


def _emptied(base: Source, roads: Sequence[EmptyRoad]) -> Source:
    if not roads:
        return base
    if not isinstance(base, SyntheticDrive):
        raise BadInputError(f"{base.name}: only a synthetic drive can be made to lead along an empty road; leave that event out")
    if len(roads) > 1:
        raise BadInputError("events: one empty road per drive")
    return base.emptied(roads[0].start, roads[0].end)
