"""The LiDAR's velocity: from consecutive scans, and from KITTI's oxts."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import GROUND, Spinner

from calib_ros import se3
from calib_ros.cli.calibrate import calibrate, replay
from calib_ros.config import Config, MotionConfig, SemanticsConfig
from calib_ros.datasets import open_dataset
from calib_ros.datasets.kitti_files import NOMINAL_LEVER_ARM, ScanMotion, image_moment, lidar_twist
from calib_ros.datasets.source import WithMotion
from calib_ros.errors import BadInputError, BadTimesError, MissingDependencyError
from calib_ros.frame import NANOSECONDS, Frame, PointCloud
from calib_ros.lidar.ego_motion import estimate_motion, unknown_motion_s, without_motion
from calib_ros.online.events import Inputs, Problem
from calib_ros.online.keyframes import EgoMotion
from calib_ros.online.pipeline import Pipeline
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.registration.calibrator import Calibrator
from calib_ros.result import CONVERGED, Result
from calib_ros_synthetic.drive import SyntheticDrive

AUTO, ALWAYS = MotionConfig(), MotionConfig(from_scans="always")
SPEED = 10.0


@pytest.fixture(scope="module")
def drive() -> SyntheticDrive:
    """Every turn of the scanner is a frame."""
    return SyntheticDrive(seed=3, frames=5, rings=32, speed=SPEED, stride=1, width=160, height=48)


class Bare:
    """A source that does not know its twists; `change` is applied to every frame. damaged: position that cannot be read."""

    def __init__(self, source, change=lambda frame: frame, damaged=None):
        self.source, self.change, self.damaged, self.reads = source, change, damaged, 0
        for name in ("name", "camera", "reference", "camera_frame", "lidar_frame", "describe"):
            setattr(self, name, getattr(source, name))

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, index: int) -> Frame:
        self.reads += 1
        if index % len(self) == self.damaged:
            raise BadInputError("damaged")
        return self.change(replace(self.source[index], twist=None))


def untimed(frame: Frame) -> Frame:
    return replace(frame, cloud=replace(frame.cloud, time=None))


@pytest.fixture
def without_library(monkeypatch):
    monkeypatch.setitem(sys.modules, "small_gicp", None)


def test_which_frames_want_an_estimate(drive):
    frame = replace(drive[0], twist=None)
    assert not without_motion(frame, AUTO)
    assert without_motion(drive[0], AUTO)
    assert all(without_motion(frame, MotionConfig(**off)) for off in ({"deskew": "off"}, {"from_scans": "never"}))
    assert without_motion(replace(frame, compensated=True), ALWAYS)
    assert without_motion(replace(frame, cloud_stamp=None), ALWAYS)
    assert without_motion(untimed(frame), AUTO)
    assert not without_motion(untimed(frame), ALWAYS)


class TestEstimate:
    @pytest.fixture(autouse=True)
    def _library(self):
        pytest.importorskip("small_gicp")

    def test_velocity_of_a_known_drive(self, drive):
        """By times and by azimuth, from a right and a wrong start, with lost returns, and backwards in time."""
        mean = 0.5 * (drive[1].twist + drive[2].twist)
        lost = drive[2].cloud.xyz.copy()
        lost[::9], lost[1::9] = np.nan, 0
        with_lost = replace(drive[2], cloud=replace(drive[2].cloud, xyz=lost))
        for before, now, start in (
            (drive[1], drive[2], None),
            (untimed(drive[1]), untimed(drive[2]), None),
            (drive[1], drive[2], mean),
            (drive[1], drive[2], [0, 0, 3.0, -40, 20, 5]),
            (drive[1], with_lost, None),
        ):
            motion = estimate_motion(before.cloud, now.cloud, 0.1, AUTO, start)
            assert motion.twist[3:] == pytest.approx(mean[3:], abs=0.02 * SPEED)
            assert motion.twist[:3] == pytest.approx(mean[:3], abs=0.03)
            assert (motion.reason, motion.speed) == ("", pytest.approx(SPEED, rel=0.05))
        backwards = estimate_motion(drive[2].cloud, drive[1].cloud, 0.1, MotionConfig(spin="none"))
        assert backwards.twist[3] == pytest.approx(-SPEED, rel=0.05)

    def test_scans_that_tell_no_motion_say_why(self, drive, monkeypatch):
        a, b = drive[1].cloud, drive[2].cloud
        places = [SyntheticDrive(seed=seed, frames=1, rings=64, width=160, height=48)[0].cloud for seed in (2, 7)]
        field, rng = Spinner(rings=64, step=0.2).scan([GROUND]), np.random.default_rng(0)
        flat = [replace(field, xyz=field.xyz + rng.normal(0, 0.01, field.xyz.shape).astype(np.float32)) for _ in range(2)]
        few = [a.select(np.arange(n)) for n in (0, 1, 50)]
        late = [replace(b, time=b.time + np.float32(by)) for by in (np.nan, 7.0)]
        for pair, gap, says in (
            (places, 0.1, "of the points match"),
            (flat, 0.1, "slide along each other"),
            *((pair, 0.1, "300 are needed") for own in few for pair in ((own, b), (b, own))),
            *(((a, own), 0.1, "s away from their scan's stamp") for own in late),
            *(((a, b), gap, "s apart, outside 0.01 to 0.35 s") for gap in (0.0, -0.1, 0.5, 1e9, np.nan)),
        ):
            motion = estimate_motion(*pair, gap, AUTO)
            assert motion.twist is None
            assert says in motion.reason
        monkeypatch.setattr("calib_ros.lidar.ego_motion.MAX_SPEED", 9.0)
        assert "beyond 9" in estimate_motion(a, b, 0.1, AUTO).reason

    # ---- offline

    def test_neighbours_of_a_source(self, drive, monkeypatch):
        monkeypatch.setattr("calib_ros.datasets.source.ROAD_SPEED", 0.5 * SPEED)
        source, said = Bare(drive), list[str]()
        moving = WithMotion(source, AUTO, said.append)
        frames = [moving[i] for i in range(len(moving))]
        assert source.reads < 2 * len(drive) + 2
        assert [f"{SPEED:.0f} m/s from frame 0 to 1 cannot be" in line for line in said] == [True]
        for i, frame in enumerate(frames):
            assert frame.twist[3:] == pytest.approx(drive[i].twist[3:], abs=0.03 * SPEED)
            assert np.array_equal(frame.cloud.xyz, drive[i].cloud.xyz)
        assert np.allclose(moving[-1].twist, frames[-1].twist, atol=0.02)
        assert len(moving) == len(drive)
        assert (moving.name, moving.describe()) == (drive.name, drive.describe())
        with pytest.raises(IndexError):
            moving[len(drive)]
        moving = WithMotion(Bare(drive, damaged=2), AUTO)
        assert moving[1].twist is not None  # from the other side
        with pytest.raises(BadInputError, match="damaged"):
            moving[2]

    def test_calibrate_and_replay_commands(self, drive, monkeypatch):
        calibrated: list[Frame] = []

        def record(self, frames, *args):
            calibrated.extend(frames)
            return Result(drive.reference, CONVERGED, "", 1.0)

        monkeypatch.setattr(Calibrator, "calibrate", record)
        calibrate(Bare(drive), "0:4:3", "reference", 0.0, Config(), None, None, None)
        assert [f.twist[3] for f in calibrated] == pytest.approx([SPEED] * 2, rel=0.03)
        # Frames left out: their clouds are read all the same.
        features = []
        offer = Recalibrator.ingest
        monkeypatch.setattr(Recalibrator, "ingest", lambda self, f: (offer(self, f), features.append(self.newest()))[0])
        list(replay(Bare(drive), "0,3", "reference", 0.0, Config()))
        assert features[0].twist[3] == pytest.approx(SPEED, rel=0.03)

    # ---- online

    def test_keyframes_get_the_velocity_since_the_cloud_before(self, drive):
        bare = Bare(drive)
        recalibrator = Recalibrator(drive.camera, drive.reference)
        recalibrator.ingest(bare[0])
        assert recalibrator.newest().twist is None
        recalibrator.selector.reset()
        assert recalibrator.ingest(bare[1])
        assert recalibrator.newest().twist[3] == pytest.approx(SPEED, rel=0.03)
        assert not recalibrator.ingest(bare[1])  # the same once more: no keyframe, no estimate, and gap 0 next
        recalibrator.selector.reset()
        assert recalibrator.ingest(drive[2])
        assert np.array_equal(recalibrator.newest().twist, drive[2].twist)

    def test_keyframes_of_unknown_motion_are_left_out_while_the_vehicle_moves(self, drive):
        bare = Bare(drive)
        recalibrator = Recalibrator(drive.camera, drive.reference)
        for frame in (bare[0], bare[1]):
            recalibrator.selector.reset()
            assert recalibrator.ingest(frame)
        assert [f.stamp for f in recalibrator.keyframes.features] == [bare[1].stamp]  # the first one's motion was not known yet

        def later(seconds):
            shift = round(seconds * NANOSECONDS)
            return replace(bare[2], stamp=bare[2].stamp + shift, cloud_stamp=bare[2].cloud_stamp + shift)

        recalibrator.selector.reset()
        with pytest.raises(BadTimesError, match=r"moved at .* m/s and .* deg/s 1\.\d s ago, and its motion now is unknown"):
            recalibrator.ingest(later(1.0))
        assert (recalibrator.keyframes.seen, recalibrator.motion.left_out) == (2, 1)
        assert recalibrator.ingest(later(9.0))  # nobody knows whether it still moves
        assert recalibrator.newest().unknown_motion_s > 0

    def test_an_unknown_motion_counts_for_as_long_as_points_are_measured_beside_the_image(self, drive):
        frame = Bare(drive)[0]
        at_once = unknown_motion_s(frame, drive.reference, AUTO)
        assert 0.002 < at_once < 0.02  # half the sweep of the view
        apart = replace(frame, stamp=frame.stamp + round(0.05 * NANOSECONDS))
        assert unknown_motion_s(apart, drive.reference, AUTO) == pytest.approx(0.05, abs=0.01)
        behind = drive.reference @ se3.exp([0, 0, np.pi, 0, 0, 0])  # a view that scans begin and end in
        assert unknown_motion_s(frame, behind, AUTO) > 0.04
        assert unknown_motion_s(drive[0], drive.reference, AUTO) == 0  # known
        assert unknown_motion_s(replace(frame, compensated=True), drive.reference, AUTO) == 0

    def test_clouds_that_tell_nothing(self, drive):
        bare, motion = Bare(drive), EgoMotion(AUTO)
        for frame in (replace(bare[0], compensated=True), bare[1], replace(bare[2], cloud_stamp=None), bare[3]):
            motion.add(frame)
            assert motion.with_twist(frame) is frame
        assert motion.last is None
        motion.add(bare[1])  # time went back
        assert motion.with_twist(bare[1]).twist is None
        assert "s apart" in motion.last.reason


def test_without_the_library(drive, without_library, capsys):
    with pytest.raises(MissingDependencyError, match="pip install small_gicp"):
        estimate_motion(drive[1].cloud, drive[2].cloud, 0.1, AUTO)
    said: list[str] = []
    moving = WithMotion(Bare(drive), AUTO, said.append)
    assert [moving[i].twist for i in range(3)] == [None] * 3
    assert ["not corrected for the vehicle's motion" in line for line in said] == [True]
    assert WithMotion(Bare(drive), AUTO)[1].twist is None
    motion = EgoMotion(AUTO)
    for i in range(2):
        motion.add(Bare(drive)[i])
        assert motion.with_twist(Bare(drive)[i]).twist is None
    assert "pip install small_gicp" in motion.missing
    list(replay(Bare(drive), "0:3:2", "reference", 0.0, Config()))
    assert "pip install small_gicp" in capsys.readouterr().err


def test_clouds_between_the_pairs_tell_the_motion_of_a_slow_camera(drive):
    start = Result(drive.reference, "initial")
    inputs = Inputs(
        lambda image, cloud, camera: image, lambda *_: ("camera", "lidar"), lambda *_: start, lambda frame: frame.cloud
    )
    pipeline = Pipeline(Config(semantics=SemanticsConfig(segmentation="none")), inputs, lambda event: None)
    pipeline.set_camera(drive.camera)
    bare = Bare(drive)
    for k in range(5):  # every fourth scan has an image
        pipeline.add(False, bare[k].cloud_stamp, bare[k])
        if k in (0, 4):
            pipeline.add(True, bare[k].stamp, bare[k])
        assert pipeline.wait_idle(60)
    assert pipeline.recalibrator.keyframes.seen == 2
    assert pipeline.recalibrator.newest().twist[3] == pytest.approx(SPEED, rel=0.03)
    assert pipeline.stop()


def test_pipeline_reports_it_once(drive, without_library):
    events: list[object] = []
    start = Result(drive.reference, "initial", "")
    inputs = Inputs(lambda image, cloud, camera: cloud, lambda *_: ("c", "l"), lambda *_: start)
    pipeline = Pipeline(
        Config.from_dict({"online": {"mode": "manual"}, "semantics": {"segmentation": "none"}}), inputs, events.append
    )
    pipeline.set_camera(drive.camera)
    bare = Bare(drive)
    for i in range(4):
        if pipeline.recalibrator is not None:
            pipeline.recalibrator.selector.reset()
        pipeline.add(True, drive[i].stamp, None)
        pipeline.add(False, drive[i].stamp, bare[i])
        assert pipeline.wait_idle(10)
    pipeline.stop()
    assert pipeline.recalibrator.keyframes.seen == 4
    assert len([e for e in events if isinstance(e, Problem) and "small_gicp" in e.message]) == 1


# ---- KITTI -------------------------------------------------------------------------------------------------------------


def oxts_line(velocity=(0, 0, 0), rates=(0, 0, 0), roll=0.0, pitch=0.0) -> str:
    values = np.arange(30.0) + 100  # whatever is read by mistake stands out
    values[3:6], values[8:11], values[17:20] = (roll, pitch, 1.0), velocity, rates
    return " ".join(f"{v:.12f}" for v in values) + "\n"


@pytest.fixture
def drive_folder(tmp_path: Path) -> Path:
    """Frames 0 and 1 with oxts; frame 2 without."""
    (tmp_path / "oxts/data").mkdir(parents=True)
    (tmp_path / "velodyne_points").mkdir()
    for number, velocity in enumerate([(8, 1, 0.5), (4, 0, 0)]):
        (tmp_path / f"oxts/data/{number:010d}.txt").write_text(oxts_line(velocity, (0.01, 0.02, 0.3)))
    return tmp_path


def test_oxts_velocity_uses_rotation_and_lever_arm(drive_folder):
    """Against two poses of the LiDAR a moment apart; without calibration the axes are aligned."""
    oxts = ScanMotion(drive_folder, drive_folder)
    twist = oxts.twist(0)
    assert twist[:3] == pytest.approx([0.01, 0.02, 0.3])
    assert twist[3:] == pytest.approx(np.add([8, 1, 0.5], np.cross(NOMINAL_LEVER_ARM, twist[:3])))
    assert oxts.twist(2) is None
    R = se3.rotation_from_euler(0.3, -0.1, 0.05)
    T_velo_imu = se3.from_parts(R, [-0.8, 0.3, -0.9])
    rows = "calib_time: x\nR: " + " ".join(f"{v:.12e}" for v in R.ravel()) + "\nT: -0.8 0.3 -0.9\n"
    (drive_folder / "calib_imu_to_velo.txt").write_text(rows)
    twist = ScanMotion(drive_folder, drive_folder).twist(0)
    dt = 1e-3
    T_imu = se3.exp(np.array([0.01, 0.02, 0.3, 8, 1, 0.5]) * dt)  # of the IMU after dt in its frame before
    T_velo = T_velo_imu @ T_imu @ se3.inverse(T_velo_imu)
    assert twist == pytest.approx(se3.log(T_velo) / dt, abs=1e-6)


def test_oxts_velocity_is_level_and_the_lidar_is_not():
    identity = np.eye(4)
    up_hill = lidar_twist(np.array(oxts_line((10, 0, 0), pitch=-0.1).split(), float), identity)  # negative: front up
    assert up_hill[3:] == pytest.approx([10 * np.cos(0.1), 0, -10 * np.sin(0.1)])
    left_up = lidar_twist(np.array(oxts_line((0, 0, 1), roll=0.1).split(), float), identity)
    assert left_up[3:] == pytest.approx([0, np.sin(0.1), np.cos(0.1)])


def test_damaged_oxts(drive_folder):
    for text in ("", "1 2 3", oxts_line()[:-30], oxts_line().replace("100.", "x."), oxts_line() + "1", "nan " * 30):
        (drive_folder / "oxts/data/0000000001.txt").write_text(text)
        with pytest.raises(BadInputError, match=r"0000000001.txt must have 30 numbers"):
            ScanMotion(drive_folder, drive_folder / "none").twist(1)


def test_times_of_a_kitti_scan_and_its_image(drive_folder):
    for image, shown in ((110_500_000, 104_000_000), (99_000_000, 99_000_000), (200_000_000, 200_000_000)):
        assert image_moment(image, 100_000_000) == (shown, 100_000_000)
    folder = drive_folder / "velodyne_points"
    cloud = PointCloud(np.array([[5, 0, 0], [0, 5, 0], [0, -5, 1], [-5, -1e-3, 0]], np.float32))
    motion = ScanMotion(drive_folder, drive_folder)
    assert motion.has_oxts
    assert not ScanMotion(folder, folder).has_oxts
    assert motion.times(cloud, 0) == pytest.approx([0, -0.025825, 0.025825, 0.05165], abs=1e-5)  # clockwise
    (folder / "timestamps_start.txt").write_text("2011-09-26 13:04:32.000\n2011-09-26 13:04:33.000\n")
    (folder / "timestamps_end.txt").write_text("2011-09-26 13:04:32.120\n2011-09-26 13:05:33.000\n")
    motion = ScanMotion(drive_folder, drive_folder)
    assert motion.times(cloud, 0) == pytest.approx([0, -0.03, 0.03, 0.06], abs=2e-5)
    assert motion.period_s(1) == pytest.approx(0.1033)  # a minute is no turn


@pytest.mark.kitti
class TestRealDrive:
    @pytest.fixture
    def source(self, kitti_root):
        return open_dataset(kitti_root / "raw/2011_09_26/2011_09_26_drive_0005_sync")

    def test_motion_of_a_frame(self, source):
        frame = source[5]
        assert frame.twist == pytest.approx([-0.01, -0.015, 0.125, 3.335, 0.153, 0.05], abs=1e-3)
        assert frame.cloud.time.min() == pytest.approx(-0.0517, abs=2e-4)
        assert frame.cloud.time.max() == pytest.approx(0.0517, abs=2e-4)
        assert not frame.compensated
        assert source.describe()["motion"] == "from oxts"

    def test_scans_agree_with_oxts(self, source):
        """oxts is 5 % faster here than scans, a second apart or consecutive, and 10 % faster than its own positions."""
        pytest.importorskip("small_gicp")
        moving = WithMotion(Bare(source), AUTO)
        for i in (3, 9, 14):
            found, oxts = moving[i].twist, source[i].twist
            assert found[3] == pytest.approx(oxts[3], rel=0.12)
            assert found[2] == pytest.approx(oxts[2], abs=0.015)
        assert moving[20].twist is None  # its neighbours are a second away
