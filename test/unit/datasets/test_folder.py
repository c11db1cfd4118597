"""Plain folders of images and clouds, and what is wrong with them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from test_cloud_files import cloud, written
from test_kitti import HEIGHT, WIDTH, write_image

from calib_ros.cli.main import main
from calib_ros.datasets import open_dataset
from calib_ros.datasets.folder import FolderSource
from calib_ros.errors import BadInputError

CALIBRATION = """\
image_width: 40
image_height: 24
camera_name: front
camera_matrix:
  rows: 3
  cols: 3
  data: [30.0, 0, 20, 0, 30, 12, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.1, 0.02, 0, 0, 0]
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
"""
REFERENCE = np.array([[0.0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3], [0, 0, 0, 1]])
ROWS = "T_camera_lidar:\n" + "".join(f"- {row}\n" for row in REFERENCE.tolist())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Images 2, 10 and 11, clouds 2, 10 and 12, a reference and no stamps."""
    root = tmp_path / "vehicle"
    for number in (2, 10, 11):
        write_image(root / "images" / f"{number}.png", number)
    for number in (2, 10, 12):
        written(root / "clouds" / f"{number}.pcd", cloud(number))
    (root / "calibration.yaml").write_text(CALIBRATION + ROWS)
    return root


def test_frames_are_the_names_with_image_and_cloud(folder):
    source = open_dataset(folder)
    assert [source[i].stamp for i in range(2)] == [0, 100_000_000]  # without times: a tenth of a second apart
    assert source[1].cloud_stamp is None
    assert "1 image without cloud (11.png)" in source.describe()["frames"]
    assert "1 cloud without image (12.pcd)" in source.describe()["frames"]
    assert isinstance(source, FolderSource)
    assert [source[i].name for i in range(len(source))] == ["2", "10"]
    frame = source[1]
    assert np.array_equal(frame.image, write_image(folder / "again.png", 10))
    expected = cloud(10)
    assert np.array_equal(frame.cloud.xyz, np.stack([expected[axis] for axis in "xyz"], axis=1))
    assert np.array_equal(frame.cloud.intensity, expected["intensity"])
    assert np.array_equal(frame.cloud.ring, expected["ring"])
    assert np.allclose(frame.cloud.time, expected["time"], atol=1e-9)
    assert np.array_equal(frame.reference, REFERENCE)
    assert (frame.camera.model, frame.camera.D.tolist()) == ("plumb_bob", [-0.1, 0.02, 0, 0, 0])
    assert (source.camera_frame, source.lidar_frame) == ("front", "lidar")


def test_pictures_that_are_rectified_already_are_of_p_or_k(folder, capsys):
    of_p = f"{CALIBRATION}projection_matrix: {{data: [30, 0, 22, 0, 0, 30, 12, 0, 0, 0, 1, 0]}}\n"
    for text, cx in ((CALIBRATION, 20), (of_p, 22)):
        (folder / "calibration.yaml").write_text(text + ROWS)
        assert not open_dataset(folder, rectified=False).camera.is_pinhole
        for source in (folder, "synthetic:rig=os1_64_wide,frames=1"):
            camera = open_dataset(source, rectified=True).camera
            assert (camera.is_pinhole, camera.said_rectified) == (True, True)
        assert open_dataset(folder, rectified=True)[0].camera.K[0, 2] == cx
    assert main(["info", str(folder), "--rectified"]) == 0
    assert "no distortion" in capsys.readouterr().out


def test_text_and_pictures_beside_frames_are_of_something_else(folder):
    for name in ("clouds/2.txt", "clouds/10.csv", "images/2.tif"):
        (folder / name).write_text("labels")
    assert len(open_dataset(folder)) == 2
    (folder / "2011.bag").write_bytes(b"#ROSBAG V2.0")  # what it was made from
    assert isinstance(open_dataset(folder), FolderSource)


@pytest.mark.parametrize(
    ("part", "name", "message"),
    [
        ("clouds", "2.e57", r"has only \.e57; \.e57 is E57; convert it"),
        ("clouds", "2.xyzrgb", r"has only \.xyzrgb; convert them; read are \.pcd"),
        ("images", "2.heic", r"has only \.heic; convert them; read are \.png"),
        ("clouds", "", "is empty; put the frames' files there"),
    ],
)
def test_files_of_a_format_that_is_not_read_are_named(folder, part, name, message):
    for path in (folder / part).iterdir():
        path.unlink()
    if name:
        (folder / part / name).write_bytes(b"1")
    with pytest.raises(BadInputError, match=message):
        open_dataset(folder)


def test_times_give_stamps_and_order_and_points_count_from_the_clouds_stamp(folder):
    times = folder / "times.csv"
    times.write_text("name, image_ns, cloud_ns\n2, 1600000001000000001, 1600000000990000000\n10, 1600000000000000000,\n")
    source = open_dataset(folder)
    stamps = [(source[i].name, source[i].stamp, source[i].cloud_stamp) for i in range(2)]
    assert stamps == [("10", 1_600_000_000_000_000_000, None), ("2", 1_600_000_001_000_000_001, 1_600_000_000_990_000_000)]
    assert source.describe()["stamps"] == "times.csv"
    columns, stamp = cloud(2), 1_600_000_000_123_456_789
    columns["timestamp"] = (stamp + np.round(columns.pop("time") * 1e9).astype("<i8")).astype("<u8")
    written(folder / "clouds" / "2.pcd", columns)
    times.write_text(f"name,image_ns,cloud_ns\n2,{stamp + 7_000_000},{stamp}\n10,{stamp - 10**9},{stamp - 10**9}\n")
    assert np.allclose(open_dataset(folder)[1].cloud.time, cloud(2)["time"], atol=1e-6)


def test_pictures_of_every_kind(folder):
    expected, lossless = open_dataset(folder)[0].image, [cv2.IMWRITE_WEBP_QUALITY, 101]
    with_alpha, deep = np.dstack([expected, np.full((HEIGHT, WIDTH), 255, np.uint8)]), expected[:, :, 0].astype(np.uint16) * 257
    (folder / "images/2.png").unlink()
    plain = ("2.BMP", expected, []), ("2.png", with_alpha, []), ("2.png", deep, None), ("2.jpeg", expected, None)
    packed = ("2.tif", expected, [cv2.IMWRITE_TIFF_COMPRESSION, 1]), ("2.tiff", expected, []), ("2.webp", expected, lossless)
    for name, picture, how in (*plain, *packed, ("2.webp", expected, None)):  # None: not the same picture
        path = folder / "images" / name
        cv2.imwrite(str(path), picture, how)
        found = open_dataset(folder)[0].image
        assert np.array_equal(found, expected) if how is not None else found.shape == picture.shape
        if path.suffix[1:] in ("tif", "tiff", "webp"):
            path.write_bytes(path.read_bytes()[:-30])
            with pytest.raises(BadInputError, match="is no complete PNG"):
                open_dataset(folder)
        path.unlink()


def test_calibration_without_distortion_name_or_reference(folder):
    text = "image_width: 40\nimage_height: 24\ncamera_matrix: {rows: 3, cols: 3, data: [30, 0, 20, 0, 30, 12, 0, 0, 1]}\n"
    (folder / "calibration.yaml").write_text(text)
    source = open_dataset(folder)
    assert source.camera.is_pinhole
    assert (source.reference, source.describe()["reference"], source.camera_frame) == (None, "none", "camera")


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("image_height: 24", "image_height: 25", r"2\.png is 40x24, but calibration.yaml says 40x25"),
        ("data: [30.0, 0, 20,", "data: [30.0, 0,", r"camera_matrix must have rows, cols and data: \[9 numbers\]"),
        ("data: [30.0,", "data: [x,", "camera_matrix must have"),
        ("plumb_bob", "omnidirectional", "distortion model 'omnidirectional' is not supported"),
        ("- [1.0, 0.0, 0.0, -0.3]\n", "", "T_camera_lidar must be a 4x4 matrix"),
        ("image_width: 40", "image_width: [40", "is not valid YAML"),
    ],
)
def test_a_wrong_calibration_is_one_clear_error(folder, before, after, message):
    path = folder / "calibration.yaml"
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after))
    with pytest.raises(BadInputError, match=message) as raised:
        open_dataset(folder)
    assert "calibration" in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "needs a first line 'name,image_ns,cloud_ns'"),
        ("name,image_ns\n2,1\n", r"no line for frame 10 \(1 of 2 missing\)"),
        ("name,image_ns\n2,1.5e9\n10,2\n", "line 2: '1.5e9' is no stamp"),
        ("name,image_ns,cloud_ns\n2,1,99999999999999999999\n10,2,2\n", "is no stamp; give whole nanoseconds"),
    ],
)
def test_wrong_times_are_one_clear_error(folder, text, message):
    (folder / "times.csv").write_text(text)
    with pytest.raises(BadInputError, match=message):
        open_dataset(folder)


def test_damaged_and_doubled_images_are_one_clear_error(folder):
    data = (folder / "images/10.png").read_bytes()
    (folder / "images/10.png").write_bytes(data[:200])
    source = open_dataset(folder)
    with pytest.raises(BadInputError, match=r"10\.png is no complete PNG"):
        source[1]
    (folder / "images/10.png").unlink()
    with pytest.raises(BadInputError, match=r"cannot read image .*10\.png"):
        source[1]
    write_image(folder / "images" / "11.jpg", 0)
    with pytest.raises(BadInputError, match=r"11\.jpg and 11\.png are of the same frame; keep one"):
        open_dataset(folder)
