"""Publishes a bag's messages at the pace they were recorded. The serialised bytes go out as they are."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rclpy
from builtin_interfaces.msg import Time
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock

from calib_ros.datasets.bag_file import BagFile
from calib_ros.errors import BadInputError, MissingDependencyError
from calib_ros.frame import NANOSECONDS
from calib_ros.ros.shared_files import use_large_message_profile

SENSOR_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/PointCloud2")
LATCHED_TYPES = ("tf2_msgs/msg/TFMessage",)
CLOCK_PERIOD = NANOSECONDS // 100
SETTLE_S = 1.0  # from the first sight of all subscribers to the first message


@dataclass(frozen=True)
class PlayOptions:
    """rate: times the recorded pace. loop: start over at the end. clock: publish /clock. wait_s: seconds to wait until every
    image and cloud topic has a subscriber. linger_s: seconds to stay after the last message, so that late joiners get
    latched topics and nothing in flight is lost."""

    rate: float = 1.0
    loop: bool = False
    clock: bool = False
    wait_s: float = 10.0
    linger_s: float = 1.0

    def __post_init__(self) -> None:
        for name, low, high in (("rate", 0.01, 1000.0), ("wait_s", 0.0, 3600.0), ("linger_s", 0.0, 3600.0)):
            if not low <= getattr(self, name) <= high:
                raise BadInputError(f"{name} = {getattr(self, name)!r} is out of range [{low:g}, {high:g}]")


def message_class(type_name: str) -> Any:
    """'sensor_msgs/msg/Image' -> the Python class. MissingDependencyError if the package is not installed."""
    package, _, name = type_name.partition("/msg/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError):
        raise MissingDependencyError(f"{type_name} is not installed; install the ROS package {package}") from None


def _sleep(seconds: float, stopped: Callable[[], bool]) -> None:
    end = time.monotonic() + seconds
    while not stopped() and time.monotonic() < end:
        time.sleep(0.02)


class Player:
    """Publishers for all topics of a bag whose types are installed; `skipped` names the others."""

    def __init__(self, node: Node, bag: BagFile, options: PlayOptions) -> None:
        self.node, self.bag, self.options = node, bag, options
        self.skipped: list[str] = []
        self.published: dict[str, int] = {}
        self._publishers: dict[str, Publisher] = {}
        self._sensors: list[Publisher] = []
        for topic in bag.topics.values():
            try:
                cls = message_class(topic.type)
            except MissingDependencyError as error:
                self.skipped.append(f"{topic.name}: {error}")
                continue
            latched = topic.type in LATCHED_TYPES and "static" in topic.name
            durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
            qos = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE, durability=durability)
            publisher = node.create_publisher(cls, topic.name, qos)
            self._publishers[topic.name] = publisher
            if topic.type in SENSOR_TYPES:
                self._sensors.append(publisher)
        if not any(bag.topics[name].count for name in self._publishers):
            raise BadInputError(f"bag {bag.path} holds no message that can be published; see calib-ros info")
        self._clock = node.create_publisher(Clock, "/clock", 10) if options.clock else None

    def wait_for_subscribers(self, stopped: Callable[[], bool]) -> bool:
        """Wait until every image and cloud topic has a subscriber; False when the time is up first."""
        end = time.monotonic() + self.options.wait_s
        while not stopped():
            if all(publisher.get_subscription_count() for publisher in self._sensors):
                # Discovery has two sides: the subscribers may not know us yet; best-effort ones would miss the first messages.
                _sleep(SETTLE_S, stopped)
                return True
            if time.monotonic() >= end:
                return False
            time.sleep(0.02)
        return False

    def play(self, stopped: Callable[[], bool], progress: Callable[[float], None] | None = None) -> None:
        """Publish the bag once, or for ever with `loop`, until `stopped` says True."""
        while not stopped():
            self._play_once(stopped, progress)
            if not self.options.loop:
                return

    def _play_once(self, stopped: Callable[[], bool], progress: Callable[[float], None] | None) -> None:
        started = time.monotonic()
        first: int | None = None
        clock_at = 0
        for name, stamp, data in self.bag.raw(list(self._publishers)):
            first = stamp if first is None else first
            due = started + (stamp - first) / NANOSECONDS / self.options.rate
            while not stopped():
                now = time.monotonic()
                if self._clock is not None:
                    recorded = min(first + int((now - started) * self.options.rate * NANOSECONDS), stamp)
                    if recorded >= clock_at:
                        self._publish_clock(recorded)
                        clock_at = recorded + CLOCK_PERIOD
                if now >= due:
                    break
                time.sleep(min(due - now, 0.01))
            if stopped():
                return
            self._publishers[name].publish(bytes(data))
            self.published[name] = self.published.get(name, 0) + 1
            if progress is not None and self.bag.duration_s > 0:
                progress(min((stamp - first) / NANOSECONDS / self.bag.duration_s, 1.0))

    def _publish_clock(self, stamp: int) -> None:
        assert self._clock is not None
        seconds, rest = divmod(stamp, NANOSECONDS)
        self._clock.publish(Clock(clock=Time(sec=seconds, nanosec=rest)))


def play(
    path: str,
    options: PlayOptions,
    report: Callable[[str], None],
    progress: Callable[[float], None] | None = None,
    domain_id: int | None = None,
) -> dict[str, int]:
    """Play a bag as a process of its own until its end or SIGINT/SIGTERM; returns the messages published per topic."""
    use_large_message_profile()
    bag = BagFile(Path(path))
    rclpy.init(domain_id=domain_id)

    def stopped() -> bool:
        return not rclpy.ok()

    node = rclpy.create_node("calib_player")
    player = None
    try:
        player = Player(node, bag, options)
        for text in player.skipped:
            report(f"not played: {text}")
        if options.wait_s and not player.wait_for_subscribers(stopped) and not stopped():
            report(f"no subscriber on every image and cloud topic after {options.wait_s:g} s; playing all the same")
        player.play(stopped, progress)
        _sleep(options.linger_s, stopped)
    except KeyboardInterrupt:
        pass
    except Exception:
        if rclpy.ok():
            raise  # else: a signal took the context away meanwhile
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
        bag.close()
    return player.published if player is not None else {}
