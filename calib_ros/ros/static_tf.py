"""/tf_static in and out, where tf2_msgs is installed."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from calib_ros import se3
from calib_ros.datasets.static_transforms import StaticTransforms
from calib_ros.errors import MissingDependencyError
from calib_ros.result import Result
from calib_ros.ros.conversions import transform_message

WAIT_S = 2.0  # static transforms are latched: discovery of their publishers takes about a second
QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def _tf_message() -> Any:
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError:
        return None
    return TFMessage


class StaticTf:
    """Reads the static tree for an initial extrinsic, and publishes the extrinsic to it.

    MissingDependencyError if `publish` is asked for without tf2_msgs.
    """

    def __init__(self, node: Node, listen: bool, publish: bool) -> None:
        self._tree = StaticTransforms()
        self._since = time.monotonic()
        self._type = _tf_message()
        if publish and self._type is None:
            raise MissingDependencyError(
                "publish_tf needs tf2_msgs; install it (apt: ros-<distro>-tf2-msgs) or set publish_tf to false"
            )
        self._listening = listen and self._type is not None
        if self._listening:
            node.create_subscription(self._type, "/tf_static", self._tree.add, QOS)
        if publish:
            latched = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            self._publisher = node.create_publisher(self._type, "/tf_static", latched)

    def lookup(self, camera_frame: str, lidar_frame: str) -> tuple[NDArray[np.float64] | None, bool]:
        """T_camera_lidar (4, 4) or None, and whether it is worth asking again."""
        if not self._listening:
            return None, False
        T = self._tree.lookup(camera_frame, lidar_frame)
        return T, T is None and time.monotonic() - self._since < WAIT_S

    def publish(self, result: Result, parent: str, stamp: int) -> None:
        """Publish the extrinsic; parent 'lidar' inverts it."""
        T, camera, lidar = result.T_camera_lidar, result.camera_frame, result.lidar_frame
        message = (
            transform_message(T, camera, lidar, stamp)
            if parent == "camera"
            else transform_message(se3.inverse(T), lidar, camera, stamp)
        )
        self._publisher.publish(self._type(transforms=[message]))
