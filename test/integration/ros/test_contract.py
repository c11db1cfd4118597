"""What other nodes rely on: usable or not, at a steady rate, and said when the data or the node end."""

from __future__ import annotations

import dataclasses
import json
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from paths import ROOT, module_at
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.time import Time
from ros_peer import LATCHED, Peer, camera_info_message, cloud_message, start_parameters
from sensor_msgs.msg import PointField
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage
from vehicle import QUICK

from calib_ros import se3
from calib_ros.datasets.bag_file import StaticTransforms
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.ros.conversions import image_message, transform_message
from calib_ros_synthetic.drive import SyntheticDrive

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]
AGE_S, PERIOD_S = 4.0, 0.1  # estimates take a second or two on busy cores, and the data must not be too old by then
FAST = {**QUICK, "max_data_age_s": AGE_S, "publish_period_s": PERIOD_S, "initial_from_tf": False}


def near(reference: np.ndarray) -> np.ndarray:
    return se3.perturb(reference, [1.2, -1.0, 0.8], [0.08, -0.05, 0.06])


def seconds(duration: Any) -> float:
    return float(duration.sec + duration.nanosec / NANOSECONDS)


def test_an_extrinsic_is_usable_only_while_data_come(street: list[Frame], drive: SyntheticDrive) -> None:
    with Peer(**start_parameters(near(drive.reference)), **FAST) as peer:
        peer.publish(street[0])
        peer.until(lambda: len(peer.extrinsics) >= 3, what="the same extrinsic again and again")
        assert not any(msg.usable for msg in peer.extrinsics)
        assert peer.extrinsics[-1].estimated_at.sec == 0

        for frame in street[1:5]:
            peer.publish(frame)
        msg = peer.until(lambda: peer.extrinsics[-1] if peer.extrinsics[-1].usable else None, what="a usable extrinsic")
        assert msg.status == "converged"
        ahead = Time.from_msg(msg.valid_until).nanoseconds - peer.node.get_clock().now().nanoseconds
        assert -NANOSECONDS < ahead < AGE_S * NANOSECONDS
        assert 0 <= seconds(msg.data_age) < AGE_S
        assert Time.from_msg(msg.estimated_at).nanoseconds in [frame.stamp for frame in street]

        # Nothing comes any more.
        msg = peer.until(lambda: None if peer.extrinsics[-1].usable else peer.extrinsics[-1], what="that it is too old")
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

        peer.publish(street[5])
        peer.until(lambda: peer.extrinsics[-1].usable, what="that data come again")


def test_a_restored_extrinsic_is_used_when_keyframes_confirm_it(
    street: list[Frame], drive: SyntheticDrive, tmp_path: Path
) -> None:
    state = tmp_path / "state.json"
    with Peer(**start_parameters(near(drive.reference)), **FAST, state_file=str(state)) as peer:
        for frame in street[:5]:
            peer.publish(frame)
        estimated = peer.get_extrinsic().extrinsic.estimated_at
    assert json.loads(state.read_text())["provenance"]["sensor_stamp_ns"] == Time.from_msg(estimated).nanoseconds
    with Peer(**FAST, state_file=str(state), online__mode="manual") as peer:
        peer.publish(street[0])
        first = peer.until(lambda: peer.extrinsics and peer.extrinsics[0], what="the restored extrinsic")
        assert (first.status, first.usable, first.estimated_at) == ("initial", False, estimated)
        assert first.transform.header.stamp == estimated
        for frame in street[5:9]:
            peer.publish(frame)
        peer.until(lambda: peer.extrinsics[-1].usable, what="that keyframes confirm it")
        assert peer.extrinsics[-1].estimated_at == estimated


def test_example_consumer_stops_using_the_extrinsic_of_a_node_that_has_ended(
    street: list[Frame], drive: SyntheticDrive, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = module_at(ROOT / "docs/examples/use_extrinsic.py")
    monkeypatch.setattr(module, "SILENCE", module.Duration(seconds=3 * PERIOD_S))
    with Peer(**start_parameters(near(drive.reference)), **{**FAST, "max_data_age_s": 60.0}) as peer:
        user = module.ExtrinsicUser(context=peer.context, cli_args=["--ros-args", "-r", "extrinsic:=/calib_ros/extrinsic"])
        executor = SingleThreadedExecutor(context=peer.context)
        executor.add_node(user)
        assert user.usable() is None

        def used() -> Any:
            executor.spin_once(timeout_sec=0.02)
            return user.usable()

        for frame in street[:5]:
            peer.publish(frame)
        transform = peer.until(used, what="that the consumer uses the extrinsic")
        assert transform == peer.get_extrinsic().extrinsic.transform.transform
        peer.calibration.pipeline.stop()
        peer._executors[0][0].shutdown(timeout_sec=1.0)
        peer.until(lambda: used() is None, what="that the consumer stops using it")
        executor.shutdown()
        user.destroy_node()


TREE = (("base_link", "lidar_mount"), ("lidar_mount", "velodyne"), ("base_link", "camera_mount"), ("camera_mount", "camera"))


def publish_tree(peer: Peer, reference: np.ndarray) -> dict[tuple[str, str], np.ndarray]:
    """An ordinary tree of a vehicle, which gives `reference` between the sensors."""
    edges = {edge: se3.perturb(np.eye(4), [3.0 * k, 10.0, -7.0 * k], [0.1, 0.2 * k, 0.5]) for k, edge in enumerate(TREE)}
    T_base_lidar = edges[TREE[0]] @ edges[TREE[1]]
    edges[TREE[3]] = se3.inverse(edges[TREE[2]]) @ T_base_lidar @ se3.inverse(reference)
    publisher = peer.peer.create_publisher(TFMessage, "/tf_static", LATCHED)
    publisher.publish(TFMessage(transforms=[transform_message(T, *edge, 0) for edge, T in edges.items()]))
    peer.until(lambda: peer.calibration.tf._tree.parent("camera") == "camera_mount", what="the tree")
    return edges


def test_a_frame_with_a_parent_gets_no_second_one(street: list[Frame], drive: SyntheticDrive) -> None:
    with Peer(**start_parameters(drive.reference), publish_tf=True, **FAST) as peer:
        publish_tree(peer, drive.reference)
        got: list[Any] = []
        peer.peer.create_subscription(TFMessage, "/tf_static", got.append, LATCHED)
        peer.publish(street[0])
        peer.until(lambda: "velodyne already has the parent lidar_mount" in peer.last_error(), what="the reason")
        peer.settle()
        assert {(t.header.frame_id, t.child_frame_id) for msg in got for t in msg.transforms} <= set(TREE)


def test_an_edge_that_would_close_a_loop_is_refused(street: list[Frame], drive: SyntheticDrive) -> None:
    with Peer(**start_parameters(drive.reference), publish_tf=True, **FAST) as peer:
        edges = (("velodyne", "mount"), ("mount", "camera"))
        publisher = peer.peer.create_publisher(TFMessage, "/tf_static", LATCHED)
        publisher.publish(TFMessage(transforms=[transform_message(np.eye(4), *edge, 0) for edge in edges]))
        peer.until(lambda: peer.calibration.tf._tree.parent("camera") == "mount", what="the tree")
        peer.publish(street[0])
        peer.until(lambda: "would close a loop" in peer.last_error(), what="the reason")
        assert peer.calibration.tf._published is None


def test_a_parent_that_comes_later_ends_the_publishing(street: list[Frame], drive: SyntheticDrive) -> None:
    with Peer(**start_parameters(drive.reference), publish_tf=True, **FAST) as peer:
        peer.publish(street[0])
        item = peer.latched(TFMessage, "/tf_static").transforms[0]
        assert (item.header.frame_id, item.child_frame_id) == ("camera", "velodyne")
        publish_tree(peer, drive.reference)
        peer.until(lambda: "velodyne already has the parent lidar_mount" in peer.last_error(), what="the reason")


@pytest.mark.parametrize("edge", [("camera_mount", "camera"), ("base_link", "camera_mount"), ("base_link", "lidar_mount")])
def test_an_edge_between_the_sensors_is_corrected(street: list[Frame], drive: SyntheticDrive, edge: tuple[str, str]) -> None:
    start = near(drive.reference)
    with Peer(**start_parameters(start), publish_tf=True, tf_parent=edge[0], tf_child=edge[1], **FAST) as peer:
        edges = publish_tree(peer, drive.reference)
        corrected: list[Any] = []
        peer.peer.create_subscription(TFMessage, "/tf_static", corrected.append, LATCHED)
        peer.publish(street[0])

        def newest() -> Any:
            own = [t for msg in corrected for t in msg.transforms if len(msg.transforms) == 1]
            return own[-1] if own else None

        item = peer.until(newest, what="the corrected edge")
        assert (item.header.frame_id, item.child_frame_id) == edge
        tree = StaticTransforms()
        tree.add(TFMessage(transforms=[transform_message(T, *names, 0) for names, T in edges.items()]))
        tree.add(TFMessage(transforms=[item]))
        np.testing.assert_allclose(tree.lookup("camera", "velodyne"), start, atol=1e-9)
        count = len(corrected)
        peer.until(lambda: len(corrected) > count + 1, what="the corrected edge again, for those who join late")


def test_a_tree_that_comes_later_is_corrected(street: list[Frame], drive: SyntheticDrive) -> None:
    options = {"publish_tf": True, "tf_parent": "base_link", "tf_child": "camera_mount", **FAST}
    with Peer(**start_parameters(drive.reference), **options) as peer:
        peer.publish(street[0])
        peer.until(lambda: "no edge between camera and velodyne" in peer.last_error(), what="that there is no tree yet")
        publish_tree(peer, drive.reference)
        peer.until(lambda: peer.calibration.tf._published is not None, what="the corrected edge")


def test_an_edge_elsewhere_in_the_tree_is_refused_with_those_that_may_be_named(
    street: list[Frame], drive: SyntheticDrive
) -> None:
    with Peer(**start_parameters(drive.reference), publish_tf=True, tf_parent="map", tf_child="base_link", **FAST) as peer:
        publish_tree(peer, drive.reference)
        peer.publish(street[0])
        peer.until(lambda: "camera_mount -> camera, base_link -> camera_mount" in peer.last_error(), what="the edges")
        change = [Parameter("tf_parent", value="map"), Parameter("tf_child", value="")]
        assert "tf_child must name its child" in peer.node.set_parameters_atomically(change).reason


def test_requests_over_the_same_keyframes_share_one_estimate(
    street: list[Frame], drive: SyntheticDrive, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Peer(**start_parameters(near(drive.reference)), **{**FAST, "online__mode": "manual"}) as peer:
        for frame in street[:4]:
            peer.publish(frame)
        recalibrator = peer.calibration.pipeline.recalibrator
        began, go_on, estimates = threading.Event(), threading.Event(), []
        estimate = recalibrator.estimate

        def slow(*args: Any, **kwargs: Any) -> Any:
            estimates.append(1)
            began.set()
            assert go_on.wait(30)
            return estimate(*args, **kwargs)

        monkeypatch.setattr(recalibrator, "estimate", slow)
        client = peer.peer.create_client(Trigger, "/calib_ros/calibrate")
        assert client.wait_for_service(10)
        answers = [client.call_async(Trigger.Request())]
        assert began.wait(30)
        answers += [client.call_async(Trigger.Request()) for _ in range(3)]
        peer.until(lambda: len(peer.calibration.pipeline._requests._answered) == 4, what="that all have joined")
        go_on.set()
        peer.until(lambda: all(answer.done() for answer in answers), what="the answers")
        assert len(estimates) == 1
        assert len({answer.result().message for answer in answers}) == 1


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
        peer.info_pub.publish(camera_info_message(frame))
        peer.until(lambda: peer.calibration.pipeline.camera is not None)
        peer.image_pub.publish(image_message(frame.image, "camera", frame.stamp))
        peer.cloud_pub.publish(message)
        peer.until(lambda: "of another clock, +37 s from the header stamp" in peer.last_error(), what="the reason")


def test_with_the_defaults_nothing_tentative_is_saved_carried_over_or_usable(
    street: list[Frame], drive: SyntheticDrive, tmp_path: Path
) -> None:
    state = tmp_path / "state.json"
    options = {**FAST, "tracker__confirmations": 3, "state_file": str(state)}
    with Peer(**start_parameters(near(drive.reference)), **options) as peer:
        for frame in street[:4]:
            peer.publish(frame)
        answer = peer.get_extrinsic()
        assert answer.extrinsic.status == "tentative", answer.message
        assert not answer.success
        assert "to be confirmed" in peer.trigger("save").message
        assert not state.exists()
        assert not peer.calibration.pipeline.recalibrator.tracker.carry_over.converged
        for frame in street[4:8]:
            peer.publish(frame)
        answer = peer.until(lambda: (a := peer.get_extrinsic()).success and a, what="a confirmed extrinsic")
        assert answer.extrinsic.status == "converged"
        saved = peer.until(lambda: state.exists() and json.loads(state.read_text()), what="the state file")
        assert saved["provenance"]["sensor_stamp_ns"] == Time.from_msg(answer.extrinsic.estimated_at).nanoseconds
        # After a reset everything is counted anew, the saving too.
        state.unlink()
        assert peer.trigger("reset").success
        for k, frame in enumerate([*street[:8], *street[:4]]):
            moment = street[7].stamp + (k + 5) * NANOSECONDS
            peer.publish(dataclasses.replace(frame, stamp=moment, cloud_stamp=None))
        peer.until(state.exists, what="the state file again")
