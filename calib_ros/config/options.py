"""Options of the configuration: dataclass fields with a description and an allowed range."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import field
from typing import Any

from calib_ros.errors import ConfigError


def option(
    default: Any,
    doc: str,
    *,
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] | None = None,
    length: int | None = None,
) -> Any:
    """A field with its description and its allowed range (inclusive; for tuples, of every element)."""
    return field(default=default, metadata={"doc": doc, "low": low, "high": high, "choices": choices, "length": length})


def bounds(stage: type, name: str) -> tuple[float, float]:
    """Lowest and highest value of a field of a stage; infinite without one."""
    low, high = (stage.__dataclass_fields__[name].metadata[end] for end in ("low", "high"))  # type: ignore[attr-defined]
    return -math.inf if low is None else low, math.inf if high is None else high


def has_room(stage: Stage, name: str, up: bool) -> bool:
    """Whether the value of a field can be raised (up), or lowered, within its range."""
    low, high = bounds(type(stage), name)
    return bool(getattr(stage, name) < high if up else getattr(stage, name) > low)


class Stage:
    """Checks every field against its metadata on construction. ConfigError names field, value and range."""

    def __post_init__(self) -> None:
        for f in dataclasses.fields(self):  # type: ignore[arg-type]
            name = f"{type(self).__name__.removesuffix('Config').lower()}.{f.name}"  # image.FIELD of ImageConfig
            object.__setattr__(self, f.name, checked(name, getattr(self, f.name), f))

    def check_with(self, config: Any) -> None:
        """ConfigError for values that are in range, but contradict each other, or those of other stages of a Config."""


def checked(name: str, value: Any, f: dataclasses.Field[Any]) -> Any:
    """`value` converted to the type of the field's default, or ConfigError."""
    meta: Any = f.metadata
    default: Any = f.default
    if value is None and isinstance(default, tuple):  # of an empty list in a parameter file ROS knows no type
        value = ()
    values = tuple(value) if isinstance(default, tuple) and isinstance(value, (list, tuple)) else (value,)
    want: type[Any] = type(next(iter(default), "")) if isinstance(default, tuple) else type(default)
    if isinstance(default, tuple) and not isinstance(value, (list, tuple)):
        raise ConfigError(f"{name} = {_printed(value)} must be a list of {want.__name__}")
    if meta["length"] is not None and len(values) != meta["length"]:
        raise ConfigError(f"{name} = {_printed(list(values))} must have {meta['length']} elements")
    out = []
    for v in values:
        if isinstance(v, bool) != (want is bool) or (want is float and not isinstance(v, (int, float))):
            raise ConfigError(f"{name} = {_printed(v)} must be of type {want.__name__}")
        if want is int and isinstance(v, float) and v.is_integer():
            v = int(v)
        if want is not float and not isinstance(v, want):
            raise ConfigError(f"{name} = {_printed(v)} must be of type {want.__name__}")
        low, high = meta["low"], meta["high"]
        # Compared before the conversion: an int of 400 digits is no float.
        if (low is not None and not v >= low) or (high is not None and not v <= high):
            raise ConfigError(f"{name} = {_printed(v)} is out of range [{_bound(low)}, {_bound(high)}]")
        if meta["choices"] and v not in meta["choices"]:
            raise ConfigError(f"{name} = {_printed(v)} must be one of {', '.join(meta['choices'])}")
        out.append(want(v))
    return tuple(out) if isinstance(default, tuple) else out[0]


def _printed(value: Any) -> str:
    """A value for an error, not too long."""
    try:
        text = repr(value)
    except ValueError:  # Python does not print whole numbers of more than 4300 digits
        text = "a number of more than 4300 digits"
    return text if len(text) <= 500 else f"{text[:497]}..."


def _bound(value: float | None) -> str:
    return "any" if value is None else f"{value:g}"
