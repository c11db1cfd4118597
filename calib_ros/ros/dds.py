"""The Fast DDS profiles for large messages, where the installed config files lie, and the QoS of what late joiners get."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from pathlib import Path

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from calib_ros.errors import MissingDependencyError
from calib_ros.ros.distributions import is_fast_dds, large_messages, profile_variables

PROFILE, LARGE_PROFILE = "fastdds_profile.xml", "fastdds_profile_large.xml"
PROFILE_BYTES = 6_000_000  # the largest message that PROFILE is made for: two of them and their like fit its memory
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)

_set_here = False  # a profile, by this process for itself


def config_file(name: str) -> Path:
    """Path of a file of the config folder: in the source tree, the share folder of a ROS install, or sys.prefix.

    MissingDependencyError if the installation lacks it.
    """
    prefixes = filter(None, [*os.environ.get("AMENT_PREFIX_PATH", "").split(":"), sys.prefix])
    folders = [Path(__file__).resolve().parents[2] / "config", *(Path(p) / "share/calib_ros/config" for p in prefixes)]
    for folder in folders:
        if (folder / name).exists():
            return folder / name
    raise MissingDependencyError(f"{name} is not installed with calib_ros; build the package anew")


def use_large_message_profile() -> None:
    """Let Fast DDS move images and clouds through shared memory whole, unless the user has a profile of their own.

    Its default segment is smaller than one image, and best-effort messages get lost. Must run before rclpy.init().
    """
    global _set_here
    if not given_profile():
        # The node works without; large best-effort messages may then get lost, as with any other node.
        with suppress(MissingDependencyError):
            os.environ[profile_variables()[0]] = str(config_file(PROFILE))
            _set_here = True


def given_profile() -> str:
    """The profile that the user has set for this process, and most likely for drivers; "" if none."""
    return "" if _set_here else next((os.environ[name] for name in profile_variables() if name in os.environ), "")


def profile_for_sender(message_bytes: int) -> str:
    """What to set where the driver of messages of this size runs, so that they arrive whole; "" where the user has done that
    already. 0 bytes = of unknown size."""
    if not is_fast_dds():
        return large_messages()
    name, given = PROFILE if 0 < message_bytes <= PROFILE_BYTES else LARGE_PROFILE, given_profile()
    if Path(given).name in (name, LARGE_PROFILE):
        return ""
    if given and Path(given).name != PROFILE:
        size = f" of {message_bytes / 1e6:.3g} MB" if message_bytes else ""
        return f"let the profile {given} hold several messages{size} in shared memory"
    try:
        path = str(config_file(name))
    except MissingDependencyError:
        path = f"config/{name}"
    return f"start its driver with {profile_variables()[0]}={path}"
