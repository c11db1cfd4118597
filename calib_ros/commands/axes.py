"""Texts of the command line that speak of the six axes. Errors are argparse's, which names the option."""

from __future__ import annotations

import math
from argparse import ArgumentTypeError

AXES = ("rx", "ry", "rz", "tx", "ty", "tz")  # turning about, and shifting along, x, y, z of the camera's optical frame
Three = tuple[float, float, float]


def per_axis(text: str) -> Three:
    """'5' or '5,5,1' -> three numbers that are not negative."""
    values = [_number(part, text) for part in text.split(",")]
    if len(values) not in (1, 3):
        raise ArgumentTypeError(f"'{text}' holds {len(values)} numbers; give one, or three for x,y,z")
    x, y, z = values if len(values) == 3 else values * 3
    return x, y, z


def axis_names(text: str) -> list[str]:
    """'rx,tz' -> names."""
    return [_axis(part, text) for part in text.split(",")]


def axis_values(text: str) -> list[tuple[str, float]]:
    """'ty=0.1,rx=2' -> names and numbers that are not negative."""
    out = []
    for part in text.split(","):
        name, equals, value = part.partition("=")
        if not equals:
            raise ArgumentTypeError(f"'{text}' is not understood; write AXIS=VALUE like ry=2 (deg) or tz=0.1 (m)")
        out.append((_axis(name, text), _number(value, text)))
    return out


def milliseconds(text: str) -> float:
    """'-4' -> seconds."""
    return _finite(text, text) / 1000


def _axis(name: str, text: str) -> str:
    name = name.strip()
    if name not in AXES:
        where = "" if name == text else f" in '{text}'"
        raise ArgumentTypeError(f"'{name}'{where} is no axis; there are {', '.join(AXES)}")
    return name


def _number(part: str, text: str) -> float:
    value = _finite(part, text)
    if value < 0:
        raise ArgumentTypeError(f"{part.strip()} must not be negative")
    return value


def _finite(part: str, text: str) -> float:
    try:
        value = float(part)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        where = "" if part == text else f" in '{text}'"
        raise ArgumentTypeError(f"'{part.strip()}'{where} is no number")
    return value
