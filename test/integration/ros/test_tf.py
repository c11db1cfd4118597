"""The extrinsic in the vehicle's tree on /tf_static, over real DDS: read, published, corrected, and never taking it apart."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from ros_peer import LATCHED, Peer, start_parameters
from tf2_msgs.msg import TFMessage
from vehicle import off

from calib_ros import se3
from calib_ros.datasets.static_transforms import StaticTransforms
from calib_ros.ros.client import result_from_message
from calib_ros.ros.conversions import matrix_from_transform, transform_message

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]
Edges = tuple[tuple[str, str], ...]
TREE = (("base_link", "lidar_mount"), ("lidar_mount", "velodyne"), ("base_link", "camera_mount"), ("camera_mount", "camera"))
LOOP = (("velodyne", "mount"), ("mount", "camera"))


def publisher_of(T: np.ndarray) -> Peer:
    return Peer(**start_parameters(T), publish_tf=True, initial_from_tf=False, online__mode="manual")


def message(edges: dict[tuple[str, str], np.ndarray]) -> TFMessage:
    return TFMessage(transforms=[transform_message(T, *edge, 0) for edge, T in edges.items()])


def names(msg: TFMessage) -> Edges:
    return tuple((item.header.frame_id, item.child_frame_id) for item in msg.transforms)


def publish_tree(peer: Peer, reference: np.ndarray, wanted: Edges = TREE) -> dict[tuple[str, str], np.ndarray]:
    """An ordinary tree of a vehicle, which gives `reference` between the sensors, or another one."""
    edges = {edge: se3.perturb(np.eye(4), [3.0 * k, 10.0, -7.0 * k], [0.1, 0.2 * k, 0.5]) for k, edge in enumerate(wanted)}
    if wanted == TREE:
        T_base_lidar = edges[TREE[0]] @ edges[TREE[1]]
        edges[TREE[3]] = se3.inverse(edges[TREE[2]]) @ T_base_lidar @ se3.inverse(reference)
    peer.peer.create_publisher(TFMessage, "/tf_static", LATCHED).publish(message(edges))
    peer.until(lambda: peer.calibration.tf.tree.parent("camera") == wanted[-1][0], "the tree")
    return edges


@pytest.mark.parametrize("late", [False, True])
def test_the_tree_of_others_gives_the_initial_extrinsic_and_the_nodes_own_edge_does_not(street, drive, late):
    with Peer(online__mode="manual", publish_tf=True) as peer:
        tf = peer.calibration.tf
        if late:
            peer.until(lambda: not tf.lookup("camera", "velodyne")[1], "that it has waited in vain")
            peer.publish(street[0])
            assert "nominal" in peer.get_extrinsic().message
            recalibrator = peer.recalibrator
            assert names(peer.latched(TFMessage, "/tf_static")) == (("camera", "velodyne"),)
            peer.new_values()
            assert tf.lookup("camera", "velodyne")[0] is None
            assert peer.recalibrator is recalibrator
        publish_tree(peer, drive.reference)
        peer.until(lambda: peer.recalibrator is None, "a new start")
        peer.publish(street[1])
        answer = peer.get_extrinsic()
        assert answer.message == "from TF"
        np.testing.assert_allclose(result_from_message(answer.extrinsic).T_camera_lidar, drive.reference, atol=1e-6)


def test_the_published_edge_follows_parameters_and_tree(street, drive):
    start = off(drive.reference)
    with publisher_of(start) as peer:
        got = peer.listen(TFMessage, "/tf_static")

        def published(*edge: str) -> np.ndarray:
            """The transform of this edge, once the node's newest message is of it."""

            def newest() -> Any:
                own = [msg for msg in got if len(msg.transforms) == 1]
                return own[-1] if own and names(own[-1]) == (edge,) else None

            return matrix_from_transform(peer.until(newest, edge).transforms[0].transform)

        peer.publish(street[0])
        np.testing.assert_allclose(published("camera", "velodyne"), start, atol=1e-9)
        peer.change(tf_parent="lidar")
        np.testing.assert_allclose(published("velodyne", "camera"), se3.inverse(start), atol=1e-9)
        peer.change(tf_parent="base_link", tf_child="camera_mount")
        peer.until(lambda: "no edge between camera and velodyne" in peer.last_error(), "that there is no tree yet")
        edges = publish_tree(peer, drive.reference)
        for edge in (TREE[2], TREE[3], TREE[0]):
            peer.change(tf_parent=edge[0], tf_child=edge[1])
            tree = StaticTransforms()
            tree.add(message({**edges, edge: published(*edge)}))
            np.testing.assert_allclose(tree.lookup("camera", "velodyne"), start, atol=1e-9)
        own = peer.calibration.tf.edges(peer.recalibrator.current.result)
        assert list(own) == [TREE[k] for k in (3, 2, 0, 1)]  # from the camera on
        for edge, T in own.items():
            tree.add(message({**edges, edge: T}))
            np.testing.assert_allclose(tree.lookup("camera", "velodyne"), start, atol=1e-9)
        count = len(got)
        peer.until(lambda: len(got) > count + 1, "the corrected edge again, for those who join late")
        for parent, child, text in (
            ("map", "base_link", "camera_mount -> camera, base_link -> camera_mount"),  # those that may be named
            ("camera", "", "velodyne already has the parent lidar_mount"),
        ):
            peer.change(tf_parent=parent, tf_child=child)
            peer.until(lambda text=text: text in peer.last_error(), "the reason")
            peer.until(lambda: peer.calibration.tf._published is None, "that nothing is published")
        peer.change(publish_tf=False)
        peer.until(lambda: peer.peer.count_publishers("/tf_static") == 1, "the end of the publisher")


@pytest.mark.parametrize(
    ("late", "wanted", "text"),
    [
        (False, TREE, "velodyne already has the parent lidar_mount"),
        (True, TREE, "velodyne already has the parent lidar_mount"),
        (False, LOOP, "would close a loop"),
    ],
)
def test_an_edge_that_would_take_the_tree_apart_is_not_published(street, drive, wanted, text, late):
    with publisher_of(drive.reference) as peer:
        if late:
            peer.publish(street[0])
            assert names(peer.latched(TFMessage, "/tf_static")) == (("camera", "velodyne"),)
        publish_tree(peer, drive.reference, wanted)
        peer.publish(street[1])
        peer.until(lambda: text in peer.last_error(), "the reason")
        peer.until(lambda: peer.calibration.tf._published is None, "that nothing is published")
        assert names(peer.latched(TFMessage, "/tf_static")) == wanted
