"""Changes at run time: parameters, clocks, TF, vehicle speed; and what /diagnostics reports."""

from __future__ import annotations

import dataclasses
import json
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TwistStamped
from rcl_interfaces.srv import DescribeParameters
from rclpy.parameter import Parameter
from ros_peer import LATCHED, Peer, camera_info_message, start_parameters
from rosgraph_msgs.msg import Clock
from scenes import RenderedDrive
from sensor_msgs.msg import Image, Imu
from tf2_msgs.msg import TFMessage
from vehicle import QUICK

from calib_ros import se3
from calib_ros.config import STAGES, SearchConfig
from calib_ros.errors import ConfigError, MissingDependencyError
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.result import BLINDED, CONVERGED, INSUFFICIENT, MOVED, REFUSED, SUSPECT, Extrinsic, Result
from calib_ros.ros import parameters
from calib_ros.ros.client import result_from_message
from calib_ros.ros.conversions import time_message, transform_message
from calib_ros.ros.diagnostics import Diagnostics, Health
from calib_ros.ros.parameters import SETTINGS
from calib_ros_synthetic.drive import SyntheticDrive

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]


def start(T: np.ndarray) -> dict[str, Any]:
    return {**start_parameters(T), "initial_from_tf": False}


def values(peer: Peer) -> dict[str, str]:
    return {v.key: v.value for v in peer.diagnostics[-1].status[0].values} if peer.diagnostics else {}


def change(peer: Peer, **named: Any) -> None:
    answer = peer.node.set_parameters_atomically([Parameter(n.replace("__", "."), value=v) for n, v in named.items()])
    assert answer.successful, answer.reason


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


def test_misspelt_names_are_logged_once_at_the_start(capfd: pytest.CaptureFixture[str]) -> None:
    with Peer(serch__rotation_deg=5.0, use_sim_time=False, online__buffer_size=9):
        pass
    lines = [line for line in capfd.readouterr().err.splitlines() if "is unknown" in line]
    assert len(lines) == 1
    assert "did you mean 'search.rotation_deg'?" in lines[0]


def test_former_names_of_parameters_are_taken_over(capfd: pytest.CaptureFixture[str]) -> None:
    with Peer(tracker__drift_deg=0.2, tracker__drift_m=0.02) as peer:
        config = peer.calibration.parameters.config
        assert (config.tracker.process_noise_deg, config.tracker.process_noise_m) == (0.2, 0.02)
        assert peer.node.get_parameter("tracker.process_noise_deg").value == 0.2
        assert not peer.node.has_parameter("tracker.drift_deg")
    lines = [line for line in capfd.readouterr().err.splitlines() if "is now called" in line]
    assert len(lines) == 2
    assert any(
        "parameter 'tracker.drift_deg' is now called 'tracker.process_noise_deg'; its value is used" in line for line in lines
    )


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
    with Peer(initial_from_tf=False) as peer:
        names = list(SETTINGS) + [f"{stage}.{f.name}" for stage, cls in STAGES.items() for f in dataclasses.fields(cls)]
        client = peer.peer.create_client(DescribeParameters, "/calib_ros/describe_parameters")
        found = peer._call(client, DescribeParameters.Request(names=names)).descriptors
    assert [d.name for d in found] == names
    for d in found:
        value = SETTINGS[d.name].default if d.name in SETTINGS else None
        stage, _, field = d.name.partition(".")
        if value is None:
            value = next(f.default for f in dataclasses.fields(STAGES[stage]) if f.name == field)
        assert d.description
        ranged = bool(d.floating_point_range or d.integer_range or d.additional_constraints)
        free = isinstance(value, (bool, str))
        assert ranged or free or d.name.startswith("initial_"), d.name
        assert d.read_only == (d.name in SETTINGS and not SETTINGS[d.name].live)


def test_settings_take_effect_at_run_time(street: list[Frame], drive: SyntheticDrive, tmp_path: Path) -> None:
    with Peer(**start(drive.reference), **QUICK) as peer:
        for frame in street[:4]:
            peer.publish(frame)
        assert peer.get_extrinsic().extrinsic.status == "converged"
        got: list[TFMessage] = []
        peer.peer.create_subscription(TFMessage, "/tf_static", got.append, LATCHED)
        change(peer, publish_tf=True, tf_parent="lidar", overlay_period_s=0.07)
        peer.until(lambda: got, 5, "TF")
        assert got[-1].transforms[0].header.frame_id == "velodyne"
        assert peer.calibration.overlay.period_s == 0.07
        change(peer, tf_parent="camera")
        peer.until(lambda: got[-1].transforms[0].header.frame_id == "camera", 5)
        T = result_from_message(peer.get_extrinsic().extrinsic).T_camera_lidar
        assert got[-1].transforms[0].transform.translation.x == pytest.approx(T[0, 3], abs=1e-9)
        change(peer, publish_tf=False)
        peer.until(lambda: peer.peer.count_publishers("/tf_static") == 0, 5)

        # The state file is another one from the next accepted estimate on.
        state = tmp_path / "state.json"
        change(peer, state_file=str(state))
        peer.publish(street[4])
        assert json.loads(state.read_text())["status"] == "converged"

        # Rectified images: another camera, without a new CameraInfo.
        camera = peer.calibration.pipeline.camera
        message = camera_info_message(street[0])
        message.p[0] *= 1.05
        peer.info_pub.publish(message)
        change(peer, image_is_rectified=True)
        peer.until(lambda: peer.calibration.pipeline.camera != camera, 5)
        assert peer.calibration.pipeline.camera.K[0, 0] == pytest.approx(1.05 * camera.K[0, 0])
        change(peer, image_is_rectified=False)
        peer.until(lambda: peer.calibration.pipeline.camera == camera, 5)
        assert peer.get_extrinsic().last_good_known  # the extrinsic stays through both, to be tested again


def test_rapid_setting_changes_lose_nothing(street: list[Frame], drive: SyntheticDrive, monkeypatch: pytest.MonkeyPatch) -> None:
    """100 changes, each taken, while frames come in: all of them are paired, heavy things are made once per use at most."""
    made: list[object] = []
    # Models would use it as well, at any time.
    plain = {**QUICK, "online__buffer_size": 20, "online__mode": "manual", "semantics__segmentation": "none"}
    with Peer(**start(drive.reference), **plain) as peer:
        peer.publish(street[0])
        from calib_ros.online import recalibrator as module

        original = module.Calibrator

        def counted(*arguments: Any) -> Any:
            made.append(arguments)
            return original(*arguments)

        monkeypatch.setattr(module, "Calibrator", counted)
        publishers = list(peer.node.publishers)
        stop = threading.Event()

        def storm() -> None:
            for k in range(100):
                change(peer, search__rounds=5 + k, online__max_speed=20.0 + k % 7, publish_tf=bool(k % 2))
                change(peer, overlay_period_s=0.1 + 0.01 * k, reliability=("auto", "reliable")[k % 2], tf_parent="camera")
                time.sleep(0.02)
            stop.set()

        thread = threading.Thread(target=storm)
        thread.start()
        sent = 1
        while not stop.is_set():
            peer.publish(later(street[sent % 8], 10.0 * sent))
            sent += 1
        thread.join()
        counts = peer.calibration.pipeline.synchronizer.counts
        assert (counts.pairs, counts.unpaired_images, peer.calibration.pipeline.dropped_pairs) == (sent, 0, 0)
        config = peer.calibration.pipeline.recalibrator.config
        assert (config.search.rounds, config.online.max_speed) == (104, 20.0 + 99 % 7)
        assert len(made) <= sent + 1  # 100 changes of the stages, but only when a keyframe needs it
        assert len(peer.calibration.pipeline.recalibrator.buffer) == min(sent, 20)
        peer.until(lambda: peer.calibration.overlay.period_s == pytest.approx(1.09), 5)
        peer.until(lambda: len(list(peer.node.publishers)) == len(publishers) + 1, 5)  # publish_tf: true came last
        assert peer.calibration.health.errors == 0, peer.last_error()


# ---- clocks -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_simulated_clock_that_jumps(street: list[Frame], drive: SyntheticDrive) -> None:
    """A bag that loops with /clock: time runs, stands still, jumps forward and back; extrinsic and keyframes go on."""
    T = se3.perturb(drive.reference, [0.3, -0.2, 0.2], [0.02, 0, 0])
    twice = {**QUICK, "online__min_keyframes": 3, "online__mode": "periodic", "online__period_s": 2.0}  # a lap
    with Peer(**start(T), **twice, use_sim_time=True) as peer:
        clock = peer.peer.create_publisher(Clock, "/clock", 10)
        accepted, lap = 0, street[:5]
        for jump in (0.0, 0.0, 86400.0, -86400.0):
            for frame in lap:
                frame = later(frame, jump)
                clock.publish(Clock(clock=time_message(frame.stamp)))
                peer.publish(frame)
            recalibrator = peer.calibration.pipeline.recalibrator
            assert recalibrator.current.accepted > accepted, jump
            accepted = recalibrator.current.accepted
            assert recalibrator.tracker.settled
            answer = peer.get_extrinsic()
            assert answer.success
            assert answer.extrinsic.transform.header.stamp.sec == frame.stamp // NANOSECONDS
            assert se3.rotation_error_deg(drive.reference, result_from_message(answer.extrinsic).T_camera_lidar) < 0.3
        count = len(peer.diagnostics)
        peer.until(lambda: len(peer.diagnostics) >= count + 2, 5)  # though the clock stands still
        last = peer.diagnostics[-1].header.stamp
        assert (last.sec, last.nanosec) == divmod(later(lap[-1], -86400.0).stamp, NANOSECONDS)
        assert int(values(peer)["stamps jumped back"]) >= 2
        assert set(peer.calibration.health._logged) <= {
            "time stamps jumped back (a looping bag, or a clock was set back): messages that waited for a partner were dropped"
        }


def test_a_camera_that_is_stamped_late_is_found_with_the_mount() -> None:
    drive = RenderedDrive(
        seed=3, frames=14, width=640, height=240, rings=64, speed=8, stride=3, ride="weaving", image_late_ms=80.0
    )
    T = se3.perturb(drive.reference, [0.3, -0.2, 0.2], [0.02, 0, 0])
    keyframes = {
        "online__min_keyframes": 5,
        "online__buffer_size": 12,
        "online__keyframe_interval_s": 0.2,
        "online__mode": "manual",
    }
    with Peer(**start(T), **{**QUICK, **keyframes}) as peer:
        counts = peer.calibration.pipeline.synchronizer.counts
        for k in range(len(drive)):
            # The motion is that of the scans. A pair is final when the next messages have come.
            peer.publish(dataclasses.replace(drive[k], twist=None), settle=False)
            peer.until(lambda k=k: counts.images > k and counts.clouds > k)
            peer.settle()
        answer = peer.trigger("calibrate")
        assert answer.success, answer.message
        message = peer.get_extrinsic().extrinsic
        assert message.time_offset == pytest.approx(0.08, abs=0.005)
        assert 0 < message.time_offset_sigma < 0.01
        T = result_from_message(message).T_camera_lidar
        assert se3.rotation_error_deg(drive.reference, T) < 0.3
        assert se3.translation_error_m(drive.reference, T) < 0.05
        count = len(peer.diagnostics)
        peer.until(lambda: len(peer.diagnostics) > count + 1, 5)
        assert float(values(peer)["time offset, ms"].split()[0]) == pytest.approx(80, abs=5)
        pairing = peer.calibration.pipeline._pairing
        assert pairing.sweep.config.time_offset_s == pytest.approx(0.08, abs=0.005)


# ---- TF ---------------------------------------------------------------------------------------------------------------


def test_tf_that_comes_late_replaces_a_nominal_start(street: list[Frame], drive: SyntheticDrive) -> None:
    with Peer(online__mode="manual") as peer:
        peer.until(lambda: not peer.calibration.tf.lookup("camera", "velodyne")[1], 5)  # it has waited in vain
        peer.publish(street[0])
        assert "nominal" in peer.get_extrinsic().message
        publisher = peer.peer.create_publisher(TFMessage, "/tf_static", LATCHED)
        publisher.publish(TFMessage(transforms=[transform_message(drive.reference, "camera", "velodyne", 0)]))
        peer.until(lambda: peer.calibration.pipeline.recalibrator is None, 5)
        peer.publish(street[1])
        answer = peer.get_extrinsic()
        assert answer.message == "from TF"
        np.testing.assert_allclose(result_from_message(answer.extrinsic).T_camera_lidar, drive.reference, atol=1e-6)


def test_own_tf_does_not_restart_the_node(street: list[Frame]) -> None:
    with Peer(online__mode="manual", publish_tf=True) as peer:
        peer.until(lambda: not peer.calibration.tf.lookup("camera", "velodyne")[1], 5)
        peer.publish(street[0])
        recalibrator = peer.calibration.pipeline.recalibrator
        assert peer.latched(TFMessage, "/tf_static").transforms[0].child_frame_id == "velodyne"
        assert peer.calibration.tf.lookup("camera", "velodyne")[0] is None
        count = len(peer.diagnostics)
        peer.until(lambda: len(peer.diagnostics) >= count + 3, 10)
        assert peer.calibration.pipeline.recalibrator is recalibrator


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
            gate = peer.calibration.pipeline.speed_gate
            peer.until(lambda: gate.newest is not None and gate.newest.stamp == frame.stamp + NANOSECONDS // 20)
            peer.publish(frame)
            recalibrator = peer.calibration.pipeline.recalibrator
            return recalibrator.keyframes_seen

        assert drive_by(street[0], 3.0) == 1
        assert drive_by(street[1], 45.0) == 1
        assert drive_by(street[2], -45.0) == 1
        assert drive_by(street[3], 3.0) == 2
        peer.until(lambda: values(peer).get("frames too fast for a keyframe") == "2", 5)
        assert values(peer)["the newest of them"] == "45.0 deg/s are above online.max_turn_deg_s = 30"
        assert peer.calibration.pipeline.speed_gate.motion_at(street[3])[0] == (
            5.0 if source == "twist" else pytest.approx(3.0, abs=0.1)
        )


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


class Log:
    def info(self, text: str) -> None: ...

    def warning(self, text: str) -> None: ...


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
    from calib_ros.config import Config
    from calib_ros.online.events import Inputs
    from calib_ros.online.pipeline import Pipeline

    health = Health(Log())
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


def test_diagnostics_of_a_node_at_work(street: list[Frame], drive: SyntheticDrive) -> None:
    with Peer(**start(drive.reference), **QUICK) as peer:
        overlays: list[Image] = []
        peer.peer.create_subscription(Image, "/calib_ros/overlay", overlays.append, 5)
        for frame in street[:5]:
            peer.publish(frame)
        peer.image_pub.publish(Image())  # that no cloud belongs to
        peer.until(lambda: values(peer).get("images") == "6" and values(peer)["estimates accepted"] != "0", 5)
        said = values(peer)
        assert said["status"] == "converged"
        assert float(said["age of the last estimate, s"]) < 60
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
            patch.setattr(peer.calibration.pipeline.synchronizer, "add_image", broken)
            patch.setattr(peer.calibration.initial, "before_messages", broken)
            peer.image_pub.publish(Image())
            peer.until(lambda: peer.calibration.health.errors == 1)
            assert "unexpected ZeroDivisionError in test_run_time.py:" in peer.last_error()
            assert "please report it" in peer.get_extrinsic().message
        peer.publish(street[0])
        assert peer.get_extrinsic().message == "from the parameters"
