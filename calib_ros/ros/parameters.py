"""ROS parameters: the configuration's own names (stage.field), and the node's settings."""

from __future__ import annotations

import array
import dataclasses
import difflib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from calib_ros import se3
from calib_ros.config import Config, load_stages, preset, stages, update
from calib_ros.config.options import checked, option
from calib_ros.config.removed import REMOVED, notices
from calib_ros.errors import ConfigError
from calib_ros.export import DESCRIPTIONS, WRITABLE
from calib_ros.extensions import PRESETS, names
from calib_ros.image.mask import check_mask
from calib_ros.online.black_box import KINDS
from calib_ros.result import INITIAL, Consumer, InitialSource, Result, parse_consumers

# Prefixes of the parameters that every ROS node has.
OF_EVERY_NODE = ("use_sim_time", "start_type_description_service", "qos_overrides.")


# The node's own settings, beside the constants of the stages.
SETTINGS: dict[str, dataclasses.Field[Any]] = {
    "preset": option(
        "",
        "configuration to begin with instead of the defaults: thesis = the thesis's own system; parameters given beside it hold "
        "before it; empty = none",
        choices=("", *names(PRESETS)),
    ),
    "rig_file": option(
        "",
        "description of a rig of several cameras and LiDARs, rig.yaml; every pair then has its topics and services below "
        "~/CAMERA/LIDAR, and ~/rig says where all sensors are; empty = one pair",
    ),
    "image_transport": option(
        "raw",
        "type of the image topic: raw = sensor_msgs/Image, compressed = sensor_msgs/CompressedImage",
        choices=("raw", "compressed"),
    ),
    "image_is_rectified": option(
        False, "the image topic is rectified: use P of CameraInfo and no distortion; a change discards the keyframes"
    ),
    "reliability": option(
        "auto",
        "QoS of the image, cloud and CameraInfo subscriptions: auto = reliable where all publishers are, else best effort, which "
        "receives from both kinds",
        choices=("auto", "best_effort", "reliable"),
    ),
    "camera_frame": option("", "name of the camera's optical frame; empty = the image's header.frame_id"),
    "lidar_frame": option("", "name of the LiDAR's frame; empty = the cloud's header.frame_id"),
    "vehicle": option(
        "", "name of the vehicle, for the hardware_id of /diagnostics before the names of both frames; empty = none"
    ),
    "motion_source": option(
        "none",
        "source of the vehicle's velocity that online.max_turn_deg_s limits: odom = topic odom (nav_msgs/Odometry), "
        "imu (sensor_msgs/Imu, turn rate only), twist (geometry_msgs/TwistStamped); none = estimated from the scans if possible",
        choices=("none", "odom", "imu", "twist"),
    ),
    "state_file": option(
        "",
        "file that the last accepted extrinsic is written to and read from at the next start; empty = none; a change takes "
        "effect at the next accepted estimate",
    ),
    "initial_translation_m": option(
        (0.0,) * 3, "initial T_camera_lidar: translation x, y, z, m; used if initial_quaternion_xyzw is given", length=3
    ),
    "initial_quaternion_xyzw": option((0.0,) * 4, "initial T_camera_lidar: rotation x, y, z, w; all zero = not given"),
    "initial_from_tf": option(True, "take the initial extrinsic from /tf_static if no state and no parameters give it"),
    "nominal_yaw_deg": option(
        0.0,
        "yaw of the camera to the left of the LiDAR's +x axis without any other initial extrinsic, deg",
        low=-180.0,
        high=180.0,
    ),
    "publish_tf": option(False, "publish the extrinsic on /tf_static"),
    "tf_parent": option(
        "camera",
        "parent of the published TF: camera (camera -> LiDAR) or lidar (LiDAR -> camera); with tf_child, the name of its parent",
    ),
    "tf_child": option(
        "",
        "child of an edge of the TF tree, anywhere between the sensors, that is corrected instead; empty = the sensor that is "
        "not tf_parent",
    ),
    "publish_period_s": option(
        1.0, "~/extrinsic is published at least this often, s; 2.5 periods are its DDS deadline", low=0.05, high=60.0
    ),
    "max_data_age_s": option(
        5.0, "without a usable pair of image and cloud for this long the extrinsic is no longer usable, s", low=0.5, high=3600.0
    ),
    "consumers": option(
        (), "users of the extrinsic and the largest errors that each can live with, 'NAME DEG M'; ~/extrinsic says who may use it"
    ),
    "overlay_period_s": option(
        1.0,
        "shortest time between two overlays, s; 0 = one for every pair; drawn only while there is a subscriber",
        low=0.0,
        high=3600.0,
    ),
    "export.on_converged": option(
        (),
        "files that a converged extrinsic is written to; by their names: .json = result, .urdf and .xacro = origin of "
        "export.joint, .yaml = Autoware's sensor_kit_calibration.yaml; the former file is kept as NAME.former",
    ),
    "export.joint": option(
        "", "joint of the robot's description in export.on_converged, between camera and LiDAR; those of a rig are found"
    ),
    "capture_dir": option(
        "", "folder that captures, the raw messages of the newest keyframes, are written to; of one node; empty = off"
    ),
    "capture_frames": option(
        0,
        "keyframes whose raw messages are kept in memory for captures, 0 = none; each takes the size of one image and one cloud",
        low=0,
        high=200,
    ),
    "capture.on": option(
        (), "statuses at which a capture is written, as by a black box: " + ", ".join(KINDS) + "; empty = none", choices=KINDS
    ),
}
# Those that may change while the node runs, as all constants of the stages may.
LIVE = {"image_is_rectified", "reliability", "state_file", "publish_tf", "tf_parent", "tf_child", "max_data_age_s"}
LIVE |= {"consumers", "overlay_period_s", "capture_dir", "capture_frames", "capture.on"}
LIVE |= {"export.on_converged", "export.joint", "vehicle"}


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
        T = se3.from_parts(se3.rotation_from_quaternion(q), t)
        return Result(
            se3.as_transform(T, "the initial extrinsic of the parameters"),
            INITIAL,
            "from the parameters",
            origin=InitialSource.PARAMETERS,
        )

    def consumers(self) -> tuple[Consumer, ...]:
        """Those that state tolerances."""
        return parse_consumers(self["consumers"])

    def check(self) -> None:
        """ConfigError for settings that contradict each other, an initial extrinsic that is none, or consumers without form."""
        self.initial()
        self.consumers()
        if self["capture.on"] and not (self["capture_dir"] and self["capture_frames"]):
            raise ConfigError(
                "capture.on needs a folder in capture_dir and in capture_frames how many keyframes are kept, such as 20"
            )
        files = self["export.on_converged"]
        for name in files:
            if not name.lower().endswith(WRITABLE):
                raise ConfigError(f"export.on_converged: the kind of {name!r} is none of {', '.join(WRITABLE)}")
        if not (self["export.joint"] or self["rig_file"]) and any(name.lower().endswith(DESCRIPTIONS) for name in files):
            raise ConfigError(
                "export.on_converged has a robot's description: export.joint must name its joint between the sensors"
            )
        if not self["tf_child"] and self["tf_parent"] not in ("camera", "lidar"):
            raise ConfigError(f"tf_parent = {self['tf_parent']!r} must be camera or lidar, or tf_child must name its child")

    def to_dict(self) -> dict[str, Any]:
        """Flat {name: value} of everything, as a parameter file has it."""
        stages = self.config.to_dict().items()
        values = {f"{stage}.{name}": value for stage, fields in stages for name, value in fields.items()}
        everything = {**self.settings, **values}
        return {name: list(value) if isinstance(value, tuple) else value for name, value in everything.items()}


def check_files(args: Sequence[str]) -> None:
    """Read every --params-file of a command line: rcl's own message names neither the line nor what to do.

    BadInputError for a file that cannot be read or is no YAML.
    """
    for flag, path in pairwise(args):
        if flag == "--params-file":
            load_stages(path)


def declare(node: Node) -> Parameters:
    """Declare everything with descriptors and ranges. What is declared already keeps its value: a managed node may be configured
    again. ConfigError names a value that is out of range or of another type."""
    for name, f in SETTINGS.items():
        _declare(node, name, f.default, f, read_only=name not in LIVE)
    chosen, names = preset(node.get_parameter("preset").value).to_dict(), list(SETTINGS)
    for stage, cls in stages().items():
        for f in dataclasses.fields(cls):
            names.append(f"{stage}.{f.name}")
            _declare(node, names[-1], chosen[stage][f.name], f)
    parameters = _parameters({name: _plain(node.get_parameter(name).value) for name in names})
    check_mask(parameters.config.image, None)
    return parameters


def _parameters(values: Mapping[str, Any]) -> Parameters:
    """From the values of all, by name. Raises a CalibrationError: a bad one is refused now, not with the first image."""
    settings = {name: checked(name, values[name], f) for name, f in SETTINGS.items()}
    of_stages = {stage: {f.name: values[f"{stage}.{f.name}"] for f in dataclasses.fields(cls)} for stage, cls in stages().items()}
    parameters = Parameters(settings, update(Config(), of_stages))
    parameters.check()
    return parameters


def misspelt(given: Mapping[str, Any], declared: Iterable[str]) -> list[str]:
    """One line for each name given that no parameter has, with the nearest that there is; one for all that have been removed.
    given: name -> value."""
    known, lines = sorted(declared), notices(given)
    for name in sorted(set(given) - REMOVED.union(known)):
        if name.startswith(OF_EVERY_NODE):
            continue
        near = difflib.get_close_matches(name, known, 1)
        lines.append(
            f"parameter '{name}' is unknown and has no effect; "
            + (f"did you mean '{near[0]}'?" if near else "config/calib_ros.yaml lists all there are")
        )
    return lines


def replaced(name: str, config: Config, given: Iterable[str]) -> list[str]:
    """A line that names what the preset `name` would set, and parameters that are given set otherwise; no line if nothing."""
    ours, own = preset(name).to_dict(), config.to_dict()
    differing = (f"{stage}.{field}" for stage in own for field in own[stage] if own[stage][field] != ours[stage][field])
    other = sorted(set(differing) & set(given))
    return [f"the preset {name} is changed by the parameters given: {', '.join(other)}"] if name and other else []


def changed(parameters: Parameters, given: list[Parameter]) -> Parameters:
    """All parameters after a change at run time, which is checked as a whole, but for the mask. Raises a CalibrationError."""
    now = parameters.to_dict()
    if unknown := misspelt({p.name: p.value for p in given}, now):
        raise ConfigError("; ".join(unknown))
    return _parameters(now | {p.name: _plain(p.value) for p in given if p.name in now})


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, array.array) else value  # rclpy hands lists over as array.array


def _declare(node: Node, name: str, default: Any, f: dataclasses.Field[Any], read_only: bool = False) -> None:
    if node.has_parameter(name):
        return
    default, low, high = list(default) if isinstance(default, tuple) else default, f.metadata["low"], f.metadata["high"]
    # Dynamic typing where a person writes 10 for 10.0, which rclpy would refuse; the configuration checks the type itself.
    dynamic = isinstance(default, (float, list))
    descriptor = ParameterDescriptor(description=f.metadata["doc"], read_only=read_only, dynamic_typing=dynamic)
    bounded = low is not None and high is not None
    if f.metadata["choices"]:
        descriptor.additional_constraints = "one of " + ", ".join(f.metadata["choices"])
    if bounded and isinstance(default, list):  # ROS has no ranges for lists
        descriptor.additional_constraints = f"each in [{low:g}, {high:g}]"
    elif bounded and type(default) is float:
        descriptor.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=float(high))]
    elif bounded and type(default) is int:
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
    try:
        node.declare_parameter(name, default, descriptor)
    except (InvalidParameterTypeException, InvalidParameterValueException) as error:
        allowed = f", range [{low:g}, {high:g}]" if bounded else ""
        kind = "list" if isinstance(default, list) else type(default).__name__
        raise ConfigError(f"parameter {name} (a {kind}{allowed}): {str(error).splitlines()[0]}") from None
