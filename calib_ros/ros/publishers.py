"""What the node publishes of the extrinsic: the message that others rely on, at a steady rate, the overlay, how far it is."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import replace
from typing import Any

from calib_ros_msgs.msg import Extrinsic as ExtrinsicMsg
from geometry_msgs.msg import TransformStamped
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Header

from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.lidar.deskew import deskewed_frame
from calib_ros.online.events import ExtrinsicUpdated, FrameIngested, IntakeIdle
from calib_ros.overlay import caption, render
from calib_ros.result import Extrinsic
from calib_ros.ros.conversions import (
    NO_ADVICE,
    STARVED,
    UNKNOWN,
    Validity,
    compressed_image_message,
    duration_message,
    extrinsic_message,
    image_message,
    transform_message,
)
from calib_ros.ros.dds import LATCHED
from calib_ros.ros.parts import NodePart

PROCESSED_KEPT = 100  # headers; more are of messages that are gone before a pair is worked off
VALID_PERIODS = 2.5  # of publishing: one message may be late, and another one lost
# Of max_data_age_s, for which an extrinsic stays usable while sensors deliver and only CPU time is missing: it may have moved
# unnoticed, but nothing says so, and usable that comes and goes with the load helps nobody.
STARVED_PERIODS = 3


class ExtrinsicPublisher(NodePart):
    """~/transform on every change, and ~/extrinsic at least once in publish_period_s, with what a consumer needs to rely on it.

    DDS tells subscribers that ask for it when the messages stay away (deadline) or the process ends (liveliness). stamp: of the
    newest message, ns. served: the consumers that may use the newest published one.
    """

    def __init__(self, own: Any) -> None:
        super().__init__(own)
        self._valid_s = VALID_PERIODS * self._parameters["publish_period_s"]
        self.stamp = 0
        self.served: list[str] = []
        self._last_good: tuple[Extrinsic, int, float] | None = None
        profile = QoSProfile(
            depth=1,
            reliability=ReliabilityPolicy.RELIABLE,
            durability=DurabilityPolicy.TRANSIENT_LOCAL,
            deadline=Duration(seconds=self._valid_s),
            liveliness=LivelinessPolicy.AUTOMATIC,
            liveliness_lease_duration=Duration(seconds=self._valid_s),
        )
        self._publisher = self._create_publisher(ExtrinsicMsg, "~/extrinsic", profile)
        self._transforms = self._create_publisher(TransformStamped, "~/transform", LATCHED)

    def pause(self) -> None:
        """Say as the last message that the extrinsic is not usable any more."""
        self._pipeline.read_current(self._publish)

    def validity(self, extrinsic: Extrinsic) -> Validity:
        """Whether an extrinsic is to be used as of now."""
        age, most = self._pipeline.data_age_s, self._parameters["max_data_age_s"]
        if self._pipeline.paused:
            return Validity(False, 0, age, "not checked any more: the node is not active" if extrinsic.usable else "")
        starved = self._pipeline.starved(most)
        if age > (STARVED_PERIODS * most if starved else most):
            seen = f"no usable pair of image and cloud for {age:.1f} s" if age < float("inf") else "no usable pair yet"
            why = STARVED if starved else ", ".join(filter(None, [self._own.sensors.silent(), seen]))
            return Validity(False, 0, age, f"not checked any more: {why}" if extrinsic.usable else "")
        until = self._node.get_clock().now().nanoseconds + round(self._valid_s * NANOSECONDS)
        return Validity(extrinsic.usable, until if extrinsic.usable else 0, age, STARVED if starved and age > most else "")

    def add(self, event: Any) -> None:
        """Publish a new extrinsic."""
        if isinstance(event, ExtrinsicUpdated):
            result = event.extrinsic.result
            self._publish(event.extrinsic, event.stamp)
            frames = result.camera_frame, result.lidar_frame
            self._transforms.publish(transform_message(result.T_camera_lidar, *frames, event.stamp))

    def again(self) -> None:
        """Others see that the node is alive, and whether its extrinsic still is."""
        self._pipeline.read_current(self._publish, wait=False)

    def _publish(self, extrinsic: Extrinsic, stamp: int) -> None:
        self.stamp = stamp
        message = self.message(extrinsic)
        self.served = [consumer.name for consumer in message.consumers if consumer.usable]
        self._publisher.publish(message)

    def message(self, extrinsic: Extrinsic, stamp: int | None = None) -> ExtrinsicMsg:
        """The message as of now. stamp: ns, if not that of the newest one published."""
        validity = self.validity(extrinsic)
        if validity.usable:
            self._last_good = (extrinsic, self.stamp, time.monotonic() - validity.data_age_s)
        recalibrator = self._pipeline.recalibrator
        advice = NO_ADVICE if recalibrator is None else recalibrator.advice(extrinsic)
        stamp = self.stamp if stamp is None else stamp
        return extrinsic_message(extrinsic, stamp, validity, self._parameters.consumers(), advice)

    def last_good(self) -> ExtrinsicMsg | None:
        """The newest message that said usable, with the age it has by now; None before the first."""
        if self._last_good is None:
            return None
        extrinsic, stamp, received = self._last_good
        msg = extrinsic_message(extrinsic, stamp, UNKNOWN, self._parameters.consumers())
        msg.data_age = duration_message(time.monotonic() - received)
        return msg


class OverlayPublisher(NodePart):
    """~/overlay and ~/overlay/compressed: the diagnostic picture, drawn once for both while someone listens to either, at most
    once per overlay_period_s.

    Draws on the thread that calls it, 10 to 40 ms: a worker's, the executor's only for a reset and for a new listener.
    """

    def __init__(self, own: Any) -> None:
        super().__init__(own)
        self.publisher = self._create_publisher(Image, "~/overlay", 1)
        self.compressed = self._create_publisher(CompressedImage, "~/overlay/compressed", 1)
        self._last = 0.0
        self._listeners = 0  # of both, a second ago

    def check(self) -> None:
        """Who begins to listen sees the newest keyframe at once: a node at rest draws none for a long time."""
        before = self._listeners
        self._listeners = sum(own.get_subscription_count() for own in (self.publisher, self.compressed))
        if self._listeners > before:
            self._publish(self._pipeline.last_keyframe)

    def add(self, event: Any) -> None:
        """Draw a frame, and a new extrinsic at once, whatever the period."""
        if isinstance(event, ExtrinsicUpdated):
            self._publish(self._pipeline.last_keyframe)
        elif isinstance(event, FrameIngested) and time.monotonic() - self._last >= self._parameters["overlay_period_s"]:
            self._publish(event.frame)

    def _publish(self, frame: Frame | None) -> None:
        """A frame with the current extrinsic below the initial one."""
        recalibrator = self._pipeline.recalibrator
        if recalibrator is None or frame is None or not self._node.context.ok():  # not ok: the node is being stopped
            return
        heard, heard_compressed = (own.get_subscription_count() > 0 for own in (self.publisher, self.compressed))
        if not (heard or heard_compressed):
            return
        self._last = time.monotonic()
        extrinsic, initial = recalibrator.current, recalibrator.tracker.initial
        newest = recalibrator.newest()
        if newest is not None and newest.stamp == frame.stamp:
            frame = deskewed_frame(replace(frame, twist=newest.twist), recalibrator.config.motion)
        picture = render(
            frame,
            extrinsic.result.T_camera_lidar,
            T_before=initial.T_camera_lidar,
            edges=newest.points if newest is not None and newest.stamp == frame.stamp else None,
            lines=caption(extrinsic, len(recalibrator.keyframes), initial.T_camera_lidar),
            status=extrinsic.result.status,
        )
        if heard:
            self.publisher.publish(image_message(picture, extrinsic.result.camera_frame, frame.stamp))
        if heard_compressed:
            self.compressed.publish(compressed_image_message(picture, extrinsic.result.camera_frame, frame.stamp))


class ProcessedPublisher(NodePart):
    """~/processed: the header of every image and cloud, once nothing that was received by then waits to be taken in.

    Whoever sends no more before it comes, as `calib-ros play --follow` does, loses no pair, however slow the machine is.
    """

    def __init__(self, own: Any) -> None:
        super().__init__(own)
        # Kept for whoever this node discovers late.
        kept = QoSProfile(depth=PROCESSED_KEPT, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._publisher = self._create_publisher(Header, "~/processed", kept)
        self._received: deque[Header] = deque(maxlen=PROCESSED_KEPT)
        self._lock = threading.Lock()

    def check(self) -> None:
        """Somebody may listen by now."""
        self._publish()

    def receive(self, header: Header) -> None:
        """Of a message that the pipeline has been given."""
        with self._lock:
            self._received.append(header)
        self._publish()

    def add(self, event: Any) -> None:
        """All pairs so far may be worked off."""
        if isinstance(event, IntakeIdle):
            self._publish()

    def _publish(self) -> None:
        """All headers, unless a pair is being taken in: what comes of the newest messages is not known before."""
        with self._lock:
            if self._pipeline.taking_in or not self._node.context.ok() or not self._publisher.get_subscription_count():
                return
            while self._received:
                self._publisher.publish(self._received.popleft())
