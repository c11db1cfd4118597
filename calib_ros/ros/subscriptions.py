"""Subscriptions that follow what publishers offer, and what to do where messages do not come."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from functools import partial
from importlib import import_module
from typing import Any, NamedTuple

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CompressedImage, Image, PointCloud2

from calib_ros.messages import stamp_ns
from calib_ros.messages.compressed_points import COMPRESSED_POINTS
from calib_ros.messages.point_fields import LIVOX
from calib_ros.messages.video import VIDEO
from calib_ros.messages.wire import wire_header
from calib_ros.ros.conversions import Serialized, cloud_of_livox, header_message
from calib_ros.ros.dds import profile_for_sender
from calib_ros.ros.distributions import SubscriptionEventCallbacks, UnsupportedEventTypeError, where_nobody_publishes

BEST_EFFORT, RELIABLE = ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE
DEPTH = 10  # half a second of a camera at 20 Hz
HANDOVER_S = 1.0  # the old subscription stays so long: the new one has to be discovered first
LOSS_CHECKS = 11  # checks, at one a second, over which lost messages count: 10 s
MIN_LOSSES = 5  # messages in that time; fewer are those of the discovery
# What to do about topics of other types, by what is wanted.
IMAGE_ADVICE = {
    "sensor_msgs/msg/CompressedImage": "set image_transport: compressed",
    "sensor_msgs/msg/Image": "set image_transport: raw",
} | dict.fromkeys(VIDEO, "republish it as raw images (image_transport republish)")
POINTS_ADVICE = {
    COMPRESSED_POINTS: "republish it (point_cloud_transport republish)",
} | dict.fromkeys(LIVOX, "source the driver's workspace, or set its xfer_format to 0")


class Form(NamedTuple):
    """A message type of a topic. restore: bytes of it -> the message."""

    kind: type[Any]
    restore: Callable[[bytes], Any]


def serialized(kind: type[Any]) -> Form:
    """What is large, and decoded only where it is looked at."""
    return Form(kind, partial(deserialize_message, message_type=kind))


def type_name(kind: type[Any]) -> str:
    """sensor_msgs.msg.Image -> 'sensor_msgs/msg/Image'."""
    return f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"


class AdaptiveSubscription:
    """Starts with best effort, which receives from every publisher, and becomes reliable where all publishers are.

    callback: called with stamp, ns, and message. preference: "auto", or "best_effort" or "reliable" whatever the publishers are;
    it may be replaced at any time and holds from the next check() on. latched: receive what was published before as well, where
    all publishers keep it. guard: context that callbacks run in. forms: types that are received, one at a time, the first that
    somebody publishes. largest: bytes of data in the largest message so far. reliability_offered: by all publishers, when check()
    was called last. silence: why nothing comes on the topic, where nothing does. To be used on the executor's thread. No message
    is lost or received twice when reliability changes.
    """

    def __init__(
        self,
        node: Node,
        forms: Sequence[Form],
        topic: str,
        callback: Callable[[int, Any], None],
        preference: str,
        latched: bool = False,
        guard: Callable[[], AbstractContextManager[None]] = nullcontext,
    ) -> None:
        self.preference = preference
        self._node, self._callback, self._latched = node, callback, latched
        self._topic, self._guard = topic, guard
        self._forms, self._form = forms, forms[0]
        self.largest, self.reliability_offered, self.silence = 0, False, ""
        self._received = self._lost = self._made = 0
        self._received_at = time.monotonic()
        self._history: deque[tuple[int, int]] = deque(maxlen=LOSS_CHECKS)  # received and lost so far, at every check
        self._old: list[tuple[Any, float]] = []
        self._recent: deque[tuple[int, int]] = deque(maxlen=64)  # stamp, and number of the subscription
        self._qos = (RELIABLE if preference == "reliable" else BEST_EFFORT, DurabilityPolicy.VOLATILE)
        self._current = self._subscribe()

    @property
    def topic(self) -> str:
        """Full name, after remapping."""
        return str(self._current.topic_name)

    @property
    def kind(self) -> type[Any]:
        """The type that is received."""
        return self._form.kind

    @property
    def reliable(self) -> bool:
        """True if messages that get lost are sent again."""
        return self._qos[0] == RELIABLE

    @property
    def silent_s(self) -> float:
        """Seconds since the newest message, before the first since the topic is listened to."""
        return time.monotonic() - self._received_at

    def lost_share(self) -> float:
        """Share of the messages of the last 10 s, 0 to 1, that the middleware has reported as lost; 0 where it reports none."""
        received, lost = self._history[0] if self._history else (0, 0)
        received, lost = self._received - received, self._lost - lost
        return lost / (received + lost) if lost >= MIN_LOSSES else 0.0

    def destroy(self) -> None:
        """Receive nothing any more."""
        for subscription in (self._current, *(old for old, _ in self._old)):
            self._node.destroy_subscription(subscription)

    def check(self) -> str:
        """Follow the publishers; to be called about once a second. One line for a person if some cannot be received, else ''."""
        now = time.monotonic()
        self._history.append((self._received, self._lost))
        for subscription, since in [old for old in self._old if now - old[1] >= HANDOVER_S]:
            self._old.remove((subscription, since))
            self._node.destroy_subscription(subscription)
        everyone = self._node.get_publishers_info_by_topic(self.topic)
        types = [p.topic_type for p in everyone]
        form = next((form for form in self._forms if type_name(form.kind) in types), self._form)
        if form != self._form:  # DDS knows one type of a topic at a time
            self.destroy()
            self._old.clear()
            self._form = form
            self._current = self._subscribe()
        publishers = [p.qos_profile for p in everyone if p.topic_type == type_name(form.kind)]
        wanted = self._wanted(publishers)
        if wanted != self._qos:
            self._qos = wanted
            self._old.append((self._current, now))
            self._current = self._subscribe()
        self.reliability_offered = bool(publishers) and all(p.reliability != BEST_EFFORT for p in publishers)
        problem = self._problem(types, publishers)
        missing = " any more; see that its driver runs" if self._received else f"; {where_nobody_publishes()}"
        nothing = "is published, but nothing comes; check its driver" if publishers else f"has no publisher{missing}"
        self.silence = problem or f"{self.topic} {nothing}"
        return problem

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
        others = sorted(set(types) - {type_name(self.kind)})
        if others:
            cures = {Image: IMAGE_ADVICE, CompressedImage: IMAGE_ADVICE, PointCloud2: POINTS_ADVICE}.get(self._forms[0].kind, {})
            text = f"{', '.join(others)}, but {type_name(self.kind)} is wanted; {cures.get(others[0], 'check the remapping')}"
            return f"{self.topic} is published as {text}"
        if self.reliable and any(p.reliability == BEST_EFFORT for p in publishers):
            return f"a publisher of {self.topic} offers best effort only and cannot be received; set reliability: auto"
        return ""

    def _subscribe(self) -> Any:
        qos = QoSProfile(depth=DEPTH, reliability=self._qos[0], durability=self._qos[1])
        self._made += 1
        receive = partial(self._receive, self._made, self._form.restore)
        subscribe = partial(self._node.create_subscription, self._form.kind, self._topic, receive, qos, raw=True)
        try:
            return subscribe(event_callbacks=SubscriptionEventCallbacks(message_lost=self._on_lost, use_default_callbacks=False))
        except UnsupportedEventTypeError:
            text = "this middleware does not report lost messages: only gaps in the stamps tell of them"
            self._node.get_logger().info(text, once=True)
            return subscribe()

    def _on_lost(self, event: Any) -> None:
        self._lost += event.total_count_change

    def _receive(self, subscription: int, restore: Callable[[bytes], Any], data: bytes) -> None:
        with self._guard():
            msg = Serialized(header_message(wire_header(data)), data, restore)
            stamp = stamp_ns(msg.header.stamp)
            # Received through the other subscription already. Through the same one it is another message: time may stand still,
            # or not be stamped at all.
            if self._old and any(seen == stamp and through != subscription for seen, through in self._recent):
                return
            self._recent.append((stamp, subscription))
            self._received += 1
            self._received_at = time.monotonic()
            self.largest = max(self.largest, len(data))
            self._callback(stamp, msg)


def livox_forms() -> list[Form]:
    """Livox's own clouds, of the drivers whose messages are installed."""
    forms = []
    for name in LIVOX:
        with suppress(ImportError):
            forms.append(Form(import_module(f"{name.partition('/')[0]}.msg").CustomMsg, cloud_of_livox))
    return forms


def loss_advice(subscription: AdaptiveSubscription) -> str:
    """What to do about lost messages."""
    if subscription.reliable:
        return "its driver leaves them out, or queues too few of them: lower its rate, or raise its queue"
    if subscription.reliability_offered:
        return "set reliability: auto, since its publishers are reliable"
    cures = [
        profile_for_sender(subscription.largest) or "from another computer raise net.core.rmem_max on both",
        "let it publish reliably" + (" or compressed (image_transport: compressed)" if subscription.kind is Image else ""),
    ]
    return ", or ".join(cures)
