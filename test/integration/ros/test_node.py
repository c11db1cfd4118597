"""The node over real DDS, in this process: messages in, extrinsic out, and what other nodes rely on: usable or not, at a steady
rate, and said when the data or the node end."""

from __future__ import annotations

import dataclasses
import json
import threading
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calib_ros_msgs.msg import Extrinsic
from geometry_msgs.msg import TransformStamped
from paths import ROOT, module_at
from rclpy.executors import SingleThreadedExecutor
from rclpy.time import Time
from ros_peer import Peer, camera_info_message, start_parameters
from scenes import is_near
from sensor_msgs.msg import CompressedImage, Image
from vehicle import QUICK, Vehicle, is_right, off

from calib_ros.frame import NANOSECONDS, PointCloud
from calib_ros.messages import decode_compressed_image, decode_image
from calib_ros.result import CONVERGED, Cause, Result
from calib_ros.ros.client import result_from_message
from calib_ros.ros.conversions import extrinsic_message

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]
PERIOD_S, AGE_S = 0.1, 0.5  # AGE_S: of data that are too old, in the test of it
FAST = {**QUICK, "publish_period_s": PERIOD_S, "initial_from_tf": False}


def seconds(duration: Any) -> float:
    return float(duration.sec + duration.nanosec / NANOSECONDS)


def matrix(extrinsic: Extrinsic) -> np.ndarray:
    return result_from_message(extrinsic).T_camera_lidar


def test_dead_lidar_beside_a_parked_car_is_named(street, drive):
    """The picture stays the same, so that no frame is a keyframe; the cloud is looked at all the same, frame_id or not."""
    with Peer(**start_parameters(drive.reference)) as peer:
        peer.publish(street[0], frame_id="")
        assert "messages of the lidar have no frame_id" in peer.last_error()
        for k in range(2):
            errors = peer.calibration.health.errors
            empty = PointCloud(np.full((500 * k, 3), np.nan, np.float32))
            frame = dataclasses.replace(street[0], stamp=street[0].stamp + (k + 1) * 10**8, cloud_stamp=None, cloud=empty)
            peer.publish(frame, frame_id="")
            assert peer.calibration.health.errors > errors
            assert ("0 usable points", "the LiDAR shows nothing (no returns)")[k] in peer.last_error()


def test_clouds_of_coordinates_alone_calibrate(street, drive):
    """Big-endian ones; what is missing is said."""
    with Peer(**start_parameters(off(drive.reference)), **QUICK) as peer:
        peer.drive(street[:4], drop=("intensity", "ring", "time"), big=True)
        answer = peer.get_extrinsic()
    assert answer.extrinsic.status == "converged", answer.message
    assert is_right(drive.reference, answer.extrinsic)
    assert "reflectivity edges are off" in answer.message


def test_a_restored_extrinsic_is_used_when_keyframes_confirm_it(street, drive, tmp_path):
    """And not for other frames."""
    state = tmp_path / "state.json"
    with Peer(**start_parameters(off(drive.reference)), **FAST, state_file=str(state)) as peer:
        peer.drive(street[:5])
        saved = peer.get_extrinsic().extrinsic
    with Peer(**FAST, state_file=str(state), online__mode="manual") as peer:
        early = peer.get_extrinsic()  # asked before any message: not yet confirmed to be of these sensors
        assert not early.success
        np.testing.assert_allclose(matrix(early.extrinsic), matrix(saved), atol=1e-9)
        peer.publish(street[0])
        assert peer.calibration.health.errors == 0
        first = peer.until(lambda: peer.extrinsics and peer.extrinsics[0], "the restored extrinsic")
        assert (first.status, first.usable, first.estimated_at) == ("initial", False, saved.estimated_at)
        np.testing.assert_allclose(matrix(first), matrix(saved), atol=1e-9)
        assert first.transform.header.stamp == saved.estimated_at
        peer.drive(street[5:9])
        peer.until(lambda: peer.extrinsics[-1].usable, "that keyframes confirm it")
        assert peer.extrinsics[-1].estimated_at == saved.estimated_at
    with Peer(**FAST, state_file=str(state), lidar_frame="other_lidar") as peer:
        peer.publish(street[0])
        assert "other_lidar" in peer.last_error()
        assert peer.get_extrinsic().extrinsic.status == "initial"


def test_a_damaged_state_file_is_named_once_and_other_sources_give_the_start(street, drive, tmp_path):
    """However often it is read while the node waits for TF."""
    state = tmp_path / "state.json"
    Result(drive.reference, CONVERGED, camera_frame="camera", lidar_frame="velodyne").save(state)
    state.write_text(state.read_text()[:200])
    with Peer(**QUICK, state_file=str(state)) as peer:
        assert not peer.get_extrinsic().success
        vehicle = Vehicle(peer, street, drive.reference)
        peer.publish_camera(vehicle.frame())
        peer.until(lambda: vehicle.send(vehicle.frame()) or peer.recalibrator)
        assert "state" in peer.last_error()
        assert peer.calibration.health.errors == 1
        first = peer.until(lambda: peer.extrinsics)[0]
        assert first.status == "initial"
        assert "nominal" in first.reason


def test_example_consumer_stops_using_the_extrinsic_of_a_node_that_has_ended(street, drive, monkeypatch):
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


def test_with_the_defaults_nothing_tentative_is_saved_carried_over_or_usable(street, drive, tmp_path):
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
        vehicle = Vehicle(peer, street, drive.reference)
        vehicle.stamp = street[7].stamp + 4 * NANOSECONDS
        for _ in range(12):
            if not state.exists():
                peer.publish(vehicle.frame(1.0))
        peer.until(state.exists, "the state file again")


@pytest.fixture(scope="module")
def peer(ros_in_this_process, drive, tmp_path_factory):
    """A node that the tests from here on share, in their order; no other one may be there beside it."""
    state = tmp_path_factory.mktemp("node") / "state.json"
    with Peer(**start_parameters(off(drive.reference)), **FAST, state_file=str(state)) as peer:
        yield peer


def test_the_start_is_published_again_and_again_and_not_usable(peer, street, drive):
    before = peer.get_extrinsic()
    assert (before.success, before.extrinsic.status) == (False, "initial")
    peer.publish(street[0])
    peer.until(lambda: len(peer.extrinsics) >= 3, "the same extrinsic again and again")
    first = peer.extrinsics[0]
    assert not any(msg.usable for msg in peer.extrinsics)
    assert (first.status, first.estimated_at.sec) == ("initial", 0)
    np.testing.assert_allclose(matrix(first), off(drive.reference), atol=1e-9)
    advice = peer.get_extrinsic().extrinsic.advice
    assert advice.text == "keep driving: 1 of 4 keyframes, each of another view"
    assert 0 < advice.progress < 0.3
    assert advice.remaining.sec == -1, "one keyframe has no pace"


def test_from_messages_to_a_published_extrinsic(peer, street, drive):
    overlays = peer.listen(Image, "/calib_ros/overlay", 5)
    compressed = peer.listen(CompressedImage, "/calib_ros/overlay/compressed", 5)
    peer.drive(street[1:5])
    answer = peer.get_extrinsic()
    assert answer.success
    assert answer.extrinsic.status == "converged"
    assert (answer.extrinsic.transform.header.frame_id, answer.extrinsic.transform.child_frame_id) == ("camera", "velodyne")
    result = result_from_message(answer.extrinsic)
    assert is_near(drive.reference, result.T_camera_lidar, 0.3, 0.08)
    assert result.frames_used == len(peer.recalibrator.keyframes) >= 5
    assert (list(answer.extrinsic.advice.weak), answer.extrinsic.advice.text) == ([], "")
    assert (answer.extrinsic.advice.progress, seconds(answer.extrinsic.advice.remaining)) == (1.0, 0.0)
    values = {value.key: value.value for value in peer.until(lambda: peer.diagnostics, "diagnostics")[-1].status[0].values}
    assert {"advice", "progress, %"} <= values.keys()
    # Covariances cross the border into ROS's order and back unchanged, and a cause as it is.
    current = peer.recalibrator.current
    np.testing.assert_allclose(result.covariance, current.result.covariance)
    np.testing.assert_allclose(result.covariance_with_intrinsics, current.result.covariance_with_intrinsics)
    blamed = replace(current, result=replace(current.result, cause=Cause.ROTATED_IMAGE))
    assert (result.cause, result_from_message(extrinsic_message(blamed, 0)).cause) == (None, Cause.ROTATED_IMAGE)
    assert np.sqrt(answer.extrinsic.covariance[0]) == pytest.approx(0.018, abs=0.02)  # metres come first in ROS

    # Whoever joins late gets the latched extrinsic and transform.
    assert peer.latched(Extrinsic, "/calib_ros/extrinsic").score == pytest.approx(answer.extrinsic.score)
    transform = peer.latched(TransformStamped, "/calib_ros/transform")
    assert transform.transform.translation.x == pytest.approx(result.T_camera_lidar[0, 3], abs=1e-12)

    peer.until(lambda: overlays and compressed, "an overlay in both forms")
    assert compressed[-1].format == "bgr8; jpeg compressed bgr8"
    picture, jpeg = decode_image(overlays[-1]), decode_compressed_image(compressed[-1])
    in_grey = partial(np.dot, b=[0.114, 0.587, 0.299])  # JPEG blurs the colours of points
    peer.until(lambda: min(np.abs(in_grey(decode_image(drawn)) - in_grey(jpeg)).mean() for drawn in overlays) < 3, "one drawing")
    assert picture.shape[1] >= street[0].image.shape[1]
    assert picture.std() > 10
    saved = json.loads(Path(peer.calibration.parameters["state_file"]).read_text())
    np.testing.assert_allclose(saved["T_camera_lidar"], result.T_camera_lidar, atol=1e-9)
    assert saved["provenance"]["sensor_stamp_ns"] == Time.from_msg(answer.extrinsic.estimated_at).nanoseconds


def test_an_extrinsic_is_usable_only_while_data_come(peer, street):
    msg = peer.until(lambda: peer.extrinsics[-1] if peer.extrinsics[-1].usable else None, "a usable extrinsic")
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


def test_usable_outlives_a_lack_of_cpu_time_for_a_while(peer, street, monkeypatch):
    """A pair has come just now, but nobody gets to look at it."""
    looked, decode, most = threading.Event(), peer.pipeline._inputs.decode, 3600.0
    inputs = dataclasses.replace(peer.pipeline._inputs, decode=lambda *pair: (looked.wait(), decode(*pair))[1])
    monkeypatch.setattr(peer.pipeline, "_inputs", inputs)

    def said(usable: bool, age_s: float) -> bool:
        """What is said while the newest pair that was looked at is so old."""
        peer.pipeline._received = time.monotonic() - age_s
        msg = peer.until(lambda: peer.extrinsics[-1] if seconds(peer.extrinsics[-1].data_age) >= age_s else None, "a message")
        return msg.usable == usable and "starved" in msg.reason

    try:
        peer.publish(dataclasses.replace(street[-1], stamp=street[-1].stamp + 2 * NANOSECONDS, cloud_stamp=None), settle=False)
        peer.until(lambda: peer.pipeline.taking_in, "the pair")
        assert said(True, 1.5 * most)
        assert said(False, 3.5 * most)
    finally:
        looked.set()
    peer.settle()
    peer.until(lambda: peer.extrinsics[-1].usable, "that there is time again")


def test_reset_goes_back_to_the_start_and_calibrate_answers_when_its_estimate_is_done(peer, street, drive):
    assert peer.trigger("reset").success
    np.testing.assert_allclose(matrix(peer.get_extrinsic().extrinsic), off(drive.reference), atol=1e-9)
    assert "keyframe" in peer.refusal("calibrate")
    assert peer.refusal("save")
    peer.drive(street[:3])  # too few for an estimate of its own accord
    done = peer.trigger("calibrate")
    assert done.success, done.message
    assert "3 keyframes" in done.message
    assert peer.trigger("save").success


def test_other_intrinsics_start_anew_and_other_sensors_are_turned_away(peer, street, drive):
    kept = peer.get_extrinsic().extrinsic
    assert kept.status == "converged"
    recalibrator = peer.recalibrator
    other = camera_info_message(street[4])
    other.k = np.array([350.0, 0, 320, 0, 350, 96, 0, 0, 1])
    peer.info_pub.publish(other)
    peer.until(lambda: "intrinsics changed" in peer.last_error())
    assert peer.recalibrator is not recalibrator
    assert len(peer.recalibrator.keyframes) == 0
    now = peer.get_extrinsic()
    assert (now.success, now.last_good_known) == (False, True)  # kept: with other intrinsics it is to be tested again
    np.testing.assert_allclose(matrix(now.extrinsic), matrix(kept), atol=1e-9)
    assert peer.trigger("reset").success
    np.testing.assert_allclose(matrix(peer.get_extrinsic().extrinsic), off(drive.reference), atol=1e-9)
    peer.publish(street[5], frame_id="rear_lidar")
    assert "rear_lidar" in peer.last_error()
    assert len(peer.recalibrator.keyframes) == 0
