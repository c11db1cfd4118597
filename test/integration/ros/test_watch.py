"""The client that a live page uses, with a real node over DDS; and ~/keyframes, which it asks for pictures."""

from __future__ import annotations

import math
import time
from contextlib import ExitStack

import cv2
import numpy as np
import pytest
from ros_peer import Peer, start_parameters
from ros_processes import node_process
from sensor_msgs.msg import Image
from vehicle import QUICK, Vehicle
from waiting import LIMIT_S, until

from calib_ros.errors import BadInputError
from calib_ros.ros.conversions import image_message
from calib_ros_check.rig.shown import NEUTRAL
from calib_ros_view.node.calls import CALIBRATE, CHECK, GET_EXTRINSIC, RESET, SAVE
from calib_ros_view.node.watch import LOOK_S, Watch
from calib_ros_view.web.live_words import said_of, words_of_check

pytestmark = [pytest.mark.ros, pytest.mark.slow]
PARAMETERS = {**QUICK, "online__mode": "manual"}


@pytest.fixture(scope="module")
def watch():
    with Watch("/calib_ros") as watching:
        yield watching


@pytest.fixture(scope="module")
def peer(watch, drive):
    """Comes after the watch: the page is open before the node is. end(): ends it, before the tests are done."""
    assert watch.history.heard is None
    answer = watch.call(GET_EXTRINSIC).result(LIMIT_S)
    assert (answer.success, "is not there" in answer.message) == (False, True), answer.message
    with ExitStack() as stack:
        peer = stack.enter_context(Peer(**start_parameters(drive.reference), **PARAMETERS))
        peer.end = stack.close
        yield peer


@pytest.fixture(scope="module")
def vehicle(peer, street, drive):
    return Vehicle(peer, street, drive.reference)


def texts(watch: Watch) -> str:
    with watch.lock:
        return "\n".join(event.text for event in watch.history.events)


def test_a_node_that_starts_later_is_found_and_heard(watch, peer):
    until(lambda: watch.history.heard and not watch.history.gone, "the node is heard")
    assert "/calib_ros" in until(watch.nodes_seen, "names of nodes")
    assert until(lambda: watch.history.diagnosis.values, "diagnostics")["status"] == "none"


def test_keyframes_are_drawn_with_score_and_age(watch, peer, vehicle):
    answer = watch.keyframes().result(LIMIT_S)
    assert (answer.success, "no keyframe yet" in answer.message) == (False, True), answer.message
    assert not answer.response.keyframes
    peer.drive(vehicle.frame() for _ in range(4))
    answer = watch.keyframes(3, 200).result(LIMIT_S)
    assert answer.success, answer.message
    found = answer.response.keyframes
    assert [round(tile.age) for tile in found] == [0, 2, 4]
    assert all(math.isfinite(tile.score) and tile.score > 0 and tile.edge_points > tile.in_view > 100 for tile in found)
    picture = cv2.imdecode(np.frombuffer(found[0].data, np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (60, 200, 3)
    assert np.ptp(picture.astype(int), axis=2).max() > 100, "edge points are coloured"
    assert answer.response.cpu > 0
    answer = watch.keyframes(1, 5000).result(LIMIT_S)
    assert (answer.success, "64 to 1280 px wide" in answer.message) == (False, True), answer.message
    until(lambda: said_of(watch, time.time()).advice == "call ~/calibrate (50% of what is needed)", "what to do")


def test_the_overlay_is_only_drawn_for_lookers(watch, peer, vehicle):
    publisher = peer.calibration.overlay.publisher
    assert publisher.get_subscription_count() == 0
    until(publisher.get_subscription_count, "a subscription", watch.look)
    until(lambda: watch.overlay[2], "an overlay", lambda: (watch.look(), peer.publish(vehicle.frame())))
    assert cv2.imdecode(np.frombuffer(watch.overlay[0], np.uint8), cv2.IMREAD_COLOR).ndim == 3
    until(lambda: publisher.get_subscription_count() == 0, f"no subscription once nobody has looked for {LOOK_S} s")


def test_services_answer_and_what_they_say_becomes_an_event(watch, peer):
    assert "nothing to save" in watch.call(SAVE).result(LIMIT_S).message
    answers = [watch.call(CALIBRATE), watch.call(CALIBRATE)]
    assert "is being called already" in answers[1].result(LIMIT_S).message
    assert answers[0].result(LIMIT_S).success
    until(lambda: watch.history.state is not None and watch.history.state.result.status != "initial", "another status")
    checked = watch.call(CHECK).result(LIMIT_S)
    assert (checked.success, len(checked.response.axes)) == (True, 6), checked.message
    assert {line.partition(": ")[0] for line in words_of_check(checked.response)} >= {"rotation", "pitch", "height"}
    assert watch.call(RESET).result(LIMIT_S).success
    assert watch.busy == frozenset()
    for text in ("~/calibrate called", "~/calibrate: ", "~/save: nothing to save", "~/check: ", "~/reset: keyframes forgotten"):
        assert text in texts(watch)


def test_a_calibration_tells_how_far_it_is_and_can_be_stopped(watch, peer, vehicle):
    assert (watch.progress, watch.stop()) == (None, False)
    peer.drive(vehicle.frame() for _ in range(4))
    peer.change(search__starts=1 << 20)  # minutes
    answer = watch.call(CALIBRATE)
    until(lambda: watch.progress is not None and watch.progress[0] == "search" and watch.progress[1] > 0, "progress")
    assert watch.stop()
    stopped = answer.result(LIMIT_S)
    assert (stopped.success, stopped.message, watch.progress) == (False, "stopped before the estimate was done", None)
    with watch.lock:
        assert watch.history.events[-1].level == NEUTRAL
    peer.settle()
    # Before the node has taken the goal.
    answer = watch.call(CALIBRATE)
    watch.stop()
    assert "stopped" in answer.result(LIMIT_S).message
    peer.settle()
    peer.change(search__starts=64)


def test_a_node_that_ends_is_noticed_and_its_restart_too(watch, peer, drive):
    peer.end()
    until(lambda: watch.history.gone, "it is gone")
    assert "nothing heard of the node" in texts(watch)
    with Peer(**start_parameters(drive.reference), **PARAMETERS):
        until(lambda: watch.history.heard and not watch.history.gone, "it is back")
        assert watch.call(GET_EXTRINSIC).result(LIMIT_S).message
    assert "the node is back after" in texts(watch)


def test_a_call_to_a_node_that_was_killed_ends_once_another_is_there(street):
    with Watch("/calib_ros") as watching:
        images = watching._node.create_publisher(Image, "/camera/image_raw", 10)
        counted = lambda: watching.history.diagnosis.number("images") >= 3  # noqa: E731
        with node_process() as killed:
            until(counted, "images", lambda: images.publish(image_message(street[0].image, "camera", time.time_ns())))
            killed.kill()
            killed.wait()
            answer = watching.call(CHECK)  # ROS lists the dead node for some seconds
            with node_process():
                message = answer.result(LIMIT_S).message
    assert "started anew while" in message or "went away while" in message


@pytest.mark.parametrize("name", ["", "/", "/a b", "/calib_ros; rm", "/../x"])
def test_a_name_that_no_node_can_have_is_refused(name):
    with pytest.raises(BadInputError, match="no name of a ROS node"):
        Watch(name)


def test_calls_under_way_are_answered_when_the_viewer_ends():
    watching = Watch("/nobody")
    watching.close()
    watching.close()
    assert "viewer ends" in watching.call(SAVE).result(LIMIT_S).message
