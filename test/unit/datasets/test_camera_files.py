"""Intrinsics from the files that other tools write, as they write them."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from calib_ros.camera import Camera
from calib_ros.datasets import open_dataset
from calib_ros.datasets.camera_files import camera_file, read_camera
from calib_ros.errors import BadInputError
from calib_ros.lens import LENSES

K = np.array([[210.5, 0, 159.25], [0, 209.75, 119.5], [0, 0, 1]])
LENS = [210.5, 209.75, 159.25, 119.5]
D5, D8 = [-0.1, 0.02, 1e-3, -5e-4, 0.004], [0.6, 0.1, 1e-4, -2e-4, 0.01, 0.9, 0.2, 0.02]


def read(folder: Path, name: str, text: str, choice: int | str | None = None, size: tuple[int, int] = (320, 240)) -> Camera:
    (folder / name).write_text(text)
    return read_camera(folder / name, choice, lambda: size)[0]


def opencv(path: Path, **values: object) -> str:
    """A file as cv2.FileStorage writes it, its format by the name."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in values.items():
        storage.write(name, np.array(value, float) if isinstance(value, (list, np.ndarray)) else value)
    storage.release()
    return path.read_text()


@pytest.mark.parametrize("name", ["calibration.yaml", "calibration.xml", "calibration.json"])
def test_files_of_opencv(tmp_path, name):
    text = opencv(tmp_path / name, image_width=320, image_height=240, camera_matrix=K, distortion_coefficients=D5, note="left")
    assert camera_file(tmp_path) == tmp_path / name
    assert read(tmp_path, name, text) == Camera(K, 320, 240, "plumb_bob", np.array(D5))
    text = opencv(tmp_path / name, K=K, D=D8, xi=np.array([[1.2]]))
    with pytest.raises(BadInputError, match="omnidir has 1 or 5 distortion coefficients, got 9"):
        read(tmp_path, name, text)
    text = opencv(tmp_path / name, K=K, D=D5[:4], xi=np.array([[1.2]]))
    assert read(tmp_path, name, text) == Camera(K, 320, 240, "omnidir", np.array([1.2, *D5[:4]]))
    text = opencv(tmp_path / name, M1=K, D1=D8, M2=2 * K, D2=D5)
    assert read(tmp_path, name, text, size=(330, 250)) == Camera(K, 330, 250, "rational_polynomial", np.array(D8))
    text = opencv(tmp_path / name, width=320, height=240, Camera_Matrix=K, dist_coeffs=D5[:4], fisheye_model=1)
    assert read(tmp_path, name, text).model == "equidistant"
    text = opencv(tmp_path / name, CameraMat=K, DistCoeff=[[d] for d in D5], ImageSize=[320.0, 240.0])
    with pytest.raises(BadInputError, match="ImageSize must be a whole number"):
        read(tmp_path, name, text)


def test_files_of_autoware_and_what_ros_topic_echo_prints(tmp_path):
    rows = f"CameraMat: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: {K.ravel().tolist()}\n"
    D = f"DistCoeff: !!opencv-matrix\n   rows: 5\n   cols: 1\n   dt: d\n   data: {D5}\n"
    text = f"%YAML:1.0\n---\n{rows}{D}ImageSize: [ 320, 240 ]\n"
    assert read(tmp_path, "calibration.yml", text) == Camera(K, 320, 240, "plumb_bob", np.array(D5))
    text = f"height: 240\nwidth: 320\ndistortion_model: mei\nd: {[1.1, *D5[:4]]}\nk: {K.ravel().tolist()}\n"
    assert read(tmp_path, "calibration.yml", text) == Camera(K, 320, 240, "omnidir", np.array([1.1, *D5[:4]]))


def kalibr(model: str, distortion: str, D: list[float], *before: float) -> dict[str, object]:
    own = {"camera_model": model, "intrinsics": [*before, *LENS], "distortion_model": distortion, "distortion_coeffs": D}
    return {**own, "resolution": [320, 240], "rostopic": "/left", "cam_overlaps": []}


@pytest.mark.parametrize(
    ("own", "model", "D"),
    [
        (kalibr("pinhole", "radtan", D5[:4]), "plumb_bob", D5[:4]),
        (kalibr("pinhole", "equidistant", D5[:4]), "equidistant", D5[:4]),
        (kalibr("pinhole", "fov", [0.8]), "fov", [0.8]),
        (kalibr("pinhole", "none", []), "plumb_bob", []),
        (kalibr("omni", "radtan", D5[:4], 1.3), "omnidir", [1.3, *D5[:4]]),
        (kalibr("omni", "none", [], 1.3), "omnidir", [1.3]),
        (kalibr("ds", "none", [], -0.2, 0.6), "double_sphere", [-0.2, 0.6]),
        (kalibr("eucm", "none", [], 0.6, 1.1), "eucm", [0.6, 1.1]),
    ],
)
def test_files_of_kalibr(tmp_path, own, model, D):
    path = tmp_path / "rig-camchain.yaml"
    text = yaml.safe_dump({"cam0": kalibr("pinhole", "radtan", D5[:4]), "cam1": own})
    assert (
        read(tmp_path, path.name, text, "cam1") == read(tmp_path, path.name, text, 1) == Camera(K, 320, 240, model, np.array(D))
    )
    assert camera_file(tmp_path) == path
    assert read_camera(path, None, lambda: (0, 0))[2:] == ("cam0", ["cam1"])


@pytest.mark.parametrize(
    ("kind", "model", "own"),
    [
        ("ds", "double_sphere", {"xi": -0.2, "alpha": 0.6}),
        ("eucm", "eucm", {"alpha": 0.6, "beta": 1.1}),
        ("ucm", "ucm", {"alpha": 0.6}),
        ("kb4", "equidistant", {"k1": 0.02, "k2": -0.004, "k3": 8e-4, "k4": -1e-4}),
        ("pinhole", "plumb_bob", {}),
        ("fov", "fov", {"w": 0.9}),
        ("pinhole-radtan8", "rational_polynomial", dict(zip(LENSES["rational_polynomial"].names, D8, strict=False), rpmax=2.5)),
    ],
)
def test_files_of_basalt(tmp_path, kind, model, own):
    lens = {"camera_type": kind, "intrinsics": {**dict(zip(("fx", "fy", "cx", "cy"), LENS, strict=True)), **own}}
    data = {
        "value0": {"T_imu_cam": [{"px": 1.0}], "intrinsics": [lens, {"camera_type": "x"}], "resolution": [[320, 240], [1, 1]]}
    }
    D = np.array([value for name, value in own.items() if name != "rpmax"])
    assert read(tmp_path, "calibration.json", json.dumps(data)) == Camera(K, 320, 240, model, D)
    with pytest.raises(BadInputError, match="is incomplete"):
        read(tmp_path, "calibration.json", json.dumps(data), "cam1")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (yaml.safe_dump({"cam0": kalibr("omni", "equidistant", D5[:4], 1.3)}), "omni with equidistant is not supported; rectify"),
        (yaml.safe_dump({"cam0": kalibr("ds", "none", [], 0.6)}), r"intrinsics must have .*\[4 numbers\]"),
        (yaml.safe_dump({"cam0": kalibr("pinhole", "radtan", [0.1])}), "4 or 5 distortion coefficients, got 1"),
        (yaml.safe_dump({"cam0": {"camera_model": "pinhole"}}), "is incomplete .*'intrinsics'.*; give"),
        ('{"value0": {"intrinsics": [], "resolution": []}}', "there is no camera 0; there are none"),
        ('{"value0": {"intrinsics": [1], "resolution": [[3, 4]]}}', "is incomplete"),
        ('{"value0": {"intrinsics": 3', "is not valid"),
        ("<opencv_storage><K>", "is not valid XML"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', "is not valid"),
        ("<a/>", "has no names"),
        ("K: !!opencv-matrix 3\n", "is not valid YAML"),
        ("[" * 4000, "is not valid"),
        ("model_type: MEI\n", "image size 0x0|camera_matrix must have"),
        ("K: [1, 2]\nwidth: 3\n", "image_height must be a whole number"),
    ],
)
def test_files_that_are_none_are_one_clear_error(tmp_path, text, says):
    with pytest.raises(BadInputError, match=says) as raised:
        read(tmp_path, "calibration.yaml", text, size=(0, 0))
    assert "\n" not in str(raised.value)


def test_a_folder_takes_its_camera_from_such_a_file_and_tells_the_others(tmp_path):
    for name in ("images", "clouds"):
        (tmp_path / name).mkdir()
    cv2.imwrite(str(tmp_path / "images/0.png"), np.zeros((240, 320), np.uint8))
    np.savez(tmp_path / "clouds/0.npz", xyz=np.ones((5, 3)))
    (tmp_path / "camchain.yaml").write_text(
        yaml.safe_dump({"cam0": kalibr("ds", "none", [], -0.2, 0.6), "cam1": kalibr("pinhole", "fov", [0.8])})
    )
    source = open_dataset(tmp_path)
    assert (source.camera.model, source.camera_frame) == ("double_sphere", "cam0")
    assert source.describe()["camera"].endswith("not cam1")
    assert open_dataset(tmp_path, camera="cam1").camera.model == open_dataset(tmp_path, camera=1).camera.model == "fov"
    with pytest.raises(BadInputError, match="there is no camera left; there are cam0, cam1"):
        open_dataset(tmp_path, camera="left")
    (tmp_path / "camchain.yaml").unlink()
    (tmp_path / "calibration.yml").write_text(f"M1: {K.tolist()}\nD1: {D5}\n")
    assert (open_dataset(tmp_path).camera.width, open_dataset(tmp_path).camera.height) == (320, 240)
