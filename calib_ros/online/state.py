"""State file: the last good extrinsic on disk, refused when it is damaged or belongs to other sensors.

A result file with three more entries: `camera`, the intrinsics that it was estimated with; `provenance`, how it was estimated;
`sha256`, the checksum of all the others. A result file that a person put there needs none of the three.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from calib_ros import io, se3
from calib_ros.camera import Camera
from calib_ros.config import Config
from calib_ros.errors import BadInputError
from calib_ros.io import write_atomically
from calib_ros.result import Result, parse

T = TypeVar("T")
CHECKSUM = "sha256"
REMEDY = "delete it or name another state_file"


class State(NamedTuple):
    """What a state file holds; camera and provenance are None where a plain result file serves as one."""

    result: Result
    camera: Camera | None
    provenance: dict[str, Any] | None


def provenance_of(config: Config, accepted: int, keyframes: int, sensor_stamp_ns: int) -> dict[str, Any]:
    """How a saved extrinsic was estimated: estimates accepted and keyframes since the node started, the score that was
    maximised, a fingerprint of all constants, and the stamp of the newest frame in it by the sensors' clock, 0 = unknown."""
    return {
        "accepted": int(accepted),
        "keyframes": int(keyframes),
        "objective": config.refine.objective,
        "config": _digest(config.to_dict())[:16],
        "sensor_stamp_ns": int(sensor_stamp_ns),
    }


def save_state(path: str | Path, result: Result, camera: Camera, provenance: Mapping[str, Any] | None = None) -> None:
    """Write an accepted estimate with the camera that it is valid for, atomically.

    BadInputError if the folder cannot be written or the result could not be read again; an old file stays then.
    """
    se3.as_transform(result.T_camera_lidar, "the state to be saved")
    data = result.to_dict()
    data["camera"] = {
        "width": camera.width,
        "height": camera.height,
        "K": camera.K.tolist(),
        "model": camera.model,
        "D": camera.D.tolist(),
    }
    data["provenance"] = dict(provenance or {})
    # As it will be read: a value that JSON changes must not be mistaken for damage.
    data = json.loads(json.dumps(data))
    # Checksum first, provenance last: whatever piece of the file is lost, one of the two still shows it.
    text = json.dumps({CHECKSUM: _digest(data), **data}, indent=1) + "\n"
    parse(text, "the state to be saved")
    write_atomically(path, text.encode())


def load_state(path: str | Path, camera: Camera, camera_frame: str, lidar_frame: str) -> Result:
    """The saved result. BadInputError with the reason if it is unreadable, damaged, of other frames or of another camera."""
    state = read_state(path)
    result, saved = state.result, state.camera
    if (result.camera_frame, result.lidar_frame) != (camera_frame, lidar_frame):
        raise BadInputError(
            f"saved state {path} is for {result.lidar_frame} -> {result.camera_frame}, "
            f"but the sensors are {lidar_frame} -> {camera_frame}; {REMEDY}"
        )
    if saved is not None and saved != camera:
        raise BadInputError(
            f"saved state {path} was estimated with other camera intrinsics ({_difference(saved, camera)}); {REMEDY}"
        )
    return replace(result, data_stamp=(state.provenance or {}).get("sensor_stamp_ns", 0))


def read_state(path: str | Path) -> State:
    """Everything a state or result file holds, whatever sensors it is for. BadInputError if it is unreadable or damaged."""
    text = io.read_text(path, "result", "a JSON or YAML result of calib-ros")
    result = parse(text, str(path))
    try:
        data = json.loads(text) if text.lstrip().startswith("{") else io.load(text)
        # A file with a provenance has a checksum; where it is missing, its key is what was damaged.
        if (CHECKSUM in data or "provenance" in data) and data.pop(CHECKSUM, None) != _digest(data):
            raise BadInputError(f"saved state {path} is damaged or edited: its checksum does not fit its content; {REMEDY}")
    except (TypeError, ValueError, RecursionError):  # keys that are no text, or lists that hold themselves
        raise BadInputError(f"saved state {path} cannot be checked for damage; {REMEDY}") from None

    def usable(name: str, made_of: Callable[[Any], T]) -> T | None:
        try:
            return None if data.get(name) is None else made_of(data[name])
        except (AttributeError, LookupError, TypeError, ValueError, OverflowError, BadInputError):
            raise BadInputError(f"saved state {path} holds no usable {name}; {REMEDY}") from None

    camera = usable("camera", lambda own: Camera(own["K"], int(own["width"]), int(own["height"]), own["model"], own["D"]))
    stamp = "sensor_stamp_ns"
    return State(result, camera, usable("provenance", lambda own: {**own, stamp: int(own.get(stamp, 0))}))


def _digest(data: dict[str, Any]) -> str:
    """Checksum of the content, whatever its layout: indenting the file anew does not damage it."""
    return hashlib.sha256(json.dumps(data, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def _difference(saved: Camera, camera: Camera) -> str:
    """The first difference, for a person: size before lens before numbers."""
    if (saved.width, saved.height) != (camera.width, camera.height):
        return f"{saved.width}x{saved.height}, now {camera.width}x{camera.height}"
    if saved.model != camera.model or len(saved.D) != len(camera.D):
        return f"{saved.model} with {len(saved.D)} coefficients, now {camera.model} with {len(camera.D)}"
    a, b = saved.K, camera.K
    return f"fx {a[0, 0]:g} fy {a[1, 1]:g} cx {a[0, 2]:g} cy {a[1, 2]:g}, now {b[0, 0]:g} {b[1, 1]:g} {b[0, 2]:g} {b[1, 2]:g}"
