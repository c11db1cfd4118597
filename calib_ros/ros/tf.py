"""/tf_static in and out, where tf2_msgs is installed."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.datasets.bag_file import StaticTransforms
from calib_ros.errors import BadInputError, MissingDependencyError
from calib_ros.online.pipeline import Pipeline
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.online.state import Provenance, load_state, read_state, save_state
from calib_ros.registration.initial_guess import nominal, nominal_start
from calib_ros.result import INITIAL, InitialSource, Result
from calib_ros.ros.conversions import transform_message
from calib_ros.ros.parameters import Parameters

OWN = 16  # published transforms that are known again: received is one of the newest
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
        self._own: deque[NDArray[np.float64]] = deque(maxlen=OWN)
        self._lock = threading.Lock()  # a worker publishes, the executor switches
        self._listening = listen and self._type is not None
        if self._listening:
            node.create_subscription(self._type, "/tf_static", self._tree.add, QOS)
        if publish:
            self.switch(True)

    @property
    def missing(self) -> str:
        """Why nothing can be published, in words, or ''."""
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
        """True if T_camera_lidar (4, 4) is what this node published itself, which it receives like anybody else."""
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


# Where the extrinsic starts from, and where the last good one is kept.
class InitialExtrinsic:
    """Saved state, parameters, TF, nominal, in this order.

    parameters: gives the current ones. error: takes one line for a person.
    """

    def __init__(self, parameters: Callable[[], Parameters], tf: StaticTf, error: Callable[[str], None]) -> None:
        self._parameters, self._tf, self._error = parameters, tf, error
        self._told = ""

    def choose(self, camera: Camera, camera_frame: str, lidar_frame: str) -> Result | None:
        """The extrinsic to start from; None while TF may still come."""
        parameters = self._parameters()
        path = parameters["state_file"]
        if path and os.path.exists(path):
            try:
                saved = load_state(path, camera, camera_frame, lidar_frame)
                return replace(saved, origin=InitialSource.SAVED_STATE)
            except BadInputError as error:
                if str(error) != self._told:  # asked again with every pair while TF may still come
                    self._told = str(error)
                    self._error(str(error))
        given = parameters.initial()
        if given is not None:
            return given
        T, pending = self._tf.lookup(camera_frame, lidar_frame)
        if T is not None:
            return Result(T, INITIAL, "from TF", origin=InitialSource.TF)
        if pending:
            return None
        return nominal_start(parameters["nominal_yaw_deg"])

    def beforehand(self) -> Result:
        """The same before any message has told which sensors these are, as far as the parameters do not deny it; without TF."""
        parameters = self._parameters()
        return self._saved() or parameters.initial() or Result(nominal(parameters["nominal_yaw_deg"]), INITIAL)

    def superseded_by_tf(self, recalibrator: Recalibrator) -> bool:
        """True if TF tells by now what a nominal start stood in for, and no estimate has been accepted since."""
        initial = recalibrator.tracker.initial
        if initial.origin is not InitialSource.NOMINAL or recalibrator.current.accepted:
            return False
        T = self._tf.lookup(initial.camera_frame, initial.lidar_frame)[0]
        if T is None or self._tf.is_own(T):
            return False
        return not np.allclose(T, initial.T_camera_lidar, atol=1e-6)

    def save(self, result: Result, pipeline: Pipeline, stamp: int) -> str:
        """Write an accepted estimate to the state file: "saved to ..." or why not. stamp: ns, of the newest data in it."""
        path, camera, recalibrator = self._parameters()["state_file"], pipeline.camera, pipeline.recalibrator
        if not path or camera is None or recalibrator is None:
            return "nothing saved: set the parameter state_file to a path"
        accepted, keyframes = recalibrator.current.accepted, recalibrator.keyframes_seen
        try:
            save_state(path, result, camera, Provenance.of(recalibrator.config, accepted, keyframes, stamp))
        except BadInputError as error:
            self._error(str(error))
            return str(error)
        return f"saved to {path}"

    def _saved(self) -> Result | None:
        parameters = self._parameters()
        path = parameters["state_file"]
        if not path or not os.path.exists(path):
            return None
        try:
            saved = read_state(path).result
        except BadInputError:
            return None  # said when the sensors are known and the start is chosen
        names = ((parameters["camera_frame"], saved.camera_frame), (parameters["lidar_frame"], saved.lidar_frame))
        if any(wanted and wanted != found for wanted, found in names):
            return None
        return replace(saved, status=INITIAL, reason="from the saved state", origin=InitialSource.SAVED_STATE)
