"""KITTI's three layouts, from tiny trees of random data and, where present, from real frames."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from calib_ros.datasets import open_dataset
from calib_ros.datasets.kitti import KittiSource
from calib_ros.errors import BadInputError
from calib_ros.frame import Frame

WIDTH, HEIGHT = 40, 24  # of all pictures
K = np.array([[30.0, 0, 20], [0, 30, 12], [0, 0, 1]])
OFFSETS = {0: (0, 0, 0), 1: (-0.54, 0, 0), 2: (0.06, 0.01, 0.003), 3: (-0.47, 0, 0)}
TR_ROTATION = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
TR_TRANSLATION = np.array([0.1, -0.2, -0.3])
TILT = np.array([[1.0, 0, 0], [0, np.cos(0.02), -np.sin(0.02)], [0, np.sin(0.02), np.cos(0.02)]])


def projection(camera: int) -> np.ndarray:
    return np.c_[K, K @ OFFSETS[camera]]


def expected_extrinsic(camera: int, tilt: np.ndarray = TILT) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = tilt @ TR_ROTATION
    T[:3, 3] = tilt @ TR_TRANSLATION + OFFSETS[camera]
    return T


def line(key: str, values: np.ndarray) -> str:
    return f"{key}: " + " ".join(f"{v:.12e}" for v in np.ravel(values)) + "\n"


def write_image(path: Path, number: int, grey: bool = False, size: tuple[int, int] = (HEIGHT, WIDTH)) -> np.ndarray:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = np.random.default_rng(number).integers(0, 256, size if grey else (*size, 3), np.uint8)
    assert cv2.imwrite(str(path), image)
    return image


def write_scan(path: Path, number: int) -> np.ndarray:
    path.parent.mkdir(parents=True, exist_ok=True)
    points = np.random.default_rng(1000 + number).normal(size=(50, 4)).astype("<f4")
    points.tofile(path)
    return points


def date_lines(count: int, offset_ns: int = 0, blank: tuple[int, ...] = ()) -> str:
    stamps = [np.datetime64("2011-09-26T13:04:59.900000000") + i * 103_000_001 + offset_ns for i in range(count)]
    return "".join("\n" if i in blank else str(stamp).replace("T", " ") + "\n" for i, stamp in enumerate(stamps))


def stamp_of(number: int, offset_ns: int = 0) -> int:
    return 1_317_042_299_900_000_000 + number * 103_000_001 + offset_ns  # 2011-09-26 13:04:59.9 UTC


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    """Pictures 0, 2, 3, 7, scans 0, 2, 5, 7, timestamps for 9; cameras 1 and 2."""
    date = tmp_path / "2011_09_26"
    drive = date / "2011_09_26_drive_0001_sync"
    for number in (0, 2, 3, 7):
        write_image(drive / "image_02/data" / f"{number:010d}.png", number)
        write_image(drive / "image_01/data" / f"{number:010d}.png", number, grey=True)
    for number in (0, 2, 5, 7):
        write_scan(drive / "velodyne_points/data" / f"{number:010d}.bin", number)
    (drive / "image_02/timestamps.txt").write_text(date_lines(9, blank=(4,)))
    (drive / "image_01/timestamps.txt").write_text(date_lines(9, 1000))
    (drive / "velodyne_points/timestamps.txt").write_text(date_lines(9, -10_000_000))
    cameras = "calib_time: 09-Jan-2012 13:57:47\n" + line("R_rect_00", TILT)
    cameras += "".join(line(f"P_rect_0{c}", projection(c)) for c in OFFSETS)
    (date / "calib_cam_to_cam.txt").write_text(cameras)
    (date / "calib_velo_to_cam.txt").write_text("calib_time: x\n" + line("R", TR_ROTATION) + line("T", TR_TRANSLATION))
    return drive


@pytest.fixture
def odometry(tmp_path: Path) -> Path:
    sequence = tmp_path / "dataset/sequences/07"
    for number in (0, 4, 9):
        write_image(sequence / "image_2" / f"{number:06d}.png", number)
        write_scan(sequence / "velodyne" / f"{number:06d}.bin", number)
    Tr = np.c_[TR_ROTATION, TR_TRANSLATION]
    (sequence / "calib.txt").write_text("".join(line(f"P{c}", projection(c)) for c in OFFSETS) + line("Tr", Tr))
    return sequence


@pytest.fixture
def objects(tmp_path: Path) -> Path:
    training = tmp_path / "object/training"
    for number, tilt in ((3, TILT), (11, np.eye(3))):
        write_image(training / "image_2" / f"{number:06d}.png", number, size=(HEIGHT + number, WIDTH))
        write_scan(training / "velodyne" / f"{number:06d}.bin", number)
        text = "".join(line(f"P{c}", projection(c)) for c in OFFSETS) + line("R0_rect", tilt)
        (training / "calib").mkdir(exist_ok=True)
        (training / "calib" / f"{number:06d}.txt").write_text(text + line("Tr_velo_to_cam", np.c_[TR_ROTATION, TR_TRANSLATION]))
    return training


def test_raw_frames_are_those_with_picture_and_scan(raw):
    source = open_dataset(raw)
    assert isinstance(source, KittiSource)
    assert [source[i].name for i in range(len(source))] == ["0000000000", "0000000002", "0000000007"]
    assert "1 pictures without scan, 1 scans without picture" in source.describe()["frames"]
    frame = source[2]
    assert np.array_equal(frame.image, write_image(raw / "again.png", 7))
    points = write_scan(raw / "again.bin", 7)
    assert np.array_equal(frame.cloud.xyz, points[:, :3])
    assert np.array_equal(frame.cloud.intensity, points[:, 3])
    assert frame.cloud.ring is None
    assert np.allclose(frame.cloud.time, -np.arctan2(points[:, 1], points[:, 0]) * 0.1033 / (2 * np.pi), atol=1e-7)
    # Timestamps belong to the number.
    assert [source[i].stamp for i in range(3)] == [stamp_of(n, -6_000_000) for n in (0, 2, 7)]  # 4 ms after the scan's
    assert [source[i].cloud_stamp for i in range(3)] == [stamp_of(n, -10_000_000) for n in (0, 2, 7)]


@pytest.mark.parametrize("camera", [1, 2])
def test_raw_extrinsic_has_rectification_and_the_offset_of_the_camera(raw, camera):
    source = open_dataset(raw, camera)
    assert np.abs(source.reference - expected_extrinsic(camera)).max() < 1e-9
    assert np.array_equal(source[0].reference, source.reference)
    assert np.abs(source.camera.K - K).max() < 1e-9
    assert (source.camera.width, source.camera.height) == (WIDTH, HEIGHT)
    assert source.camera.is_pinhole
    assert source[0].image.ndim == (2 if camera == 1 else 3)
    assert source.camera_frame != open_dataset(raw, 3 - camera).camera_frame


def test_raw_opened_from_above_and_without_timestamps(raw):
    assert open_dataset(raw.parent).describe() == open_dataset(raw).describe()
    (raw.parent / "2011_09_26_drive_0002_sync/velodyne_points/data").mkdir(parents=True)
    refused(raw.parent, "2 KITTI drives: 2011_09_26_drive_0001_sync, 2011_09_26_drive_0002_sync")
    (raw / "image_02/timestamps.txt").unlink()
    source = open_dataset(raw)
    assert [source[i].stamp for i in range(3)] == [0, 200_000_000, 700_000_000]
    assert source[0].cloud_stamp is None
    assert "assumed" in source.describe()["stamps"]


def test_odometry(odometry):
    source = open_dataset(odometry)
    assert [source[i].name for i in range(len(source))] == ["000000", "000004", "000009"]
    assert np.abs(source.reference - expected_extrinsic(2, np.eye(3))).max() < 1e-9
    assert [source[i].stamp for i in range(3)] == [0, 400_000_000, 900_000_000]
    assert (source[0].compensated, source[0].twist, source[0].cloud.time) == (True, None, None)
    assert "compensated" in source.describe()["motion"]
    (odometry / "times.txt").write_text("".join(f"{0.1037 * i:e}\n" for i in range(10)))
    assert [open_dataset(odometry)[i].stamp for i in range(3)] == [0, 414_800_000, 933_300_000]
    assert len(open_dataset(odometry.parents[1])) == 3
    assert source[-1].name == "000009"
    with pytest.raises(IndexError):
        source[3]


def test_object_frames_have_their_own_calibration(objects):
    source = open_dataset(objects)
    assert [source[i].name for i in range(len(source))] == ["000003", "000011"]
    assert np.abs(source.reference - expected_extrinsic(2)).max() < 1e-9
    assert np.abs(source[1].reference - expected_extrinsic(2, np.eye(3))).max() < 1e-9
    assert [source[i].camera.height for i in range(2)] == [HEIGHT + 3, HEIGHT + 11]
    assert [source[i].stamp for i in range(2)] == [300_000_000, 1_100_000_000]
    assert (source[0].cloud_stamp, source[0].twist, source[0].cloud.time) == (None, None, None)
    assert len(open_dataset(objects.parent)) == 2


@pytest.mark.parametrize("camera", [0, 1])
def test_drives_of_kitti_360(tmp_path, camera):
    """Pictures, scans and calibration in three folders; the calibration leads from the camera to the scanner."""
    name = "2013_05_28_drive_0000_sync"
    drive, velodyne = tmp_path / "data_2d_raw" / name, tmp_path / "data_3d_raw" / name / "velodyne_points"
    for number in (0, 2, 7):
        for own in (0, 1):
            write_image(drive / f"image_0{own}/data_rect" / f"{number:010d}.png", number + own)
    for number in (2, 7):
        points = write_scan(velodyne / "data" / f"{number:010d}.bin", number)
    (drive / f"image_0{camera}/timestamps.txt").write_text(date_lines(9))
    (velodyne / "timestamps.txt").write_text(date_lines(9, -20_000_000))
    calibration = tmp_path / "calibration"
    calibration.mkdir()
    text = "".join(line(f"P_rect_0{c}", projection(c)) for c in (0, 1)) + line("R_rect_00", TILT)
    (calibration / "perspective.txt").write_text(text)
    to_velo = np.c_[TR_ROTATION.T, -TR_ROTATION.T @ TR_TRANSLATION]
    (calibration / "calib_cam_to_velo.txt").write_text(line("", to_velo).removeprefix(": "))
    for path in (drive, tmp_path):
        source = open_dataset(path, camera)
        assert np.abs(source.reference - expected_extrinsic(camera)).max() < 1e-9
        assert [(source[k].stamp, source[k].cloud_stamp) for k in range(2)] == [
            (stamp_of(n), stamp_of(n, -20_000_000)) for n in (2, 7)
        ]
        assert np.array_equal(source[1].cloud.xyz, points[:, :3])
        assert source[1].cloud.time is not None
        assert source.camera_frame == f"image_0{camera}"
    assert open_dataset(drive).camera_frame == "image_00"
    refused(drive, "no images of camera 2", camera=2)
    (calibration / "calib_cam_to_velo.txt").write_text("1 2 3")
    refused(drive, "calib_cam_to_velo.txt: .* must have 12 numbers")


def refused(source: Path | str, says: str, **options) -> None:
    """A source that cannot be opened, or read to its end."""
    with pytest.raises(BadInputError, match=says) as caught:
        read_all(source, **options)
    assert "\n" not in str(caught.value)


def read_all(source: Path | str, **options) -> list[Frame]:
    opened = open_dataset(source, **options)
    return [opened[index] for index in range(len(opened))]


def test_cameras_that_are_not_there(raw, odometry):
    refused(raw, r"no images of camera 3 \(image_03/data\), it has 1, 2", camera=3)
    refused(odometry, r"no images of camera 0 \(image_0\), it has 2", camera=0)
    refused(odometry, "no images of camera 7", camera=7)
    refused(odometry, "has no camera CAM_FRONT; KITTI's are numbers", camera="CAM_FRONT")


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda d: (d.parent / "calib_velo_to_cam.txt").unlink(), "calib_velo_to_cam.txt is missing; download"),
        (lambda d: (d.parent / "calib_cam_to_cam.txt").write_text("P_rect_02: 1 2 3\n"), "'P_rect_02' must have 12 numbers"),
        (lambda d: (d.parent / "calib_velo_to_cam.txt").write_text(line("R", np.ones(9)) + line("T", np.ones(3))), "not a rigid"),
        (lambda d: (d / "velodyne_points/data/0000000007.bin").write_bytes(bytes(33)), "0000000007.bin is truncated: 33 bytes"),
        (lambda d: (d / "image_02/data/0000000007.png").write_bytes(b"\x89PNG"), "0000000007.png is no complete PNG"),
        (lambda d: (d / "image_02/timestamps.txt").write_text(date_lines(9, blank=(7,))), "no timestamp on line 8"),
        (lambda d: (d / "velodyne_points").rename(d / "points"), "has no folder velodyne_points/data"),
        (lambda d: [p.unlink() for p in (d / "velodyne_points/data").iterdir()], "no number has both"),
    ],
)
def test_damaged_drives_say_what_to_do(raw, damage, says):
    damage(raw)
    refused(raw, says)


def test_unrecognised_folders_are_refused_and_scans_that_vanish(tmp_path, raw):
    source = open_dataset(raw)
    (raw / "velodyne_points/data/0000000002.bin").unlink()
    with pytest.raises(BadInputError, match=r"0000000002\.bin cannot be read"):
        source[1]
    assert source[2].name == "0000000007"
    refused(tmp_path / "nowhere", "does not exist")
    empty = tmp_path / "empty"
    empty.mkdir()
    refused(empty, "looked for metadata.yaml.*KITTI raw.*KITTI odometry.*KITTI object.*found nothing")
    (tmp_path / "notes.txt").write_text("hello")
    refused(tmp_path / "notes.txt", "is not a dataset; give a .mcap")
    (tmp_path / "old.bag").write_bytes(b"#ROSBAG V2.0")
    refused(tmp_path / "old.bag", "bag .* cannot be read")
    refused(raw, "has no option image_topic", image_topic="/camera")
    assert len(open_dataset(raw, image_topic=None)) == 2


@pytest.mark.kitti
class TestRealFrames:
    def test_raw(self, kitti_root):
        drive = kitti_root / "raw/2011_09_26/2011_09_26_drive_0005_sync"
        source = open_dataset(drive)
        assert len(source) == 29
        assert source.numbers == [*range(16), *range(32, 153, 10)]
        scan_lines = (drive / "velodyne_points/timestamps.txt").read_text().splitlines()
        for index in (0, 15, 16, 28):
            frame = source[index]
            assert str(np.datetime64(frame.cloud_stamp, "ns")).replace("T", " ") == scan_lines[int(frame.name)]
            # The pictures are stamped 6.5 ms later still, when they had arrived.
            assert frame.stamp - frame.cloud_stamp == 4_000_000
        assert frame.image.shape == (375, 1242, 3)
        assert 100_000 < len(frame.cloud) < 130_000
        assert np.isfinite(frame.cloud.xyz).all()
        # The offset from camera 0 to camera 2, easily forgotten, is in the reference.
        assert source.reference[0, 3] == pytest.approx(0.0571, abs=1e-4)
