"""Changes at run time: parameters, clocks, TF, vehicle speed; and what /diagnostics reports."""

from __future__ import annotations

import dataclasses
import json
import logging
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TwistStamped
from rcl_interfaces.srv import DescribeParameters
from ros_peer import LATCHED, Peer, camera_info_message, cloud_message, start_parameters
from scenes import RenderedDrive
from sensor_msgs.msg import Image, Imu
from tf2_msgs.msg import TFMessage
from vehicle import QUICK

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.config import Config, SearchConfig, stages
from calib_ros.errors import ConfigError, MissingDependencyError
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.intrinsics import IntrinsicEstimate, RefinedCamera
from calib_ros.online import recalibrator as recalibrator_module
from calib_ros.online.events import Inputs
from calib_ros.online.pipeline import Pipeline
from calib_ros.result import BLINDED, CONVERGED, INSUFFICIENT, MOVED, REFUSED, SUSPECT, Extrinsic, Result
from calib_ros.ros import parameters
from calib_ros.ros.client import result_from_message
from calib_ros.ros.conversions import image_message, time_message, transform_message
from calib_ros.ros.diagnostics import Diagnostics, Health, refined_values
from calib_ros.ros.parameters import LIVE, SETTINGS
from calib_ros_synthetic.drive import SyntheticDrive

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]


def start(T: np.ndarray) -> dict[str, Any]:
    return {**start_parameters(T), "initial_from_tf": False}


def later(frame: Frame, by: float) -> Frame:
    return dataclasses.replace(frame, stamp=frame.stamp + round(by * NANOSECONDS), cloud_stamp=None)


# ---- parameters -------------------------------------------------------------------------------------------------------


def test_misspelt_names_are_answered_with_the_nearest() -> None:
    declared = ["search.rotation_deg", "online.buffer_size", "publish_tf", "use_sim_time"]
    given = [
        *("serch.rotation_deg", "online.bufer_size", "publish_tf", "use_sim_time", "zzz", "start_type_description_service"),
        "qos_overrides./image.subscription.depth",
    ]
    assert parameters.misspelt(dict.fromkeys(given, 1), declared) == [
        "parameter 'online.bufer_size' is unknown and has no effect; did you mean 'online.buffer_size'?",
        "parameter 'serch.rotation_deg' is unknown and has no effect; did you mean 'search.rotation_deg'?",
        "parameter 'zzz' is unknown and has no effect; config/calib_ros.yaml lists all there are",
    ]


def test_misspelt_and_former_names_are_logged_once_at_the_start(capfd: pytest.CaptureFixture[str]) -> None:
    """The value of a former name is taken over."""
    former = {"tracker__drift_deg": 0.2, "tracker__drift_m": 0.02}
    with Peer(serch__rotation_deg=5.0, use_sim_time=False, online__buffer_size=9, **former) as peer:
        config = peer.calibration.parameters.config
        assert (config.tracker.process_noise_deg, config.tracker.process_noise_m) == (0.2, 0.02)
        assert peer.node.get_parameter("tracker.process_noise_deg").value == 0.2
        assert not peer.node.has_parameter("tracker.drift_deg")
    lines = capfd.readouterr().err.splitlines()
    assert ["did you mean 'search.rotation_deg'?" in line for line in lines if "is unknown" in line] == [True]
    renamed = [line for line in lines if "is now called" in line]
    assert len(renamed) == 2
    assert any("'tracker.drift_deg' is now called 'tracker.process_noise_deg'; its value is used" in line for line in renamed)


def test_removed_parameters_are_told_in_one_line_and_ignored(capfd: pytest.CaptureFixture[str]) -> None:
    with Peer(search__distinct=20, lidar__jump_min=0.3, score__sigma=[16.0, 8.0, 4.0, 2.0, 1.2]) as peer:
        assert peer.calibration.parameters.config.search.starts == SearchConfig().starts
        assert not peer.node.has_parameter("search.distinct")
    (line,) = [line for line in capfd.readouterr().err.splitlines() if "no effect" in line]
    assert "lidar.jump_min" in line
    assert "score.sigma" in line
    assert "have no effect any more; remove them" in line
    (changed,) = parameters.misspelt({"search.distinct": 80}, [])
    assert changed == "search.distinct has no effect any more, 20 is used; remove it"


def test_a_parameter_under_both_names_is_refused() -> None:
    with (
        pytest.raises(ConfigError, match=r"tracker.drift_deg is the former name of tracker.process_noise_deg; give only"),
        Peer(tracker__drift_deg=0.2, tracker__process_noise_deg=0.2),
    ):
        pass


def test_every_parameter_describes_its_meaning_and_range() -> None:
    defaults = {name: setting.default for name, setting in SETTINGS.items()}
    defaults |= {f"{stage}.{f.name}": f.default for stage, cls in stages().items() for f in dataclasses.fields(cls)}
    with Peer(initial_from_tf=False) as peer:
        client = peer.peer.create_client(DescribeParameters, "/calib_ros/describe_parameters")
        found = peer.call(client, DescribeParameters.Request(names=list(defaults))).descriptors
    assert [d.name for d in found] == list(defaults)
    for d in found:
        assert d.description
        ranged = d.floating_point_range or d.integer_range or d.additional_constraints
        assert ranged or isinstance(defaults[d.name], (bool, str)) or d.name.startswith("initial_"), d.name
        assert d.read_only == (d.name in SETTINGS and d.name not in LIVE)


def test_settings_take_effect_at_run_time(street: list[Frame], drive: SyntheticDrive, tmp_path: Path) -> None:
    with Peer(**start(drive.reference), **QUICK) as peer:
        peer.drive(street[:4])
        assert peer.get_extrinsic().extrinsic.status == "converged"
        got = peer.listen(TFMessage, "/tf_static")
        peer.change(publish_tf=True, tf_parent="lidar", overlay_period_s=0.07)
        peer.until(lambda: got, "TF")
        assert got[-1].transforms[0].header.frame_id == "velodyne"
        assert peer.calibration.overlay.period_s == 0.07
        peer.change(tf_parent="camera")
        peer.until(lambda: got[-1].transforms[0].header.frame_id == "camera")
        T = result_from_message(peer.get_extrinsic().extrinsic).T_camera_lidar
        assert got[-1].transforms[0].transform.translation.x == pytest.approx(T[0, 3], abs=1e-9)
        peer.change(publish_tf=False)
        peer.until(lambda: peer.peer.count_publishers("/tf_static") == 0)

        # The state file is another one from the next accepted estimate on.
        state = tmp_path / "state.json"
        peer.change(state_file=str(state))
        peer.publish(street[4])
        assert json.loads(state.read_text())["status"] == "converged"

        # Rectified images: another camera, without a new CameraInfo.
        camera = peer.pipeline.camera
        message = camera_info_message(street[0])
        message.p[0] *= 1.05
        peer.info_pub.publish(message)
        peer.change(image_is_rectified=True)
        peer.until(lambda: peer.pipeline.camera != camera)
        assert peer.pipeline.camera.K[0, 0] == pytest.approx(1.05 * camera.K[0, 0])
        peer.change(image_is_rectified=False)
        peer.until(lambda: peer.pipeline.camera == camera)
        assert peer.get_extrinsic().last_good_known  # the extrinsic stays through both, to be tested again


def test_rapid_setting_changes_lose_nothing(street: list[Frame], drive: SyntheticDrive, monkeypatch: pytest.MonkeyPatch) -> None:
    """100 changes, each taken, while frames come in: all of them are paired, heavy things are made once per use at most."""
    made: list[object] = []
    plain = {**QUICK, "online__buffer_size": 20, "online__mode": "manual"}
    with Peer(**start(drive.reference), **plain) as peer:
        peer.publish(street[0])
        original = recalibrator_module.Calibrator
        monkeypatch.setattr(recalibrator_module, "Calibrator", lambda *given: made.append(given) or original(*given))
        publishers = list(peer.node.publishers)
        stop = threading.Event()

        def storm() -> None:
            for k in range(100):
                peer.change(search__rounds=5 + k, online__max_speed=20.0 + k % 7, publish_tf=bool(k % 2))
                peer.change(overlay_period_s=0.1 + 0.01 * k, reliability=("auto", "reliable")[k % 2], tf_parent="camera")
                time.sleep(0.02)
            stop.set()

        thread = threading.Thread(target=storm)
        thread.start()
        sent = 1
        while not stop.is_set():
            peer.publish(later(street[sent % 8], 10.0 * sent))
            sent += 1
        thread.join()
        counts = peer.pipeline.synchronizer.counts
        assert (counts.pairs, counts.unpaired_images, peer.pipeline.dropped_pairs) == (sent, 0, 0)
        config = peer.recalibrator.config
        assert (config.search.rounds, config.online.max_speed) == (104, 20.0 + 99 % 7)
        assert len(made) <= sent + 1  # 100 changes of the stages, but only when a keyframe needs it
        assert len(peer.recalibrator.buffer) == min(sent, 20)
        peer.until(lambda: peer.calibration.overlay.period_s == pytest.approx(1.09))
        peer.until(lambda: len(list(peer.node.publishers)) == len(publishers) + 1)  # publish_tf: true came last
        assert peer.calibration.health.errors == 0, peer.last_error()


# ---- clocks -----------------------------------------------------------------------------------------------------------


def test_a_camera_that_is_stamped_late_is_found_with_the_mount() -> None:
    drive = RenderedDrive(
        seed=3, frames=11, width=640, height=240, rings=32, speed=8, stride=3, ride="weaving", image_late_ms=80.0
    )
    T = se3.perturb(drive.reference, [0.3, -0.2, 0.2], [0.02, 0, 0])
    keyframes = {"min_keyframes": 5, "buffer_size": 12, "similarity_threshold": 1.0, "mode": "manual"}
    with Peer(**start(T), **{**QUICK, **{f"online__{name}": value for name, value in keyframes.items()}}) as peer:
        for k in range(len(drive)):
            # The motion is that of the scans. A pair is final when the next messages have come.
            frame = dataclasses.replace(drive[k], twist=None)
            peer.publish_camera(frame)
            cloud = cloud_message(frame.cloud, frame.cloud_stamp or frame.stamp)
            peer.send(image_message(frame.image, "camera", frame.stamp), cloud)
        answer = peer.trigger("calibrate")
        assert answer.success, answer.message
        message = peer.get_extrinsic().extrinsic
        assert message.time_offset == pytest.approx(0.08, abs=0.005)
        assert 0 < message.time_offset_sigma < 0.01
        T = result_from_message(message).T_camera_lidar
        assert se3.rotation_error_deg(drive.reference, T) < 0.3
        assert se3.translation_error_m(drive.reference, T) < 0.05
        assert float(peer.new_values()["time offset, ms"].split()[0]) == pytest.approx(80, abs=5)
        pairing = peer.pipeline._pairing
        assert pairing.sweep.config.time_offset_s == pytest.approx(0.08, abs=0.005)


# ---- TF ---------------------------------------------------------------------------------------------------------------


def test_tf_that_comes_late_replaces_a_nominal_start(street: list[Frame], drive: SyntheticDrive) -> None:
    with Peer(online__mode="manual") as peer:
        peer.until(lambda: not peer.calibration.tf.lookup("camera", "velodyne")[1])  # it has waited in vain
        peer.publish(street[0])
        assert "nominal" in peer.get_extrinsic().message
        publisher = peer.peer.create_publisher(TFMessage, "/tf_static", LATCHED)
        publisher.publish(TFMessage(transforms=[transform_message(drive.reference, "camera", "velodyne", 0)]))
        peer.until(lambda: peer.recalibrator is None)
        peer.publish(street[1])
        answer = peer.get_extrinsic()
        assert answer.message == "from TF"
        np.testing.assert_allclose(result_from_message(answer.extrinsic).T_camera_lidar, drive.reference, atol=1e-6)


def test_own_tf_does_not_restart_the_node(street: list[Frame]) -> None:
    with Peer(online__mode="manual", publish_tf=True) as peer:
        peer.until(lambda: not peer.calibration.tf.lookup("camera", "velodyne")[1])
        peer.publish(street[0])
        recalibrator = peer.recalibrator
        assert peer.latched(TFMessage, "/tf_static").transforms[0].child_frame_id == "velodyne"
        assert peer.calibration.tf.lookup("camera", "velodyne")[0] is None
        peer.new_values()
        assert peer.recalibrator is recalibrator


# ---- the vehicle's speed ----------------------------------------------------------------------------------------------


def twist_message(stamp: int, speed: float, turn_deg: float) -> TwistStamped:
    message = TwistStamped()
    message.header.stamp = time_message(stamp)
    message.twist.linear.x, message.twist.angular.z = speed, float(np.deg2rad(turn_deg))
    return message


def imu_message(stamp: int, speed: float, turn_deg: float) -> Imu:
    message = Imu()
    message.header.stamp = time_message(stamp)
    message.angular_velocity.y = float(np.deg2rad(turn_deg))
    return message


@pytest.mark.parametrize(("source", "make"), [("twist", twist_message), ("imu", imu_message)])
def test_no_keyframe_in_a_sharp_turn(street: list[Frame], drive: SyntheticDrive, source: str, make: Any) -> None:
    with Peer(**start(drive.reference), online__mode="manual", motion_source=source) as peer:
        publisher = peer.peer.create_publisher(TwistStamped if source == "twist" else Imu, source, 10)
        peer.until(publisher.get_subscription_count)

        def drive_by(frame: Frame, turn_deg: float) -> int:
            publisher.publish(make(frame.stamp + NANOSECONDS // 20, 5.0, turn_deg))
            gate = peer.pipeline.speed_gate
            peer.until(lambda: gate.newest is not None and gate.newest.stamp == frame.stamp + NANOSECONDS // 20)
            peer.publish(frame)
            recalibrator = peer.recalibrator
            return recalibrator.keyframes_seen

        assert drive_by(street[0], 3.0) == 1
        assert drive_by(street[1], 45.0) == 1
        assert drive_by(street[2], -45.0) == 1
        assert drive_by(street[3], 3.0) == 2
        peer.until(lambda: peer.values.get("frames too fast for a keyframe") == "2")
        assert peer.values["the newest of them"] == "45.0 deg/s are above online.max_turn_deg_s = 30"
        assert peer.pipeline.speed_gate.motion_at(street[3])[0] == (5.0 if source == "twist" else pytest.approx(3.0, abs=0.1))


def test_odometry_without_its_messages_is_named() -> None:
    try:
        import nav_msgs.msg  # noqa: F401
    except ImportError:
        with pytest.raises(MissingDependencyError, match="motion_source: odom needs nav_msgs; install it"):
            Peer(motion_source="odom")
    else:
        with Peer(motion_source="odom") as peer:
            assert peer.peer.count_subscribers("/odom") == 1


def test_without_a_source_nothing_is_subscribed() -> None:
    with Peer() as peer:
        assert [peer.peer.count_subscribers(f"/{name}") for name in ("odom", "imu", "twist")] == [0, 0, 0]


# ---- /diagnostics -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("status", "level", "text"),
    [
        (CONVERGED, DiagnosticStatus.OK, "converged"),
        (REFUSED, DiagnosticStatus.WARN, "refused: because"),
        (INSUFFICIENT, DiagnosticStatus.WARN, "insufficient: because"),
        (SUSPECT, DiagnosticStatus.WARN, "suspect: because"),
        (MOVED, DiagnosticStatus.ERROR, "moved: because"),
        (BLINDED, DiagnosticStatus.ERROR, "blinded: check the hardware: a sensor shows nothing: because"),
    ],
)
def test_every_status_has_its_level(status: str, level: bytes, text: str) -> None:
    health = Health(logging.getLogger())
    pipeline = Pipeline(Config(), Inputs(*3 * [lambda *_: None]), lambda event: None)
    try:
        diagnostics = Diagnostics("/calib_ros", health, pipeline)
        assert diagnostics.message(time_message(0)).status[0].message == "collecting keyframes"
        covariance = np.diag([1e-6, 4e-6, 1e-6, 1e-4, 1e-4, 9e-4])
        result = Result(np.eye(4), status, "" if status == CONVERGED else "because", 0.9, covariance)
        health.add_extrinsic(Extrinsic(result, 1.25, 7, "fits" if status == CONVERGED else "does not fit", 0.031))
        found = diagnostics.message(time_message(0), {"more": "yes"}).status[0]
    finally:
        assert pipeline.stop()
    assert (found.level, found.message) == (level, text)
    said = {v.key: v.value for v in found.values}
    assert (said["status"], said["drift"], said["estimates accepted"], said["more"]) == (status, "1.25", "7", "yes")
    assert said["sigma of rotation, deg"] == f"{np.rad2deg(2e-3):.3f}"
    assert said["sigma of translation, m"] == "0.0300"
    assert (said["monitor p-value"], said["monitor"]) == ("0.031", "fits" if status == CONVERGED else "does not fit")


def test_refined_intrinsics_are_told_in_numbers() -> None:
    camera = Camera(np.array([[714.0, 0, 630.25], [0, 714, 370], [0, 0, 1]]), 1280, 720, D=np.array([-0.31, 0.1, 0, 0, 0]))
    changes = {
        "focal_length_share": IntrinsicEstimate(0.02, 0.001, True),
        "principal_point_x_px": IntrinsicEstimate(-3.0, 1.5, True),
        "k1": IntrinsicEstimate(0.0, 0.004, False),
    }
    assert refined_values(RefinedCamera(camera, np.eye(4), changes, np.eye(9))) == {
        "refined focal length, px": "714.0 +- 0.7",
        "refined principal point x, px": "630.2 +- 1.5",
        "refined principal point y, px": "unknown",
        "refined k1": "-0.3100 +- 0.0040, as stated",
    }
    assert set(refined_values(None).values()) == {"unknown"}


def test_diagnostics_of_a_node_at_work(street: list[Frame], drive: SyntheticDrive) -> None:
    with Peer(**start(drive.reference), **QUICK) as peer:
        peer.drive(street[:5])
        peer.image_pub.publish(Image())  # that no cloud belongs to
        peer.until(lambda: peer.values.get("images") == "6" and peer.values["estimates accepted"] != "0")
        said = peer.values
        assert said["status"] == "converged"
        assert (said["clouds"], said["pairs"], said["keyframes so far"]) == ("5", "5", "5")
        assert float(said["age of the last estimate, s"]) >= 0
        assert 0 < float(said["sigma of rotation, deg"]) < 1
        assert 0 < float(said["sigma of translation, m"]) < 0.3
        assert float(said["callback 99th percentile, ms"]) > 0
        assert said["motion from scans"].startswith("failed: the scans are 1 s apart")
        assert said["frames too fast for a keyframe"] == "0"


def test_exception_in_a_callback_ends_neither_node_nor_service(
    street: list[Frame], drive: SyntheticDrive, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Peer(**start(drive.reference), online__mode="manual") as peer:

        def broken(*_: Any) -> Any:
            raise ZeroDivisionError("by hand")

        with monkeypatch.context() as patch:
            patch.setattr(peer.pipeline.synchronizer, "add_image", broken)
            patch.setattr(peer.calibration.initial, "before_messages", broken)
            peer.image_pub.publish(Image())
            peer.until(lambda: peer.calibration.health.errors == 1)
            assert "unexpected ZeroDivisionError in test_run_time.py:" in peer.last_error()
            assert "please report it" in peer.get_extrinsic().message
        peer.publish(street[0])
        assert peer.get_extrinsic().message == "from the parameters"
