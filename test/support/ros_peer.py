"""A peer of the node under test: publishes frames as real messages and listens to everything the node says."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Any

import numpy as np
import rclpy
from calib_ros_msgs.action import Calibrate
from calib_ros_msgs.msg import Extrinsic
from calib_ros_msgs.srv import GetExtrinsic
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from ros_messages import Messages
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_srvs.srv import Trigger
from waiting import LIMIT_S, until

from calib_ros import se3
from calib_ros.frame import Frame, PointCloud
from calib_ros.online.pacing import LoadBudget
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


class Goal:
    """A goal of ~/calibrate. accepted: by the node; feedback: so far."""

    def __init__(self, client: ActionClient, until: Callable[..., Any]) -> None:
        """until: waits for a condition while the node's executor turns."""
        self._until, self.feedback = until, []
        assert client.wait_for_server(LIMIT_S)
        sent = client.send_goal_async(Calibrate.Goal(), feedback_callback=lambda said: self.feedback.append(said.feedback))
        until(sent.done, "an answer to the goal")
        self._handle = sent.result()
        self.accepted = self._handle.accepted
        self._result = self._handle.get_result_async() if self.accepted else None

    def await_feedback(self) -> None:
        """Wait until the estimate is under way."""
        self._until(lambda: self.feedback, "feedback")

    def cancel(self) -> bool:
        """Whether the node cancels it."""
        asked = self._handle.cancel_goal_async()
        self._until(asked.done, "an answer to the cancel")
        return bool(asked.result().goals_canceling)

    def result(self) -> tuple[int, Calibrate.Result]:
        """GoalStatus and result, once it is over."""
        self._until(self._result.done, "the goal's result")
        answer = self._result.result()
        return answer.status, answer.result


class NodeAndPeer:
    """The node under test and a peer node in one process, each with its own executor thread, over real DDS. parameters: of the
    node, with __ for the dot."""

    def __init__(self, node_type: Any, parameters: dict[str, Any]) -> None:
        self.context = Context()
        rclpy.init(context=self.context)
        self.node = node_type(context=self.context, parameter_overrides=_values(parameters))
        self.peer = rclpy.create_node("peer", context=self.context)
        self._executors: list[tuple[SingleThreadedExecutor, threading.Thread]] = []

    def spin(self) -> None:
        """To be called when the peer has all it listens with."""
        for node in (self.node, self.peer):
            executor = SingleThreadedExecutor(context=self.context)
            executor.add_node(node)
            thread = threading.Thread(target=_spin, args=(executor,))
            thread.start()
            self._executors.append((executor, thread))

    def __enter__(self) -> Any:
        return self

    def __exit__(self, *_: object) -> None:
        self.node.stop()
        for executor, thread in self._executors:
            executor.shutdown(timeout_sec=LIMIT_S)
            thread.join(LIMIT_S)
        self.node.destroy_node()
        self.peer.destroy_node()
        rclpy.try_shutdown(context=self.context)

    @property
    def calibration(self) -> Any:
        """All of the node but its kind; None while a managed node is not configured."""
        return self.node.calibration

    def last_error(self) -> str:
        """The newest problem; none while a managed node is not configured."""
        return self.calibration.health.last_error[0] if self.calibration is not None else ""

    def until(self, condition: Callable[[], Any], what: object = "") -> Any:
        """Wait until the condition holds."""
        return until(condition, what, state=lambda: f"last error: {self.last_error()}")

    def change(self, **named: Any) -> None:
        """Set parameters of the node, with __ for the dot, all at once; they must be taken."""
        assert self.set(**named) == ""

    def set(self, **named: Any) -> str:
        """The same; why they are refused, "" if they are taken."""
        answer = self.node.set_parameters_atomically(_values(named))
        return "" if answer.successful else answer.reason or "refused"

    def call(self, client: Any, request: Any) -> Any:
        """The answer of a service."""
        future = self.call_async(client, request)
        self.until(future.done, client.srv_name)
        return future.result()

    def call_async(self, client: Any, request: Any) -> Any:
        """The future of the answer."""
        assert client.wait_for_service(LIMIT_S)
        return client.call_async(request)


def _values(named: dict[str, Any]) -> list[Parameter]:
    return [Parameter(name.replace("__", "."), value=value) for name, value in named.items()]


def _spin(executor: SingleThreadedExecutor) -> None:
    with suppress(ExternalShutdownException, InvalidHandle):  # rclpy may wake what is being shut down
        executor.spin()


class Peer(NodeAndPeer):
    """The node under test and a peer node for its sensors.

    node_type: a managed node is to be configured by the test. parameters: of the node, with __ for the dot. Without others than
    these it runs no networks and makes an estimate at every keyframe, though tests send frames faster than a vehicle does; data
    do not grow too old, and CPU time is no matter.
    """

    def __init__(self, image_type: Any = Image, node_type: Any = CalibNode, **parameters: Any) -> None:
        parameters.setdefault("semantics__segmentation", "none")  # the network takes 83 ms per keyframe
        parameters.setdefault("online__rest_period_s", 0.0)
        parameters.setdefault("online__max_load", 1.0)
        parameters.setdefault("max_data_age_s", 3600.0)
        super().__init__(node_type, parameters)
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
        # Before its node spins: rclpy shows an action client to the executor before it has made its lock.
        self._calibrate = ActionClient(self.peer, Calibrate, "/calib_ros/calibrate")
        self.spin()
        if self.calibration is not None:
            self.await_subscriptions()

    @property
    def pipeline(self) -> Any:
        """The node's pipeline."""
        return self.calibration.pipeline

    @property
    def recalibrator(self) -> Any:
        """The pipeline's recalibrator; None before the first pair."""
        return self.pipeline.recalibrator

    @property
    def values(self) -> dict[str, str]:
        """The newest values of the extrinsic's status on /diagnostics."""
        return {v.key: v.value for v in self.diagnostics[-1].status[0].values} if self.diagnostics else {}

    def new_values(self) -> dict[str, str]:
        """Values that were made after this call."""
        count = len(self.diagnostics)
        self.until(lambda: len(self.diagnostics) > count + 1, "diagnostics")  # the first of them may have been made before
        return self.values

    def await_subscriptions(self) -> None:
        """Wait until an active node receives all sensors: both sides of the discovery, or a first message may be lost."""
        publishers = (self.image_pub, self.cloud_pub, self.info_pub)
        self.until(lambda: all(publisher.get_subscription_count() for publisher in publishers), "the subscriptions")
        adaptive = self.calibration.sensors.adaptive
        self.until(lambda: all(follows._current.get_publisher_count() for follows in adaptive), "the publishers")
        self.pipeline.load = LoadBudget(self.pipeline.config.online, lambda: 1000 * time.monotonic())

    def publish(self, frame: Frame, settle: bool = True, **cloud_options: Any) -> None:
        """One frame as three messages; settle = wait until the node has worked it off."""
        counts = self.pipeline.pairing.synchronizer.counts
        pairs = counts.pairs
        self.publish_camera(frame)
        self.image_pub.publish(image_message(frame.image, "camera", frame.stamp))
        self.cloud_pub.publish(cloud_message(frame.cloud, frame.cloud_stamp or frame.stamp, **cloud_options))
        if settle:
            self.until(lambda: counts.pairs > pairs, "a pair")
            self.settle()

    def drive(self, frames: Iterable[Frame], **cloud_options: Any) -> None:
        """Publish frames, each when the node has worked off the one before."""
        for frame in frames:
            self.publish(frame, **cloud_options)

    def refusal(self, name: str) -> str:
        """What a service says that must not succeed, in one line."""
        answer = self.trigger(name)
        assert not answer.success
        assert "\n" not in answer.message
        return str(answer.message)

    def publish_camera(self, frame: Frame) -> None:
        """A frame's CameraInfo; afterwards the node knows a camera."""
        self.info_pub.publish(camera_info_message(frame))
        self.until(lambda: self.pipeline.camera is not None, "the camera")

    def send(self, image: Any, cloud: Any) -> None:
        """An image and a cloud that may not become a pair; the node has worked them off afterwards."""
        counts = self.pipeline.pairing.synchronizer.counts
        images, clouds = counts.images, counts.clouds
        self.image_pub.publish(image)
        self.cloud_pub.publish(cloud)
        self.until(lambda: counts.images > images and counts.clouds > clouds, "an image and a cloud")
        self.settle()

    def settle(self) -> None:
        """Wait until the node's threads are idle."""
        with self.pipeline._lock:  # a pair is counted under it, and queued
            pass
        assert self.pipeline.wait_idle(LIMIT_S)

    def goal(self) -> Goal:
        """A goal of ~/calibrate that the node has answered."""
        return Goal(self._calibrate, self.until)

    def get_extrinsic(self) -> GetExtrinsic.Response:
        return self.call(self._get, GetExtrinsic.Request())

    def trigger(self, name: str) -> Trigger.Response:
        return self.call(self._triggers[name], Trigger.Request())

    def warns(self, *texts: str) -> bool:
        """Whether the newest diagnostics are a warning with these texts."""
        if not self.diagnostics:
            return False
        status = self.diagnostics[-1].status[0]
        return status.level == DiagnosticStatus.WARN and all(text in status.message for text in texts)

    def listen(self, kind: type[Any], topic: str, qos: Any = LATCHED) -> list[Any]:
        """What comes on a topic from now on, and what a latched one holds."""
        got: list[Any] = []
        self.peer.create_subscription(kind, topic, got.append, qos)
        return got

    def latched(self, kind: type[Any], topic: str) -> Any:
        """What a client that joins now gets from a latched topic."""
        got = self.listen(kind, topic)
        self.until(lambda: got, topic)
        return got[-1]
