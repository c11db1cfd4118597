"""What a node with a rig says of all its sensors, with pictures and clouds that are asked for in turn while somebody looks."""

from __future__ import annotations

import itertools
import re
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from calib_ros_msgs.msg import Extrinsic as ExtrinsicMsg
from calib_ros_msgs.msg import Rig
from calib_ros_msgs.srv import GetKeyframes
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2

from calib_ros.arrays import Matrix
from calib_ros.errors import CalibrationError
from calib_ros.messages import decode_cloud
from calib_ros.result import CONVERGED, INITIAL, MOVED, Result
from calib_ros.rig.description import CAMERA, LIDAR
from calib_ros.rig.graph import at_sensor, worst_sigmas
from calib_ros.ros.client import result_from_message
from calib_ros.ros.conversions import covariance_from_ros, matrix_from_transform
from calib_ros_view.node.watch import LATCHED, Watch
from calib_ros_view.session.live import BAD, DOUBTFUL, LEVELS, SILENT_S
from calib_ros_view.session.rig_shown import (
    DOUBTED,
    REJECTED,
    EdgeShown,
    LoopShown,
    Pair,
    RigShown,
    SensorShown,
    compared,
)

CLOUD = "sensor_msgs/msg/PointCloud2"
KIND = "registration"
TILE_WIDTH = 480  # px
VIEW_DEG = (32.0, 20.0)  # half of what a camera sees, across and upwards, where its intrinsics are not known
PATIENCE_S = 10.0  # in which a picture or a cloud comes, or the next one's turn is
LOOK_S = 3.0  # after which a page that does not say so again is not looked at any more
NOT_HEARD = "The node is not heard any more; this is the last known."
NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


class RigWatch:
    """A node with a rig, for its page, on the thread of a watch of that node; `rig` stays None where it has none.

    See `RigSession` for tiles, which are of pairs here, clouds, version and problem. A picture is that of the newest keyframe of
    a pair, which the node draws on request; a second apart one of them is asked for, and one of the clouds that the node itself
    listens to is received.
    """

    def __init__(self, watch: Watch) -> None:
        self.name, self.problem, self.version = watch.name, "", 0
        self.rig: RigShown | None = None
        self.tiles: dict[str, bytes] = {}
        self.clouds: dict[str, NDArray[np.float32]] = {}
        self._lock = watch.lock
        self._message: Rig | None = None
        self._heard = 0.0
        self._pairs: dict[Pair, tuple[Result, bool] | None] = {}  # what each has said, and whether it is usable
        self._clients: dict[Pair, Any] = {}
        self._looked = -LOOK_S
        self._turns, self._cloud_turns = itertools.count(), itertools.count()
        self._asked: tuple[Any, Any, float] | None = None  # client, future, since when
        self._cloud: tuple[Any, float] | None = None  # subscription, since when
        self._had_cloud = False
        self._node: Node
        watch.on_its_thread(self._begin)

    def pairs_of(self, tile: str) -> Sequence[Pair]:
        """See `RigSession`."""
        return [pair for pair in self._pairs if "/".join(pair) == tile]

    @property
    def pairs(self) -> list[Pair]:
        """Cameras and LiDARs that have been heard of."""
        return list(self._pairs)

    def corners(self, camera: str) -> Matrix:
        """See `RigSession`; the node does not say what a camera sees."""
        u, v = np.tan(np.deg2rad(VIEW_DEG))
        return np.array([[-u, -v, 1.0], [u, -v, 1.0], [u, v, 1.0], [-u, v, 1.0]])

    def look(self) -> None:
        """Somebody looks; to be called again within LOOK_S."""
        self._looked = time.monotonic()

    # ---- the watch's thread -------------------------------------------------------------------------------------------

    def _begin(self, node: Node) -> None:
        self._node = node
        node.create_subscription(Rig, f"{self.name}/rig", self._on_rig, LATCHED)
        node.create_timer(1.0, self._every_second)

    def _on_rig(self, message: Rig) -> None:
        self._heard, self._message = time.monotonic(), message
        self._find_pairs()
        self._show()

    def _find_pairs(self) -> None:
        own = re.compile(re.escape(self.name) + r"/(\w+)/(\w+)/extrinsic")
        for topic, _ in self._node.get_topic_names_and_types():
            if (found := own.fullmatch(topic)) and found.groups() not in self._pairs:
                pair = found[1], found[2]
                with self._lock:
                    self._pairs[pair] = None
                self._node.create_subscription(ExtrinsicMsg, topic, lambda m, p=pair: self._on_extrinsic(p, m), LATCHED)
                self._clients[pair] = self._node.create_client(GetKeyframes, f"{self.name}/{'/'.join(pair)}/keyframes")

    def _on_extrinsic(self, pair: Pair, message: ExtrinsicMsg) -> None:
        try:
            told = result_from_message(message), bool(message.usable)
        except CalibrationError:
            return  # the page of the pair says so
        with self._lock:
            self._pairs[pair] = told

    def _every_second(self) -> None:
        if self._message is None:
            return
        self._find_pairs()
        now = time.monotonic()
        gone = now - self._heard > SILENT_S
        if gone != bool(self.problem):
            self.problem, self.version = NOT_HEARD if gone else "", self.version + 1
        wanted = now - self._looked < LOOK_S and not gone
        self._next_picture(wanted)
        self._next_cloud(wanted)

    def _next_picture(self, wanted: bool) -> None:
        if self._asked is not None and time.monotonic() - self._asked[2] > PATIENCE_S:
            self._asked[0].remove_pending_request(self._asked[1])
            self._asked = None
        if not wanted or self._asked is not None or not self._pairs:
            return
        pair = list(self._pairs)[next(self._turns) % len(self._pairs)]
        client = self._clients[pair]
        if client.service_is_ready():
            future = client.call_async(GetKeyframes.Request(max_keyframes=1, max_width=TILE_WIDTH))
            self._asked = client, future, time.monotonic()
            future.add_done_callback(lambda done: self._drawn("/".join(pair), done))

    def _drawn(self, tile: str, future: Any) -> None:
        self._asked = None
        if future.exception() is None and future.result().keyframes:
            self.tiles[tile] = bytes(future.result().keyframes[0].data)
            self.version += 1

    def _next_cloud(self, wanted: bool) -> None:
        if self._cloud is not None:
            if not self._had_cloud and wanted and time.monotonic() - self._cloud[1] < PATIENCE_S:
                return
            self._node.destroy_subscription(self._cloud[0])
            self._cloud, self._had_cloud = None, False
        if not wanted:
            return
        space, _, name = self.name.rpartition("/")
        try:
            heard = self._node.get_subscriber_names_and_types_by_node(name, space or "/")
        except Exception:  # ROS lists the node no more
            return
        topics = sorted(topic for topic, kinds in heard if CLOUD in kinds)
        if topics:
            topic = topics[next(self._cloud_turns) % len(topics)]
            subscription = self._node.create_subscription(PointCloud2, topic, self._on_cloud, NEWEST, raw=True)
            self._cloud = subscription, time.monotonic()

    def _on_cloud(self, data: bytes) -> None:
        """The first one; further ones until the subscription has gone cost next to nothing."""
        if self._had_cloud or self._message is None:
            return
        self._had_cloud = True
        message = deserialize_message(data, PointCloud2)
        names = [own.name for own in self._message.sensors if own.transform.child_frame_id == message.header.frame_id]
        try:
            if names:
                self.clouds[names[0]] = decode_cloud(message).finite().xyz
                self.version += 1
        except CalibrationError:
            return  # the node says so

    def _show(self) -> None:
        """Put together what was heard."""
        message = self._message
        assert message is not None
        cameras = {camera for camera, _ in self._pairs}
        sensors = tuple(self._sensor(own, CAMERA if own.name in cameras else LIDAR) for own in message.sensors)
        loops = tuple(
            LoopShown(tuple(own.sensors), own.rotation_deg, own.translation_m, own.p_value, own.closes) for own in message.loops
        )
        rig = RigShown(message.reference, sensors, (), loops, message.text)
        with self._lock:
            edges = tuple(self._edge(pair, told, rig, message) for pair, told in self._pairs.items())
        edges += tuple(self._edge_of_lidars(own, rig) for own in message.edges if own.kind != KIND)
        self.rig, self.version = replace(rig, edges=edges), self.version + 1

    def _sensor(self, own: Any, kind: str) -> SensorShown:
        T, C = matrix_from_transform(own.transform.transform), covariance_from_ros(own.covariance)
        moved = (own.moved_deg, own.moved_m) if own.moved_deg or own.moved_m else None
        sigma = None if C is None else worst_sigmas(at_sensor(T, C))
        return SensorShown(own.name, kind, T, own.status, own.reason, own.usable, sigma, moved)

    def _edge_of_lidars(self, own: Any, rig: RigShown) -> EdgeShown:
        edge = EdgeShown(own.target, own.source, own.kind, own.status, LEVELS.get(own.status, BAD), own.reason)
        C = covariance_from_ros(own.covariance)
        return edge if C is None else compared(edge, matrix_from_transform(own.transform), C, rig.poses)

    def _edge(self, pair: Pair, told: tuple[Result, bool] | None, rig: RigShown, message: Rig) -> EdgeShown:
        if told is None:
            return EdgeShown(*pair, KIND, INITIAL, LEVELS[INITIAL])
        result, usable = told
        fate, level = result.status, LEVELS.get(result.status, BAD)
        level = DOUBTFUL if fate == CONVERGED and not usable else level
        for wrong, how, edges in ((DOUBTED, DOUBTFUL, message.doubted), (REJECTED, BAD, message.rejected)):
            if (*pair, KIND) in ((own.target, own.source, own.kind) for own in edges):
                fate, level = wrong, how
        edge = EdgeShown(*pair, KIND, fate, level, result.reason)
        if result.covariance_with_intrinsics is None or result.status in (INITIAL, MOVED):
            return edge
        return compared(edge, result.T_camera_lidar, result.covariance_with_intrinsics, rig.poses)
