"""The last good extrinsic on disk: survives restarts, refused when it belongs to other sensors."""

from __future__ import annotations

import json
from pathlib import Path

from calib_ros.camera import Camera
from calib_ros.errors import BadInputError
from calib_ros.files import write_atomically
from calib_ros.result import Result, load, parse


def save_state(path: str | Path, result: Result, camera: Camera) -> None:
    """Write the result with the camera that it holds for, atomically. BadInputError if the folder cannot be written."""
    data = result.to_dict()
    data["camera"] = {
        "width": camera.width,
        "height": camera.height,
        "K": camera.K.tolist(),
        "model": camera.model,
        "D": camera.D.tolist(),
    }
    write_atomically(path, (json.dumps(data, indent=1) + "\n").encode())


def load_state(path: str | Path, camera: Camera, camera_frame: str, lidar_frame: str) -> Result:
    """The saved result. BadInputError with the reason if it is unreadable, of other frames or of another camera."""
    result = load(path)
    if (result.camera_frame, result.lidar_frame) != (camera_frame, lidar_frame):
        raise BadInputError(
            f"saved state {path} is for {result.lidar_frame} -> {result.camera_frame}, "
            f"but the sensors are {lidar_frame} -> {camera_frame}; delete it or name another state_file"
        )
    saved = _saved_camera(Path(path))
    if saved is not None and saved != camera:
        raise BadInputError(
            f"saved state {path} was estimated with other camera intrinsics; delete it or name another state_file"
        )
    return result


def _saved_camera(path: Path) -> Camera | None:
    text = path.read_text(encoding="utf-8")
    parse(text, str(path))
    try:
        data = json.loads(text).get("camera")
    except ValueError:
        return None
    if data is None:
        return None
    try:
        return Camera(data["K"], int(data["width"]), int(data["height"]), data["model"], data["D"])
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError):
        raise BadInputError(f"saved state {path} holds no usable camera; delete it or name another state_file") from None
