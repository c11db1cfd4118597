"""The events of a drive, checked, and the list of them as text files hold it. Times are seconds of the drive."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import BadInputError

Floats = NDArray[np.float64]
Axis = tuple[float, float, float]
DOWN: Axis = (0.0, 1.0, 0.0)  # the camera's y: a turn about it is a yaw
LOOKS = ("dark", "white", "frozen")


def _number(event: object, name: str, value: Any, low: float, high: float) -> None:
    good = isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high
    if not good:
        raise BadInputError(f"event {type(event).__name__}: {name}={value} is not allowed; it must be from {low:g} to {high:g}")


def _unit(event: object, name: str, value: Any) -> Floats:
    """(3,) of length 1."""
    try:
        axis = np.array(value, float)
    except (TypeError, ValueError):
        axis = np.zeros(0)
    length = float(np.linalg.norm(axis)) if axis.shape == (3,) else 0.0
    if not math.isfinite(length) or length < 1e-9:
        raise BadInputError(f"event {type(event).__name__}: {name}={value} is no axis; give three numbers that are not all 0")
    return np.asarray(axis / length)


@dataclass(frozen=True)
class Event:
    """Something between start (s) and end (s). BadInputError when they, or what a kind adds, make no sense."""

    start: float
    end: float
    label: ClassVar[str] = "event"

    def __post_init__(self) -> None:
        _number(self, "start", self.start, 0.0, 1e6)
        _number(self, "end", self.end, self.start, 1e6)
        if self.end == self.start and not isinstance(self, Knock):
            raise BadInputError(f"event {type(self).__name__}: end={self.end:g} must be after start={self.start:g}")

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

    def __post_init__(self) -> None:
        super().__post_init__()
        _number(self, "deg", self.deg, -45.0, 45.0)
        _unit(self, "axis", self.axis)

    def xi(self, time: float) -> Floats:
        """Left perturbation (6,) at `time`, rad and m."""
        share = min(max((time - self.start) / (self.end - self.start), 0.0), 1.0)
        return np.concatenate([np.deg2rad(self.deg * share) * _unit(self, "axis", self.axis), np.zeros(3)])


@dataclass(frozen=True)
class Knock(Event):
    """At `start` the camera turns by `deg` about `axis` and moves by `m` along `direction`, and stays so.

    Both are parts of one left perturbation, in the camera's frame. end is the same as start.
    """

    end: float = math.nan
    deg: float = 2.0
    axis: Axis = (1.0, 2.0, 1.0)
    m: float = 0.05
    direction: Axis = (1.0, -1.0, 1.0)
    label: ClassVar[str] = "knock"

    def __post_init__(self) -> None:
        if math.isnan(self.end):
            object.__setattr__(self, "end", self.start)
        super().__post_init__()
        if self.end != self.start:
            raise BadInputError(f"event Knock: it takes no time; leave end={self.end:g} out")
        _number(self, "deg", self.deg, -45.0, 45.0)
        _number(self, "m", self.m, -1.0, 1.0)
        _unit(self, "axis", self.axis)
        _unit(self, "direction", self.direction)

    def xi(self, time: float) -> Floats:
        """Left perturbation (6,) at `time`, rad and m."""
        if time < self.start:
            return np.zeros(6)
        turn, shift = _unit(self, "axis", self.axis), _unit(self, "direction", self.direction)
        return np.concatenate([np.deg2rad(self.deg) * turn, self.m * shift])

    def describe(self) -> str:
        """For people."""
        return f"{self.label} at {self.start:g} s"


@dataclass(frozen=True)
class Covered(Event):
    """The image shows nothing: "dark" and "white" with a sensor's noise, or "frozen", the last image again and again."""

    look: str = "dark"
    label: ClassVar[str] = "covered lens"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.look not in LOOKS:
            raise BadInputError(f"event Covered: look={self.look} is not allowed; it must be one of {', '.join(LOOKS)}")

    def describe(self) -> str:
        """For people."""
        return f"{self.label} ({self.look}) {self.start:g}-{self.end:g} s"


@dataclass(frozen=True)
class LostClouds(Event):
    """A share of the clouds never arrives."""

    share: float = 0.2
    label: ClassVar[str] = "lost clouds"

    def __post_init__(self) -> None:
        super().__post_init__()
        _number(self, "share", self.share, 0.0, 1.0)


@dataclass(frozen=True)
class LateCamera(Event):
    """The image shows what was there delay_s before its stamp."""

    delay_s: float = 0.08
    label: ClassVar[str] = "late camera"

    def __post_init__(self) -> None:
        super().__post_init__()
        _number(self, "delay_s", self.delay_s, 0.0, 1.0)


@dataclass(frozen=True)
class EmptyRoad(Event):
    """Nothing in sight but the road and the sky."""

    label: ClassVar[str] = "empty road"


KINDS: dict[str, type[Event]] = {
    "drift": Drift, "knock": Knock, "covered": Covered, "lost_clouds": LostClouds, "late_camera": LateCamera,
    "empty_road": EmptyRoad,
}  # fmt: skip


def parse_events(rows: Any) -> list[Event]:
    """[{kind: drift, start: 20, end: 80, deg: 0.5}, ...] -> events. BadInputError names the first row that is wrong."""
    if not isinstance(rows, Sequence) or isinstance(rows, str) or not all(isinstance(row, dict) for row in rows):
        raise BadInputError("events must be a list of mappings, each with its kind, start and end")
    events = []
    for number, row in enumerate(rows):
        values: dict[str, Any] = dict(row)
        kind: Any = KINDS.get(str(values.pop("kind", "")))
        if kind is None:
            raise BadInputError(f"event {number}: kind={row.get('kind')} is not known; it must be one of {', '.join(KINDS)}")
        names = [f.name for f in fields(kind)]
        unknown = [key for key in values if key not in names]
        missing = [name for name in ("start", "end") if name not in values and not (kind is Knock and name == "end")]
        if unknown or missing:
            what = f"{unknown[0]} is not known" if unknown else f"{missing[0]} is missing"
            raise BadInputError(f"event {number} ({row['kind']}): {what}; it takes {', '.join(map(str, names))}")
        events.append(kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}))
    return events


def default_events(synthetic: bool = True) -> list[Event]:
    """Those of a drive of 180 s; without the empty road for a recording."""
    events: list[Event] = [
        Drift(20, 80, deg=0.5), Knock(90), Covered(115, 125), LateCamera(126, 138), LostClouds(138, 150),
    ]  # fmt: skip
    return [*events, EmptyRoad(150, 180)] if synthetic else events
