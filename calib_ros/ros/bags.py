"""`calib-ros play`: publishes a bag."""

from __future__ import annotations

import importlib
import signal
import time
from collections import deque
from collections.abc import Callable
from contextlib import closing
from itertools import islice, product
from pathlib import Path
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Header

from calib_ros.datasets.bag_file import BagFile, peek_header
from calib_ros.errors import BadInputError, MissingDependencyError
from calib_ros.frame import NANOSECONDS
from calib_ros.messages import stamp_ns
from calib_ros.messages.point_fields import LIVOX
from calib_ros.ros.conversions import time_message
from calib_ros.ros.dds import use_large_message_profile
from calib_ros.ros.publishers import PROCESSED_KEPT

CLOUD_TYPES = ("sensor_msgs/msg/PointCloud2", *LIVOX)
SENSOR_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", *CLOUD_TYPES)
CLOCK_PERIOD = NANOSECONDS // 100
SETTLE_S = 1.0  # from the discovery of all subscribers to the first message
LINGER_S = 1.0  # after the last message, so that late joiners get latched topics and nothing in flight is lost
SENT_KEPT = 10  # messages on their way to a node that says nothing
FOLLOW_S = 60.0  # longest wait for a followed node, which may have lost messages or have ended


def message_class(type_name: str) -> Any:
    """'sensor_msgs/msg/Image' -> the Python class. MissingDependencyError if the package is not installed."""
    package, _, name = type_name.partition("/msg/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError):
        raise MissingDependencyError(f"{type_name} is not installed; install the ROS package {package}") from None


class Follower:
    """Tells how far a node has come: it publishes the headers of images and clouds on ~/processed once it is done with them.

    One scan may be on its way, so that a message that gets lost holds nothing up: those after it tell that it is gone. Nobody
    waits for ever: after FOLLOW_S without a header the next scans are sent all the same, until one comes.
    """

    def __init__(self, node: Node, name: str) -> None:
        self._node = node
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._scans, self._silent = 0, False  # scans sent so far; whether it was waited for in vain
        self._in_flight: deque[tuple[tuple[int, str], int]] = deque()  # stamp and frame, and the scans sent by then
        kept = QoSProfile(depth=PROCESSED_KEPT, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._processed = node.create_subscription(Header, f"{name.rstrip('/')}/processed", self._on_header, kept).topic_name

    def _on_header(self, header: Header) -> None:
        done = stamp_ns(header.stamp), header.frame_id.lstrip("/")
        sent = [message for message, _ in self._in_flight]
        if done in sent:
            self._silent, place = False, sent.index(done)
            scans = self._in_flight[place][1]
            # Those before it of the same sensor have got lost, and of any sensor where a scan lies between.
            earlier = [m for m in islice(self._in_flight, place) if m[0][1] != done[1] and m[1] >= scans]
            self._in_flight = deque([*earlier, *islice(self._in_flight, place + 1, None)])

    def wait(self, stopped: Callable[[], bool]) -> None:
        """Before another scan is sent: until the node is done with what was sent before the last one."""
        end = time.monotonic() + (0.0 if self._silent else FOLLOW_S)
        while self._in_flight and self._in_flight[0][1] < self._scans:
            waiting = len(self._in_flight)
            if stopped() or time.monotonic() >= end:
                self._silent = True
                self._executor.spin_once(timeout_sec=0)
                self._in_flight = deque(islice(self._in_flight, max(len(self._in_flight) - SENT_KEPT, 0), None))
                return
            self._executor.spin_once(timeout_sec=0.05)
            if len(self._in_flight) < waiting:
                end = time.monotonic() + FOLLOW_S

    def add(self, topic: str, stamp: int, frame: str, is_scan: bool) -> None:
        """An image or a scan has been sent; those of topics that the node does not subscribe to do not count."""
        if self.subscribes_to(topic):
            self._scans += is_scan
            self._in_flight.append(((stamp, frame), self._scans))

    def subscribes_to(self, topic: str) -> bool:
        """Whether the node subscribes to a topic, and tells us."""
        told = [_owner(end) for end in self._node.get_publishers_info_by_topic(self._processed)]
        owners = [_owner(end) for end in self._node.get_subscriptions_info_by_topic(topic)]
        return any(a == b for ends in product(told, owners) for a, b in zip(*ends, strict=True))


def _owner(endpoint: Any) -> tuple[bytes, tuple[str, str]]:
    """The participant, that is, the prefix of a DDS GUID (DDSI-RTPS 8.2.4.1), and the node, by which other middlewares go: Fast
    DDS may lose names of nodes, which come by a topic of depth 1 (ros2/rmw_fastrtps#792)."""
    return bytes(endpoint.endpoint_gid[:12]), (endpoint.node_namespace, endpoint.node_name)


def _sleep(seconds: float, stopped: Callable[[], bool]) -> None:
    end = time.monotonic() + seconds
    while not stopped() and time.monotonic() < end:
        time.sleep(0.02)


class Player:
    """Publishes the messages of a bag at the pace they were recorded, as serialised bytes; see `play`.

    skipped: topics whose types are not installed. published: messages so far, by topic.
    """

    def __init__(self, node: Node, bag: BagFile, rate: float, clock: bool, follow: str) -> None:
        self.bag, self.rate = bag, rate
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
            latched = topic.type == "tf2_msgs/msg/TFMessage" and "static" in topic.name
            durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
            qos = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE, durability=durability)
            publisher = node.create_publisher(cls, topic.name, qos)
            self._publishers[topic.name] = publisher
            if topic.type in SENSOR_TYPES:
                self._sensors.append(publisher)
        if not any(bag.topics[name].count for name in self._publishers):
            raise BadInputError(f"bag {bag.path} holds no message that can be published; see calib-ros info")
        self._clock = node.create_publisher(Clock, "/clock", 10) if clock else None
        self._follower = Follower(node, follow) if follow else None

    def wait_for_subscribers(self, wait_s: float, stopped: Callable[[], bool]) -> bool:
        """Wait until every image and cloud topic has a subscriber, and a followed node is known; False when the time is up
        first."""
        end = time.monotonic() + wait_s
        while not stopped() and time.monotonic() < end:
            if self.hears_followed_node() and all(publisher.get_subscription_count() for publisher in self._sensors):
                # Discovery has two sides: the subscribers may not know us yet; best-effort ones would miss the first messages.
                _sleep(SETTLE_S, stopped)
                return True
            time.sleep(0.02)
        return False

    def hears_followed_node(self) -> bool:
        """False where one is to be followed that is not heard, or does not subscribe to an image and a cloud of the bag."""
        follower = self._follower
        return follower is None or sum(follower.subscribes_to(sensor.topic_name) for sensor in self._sensors) >= 2

    def play_once(self, stopped: Callable[[], bool], progress: Callable[[float], None]) -> None:
        """Publish the bag, until `stopped` says True."""
        started = time.monotonic()
        first: int | None = None
        clock_at = 0
        for name, stamp, data in self.bag.raw(list(self._publishers)):
            first = stamp if first is None else first
            kind, follower = self.bag.topics[name].type, self._follower
            if follower is not None and kind in CLOUD_TYPES:
                began = time.monotonic()
                follower.wait(stopped)
                started += time.monotonic() - began  # the pace of what follows stays the recorded one
            due = started + (stamp - first) / NANOSECONDS / self.rate
            while not stopped():
                now = time.monotonic()
                if self._clock is not None:
                    recorded = min(first + int((now - started) * self.rate * NANOSECONDS), stamp)
                    if recorded >= clock_at:
                        self._clock.publish(Clock(clock=time_message(recorded)))
                        clock_at = recorded + CLOCK_PERIOD
                if now >= due:
                    break
                time.sleep(min(due - now, 0.01))
            if stopped():
                return
            self._publishers[name].publish(bytes(data))
            if follower is not None and kind in SENSOR_TYPES:
                follower.add(name, *peek_header(data), kind in CLOUD_TYPES)
            self.published[name] = self.published.get(name, 0) + 1
            if self.bag.duration_s > 0:
                progress(min((stamp - first) / NANOSECONDS / self.bag.duration_s, 1.0))


def play(
    path: str,
    report: Callable[[str], None],
    progress: Callable[[float], None],
    rate: float = 1.0,
    loop: bool = False,
    clock: bool = False,
    wait_s: float = 10.0,
    follow: str = "",
) -> dict[str, int]:
    """Play a bag as a process of its own until its end or SIGINT/SIGTERM; returns the messages published per topic.

    rate: times the recorded pace. loop: start over at the end. clock: publish /clock. wait_s: seconds to wait until every image
    and cloud topic has a subscriber. follow: a node of this package that the playing waits for where it is slower, for example
    /calib_ros; empty = none.
    """
    for name, value, low, high in (("rate", rate, 0.01, 1000.0), ("wait_s", wait_s, 0.0, 3600.0)):
        if not low <= value <= high:
            raise BadInputError(f"{name} = {value!r} is out of range [{low:g}, {high:g}]")

    def stopped() -> bool:
        return not rclpy.ok()

    published: dict[str, int] = {}
    use_large_message_profile()
    # SIGINT ends the ROS context, which the player looks at; an exception besides could come in the middle of anything, such as
    # the end of a generator, where nobody can catch it.
    before = signal.signal(signal.SIGINT, lambda *_: None)
    try:
        with closing(BagFile(Path(path))) as bag:
            rclpy.init()
            node = rclpy.create_node("calib_player")
            try:
                player = Player(node, bag, rate, clock, follow)
                published = player.published
                for text in player.skipped:
                    report(f"not played: {text}")
                if wait_s and not player.wait_for_subscribers(wait_s, stopped) and not stopped():
                    problem = "no subscriber on every image and cloud topic"
                    if not player.hears_followed_node():
                        problem = f"{follow} is not heard, or subscribes to other topics (check name, remapping, ROS_DOMAIN_ID)"
                    report(f"{problem} after {wait_s:g} s; playing all the same")
                player.play_once(stopped, progress)
                while loop and not stopped():
                    player.play_once(stopped, progress)
                _sleep(LINGER_S, stopped)
            except Exception:
                if rclpy.ok():
                    raise  # else: a signal took the context away meanwhile
            finally:
                node.destroy_node()
                rclpy.try_shutdown()
    finally:
        signal.signal(signal.SIGINT, before)
    return published
