"""What other nodes rely on: usable or not, at a steady rate, and said when the data or the node end."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from paths import ROOT, module_at
from rclpy.executors import SingleThreadedExecutor
from rclpy.time import Time
from ros_peer import Peer, start_parameters
from vehicle import QUICK, Vehicle, off

from calib_ros.frame import NANOSECONDS
from calib_ros.result import CONVERGED, Result
from calib_ros.ros.client import result_from_message

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]
PERIOD_S, AGE_S = 0.1, 0.5  # AGE_S: of data that are too old, in the test of it
FAST = {**QUICK, "publish_period_s": PERIOD_S, "initial_from_tf": False}


def seconds(duration: Any) -> float:
    return float(duration.sec + duration.nanosec / NANOSECONDS)


def test_an_extrinsic_is_usable_only_while_data_come(street, drive):
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


def test_a_restored_extrinsic_is_used_when_keyframes_confirm_it(street, drive, tmp_path):
    """And not for other frames."""
    state = tmp_path / "state.json"
    with Peer(**start_parameters(off(drive.reference)), **FAST, state_file=str(state)) as peer:
        peer.drive(street[:5])
        saved = peer.get_extrinsic().extrinsic
        T = result_from_message(saved).T_camera_lidar
    assert json.loads(state.read_text())["provenance"]["sensor_stamp_ns"] == Time.from_msg(saved.estimated_at).nanoseconds
    with Peer(**FAST, state_file=str(state), online__mode="manual") as peer:
        early = peer.get_extrinsic()  # asked before any message: not yet confirmed to be of these sensors
        assert not early.success
        np.testing.assert_allclose(result_from_message(early.extrinsic).T_camera_lidar, T, atol=1e-9)
        peer.publish(street[0])
        assert peer.calibration.health.errors == 0
        first = peer.until(lambda: peer.extrinsics and peer.extrinsics[0], "the restored extrinsic")
        assert (first.status, first.usable, first.estimated_at) == ("initial", False, saved.estimated_at)
        np.testing.assert_allclose(result_from_message(first).T_camera_lidar, T, atol=1e-9)
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
