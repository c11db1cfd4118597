"""What one node says, of a pair or of a whole rig, for pages that show it; pictures and clouds only while somebody looks."""

from __future__ import annotations

import itertools
import re
import time
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from calib_ros_msgs.msg import Extrinsic as ExtrinsicMsg
from calib_ros_msgs.msg import Rig
from calib_ros_msgs.srv import GetKeyframes
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import Image, PointCloud2

from calib_ros.arrays import Matrix
from calib_ros.errors import CalibrationError
from calib_ros.messages import decode_cloud, decode_image
from calib_ros.result import CONVERGED, INITIAL, MOVED, Result
from calib_ros.rig.description import CAMERA, LIDAR
from calib_ros.rig.graph import at_sensor, worst_sigmas
from calib_ros.ros.client import result_from_message
from calib_ros.ros.conversions import advice_of, covariance_from_ros, matrix_from_transform
from calib_ros_check.rig.shown import BAD, DOUBTED, DOUBTFUL, LEVELS, REJECTED, EdgeShown, RigShown, SensorShown, compared
from calib_ros_view.node.calls import NodeClient
from calib_ros_view.session.live import SILENT_S, Diagnosis, NodeState, Pair

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
CLOUD = "sensor_msgs/msg/PointCloud2"
KIND = "registration"
OVERLAY_WIDTH, OVERLAY_QUALITY = 1600, 82  # px at most; of the JPEG
TILE_WIDTH = 480  # px
VIEW_DEG = (32.0, 20.0)  # half of what a camera sees, across and upwards, where its intrinsics are not known
PATIENCE_S = 10.0  # in which a picture or a cloud comes, or the next one's turn is
LOOK_S = 4.0  # after which a page that does not say so again is not looked at any more
NOT_HEARD = "The node is not heard any more; this is the last known."


class Watch(NodeClient):
    """Subscribes to one node; what it says of a pair is in `history`. overlay: the newest one, which comes while somebody looks,
    as the node draws it for subscribers only: JPEG, when, s since the epoch, and a number that rises.

    rig: what a node with a rig says of its sensors, None for one of a pair. See `RigSession` for tiles, which are of pairs here,
    clouds, version and problem. A tile is the newest keyframe of a pair, which the node draws on request; while somebody looks, a
    second apart one of them is asked for, and one of the clouds that the node itself listens to is received.
    """

    def listen(self) -> None:
        """See `NodeClient`."""
        self.overlay, self.problem, self.version = (b"", 0.0, 0), "", 0
        self.rig: RigShown | None = None
        self.tiles: dict[str, bytes] = {}
        self.clouds: dict[str, NDArray[np.float32]] = {}
        self._overlay_subscription: Any = None
        self._looked, self._heard = -LOOK_S, 0.0
        self._message: Rig | None = None
        self.pairs: dict[Pair, tuple[Result, bool] | None] = {}  # what each has said, and whether it is usable
        self._clients: dict[Pair, Any] = {}
        self._turns, self._cloud_turns = itertools.count(), itertools.count()
        self._asked: tuple[Any, Any, float] | None = None  # client, future, since when
        self._cloud: tuple[Any, float] | None = None  # subscription, since when
        self._had_cloud = False
        self._node.create_subscription(ExtrinsicMsg, f"{self.name}/extrinsic", self._on_extrinsic, LATCHED)
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        self._node.create_subscription(Rig, f"{self.name}/rig", self._on_rig, LATCHED)
        self._node.create_timer(1.0, self._every_second)
        self._node.create_timer(0.25, self._subscribe_overlay)

    def __enter__(self) -> Watch:
        return self

    def pairs_of(self, tile: str) -> list[Pair]:
        """See `RigSession`."""
        return [pair for pair in self.pairs if "/".join(pair) == tile]

    def corners(self, camera: str) -> Matrix:
        """See `RigSession`; the node does not say what a camera sees."""
        u, v = np.tan(np.deg2rad(VIEW_DEG))
        return np.array([[-u, -v, 1.0], [u, -v, 1.0], [u, v, 1.0], [-u, v, 1.0]])

    def look(self) -> None:
        """Somebody looks; to be called again within LOOK_S."""
        self._looked = time.monotonic()

    # ---- the thread, of a pair ----------------------------------------------------------------------------------------

    def _subscribe_overlay(self) -> None:
        wanted = time.monotonic() - self._looked < LOOK_S and not self._closed
        if wanted and self._overlay_subscription is None:
            self._overlay_subscription = self._node.create_subscription(Image, f"{self.name}/overlay", self._on_overlay, 1)
        elif not wanted and self._overlay_subscription is not None:
            self._node.destroy_subscription(self._overlay_subscription)
            self._overlay_subscription = None

    def _on_extrinsic(self, message: ExtrinsicMsg) -> None:
        try:
            result = result_from_message(message)
        except CalibrationError as error:
            self.note(f"an extrinsic that cannot be read: {error}", BAD)
            return
        age = message.data_age.sec + 1e-9 * message.data_age.nanosec
        age = age if age >= 0 else float("nan")
        state = NodeState(result, float(message.drift), bool(message.usable), age, str(advice_of(message)))
        with self.lock:
            self.history.add_extrinsic(time.time(), state)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        name = self.name.lstrip("/")
        found = {status.name: status for status in message.status}
        status = found.get(f"{name}: extrinsic")
        if status is None:
            return
        check = found.get(f"{name}: check")
        level = status.level[0] if isinstance(status.level, bytes) else int(status.level)
        values = {pair.key: pair.value for pair in status.values}
        diagnosis = Diagnosis(level, status.message, values, check.message if check is not None else "never run")
        with self.lock:
            self.history.add_diagnosis(time.time(), diagnosis)

    def _on_overlay(self, message: Image) -> None:
        try:
            picture: Any = decode_image(message)
        except CalibrationError as error:
            self.note(f"an overlay that cannot be read: {error}", BAD)
            return
        scale = OVERLAY_WIDTH / picture.shape[1]
        if scale < 1:
            picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, OVERLAY_QUALITY])[1].tobytes()
        self.overlay = jpeg, time.time(), self.overlay[2] + 1

    # ---- the thread, of a rig -----------------------------------------------------------------------------------------

    def _on_rig(self, message: Rig) -> None:
        """Put together what was heard."""
        self._heard, self._message = time.monotonic(), message
        self._find_pairs()
        cameras = {camera for camera, _ in self.pairs}
        sensors = []
        for own in message.sensors:
            T, C = matrix_from_transform(own.transform.transform), covariance_from_ros(own.covariance)
            kind, moved = CAMERA if own.name in cameras else LIDAR, (own.moved_deg, own.moved_m)
            sigma = None if C is None else worst_sigmas(at_sensor(T, C))
            sensors.append(
                SensorShown(own.name, kind, T, own.status, own.reason, own.usable, sigma, moved if any(moved) else None)
            )
        loops = tuple((own.sensors, (own.rotation_deg, own.translation_m), own.p_value, own.closes) for own in message.loops)
        rig = RigShown(message.reference, tuple(sensors), (), loops, message.text)
        edges = [self._edge(pair, told, rig, message) for pair, told in self.pairs.items()]
        for own in message.edges:
            if own.kind != KIND:
                edge = EdgeShown(own.target, own.source, own.kind, own.status, LEVELS.get(own.status, BAD), own.reason)
                C = covariance_from_ros(own.covariance)
                edges.append(edge if C is None else compared(edge, matrix_from_transform(own.transform), C, rig.poses))
        self.rig, self.version = replace(rig, edges=tuple(edges)), self.version + 1

    def _find_pairs(self) -> None:
        own = re.compile(re.escape(self.name) + r"/(\w+)/(\w+)/extrinsic")
        for topic, _ in self._node.get_topic_names_and_types():
            if (found := own.fullmatch(topic)) and found.groups() not in self.pairs:
                pair = found[1], found[2]
                self.pairs = {**self.pairs, pair: None}  # another one, since pages read it
                self._node.create_subscription(ExtrinsicMsg, topic, lambda m, p=pair: self._on_pair(p, m), LATCHED)
                self._clients[pair] = self._node.create_client(GetKeyframes, f"{self.name}/{'/'.join(pair)}/keyframes")

    def _on_pair(self, pair: Pair, message: ExtrinsicMsg) -> None:
        try:
            self.pairs[pair] = result_from_message(message), bool(message.usable)
        except CalibrationError:
            return  # the page of the pair says so

    def _every_second(self) -> None:
        if self._message is None:
            return
        self._find_pairs()
        now = time.monotonic()
        gone = now - self._heard > SILENT_S
        if gone != bool(self.problem):
            self.problem, self.version = NOT_HEARD if gone else "", self.version + 1
        wanted = now - self._looked < LOOK_S and not gone
        self._next_picture(wanted, now)
        self._next_cloud(wanted, now)

    def _next_picture(self, wanted: bool, now: float) -> None:
        if self._asked is not None and now - self._asked[2] > PATIENCE_S:
            self._asked[0].remove_pending_request(self._asked[1])
            self._asked = None
        if not wanted or self._asked is not None or not self.pairs:
            return
        pair = list(self.pairs)[next(self._turns) % len(self.pairs)]
        client = self._clients[pair]
        if client.service_is_ready():
            future = client.call_async(GetKeyframes.Request(max_keyframes=1, max_width=TILE_WIDTH))
            self._asked = client, future, now
            future.add_done_callback(lambda done: self._drawn("/".join(pair), done))

    def _drawn(self, tile: str, future: Any) -> None:
        self._asked = None
        if future.exception() is None and future.result().keyframes:
            self.tiles[tile] = bytes(future.result().keyframes[0].data)
            self.version += 1

    def _next_cloud(self, wanted: bool, now: float) -> None:
        if self._cloud is not None:
            if not self._had_cloud and wanted and now - self._cloud[1] < PATIENCE_S:
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
            self._cloud = self._node.create_subscription(PointCloud2, topic, self._on_cloud, NEWEST, raw=True), now

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
