"""~/check over real DDS: right, wrong, refused, beside everything else that the node does, and what /diagnostics says of it."""

from __future__ import annotations

import math
import threading
from typing import Any

import numpy as np
import pytest
from calib_ros_msgs.msg import CauseFinding, Deviation
from calib_ros_msgs.srv import Check
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Quaternion, Transform, Vector3
from ros_peer import LATCHED, Peer, start_parameters
from tf2_msgs.msg import TFMessage
from vehicle import QUICK, Vehicle

from calib_ros import se3
from calib_ros.frame import Frame
from calib_ros.result import Cause
from calib_ros.ros.conversions import matrix_from_transform, transform_message
from calib_ros_check.node.requests import check_keyframes
from calib_ros_check.outcome import CheckVerdict

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]
INCONCLUSIVE, PASS, FAIL = Check.Response.INCONCLUSIVE, Check.Response.PASS, Check.Response.FAIL


class Checked:
    """A node at the right extrinsic that waits for requests, four keyframes, and a client of its check."""

    def __init__(self, peer: Peer, street: list[Frame], reference: np.ndarray) -> None:
        self.peer, self.vehicle, self.reference = peer, Vehicle(peer, street, reference), reference
        self.client = peer.peer.create_client(Check, "/calib_ros/check")

    def ask(self, T: np.ndarray | None = None, **fields: Any) -> Any:
        """The future of the answer."""
        request = Check.Request(**fields)
        if T is not None:
            request.extrinsic_given, request.extrinsic = True, transform_message(T, "", "", 0).transform
        return self.peer.call_async(self.client, request)

    def check(self, T: np.ndarray | None = None, **fields: Any) -> Check.Response:
        answer = self.ask(T, **fields)
        self.peer.until(answer.done, "the answer")
        return answer.result()

    def status(self, verdict: str) -> dict[str, str]:
        """Values of the newest status of checks, once it is of such a verdict; the level tells of the node's own extrinsic, which
        is right in all tests."""

        def newest() -> dict[str, str] | None:
            for status in self.peer.diagnostics[-1].status if self.peer.diagnostics else ():
                values = {v.key: v.value for v in status.values}
                if status.name == "calib_ros: check" and values["verdict"] == verdict:
                    assert status.level == DiagnosticStatus.OK
                    return values
            return None

        return self.peer.until(newest, f"diagnostics of a check: {verdict}")


@pytest.fixture(scope="module")
def checked(ros_in_this_process, drive, street):
    with Peer(**start_parameters(drive.reference), **{**QUICK, "online__mode": "manual"}) as peer:
        yield Checked(peer, street, drive.reference)


def test_a_node_without_keyframes_refuses_and_says_what_to_wait_for(checked):
    """First of all: the node has seen nothing yet."""
    assert checked.status("none")
    answer = checked.check()
    assert (answer.success, answer.verdict, answer.cause, answer.covariance[0]) == (False, INCONCLUSIVE, "", -1)
    assert "no pair of image and cloud" in answer.message
    assert math.isnan(answer.p_within)
    assert math.isnan(answer.rotation.error)
    checked.peer.drive(checked.vehicle.frame() for _ in range(4))


def test_a_right_extrinsic_passes_and_nothing_changes(checked):
    recalibrator = checked.peer.recalibrator
    before, keyframes = recalibrator.current, recalibrator.keyframes.seen
    answer = checked.check()
    assert (answer.success, answer.verdict, answer.cause, answer.cause_message) == (True, PASS, "", ""), answer.message
    assert answer.p_within > 0.9
    assert [axis.name for axis in answer.axes] == ["rx", "ry", "rz", "tx", "ty", "tz"]
    assert all(axis.verdict == Deviation.PASS and axis.low <= axis.error <= axis.high and axis.words for axis in answer.axes)
    assert {finding.cause for finding in answer.causes} == {cause.value for cause in Cause} - {"already_rectified"}
    assert all(finding.state != CauseFinding.FOUND and finding.message for finding in answer.causes)
    assert (answer.tolerance_deg, answer.tolerance_m) == (0.5, 0.1)
    np.testing.assert_allclose(matrix_from_transform(answer.checked.transform), checked.reference, atol=1e-9)
    assert (answer.checked.header.frame_id, answer.checked.child_frame_id) == ("camera", "velodyne")
    assert answer.estimate_known
    assert answer.covariance[0] > 0
    assert 0 < answer.keyframes_used <= answer.keyframes == 4
    assert answer.stamp.sec * 10**9 + answer.stamp.nanosec == recalibrator.newest().stamp
    assert (recalibrator.current, recalibrator.keyframes.seen) == (before, keyframes)
    said = checked.status("pass")
    assert said["cause"] == "none"
    assert said["ry, deg"].endswith("pass")


def test_a_wrong_one_of_the_request_fails_with_its_direction_and_size(checked):
    wrong = checked.reference.copy()
    wrong[:3, :3] = se3.perturb(np.eye(4), [0, 2.0, 0], [0, 0, 0])[:3, :3] @ wrong[:3, :3]
    answer = checked.check(wrong, tolerance_deg=1.0, tolerance_m=0.2, max_keyframes=3)
    assert (answer.success, answer.verdict) == (True, FAIL), answer.message
    axes = {axis.name: axis for axis in answer.axes}
    assert axes["ry"].verdict == answer.rotation.verdict == Deviation.FAIL
    assert axes["ry"].low <= 2.0 <= axes["ry"].high
    assert "left" in axes["ry"].words
    assert answer.translation.verdict == Deviation.PASS
    assert (answer.tolerance_deg, answer.tolerance_m, answer.keyframes) == (1.0, 0.2, 3)
    assert se3.rotation_error_deg(checked.reference, matrix_from_transform(answer.estimated.transform)) < 0.5
    said = checked.status("fail")
    assert (said["of the current extrinsic"], said["tolerance"]) == ("no", "1 deg, 0.2 m")


def test_a_cause_is_named_while_the_node_goes_on(checked, monkeypatch):
    """The transform the wrong way round: pairs, heartbeat and answers go on meanwhile."""
    peer, go_on = checked.peer, threading.Event()

    def again_and_again(*args: Any) -> Any:
        """As long as the test needs a node that computes."""
        outcome = check_keyframes(*args)
        while not go_on.is_set():
            outcome = check_keyframes(*args)
        return outcome

    monkeypatch.setattr("calib_ros_check.node.requests.check_keyframes", again_and_again)
    publisher = peer.peer.create_publisher(TFMessage, "/tf_static", LATCHED)
    base = transform_message(se3.perturb(np.eye(4), [0, 0, 30], [0, 1, 0]), "camera", "base_link", 0)
    publisher.publish(TFMessage(transforms=[base]))
    peer.until(lambda: peer.calibration.tf.tree.others("camera", "velodyne"), "the other frame of the vehicle")
    recalibrator = peer.recalibrator
    keyframes, published = recalibrator.keyframes.seen, len(peer.extrinsics)
    under_way = checked.ask(se3.inverse(checked.reference))
    peer.until(lambda: peer.pipeline._estimator.busy, "the check to begin")
    assert peer.get_extrinsic().extrinsic.status == "initial"
    peer.publish(checked.vehicle.frame(), settle=False)
    peer.until(lambda: recalibrator.keyframes.seen > keyframes and len(peer.extrinsics) > published, "that the node goes on")
    assert not under_way.done()
    go_on.set()
    peer.until(under_way.done, "the answer")
    answer = under_way.result()
    assert (answer.verdict, answer.cause) == (FAIL, "inverse_transform"), answer.message
    assert "wrong way round" in answer.cause_message
    states = {finding.cause: finding.state for finding in answer.causes}
    assert states["inverse_transform"] == CauseFinding.FOUND
    assert states["mirrored_image"] == CauseFinding.EXCLUDED
    assert states["time_offset"] == CauseFinding.NOT_JUDGED
    assert answer.notes == []  # frames of the vehicle were tried


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"tolerance_deg": -1.0}, "the tolerance of the rotation, -1 deg"),
        ({"tolerance_m": math.nan}, "the tolerance of the translation, nan m"),
        ({"tolerance_deg": math.inf}, "the tolerance of the rotation, inf deg"),
        ({"extrinsic_given": True, "extrinsic": Transform(rotation=Quaternion(w=0.0))}, "is no rotation"),
        ({"extrinsic_given": True, "extrinsic": Transform(translation=Vector3(x=math.nan))}, "finite"),
        ({"extrinsic": Transform(translation=Vector3(x=1.0))}, "extrinsic_given is false"),
    ],
)
def test_absurd_requests_are_refused_clearly(checked, fields, text):
    answer = checked.check(**fields)
    assert not answer.success
    assert text in answer.message


def test_callers_that_ask_together_or_disappear_do_no_harm(checked):
    """Clients ask for the same, one of them is gone before the answer."""
    peer = checked.peer
    gone = peer.peer.create_client(Check, "/calib_ros/check")
    peer.call_async(gone, Check.Request())
    calls = [checked.ask() for _ in range(3)]
    peer.until(lambda: peer.pipeline._estimator.busy, "the check to begin")
    peer.peer.destroy_client(gone)
    peer.until(lambda: all(call.done() for call in calls), "all answers")
    assert {call.result().verdict for call in calls} == {PASS}
    peer.settle()
    assert checked.check(max_keyframes=1).success


def test_a_node_that_stops_answers_and_ends(checked):
    """Last of all: the node is gone afterwards."""
    peer = checked.peer
    under_way = checked.ask(se3.inverse(checked.reference))
    peer.until(lambda: peer.pipeline._requests._running, "the check to begin")
    peer.pipeline.stop()
    peer.until(under_way.done, "an answer")
    assert not under_way.result().success
    assert "stopping" in under_way.result().message
    peer.until(lambda: not peer.pipeline._estimator.busy, "the end of the check")


def test_messages_and_verdicts_have_the_same_names():
    for verdict in CheckVerdict:
        assert getattr(Check.Response, verdict.name) == getattr(Deviation, verdict.name)
