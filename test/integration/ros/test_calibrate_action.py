"""~/calibrate as an action, over real DDS: progress, cancel, and one estimate for service and goals together."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from ros_peer import Goal, Peer, start_parameters
from std_srvs.srv import Trigger
from vehicle import QUICK, is_right, off
from waiting import LIMIT_S

from calib_ros.frame import Frame
from calib_ros.ros.client import result_from_message
from calib_ros_synthetic.drive import SyntheticDrive

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]
SECONDS, MINUTES = 1 << 14, 1 << 20  # search.starts: how long the search takes


class Calibrated:
    """A node with four keyframes that waits for requests."""

    def __init__(self, peer: Peer) -> None:
        self.peer = peer

    def goal(self, starts: int | None = None) -> Goal:
        if starts is not None:
            self.peer.change(search__starts=starts)
        return self.peer.goal()

    @contextmanager
    def one_run(self, monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
        """Requests in this block share one run, which goes on when the event is set."""
        recalibrator, go_on, runs = self.peer.recalibrator, threading.Event(), []
        estimate = recalibrator.estimate

        def held(*args: Any, **kwargs: Any) -> Any:
            runs.append(1)
            assert go_on.wait(LIMIT_S)
            return estimate(*args, **kwargs)

        with monkeypatch.context() as patch:
            patch.setattr(recalibrator, "estimate", held)
            yield go_on
            self.peer.settle()
        assert len(runs) == 1

    def await_requests(self, count: int) -> None:
        requests = self.peer.pipeline._requests
        self.peer.until(lambda: len(requests._answered) == count, "that all have joined")


@pytest.fixture(scope="module")
def calibrated(ros_in_this_process: None, drive: SyntheticDrive, street: list[Frame]) -> Iterator[Calibrated]:
    with Peer(**start_parameters(off(drive.reference)), **{**QUICK, "online__mode": "manual"}, initial_from_tf=False) as peer:
        peer.drive(street[:4])
        yield Calibrated(peer)


def assert_answers(calibrated: Calibrated, drive: SyntheticDrive) -> None:
    """The next request gives the right extrinsic."""
    status, result = calibrated.goal(starts=64).result()
    assert status == GoalStatus.STATUS_SUCCEEDED, result.message
    assert result.success
    assert is_right(drive.reference, result.extrinsic)


def test_goals_and_calls_of_the_service_share_one_estimate_with_progress(
    calibrated: Calibrated, drive: SyntheticDrive, monkeypatch: pytest.MonkeyPatch
) -> None:
    peer = calibrated.peer
    service = peer.peer.create_client(Trigger, "/calib_ros/calibrate")
    with calibrated.one_run(monkeypatch) as go_on:
        goals = [calibrated.goal(starts=SECONDS), calibrated.goal()]
        called = peer.call_async(service, Trigger.Request())
        calibrated.await_requests(3)
        go_on.set()
        results = [goal.result() for goal in goals]
        peer.until(called.done, "the service's answer")
    for status, result in results:
        assert status == GoalStatus.STATUS_SUCCEEDED
        assert (result.success, result.message) == (called.result().success, called.result().message)
        current = peer.get_extrinsic().extrinsic
        assert result.extrinsic.transform.transform == current.transform.transform
        assert np.all(result.extrinsic.covariance == current.covariance)
    for goal in goals:
        assert {said.stage for said in goal.feedback} == {"search"}
        shares = [said.progress for said in goal.feedback]
        assert len(shares) >= 2
        assert shares == sorted(shares)
        assert 0 <= shares[0] < shares[-1] <= 1
    assert_answers(calibrated, drive)


def test_cancel_ends_goal_and_search_and_the_node_answers_afterwards(calibrated: Calibrated, drive: SyntheticDrive) -> None:
    peer = calibrated.peer
    assert_answers(calibrated, drive)
    before = peer.recalibrator.current
    goal = calibrated.goal(starts=MINUTES)
    goal.await_feedback()
    assert goal.cancel()
    status, result = goal.result()
    assert status == GoalStatus.STATUS_CANCELED
    assert not result.success
    assert result.message
    peer.settle()
    assert peer.recalibrator.current is before
    np.testing.assert_allclose(result_from_message(result.extrinsic).T_camera_lidar, before.result.T_camera_lidar, atol=1e-9)
    assert not goal.cancel()  # it is over
    assert_answers(calibrated, drive)


def test_a_cancelled_goal_leaves_the_estimate_to_the_others(calibrated: Calibrated, monkeypatch: pytest.MonkeyPatch) -> None:
    with calibrated.one_run(monkeypatch) as go_on:
        cancelled, other = calibrated.goal(), calibrated.goal()
        calibrated.await_requests(2)
        assert cancelled.cancel()
        assert cancelled.result()[0] == GoalStatus.STATUS_CANCELED  # at once: the estimate has not gone on yet
        go_on.set()
        status, result = other.result()
        assert status == GoalStatus.STATUS_SUCCEEDED, result.message


def test_the_node_answers_others_while_a_goal_is_under_way(calibrated: Calibrated, drive: SyntheticDrive) -> None:
    peer = calibrated.peer
    goal = calibrated.goal(starts=MINUTES)
    goal.await_feedback()
    published = len(peer.extrinsics)
    assert peer.get_extrinsic().extrinsic.status
    peer.until(lambda: len(peer.extrinsics) > published, "the heartbeat")
    assert peer.trigger("reset").success  # the estimate is void, but goes on
    assert peer.pipeline._estimator.busy
    assert goal.cancel()
    assert goal.result()[0] == GoalStatus.STATUS_CANCELED
    peer.settle()
    status, nothing = calibrated.goal().result()
    assert status == GoalStatus.STATUS_ABORTED
    assert "keyframe" in nothing.message
    assert nothing.extrinsic.status == "insufficient"


def test_a_goal_before_any_message_says_what_is_missing(ros_in_this_process: None) -> None:
    with Peer(initial_from_tf=False) as peer:
        status, result = peer.goal().result()
        assert status == GoalStatus.STATUS_ABORTED
        assert "no pair of image and cloud" in result.message
        assert result.extrinsic.status == "initial"
