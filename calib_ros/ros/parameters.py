"""ROS parameters: the configuration's own names (stage.field), and the node's settings."""

from __future__ import annotations

import array
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from calib_ros import se3
from calib_ros.config import STAGES, Config, load_stages, update
from calib_ros.errors import BadInputError, CalibrationError, ConfigError
from calib_ros.result import Result


@dataclass(frozen=True)
class Setting:
    """A node setting: default, meaning, allowed values (texts) or range (numbers)."""

    default: Any
    doc: str
    choices: tuple[str, ...] = ()
    low: float | None = None
    high: float | None = None


SETTINGS = {
    "image_transport": Setting("raw", "raw: sensor_msgs/Image; compressed: sensor_msgs/CompressedImage", ("raw", "compressed")),
    "image_is_rectified": Setting(False, "the image topic is rectified: use P of CameraInfo and no distortion"),
    "reliability": Setting(
        "best_effort",
        "QoS of the image and cloud subscriptions; best_effort receives from both kinds",
        ("best_effort", "reliable"),
    ),
    "camera_frame": Setting("", "name of the camera's optical frame; empty = the image's header.frame_id"),
    "lidar_frame": Setting("", "name of the LiDAR's frame; empty = the cloud's header.frame_id"),
    "state_file": Setting("", "the last good extrinsic is kept here and read at the next start; empty = not kept"),
    "initial_translation_m": Setting(
        [0.0, 0.0, 0.0], "initial T_camera_lidar: x, y, z; used if initial_quaternion_xyzw is given"
    ),
    "initial_quaternion_xyzw": Setting([0.0, 0.0, 0.0, 0.0], "initial T_camera_lidar: rotation x, y, z, w; all zero = not given"),
    "initial_from_tf": Setting(True, "take the initial extrinsic from /tf_static if no state and no parameters give it"),
    "nominal_yaw_deg": Setting(
        0.0, "without any other initial extrinsic the camera looks this far left of the LiDAR's +x axis", (), -180.0, 180.0
    ),
    "publish_tf": Setting(False, "publish the extrinsic on /tf_static"),
    "tf_parent": Setting(
        "camera", "parent of the published TF: camera (camera -> LiDAR) or lidar (LiDAR -> camera)", ("camera", "lidar")
    ),
    "overlay_period_s": Setting(1.0, "the overlay is drawn at most this often, and only when someone listens", (), 0.05, 3600.0),
}


@dataclass(frozen=True)
class Parameters:
    """All settings of SETTINGS by name, and the configuration."""

    settings: dict[str, Any]
    config: Config

    def __getitem__(self, name: str) -> Any:
        return self.settings[name]

    def initial(self) -> Result | None:
        """The initial extrinsic that the parameters give, or None."""
        t, q = self["initial_translation_m"], self["initial_quaternion_xyzw"]
        if not np.any(q):
            return None
        if len(t) != 3:
            raise BadInputError(f"initial_translation_m = {list(t)} must have 3 elements")
        T = se3.from_parts(se3.rotation_from_quaternion(q), t)
        return Result(se3.as_transform(T, "the initial extrinsic of the parameters"), "initial", "from the parameters")


def check_files(args: Sequence[str]) -> None:
    """Read every --params-file of a command line: rcl's own message names neither the line nor what to do.

    BadInputError for a file that cannot be read or is no YAML.
    """
    for flag, path in pairwise(args):
        if flag == "--params-file":
            load_stages(path)


def declare(node: Node) -> Parameters:
    """Declare everything with descriptors and ranges. ConfigError names a value that is out of range or of another type."""
    for name, setting in SETTINGS.items():
        _declare(node, name, setting.default, setting.doc, setting.low, setting.high, setting.choices, read_only=True)
    for stage, cls in STAGES.items():
        for f in dataclasses.fields(cls):
            default = list(f.default) if isinstance(f.default, tuple) else f.default
            meta = f.metadata
            _declare(node, f"{stage}.{f.name}", default, meta["doc"], meta["low"], meta["high"], meta["choices"], read_only=False)
    settings = {name: _checked_setting(name, setting, _value(node, name)) for name, setting in SETTINGS.items()}
    values = {
        stage: {f.name: _value(node, f"{stage}.{f.name}") for f in dataclasses.fields(cls)} for stage, cls in STAGES.items()
    }
    parameters = Parameters(settings, update(Config(), values))
    parameters.initial()  # a bad one is refused now, not when the first image comes
    return parameters


def _value(node: Node, name: str) -> Any:
    value = node.get_parameter(name).value
    return list(value) if isinstance(value, array.array) else value  # rclpy hands lists over as array.array


def _checked_setting(name: str, setting: Setting, value: Any) -> Any:
    """The value in the default's type, 10 as 10.0. ConfigError if it is of another, out of range or none of the choices."""
    if setting.choices and value not in setting.choices:
        raise ConfigError(f"{name} = {value!r} must be one of {', '.join(setting.choices)}")
    if isinstance(setting.default, (float, list)):
        numbers = value if isinstance(setting.default, list) else [value]
        if not isinstance(numbers, list) or any(isinstance(v, bool) or not isinstance(v, (int, float)) for v in numbers):
            kind = "a list of numbers" if isinstance(setting.default, list) else "a number"
            raise ConfigError(f"{name} = {value!r} must be {kind}")
        value = [float(v) for v in numbers] if isinstance(setting.default, list) else float(value)
    if setting.low is not None and setting.high is not None and not setting.low <= value <= setting.high:
        raise ConfigError(f"{name} = {value!r} is out of range [{setting.low:g}, {setting.high:g}]")
    return value


def _declare(node: Node, name: str, default: Any, doc: str, low: Any, high: Any, choices: Any, read_only: bool) -> None:
    # Dynamic typing where a person writes 10 for 10.0, which rclpy would refuse; the configuration checks the type itself.
    dynamic = isinstance(default, (float, list))
    descriptor = ParameterDescriptor(description=doc, read_only=read_only, dynamic_typing=dynamic)
    if choices:
        descriptor.additional_constraints = "one of " + ", ".join(choices)
    if low is not None and high is not None and type(default) is float:
        descriptor.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=float(high))]
    elif low is not None and high is not None and type(default) is int:
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
    try:
        node.declare_parameter(name, default, descriptor)
    except (InvalidParameterTypeException, InvalidParameterValueException) as error:
        allowed = f", range [{low:g}, {high:g}]" if low is not None and high is not None else ""
        kind = "list" if isinstance(default, list) else type(default).__name__
        raise ConfigError(f"parameter {name} (a {kind}{allowed}): {str(error).splitlines()[0]}") from None


def on_change(config: Config, changed: list[Parameter]) -> tuple[SetParametersResult, Config]:
    """Check a run-time change as a whole -> the answer to the caller, and the configuration from now on."""
    stages: dict[str, dict[str, Any]] = {}
    for p in changed:
        stage, dot, name = p.name.partition(".")
        if dot and stage in STAGES:
            # rclpy hands lists over as array.array
            stages.setdefault(stage, {})[name] = list(p.value) if isinstance(p.value, array.array) else p.value
    try:
        return SetParametersResult(successful=True), update(config, stages)
    except CalibrationError as error:
        return SetParametersResult(successful=False, reason=str(error)), config
