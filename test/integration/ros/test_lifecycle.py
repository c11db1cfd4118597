"""The managed node over real DDS: what each transition makes, ends and keeps."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from importlib.util import find_spec
from typing import Any

import pytest
from calib_ros_msgs.msg import Extrinsic
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from ros_peer import Peer, start_parameters
from vehicle import QUICK, Vehicle, is_right, off

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
        return bool(self.peer.call(self._change, request).success)

    def configure(self) -> bool:
        return self.change(Transition.TRANSITION_CONFIGURE)

    def activate(self) -> None:
        assert self.change(Transition.TRANSITION_ACTIVATE)
        self.peer.await_subscriptions()

    def deactivate(self) -> None:
        assert self.change(Transition.TRANSITION_DEACTIVATE)

    @property
    def state(self) -> int:
        return int(self.peer.call(self._get, GetState.Request()).current_state.id)

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
    with Managed(**start_parameters(off(drive.reference)), **QUICK) as managed:
        yield managed


def test_a_drive_through_all_states(managed: Managed, street: list[Frame], drive: SyntheticDrive) -> None:
    peer = managed.peer
    assert managed.state == State.PRIMARY_STATE_UNCONFIGURED
    assert peer.calibration is None
    of_every_node = managed.topics()

    assert managed.configure()
    assert managed.state == State.PRIMARY_STATE_INACTIVE
    own = {f"/calib_ros/{name}" for name in ("extrinsic", "overlay", "get_extrinsic", "capture", "calibrate/_action/send_goal")}
    peer.until(lambda: own <= managed.topics() - of_every_node, "topics and services")
    assert "not active" in peer.refusal("calibrate")
    assert not peer.goal().accepted
    assert peer.get_extrinsic().extrinsic.status == "initial"
    assert peer.image_pub.get_subscription_count() == 0
    assert peer.extrinsics == []

    managed.activate()
    vehicle = Vehicle(peer, street, drive.reference)
    peer.publish(vehicle.frame())
    vehicle.assert_recovers()
    found = peer.get_extrinsic().extrinsic
    assert found.usable
    recalibrator, keyframes = peer.recalibrator, peer.recalibrator.keyframes_seen

    # Inactive: the last message says that nobody looks after the extrinsic, and no data are received.
    managed.deactivate()
    assert managed.state == State.PRIMARY_STATE_INACTIVE
    peer.until(lambda: not peer.extrinsics[-1].usable, "the last message")
    assert not peer.latched(Extrinsic, "/calib_ros/extrinsic").usable
    peer.until(lambda: peer.image_pub.get_subscription_count() == 0, "the end of the subscriptions")
    answer = peer.get_extrinsic()
    assert not answer.success
    assert "not active" in answer.message
    assert answer.last_good_known
    assert is_right(drive.reference, answer.last_good)

    # Active again: keyframes and extrinsic are those of before; they count once data come.
    managed.activate()
    assert not peer.get_extrinsic().extrinsic.usable
    assert peer.recalibrator is recalibrator
    assert recalibrator.keyframes_seen == keyframes
    peer.publish(vehicle.frame())
    again = peer.get_extrinsic().extrinsic
    assert again.usable
    assert is_right(drive.reference, again)
    assert recalibrator.keyframes_seen == keyframes + 1

    # Nothing is left but the parameters, with their values; the next configuration begins anew from them.
    peer.change(online__buffer_size=7)
    managed.deactivate()
    assert managed.change(Transition.TRANSITION_CLEANUP)
    assert managed.state == State.PRIMARY_STATE_UNCONFIGURED
    assert peer.calibration is None
    peer.until(lambda: managed.topics() == of_every_node, "that all topics and services are gone")
    assert managed.configure()
    managed.activate()
    assert peer.recalibrator is None
    assert peer.pipeline.config.online.buffer_size == 7
    vehicle.peer.publish(vehicle.frame())
    vehicle.assert_recovers()


def test_deactivation_ends_a_goal_and_shutdown_a_running_search(
    managed: Managed, street: list[Frame], drive: SyntheticDrive
) -> None:
    peer = managed.peer
    assert managed.configure()
    peer.change(online__mode="manual", search__starts=1 << 20)  # minutes
    managed.activate()
    peer.publish(Vehicle(peer, street, drive.reference).frame())
    goal = peer.goal()
    goal.await_feedback()
    managed.deactivate()
    assert "not active" in goal.result()[1].message
    managed.activate()
    peer.goal().await_feedback()
    pipeline = peer.pipeline
    assert managed.change(Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert managed.state == State.PRIMARY_STATE_FINALIZED
    assert peer.calibration is None
    assert not pipeline._estimator.busy
    peer.until(lambda: "/calib_ros/get_extrinsic" not in managed.topics(), "that all services are gone")
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
        managed.peer.change(tf_parent="lidar")
        assert managed.configure()
        assert managed.peer.calibration.parameters["tf_parent"] == "lidar"
