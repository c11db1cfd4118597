"""nuScenes by its JSON tables: a tree with the schema of the devkit, rendered from the synthetic street."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import sample_sources
from scenes import RenderedDrive
from scipy.spatial.transform import Rotation

from calib_ros import se3
from calib_ros.config import MotionConfig
from calib_ros.datasets import open_dataset
from calib_ros.datasets.nuscenes import NuScenesSource
from calib_ros.errors import BadInputError
from calib_ros.lidar.deskew import deskewed_points, moved
from calib_ros_synthetic.drive import SyntheticDrive

FRAMES, SPEED = 4, 3.0  # m/s: 11 cm between image and scan
T_EGO_LIDAR = se3.from_parts(Rotation.from_euler("z", -90, degrees=True).as_matrix(), [0.94, 0.0, 1.84])
TURNED = se3.from_parts(Rotation.from_euler("z", 90, degrees=True).as_matrix(), [0, 0, 0])  # nuScenes' LiDAR looks along y
LATE_US = 35_000  # from the image to the end of the scan, as for CAM_FRONT
SCAN_US = 50_000
FRONT, BACK, LIDAR = "CAM_FRONT", "CAM_BACK", "LIDAR_TOP"


@pytest.fixture(scope="module")
def drive() -> SyntheticDrive:
    return RenderedDrive(seed=1, frames=FRAMES, rings=32, width=640, height=192, speed=SPEED)


@pytest.fixture(scope="module")
def truth(drive: SyntheticDrive) -> np.ndarray:
    return drive.reference @ se3.inverse(TURNED)


@pytest.fixture(scope="module")
def template(drive: SyntheticDrive, truth: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scenes scene-0061, with all its files, and scene-0103, without any."""
    root = tmp_path_factory.mktemp("nuscenes")
    T_front = T_EGO_LIDAR @ se3.inverse(truth)
    T_back = se3.from_parts(Rotation.from_euler("z", 180, degrees=True).as_matrix(), [0, 0, 0]) @ T_front
    sensors = {FRONT: (T_front, drive.camera.K), BACK: (T_back, drive.camera.K), LIDAR: (T_EGO_LIDAR, None)}
    measured: list[sample_sources.Measured] = []
    for k in range(FRAMES):
        frame = drive[k]
        own, stamp = ("scene-0061", f"f{k}"), frame.stamp // 1000
        start = se3.from_parts(Rotation.from_euler("z", 20 * k, degrees=True).as_matrix(), [100.0 * k, 50, 0])

        def ego(at_us: int, start=start, stamp=stamp, twist=frame.twist) -> np.ndarray:
            T_global_lidar = start @ se3.exp(twist * (at_us - stamp) * 1e-6) @ se3.inverse(TURNED)
            return T_global_lidar @ se3.inverse(T_EGO_LIDAR)

        points = moved(deskewed_points(frame, MotionConfig()), frame.twist, np.full(len(frame.cloud), -LATE_US * 1e-6))
        rows = np.c_[se3.transform(TURNED, points), frame.cloud.intensity, frame.cloud.ring]
        measured += [(*own, channel, stamp, ego(stamp), True, frame.image) for channel in (FRONT, BACK)]
        # Of the sweeps only the poses are needed.
        scans = {stamp + LATE_US + gap: rows if gap == 0 else None for gap in (0, -SCAN_US, SCAN_US)}
        measured += [(*own, LIDAR, at, ego(at), content is not None, content) for at, content in scans.items()]
    measured += [("scene-0103", "g", channel, 5, np.eye(4), True, None) for channel in (FRONT, LIDAR)]
    sample_sources.nuscenes(root, sensors, measured)
    edit(root, "sensor", lambda rows: [{"token": "sr", "channel": "RADAR_FRONT", "modality": "radar"}, *rows])
    edit(root, "sample_data", lambda rows: rows[::-1])
    return root


@pytest.fixture
def tree(template: Path, tmp_path: Path) -> Path:
    """A copy of the tables that a test may change, with links to the files."""
    (tmp_path / "v1.0-mini").mkdir()
    for table in (template / "v1.0-mini").iterdir():
        (tmp_path / "v1.0-mini" / table.name).write_bytes(table.read_bytes())
    for file in (template / "samples").rglob("*.*"):
        target = tmp_path / file.relative_to(template)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.symlink_to(file)
    return tmp_path


def edit(tree: Path, table: str, change) -> None:
    path = tree / "v1.0-mini" / f"{table}.json"
    rows = json.loads(path.read_text())
    path.write_text(json.dumps(change(rows)))


def test_key_frames_of_the_first_scene(template, drive, truth):
    source = open_dataset(template)
    assert isinstance(source, NuScenesSource)
    assert (source.name, len(source), source.camera_frame, source.lidar_frame) == ("scene-0061", FRAMES, FRONT, LIDAR)
    assert np.abs(source.reference - truth).max() < 1e-9
    assert np.array_equal(source.camera.K, drive.camera.K)
    frame = source[2]
    assert np.array_equal(frame.image, drive[2].image)
    assert (frame.stamp, frame.cloud_stamp) == (drive[2].stamp // 1000 * 1000, drive[2].stamp // 1000 * 1000 + LATE_US * 1000)
    assert np.array_equal(frame.cloud.ring, drive[2].cloud.ring)
    assert np.array_equal(frame.cloud.intensity, drive[2].cloud.intensity)
    assert frame.cloud.time is None
    facts = source.describe()
    assert facts["cameras"] == "CAM_BACK, CAM_FRONT (chosen)"
    assert facts["scene"] == "scene-0061; others, as PATH#NAME: scene-0103"


def test_points_move_from_the_scans_stamp_to_the_images(template, drive):
    """The scan is compensated to its own stamp, 35 ms and 11 cm after the image."""
    frame = open_dataset(template)[1]
    wanted = se3.transform(TURNED, deskewed_points(drive[1], MotionConfig()))
    found = deskewed_points(frame, MotionConfig())
    assert np.abs(frame.cloud.xyz - wanted).max() > 0.1
    assert np.abs(found - wanted).max() < 1e-3
    R = TURNED[:3, :3]
    assert np.allclose(frame.twist, np.concatenate([R @ drive[1].twist[:3], R @ drive[1].twist[3:]]), atol=1e-4)


def test_a_camera_a_scene_and_a_version_are_chosen(template, tree, truth):
    for camera in (BACK, 0, "0"):
        source = open_dataset(template, camera)
        assert source.camera_frame == BACK
        assert se3.rotation_error_deg(truth, source.reference) == pytest.approx(180)
    assert open_dataset(f"{template}#scene-0061").describe() == open_dataset(template / "v1.0-mini").describe()
    (tree / "v1.0-test").mkdir()
    (tree / "v1.0-test/sample_data.json").write_text("[]")
    with pytest.raises(BadInputError, match=r"holds v1\.0-mini, v1\.0-test; give one of them"):
        open_dataset(tree)
    assert len(open_dataset(f"{tree}/v1.0-mini#scene-0061")) == FRAMES


def test_frames_without_files_are_left_out_and_a_lone_scan_has_no_velocity(tree):
    next(iter(sorted((tree / "samples" / LIDAR).iterdir()))).unlink()
    source = open_dataset(tree)
    assert source.describe()["frames"] == f"{FRAMES - 1} key frames; left out: 1 whose files are missing"
    with pytest.raises(BadInputError, match="scene-0103 has 1 key frames of CAM_FRONT, but none has its files"):
        open_dataset(f"{tree}#scene-0103")
    edit(tree, "sample_data", lambda rows: [row for row in rows if row["is_key_frame"]])
    assert open_dataset(tree)[0].twist is None


@pytest.mark.parametrize(
    ("scene", "camera", "message"),
    [
        ("#scene-0999", None, "no scene scene-0999; it has scene-0061, scene-0103"),
        ("", "CAM_SIDE", "no camera CAM_SIDE; choose one of 0 CAM_BACK, 1 CAM_FRONT"),
        ("", 2, "no camera 2; choose one of 0 CAM_BACK"),
        ("", "RADAR_FRONT", "no camera RADAR_FRONT"),
    ],
)
def test_unknown_scenes_and_cameras(template, scene, camera, message):
    with pytest.raises(BadInputError, match=message):
        open_dataset(f"{template}{scene}", camera)


@pytest.mark.parametrize("table", ["scene", "sample", "sample_data", "calibrated_sensor", "ego_pose", "sensor"])
@pytest.mark.parametrize("content", ["[{", '[{"token": "a", "scene_token": "scene-0061", "sensor_token": "sLIDAR_TOP"}]', None])
def test_damaged_tables_are_one_clear_error(tree, table, content):
    path = tree / "v1.0-mini" / f"{table}.json"
    path.unlink()
    if content is not None:
        path.write_text(content)
    with pytest.raises(BadInputError) as raised:
        open_dataset(tree)[0]
    assert "\n" not in str(raised.value)
    assert ";" in str(raised.value)


@pytest.mark.parametrize("value", [None, [1, 2], ["a", 0, 0, 1], [0, 0, 0, 0], [float("nan"), 0, 0, 1]])
def test_an_unusable_pose_is_one_clear_error(tree, value):
    edit(tree, "calibrated_sensor", lambda rows: [{**row, "rotation": value} for row in rows])
    with pytest.raises(BadInputError, match="the values of row cCAM_FRONT are unusable"):
        open_dataset(tree)
