"""A subscription whose QoS follows what the publishers of its topic offer."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

BEST_EFFORT, RELIABLE = ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE
DEPTH = 10  # half a second of a camera at 20 Hz
HANDOVER_S = 1.0  # the old subscription stays so long: the new one has to be discovered first


def type_name(kind: type[Any]) -> str:
    """sensor_msgs.msg.Image -> 'sensor_msgs/msg/Image'."""
    return f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"


class AdaptiveSubscription:
    """Starts with best effort, which receives from every publisher, and becomes reliable where all publishers are.

    preference: "auto", or "best_effort" or "reliable" whatever the publishers are; it may be replaced at any time and holds from
    the next check() on. latched: take what was published before as well, where all publishers keep it. To be used on the
    executor's thread. No message is lost or taken twice in a change.
    """

    def __init__(
        self, node: Node, kind: type[Any], topic: str, callback: Callable[[Any], None], preference: str, latched: bool = False
    ) -> None:
        self.preference = preference
        self._node, self._kind, self._callback, self._latched = node, kind, callback, latched
        self._topic = topic
        self._old: list[tuple[Any, float]] = []
        self._recent: deque[tuple[tuple[int, int], int]] = deque(maxlen=64)
        self._made = 0
        self._qos = (RELIABLE if preference == "reliable" else BEST_EFFORT, DurabilityPolicy.VOLATILE)
        self._current = self._subscribe()

    @property
    def topic(self) -> str:
        """Full name, after remapping."""
        return str(self._current.topic_name)

    @property
    def reliable(self) -> bool:
        """True if messages that get lost are sent again."""
        return self._qos[0] == RELIABLE

    def check(self) -> str:
        """Follow the publishers; to be called about once a second. One line for a person if some cannot be received, else ''."""
        now = time.monotonic()
        for subscription, since in [old for old in self._old if now - old[1] >= HANDOVER_S]:
            self._old.remove((subscription, since))
            self._node.destroy_subscription(subscription)
        everyone = self._node.get_publishers_info_by_topic(self.topic)
        publishers = [p.qos_profile for p in everyone if p.topic_type == type_name(self._kind)]
        wanted = self._wanted(publishers)
        if wanted != self._qos:
            self._qos = wanted
            self._old.append((self._current, now))
            self._current = self._subscribe()
        return self._problem([p.topic_type for p in everyone], publishers)

    def _wanted(self, publishers: list[QoSProfile]) -> tuple[ReliabilityPolicy, DurabilityPolicy]:
        if not publishers:
            reliability, durability = self._qos
        else:
            reliability = BEST_EFFORT if any(p.reliability == BEST_EFFORT for p in publishers) else RELIABLE
            kept = self._latched and all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in publishers)
            durability = DurabilityPolicy.TRANSIENT_LOCAL if kept else DurabilityPolicy.VOLATILE
        if self.preference != "auto":
            reliability = RELIABLE if self.preference == "reliable" else BEST_EFFORT
        return reliability, durability

    def _problem(self, types: list[str], publishers: list[QoSProfile]) -> str:
        others = sorted(set(types) - {type_name(self._kind)})
        if others:
            advice = {
                "sensor_msgs/msg/CompressedImage": "set image_transport: compressed",
                "sensor_msgs/msg/Image": "set image_transport: raw",
            }
            what = advice.get(others[0], "check the remapping") if "Image" in self._kind.__name__ else "check the remapping"
            return f"{self.topic} is published as {', '.join(others)}, but {type_name(self._kind)} is wanted; {what}"
        if self.reliable and any(p.reliability == BEST_EFFORT for p in publishers):
            return f"a publisher of {self.topic} offers best effort only and cannot be received; set reliability: auto"
        return ""

    def _subscribe(self) -> Any:
        qos = QoSProfile(depth=DEPTH, reliability=self._qos[0], durability=self._qos[1])
        self._made += 1
        return self._node.create_subscription(self._kind, self._topic, partial(self._take, self._made), qos)

    def _take(self, subscription: int, msg: Any) -> None:
        stamp = (msg.header.stamp.sec, msg.header.stamp.nanosec)
        # Came through the other one. Through the same one it is another message: time may stand still, or not be stamped at all.
        if self._old and any(seen == stamp and through != subscription for seen, through in self._recent):
            return
        self._recent.append((stamp, subscription))
        self._callback(msg)
