"""Exports: other tools read back the exported transform by their own rules."""

from __future__ import annotations

import itertools
import json
import shlex
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.cli import arguments, main
from calib_ros.datasets.kitti import layout_of
from calib_ros.errors import BadInputError
from calib_ros.export import FORMATS, export
from calib_ros.online.state import save_state
from calib_ros.registration.initial_guess import nominal
from calib_ros.result import CONVERGED, INITIAL, REFUSED, Result, parse

PINHOLE = Camera(np.array([[700.0, 0, 600.5], [0, 710, 180.25], [0, 0, 1]]), 1242, 375)
LENS = Camera(PINHOLE.K, 1242, 375, "plumb_bob", np.array([-0.3, 0.1, 0, 0, 0]))


def moved(T: np.ndarray) -> np.ndarray:
    T = T.copy()
    T[:3, 3] = 0.27, -1e-7, -1.125
    return T


def at_pitch(pitch: float, roll: float = 0.4, yaw: float = -1.1) -> np.ndarray:
    return moved(se3.from_parts(Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix(), np.zeros(3)))


RIGHT_ANGLE = np.pi / 2
TRANSFORMS = {
    "identity": np.eye(4),
    "nominal": moved(nominal()),  # at gimbal lock by its nature: the camera's z axis is the LiDAR's x axis
    "rear": moved(nominal(180.0)),
    "near nominal": se3.perturb(moved(nominal()), [1, -2, 0.5], np.zeros(3)),
    "lock up": at_pitch(RIGHT_ANGLE),
    "lock down": at_pitch(-RIGHT_ANGLE),
    **{f"{gap:g} before lock": at_pitch(RIGHT_ANGLE - gap) for gap in (1e-12, 1e-10, 1e-9, 1e-8, 1e-7, 1e-5)},
    "half a turn": moved(se3.exp([np.pi, 0, 0, 0, 0, 0])),
    **{f"random {seed}": moved(se3.from_parts(Rotation.random(rng=seed).as_matrix(), np.zeros(3))) for seed in range(8)},
}


BOTH_WAYS = tuple(itertools.product(TRANSFORMS.values(), ("camera", "lidar")))  # T, and the parent of the exported transform


def result(T: np.ndarray = TRANSFORMS["identity"], **changes: object) -> Result:
    return replace(Result(T, CONVERGED, camera_frame="front/optical", lidar_frame="velo"), **changes)


def same(found: np.ndarray, T: np.ndarray, parent: str = "camera") -> None:
    assert np.abs(found - (T if parent == "camera" else np.linalg.inv(T))).max() < 1e-9


def from_rpy(xyz: list[float], rpy: list[float]) -> np.ndarray:
    """By the rule of URDF: about fixed axes, roll first."""
    return se3.from_parts(Rotation.from_euler("xyz", rpy).as_matrix(), xyz)


def frames(parent: str) -> tuple[str, str]:
    return ("front/optical", "velo") if parent == "camera" else ("velo", "front/optical")


def test_tf_urdf_and_autoware() -> None:
    for T, parent in BOTH_WAYS:
        text = export(result(T), "tf", parent)
        words = shlex.split(text)
        assert words[:4] == ["ros2", "run", "tf2_ros", "static_transform_publisher"]
        options = dict(zip(words[4::2], words[5::2], strict=True))
        q = [float(options[f"--q{axis}"]) for axis in "xyzw"]
        found = se3.from_parts(Rotation.from_quat(q).as_matrix(), [float(options[f"--{axis}"]) for axis in "xyz"])
        assert abs(np.linalg.norm(q) - 1) < 1e-12
        same(found, T, parent)
        assert (options["--frame-id"], options["--child-frame-id"]) == frames(parent)
        assert text.count("\n") == 1
        joint = ET.fromstring(export(result(T), "urdf", parent))
        assert (joint.tag, joint.get("type")) == ("joint", "fixed")
        assert (joint.find("parent").get("link"), joint.find("child").get("link")) == frames(parent)
        xyz, rpy = ([float(v) for v in joint.find("origin").get(name).split()] for name in ("xyz", "rpy"))
        same(from_rpy(xyz, rpy), T, parent)
        assert abs(rpy[1]) <= RIGHT_ANGLE
        data = yaml.safe_load(export(result(T), "autoware", parent))
        outer, inner = frames(parent)
        assert list(data) == [outer]
        assert list(data[outer]) == [inner]
        entry = data[outer][inner]
        assert list(entry) == ["x", "y", "z", "roll", "pitch", "yaw"]
        assert all(isinstance(value, float) for value in entry.values())
        same(from_rpy([entry[k] for k in "xyz"], [entry[k] for k in ("roll", "pitch", "yaw")]), T, parent)


def numbers(text: str) -> dict[str, np.ndarray]:
    lines = (line.split(":") for line in text.splitlines())
    return {key: np.array(values.split(), float) for key, values in lines}


def test_kitti_and_results() -> None:
    for T in TRANSFORMS.values():
        found = numbers(export(result(T), "kitti"))
        assert list(found) == ["Tr"]
        same(np.vstack([found["Tr"].reshape(3, 4), [0, 0, 0, 1]]), T)
        raw = numbers(export(result(T), "kitti-raw"))
        assert list(raw) == ["R", "T"]
        same(se3.from_parts(raw["R"].reshape(3, 3), raw["T"]), T)
        for form, read in (("json", json.loads), ("yaml", yaml.safe_load)):
            text = export(result(T), form)
            assert np.array_equal(read(text)["T_camera_lidar"], T)
            same(parse(text, form).T_camera_lidar, T)


def test_the_project_reads_its_own_kitti_files(tmp_path: Path) -> None:
    T = TRANSFORMS["near nominal"]
    for folder in ("odometry/velodyne", "odometry/image_0", "raw/velodyne_points/data", "raw/image_00/data"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "odometry/calib.txt").write_text(export(result(T), "kitti", camera=PINHOLE))
    P, found = layout_of(tmp_path / "odometry", 0).calibrate(0)
    same(found, T)
    assert np.array_equal(P, np.c_[PINHOLE.K, np.zeros(3)])
    # The files that the docstring of kitti_raw assumes beside it.
    values = " ".join(map(str, P.ravel()))
    (tmp_path / "raw/calib_cam_to_cam.txt").write_text(f"P_rect_00: {values}\nR_rect_00: 1 0 0 0 1 0 0 0 1\n")
    (tmp_path / "raw/calib_velo_to_cam.txt").write_text(export(result(T), "kitti-raw"))
    same(layout_of(tmp_path / "raw", 0).calibrate(0)[1], T)


NASTY = ["with space", "a'b", 'a"b', "<&>", "$(reboot)", "a: b", "- x", "Straße", "yes", "12", "#x", "*a", "x\ny"]


def test_names_are_quoted_as_each_format_wants() -> None:
    for name in NASTY:
        T, odd = TRANSFORMS["near nominal"], {"camera_frame": name, "lidar_frame": "l"}
        words = shlex.split(export(result(T, **odd), "tf"))
        assert words[words.index("--frame-id") + 1] == name
        joint = ET.fromstring(export(result(T, **odd), "urdf"))
        assert joint.find("parent").get("link") == name
        assert yaml.safe_load(export(result(T, **odd), "autoware")).keys() == {name}


def test_invalid_frame_names_and_choices_are_refused() -> None:
    one_way = (f"{form} files hold .* by definition; leave out --parent lidar" for form in ("kitti", "kitti-raw", "json", "yaml"))
    for form, options, says in (
        ("tf", {"camera_frame": "velo"}, "both 'velo'"),
        ("urdf", {"lidar_frame": " "}, "has no name"),
        ("xml", {}, "format 'xml' is not known; choose one of tf, urdf"),
        ("tf", {"parent": "base"}, "parent 'base' is not known"),
        *((says.split()[0], {"parent": "lidar"}, says) for says in one_way),
    ):
        with pytest.raises(BadInputError, match=says):
            export(result(), form, **options)


# --- the command ----------------------------------------------------------------------------------------------------------


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    code = main.main(["export", *map(str, words)])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "state.json"
    save_state(path, result(TRANSFORMS["near nominal"]), PINHOLE)
    return path


@pytest.mark.parametrize("form", FORMATS)
def test_the_command_prints_or_writes(form: str, saved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert arguments.FORMATS == FORMATS
    expected = export(parse(saved.read_text(), "x"), form, camera=PINHOLE)  # reading may turn the last digit of a rotation
    assert run(capsys, saved, "--format", form) == (0, expected, "")
    assert run(capsys, saved, "--format", form, "--out", "-") == (0, expected, "")
    out = tmp_path / "new" / "file.txt"
    code, said, wrong = run(capsys, saved, "--format", form, "--out", out)
    assert (code, said.startswith(f"wrote {out}"), "a joint alone" in said, wrong) == (0, True, form == "urdf", "")
    assert out.read_text() == expected


def test_the_command_takes_direction_and_names(saved: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [saved, "--format", "autoware", "--parent", "lidar", "--camera-frame", "camera0/optical", "--lidar-frame", "top"]
    code, out, err = run(capsys, *words)
    assert (code, err) == (0, "")
    entry = yaml.safe_load(out)["top"]["camera0/optical"]
    found = from_rpy([entry[k] for k in "xyz"], [entry[k] for k in ("roll", "pitch", "yaw")])
    same(found, TRANSFORMS["near nominal"], "lidar")


@pytest.mark.parametrize("status", [INITIAL, REFUSED])
def test_unaccepted_results_are_exported_with_a_note(status: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result(np.eye(4), status=status, reason="nothing\nmatches").save(tmp_path / "r.json")
    code, out, err = run(capsys, tmp_path / "r.json")
    assert (code, out) == (0, export(result(np.eye(4)), "tf"))
    assert len(err.splitlines()) == 1
    assert f"its status is {status} (nothing matches)" in err


def test_lens_distortion_is_noted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_state(tmp_path / "s.json", result(np.eye(4)), LENS)
    code, out, err = run(capsys, tmp_path / "s.json", "--format", "kitti")
    assert (code, list(numbers(out))) == (0, ["Tr"])
    assert err == "calib-ros: no P0 written, the camera has distortion; Tr holds for its rectified image, too\n"
