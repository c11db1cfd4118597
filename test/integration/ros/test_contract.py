"""What other nodes rely on: usable or not, at a steady rate, and said when the data or the node end."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from paths import ROOT, module_at
from rclpy.executors import SingleThreadedExecutor
from rclpy.time import Time
from ros_peer import LATCHED, Peer, cloud_message, start_parameters
from sensor_msgs.msg import PointField
from tf2_msgs.msg import TFMessage
from vehicle import QUICK, off

from calib_ros import se3
from calib_ros.datasets.bag_file import StaticTransforms
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.ros.conversions import image_message, transform_message
from calib_ros_synthetic.drive import SyntheticDrive

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]
PERIOD_S, AGE_S = 0.1, 0.5  # AGE_S: of data that are too old, in the test of it
FAST = {**QUICK, "publish_period_s": PERIOD_S, "initial_from_tf": False}


def seconds(duration: Any) -> float:
    return float(duration.sec + duration.nanosec / NANOSECONDS)


def test_an_extrinsic_is_usable_only_while_data_come(street: list[Frame], drive: SyntheticDrive) -> None:
    with Peer(**start_parameters(off(drive.reference)), **FAST) as peer:
        peer.publish(street[0])
        peer.until(lambda: len(peer.extrinsics) >= 3, "the same extrinsic again and again")
        assert not any(msg.usable for msg in peer.extrinsics)
        assert peer.extrinsics[-1].estimated_at.sec == 0

        peer.drive(street[1:5])
        msg = peer.until(lambda: peer.extrinsics[-1] if peer.extrinsics[-1].usable else None, "a usable extrinsic")
        assert msg.status == "converged"
        ahead = Time.from_msg(msg.valid_until).nanoseconds - peer.node.get_clock().now().nanoseconds
        assert ahead < 10 * PERIOD_S * NANOSECONDS
        assert seconds(msg.data_age) >= 0
        assert Time.from_msg(msg.estimated_at).nanoseconds in [frame.stamp for frame in street]

        peer.change(max_data_age_s=AGE_S)  # and nothing comes any more
        msg = peer.until(lambda: None if peer.extrinsics[-1].usable else peer.extrinsics[-1], "that it is too old")
        assert "no usable pair of image and cloud" in msg.reason
        assert Time.from_msg(msg.valid_until).nanoseconds == 0
        assert seconds(msg.data_age) > AGE_S
        answer = peer.get_extrinsic()
        assert not answer.success
        assert "no usable pair of image and cloud" in answer.message
        assert answer.last_good_known
        assert not answer.last_good.usable
        assert seconds(answer.last_good.data_age) > AGE_S
        assert answer.last_good.transform == answer.extrinsic.transform

        peer.change(max_data_age_s=3600.0)
        peer.publish(street[5])
        peer.until(lambda: peer.extrinsics[-1].usable, "that data come again")


def test_a_restored_extrinsic_is_used_when_keyframes_confirm_it(
    street: list[Frame], drive: SyntheticDrive, tmp_path: Path
) -> None:
    state = tmp_path / "state.json"
    with Peer(**start_parameters(off(drive.reference)), **FAST, state_file=str(state)) as peer:
        peer.drive(street[:5])
        estimated = peer.get_extrinsic().extrinsic.estimated_at
    assert json.loads(state.read_text())["provenance"]["sensor_stamp_ns"] == Time.from_msg(estimated).nanoseconds
    with Peer(**FAST, state_file=str(state), online__mode="manual") as peer:
        peer.publish(street[0])
        first = peer.until(lambda: peer.extrinsics and peer.extrinsics[0], "the restored extrinsic")
        assert (first.status, first.usable, first.estimated_at) == ("initial", False, estimated)
        assert first.transform.header.stamp == estimated
        peer.drive(street[5:9])
        peer.until(lambda: peer.extrinsics[-1].usable, "that keyframes confirm it")
        assert peer.extrinsics[-1].estimated_at == estimated


def test_example_consumer_stops_using_the_extrinsic_of_a_node_that_has_ended(
    street: list[Frame], drive: SyntheticDrive, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = module_at(ROOT / "docs/examples/use_extrinsic.py")
    monkeypatch.setattr(module, "SILENCE", module.Duration(seconds=3 * PERIOD_S))
    with Peer(**start_parameters(off(drive.reference)), **FAST) as peer:
        user = module.ExtrinsicUser(context=peer.context, cli_args=["--ros-args", "-r", "extrinsic:=/calib_ros/extrinsic"])
        executor = SingleThreadedExecutor(context=peer.context)
        executor.add_node(user)
        assert user.usable() is None

        def used() -> Any:
            executor.spin_once(timeout_sec=0.02)
            return user.usable()

        peer.drive(street[:5])
        transform = peer.until(used, "that the consumer uses the extrinsic")
        assert transform == peer.get_extrinsic().extrinsic.transform.transform
        peer.pipeline.stop()
        peer._executors[0][0].shutdown(timeout_sec=1.0)
        peer.until(lambda: used() is None, "that the consumer stops using it")
        executor.shutdown()
        user.destroy_node()


TREE = (("base_link", "lidar_mount"), ("lidar_mount", "velodyne"), ("base_link", "camera_mount"), ("camera_mount", "camera"))


def publish_tree(peer: Peer, reference: np.ndarray, names: tuple[tuple[str, str], ...] = TREE) -> dict[tuple[str, str], Any]:
    """An ordinary tree of a vehicle, which gives `reference` between the sensors."""
    edges = {edge: se3.perturb(np.eye(4), [3.0 * k, 10.0, -7.0 * k], [0.1, 0.2 * k, 0.5]) for k, edge in enumerate(names)}
    if names == TREE:
        T_base_lidar = edges[TREE[0]] @ edges[TREE[1]]
        edges[TREE[3]] = se3.inverse(edges[TREE[2]]) @ T_base_lidar @ se3.inverse(reference)
    publisher = peer.peer.create_publisher(TFMessage, "/tf_static", LATCHED)
    publisher.publish(TFMessage(transforms=[transform_message(T, *edge, 0) for edge, T in edges.items()]))
    peer.until(lambda: peer.calibration.tf._tree.parent("camera") == names[-1][0], "the tree")
    return edges


@pytest.mark.parametrize(
    ("names", "options", "text"),
    [
        (TREE, {}, "velodyne already has the parent lidar_mount"),
        ((("velodyne", "mount"), ("mount", "camera")), {}, "would close a loop"),
        (TREE, {"tf_parent": "map", "tf_child": "base_link"}, "camera_mount -> camera, base_link -> camera_mount"),
    ],
    ids=["second parent", "loop", "elsewhere"],
)
def test_an_edge_that_would_take_the_tree_apart_is_refused(
    street: list[Frame], drive: SyntheticDrive, names: tuple[tuple[str, str], ...], options: dict[str, str], text: str
) -> None:
    """The edges that may be named are told."""
    with Peer(**start_parameters(drive.reference), publish_tf=True, **options, **FAST) as peer:
        publish_tree(peer, drive.reference, names)
        got = peer.listen(TFMessage, "/tf_static")
        peer.publish(street[0])
        peer.until(lambda: text in peer.last_error(), "the reason")
        peer.settle()
        assert peer.calibration.tf._published is None
        assert {(t.header.frame_id, t.child_frame_id) for msg in got for t in msg.transforms} <= set(names)


def test_a_parent_that_comes_later_ends_the_publishing(street: list[Frame], drive: SyntheticDrive) -> None:
    with Peer(**start_parameters(drive.reference), publish_tf=True, **FAST) as peer:
        peer.publish(street[0])
        item = peer.latched(TFMessage, "/tf_static").transforms[0]
        assert (item.header.frame_id, item.child_frame_id) == ("camera", "velodyne")
        publish_tree(peer, drive.reference)
        peer.until(lambda: "velodyne already has the parent lidar_mount" in peer.last_error(), "the reason")


@pytest.mark.parametrize("edge", [("camera_mount", "camera"), ("base_link", "camera_mount"), ("base_link", "lidar_mount")])
def test_an_edge_between_the_sensors_is_corrected(street: list[Frame], drive: SyntheticDrive, edge: tuple[str, str]) -> None:
    start = off(drive.reference)
    with Peer(**start_parameters(start), publish_tf=True, tf_parent=edge[0], tf_child=edge[1], **FAST) as peer:
        edges = publish_tree(peer, drive.reference)
        corrected = peer.listen(TFMessage, "/tf_static")
        peer.publish(street[0])

        def newest() -> Any:
            own = [t for msg in corrected for t in msg.transforms if len(msg.transforms) == 1]
            return own[-1] if own else None

        item = peer.until(newest, "the corrected edge")
        assert (item.header.frame_id, item.child_frame_id) == edge
        tree = StaticTransforms()
        tree.add(TFMessage(transforms=[transform_message(T, *names, 0) for names, T in edges.items()]))
        tree.add(TFMessage(transforms=[item]))
        np.testing.assert_allclose(tree.lookup("camera", "velodyne"), start, atol=1e-9)
        count = len(corrected)
        peer.until(lambda: len(corrected) > count + 1, "the corrected edge again, for those who join late")


def test_a_tree_that_comes_later_is_corrected(street: list[Frame], drive: SyntheticDrive) -> None:
    options = {"publish_tf": True, "tf_parent": "base_link", "tf_child": "camera_mount", **FAST}
    with Peer(**start_parameters(drive.reference), **options) as peer:
        peer.publish(street[0])
        peer.until(lambda: "no edge between camera and velodyne" in peer.last_error(), "that there is no tree yet")
        publish_tree(peer, drive.reference)
        peer.until(lambda: peer.calibration.tf._published is not None, "the corrected edge")


def test_sensors_without_a_frame_id_are_named(street: list[Frame], drive: SyntheticDrive) -> None:
    with Peer(**start_parameters(drive.reference), **FAST) as peer:
        peer.publish(street[0], frame_id="")
        assert "messages of the lidar have no frame_id" in peer.last_error()


def test_point_times_of_another_clock_are_named(street: list[Frame], drive: SyntheticDrive) -> None:
    with Peer(**start_parameters(drive.reference), **FAST) as peer:
        frame = street[0]
        times = (np.linspace(0, 0.1, len(frame.cloud)) + frame.stamp / NANOSECONDS + 37.0).astype(np.float64)
        message = cloud_message(frame.cloud, frame.stamp, drop=("time",))
        raw = np.frombuffer(bytes(message.data), np.uint8).reshape(len(frame.cloud), -1)
        message.fields = [
            *message.fields,
            PointField(name="timestamp", offset=raw.shape[1], datatype=PointField.FLOAT64, count=1),
        ]
        message.data = np.c_[raw, times.view(np.uint8).reshape(len(times), 8)].tobytes()
        message.point_step, message.row_step = raw.shape[1] + 8, (raw.shape[1] + 8) * len(times)
        peer.publish_camera(frame)
        peer.send(image_message(frame.image, "camera", frame.stamp), message)
        peer.until(lambda: "of another clock, +37 s from the header stamp" in peer.last_error(), "the reason")


def test_with_the_defaults_nothing_tentative_is_saved_carried_over_or_usable(
    street: list[Frame], drive: SyntheticDrive, tmp_path: Path
) -> None:
    state = tmp_path / "state.json"
    options = {**FAST, "tracker__confirmations": 3, "state_file": str(state)}
    with Peer(**start_parameters(off(drive.reference)), **options) as peer:
        peer.drive(street[:4])
        answer = peer.get_extrinsic()
        assert answer.extrinsic.status == "tentative", answer.message
        assert not answer.success
        assert "to be confirmed" in peer.trigger("save").message
        assert not state.exists()
        assert not peer.recalibrator.tracker.carry_over.converged
        peer.drive(street[4:8])
        answer = peer.until(lambda: (a := peer.get_extrinsic()).success and a, "a confirmed extrinsic")
        assert answer.extrinsic.status == "converged"
        saved = peer.until(lambda: state.exists() and json.loads(state.read_text()), "the state file")
        assert saved["provenance"]["sensor_stamp_ns"] == Time.from_msg(answer.extrinsic.estimated_at).nanoseconds
        # After a reset everything is counted anew, the saving too.
        state.unlink()
        assert peer.trigger("reset").success
        for k, frame in enumerate([*street[:8], *street[:4]]):
            if state.exists():
                break
            moment = street[7].stamp + (k + 5) * NANOSECONDS
            peer.publish(dataclasses.replace(frame, stamp=moment, cloud_stamp=None))
        peer.until(state.exists, "the state file again")
