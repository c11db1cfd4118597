"""The node over real DDS, in this process: messages in, extrinsic out."""

from __future__ import annotations

import dataclasses
import json
import time
from pathlib import Path

import numpy as np
import pytest
from calib_ros_msgs.msg import Extrinsic
from geometry_msgs.msg import TransformStamped
from rclpy.parameter import Parameter
from ros_peer import LATCHED, Peer, camera_info_message, cloud_message, errors_to, start_parameters
from sensor_msgs.msg import CompressedImage, Image
from tf2_msgs.msg import TFMessage
from vehicle import QUICK

from calib_ros import se3
from calib_ros.errors import CalibrationError
from calib_ros.frame import NANOSECONDS, Frame, PointCloud
from calib_ros.messages import decode_image
from calib_ros.ros.client import result_from_message
from calib_ros.ros.conversions import image_message, transform_message
from calib_ros_synthetic.drive import SyntheticDrive

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]


def wrong(reference: np.ndarray) -> np.ndarray:
    return se3.perturb(reference, [1.2, -1.0, 0.8], [0.08, -0.05, 0.06])


def test_from_messages_to_a_published_extrinsic(street: list[Frame], drive: SyntheticDrive, tmp_path: Path) -> None:
    reference, start = drive.reference, wrong(drive.reference)
    state = tmp_path / "state.json"
    with Peer(**start_parameters(start), **QUICK, state_file=str(state)) as peer:
        before = peer.get_extrinsic()
        assert not before.success
        assert before.extrinsic.status == "initial"
        overlays: list[Image] = []
        peer.peer.create_subscription(Image, "/calib_ros/overlay", overlays.append, 5)
        for frame in street[:5]:
            peer.publish(frame)
        answer = peer.get_extrinsic()
        assert answer.success
        assert answer.extrinsic.status == "converged"
        assert (answer.extrinsic.transform.header.frame_id, answer.extrinsic.transform.child_frame_id) == ("camera", "velodyne")
        result = result_from_message(answer.extrinsic)
        deg, m = errors_to(reference, result.T_camera_lidar)
        assert deg < 0.3
        assert m < 0.08
        assert result.frames_used == len(peer.calibration.pipeline.recalibrator.buffer) >= 5
        # The covariance crosses the border into ROS's order and back unchanged.
        np.testing.assert_allclose(result.covariance, peer.calibration.pipeline.recalibrator.current.result.covariance)
        assert np.sqrt(answer.extrinsic.covariance[0]) == pytest.approx(0.018, abs=0.02)  # metres come first in ROS

        # Whoever joins late gets the latched extrinsic and transform.
        late = peer.latched(Extrinsic, "/calib_ros/extrinsic")
        assert late.score == pytest.approx(answer.extrinsic.score)
        transform = peer.latched(TransformStamped, "/calib_ros/transform")
        assert transform.transform.translation.x == pytest.approx(result.T_camera_lidar[0, 3], abs=1e-12)

        peer.until(lambda: overlays, what="an overlay")
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
        nothing = peer.trigger("calibrate")
        assert not nothing.success
        assert "keyframe" in nothing.message
        assert not peer.trigger("save").success
        for frame in street[:3]:
            peer.publish(frame)  # too few for an estimate of its own accord
        done = peer.trigger("calibrate")
        assert done.success, done.message
        assert "3 keyframes" in done.message
        assert peer.trigger("save").success


def test_dead_lidar_beside_a_parked_car_is_named(street: list[Frame], drive: SyntheticDrive) -> None:
    """The picture stays the same, so that no frame is a keyframe; the cloud is looked at all the same."""
    with Peer(**start_parameters(drive.reference)) as peer:
        peer.publish(street[0])
        for k, cloud in enumerate((PointCloud(np.zeros((0, 3), np.float32)), PointCloud(np.full((500, 3), np.nan, np.float32)))):
            errors = peer.calibration.health.errors
            peer.publish(dataclasses.replace(street[0], stamp=street[0].stamp + (k + 1) * 10**8, cloud_stamp=None, cloud=cloud))
            assert peer.calibration.health.errors > errors  # from the second on a sensor is called blind, too
            assert "0 usable points" in peer.last_error()


def test_state_is_restored_and_refused_for_other_frames(street: list[Frame], drive: SyntheticDrive, tmp_path: Path) -> None:
    state = tmp_path / "state.json"
    T = se3.perturb(drive.reference, [0.1, 0, 0], [0.01, 0, 0])
    state.write_text(
        json.dumps({"T_camera_lidar": T.tolist(), "camera_frame": "camera", "lidar_frame": "velodyne", "status": "converged"})
    )
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
    state.write_text("{ truncated")
    with Peer(state_file=str(state)) as peer:
        peer.publish(street[0])
        assert "neither valid JSON nor YAML" in peer.last_error()
        assert peer.get_extrinsic().extrinsic.status == "initial"


def good(frame: Frame) -> tuple[object, object, object]:
    return camera_info_message(frame), image_message(frame.image, "camera", frame.stamp), cloud_message(frame.cloud, frame.stamp)


def empty_cloud(frame: Frame) -> tuple[object, object, object]:
    info, image, _ = good(frame)
    return info, image, cloud_message(PointCloud(np.zeros((0, 3), np.float32)), frame.stamp)


def nan_cloud(frame: Frame) -> tuple[object, object, object]:
    info, image, _ = good(frame)
    return info, image, cloud_message(PointCloud(np.full((1000, 3), np.nan, np.float32)), frame.stamp)


def truncated_cloud(frame: Frame) -> tuple[object, object, object]:
    info, image, cloud = good(frame)
    cloud.data = cloud.data[:1000]
    return info, image, cloud


def unknown_encoding(frame: Frame) -> tuple[object, object, object]:
    info, image, cloud = good(frame)
    image.encoding = "32FC7"
    return info, image, cloud


def other_size(frame: Frame) -> tuple[object, object, object]:
    info, _, cloud = good(frame)
    return info, image_message(frame.image[:100], "camera", frame.stamp), cloud


def zero_k(frame: Frame) -> tuple[object, object, object]:
    info, image, cloud = good(frame)
    info.k = np.zeros(9)
    return info, image, cloud


def stamps_back(frame: Frame) -> tuple[object, object, object]:
    earlier = dataclasses.replace(frame, stamp=frame.stamp - 3600 * NANOSECONDS, cloud_stamp=None)
    return good(earlier)


BAD = [
    (empty_cloud, "the cloud has 0 usable points"),
    (nan_cloud, "the cloud has 0 usable points"),
    (truncated_cloud, "PointCloud2"),
    (unknown_encoding, "32FC7"),
    (other_size, "CameraInfo says"),
    (zero_k, "K is all zero"),
    (stamps_back, "jumped back"),
]


def test_bad_messages_leave_node_and_extrinsic_alone(
    street: list[Frame], drive: SyntheticDrive, capfd: pytest.CaptureFixture[str]
) -> None:
    with Peer(**start_parameters(wrong(drive.reference)), **QUICK) as peer:
        for frame in street[:5]:
            peer.publish(frame)
        kept = result_from_message(peer.get_extrinsic().extrinsic)
        assert kept.status == "converged"
        later = dataclasses.replace(street[6], stamp=street[5].stamp, cloud_stamp=None)
        for make, text in BAD:
            later = dataclasses.replace(later, stamp=later.stamp + 2 * NANOSECONDS)
            errors = peer.calibration.health.errors
            for publisher, message in zip((peer.info_pub, peer.image_pub, peer.cloud_pub), make(later), strict=True):
                publisher.publish(message)
            peer.until(lambda n=errors: peer.calibration.health.errors > n, what=make.__name__)
            peer.settle()
            assert text in peer.last_error(), make.__name__
            assert "\n" not in peer.last_error()
            now = peer.get_extrinsic()
            assert now.last_good_known
            assert now.success == now.extrinsic.usable
            # After a bad CameraInfo the last good one stays, so that its image and cloud still count.
            latest = result_from_message(now.extrinsic)
            deg, m = errors_to(kept.T_camera_lidar, latest.T_camera_lidar)
            kept = latest
            assert (deg, m) == pytest.approx((0, 0), abs=1e-6) or make is zero_k
            assert deg < 0.1
            assert m < 0.02
        # Healthy again without a restart.
        fresh = dataclasses.replace(street[7], stamp=later.stamp + 10 * NANOSECONDS, cloud_stamp=None)
        keyframes = peer.calibration.pipeline.recalibrator.keyframes_seen
        peer.publish(fresh)
        assert peer.calibration.pipeline.recalibrator.keyframes_seen == keyframes + 1
    logged = capfd.readouterr()
    assert "Traceback" not in logged.err + logged.out


def test_other_intrinsics_start_anew_and_other_sensors_are_turned_away(street: list[Frame], drive: SyntheticDrive) -> None:
    with Peer(**start_parameters(wrong(drive.reference)), **QUICK) as peer:
        for frame in street[:4]:
            peer.publish(frame)
        kept = result_from_message(peer.get_extrinsic().extrinsic)
        assert kept.status == "converged"
        recalibrator = peer.calibration.pipeline.recalibrator
        other = camera_info_message(street[4])
        other.k = np.array([350.0, 0, 320, 0, 350, 96, 0, 0, 1])
        peer.info_pub.publish(other)
        peer.until(lambda: "intrinsics changed" in peer.last_error())
        assert peer.calibration.pipeline.recalibrator is not recalibrator
        assert len(peer.calibration.pipeline.recalibrator.buffer) == 0
        now = peer.get_extrinsic()
        assert not now.success  # with other intrinsics it is another calibration: kept, to be tested again
        assert now.last_good_known
        np.testing.assert_allclose(result_from_message(now.extrinsic).T_camera_lidar, kept.T_camera_lidar, atol=1e-9)
        assert peer.trigger("reset").success
        back = result_from_message(peer.get_extrinsic().extrinsic)
        np.testing.assert_allclose(back.T_camera_lidar, wrong(drive.reference), atol=1e-9)
        peer.publish(street[5], frame_id="rear_lidar")
        assert "rear_lidar" in peer.last_error()
        assert len(peer.calibration.pipeline.recalibrator.buffer) == 0


def test_clouds_that_lack_something_still_work(street: list[Frame], drive: SyntheticDrive) -> None:
    """No intensity (said in the result), no ring field, big-endian: all calibrate."""
    T = wrong(drive.reference)
    variants = ({"drop": ("intensity",)}, {"drop": ("ring", "time")}, {"big": True})
    for options in variants:
        with Peer(**start_parameters(T), **QUICK) as peer:
            for frame in street[:4]:
                peer.publish(frame, **options)
            answer = peer.get_extrinsic()
            assert answer.extrinsic.status == "converged", (options, answer.message)
            deg, m = errors_to(drive.reference, result_from_message(answer.extrinsic).T_camera_lidar)
            assert deg < 0.4, options
            assert m < 0.12, options
            assert ("reflectivity edges are off" in answer.message) == ("intensity" in options.get("drop", ()))


def test_unsynchronised_topics_are_named(street: list[Frame]) -> None:
    with Peer() as peer:
        frame = street[0]
        peer.info_pub.publish(camera_info_message(frame))
        for k in range(60):
            stamp = frame.stamp + k * NANOSECONDS // 10
            peer.image_pub.publish(image_message(frame.image[:8], "camera", stamp))
            peer.cloud_pub.publish(cloud_message(frame.cloud.select(np.arange(10)), stamp + 400 * NANOSECONDS))
            if "synchronise the clocks" in peer.last_error():
                break
            peer.until(lambda n=k: peer.calibration.pipeline.synchronizer.counts.clouds > n)
            time.sleep(0.1)
        peer.until(lambda: "synchronise the clocks" in peer.last_error(), 8)
        peer.until(lambda: any("synchronise" in d.status[0].message for d in peer.diagnostics), 5)


def test_parameters_at_run_time(street: list[Frame]) -> None:
    with Peer(initial_from_tf=False) as peer:
        refused = peer.node.set_parameters([Parameter("search.rotation_deg", value=-5.0)])[0]
        assert not refused.successful
        assert "search.rotation_deg" in refused.reason
        assert not peer.node.set_parameters([Parameter("refine.optimizer", value="magic")])[0].successful
        assert not peer.node.set_parameters([Parameter("camera_frame", value="elsewhere")])[0].successful
        assert peer.calibration.pipeline.config.search.rotation_deg == 3.0
        assert peer.node.set_parameters([Parameter("search.rotation_deg", value=5.0)])[0].successful
        assert peer.calibration.pipeline.config.search.rotation_deg == 5.0
        assert peer.node.set_parameters([Parameter("search.rotation_deg", value=7)])[0].successful
        assert peer.calibration.pipeline.config.search.rotation_deg == 7.0
        wrong_type = peer.node.set_parameters([Parameter("search.rotation_deg", value="wide")])[0]
        assert not wrong_type.successful
        assert "must be of type float" in wrong_type.reason
        assert not peer.node.set_parameters([Parameter("search.rotation_deg", value=70)])[0].successful
        assert peer.node.set_parameters([Parameter("constraints.sigma_m", value=[0.1, 0.1, 0.2])])[0].successful
        assert peer.calibration.pipeline.config.constraints.sigma_m == (0.1, 0.1, 0.2)
        peer.publish(street[0])
        assert peer.node.set_parameters([Parameter("online.buffer_size", value=7)])[0].successful
        assert peer.calibration.pipeline.recalibrator.buffer.maxlen == 7


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
        publisher = peer.peer.create_publisher(TFMessage, "/tf_static", LATCHED)
        publisher.publish(
            TFMessage(
                transforms=[
                    transform_message(T_base_camera, "base_link", "camera", 0),
                    transform_message(T_base_lidar, "base_link", "velodyne", 0),
                ]
            )
        )
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


def test_compressed_images(street: list[Frame], drive: SyntheticDrive) -> None:
    import cv2

    with Peer(CompressedImage, image_transport="compressed", **start_parameters(drive.reference)) as peer:
        frame = street[0]
        peer.info_pub.publish(camera_info_message(frame))
        peer.until(lambda: peer.calibration.pipeline.camera is not None)
        message = CompressedImage(format="jpeg", data=cv2.imencode(".jpg", frame.image)[1].tobytes())
        message.header = image_message(frame.image, "camera", frame.stamp).header
        peer.image_pub.publish(message)
        peer.cloud_pub.publish(cloud_message(frame.cloud, frame.stamp))
        peer.until(
            lambda: (
                peer.calibration.pipeline.recalibrator is not None and peer.calibration.pipeline.recalibrator.keyframes_seen == 1
            )
        )


def test_diagnostics_report_rates_and_load(street: list[Frame]) -> None:
    with Peer(initial_from_tf=False) as peer:
        peer.publish(street[0])
        message = peer.until(lambda: next((d for d in peer.diagnostics if dict_of(d)["keyframes so far"] == "1"), None), 5)
        values = dict_of(message)
        assert values["pairs"] == "1"
        assert float(values["callback 99th percentile, ms"]) < 1000
        assert values["errors"] == "0"


def dict_of(message: object) -> dict[str, str]:
    return {v.key: v.value for v in message.status[0].values}
