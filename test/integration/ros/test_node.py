"""The node over real DDS, in this process: messages in, extrinsic out."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calib_ros_msgs.msg import Extrinsic
from geometry_msgs.msg import TransformStamped
from ros_peer import LATCHED, Peer, camera_info_message, errors_to, start_parameters
from sensor_msgs.msg import Image
from tf2_msgs.msg import TFMessage
from vehicle import QUICK, is_right, off

from calib_ros import se3
from calib_ros.errors import CalibrationError
from calib_ros.frame import Frame, PointCloud
from calib_ros.messages import decode_image
from calib_ros.result import CONVERGED, Result
from calib_ros.ros.client import result_from_message
from calib_ros.ros.conversions import transform_message
from calib_ros_synthetic.drive import SyntheticDrive

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]


def test_from_messages_to_a_published_extrinsic(street: list[Frame], drive: SyntheticDrive, tmp_path: Path) -> None:
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


def test_dead_lidar_beside_a_parked_car_is_named(street: list[Frame], drive: SyntheticDrive) -> None:
    """The picture stays the same, so that no frame is a keyframe; the cloud is looked at all the same."""
    with Peer(**start_parameters(drive.reference)) as peer:
        peer.publish(street[0])
        for k in range(2):
            errors = peer.calibration.health.errors
            empty = PointCloud(np.full((500 * k, 3), np.nan, np.float32))
            peer.publish(dataclasses.replace(street[0], stamp=street[0].stamp + (k + 1) * 10**8, cloud_stamp=None, cloud=empty))
            assert peer.calibration.health.errors > errors  # from the second on a sensor is called blind, too
            assert "0 usable points" in peer.last_error()


def test_state_is_restored_and_refused_for_other_frames(street: list[Frame], drive: SyntheticDrive, tmp_path: Path) -> None:
    state = tmp_path / "state.json"
    T = se3.perturb(drive.reference, [0.1, 0, 0], [0.01, 0, 0])
    Result(T, CONVERGED, camera_frame="camera", lidar_frame="velodyne").save(state)
    with Peer(state_file=str(state)) as peer:
        early = peer.get_extrinsic()  # asked before any message: the saved one, not yet confirmed to be of these sensors
        assert not early.success
        assert errors_to(T, result_from_message(early.extrinsic).T_camera_lidar) == pytest.approx((0, 0), abs=1e-6)
        peer.publish(street[0])
        assert peer.calibration.health.errors == 0
        answer = peer.get_extrinsic()
        assert answer.success
        assert errors_to(T, result_from_message(answer.extrinsic).T_camera_lidar) == pytest.approx((0, 0), abs=1e-6)
    with Peer(state_file=str(state), lidar_frame="other_lidar") as peer:
        peer.publish(street[0])
        assert "other_lidar" in peer.last_error()
        assert peer.get_extrinsic().extrinsic.status == "initial"


def test_other_intrinsics_start_anew_and_other_sensors_are_turned_away(street: list[Frame], drive: SyntheticDrive) -> None:
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


@pytest.mark.parametrize("options", [{"drop": ("intensity",)}, {"drop": ("ring", "time")}, {"big": True}])
def test_clouds_that_lack_something_still_work(street: list[Frame], drive: SyntheticDrive, options: dict[str, Any]) -> None:
    """No intensity (said in the result), no ring field, big-endian: all calibrate."""
    with Peer(**start_parameters(off(drive.reference)), **QUICK) as peer:
        peer.drive(street[:4], **options)
        answer = peer.get_extrinsic()
    assert answer.extrinsic.status == "converged", answer.message
    assert is_right(drive.reference, answer.extrinsic)
    assert ("reflectivity edges are off" in answer.message) == ("intensity" in options.get("drop", ()))


def test_parameters_at_run_time(street: list[Frame]) -> None:
    with Peer(initial_from_tf=False) as peer:
        for name, value, text in (
            ("search__rotation_deg", -5.0, "search.rotation_deg"),
            ("search__rotation_deg", 70, "search.rotation_deg"),
            ("search__rotation_deg", "wide", "must be of type float"),
            ("refine__optimizer", "magic", "refine.optimizer"),
            ("camera_frame", "elsewhere", "camera_frame"),
            ("tf_parent", "map", "tf_child must name its child"),
        ):
            assert text in peer.set(**{name: value})
        assert peer.pipeline.config.search.rotation_deg == 3.0
        for value in (5.0, 7):
            peer.change(search__rotation_deg=value)
            assert peer.pipeline.config.search.rotation_deg == value
        peer.change(constraints__sigma_m=[0.1, 0.1, 0.2])
        assert peer.pipeline.config.constraints.sigma_m == (0.1, 0.1, 0.2)
        peer.publish(street[0])
        peer.change(online__buffer_size=7)
        assert peer.recalibrator.buffer.maxlen == 7


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"search__rotation_deg": -5.0}, "search.rotation_deg"),
        ({"search__rotation_deg": "wide"}, "search.rotation_deg"),
        ({"initial_quaternion_xyzw": [0.0, 1.0]}, "quaternion"),
        ({"initial_translation_m": [0.0], "initial_quaternion_xyzw": [0.0, 0.0, 0.0, 1.0]}, "initial_translation_m"),
        ({"image_transport": "theora"}, "image_transport"),
        ({"overlay_period_s": -1}, "overlay_period_s"),
        ({"overlay_period_s": "often"}, "overlay_period_s"),
        ({"search__rotation_deg": 99}, "search.rotation_deg"),
        ({"constraints__sigma_m": [1.0, 2.0]}, "constraints.sigma_m"),
    ],
)
def test_bad_parameters_at_the_start(parameters: dict[str, object], text: str) -> None:
    with pytest.raises(CalibrationError, match=text):
        Peer(**parameters)


def test_tf_gives_the_initial_extrinsic(street: list[Frame], drive: SyntheticDrive) -> None:
    T_base_camera = se3.from_parts(se3.rotation_from_euler(0.3, 0.2, 0.1), [1, 2, 3])
    T_base_lidar = T_base_camera @ drive.reference
    with Peer() as peer:
        edges = {"camera": T_base_camera, "velodyne": T_base_lidar}
        publisher = peer.peer.create_publisher(TFMessage, "/tf_static", LATCHED)
        publisher.publish(TFMessage(transforms=[transform_message(T, "base_link", name, 0) for name, T in edges.items()]))
        peer.until(lambda: peer.calibration.tf.lookup("camera", "velodyne")[0] is not None)
        peer.publish(street[0])
        T = result_from_message(peer.get_extrinsic().extrinsic).T_camera_lidar
        assert errors_to(drive.reference, T) == pytest.approx((0, 0), abs=1e-6)


@pytest.mark.parametrize("parent", ["camera", "lidar"])
def test_publish_tf_in_both_directions(street: list[Frame], drive: SyntheticDrive, parent: str) -> None:
    with Peer(**start_parameters(drive.reference), publish_tf=True, tf_parent=parent, initial_from_tf=False) as peer:
        peer.publish(street[0])
        item = peer.latched(TFMessage, "/tf_static").transforms[0]
        expected = drive.reference if parent == "camera" else se3.inverse(drive.reference)
        names = ("camera", "velodyne") if parent == "camera" else ("velodyne", "camera")
        assert (item.header.frame_id, item.child_frame_id) == names
        t = item.transform.translation
        np.testing.assert_allclose([t.x, t.y, t.z], expected[:3, 3], atol=1e-9)
