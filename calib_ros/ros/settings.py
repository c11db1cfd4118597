"""The node's own settings, beside the constants of the stages: one place for defaults, meaning and ranges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from calib_ros.errors import ConfigError


@dataclass(frozen=True)
class Setting:
    """A node setting: default, meaning, allowed values (texts) or range (numbers); live = it may change while the node runs."""

    default: Any
    doc: str
    choices: tuple[str, ...] = ()
    low: float | None = None
    high: float | None = None
    live: bool = False


SETTINGS = {
    "image_transport": Setting("raw", "raw: sensor_msgs/Image; compressed: sensor_msgs/CompressedImage", ("raw", "compressed")),
    "image_is_rectified": Setting(
        False,
        "the image topic is rectified: use P of CameraInfo and no distortion; a change starts the keyframes anew",
        live=True,
    ),
    "reliability": Setting(
        "auto",
        "QoS of the image, cloud and CameraInfo subscriptions: auto = reliable where all publishers are, else best effort, which "
        "receives from both kinds",
        ("auto", "best_effort", "reliable"),
        live=True,
    ),
    "camera_frame": Setting("", "name of the camera's optical frame; empty = the image's header.frame_id"),
    "lidar_frame": Setting("", "name of the LiDAR's frame; empty = the cloud's header.frame_id"),
    "motion_source": Setting(
        "none",
        "what tells how fast the vehicle moves, for online.max_speed and online.max_turn_deg_s: topic odom (nav_msgs/Odometry), "
        "imu (sensor_msgs/Imu, turns only) or twist (geometry_msgs/TwistStamped); none = the scans themselves, where they can",
        ("none", "odom", "imu", "twist"),
    ),
    "state_file": Setting(
        "",
        "the last good extrinsic is kept here and read at the next start; empty = not kept; a change holds from the next "
        "accepted estimate on",
        live=True,
    ),
    "initial_translation_m": Setting(
        [0.0, 0.0, 0.0], "initial T_camera_lidar: x, y, z; used if initial_quaternion_xyzw is given"
    ),
    "initial_quaternion_xyzw": Setting([0.0, 0.0, 0.0, 0.0], "initial T_camera_lidar: rotation x, y, z, w; all zero = not given"),
    "initial_from_tf": Setting(True, "take the initial extrinsic from /tf_static if no state and no parameters give it"),
    "nominal_yaw_deg": Setting(
        0.0, "without any other initial extrinsic the camera looks this far left of the LiDAR's +x axis", (), -180.0, 180.0
    ),
    "publish_tf": Setting(False, "publish the extrinsic on /tf_static", live=True),
    "tf_parent": Setting(
        "camera",
        "parent of the published TF: camera (camera -> LiDAR) or lidar (LiDAR -> camera)",
        ("camera", "lidar"),
        live=True,
    ),
    "overlay_period_s": Setting(
        1.0, "the overlay is drawn at most this often, and only when someone listens", (), 0.05, 3600.0, live=True
    ),
    "capture_dir": Setting(
        "", "folder that ~/capture writes the raw messages of the newest keyframes to; empty = it writes nothing", live=True
    ),
    "capture_frames": Setting(
        0,
        "keyframes whose raw messages are kept in memory for ~/capture, 0 = none; each takes the size of one image and one cloud "
        "(3 MB at 1.4 Mpixel grey and 64 rings: 20 take 66 MB)",
        (),
        0,
        200,
        live=True,
    ),
}


def checked(name: str, value: Any) -> Any:
    """The value of a setting in its default's type, 10 as 10.0. ConfigError if it is of another, out of range or no choice."""
    setting = SETTINGS[name]
    if setting.choices and value not in setting.choices:
        raise ConfigError(f"{name} = {value!r} must be one of {', '.join(setting.choices)}")
    if isinstance(setting.default, (float, list)):
        numbers = value if isinstance(setting.default, list) else [value]
        if not isinstance(numbers, list) or any(isinstance(v, bool) or not isinstance(v, (int, float)) for v in numbers):
            kind = "a list of numbers" if isinstance(setting.default, list) else "a number"
            raise ConfigError(f"{name} = {value!r} must be {kind}")
        value = [float(v) for v in numbers] if isinstance(setting.default, list) else float(value)
    elif type(value) is not type(setting.default):
        raise ConfigError(f"{name} = {value!r} must be of type {type(setting.default).__name__}")
    if setting.low is not None and setting.high is not None and not setting.low <= value <= setting.high:
        raise ConfigError(f"{name} = {value!r} is out of range [{setting.low:g}, {setting.high:g}]")
    return value
