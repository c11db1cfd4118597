"""`calib-ros calibrate --intrinsics refine`: the file of the corrected camera."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from calib_ros import open_dataset
from calib_ros.cli import main
from calib_ros.frame import Frame
from calib_ros.intrinsics import FOCAL, camera_info_yaml, changed
from calib_ros.result import load

QUICK = {"semantics": {"segmentation": "none"}, "search": {"rounds": 1, "starts": 64}}


@pytest.fixture
def vehicle(street: list[Frame], tmp_path: Path) -> Path:
    """A folder of some frames, whose focal length is given 3 % too long."""
    folder = tmp_path / "vehicle"
    for part in ("images", "clouds"):
        (folder / part).mkdir(parents=True)
    for k, frame in enumerate(street[:4]):
        cv2.imwrite(str(folder / "images" / f"{k}.png"), frame.image)
        np.savez(folder / "clouds" / f"{k}.npz", xyz=frame.cloud.xyz, ring=frame.cloud.ring, intensity=frame.cloud.intensity)
    given = yaml.safe_load(camera_info_yaml(changed(street[0].camera, FOCAL, 0.03), "front"))
    T = np.asarray(street[0].reference).tolist()
    (folder / "calibration.yaml").write_text(yaml.safe_dump({**given, "T_camera_lidar": T}))
    (tmp_path / "quick.yaml").write_text(yaml.safe_dump(QUICK))
    return folder


def calibrate(folder: Path, *options: str) -> int:
    config = ["--config", str(folder.parent / "quick.yaml")]
    return main.main(["calibrate", str(folder), *config, "--intrinsics", "refine", *options])


def test_refined_intrinsics_are_written_as_camera_info(
    vehicle: Path, street: list[Frame], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, result, camera = tmp_path / "front.yaml", tmp_path / "result.json", street[0].camera
    options = ["--initial", "reference", "--search-deg", "2", "--search-m", "0.15"]
    code = calibrate(vehicle, *options, "--camera-info", str(out), "--json", str(result))
    text = capsys.readouterr().out
    assert code == 0, text
    assert "refined intrinsics: fx " in text
    written = yaml.safe_load(out.read_text())
    assert (written["camera_name"], written["image_width"], written["image_height"]) == ("front", camera.width, camera.height)
    assert [written[f"{name}_matrix"]["rows"] for name in ("camera", "rectification", "projection")] == [3, 3, 3]
    assert [len(written[f"{name}_matrix"]["data"]) for name in ("camera", "rectification", "projection")] == [9, 9, 12]
    refined = load(result).refined_camera
    assert refined is not None
    assert refined.camera.K[0, 0] == pytest.approx(camera.K[0, 0], rel=0.01)
    assert refined.changes[FOCAL].value == pytest.approx(1 / 1.03 - 1, abs=0.01)
    # What reads such files understands it, down to the last bit.
    shutil.copy(out, vehicle / "calibration.yaml")
    assert open_dataset(vehicle).camera == refined.camera


def test_a_refused_estimate_writes_no_camera(vehicle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Looking backwards nothing can match."""
    out = tmp_path / "front.yaml"
    code = calibrate(vehicle, "--yaw-deg", "180", "--search-deg", "1", "--search-m", "0.1", "--camera-info", str(out))
    assert code == 1
    assert f"{out} is not written: the estimate is " in capsys.readouterr().err
    assert not out.exists()
