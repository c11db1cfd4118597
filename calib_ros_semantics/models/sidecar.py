"""The YAML beside a model: what its tensors do not say."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from calib_ros import io
from calib_ros.errors import BadInputError, ModelError

SIZES = (8, 8192)  # px; smallest and largest side of an input
MAX_NUMBERS = 65536  # class numbers are below


@dataclass(frozen=True)
class Sidecar:
    """What the YAML says, see ENTRIES; empty or None entries are inferred.

    family, output: instead of those told by the tensors. scale: factor on grey levels 0..255. mean, std: per channel, after it.
    channels: of range images their names in order. azimuth_deg: angle that its columns cover, straight ahead in the middle.
    """

    family: str = ""
    mean: tuple[float, ...] = ()
    std: tuple[float, ...] = ()
    scale: float | None = None
    channels: str | tuple[str, ...] = ""
    size: tuple[int, int] | None = None
    labels: str | tuple[str, ...] | dict[int, str] = ""
    fov_deg: tuple[float, float] | None = None
    azimuth_deg: float = 360.0
    output: str = ""

    @staticmethod
    def beside(path: str | Path) -> Sidecar:
        """The YAML of a model's file; empty if there is none. ModelError names a wrong entry."""
        beside = (Path(path).with_suffix(suffix) for suffix in (".yaml", ".yml"))
        own = next(filter(Path.is_file, beside), None)
        return Sidecar() if own is None else _read(own)


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e12


def _is_side(value: Any) -> bool:
    return isinstance(value, int) and SIZES[0] <= value <= SIZES[1]


def _is_list(value: Any, of: Callable[[Any], bool], length: int | None = None) -> bool:
    return isinstance(value, list) and bool(value) and len(value) == (length or len(value)) and all(map(of, value))


def _names_numbers(value: Any) -> bool:
    return isinstance(value, dict) and all(type(k) is int and 0 <= k < MAX_NUMBERS and _is_text(v) for k, v in value.items())


# What the value of each entry must be, and whether it is.
ENTRIES: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "family": ("a name", _is_text),
    "mean": ("a list of numbers", lambda v: _is_list(v, _is_number)),
    "std": ("a list of numbers above 0", lambda v: _is_list(v, _is_number) and min(v) > 0),
    "scale": ("a number above 0", lambda v: _is_number(v) and v > 0),
    "channels": ("rgb, bgr or a list of names", lambda v: v in ("rgb", "bgr") or _is_list(v, _is_text)),
    "size": (f"[height, width], each {SIZES[0]} to {SIZES[1]} px", lambda v: _is_list(v, _is_side, 2)),
    "labels": (
        "a list of class names, a mapping from numbers to names, or the name of a dataset",
        lambda v: _is_text(v) or _is_list(v, _is_text) or _names_numbers(v),
    ),
    "fov_deg": ("[highest, lowest]", lambda v: _is_list(v, _is_number, 2) and -90 <= v[1] < v[0] <= 90),
    "azimuth_deg": ("an angle above 0, up to 360", lambda v: _is_number(v) and 0 < v <= 360),
    "output": ("a name", _is_text),
}


def _read(path: Path) -> Sidecar:
    known = ", ".join(ENTRIES)
    try:
        data = io.load(io.read_text(path, "description of a model", "a small YAML"))
    except BadInputError as error:
        raise ModelError(str(error)) from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ModelError(f"{path} is not valid YAML{io.what_is_wrong(error)}; it may hold {known}") from None
    if not isinstance(data, dict | None):
        raise ModelError(f"{path} must hold names and values; known are {known}")
    given: dict[str, Any] = {name: value for name, value in (data or {}).items() if value is not None or name not in ENTRIES}
    for name, value in given.items():
        if name not in ENTRIES:
            raise ModelError(f"{path}: unknown entry '{name}'; known are {known}")
        expected, fits = ENTRIES[name]
        if not fits(value):
            raise ModelError(f"{path}: {name} = {value!r} must be {expected}")
        given[name] = tuple(value) if isinstance(value, list) else value
    return Sidecar(**given)
