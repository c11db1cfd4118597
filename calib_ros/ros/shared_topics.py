"""What several pairs of a rig look at: each message is received and decoded once for all."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any

from rclpy.node import Node

from calib_ros.datasets.recent import Recent
from calib_ros.ros.conversions import Serialized, cloud_from_message, pixels_from_message
from calib_ros.ros.subscriptions import AdaptiveSubscription, Form

Guard = Callable[[], AbstractContextManager[None]]
CLOUDS_KEPT, IMAGES_KEPT = 6, 2  # decoded messages: of clouds, those before a keyframe's are asked for as well
CHECKED_AGAIN_S = 0.5  # everybody who listens checks once a second


class SharedTopics:
    """Subscriptions of one node that several listen to, each with a callback of its own."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self._topics: dict[str, _Topic] = {}

    def subscribe(
        self, forms: Sequence[Form], topic: str, callback: Callable[[int, Any], None], guard: Guard = nullcontext, **options: Any
    ) -> Listener:
        """As an `AdaptiveSubscription`, which the first one makes with its options."""
        if topic not in self._topics:
            make = partial(AdaptiveSubscription, self.node, forms, topic, guard=guard, **options)
            self._topics[topic] = _Topic(make)
        return Listener(self._topics[topic], callback, guard, self._leave)

    def _leave(self, topic: _Topic) -> None:
        topic.subscription.destroy()
        self._topics = {name: own for name, own in self._topics.items() if own is not topic}


class _Topic:
    def __init__(self, make: Callable[..., AdaptiveSubscription]) -> None:
        self.listeners: list[Listener] = []
        self.checked, self.problem = 0.0, ""
        self.subscription = make(callback=self._receive)

    def _receive(self, stamp: int, message: Any) -> None:
        for listener in list(self.listeners):
            with listener.guard():
                listener.callback(stamp, message)


class Listener:
    """One of those who share a subscription, with the members of an `AdaptiveSubscription`."""

    def __init__(
        self,
        topic: _Topic,
        callback: Callable[[int, Any], None],
        guard: Guard,
        leave: Callable[[_Topic], None],
    ) -> None:
        self._topic, self.callback, self.guard, self._leave = topic, callback, guard, leave
        self.preference = topic.subscription.preference
        topic.listeners.append(self)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._topic.subscription, name)

    @property
    def tells(self) -> bool:
        """See `AdaptiveSubscription`: of those who share it, the first one."""
        return self._topic.listeners[:1] == [self]

    def check(self) -> str:
        """See `AdaptiveSubscription`."""
        own, now = self._topic, time.monotonic()
        if now - own.checked >= CHECKED_AGAIN_S:
            own.checked, own.subscription.preference = now, self.preference
            own.problem = own.subscription.check()
        return own.problem

    def destroy(self) -> None:
        """Receive nothing any more; the last one ends the subscription."""
        if self in self._topic.listeners:
            self._topic.listeners.remove(self)
            if not self._topic.listeners:
                self._leave(self._topic)


class Decoded:
    """What the messages of one sensor hold, decoded once for all who ask."""

    def __init__(self, decode: Callable[[Serialized], Any], kept: int) -> None:
        self._decode, self._recent = decode, Recent(kept)

    def __call__(self, message: Serialized) -> Any:
        return self._recent(message, lambda: self._decode(message))


def decoded_clouds() -> Decoded:
    """Of a LiDAR."""
    return Decoded(cloud_from_message, CLOUDS_KEPT)


def decoded_images() -> Decoded:
    """Of a camera."""
    return Decoded(pixels_from_message, IMAGES_KEPT)
