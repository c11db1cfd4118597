"""Scenes of ONCE."""

from __future__ import annotations

import json
import re

import cv2
import numpy as np
import pytest

from calib_ros import se3
from calib_ros.datasets import open_dataset
from calib_ros.errors import BadInputError

T_LIDAR_CAMERA = se3.from_parts(se3.rotation_from_euler(0.1, -1.4, 0.2), [0.3, -0.1, 0.5])
CAMERA = {
    "cam_to_velo": T_LIDAR_CAMERA.tolist(),
    "cam_intrinsic": [[60.0, 0.0, 40.0], [0.0, 61.0, 30.0], [0.0, 0.0, 1.0]],
    "distortion": [-0.1, 0.02, 0.001, 0.0],
}
TIMES = (1616343528200, 1616343528700, 1616343529199)


@pytest.fixture
def scene(tmp_path):
    folder = tmp_path / "000027"
    for camera in ("cam01", "cam03"):
        (folder / camera).mkdir(parents=True)
        for k, time in enumerate(TIMES):
            cv2.imwrite(str(folder / camera / f"{time}.jpg"), np.full((60, 80, 3), 40 * k, np.uint8))
    (folder / "lidar_roof").mkdir()
    for k, time in enumerate(TIMES[1:]):
        np.full((5, 4), k, np.float32).tofile(folder / "lidar_roof" / f"{time}.bin")
    (folder / "000027.json").write_text(json.dumps({"calib": {"cam03": CAMERA, "cam01": CAMERA | {"distortion": 8 * [0.0]}}}))
    return folder


def test_frames_have_a_picture_and_a_scan_of_the_same_time(scene):
    source = open_dataset(scene, "cam03")
    assert [frame.stamp for frame in source] == [time * 1_000_000 for time in TIMES[1:]]
    assert [int(frame.image[0, 0, 0]) // 40 for frame in source] == [1, 2]
    assert [frame.cloud.xyz[0, 0] for frame in source] == [0, 1]
    assert (source.camera.model, source.camera.width, source.camera.height) == ("plumb_bob", 80, 60)
    assert source.camera.D[:4] == pytest.approx(CAMERA["distortion"])
    np.testing.assert_allclose(source[0].reference, se3.inverse(T_LIDAR_CAMERA), atol=1e-12)
    assert source.describe()["kind"] == "ONCE"
    assert "1 pictures without scan" in source.describe()["frames"]


def test_a_camera_is_chosen_by_name_or_number(scene):
    assert open_dataset(scene).camera_frame == "cam01"
    assert open_dataset(scene, 1).camera_frame == "cam03"
    assert open_dataset(scene, "cam01").camera_frame == "cam01"
    for camera in (7, "cam07"):
        with pytest.raises(BadInputError, match=rf"no camera {camera}; it has cam01, cam03"):
            open_dataset(scene, camera)


@pytest.mark.parametrize(
    ("damage", "text"),
    [
        ({"calib": None}, "no cameras under 'calib'"),
        ({"calib": {"cam01": None}}, "cam01: incomplete"),
        ({"calib": {"cam01": CAMERA | {"cam_to_velo": [[1.0]]}}}, "cam01: cam_to_velo"),
        ({"calib": {"cam01": CAMERA | {"cam_intrinsic": [1.0]}}}, "cam01: K has 1 numbers"),
        ({"calib": {}}, "no camera 0; it has none"),
        ({"calib": {"cam09": CAMERA}}, r"picture \(0 in cam09\) and a scan \(2 in lidar_roof\)"),
        ([], "no cameras under 'calib'"),
    ],
)
def test_damaged_annotations_are_named(scene, damage, text):
    (scene / "000027.json").write_text(json.dumps(damage))
    with pytest.raises(BadInputError, match=text):
        open_dataset(scene)


def test_missing_annotations_are_named(scene):
    (scene / "000027.json").unlink()
    with pytest.raises(BadInputError, match="download the scene's annotations"):
        open_dataset(scene)


def test_pickles_of_pandaset_are_refused_with_what_helps(tmp_path):
    (tmp_path / "lidar").mkdir()
    (tmp_path / "lidar/00.pkl.gz").write_bytes(b"")
    with pytest.raises(BadInputError, match=re.escape("write x, y, z, i of pandas.read_pickle")):
        open_dataset(tmp_path)
