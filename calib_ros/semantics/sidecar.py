"""The YAML beside a model: what cannot be inferred from its tensors.

`model.yaml` beside `model.onnx`; every entry may be left out.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from calib_ros import plain_yaml
from calib_ros.errors import BadInputError, ModelError


@dataclass(frozen=True)
class Sidecar:
    """family: overrides what the tensors tell, see the modules that use it. output: name of the output that counts.

    mean, std: per channel, in the unit of the channels after `scale`. scale: of grey levels 0..255 before that, 1/255 for 0..1.
    channels: rgb or bgr; of range images their names in order. size: (height, width) to run at. labels: class names by number,
    or the name of a dataset. fov_deg: highest and lowest elevation of a range image. azimuth_deg: angle that its columns cover,
    straight ahead in the middle.
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
        """That of a model's file; empty if there is none. ModelError names the entry that is wrong."""
        for suffix in (".yaml", ".yml"):
            own = Path(path).with_suffix(suffix)
            if own.is_file():
                return _read(own)
        return Sidecar()


def _read(path: Path) -> Sidecar:
    names = [f.name for f in dataclasses.fields(Sidecar)]
    try:
        data = plain_yaml.load(plain_yaml.read_text(path, "description of a model", "a small YAML"))
    except BadInputError as error:
        raise ModelError(str(error)) from None
    except (yaml.YAMLError, ValueError, RecursionError):
        raise ModelError(f"{path} is not valid YAML; it may hold {', '.join(names)}") from None
    if data is None:
        return Sidecar()
    if not isinstance(data, dict):
        raise ModelError(f"{path} must hold names and values; known are {', '.join(names)}")
    for name in data:
        if name not in names:
            raise ModelError(f"{path}: unknown entry '{name}'; known are {', '.join(names)}")
    return Sidecar(**{name: _checked(path, name, value) for name, value in data.items() if value is not None})


def _checked(path: Path, name: str, value: Any) -> Any:
    wanted = {
        "family": "a name",
        "mean": "a list of numbers",
        "std": "a list of numbers above 0",
        "scale": "a number above 0",
        "channels": "rgb, bgr or a list of names",
        "size": "[height, width]",
        "labels": "a list of class names, a mapping from numbers to names, or the name of a dataset",
        "fov_deg": "[highest, lowest]",
        "azimuth_deg": "an angle above 0, up to 360",
        "output": "a name",
    }[name]
    fits = False
    if name in ("family", "output"):
        fits = isinstance(value, str)
    elif name == "scale":
        fits = _is_number(value) and value > 0
    elif name == "azimuth_deg":
        fits = _is_number(value) and 0 < value <= 360
    elif name in ("mean", "std", "size", "fov_deg"):
        fits = isinstance(value, list) and len(value) > 0 and all(_is_number(v) for v in value)
        fits = fits and (name != "std" or min(value) > 0)
        fits = fits and (name != "size" or (len(value) == 2 and all(isinstance(v, int) and 8 <= v <= 8192 for v in value)))
        fits = fits and (name != "fov_deg" or (len(value) == 2 and -90 <= value[1] < value[0] <= 90))
    elif name == "channels":
        fits = value in ("rgb", "bgr") or (isinstance(value, list) and all(isinstance(v, str) for v in value))
    elif isinstance(value, dict):
        fits = all(
            isinstance(k, int) and not isinstance(k, bool) and 0 <= k < 65536 and isinstance(v, str) for k, v in value.items()
        )
    else:
        fits = isinstance(value, str) or (isinstance(value, list) and all(isinstance(v, str) for v in value))
    if not fits:
        raise ModelError(f"{path}: {name} = {value!r} must be {wanted}")
    if isinstance(value, list):
        return tuple(float(v) for v in value) if name in ("mean", "std", "fov_deg") else tuple(value)
    return value


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e12
