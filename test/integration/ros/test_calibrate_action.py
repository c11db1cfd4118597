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

from calib_ros.ros.client import result_from_message

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]
SUCCEEDED, CANCELED, ABORTED = GoalStatus.STATUS_SUCCEEDED, GoalStatus.STATUS_CANCELED, GoalStatus.STATUS_ABORTED
SECONDS, MINUTES = 1 << 14, 1 << 20  # search.starts: how long the search takes


def goal(peer: Peer, starts: int) -> Goal:
    peer.change(search__starts=starts)
    return peer.goal()


@contextmanager
def one_run(peer: Peer, monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """Requests in this block share one run, which goes on when the event is set."""
    recalibrator, go_on, runs = peer.recalibrator, threading.Event(), []
    estimate = recalibrator.estimate

    def held(*args: Any, **kwargs: Any) -> Any:
        runs.append(1)
        assert go_on.wait(LIMIT_S)
        return estimate(*args, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(recalibrator, "estimate", held)
        yield go_on
        peer.settle()
    assert len(runs) == 1


def await_requests(peer: Peer, count: int) -> None:
    requests = peer.pipeline._requests
    peer.until(lambda: requests._running is not None and len(requests._running.asked) == count, "that all have joined")


def assert_answers(peer: Peer, reference: np.ndarray) -> None:
    """The next request gives the right extrinsic."""
    status, result = goal(peer, 64).result()
    assert (status, result.success) == (SUCCEEDED, True), result.message
    assert is_right(reference, result.extrinsic)


def assert_says(asked: Goal, what: str, extrinsic: str) -> None:
    """It is aborted with a message, and the status of the extrinsic."""
    status, result = asked.result()
    assert (status, result.extrinsic.status) == (ABORTED, extrinsic)
    assert what in result.message


@pytest.fixture(scope="module")
def peer(ros_in_this_process, drive, street):
    """A node with four keyframes that waits for requests; before them it says what is missing."""
    with Peer(**start_parameters(off(drive.reference)), **{**QUICK, "online__mode": "manual"}, initial_from_tf=False) as peer:
        assert_says(peer.goal(), "no pair of image and cloud", "initial")
        peer.drive(street[:4])
        yield peer


def test_goals_and_calls_of_the_service_share_one_estimate_with_progress(peer, drive, monkeypatch):
    service = peer.peer.create_client(Trigger, "/calib_ros/calibrate")
    with one_run(peer, monkeypatch) as go_on:
        goals = [goal(peer, SECONDS), peer.goal()]
        called = peer.call_async(service, Trigger.Request())
        await_requests(peer, 3)
        go_on.set()
        results = [asked.result() for asked in goals]
        peer.until(called.done, "the service's answer")
    for status, result in results:
        assert status == SUCCEEDED
        assert (result.success, result.message) == (called.result().success, called.result().message)
        current = peer.get_extrinsic().extrinsic
        assert result.extrinsic.transform.transform == current.transform.transform
        assert np.all(result.extrinsic.covariance == current.covariance)
    for asked in goals:
        assert {said.stage for said in asked.feedback} == {"search"}
        shares = [said.progress for said in asked.feedback]
        assert shares == sorted(shares)
        assert 0 <= shares[0] < shares[-1] <= 1
    assert_answers(peer, drive.reference)


def test_cancel_ends_goal_and_search_and_the_node_answers_afterwards(peer, drive):
    assert_answers(peer, drive.reference)
    before = peer.recalibrator.current
    under_way = goal(peer, MINUTES)
    under_way.await_feedback()
    assert under_way.cancel()
    status, result = under_way.result()
    assert (status, result.success) == (CANCELED, False)
    assert result.message
    peer.settle()
    assert peer.recalibrator.current is before
    np.testing.assert_allclose(result_from_message(result.extrinsic).T_camera_lidar, before.result.T_camera_lidar, atol=1e-9)
    assert not under_way.cancel()  # it is over
    assert_answers(peer, drive.reference)


def test_the_node_answers_others_while_a_goal_is_under_way(peer):
    under_way = goal(peer, MINUTES)
    under_way.await_feedback()
    published = len(peer.extrinsics)
    assert peer.get_extrinsic().extrinsic.status
    peer.until(lambda: len(peer.extrinsics) > published, "the heartbeat")
    assert peer.trigger("reset").success  # the estimate is void, but goes on
    assert peer.pipeline._estimator.busy
    assert under_way.cancel()
    assert under_way.result()[0] == CANCELED
    peer.settle()
    assert_says(peer.goal(), "keyframe", "insufficient")
