"""Publishes the messages of a bag over and over, as bytes, with stamps that go on."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from calib_ros.datasets.bag_file import BagFile, peek_header
from calib_ros.frame import NANOSECONDS
from calib_ros.ros.bags import message_class

IMAGE, INFO, POINTS = "/camera/image_raw", "/camera/camera_info", "/velodyne_points"  # as bag_writer names them
GAP_NS = NANOSECONDS  # between two laps: the jump from the last scene to the first must not look like motion
LOWEST, HIGHEST = 2.0, 200.0  # pairs per second
STAMP = 4  # offset of the stamp in a message that begins with a header, behind the encapsulation


@dataclass
class Recorded:
    """A message of the bag, whose stamp is written over before it goes out."""

    topic: str
    stamp: int
    data: bytearray


def recorded(bag: Path) -> list[Recorded]:
    """All images, infos and clouds of a bag, by stamp. They are held in memory."""
    file = BagFile(bag)
    messages = [Recorded(topic, peek_header(data)[0], bytearray(data)) for topic, _, data in file.raw([INFO, IMAGE, POINTS])]
    file.close()
    return sorted(messages, key=lambda message: message.stamp)


def restamped(messages: list[Recorded]) -> Iterator[Recorded]:
    """The messages without end; every lap follows the one before."""
    lap_ns = messages[-1].stamp - messages[0].stamp + GAP_NS
    for lap in count():
        for message in messages:
            seconds, rest = divmod(message.stamp + lap * lap_ns, NANOSECONDS)
            struct.pack_into(("<" if message.data[1] & 1 else ">") + "iI", message.data, STAMP, seconds, rest)
            yield message


class Pace:
    """Pairs per second: fixed, or as fast as the node takes them.

    The node never falls behind: a busy worker leaves pairs out. So the rate rises until more than `share` of the pairs of the
    last seconds were left out or a message was lost, and then stays a little below.
    """

    def __init__(self, fixed: float | None, share: float) -> None:
        self.rate = fixed or 10.0
        self._fixed, self._share = fixed is not None, share
        self._seen: list[tuple[int, int]] = []

    def heard(self, pairs: int, left_out: int) -> None:
        """The node's counts, once a second."""
        self._seen = [*self._seen[-5:], (pairs, left_out)]
        if self._fixed or len(self._seen) < 6:
            return
        new, lost = (self._seen[-1][k] - self._seen[0][k] for k in (0, 1))
        if lost > self._share * new:
            self.rate = max(0.85 * self.rate, LOWEST)
            self._seen = self._seen[-1:]  # what was lost at the old rate says nothing of the new one
        elif new > 0.9 * 5 * self.rate:  # else we are the slow ones
            self.rate = min(1.04 * self.rate, HIGHEST)


class Feeder:
    """Publishers of the three topics."""

    def __init__(self, node: Node, messages: list[Recorded], types: dict[str, str]) -> None:
        qos = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
        self._publishers: dict[str, Any] = {
            topic: node.create_publisher(message_class(kind), topic, qos) for topic, kind in types.items()
        }
        self._messages = messages
        self.sent = dict.fromkeys(types, 0)

    @property
    def heard(self) -> bool:
        """True if every topic has a subscriber."""
        return all(publisher.get_subscription_count() for publisher in self._publishers.values())

    def run(self, pairs: int, pace: Pace, idle: Callable[[float], None], stopped: Callable[[], bool]) -> None:
        """Publish so many pairs. idle: called with the time at which the next one is due, at least once for each."""
        due = time.monotonic()
        for message in restamped(self._messages):
            if message.topic == IMAGE:
                if self.sent[IMAGE] == pairs or stopped():
                    return
                due = max(due + 1 / pace.rate, time.monotonic() - 1 / pace.rate)  # a delay is not made up for in a burst
                idle(due)
            self._publishers[message.topic].publish(bytes(message.data))
            self.sent[message.topic] += 1
