"""What the node listens to: image, cloud, CameraInfo, and what tells how fast the vehicle moves."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import TwistStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu, PointCloud2

from calib_ros.camera import Camera
from calib_ros.errors import CalibrationError, MissingDependencyError
from calib_ros.messages import decode_camera_info, stamp_ns
from calib_ros.online.pipeline import OnlinePipeline
from calib_ros.ros.adaptive import AdaptiveSubscription
from calib_ros.ros.health import Health
from calib_ros.ros.parameters import Parameters

MOTION_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


class Sensors:
    """The subscriptions; hands every message over to the pipeline. camera_info: the newest usable CameraInfo, None before."""

    def __init__(self, node: Node, parameters: Parameters, pipeline: OnlinePipeline, health: Health) -> None:
        self.camera_info: CameraInfo | None = None
        self._pipeline, self._health = pipeline, health
        self._rectified = parameters["image_is_rectified"]
        image = CompressedImage if parameters["image_transport"] == "compressed" else Image
        wanted = parameters["reliability"]
        self.image = AdaptiveSubscription(node, image, "image", health.timed(self._on_image), wanted)
        self.points = AdaptiveSubscription(node, PointCloud2, "points", health.timed(self._on_points), wanted)
        # A camera's driver may say once, latched, what never changes.
        self.info = AdaptiveSubscription(
            node, CameraInfo, "camera_info", health.timed(self._on_camera_info), wanted, latched=True
        )
        self.adaptive = (self.image, self.points, self.info)
        source = parameters["motion_source"]
        if source != "none":
            kind, decode = _motion_message(source)

            def on_motion(msg: Any) -> None:
                pipeline.speed_gate.measured(stamp_ns(msg.header.stamp), *decode(msg))

            node.create_subscription(kind, source, health.timed(on_motion), MOTION_QOS)

    def check(self, parameters: Parameters) -> None:
        """To be called about once a second: follow the publishers and the parameters."""
        for subscription in self.adaptive:
            subscription.preference = parameters["reliability"]
            problem = subscription.check()
            if problem:
                self._health.error(problem)
        if parameters["image_is_rectified"] != self._rectified:
            self._rectified = parameters["image_is_rectified"]
            if self.camera_info is not None:
                self._on_camera_info(self.camera_info)

    def _on_image(self, msg: Any) -> None:
        self._pipeline.add_image(stamp_ns(msg.header.stamp), msg)

    def _on_points(self, msg: PointCloud2) -> None:
        self._pipeline.add_cloud(stamp_ns(msg.header.stamp), msg)

    def _on_camera_info(self, msg: CameraInfo) -> None:
        try:
            camera: Camera = decode_camera_info(msg, self._rectified)
        except CalibrationError as error:
            self._health.error(str(error))
            return
        self.camera_info = msg
        self._pipeline.set_camera(camera)


def _motion_message(source: str) -> tuple[type[Any], Callable[[Any], tuple[float | None, float | None]]]:
    """Message type of a motion source, and what makes speed, m/s, and turn rate, deg/s, of it; None = not told.

    MissingDependencyError without nav_msgs where it is needed.
    """
    if source == "imu":
        return Imu, lambda msg: (None, None if msg.angular_velocity_covariance[0] == -1 else _turn(msg.angular_velocity))
    if source == "twist":
        return TwistStamped, lambda msg: (_length(msg.twist.linear), _turn(msg.twist.angular))
    try:
        from nav_msgs.msg import Odometry
    except ImportError:
        raise MissingDependencyError(
            "motion_source: odom needs nav_msgs; install it (apt: ros-<distro>-nav-msgs) or set motion_source to twist or imu"
        ) from None
    return Odometry, lambda msg: (_length(msg.twist.twist.linear), _turn(msg.twist.twist.angular))


def _length(vector: Any) -> float:
    return float(np.linalg.norm([vector.x, vector.y, vector.z]))


def _turn(vector: Any) -> float:
    return float(np.rad2deg(_length(vector)))
