"""The managed node over real DDS: what each transition makes, ends and keeps."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from importlib.util import find_spec
from typing import Any

import pytest
from calib_ros_msgs.action import Calibrate
from calib_ros_msgs.msg import Extrinsic
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.action import ActionClient
from rclpy.parameter import Parameter
from ros_peer import Peer, start_parameters
from vehicle import QUICK, Vehicle, is_right

from calib_ros import se3
from calib_ros.frame import Frame
from calib_ros.ros.lifecycle_node import CalibLifecycleNode
from calib_ros_synthetic.drive import SyntheticDrive

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]


class Managed:
    """A managed node, and what a lifecycle manager does with it."""

    def __init__(self, **parameters: Any) -> None:
        self.peer = Peer(node_type=CalibLifecycleNode, initial_from_tf=False, **parameters)
        self._change = self.peer.peer.create_client(ChangeState, "/calib_ros/change_state")
        self._get = self.peer.peer.create_client(GetState, "/calib_ros/get_state")

    def __enter__(self) -> Managed:
        return self

    def __exit__(self, *error: object) -> None:
        self.peer.__exit__(*error)

    def change(self, transition: int) -> bool:
        request = ChangeState.Request(transition=Transition(id=transition))
        return bool(self.peer._call(self._change, request).success)

    def configure(self) -> bool:
        return self.change(Transition.TRANSITION_CONFIGURE)

    def activate(self) -> bool:
        return self.change(Transition.TRANSITION_ACTIVATE)

    def deactivate(self) -> bool:
        return self.change(Transition.TRANSITION_DEACTIVATE)

    @property
    def state(self) -> int:
        return int(self.peer._call(self._get, GetState.Request()).current_state.id)

    def topics(self) -> set[str]:
        """All that the node publishes, receives and serves, as others see it."""
        peer = self.peer.peer
        kinds = (
            peer.get_publisher_names_and_types_by_node,
            peer.get_subscriber_names_and_types_by_node,
            peer.get_service_names_and_types_by_node,
        )
        return {topic for kind in kinds for topic, _ in kind("calib_ros", "/")}


@pytest.fixture
def managed(drive: SyntheticDrive) -> Iterator[Managed]:
    start = se3.perturb(drive.reference, [1.2, -1.0, 0.8], [0.08, -0.05, 0.06])
    with Managed(**start_parameters(start), **QUICK) as managed:
        yield managed


def test_a_drive_through_all_states(managed: Managed, street: list[Frame], drive: SyntheticDrive) -> None:
    peer = managed.peer
    assert managed.state == State.PRIMARY_STATE_UNCONFIGURED
    assert peer.calibration is None
    of_every_node = managed.topics()

    assert managed.configure()
    assert managed.state == State.PRIMARY_STATE_INACTIVE
    own = {f"/calib_ros/{name}" for name in ("extrinsic", "overlay", "get_extrinsic", "capture", "calibrate/_action/send_goal")}
    peer.until(lambda: own <= managed.topics() - of_every_node, what="topics and services")
    asked = peer.trigger("calibrate")
    assert not asked.success
    assert "not active" in asked.message
    action = ActionClient(peer.peer, Calibrate, "/calib_ros/calibrate")
    assert action.wait_for_server(10)
    sent = action.send_goal_async(Calibrate.Goal())
    peer.until(sent.done)
    assert not sent.result().accepted
    assert peer.get_extrinsic().extrinsic.status == "initial"
    assert peer.image_pub.get_subscription_count() == 0
    assert peer.extrinsics == []

    assert managed.activate()
    peer.await_subscriptions()
    vehicle = Vehicle(peer, street, drive.reference)
    peer.publish(vehicle.frame())
    vehicle.assert_recovers()
    found = peer.get_extrinsic().extrinsic
    assert found.usable
    recalibrator, keyframes = peer.calibration.pipeline.recalibrator, peer.calibration.pipeline.recalibrator.keyframes_seen

    # Inactive: the last message says that nobody looks after the extrinsic, and no data are received.
    assert managed.deactivate()
    assert managed.state == State.PRIMARY_STATE_INACTIVE
    peer.until(lambda: not peer.extrinsics[-1].usable, what="the last message")
    assert not peer.latched(Extrinsic, "/calib_ros/extrinsic").usable
    peer.until(lambda: peer.image_pub.get_subscription_count() == 0, what="the end of the subscriptions")
    answer = peer.get_extrinsic()
    assert not answer.success
    assert "not active" in answer.message
    assert answer.last_good_known
    assert is_right(drive.reference, answer.last_good)

    # Active again: keyframes and extrinsic are those of before; they count once data come.
    assert managed.activate()
    peer.await_subscriptions()
    assert not peer.get_extrinsic().extrinsic.usable
    assert peer.calibration.pipeline.recalibrator is recalibrator
    assert recalibrator.keyframes_seen == keyframes
    peer.publish(vehicle.frame())
    again = peer.get_extrinsic().extrinsic
    assert again.usable
    assert is_right(drive.reference, again)
    assert recalibrator.keyframes_seen == keyframes + 1

    # Nothing is left but the parameters, with their values; the next configuration begins anew from them.
    assert peer.node.set_parameters([Parameter("online.buffer_size", value=7)])[0].successful
    assert managed.deactivate()
    assert managed.change(Transition.TRANSITION_CLEANUP)
    assert managed.state == State.PRIMARY_STATE_UNCONFIGURED
    assert peer.calibration is None
    peer.until(lambda: managed.topics() == of_every_node, what="that all topics and services are gone")
    assert managed.configure()
    assert managed.activate()
    peer.await_subscriptions()
    assert peer.calibration.pipeline.recalibrator is None
    assert peer.calibration.pipeline.config.online.buffer_size == 7
    vehicle.peer.publish(vehicle.frame())
    vehicle.assert_recovers()


def test_deactivation_ends_a_goal_and_shutdown_a_running_search(
    managed: Managed, street: list[Frame], drive: SyntheticDrive
) -> None:
    peer = managed.peer
    assert managed.configure()
    long = [Parameter("online.mode", value="manual"), Parameter("search.starts", value=1 << 20)]
    assert peer.node.set_parameters_atomically(long).successful
    assert managed.activate()
    peer.await_subscriptions()
    vehicle = Vehicle(peer, street, drive.reference)
    peer.publish(vehicle.frame())
    action = ActionClient(peer.peer, Calibrate, "/calib_ros/calibrate")
    assert action.wait_for_server(10)

    def search() -> Any:
        feedback: list[Any] = []
        sent = action.send_goal_async(Calibrate.Goal(), feedback_callback=feedback.append)
        peer.until(sent.done)
        result = sent.result().get_result_async()
        peer.until(lambda: feedback, what="feedback")
        return result

    result = search()
    assert managed.deactivate()
    peer.until(result.done, what="the end of the goal")
    assert "not active" in result.result().result.message
    assert managed.activate()
    peer.await_subscriptions()
    search()
    pipeline = peer.calibration.pipeline
    assert managed.change(Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert managed.state == State.PRIMARY_STATE_FINALIZED
    assert peer.calibration is None
    assert not pipeline.estimating
    peer.until(lambda: "/calib_ros/get_extrinsic" not in managed.topics(), what="that all services are gone")
    assert managed.state == State.PRIMARY_STATE_FINALIZED  # it still answers: no answer was sent through a service that is gone


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"search__rotation_deg": -5.0}, "search.rotation_deg"),
        ({"image_transport": "theora"}, "image_transport"),
        ({"tf_parent": "map"}, "tf_child must name its child"),
    ],
)
def test_bad_parameters_fail_the_configuration_in_one_line(
    parameters: dict[str, Any], text: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with Managed(**parameters) as managed:
        for _ in range(2):
            assert not managed.configure()
            assert managed.state == State.PRIMARY_STATE_UNCONFIGURED
            assert managed.peer.calibration is None
    lines = [line for line in capfd.readouterr().err.splitlines() if "[ERROR]" in line]
    assert len(lines) == 2
    assert all(text in line for line in lines)


@pytest.mark.skipif(find_spec("nav_msgs") is not None, reason="nav_msgs is installed: nothing is missing")
def test_a_missing_package_fails_the_configuration_and_leaves_nothing_behind() -> None:
    with Managed(motion_source="odom") as managed:
        before, threads = managed.topics(), threading.active_count()
        assert not managed.configure()
        assert managed.topics() == before
        assert threading.active_count() == threads


def test_parameters_put_right_let_the_configuration_pass() -> None:
    with Managed(tf_parent="map") as managed:
        assert not managed.configure()
        assert managed.peer.node.set_parameters([Parameter("tf_parent", value="lidar")])[0].successful
        assert managed.configure()
        assert managed.peer.calibration.parameters["tf_parent"] == "lidar"
