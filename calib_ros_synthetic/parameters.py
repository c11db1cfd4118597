"""The parameters of synthetic drives, and the texts `synthetic:name=value,...` that state them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from calib_ros.errors import BadInputError
from calib_ros_synthetic.rigs import RIGS
from calib_ros_synthetic.scanners import PLAIN
from calib_ros_synthetic.street import SPINS, STEADY

V = TypeVar("V")
# Parameter -> its default (None: it depends on others), and of one that is a number its type, lowest and highest value.
PARAMETERS: dict[str, tuple[Any, ...]] = {
    "seed": (0, int, 0, 2**31 - 1),
    "frames": (20, int, 1, 100_000),
    "rings": (None, int, 0, 128),
    "width": (None, int, 64, 8192),
    "height": (None, int, 48, 8192),
    "speed": (None, float, 0.0, 40.0),
    "stride": (10, int, 1, 1000),
    "noise": (1.0, float, 0.0, 10.0),
    "tilt_deg": (2.0, float, 0.0, 20.0),
    "image_late_ms": (0.0, float, -500.0, 500.0),
    "jitter_ms": (0.0, float, 0.0, 100.0),
    "clocks": (1.0, float, 0.0, 100.0),
    "knock_at": (None, float, 0.0, 100_000.0),
    "knock_deg": (1.0, float, 0.0, 20.0),
    "knock_m": (0.05, float, 0.0, 2.0),
    "rig": (None,),
    "scene": ("street",),
    "condition": (None,),
    "fields": (None,),
    "ride": (STEADY,),
    "stamp_at": ("middle",),
    "spin": (SPINS[0],),
    "knock": ("",),
}
# Those of rigs of one pair, and of several sensors, in the order in which they are named.
OF_PAIR = (
    *("seed", "frames", "rings", "width", "height", "speed", "stride", "noise", "tilt_deg", "image_late_ms", "jitter_ms"),
    *("rig", "scene", "condition", "fields", "ride", "stamp_at", "spin"),
)
OF_SEVERAL = (
    *("seed", "frames", "stride", "width", "speed", "noise", "tilt_deg", "clocks", "knock_at", "knock_deg", "knock_m"),
    *("rig", "scene", "condition", "ride", "knock"),
)
CHOICE = ("camera", "lidar")  # which pair of several sensors a text stands for


def named(parameter: str, name: str, known: Mapping[str, V]) -> V:
    """What a name stands for. BadInputError for an unknown one."""
    if name not in known:
        raise BadInputError(f"synthetic drive: {parameter}={name} is not known; choose one of {', '.join(known)}")
    return known[name]


def known_of(rig: str | None) -> tuple[str, ...]:
    """The parameters of a rig in RIGS; None = of the plain one. BadInputError for an unknown rig."""
    return OF_PAIR if rig is None or named("rig", rig, RIGS).is_pair else OF_SEVERAL


def checked(name: str, value: Any) -> Any:
    """A parameter, as a number of its type where it is one. BadInputError for what is none, or out of range."""
    if len(PARAMETERS[name]) == 1 or value is None:
        return value
    _, kind, low, high = PARAMETERS[name]
    allowed = "one of " + ", ".join(map(str, sorted(PLAIN))) if name == "rings" else f"from {low:g} to {high:g}"
    try:
        number = float(value)
        good = low <= number <= high and (kind is float or number == int(number)) and not isinstance(value, bool)
    except (TypeError, ValueError, OverflowError):
        good = False
    if not good or (name == "rings" and int(number) not in PLAIN):
        what = "a whole number" if kind is int else "a number"
        raise BadInputError(f"synthetic drive: {name}={value} is not allowed; it must be {what} {allowed}")
    return kind(number)


def parsed(text: str) -> dict[str, Any]:
    """The parameters in the text of a source, of several sensors CHOICE among them."""
    kind, _, rest = text.strip().partition(":")
    if kind != "synthetic":
        raise BadInputError(f"'{text}' is no synthetic drive; write 'synthetic' or 'synthetic:seed=3,frames=16'")
    items = [(item.strip(), *(part.strip() for part in item.partition("="))) for item in rest.split(",") if item.strip()]
    known = known_of({key: value for _, key, _, value in items}.get("rig"))
    known = known if known is OF_PAIR else (*known, *CHOICE)
    parameters: dict[str, Any] = {}
    for item, key, equals, value in items:
        if key not in known or not equals:
            raise BadInputError(f"synthetic drive: '{item}' is not understood; write key=value with {', '.join(known)}")
        parameters[key] = value if key in CHOICE else checked(key, value)
    return parameters
