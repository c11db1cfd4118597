"""The node over real DDS, in this process: messages in, extrinsic out."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from calib_ros_msgs.msg import Extrinsic
from geometry_msgs.msg import TransformStamped
from ros_peer import Peer, camera_info_message, errors_to, start_parameters
from sensor_msgs.msg import Image
from vehicle import QUICK, is_right, off

from calib_ros.frame import PointCloud
from calib_ros.messages import decode_image
from calib_ros.ros.client import result_from_message

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]


def test_from_messages_to_a_published_extrinsic(street, drive, tmp_path):
    reference, start = drive.reference, off(drive.reference)
    state = tmp_path / "state.json"
    with Peer(**start_parameters(start), **QUICK, state_file=str(state)) as peer:
        before = peer.get_extrinsic()
        assert not before.success
        assert before.extrinsic.status == "initial"
        overlays = peer.listen(Image, "/calib_ros/overlay", 5)
        peer.drive(street[:5])
        answer = peer.get_extrinsic()
        assert answer.success
        assert answer.extrinsic.status == "converged"
        assert (answer.extrinsic.transform.header.frame_id, answer.extrinsic.transform.child_frame_id) == ("camera", "velodyne")
        result = result_from_message(answer.extrinsic)
        deg, m = errors_to(reference, result.T_camera_lidar)
        assert deg < 0.3
        assert m < 0.08
        assert result.frames_used == len(peer.recalibrator.buffer) >= 5
        # The covariance crosses the border into ROS's order and back unchanged.
        np.testing.assert_allclose(result.covariance, peer.recalibrator.current.result.covariance)
        assert np.sqrt(answer.extrinsic.covariance[0]) == pytest.approx(0.018, abs=0.02)  # metres come first in ROS

        # Whoever joins late gets the latched extrinsic and transform.
        late = peer.latched(Extrinsic, "/calib_ros/extrinsic")
        assert late.score == pytest.approx(answer.extrinsic.score)
        transform = peer.latched(TransformStamped, "/calib_ros/transform")
        assert transform.transform.translation.x == pytest.approx(result.T_camera_lidar[0, 3], abs=1e-12)

        peer.until(lambda: overlays, "an overlay")
        picture = decode_image(overlays[-1])
        assert picture.shape[1] >= street[0].image.shape[1]
        assert picture.std() > 10
        saved = json.loads(state.read_text())
        np.testing.assert_allclose(saved["T_camera_lidar"], result.T_camera_lidar, atol=1e-9)
        first = peer.extrinsics[0]
        assert first.status == "initial"
        np.testing.assert_allclose(result_from_message(first).T_camera_lidar, start, atol=1e-9)

        # Reset goes back to the start, calibrate answers when its estimate is done.
        assert peer.trigger("reset").success
        assert errors_to(start, result_from_message(peer.get_extrinsic().extrinsic).T_camera_lidar)[0] < 1e-6
        assert "keyframe" in peer.refusal("calibrate")
        assert peer.refusal("save")
        peer.drive(street[:3])  # too few for an estimate of its own accord
        done = peer.trigger("calibrate")
        assert done.success, done.message
        assert "3 keyframes" in done.message
        assert peer.trigger("save").success


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
            assert peer.calibration.health.errors > errors  # from the second on a sensor is called blind, too
            assert "0 usable points" in peer.last_error()


def test_other_intrinsics_start_anew_and_other_sensors_are_turned_away(street, drive):
    with Peer(**start_parameters(off(drive.reference)), **QUICK) as peer:
        peer.drive(street[:4])
        kept = result_from_message(peer.get_extrinsic().extrinsic)
        assert kept.status == "converged"
        recalibrator = peer.recalibrator
        other = camera_info_message(street[4])
        other.k = np.array([350.0, 0, 320, 0, 350, 96, 0, 0, 1])
        peer.info_pub.publish(other)
        peer.until(lambda: "intrinsics changed" in peer.last_error())
        assert peer.recalibrator is not recalibrator
        assert len(peer.recalibrator.buffer) == 0
        now = peer.get_extrinsic()
        assert not now.success  # with other intrinsics it is another calibration: kept, to be tested again
        assert now.last_good_known
        np.testing.assert_allclose(result_from_message(now.extrinsic).T_camera_lidar, kept.T_camera_lidar, atol=1e-9)
        assert peer.trigger("reset").success
        back = result_from_message(peer.get_extrinsic().extrinsic)
        np.testing.assert_allclose(back.T_camera_lidar, off(drive.reference), atol=1e-9)
        peer.publish(street[5], frame_id="rear_lidar")
        assert "rear_lidar" in peer.last_error()
        assert len(peer.recalibrator.buffer) == 0


@pytest.mark.parametrize("options", [{"drop": ("intensity",)}, {"drop": ("ring", "time"), "big": True}])
def test_clouds_that_lack_something_still_work(street, drive, options):
    """No intensity (said in the result); no ring and time, big-endian: all calibrate."""
    with Peer(**start_parameters(off(drive.reference)), **QUICK) as peer:
        peer.drive(street[:4], **options)
        answer = peer.get_extrinsic()
    assert answer.extrinsic.status == "converged", answer.message
    assert is_right(drive.reference, answer.extrinsic)
    assert ("reflectivity edges are off" in answer.message) == ("intensity" in options.get("drop", ()))
