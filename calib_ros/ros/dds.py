"""The Fast DDS profile for large messages, and where the installed config files lie."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from pathlib import Path

from calib_ros.errors import MissingDependencyError

# The name changed with Kilted, which warns about the old one; Jazzy and older do not know the new one.
PROFILE_VARIABLES = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")
OLD_DISTRIBUTIONS = ("humble", "iron", "jazzy")


def config_file(name: str) -> Path:
    """Path of a file of the config folder: in the source tree, the share folder of a ROS install, or sys.prefix.

    MissingDependencyError if the installation lacks it.
    """
    source_tree = Path(__file__).resolve().parents[2] / "config" / name
    if source_tree.exists():
        return source_tree
    candidates = [
        Path(prefix) / "share/calib_ros/config" / name for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(":") if prefix
    ]
    candidates.append(Path(sys.prefix) / "share/calib_ros/config" / name)
    for path in candidates:
        if path.exists():
            return path
    raise MissingDependencyError(f"{name} is not installed with calib_ros; build the package anew")


def use_large_message_profile() -> None:
    """Let Fast DDS move images and clouds through shared memory whole, unless the user has a profile of their own.

    Its default segment is smaller than one image, and best-effort messages get lost. Must run before rclpy.init().
    """
    if not any(name in os.environ for name in PROFILE_VARIABLES):
        name = PROFILE_VARIABLES[os.environ.get("ROS_DISTRO", "") in OLD_DISTRIBUTIONS]
        # The node works without; large best-effort messages may then get lost, as with any other node.
        with suppress(MissingDependencyError):
            os.environ[name] = str(config_file("fastdds_profile.xml"))
