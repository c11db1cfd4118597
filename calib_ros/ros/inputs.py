"""What pairs receive: image, cloud, CameraInfo, and what measures how fast the vehicle moves.

Each message is received and decoded once for all pairs that look at it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import TwistStamped
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu, PointCloud2

from calib_ros.arrays import Transform
from calib_ros.camera import Camera
from calib_ros.datasets.recent import Recent
from calib_ros.errors import BadInputError, CalibrationError, MissingDependencyError
from calib_ros.frame import NANOSECONDS, Frame, PointCloud
from calib_ros.messages import decode_camera_info, stamp_ns
from calib_ros.online.common import Common
from calib_ros.online.pairing import LASTING, MISSING_SHARE, SILENT_PERIODS
from calib_ros.rig.description import CAMERA
from calib_ros.rig.edges import SEEN, seen_share
from calib_ros.ros.conversions import Serialized, cloud_from_message, pixels_from_message
from calib_ros.ros.diagnostics import SILENCE_S
from calib_ros.ros.distributions import remark
from calib_ros.ros.parts import NodePart
from calib_ros.ros.subscriptions import BEST_EFFORT, AdaptiveSubscription, Form, livox_forms, loss_advice, serialized

Guard = Callable[[], AbstractContextManager[None]]
CLOUDS_KEPT, IMAGES_KEPT = 6, 2  # decoded messages: of clouds, those before a keyframe's are asked for as well
UNSEEN_SCANS = 10  # one after the other without a point in view: a second
SILENT_S = 1.0  # without a message: slower sensors than this are of no use
AFTER_STAMP = 12  # bytes of a message: what comes behind is the same in nearly every CameraInfo
INACTIVE = "the node is not active; activate it first"
MOTION_QOS = QoSProfile(depth=10, reliability=BEST_EFFORT)


class SharedTopics:
    """Subscriptions of one node that several listen to, each with a callback of its own."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self._topics: dict[str, tuple[AdaptiveSubscription, list[Listener]]] = {}

    def subscribe(
        self, forms: Sequence[Form], topic: str, callback: Callable[[int, Any], None], guard: Guard = nullcontext, **options: Any
    ) -> Listener:
        """As an `AdaptiveSubscription`, which the first one makes with its options."""
        if topic not in self._topics:
            listeners: list[Listener] = []

            def receive(stamp: int, message: Any) -> None:
                for listener in list(listeners):
                    with listener.guard():
                        listener.callback(stamp, message)

            self._topics[topic] = AdaptiveSubscription(self.node, forms, topic, receive, guard=guard, **options), listeners
        return Listener(*self._topics[topic], callback, guard, lambda: self._topics.pop(topic))


class Listener:
    """One of those who share a subscription, with the members of an `AdaptiveSubscription`. leave: called with the last one."""

    def __init__(
        self,
        subscription: AdaptiveSubscription,
        everyone: list[Listener],
        callback: Callable[[int, Any], None],
        guard: Guard,
        leave: Callable[[], object],
    ) -> None:
        self._subscription, self._everyone, self._leave = subscription, everyone, leave
        self.callback, self.guard, self.preference = callback, guard, subscription.preference
        everyone.append(self)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._subscription, name)

    @property
    def tells(self) -> bool:
        """Whether it is to report problems: of those who share the subscription, the first one."""
        return self._everyone[:1] == [self]

    def check(self) -> str:
        """See `AdaptiveSubscription`; of the others, which the first one checks for, ''."""
        if not self.tells:
            return ""
        self._subscription.preference = self.preference
        return self._subscription.check()

    def destroy(self) -> None:
        """Receive nothing any more; the last one ends the subscription."""
        if self in self._everyone:
            self._everyone.remove(self)
            if not self._everyone:
                self._subscription.destroy()
                self._leave()


Decoded = Callable[[Serialized], Any]  # message -> what it holds


def decoded_once(kind: str) -> Decoded:
    """What messages of a camera or a LiDAR hold, the same for several who ask while they are among the newest."""
    decode, kept = (pixels_from_message, IMAGES_KEPT) if kind == CAMERA else (cloud_from_message, CLOUDS_KEPT)
    recent = Recent(kept)
    return lambda message: recent(message, lambda: decode(message))


@dataclass(eq=False)
class PairInputs:
    """What the interface of a pair receives, alone or as one of several of a rig.

    camera, lidar: names; "" = they have none. topics: of image, points and CameraInfo. T: T_camera_lidar (4, 4) by the priors;
    None = unknown. unseen: called with a line for people where no point of a scan is in view by it; None: not to be asked, the
    pair is given. on_reset: called after ~/reset of the pair.
    """

    shared: SharedTopics
    image: Decoded = pixels_from_message
    cloud: Decoded = cloud_from_message
    common: Common | None = None
    camera: str = ""
    lidar: str = ""
    topics: tuple[str, str, str] = ("image", "points", "camera_info")
    T: Transform | None = None
    unseen: Callable[[str], None] | None = None
    on_reset: Callable[[], None] = lambda: None
    _unseen_scans: int = 0

    def frame(self, image: Serialized, cloud: Serialized, camera: Camera) -> Frame:
        """Image and cloud -> Frame. BadInputError if one of them cannot be decoded, or shows nothing of the other."""
        points: PointCloud = self.cloud(cloud)
        if self.unseen is not None and self.T is not None:
            if seen_share(camera, self.T, points.finite().xyz.astype(float)) >= SEEN:
                self.unseen = None
            else:
                self._unseen_scans += 1  # a LiDAR that starts may send parts of scans
                line = f"{self.camera} and {self.lidar} share no view by their priors, and are not estimated"
                if self._unseen_scans >= UNSEEN_SCANS:
                    self.unseen(line)
                raise BadInputError(line)
        pixels: NDArray[np.uint8] = self.image(image)
        return Frame(pixels, points, camera, stamp_ns(image.header.stamp), stamp_ns(cloud.header.stamp))


# A type of messages that tell the vehicle's motion, and what takes speed, m/s, and turn rate, deg/s, from them; None = unknown.
MotionSource = tuple[type[Any], Callable[[Any], tuple[float | None, float | None]]]


class SensorSubscriptions(NodePart):
    """Image, cloud, CameraInfo and motion; while the node is active every message goes to the pipeline.

    camera_info: the newest usable CameraInfo. motion: what measures the vehicle's motion, from motion_source().
    """

    def __init__(self, own: Any, motion: MotionSource | None) -> None:
        super().__init__(own)
        self.camera_info: Serialized | None = None
        self.adaptive: tuple[Any, ...] = ()  # of `Listener`
        self._inputs, self._rectified = own.inputs, self._parameters["image_is_rectified"]
        self._motion = motion
        self._motion_subscription: Any = None
        self._pipeline.pause(INACTIVE)

    def start(self) -> None:
        """Subscribe, and let the pipeline work."""
        self._pipeline.resume()
        pipeline, parameters, shared = self._pipeline, self._parameters, self._inputs.shared
        subscribe = partial(shared.subscribe, preference=parameters["reliability"], guard=self._health.guard)
        image, points, camera_info = self._inputs.topics
        kind = CompressedImage if parameters["image_transport"] == "compressed" else Image
        self.adaptive = (
            subscribe([serialized(kind)], image, partial(self._forward, True)),
            subscribe([serialized(PointCloud2), *livox_forms()], points, partial(self._forward, False)),
            # A camera's driver may publish once, latched, what never changes.
            subscribe([serialized(CameraInfo)], camera_info, self._on_camera_info, latched=True),
        )
        if self._motion is not None:
            motion, decode = self._motion

            def on_motion(msg: Any) -> None:
                with self._health.guard():
                    pipeline.speed_gate.add_measurement(stamp_ns(msg.header.stamp), *decode(msg))

            topic = parameters["motion_source"]
            self._motion_subscription = shared.node.create_subscription(motion, topic, on_motion, MOTION_QOS)
        said = f"semantics: {'; '.join(pipeline.segmentation.in_use()) or 'no models'}", remark()
        for line in filter(None, [*said, "waiting for images, clouds and CameraInfo"]):
            self._node.get_logger().info(line)

    def pause(self) -> None:
        """Receive nothing any more, until start() is called again."""
        self._pipeline.pause(INACTIVE)
        for subscription in self.adaptive:
            subscription.destroy()
        self.adaptive = ()
        if self._motion_subscription is not None:
            self._inputs.shared.node.destroy_subscription(self._motion_subscription)
            self._motion_subscription = None

    def check(self) -> None:
        """Follow the publishers and the parameters."""
        parameters = self._parameters
        if self._inputs.common is None:  # else the rig receives them
            self._pipeline.load.count_messages()
        for subscription in self.adaptive:
            subscription.preference = parameters["reliability"]
            if problem := subscription.check():
                self._health.error(problem, f"publishers of {subscription.topic}")
        self._health.silence = {name: own.silence for name, own in zip(("image", "points"), self.adaptive, strict=False)}
        losses, synchronizer = dict[str, str](), self._pipeline.pairing.synchronizer
        for own, missing, period in zip(self.adaptive, synchronizer.missing_shares(), synchronizer.periods, strict=False):
            # Seen by the middleware, which knows of messages that did not arrive whole, or by the stamps of a stream that keeps
            # its period, until it falls silent; of images and clouds, where many get lost.
            lost, topic = own.lost_share(), own.topic
            silent = not lost and own.silent_s > max(SILENCE_S, SILENT_PERIODS * period / NANOSECONDS)
            share = math.inf if silent else max(lost, missing)
            text = own.silence if silent else f"{share:.0%} of the messages on {topic} get lost; {loss_advice(own)}"
            if not silent and share >= MISSING_SHARE * (LASTING if topic in self._health.losses else 1):
                losses[topic] = text
            elif not silent:
                share, text = 0.0, f"the messages on {topic} get through again"
            if own.tells:
                self._health.missing(f"losses on {topic}", share, text)
        self._health.losses = losses
        if parameters["image_is_rectified"] != self._rectified:
            self._rectified = parameters["image_is_rectified"]
            if self.camera_info is not None:
                self._use_camera(self.camera_info)

    def silent(self) -> str:
        """Which of the sensors, by its name, sends nothing, for a person; "" if both send or have no names."""
        told = zip((self._inputs.camera, self._inputs.lidar), self.adaptive, strict=False)
        return ", ".join(f"nothing comes from {name} on {own.topic}" for name, own in told if name and own.silent_s > SILENT_S)

    def _forward(self, is_image: bool, stamp: int, message: Any) -> None:
        try:
            self._pipeline.add(is_image, stamp, message)
        finally:
            self._own.processed.receive(message.header)

    def _on_camera_info(self, stamp: int, msg: Serialized) -> None:
        if self.camera_info is None or msg.data[AFTER_STAMP:] != self.camera_info.data[AFTER_STAMP:]:
            self._use_camera(msg)

    def _use_camera(self, msg: Serialized) -> None:
        try:
            camera = decode_camera_info(msg.message(), self._rectified)
        except CalibrationError as error:
            self._health.error(str(error), "CameraInfo")
            return
        self.camera_info = msg
        self._pipeline.set_camera(camera)


def motion_source(name: str) -> MotionSource | None:
    """What the parameter motion_source names, None for none. MissingDependencyError without nav_msgs where it is needed."""
    if name == "none":
        return None
    if name == "imu":
        return Imu, lambda msg: (None, None if msg.angular_velocity_covariance[0] == -1 else _turn_deg_s(msg.angular_velocity))
    if name == "twist":
        return TwistStamped, lambda msg: (_length(msg.twist.linear), _turn_deg_s(msg.twist.angular))
    try:
        from nav_msgs.msg import Odometry
    except ImportError:
        raise MissingDependencyError(
            "motion_source: odom needs nav_msgs; install it (apt: ros-<distro>-nav-msgs) or set motion_source to twist or imu"
        ) from None
    return Odometry, lambda msg: (_length(msg.twist.twist.linear), _turn_deg_s(msg.twist.twist.angular))


def _length(vector: Any) -> float:
    return float(np.linalg.norm([vector.x, vector.y, vector.z]))


def _turn_deg_s(vector: Any) -> float:
    return float(np.rad2deg(_length(vector)))
