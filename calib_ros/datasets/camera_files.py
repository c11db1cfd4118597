"""Files of a camera's intrinsics as ROS, Kalibr, basalt and OpenCV write them."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from calib_ros import io, se3
from calib_ros.arrays import Matrix
from calib_ros.camera import Camera
from calib_ros.errors import BadInputError
from calib_ros.lens import LENSES, lens_model
from calib_ros.messages import decode_camera_info
from calib_ros.messages.wire import shown

WANTED = (
    "what ROS camera_calibration writes: image_width, image_height, camera_matrix, distortion_coefficients; "
    "or a file of Kalibr, basalt or OpenCV"
)
FILES = ("calibration.yaml", "calibration.yml", "calibration.json", "calibration.xml", "camchain.yaml")
OF_KALIBR = {"pinhole": 0, "omni": 1, "ds": 2, "eucm": 2}  # camera_model -> how many intrinsics are before the focal lengths
# What ROS, samples of OpenCV and Autoware.AI call the same, without case and underlines.
MATRIX = ("cameramatrix", "cameramat", "k", "m1", "k1")
DISTORTION = ("distortioncoefficients", "distcoeffs", "distcoeff", "d", "d1")
SIZE = ("imagesize", "resolution")
SIDES = (("imagewidth", "width"), ("imageheight", "height"))


def camera_file(folder: Path) -> Path:
    """The file of a folder that holds its camera: the first of FILES that is there, else one that Kalibr named."""
    found = [folder / name for name in FILES if (folder / name).is_file()]
    return next(iter(found or sorted(folder.glob("*camchain*.yaml"))), folder / FILES[0])


def read_camera(
    path: Path, choice: int | str | None, image_size: Callable[[], tuple[int, int]], rectified: bool = False
) -> tuple[Camera, Matrix | None, str, list[str]]:
    """A camera of a file, T_camera_lidar (4, 4) if the file has one, the camera's name, and those of others in the file.

    choice: its name or number where there are several; None = the first. image_size: gives width and height, px, where the file
    has none. rectified: the images are; P is their camera, else K. Raises BadInputError, with the file and what to do.
    """
    if not path.is_file():
        raise BadInputError(f"calibration {path} is missing; put there {WANTED}")
    try:
        values = _values(io.read_text(path, "calibration", WANTED))
    except (yaml.YAMLError, ElementTree.ParseError, ValueError, RecursionError) as error:
        kind = "XML" if isinstance(error, ElementTree.ParseError) else "YAML"
        raise BadInputError(f"calibration {path} is not valid {kind}{io.what_is_wrong(error)}; give {WANTED}") from None
    if not isinstance(values, dict):
        raise BadInputError(f"calibration {path} has no names; give {WANTED}")
    try:
        cameras = _cameras(values)
        choice = 0 if choice is None or len(cameras) == 1 else choice
        name = (dict(enumerate(cameras)) | {name: name for name in cameras}).get(choice)
        if name is None:
            raise BadInputError(f"there is no camera {shown(choice)}; there are {', '.join(map(shown, cameras)) or 'none'}")
        info, P = _info(cameras[name], image_size), cameras[name].get("projection_matrix")
        info["p"] = _numbers(P, "projection_matrix", 12) if rectified and P else np.insert(info["k"], (3, 6, 9), 0.0)
        camera = decode_camera_info(SimpleNamespace(**info), rectified)
        T = values.get("T_camera_lidar")
        reference = None if T is None else se3.as_transform(T, "T_camera_lidar")
        return camera, reference, shown(name), [shown(other) for other in cameras if other != name]
    except BadInputError as error:
        raise BadInputError(f"calibration {path}: {str(error).removeprefix('CameraInfo: ')}") from error
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise BadInputError(f"calibration {path} is incomplete ({shown(error)}); give {WANTED}") from None


def _values(text: str) -> Any:
    """What a YAML, JSON or XML file holds."""
    start = text.lstrip()
    if start.startswith("{"):
        return json.loads(text)
    if not start.startswith("<"):
        return io.load(re.sub(r"\A\s*%YAML.*\n", "", text))  # OpenCV's "%YAML:1.0" is no directive of YAML
    if "<!DOCTYPE" in text:
        raise ValueError
    return _of_xml(ElementTree.fromstring(text))


def _of_xml(node: ElementTree.Element) -> Any:
    if len(node):
        return {child.tag: _of_xml(child) for child in node}
    words = (node.text or "").split()
    return io.load(words[0]) if len(words) == 1 else words


def _cameras(values: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """What the file holds of each camera, by name."""
    if isinstance(values.get("value0"), dict):
        lenses = zip(values["value0"]["intrinsics"], values["value0"]["resolution"], strict=True)
        return {f"cam{n}": {**lens, "resolution": size} for n, (lens, size) in enumerate(lenses)}
    chain = {name: own for name, own in values.items() if isinstance(own, dict) and "camera_model" in own}
    return chain or {str(values.get("camera_name") or "camera"): values}


def _info(own: dict[str, Any], image_size: Callable[[], tuple[int, int]]) -> dict[str, Any]:
    """The fields of CameraInfo."""
    model, distortion = "", str(own.get("distortion_model") or "none")
    if "camera_type" in own:  # basalt
        model, lens = str(own["camera_type"]), own["intrinsics"]
        numbers = [lens[name] for name in ("fx", "fy", "cx", "cy")]
        D = [lens[name] for name in LENSES[lens_model(model)].names if name in lens] if lens_model(model) in LENSES else []
    elif "camera_model" in own:  # Kalibr
        model, D = str(own["camera_model"]), list(own.get("distortion_coeffs") or ()) if distortion != "none" else []
        if model not in OF_KALIBR or (D and (model, distortion) != ("omni", "radtan") and model != "pinhole"):
            raise BadInputError(f"{shown(model)} with {shown(distortion)} is not supported; rectify the images")
        before = OF_KALIBR[model]
        D, numbers = [*own["intrinsics"][:before], *D], own["intrinsics"][before:]
        model = distortion if model == "pinhole" else model
    else:
        return _of_ros(own, image_size)
    fx, fy, cx, cy = _numbers(numbers, "intrinsics", 4)
    width, height = (_pixels(side, "resolution") for side in own["resolution"])
    K = np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1])
    return {"width": width, "height": height, "k": K, "d": _numbers(D, "distortion"), "distortion_model": model}


def _of_ros(values: dict[str, Any], image_size: Callable[[], tuple[int, int]]) -> dict[str, Any]:
    """The same of ROS, OpenCV and Autoware.AI. Without a name of the model it is that of OpenCV with so many coefficients."""
    plain = {str(name).lower().replace("_", ""): name for name in values}

    def of(names: tuple[str, ...], usual: str) -> tuple[str, Any]:
        name = next((plain[name] for name in names if name in plain), usual)
        return name, values.get(name)

    sides = [of(names, usual) for names, usual in zip(SIDES, ("image_width", "image_height"), strict=True)]
    if not any(name in values for name, _ in sides):
        both, size = of(SIZE, "")
        sides = [(both, side) for side in (image_size() if size is None else size)]
    width, height = (_pixels(side, name) for name, side in sides)
    name, D = of(DISTORTION, "distortion_coefficients")
    D = _numbers(D, name) if D else np.zeros(0)
    model = values.get("distortion_model") or ("equidistant" if values.get("fisheye_model") else "")
    if "xi" in values:
        model, D = "omnidir", np.r_[_numbers(values["xi"], "xi", 1), D]
    if not model and len(D) > 5:
        model = "rational_polynomial"
    name, K = of(MATRIX, "camera_matrix")
    return {"width": width, "height": height, "k": _numbers(K, name, 9), "d": D, "distortion_model": str(model)}


def _pixels(value: Any, name: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise BadInputError(f"{name} must be a whole number of pixels, got {shown(value)}")
    return value


def _numbers(value: Any, name: str, count: int | None = None) -> Matrix:
    """The numbers of a matrix {rows, cols, data}, a list or one number."""
    data = value.get("data") if isinstance(value, dict) else value
    try:
        numbers = np.asarray(data, float).ravel() if data is not None else None
    except (TypeError, ValueError, OverflowError):
        numbers = None
    if numbers is None or not np.isfinite(numbers).all() or (count is not None and len(numbers) != count):
        of = f"{count} numbers" if count else "numbers"
        raise BadInputError(f"{name} must have rows, cols and data: [{of}], as ROS camera_calibration writes it")
    return numbers
