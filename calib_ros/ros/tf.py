"""/tf_static in and out, where tf2_msgs is installed."""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from calib_ros import se3
from calib_ros.datasets.bag_file import StaticTransforms
from calib_ros.errors import MissingDependencyError
from calib_ros.result import Result
from calib_ros.ros.conversions import transform_message

OWN_TRANSFORMS = 16  # published transforms that are recognised when they are received: one of the newest
WAIT_S = 2.0  # static transforms are latched: discovery of their publishers takes about a second
QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


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
        self._node = node
        self._tree = StaticTransforms()
        self._since = time.monotonic()
        self._type = _tf_message()
        self._publisher: Any = None
        self._own: deque[NDArray[np.float64]] = deque(maxlen=OWN_TRANSFORMS)
        self._lock = threading.Lock()  # a worker publishes, the executor switches
        self._listening = listen and self._type is not None
        if self._listening:
            node.create_subscription(self._type, "/tf_static", self._tree.add, QOS)
        if publish:
            self.switch(True)

    @property
    def missing(self) -> str:
        """Why nothing can be published, for a person; "" if it can."""
        if self._type is not None:
            return ""
        return "publish_tf needs tf2_msgs; install it (apt: ros-<distro>-tf2-msgs) or set publish_tf to false"

    def switch(self, on: bool) -> None:
        """Publish from now on, or take back what was published: who joins later does not get it any more."""
        if on and self.missing:
            raise MissingDependencyError(self.missing)
        with self._lock:
            if on and self._publisher is None:
                self._publisher = self._node.create_publisher(self._type, "/tf_static", LATCHED)
            elif not on and self._publisher is not None:
                self._node.destroy_publisher(self._publisher)
                self._publisher = None

    def lookup(self, camera_frame: str, lidar_frame: str) -> tuple[NDArray[np.float64] | None, bool]:
        """T_camera_lidar (4, 4) or None, and whether it is worth asking again."""
        if not self._listening:
            return None, False
        T = self._tree.lookup(camera_frame, lidar_frame)
        return T, T is None and time.monotonic() - self._since < WAIT_S

    def is_own(self, T: NDArray[np.float64]) -> bool:
        """True if this node published T_camera_lidar (4, 4) itself, which it receives like anybody else."""
        with self._lock:
            return any(np.allclose(T, own, atol=1e-6) for own in self._own)

    def publish(self, result: Result, parent: str, stamp: int) -> None:
        """Publish the extrinsic if switched on; parent 'lidar' inverts it."""
        T, camera, lidar = result.T_camera_lidar, result.camera_frame, result.lidar_frame
        message = (
            transform_message(T, camera, lidar, stamp)
            if parent == "camera"
            else transform_message(se3.inverse(T), lidar, camera, stamp)
        )
        with self._lock:
            if self._publisher is not None:
                self._own.append(T)
                self._publisher.publish(self._type(transforms=[message]))
