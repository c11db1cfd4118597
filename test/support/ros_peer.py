"""A peer of the node under test: publishes frames as real messages and listens to everything the node says."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
import rclpy
from calib_ros_msgs.msg import Extrinsic
from calib_ros_msgs.srv import GetExtrinsic
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TransformStamped
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from ros_messages import Messages
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_srvs.srv import Trigger

from calib_ros import se3
from calib_ros.frame import Frame, PointCloud
from calib_ros.ros.conversions import image_message, time_message
from calib_ros.ros.node import CalibNode

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def camera_info_message(frame: Frame, frame_id: str = "camera") -> CameraInfo:
    camera = frame.camera
    msg = CameraInfo(width=camera.width, height=camera.height, distortion_model=camera.model)
    msg.header.frame_id, msg.header.stamp = frame_id, time_message(frame.stamp)
    msg.k, msg.d = camera.K.ravel(), camera.D.tolist()
    msg.p = np.c_[camera.K, np.zeros(3)].ravel()
    return msg


def cloud_message(
    cloud: PointCloud, stamp: int, frame_id: str = "velodyne", drop: tuple[str, ...] = (), big: bool = False
) -> PointCloud2:
    """PointCloud2 with the cloud's fields except those in `drop`; big = big-endian."""
    columns = [*zip("xyz", cloud.xyz.T, ["f4"] * 3, strict=True)]
    columns += [("intensity", cloud.intensity, "f4"), ("ring", cloud.ring, "u2"), ("time", cloud.time, "f4")]
    columns = [column for column in columns if column[1] is not None and column[0] not in drop]
    packed = np.empty(len(cloud), [(name, (">" if big else "<") + kind) for name, _, kind in columns])
    for name, values, _ in columns:
        packed[name] = values
    return Messages("rclpy").cloud(packed, stamp=stamp, frame=frame_id)


def start_parameters(T: np.ndarray) -> dict[str, Any]:
    """Parameters of the initial extrinsic T."""
    return {
        "initial_translation_m": T[:3, 3].tolist(),
        "initial_quaternion_xyzw": se3.quaternion_from_rotation(T[:3, :3]).tolist(),
    }


def errors_to(reference: np.ndarray, T: np.ndarray) -> tuple[float, float]:
    """Degrees and metres."""
    return se3.rotation_error_deg(reference, T), se3.translation_error_m(reference, T)


class Peer:
    """The node under test and a peer node in one process, each with its own executor thread, over real DDS.

    node_type: a managed node is to be configured by the test. parameters: of the node, with __ for the dot. Without others than
    these it runs no networks, makes an estimate at every keyframe, and may use a core: tests send frames faster than a vehicle
    does.
    """

    def __init__(self, image_type: Any = Image, node_type: Any = CalibNode, **parameters: Any) -> None:
        parameters.setdefault("semantics__segmentation", "none")  # the network takes 83 ms per keyframe
        parameters.setdefault("online__rest_period_s", 0.0)
        parameters.setdefault("online__rest_spacing_s", 0.0)
        parameters.setdefault("online__max_load", 1.0)
        self.context = Context()
        rclpy.init(context=self.context)
        overrides = [Parameter(name.replace("__", "."), value=value) for name, value in parameters.items()]
        self.node = node_type(context=self.context, parameter_overrides=overrides)
        self.peer = rclpy.create_node("peer", context=self.context)
        reliable = QoSProfile(depth=50, reliability=ReliabilityPolicy.RELIABLE)
        self.image_pub = self.peer.create_publisher(image_type, "image", reliable)
        self.info_pub = self.peer.create_publisher(CameraInfo, "camera_info", reliable)
        self.cloud_pub = self.peer.create_publisher(PointCloud2, "points", reliable)
        self.extrinsics: list[Extrinsic] = []
        self.diagnostics: list[DiagnosticArray] = []
        self.peer.create_subscription(Extrinsic, "/calib_ros/extrinsic", self.extrinsics.append, LATCHED)
        self.peer.create_subscription(DiagnosticArray, "/diagnostics", self.diagnostics.append, 10)
        self._get = self.peer.create_client(GetExtrinsic, "/calib_ros/get_extrinsic")
        self._triggers = {
            name: self.peer.create_client(Trigger, f"/calib_ros/{name}") for name in ("calibrate", "reset", "save", "capture")
        }
        self._executors = [self._spin(self.node), self._spin(self.peer)]
        if self.calibration is not None:
            self.await_subscriptions()

    @property
    def calibration(self) -> Any:
        """All of the node but its kind; None while a managed node is not configured."""
        return self.node.calibration

    def await_subscriptions(self) -> None:
        """Wait until the node receives all sensors."""
        publishers = (self.image_pub, self.cloud_pub, self.info_pub)
        self.until(lambda: all(publisher.get_subscription_count() for publisher in publishers), what="the subscriptions")

    def _spin(self, node: Any) -> tuple[SingleThreadedExecutor, threading.Thread]:
        executor = SingleThreadedExecutor(context=self.context)
        executor.add_node(node)

        def run() -> None:
            with suppress(ExternalShutdownException):
                executor.spin()

        thread = threading.Thread(target=run)
        thread.start()
        return executor, thread

    def __enter__(self) -> Peer:
        return self

    def __exit__(self, *_: object) -> None:
        self.node.stop()
        for executor, thread in self._executors:
            executor.shutdown(timeout_sec=1.0)
            thread.join(5)
        self.node.destroy_node()
        self.peer.destroy_node()
        rclpy.try_shutdown(context=self.context)

    def until(self, condition: Callable[[], Any], seconds: float = 60.0, what: str = "") -> Any:
        """Wait until the condition holds; AssertionError after so many seconds, far more than it takes on an idle machine."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            value = condition()
            if value:
                return value
            time.sleep(0.01)
        last = self.last_error() if self.calibration is not None else "none, not configured"
        raise AssertionError(f"did not happen within {seconds} s: {what or condition}; last errors: {last}")

    def publish(self, frame: Frame, settle: bool = True, **cloud_options: Any) -> None:
        """One frame as three messages; settle = wait until the node has worked it off."""
        counts = self.calibration.pipeline.synchronizer.counts
        pairs = counts.pairs
        self.info_pub.publish(camera_info_message(frame))
        self.until(lambda: self.calibration.pipeline.camera is not None)
        self.image_pub.publish(image_message(frame.image, "camera", frame.stamp))
        self.cloud_pub.publish(cloud_message(frame.cloud, frame.cloud_stamp or frame.stamp, **cloud_options))
        if settle:
            self.until(lambda: counts.pairs > pairs, what="a pair")
            self.settle()

    def settle(self) -> None:
        """Wait until the node's threads are idle."""
        with self.calibration.pipeline._lock:  # a pair is counted under it, and queued
            pass
        assert self.calibration.pipeline.wait_idle(120)

    def get_extrinsic(self) -> GetExtrinsic.Response:
        return self._call(self._get, GetExtrinsic.Request())

    def trigger(self, name: str, seconds: float = 60.0) -> Trigger.Response:
        return self._call(self._triggers[name], Trigger.Request(), seconds)

    def _call(self, client: Any, request: Any, seconds: float = 20.0) -> Any:
        assert client.wait_for_service(10)
        future = client.call_async(request)
        self.until(future.done, seconds, client.srv_name)
        return future.result()

    def last_error(self) -> str:
        return self.calibration.health._last_error[0]

    def warns(self, *texts: str) -> bool:
        """Whether the newest diagnostics are a warning with these texts."""
        if not self.diagnostics:
            return False
        status = self.diagnostics[-1].status[0]
        return status.level == DiagnosticStatus.WARN and all(text in status.message for text in texts)

    def latched(self, kind: type[Any], topic: str, seconds: float = 10.0) -> Any:
        """What a client that joins now gets from a latched topic."""
        got: list[Any] = []
        subscription = self.peer.create_subscription(kind, topic, got.append, LATCHED)
        self.until(lambda: got, seconds, topic)
        self.peer.destroy_subscription(subscription)
        return got[-1]


__all__ = ["LATCHED", "Peer", "TransformStamped", "camera_info_message", "cloud_message"]
