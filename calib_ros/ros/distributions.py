"""What differs between distributions of ROS 2, Humble to Rolling, and between their middlewares; elsewhere no code asks."""

from __future__ import annotations

from importlib.metadata import version

from rclpy.utilities import get_rmw_implementation_identifier

try:
    from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks, UnsupportedEventTypeError
except ImportError:  # Humble
    from rclpy.qos_event import PublisherEventCallbacks, SubscriptionEventCallbacks, UnsupportedEventTypeError

__all__ = ["PublisherEventCallbacks", "SubscriptionEventCallbacks", "UnsupportedEventTypeError"]

IRON, KILTED = 4, 8  # the first major version of rclpy; ROS_DISTRO, which wheels do not set, would not tell
# How middlewares other than Fast DDS get large messages whole, by a part of the identifier; what none names is a DDS as well.
LARGE_MESSAGES = {
    "cyclonedds": "raise net.core.rmem_max, and SocketReceiveBufferSize in CYCLONEDDS_URI, to several messages",
    "zenoh": "set ZENOH_CONFIG_OVERRIDE='transport/shared_memory/enabled=true' for the driver, the node and rmw_zenohd",
    "": "give the driver's DDS a shared memory or socket buffers (net.core.rmem_max) that hold several messages",
}


def on_this_machine_only() -> dict[str, str]:
    """Environment of processes that are not to meet others over the network."""
    return {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"} if _rclpy() >= IRON else {"ROS_LOCALHOST_ONLY": "1"}


def profile_variables() -> tuple[str, ...]:
    """What may name Fast DDS's profile, the one to set first: Kilted takes the old name with a warning."""
    return ("FASTDDS_DEFAULT_PROFILES_FILE",) * (_rclpy() >= KILTED) + ("FASTRTPS_DEFAULT_PROFILES_FILE",)


def is_fast_dds() -> bool:
    """Whether the middleware is the one that the profiles of config/ are for."""
    return "fastrtps" in get_rmw_implementation_identifier()


def large_messages() -> str:
    """What to do for large messages where the middleware is another."""
    return next(text for part, text in LARGE_MESSAGES.items() if part in get_rmw_implementation_identifier())


def remark() -> str:
    """What a person should know of this middleware, in one line; "" for Fast DDS."""
    return "" if is_fast_dds() else f"{get_rmw_implementation_identifier()}: to receive large messages, {large_messages()}"


def where_nobody_publishes() -> str:
    """What to check where a topic has no publisher."""
    router = " and that rmw_zenohd runs" if "zenoh" in get_rmw_implementation_identifier() else ""
    return f"check the remapping and ROS_DOMAIN_ID{router}"


def _rclpy() -> int:
    return int(version("rclpy").partition(".")[0])
