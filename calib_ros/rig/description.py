"""The description of a rig, rig.yaml: its sensors, the one that the others are stated in, and where each is believed to be."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from calib_ros import io, result, se3
from calib_ros.arrays import Transform
from calib_ros.datasets.rig import CAMERA as CAMERA
from calib_ros.datasets.rig import KINDS, SIGMA_DEG, SIGMA_M
from calib_ros.datasets.rig import LIDAR as LIDAR
from calib_ros.datasets.rig import RigDescription as RigDescription
from calib_ros.datasets.rig import Sensor as Sensor
from calib_ros.datasets.rig import prior_covariance as prior_covariance
from calib_ros.errors import BadInputError

FROM_TF = "tf"
MAX_SIGMA_DEG, MAX_SIGMA_M = 45.0, 5.0
KEYS = {"reference", "sensors", "pairs"}
SENSOR_KEYS = {"kind", "topic", "camera_info", "frame", "prior", "sigma_deg", "sigma_m", "mask"}
PRIOR_KEYS = {"translation_m", "quaternion_xyzw"}


def read_rig(path: str | Path) -> RigDescription:
    """The description in a YAML file. BadInputError names the file, the key and what to do, in one line."""
    path = Path(path).expanduser()
    try:
        text = io.read_text(path, "rig", "a description of a rig, see docs/rig.md")
        data, root = io.load(text), io.compose(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise BadInputError(f"{path} is no valid YAML{io.what_is_wrong(error)}; correct it") from None
    reader = _Reader(path)
    reader.check_unique(root)
    return reader.rig(data)


class _Reader:
    """Checks values of one file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._kind: Any = None  # of the reference

    def wrong(self, key: str, problem: str) -> BadInputError:
        return BadInputError(f"{self.path}: {key}{' ' if key else ''}{problem}")

    def check_unique(self, node: yaml.Node | None) -> None:
        """BadInputError for a key that a mapping has twice, of which YAML takes the last."""
        seen: set[str] = set()
        for key, value in node.value if isinstance(node, yaml.MappingNode) else ():
            if key.value in seen:
                raise self.wrong(key.value, f"is given again in line {key.start_mark.line + 1}; leave one of them")
            seen.add(key.value)
            self.check_unique(value)

    def mapping(self, value: Any, key: str, known: Collection[str] | None, example: str) -> Mapping[str, Any]:
        if not isinstance(value, dict) or not all(isinstance(name, str) for name in value):
            raise self.wrong(key, f"must be a mapping such as {example}")
        for name in sorted(value.keys() - (known or value.keys())):
            raise self.wrong(f"{key}.{name}" if key else name, f"is not known; {_nearest(name, known or ())}")
        return value

    def text(self, value: Any, key: str) -> str:
        if not isinstance(value, str) or not value.strip():
            raise self.wrong(key, f"must be a text, got {value!r}; quote it")
        return value

    def sigma(self, value: Any, key: str, most: float) -> float:
        if not isinstance(value, (int, float)) or isinstance(value, bool) or not 0 < value <= most:
            raise self.wrong(key, f"= {value!r} is no standard deviation; give a number above 0, up to {most:g}")
        return float(value)

    def name(self, value: Any, key: str, names: Collection[str]) -> str:
        if not isinstance(value, str) or value not in names:
            raise self.wrong(key, f"names {value!r}, which is no sensor here; {_nearest(str(value), names)}")
        return value

    def rig(self, data: Any) -> RigDescription:
        top = self.mapping(data, "", KEYS, "reference: lidar_top, with sensors:")
        for key in ("reference", "sensors"):
            if key not in top:
                raise self.wrong(key, "is missing; " + {"reference": "name a sensor", "sensors": "list the sensors by name"}[key])
        entries = self.mapping(top["sensors"], "sensors", None, "front: {kind: camera, topic: /front/image}")
        reference = self.name(top["reference"], "reference", entries)
        at = entries[reference]
        self._kind = at.get("kind") if isinstance(at, dict) else None
        sensors = tuple(self.sensor(name, value) for name, value in entries.items())
        rig = RigDescription(sensors, reference)
        if len(sensors) < 2 or not rig.lidars:
            raise self.wrong("sensors", "must hold two or more, one of them of kind: lidar; add what is missing")
        own = rig[rig.reference].prior
        if own is not None and not np.allclose(own, np.eye(4)):
            raise self.wrong(f"sensors.{rig.reference}.prior", "is of the reference itself; leave it out")
        for key in ("topic", "frame"):
            seen: dict[tuple[str, str], str] = {}
            for sensor in sensors:
                value = getattr(sensor, key), sensor.kind if key == "topic" else ""  # a folder may hold images and clouds
                if value[0] and value in seen:
                    raise self.wrong(f"sensors.{sensor.name}.{key}", f"is {value[0]}, as of {seen[value]}; give each its own")
                seen[value] = sensor.name
        if top.get("pairs") is None:
            return rig
        return RigDescription(sensors, rig.reference, self.pairs(top["pairs"], rig))

    def sensor(self, name: str, value: Any) -> Sensor:
        key = f"sensors.{name}"
        entry = self.mapping(value, key, SENSOR_KEYS, "{kind: camera, topic: /front/image}")
        if "kind" not in entry:
            raise self.wrong(f"{key}.kind", "is missing; give camera or lidar")
        kind = self.text(entry["kind"], f"{key}.kind")
        if kind not in KINDS:
            raise self.wrong(f"{key}.kind", f"is {kind!r}; give camera or lidar")
        for name_of in ("camera_info", "mask"):
            if kind == LIDAR and name_of in entry:
                raise self.wrong(f"{key}.{name_of}", "is of cameras; leave it out, or set kind: camera")
        texts = {k: self.text(entry[k], f"{key}.{k}") for k in ("topic", "camera_info", "frame", "mask") if k in entry}
        if "mask" in texts:
            texts["mask"] = str(self.file(texts["mask"], f"{key}.mask"))
        prior = self.prior(entry.get("prior", FROM_TF), f"{key}.prior", kind)
        limits = (("sigma_deg", SIGMA_DEG, MAX_SIGMA_DEG), ("sigma_m", SIGMA_M, MAX_SIGMA_M))
        deg, m = (self.sigma(entry.get(k, usual), f"{key}.{k}", most) for k, usual, most in limits)
        topic, info, frame, mask = (texts.get(k, "") for k in ("topic", "camera_info", "frame", "mask"))
        return Sensor(name, kind, topic, info, frame, prior, deg, m, mask)

    def file(self, text: str, key: str) -> Path:
        path = self.path.parent / os.path.expanduser(text)  # which leaves an unknown user as it is
        if not path.is_file():
            raise self.wrong(key, f"names {path}, which is no file; give a path from the folder of {self.path.name}")
        return path

    def prior(self, value: Any, key: str, kind: str) -> Transform | None:
        """T_reference_sensor (4, 4); None = as the recording states it."""
        if value == FROM_TF:
            return None
        if isinstance(value, str):
            if not value.strip():
                raise self.wrong(key, "is empty; give tf, a result file, or translation_m with quaternion_xyzw")
            if kind == self._kind:
                raise self.wrong(key, f"is a result of camera and LiDAR, but the reference is a {kind}, too; give translation_m")
            T = result.load(self.file(value, key)).T_camera_lidar
            return T if kind == LIDAR else se3.inverse(T)
        parts = self.mapping(value, key, PRIOR_KEYS, "{translation_m: [x, y, z], quaternion_xyzw: [x, y, z, w]}, tf, or a file")
        try:
            if parts.keys() != PRIOR_KEYS:
                raise ValueError
            t = np.array(parts["translation_m"], float).reshape(3)
            T = se3.from_parts(se3.rotation_from_quaternion(parts["quaternion_xyzw"]), t)
        except (TypeError, ValueError, OverflowError):
            raise self.wrong(key, "needs translation_m of 3 and quaternion_xyzw of 4 numbers") from None
        except BadInputError as error:
            raise self.wrong(key, f": {error}") from None
        return se3.as_transform(T, f"{self.path}: {key}")

    def pairs(self, value: Any, rig: RigDescription) -> tuple[tuple[str, str], ...]:
        if not isinstance(value, list) or not value or not all(isinstance(pair, list) and len(pair) == 2 for pair in value):
            raise self.wrong("pairs", "must be a list such as [[front, lidar_top]]; leave it out for all that share a view")
        names = [sensor.name for sensor in rig.sensors]
        found: list[tuple[str, str]] = []
        for k, (a, b) in enumerate(value):
            a, b = self.name(a, f"pairs[{k}]", names), self.name(b, f"pairs[{k}]", names)
            if rig[a].kind == rig[b].kind == CAMERA or a == b:
                raise self.wrong(f"pairs[{k}]", f"is {a} and {b}; pair a camera with a LiDAR, or two LiDARs")
            pair = (b, a) if rig[a].kind == LIDAR and rig[b].kind == CAMERA else (a, b)
            if pair in found or pair[::-1] in found:
                raise self.wrong(f"pairs[{k}]", f"lists {a} and {b} again; leave it out")
            found.append(pair)
        return tuple(found)


def _nearest(name: str, known: Collection[str]) -> str:
    """What to write instead."""
    close = get_close_matches(name, list(known), 1)
    return f"do you mean {close[0]}?" if close else f"there are {', '.join(sorted(known))}"
