"""The managed node over real DDS: what each transition makes, ends and keeps."""

from __future__ import annotations

import threading
from importlib.util import find_spec
from typing import Any

import pytest
from calib_ros_msgs.msg import Extrinsic
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from ros_peer import Peer, start_parameters
from vehicle import QUICK, Vehicle, is_right, off

from calib_ros.ros.node import CalibLifecycleNode

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]
UNCONFIGURED, INACTIVE = State.PRIMARY_STATE_UNCONFIGURED, State.PRIMARY_STATE_INACTIVE
FINALIZED = State.PRIMARY_STATE_FINALIZED


class Managed(Peer):
    """A managed node, and what a lifecycle manager does with it."""

    def __init__(self, **parameters: Any) -> None:
        super().__init__(node_type=CalibLifecycleNode, initial_from_tf=False, **parameters)
        self._change = self.peer.create_client(ChangeState, "/calib_ros/change_state")
        self._state = self.peer.create_client(GetState, "/calib_ros/get_state")

    def transit(self, transition: int) -> bool:
        request = ChangeState.Request(transition=Transition(id=transition))
        return bool(self.call(self._change, request).success)

    def configure(self) -> int:
        """The state afterwards."""
        assert self.transit(Transition.TRANSITION_CONFIGURE) == (self.calibration is not None)
        return self.state

    def activate(self) -> None:
        assert self.transit(Transition.TRANSITION_ACTIVATE)
        self.await_subscriptions()

    def deactivate(self) -> None:
        assert self.transit(Transition.TRANSITION_DEACTIVATE)

    @property
    def state(self) -> int:
        return int(self.call(self._state, GetState.Request()).current_state.id)

    def topics(self) -> set[str]:
        """All that the node publishes, receives and serves, as others see it."""
        kinds = [getattr(self.peer, f"get_{kind}_names_and_types_by_node") for kind in ("publisher", "subscriber", "service")]
        return {topic for kind in kinds for topic, _ in kind("calib_ros", "/")}


@pytest.fixture
def managed(drive):
    with Managed(**start_parameters(off(drive.reference)), **QUICK) as managed:
        yield managed


def test_a_drive_through_all_states(managed, street, drive):
    assert managed.state == UNCONFIGURED
    assert managed.calibration is None
    of_every_node = managed.topics()

    assert managed.configure() == INACTIVE
    own = {f"/calib_ros/{name}" for name in ("extrinsic", "overlay", "get_extrinsic", "capture", "calibrate/_action/send_goal")}
    managed.until(lambda: own <= managed.topics() - of_every_node, "topics and services")
    assert "not active" in managed.refusal("calibrate")
    assert not managed.goal().accepted
    assert managed.get_extrinsic().extrinsic.status == "initial"
    assert managed.image_pub.get_subscription_count() == 0
    assert managed.extrinsics == []

    managed.activate()
    vehicle = Vehicle(managed, street, drive.reference)
    managed.publish(vehicle.frame())
    vehicle.assert_recovers()
    found = managed.get_extrinsic().extrinsic
    assert found.usable
    recalibrator, keyframes = managed.recalibrator, managed.recalibrator.keyframes.seen

    # Inactive: the last message says that nobody looks after the extrinsic, and no data are received.
    managed.deactivate()
    assert managed.state == INACTIVE
    managed.until(lambda: not managed.latched(Extrinsic, "/calib_ros/extrinsic").usable, "the last message")
    managed.until(lambda: managed.image_pub.get_subscription_count() == 0, "the end of the subscriptions")
    answer = managed.get_extrinsic()
    assert not answer.success
    assert "not active" in answer.message
    assert answer.last_good_known
    assert is_right(drive.reference, answer.last_good)

    # Active again: keyframes and extrinsic are those of before; they count once data come.
    managed.activate()
    assert not managed.get_extrinsic().extrinsic.usable
    assert managed.recalibrator is recalibrator
    assert recalibrator.keyframes.seen == keyframes
    managed.publish(vehicle.frame())
    again = managed.get_extrinsic().extrinsic
    assert again.usable
    assert is_right(drive.reference, again)
    assert recalibrator.keyframes.seen == keyframes + 1

    # Nothing is left but the parameters, with their values; the next configuration begins anew from them.
    managed.change(online__buffer_size=7)
    managed.deactivate()
    assert managed.transit(Transition.TRANSITION_CLEANUP)
    assert managed.state == UNCONFIGURED
    assert managed.calibration is None
    managed.until(lambda: managed.topics() == of_every_node, "that all topics and services are gone")
    assert managed.configure() == INACTIVE
    managed.activate()
    assert managed.recalibrator is None
    assert managed.pipeline.config.online.buffer_size == 7
    managed.publish(vehicle.frame())
    vehicle.assert_recovers()


def test_deactivation_ends_a_goal_and_shutdown_a_running_search(managed, street, drive):
    managed.configure()
    managed.change(online__mode="manual", search__starts=1 << 20)  # minutes
    managed.activate()
    managed.publish(Vehicle(managed, street, drive.reference).frame())
    goal = managed.goal()
    goal.await_feedback()
    managed.deactivate()
    assert "not active" in goal.result()[1].message
    managed.activate()
    managed.goal().await_feedback()
    pipeline = managed.pipeline
    assert managed.transit(Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert managed.state == FINALIZED
    assert managed.calibration is None
    assert not pipeline._estimator.busy
    managed.until(lambda: "/calib_ros/get_extrinsic" not in managed.topics(), "that all services are gone")
    assert managed.state == FINALIZED  # it still answers: no answer was sent through a service that is gone


@pytest.mark.parametrize(
    ("wrong", "right", "text"),
    [
        ({"search__rotation_deg": -5.0}, {}, "search.rotation_deg"),
        ({"tf_parent": "map"}, {"tf_parent": "lidar"}, "tf_child must name its child"),
    ],
)
def test_bad_parameters_fail_the_configuration_in_one_line_until_they_are_put_right(capfd, wrong, right, text):
    with Managed(**wrong) as managed:
        for _ in range(2):
            assert managed.configure() == UNCONFIGURED
        if right:
            managed.change(**right)
            assert managed.configure() == INACTIVE
    lines = [line for line in capfd.readouterr().err.splitlines() if "[ERROR]" in line]
    assert len(lines) == 2
    assert all(text in line for line in lines)


@pytest.mark.skipif(find_spec("nav_msgs") is not None, reason="nav_msgs is installed: nothing is missing")
def test_a_missing_package_fails_the_configuration_and_leaves_nothing_behind(capfd):
    with Managed(motion_source="odom") as managed:
        before, threads = managed.topics(), threading.active_count()
        assert managed.configure() == UNCONFIGURED
        assert (managed.topics(), threading.active_count()) == (before, threads)
    assert "motion_source: odom needs nav_msgs; install it" in capfd.readouterr().err
