"""/tf_static in and out, where tf2_msgs is installed."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from operator import itemgetter
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from calib_ros import se3
from calib_ros.arrays import Matrix, Transform
from calib_ros.datasets.static_transforms import StaticTransforms
from calib_ros.errors import BadInputError, MissingDependencyError
from calib_ros.online.events import ExtrinsicUpdated
from calib_ros.result import Result
from calib_ros.ros.conversions import transform_message
from calib_ros.ros.dds import LATCHED
from calib_ros.ros.parts import NodePart

CAMERA, LIDAR = "camera", "lidar"  # values of tf_parent
OWN_TRANSFORMS = 64  # published transforms that are recognised when they are received: one of the newest
WAIT_S = 2.0  # static transforms are latched: discovery of their publishers takes about a second
QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)

CURES = (
    "take the other one as tf_parent",
    "give an edge between camera and LiDAR as tf_parent and tf_child, and it is corrected",
)


class StaticTf(NodePart):
    """Reads the static tree for an initial extrinsic, and publishes the extrinsic to it while publish_tf says so.

    cures: what to do about a loop, and about a second parent. tree: of everybody but this node. MissingDependencyError if
    publish_tf is asked for without tf2_msgs.
    """

    def __init__(self, own: Any, cures: tuple[str, str] = CURES) -> None:
        super().__init__(own)
        self._node, self._cures = own.inputs.shared.node, cures  # of a rig, for its pairs as well
        self.tree = StaticTransforms()
        self._since = time.monotonic()
        self._type: Any = None
        with suppress(ImportError):
            from tf2_msgs.msg import TFMessage

            self._type = TFMessage
        self._publisher: Any = None
        self._sent: deque[TransformStamped] = deque(maxlen=OWN_TRANSFORMS)
        self._wanted: tuple[Result, int] | None = None  # the newest that was to be published, with its stamp
        # Parent and child by the parameters when it was published last: CAMERA or LIDAR and "", the other sensor being the child;
        # with a child, the name of its parent.
        self._edge = "", ""
        self._published: TransformStamped | None = None  # what late joiners get
        self._tree_wanted: Sequence[TransformStamped] = ()  # several edges that were not published yet
        self._lock = threading.RLock()  # a worker publishes, the executor switches and receives
        self._use_tree = self._parameters["initial_from_tf"] and self._type is not None
        self._subscription: Any = None
        if self._use_tree:
            self._listen()
        if self._parameters["publish_tf"]:
            self._switch(True)

    @property
    def missing(self) -> str:
        """Why nothing can be published, for a person; "" if it can."""
        if self._type is not None:
            return ""
        return "publish_tf needs tf2_msgs; install it (apt: ros-<distro>-tf2-msgs) or set publish_tf to false"

    def _switch(self, on: bool) -> None:
        """Publish from now on, or take back what was published: who joins later does not get it any more."""
        if on and self.missing:
            raise MissingDependencyError(self.missing)
        with self._lock:
            if on:
                self._listen()
            if on and self._publisher is None:
                self._publisher = self._node.create_publisher(self._type, "/tf_static", LATCHED)
            elif not on and self._publisher is not None:
                self._node.destroy_publisher(self._publisher)
                self._publisher = self._published = None

    def destroy(self) -> None:
        """Take back what was published, and receive nothing any more."""
        self._switch(False)
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)

    def lookup(self, camera_frame: str, lidar_frame: str) -> tuple[NDArray[np.float64] | None, bool]:
        """T_camera_lidar (4, 4) or None, and whether it is worth asking again. What this node published does not count."""
        if not self._use_tree:
            return None, False
        T = self.tree.lookup(camera_frame, lidar_frame)
        return T, T is None and time.monotonic() - self._since < WAIT_S

    def edges(self, result: Result) -> dict[tuple[str, str], Transform]:
        """(parent, child) -> T_parent_child (4, 4) by which the tree gives an extrinsic, of all edges between the sensors, from
        the camera on; none if the tree does not connect them."""
        T, camera, lidar = result.T_camera_lidar, result.camera_frame, result.lidar_frame
        return {edge: self._edge_between(T, camera, lidar, *edge) for edge in self.tree.path(camera, lidar)}

    def add(self, event: Any) -> None:
        """Publish a new extrinsic as the edge of the tree that the parameters name; what cannot carry it is reported instead."""
        if isinstance(event, ExtrinsicUpdated):
            with self._lock:
                self._wanted = event.extrinsic.result, event.stamp
                self._publish()

    def _publish(self) -> None:
        if self._publisher is None or self._wanted is None or time.monotonic() - self._since < WAIT_S:
            return  # what others publish is not known yet; see check()
        self._edge = self._parameters["tf_parent"], self._parameters["tf_child"]
        try:
            message = self._message(*self._wanted)
        except BadInputError as error:
            self._withdraw(str(error))
            return
        self._published = message
        self._send([message])

    def _send(self, messages: list[TransformStamped]) -> None:
        self._sent.extend(messages)
        self._publisher.publish(self._type(transforms=messages))

    def put_tree(self, messages: Sequence[TransformStamped]) -> None:
        """Publish several edges at once with the next check, in place of those before; those that /tf_static does not allow are
        reported instead."""
        with self._lock:
            self._tree_wanted = messages

    def check(self) -> None:
        """Follow the parameters and the tree, which may have changed for the better or the worse.

        What could not be published is tried again. A corrected edge is published again: who joins late receives it from its
        first publisher too, in any order.
        """
        with self._lock:
            self._switch(self._parameters["publish_tf"])
            if self._publisher is not None and self._tree_wanted and time.monotonic() - self._since >= WAIT_S:
                messages, self._tree_wanted = self._tree_wanted, ()
                conflicts = {m.child_frame_id: self._conflict(m.header.frame_id, m.child_frame_id) for m in messages}
                for child, conflict in filter(itemgetter(1), conflicts.items()):
                    self._health.error(conflict, f"tf {child}")
                self._send([message for message in messages if not conflicts[message.child_frame_id]])
            message, edge = self._published, (self._parameters["tf_parent"], self._parameters["tf_child"])
            if message is None or edge[1] or edge != self._edge:
                self._publish()
            elif conflict := self._conflict(message.header.frame_id, message.child_frame_id):
                self._withdraw(conflict)

    def _listen(self) -> None:
        if self._subscription is None:
            self._since = time.monotonic()
            self._subscription = self._node.create_subscription(self._type, "/tf_static", self._receive, QOS)

    def _receive(self, msg: Any) -> None:
        with self._lock:
            others = [item for item in msg.transforms if not any(_same(item, own) for own in self._sent)]
        self.tree.add(self._type(transforms=others))

    def _withdraw(self, why: str) -> None:
        """Nothing is published any more: tf2 would take the tree apart, or a wrong edge stay in it."""
        self._health.error(why, "tf")
        if self._published is not None:
            self._switch(False)
            self._switch(True)

    def _message(self, result: Result, stamp: int) -> TransformStamped:
        """The transform of an edge. BadInputError if the child has another parent, or the edge does not join the sensors."""
        T, camera, lidar = result.T_camera_lidar, result.camera_frame, result.lidar_frame
        parent, child = self._edge
        if not child:
            parent, child, T = (camera, lidar, T) if parent == CAMERA else (lidar, camera, se3.inverse(T))
        else:
            T = self._edge_between(T, camera, lidar, parent, child)
        conflict = self._conflict(parent, child)
        if conflict:
            raise BadInputError(conflict)
        return transform_message(T, parent, child, stamp)

    def _conflict(self, parent: str, child: str) -> str:
        """Why an edge must not be published, "" if it may: a frame has one parent."""
        other = self.tree.parent(child)
        above: str | None = parent
        seen: set[str] = set()
        while above is not None and above != child and above not in seen:
            seen.add(above)
            above = self.tree.parent(above)
        if above == child:
            return (
                f"publish_tf: {child} is above {parent} in /tf_static already, an edge {parent} -> {child} would close a loop: "
                f"nothing is published; {self._cures[0]}"
            )
        if other in (None, parent):
            return ""
        return (
            f"publish_tf: {child} already has the parent {other} in /tf_static, a second one ({parent}) would take the tree "
            f"apart: nothing is published; {self._cures[1]}"
        )

    def _edge_between(self, T_camera_lidar: Transform, camera: str, lidar: str, parent: str, child: str) -> Transform:
        """T_parent_child (4, 4) with which the tree gives this extrinsic."""
        for a, b, T in ((camera, lidar, T_camera_lidar), (lidar, camera, se3.inverse(T_camera_lidar))):
            T_a_parent, T_child_b = self._fixed(a, parent, child), self._fixed(child, b, child)
            if T_a_parent is not None and T_child_b is not None:
                return np.asarray(se3.inverse(T_a_parent) @ T @ se3.inverse(T_child_b))
        edges = ", ".join(f"{p} -> {c}" for p, c in self.tree.path(camera, lidar)) or "none, they are not connected"
        raise BadInputError(
            f"publish_tf: tf_parent {parent} and tf_child {child} are no edge between {camera} and {lidar} in /tf_static; "
            f"its edges there: {edges}"
        )

    def _fixed(self, target: str, source: str, without: str) -> Matrix | None:
        """T_target_source (4, 4) without the edge above a child."""
        return np.eye(4) if target == source else self.tree.lookup(target, source, without)


def _same(a: TransformStamped, b: TransformStamped) -> bool:
    """Is a received transform one that was published?"""
    if (a.header.frame_id, a.child_frame_id) != (b.header.frame_id, b.child_frame_id):
        return False
    first, second = (
        [getattr(part, name) for part, names in ((m.translation, "xyz"), (m.rotation, "xyzw")) for name in names]
        for m in (a.transform, b.transform)
    )
    return bool(np.allclose(first, second, atol=1e-9))
