"""The command line: exit codes, output files, one line for bad input."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import threading
from argparse import Namespace
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import sample_sources
import yaml
from paths import ROOT

from calib_ros import open_dataset, se3
from calib_ros.camera import Camera
from calib_ros.cli import inputs, main
from calib_ros.cli.calibrate import advice, calibrate, draw, next_command
from calib_ros.cli.inputs import ConstraintOptions
from calib_ros.cli.output import more_frames, motion, summary
from calib_ros.config import Config, MotionConfig, update
from calib_ros.errors import BadInputError, ConfigError
from calib_ros.frame import Frame
from calib_ros.intrinsics import FOCAL, camera_info_yaml, changed
from calib_ros.online.state import save_state
from calib_ros.overlay import layout
from calib_ros.registration.initial_guess import nominal
from calib_ros.registration.search.constraints import NOMINAL_BOX, SearchBox
from calib_ros.result import CONVERGED, INSUFFICIENT, REFUSED, Cause, Extrinsic, RefusalCode, Result, load
from calib_ros_synthetic.drive import SyntheticDrive

pytestmark = pytest.mark.usefixtures("rendered_once")
SOURCE = "synthetic:seed=1,frames=6,rings=32,width=640,height=192,speed=3"
# Enough for what these tests are about; test_calibrate_writes_result_and_overlay runs the defaults.
QUICK: dict[str, dict[str, Any]] = {"semantics": {"segmentation": "none"}, "search": {"rounds": 1, "starts": 64}}


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    code = main.main(list(arguments))
    captured = capsys.readouterr()
    return code, captured.out, captured.err


@pytest.fixture(scope="module")
def bag(street_bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of SOURCE, whose frames are those that the street begins with."""
    path = tmp_path_factory.mktemp("cli") / "bag"
    assert main.main(["convert", str(street_bag), str(path), "--frames", "0:6", "--storage", "sqlite3"]) == 0
    return path


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """--config of QUICK."""
    path = tmp_path_factory.mktemp("quick") / "quick.yaml"
    path.write_text(yaml.safe_dump(QUICK))
    return ["--config", str(path)]


def vehicle(folder: Path, frames: list[Frame], camera: Camera) -> Path:
    """A plain folder of frames, with what this camera's calibration says."""
    for part in ("images", "clouds"):
        (folder / part).mkdir(parents=True)
    times = "name,image_ns,cloud_ns\n"
    for k, frame in enumerate(frames):
        cv2.imwrite(str(folder / "images" / f"{k:06d}.png"), frame.image)
        np.savez(folder / "clouds" / f"{k:06d}.npz", xyz=frame.cloud.xyz, ring=frame.cloud.ring, i=frame.cloud.intensity)
        times += f"{k:06d},{frame.stamp},{frame.moment_of_cloud}\n"
    (folder / "times.csv").write_text(times)
    calibration = yaml.safe_load(camera_info_yaml(camera, "front"))
    calibration["T_camera_lidar"] = np.asarray(frames[0].reference).tolist()
    (folder / "calibration.yaml").write_text(yaml.safe_dump(calibration))
    return folder


def test_a_plain_folder_is_a_source_of_every_command(
    street: list[Frame], bag: Path, quick: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = vehicle(tmp_path / "vehicle", street[:3], street[0].camera)
    code, out, _ = run(capsys, "info", str(folder))
    assert code == 0
    assert "3, names 000000 to 000002" in out
    assert "with x, y, z, intensity, ring" in out
    assert "640x192" in out
    assert "6 pairs" in run(capsys, "info", str(bag))[1]

    result = tmp_path / "result.json"
    refine = ["--initial", "reference", "--search-deg", "0", "--search-m", "0", *quick, "--json", str(result)]
    code, out, _ = run(capsys, "calibrate", str(folder), *refine)
    assert code == 0, out
    assert json.loads(result.read_text())["camera_frame"] == "front"
    assert json.loads(result.read_text())["reference_error"]["rotation_deg"] < 0.3

    code, out, _ = run(capsys, "convert", str(folder), str(tmp_path / "bag"))
    assert code == 0
    again = open_dataset(tmp_path / "bag")
    assert np.array_equal(again[2].cloud.xyz, street[2].cloud.xyz, equal_nan=True)
    assert again[1].stamp == street[1].stamp

    code, _, err = run(capsys, "info", str(folder), "--image-topic", "/image")
    assert code == 2
    assert "has no option image_topic" in err


def test_calibrate_writes_result_and_overlay(
    bag: Path, quick: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    initial = tmp_path / "initial.json"
    truth = open_dataset(str(bag)).reference
    Result(se3.perturb(truth, [1, -1, 1], [0.05, 0.05, -0.05]), "initial").save(initial)
    files = {"json": tmp_path / "result.json", "png": tmp_path / "overlay.png"}
    arguments = ["calibrate", str(bag), "--initial", str(initial), "--search-deg", "2", "--search-m", "0.1"]
    code, out, _ = run(capsys, *arguments, "--json", str(files["json"]), "--overlay", str(files["png"]))
    assert code == 0, out
    assert "static_transform_publisher" in out
    result = json.loads(files["json"].read_text())
    assert result["status"] == "converged"
    assert result["frames_used"] == 6
    assert len({frame["name"] for frame in result["frames"]}) == 6
    assert not any(frame["left_out"] for frame in result["frames"])
    assert f"search: {result['starts']['agreed']} of {result['starts']['climbed']} independent starts" in out
    assert "motion: points stay where they were measured (1 cm per ms at 10 m/s): the scans are 1 s apart" in out
    assert (result["camera_frame"], result["lidar_frame"]) == ("camera", "velodyne")
    assert result["reference_error"]["rotation_deg"] < 0.3
    assert result["reference_error"]["translation_m"] < 0.08
    error = se3.rotation_error_deg(truth, result["T_camera_lidar"])
    assert result["reference_error"]["rotation_deg"] == pytest.approx(error, abs=1e-6)
    assert cv2.imread(str(files["png"])).shape[1] >= 640

    # The result is a valid start, as YAML too; refining from there stays there.
    again = tmp_path / "again.yaml"
    refine = ["calibrate", str(bag), *quick, "--initial", str(files["json"]), "--search-deg", "0", "--search-m", "0"]
    refine += ["--json", str(again)]
    code, _, _ = run(capsys, *refine)
    assert code == 0
    second = yaml.safe_load(again.read_text())
    assert se3.rotation_error_deg(result["T_camera_lidar"], second["T_camera_lidar"]) < 0.03
    third = json.loads(run(capsys, *refine[:-1], "-")[1])
    assert third["status"] == "converged"
    assert third | {"elapsed_s": 0, "stamp": 0} == second | {"elapsed_s": 0, "stamp": 0}


def test_a_refusal_is_drawn_with_its_optimum_or_the_start_alone(drive: SyntheticDrive, tmp_path: Path) -> None:
    frame, T = drive[0], drive.reference
    off, path = se3.perturb(T, [0, 3, 0], [0, 0, 0]), tmp_path / "overlay.png"
    width, height = frame.camera.width, frame.camera.height

    def drawn(panels: int, result: Result) -> np.ndarray:
        """The last of so many panels."""
        draw(path, frame, Extrinsic(result), Config())
        picture, plan = cv2.imread(str(path)), layout(width, height, panels)
        assert picture.shape[:2] == plan.size[::-1]
        x, y = plan.panels[-1]
        return picture[y : y + height, x : x + width]

    found, start = drawn(2, Result(T, CONVERGED, initial=off)), drawn(2, Result(off, CONVERGED, initial=off))
    assert (drawn(2, Result(off, REFUSED, initial=off, optimum=T)) == found).all()
    assert (drawn(1, Result(off, INSUFFICIENT, initial=off)) == start).all()
    assert (found != start).any()


def test_not_converged_is_exit_code_1(bag: Path, quick: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Looking backwards nothing can match; the result is still written, with the reason and without an invented transform."""
    target = tmp_path / "result.json"
    arguments = ["calibrate", str(bag), "--yaw-deg", "180", "--search-deg", "1", "--search-m", "0.1", "--json", str(target)]
    code, _out, _ = run(capsys, *arguments, *quick)
    assert code == 1
    result = json.loads(target.read_text())
    assert result["status"] in ("refused", "insufficient")
    assert result["reason"]
    assert np.linalg.norm(result["translation_m"]) == 0  # the nominal start, not an estimate


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["info", "{tmp}/missing"], "missing"),
        (["info", "synthetic:rings=17"], "rings"),
        (["calibrate", "{bag}", "--frames", "0:99:x"], "--frames"),
        (["calibrate", "{bag}", "--initial", "{bad_json}"], "bad.json"),
        (["calibrate", "{bag}", "--config", "{bad_yaml}"], "line"),
        (["calibrate", "{bag}", "--overlay", "{out_of_range}/folder.png"], "--overlay"),
        (["calibrate", "{bag}", "--camera-info", "{tmp}/camera.yaml"], "give --intrinsics refine"),
        (["calibrate", "{bag}", "--intrinsics", "refine", "--camera-info", "{out_of_range}/camera.yaml"], "--camera-info"),
        (["calibrate", "{bag}", "--seed", "-4"], "search.seed"),
        (["calibrate", "{bag}", "--search-deg", "5,5"], "holds 2 numbers"),
        (["calibrate", "{bag}", "--fix", "rx,ry,rz,tx,ty,tz"], "nothing is left to estimate"),
        (["calibrate", "{bag}", "--bound", "rx=181"], "--bound rx=181 is out of range"),
        (["replay", "{bag}", "--time-offset-ms", "-90000"], "-90 is out of range [-60, 60]"),
        (["calibrate", "{bag}", "--time-offset", "guess"], "'guess' is no number; give estimate, fixed or seconds"),
        (["replay", "{bag}", "--initial", "motion"], "calibrate --initial motion"),
        (["replay", "{bag}", "--gif", "{tmp}"], "is a folder"),
        (["replay", "{bag}", "--rotation-only", "--bound", "tx=1"], "--bound tx=1 contradicts --rotation-only"),
        (["calibrate", "{bag}", "--objective", "magic"], "--objective"),
        (["convert", "{bag}", "{bag}"], "exists"),
        (["play", "{bag}", "--rate", "-1"], "rate"),
        (["play", "{tmp}/missing"], "{tmp}/missing"),
        (["play", "{tmp}"], "{tmp}"),
        (["export", "{tmp}"], "cannot read"),
        (["export", "{bad_json}"], "neither valid JSON nor YAML"),
        (["export", "{flipped}"], "damaged or edited"),
        (["export", "{state}", "--parent", "base"], "--parent"),
        (["export", "{state}", "--out", "/dev/full"], "No space left"),
        (["export"], "file"),
        (["models", "{bag}", "--image-classes", "source", "--frame", "6"], "--frame 6 is outside 0..5"),
        (["models", "{bag}", "--image-classes", "source", "--out", "{bad_yaml}"], "is a file, not a folder; name another"),
        (["models", "{bag}", "--image-classes", "source", "--out", "{bad_yaml}/x"], "cannot be made (Not a directory)"),
        (["models", "{bag}", "--config", "{tmp}/none.yaml"], "none.yaml"),
        (["models", "{bag}", "--config", "{misspelt}"], "image_class"),
        (["rig", "{tmp}/nowhere", "--rig", "{rig}"], "nowhere does not exist"),
        (["rig", "synthetic:rig=two_lidars_three_cameras", "--rig", "{tmp}/nothing.yaml"], "nothing.yaml"),
        (["rig", "synthetic:rig=two_lidars_three_cameras", "--rig", "{rig}", "--out", "x.txt"], "the ending tells the format"),
        (["rig", "synthetic:rig=two_lidars_three_cameras,frames=2", "--rig", "{rig}", "--frames", "7"], "position 7 is outside"),
        (["rig", "synthetic:", "--rig", "{rig}", "--write-rig", "x"], "leave one of them out"),
        (["rig", "{tmp}/nowhere"], "nowhere does not exist"),
        (["dance"], "dance"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line_and_exit_code_2(
    bag: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], arguments: list[str], text: str
) -> None:
    (tmp_path / "bad.json").write_text('{"T_camera_lidar": [[1, 0')
    (tmp_path / "bad.yaml").write_text("search:\n  rotation_deg: [1\n")
    (tmp_path / "range.yaml").write_text("search: {rotation_deg: 500.0}\n")
    (tmp_path / "misspelt.yaml").write_text("semantics: {image_class: source}\n")
    (tmp_path / "rig.yaml").write_text("reference: lidar_left\nsensors: {lidar_left: {kind: lidar}, front: {kind: camera}}\n")
    save_state(tmp_path / "state.json", Result(nominal(), CONVERGED), Camera(np.diag([70.0, 70, 1]), 96, 64))
    (tmp_path / "flipped.json").write_text((tmp_path / "state.json").read_text().replace('"lidar"', '"lidbr"'))
    names = {"tmp": tmp_path, "bag": bag, "out_of_range": tmp_path / "range.yaml"}
    names |= {name: tmp_path / f"{name}.json" for name in ("state", "flipped")}
    names |= {"bad_json": tmp_path / "bad.json", "bad_yaml": tmp_path / "bad.yaml", "misspelt": tmp_path / "misspelt.yaml"}
    names["rig"] = tmp_path / "rig.yaml"
    arguments = [argument.format(**names) for argument in arguments]
    try:
        code: object = main.main(arguments)
    except SystemExit as end:  # of argparse
        code = end.code
    out, err = capfd.readouterr()
    assert code == 2, err
    assert len(err.splitlines()) == 1, err
    assert text.format(**names) in err
    assert out == ""


def test_bad_input_of_a_process_is_one_line_and_exit_code_2(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "calib_ros", "info", "missing"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)})
    assert (done.returncode, done.stdout) == (2, "")
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert "missing" in done.stderr


def test_demo_leaves_foreign_files_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = tmp_path / "mine" / "bag"
    bag.mkdir(parents=True)
    (bag / "metadata.yaml").write_text("precious")
    code, _, err = run(capsys, "demo", "--out", str(tmp_path / "mine"))
    assert code == 2
    assert "no demo made" in err
    assert (bag / "metadata.yaml").read_text() == "precious"
    (tmp_path / "file").write_text("x")
    code, _, err = run(capsys, "demo", "--out", str(tmp_path / "file"))
    assert code == 2
    assert len(err.splitlines()) == 1
    assert run(capsys, "demo", "--out", str(tmp_path / "new"), "--seed", "-3")[0] == 2
    assert not (tmp_path / "new").exists()


def test_results_go_through_links_and_into_pipes(tmp_path: Path) -> None:
    result = Result(np.eye(4), "converged")
    (tmp_path / "link.json").symlink_to(tmp_path / "real.json")
    (tmp_path / "real.json").write_text("old")
    result.save(tmp_path / "link.json")
    assert (tmp_path / "link.json").is_symlink()
    assert json.loads((tmp_path / "real.json").read_text())["status"] == "converged"
    pipe = tmp_path / "pipe.json"
    os.mkfifo(pipe)
    got: list[str] = []
    reader = threading.Thread(target=lambda: got.append(pipe.read_text()))
    reader.start()
    result.save(pipe)
    reader.join(5)
    assert json.loads(got[0])["status"] == "converged"
    assert pipe.is_fifo()


def test_the_command_line_overrules_the_configuration(tmp_path: Path) -> None:
    """Before the parts are checked against each other: this file's optimiser fits the fast form only."""
    path = tmp_path / "c.yaml"
    path.write_text("refine: {objective: thesis, optimizer: levenberg_marquardt}\nsearch:\n")
    with pytest.raises(ConfigError, match="needs a gradient"):
        inputs.configuration(str(path))
    config = inputs.configuration(str(path), seed=7, objective="fast", threads=2)
    assert (config.refine.objective, config.refine.optimizer) == ("fast", "levenberg_marquardt")
    assert (config.search.seed, config.search.threads) == (7, 2)
    assert inputs.configuration(None, seed=7).search.threads == 1


# --- what is known of the extrinsic ----------------------------------------------------------------------------------------


def twist_of(result: dict[str, list[list[float]]], start: Path) -> np.ndarray:
    """(6,) deg and m that an estimate lies away from its start."""
    before = json.loads(start.read_text())["T_camera_lidar"]
    xi = se3.log(np.array(result["T_camera_lidar"]) @ se3.inverse(np.array(before)))
    return np.concatenate([np.rad2deg(xi[:3]), xi[3:]])


def test_replay_prints_a_line_per_estimate_and_keeps_constraints_between_them(
    bag: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    start, config, film = (tmp_path / name for name in ("start.json", "config.yaml", "drive.gif"))
    Result(se3.perturb(open_dataset(str(bag)).reference, [1.2, -1, 0.8], [0.02, -0.01, 0.02]), "initial").save(start)
    config.write_text(yaml.safe_dump({**QUICK, "online": {"min_keyframes": 5}}))
    code, out, _ = run(capsys, "replay", str(bag), "--initial", "reference", "--config", str(config))
    assert code == 0
    lines = [json.loads(line) for line in out.splitlines()]  # one per estimate
    assert [line["keyframes"] for line in lines] == [5, 6]
    assert lines[0]["advice"]["text"] == "keep driving: 0 of 5 further keyframes"
    assert lines[0]["advice"]["progress"] < lines[1]["advice"]["progress"] < 1
    assert lines[-1]["status"] == "tentative"  # as many keyframes again would confirm it
    assert lines[-1]["reference_error"]["rotation_deg"] < 0.3

    arguments = ["--initial", str(start), "--config", str(config), "--fix", "tx,ty,tz", "--bound", "rx=0.2", "--gif", str(film)]
    code, out, err = run(capsys, "replay", str(bag), *arguments)
    assert code in (0, 1), err
    lines = [json.loads(line) for line in out.splitlines()]
    assert len(lines) == 2
    for line in lines:  # not 0.2 deg further with each
        moved = twist_of(line, start)
        assert np.allclose(moved[3:], 0, atol=1e-9)
        assert abs(moved[0]) <= 0.2 + 1e-9
    assert film.read_bytes().startswith(b"GIF")


def test_constraints_go_into_the_configuration(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    path.write_text("constraints: {limit_deg: [5.0, 5.0, 5.0], sigma_m: [0.1, 0.1, 0.1]}\n")
    known = ConstraintOptions(True, ["rx"], [("ry", 2.0), ("rx", 0.0)], (0.0, 1.0, 2.0), None, -0.004)
    config = inputs.configuration(str(path), constraints=known)
    assert config.constraints.limit_deg == (0.0, 2.0, 5.0)
    assert config.constraints.limit_m == (0.0, 0.0, 0.0)
    assert config.constraints.sigma_deg == (0.0, 1.0, 2.0)
    assert config.constraints.sigma_m == (0.1, 0.1, 0.1)
    assert config.motion.time_offset_s == -0.004
    assert inputs.configuration(None, constraints=ConstraintOptions()) == Config()


@pytest.mark.parametrize(
    ("known", "text"),
    [
        (ConstraintOptions(fixed=["rx"], bounds=[("rx", 1.0)]), "--bound rx=1 contradicts --fix rx"),
        (ConstraintOptions(bounds=[("tz", 1.0), ("tz", 2.0)]), "--bound tz=2 contradicts --bound tz=1"),
        (ConstraintOptions(rotation_only=True, prior_m=(0.1, 0.1, 0.1)), "--prior-m: tx, ty, tz are fixed"),
        (ConstraintOptions(fixed=["rx"], prior_deg=(1.0, 2.0, 2.0)), "--prior-deg: rx is fixed"),
        (ConstraintOptions(rotation_only=True, fixed=["rx", "ry", "rz"]), "nothing is left"),
        (ConstraintOptions(time_offset=float("nan")), "out of range"),
    ],
)
def test_contradictory_constraints_are_refused(known: ConstraintOptions, text: str) -> None:
    with pytest.raises(BadInputError, match=text):
        known.apply_to(Config())
    with pytest.raises(BadInputError, match=r"no effect with motion\.deskew: off"):
        ConstraintOptions(time_offset=0.01).apply_to(Config(motion=MotionConfig(deskew="off")))


def test_refined_intrinsics_are_written_as_camera_info(
    street: list[Frame], quick: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The focal length is given 3 % too long. Looking backwards nothing can match, and no camera is written."""
    folder = vehicle(tmp_path / "vehicle", street[:4], changed(street[0].camera, FOCAL, 0.03))
    out, result, camera = tmp_path / "front.yaml", tmp_path / "result.json", street[0].camera
    refine = ["calibrate", str(folder), *quick, "--intrinsics", "refine", "--camera-info", str(out)]
    code, _, err = run(capsys, *refine, "--frames", "0", "--yaw-deg", "180", "--search-deg", "1", "--search-m", "0.1")
    assert code == 1
    assert f"{out} is not written: the estimate is " in err
    assert not out.exists()
    options = ["--initial", "reference", "--search-deg", "2", "--search-m", "0.15", "--json", str(result)]
    code, text, _ = run(capsys, *refine, *options)
    assert code == 0, text
    assert "refined intrinsics: fx " in text
    written = yaml.safe_load(out.read_text())
    assert (written["camera_name"], written["image_width"], written["image_height"]) == ("front", camera.width, camera.height)
    matrices = [written[f"{name}_matrix"] for name in ("camera", "rectification", "projection")]
    assert [(matrix["rows"], len(matrix["data"])) for matrix in matrices] == [(3, 9), (3, 9), (3, 12)]
    refined = load(result).refined_camera
    assert refined is not None
    assert refined.camera.K[0, 0] == pytest.approx(camera.K[0, 0], rel=0.01)
    assert refined.changes[FOCAL].value == pytest.approx(1 / 1.03 - 1, abs=0.01)
    # What reads such files understands it, down to the last bit.
    shutil.copy(out, folder / "calibration.yaml")
    assert open_dataset(folder).camera == refined.camera
    exact = vehicle(tmp_path / "exact", street[:4], camera)  # without any distortion
    code, text, _ = run(capsys, "calibrate", str(exact), *quick, *options[:-2], "--intrinsics", "refine")
    assert (code, "k1 0.0000 (+0.0000" in text) == (0, True), text


@pytest.mark.parametrize(
    ("known", "deg", "m", "says"),
    [
        ({"rotation_only": True}, (5.0, 5.0, 5.0), (0.0, 0.0, 0.0), None),
        ({"rotation_only": True}, None, (0.5, 0.5, 0.5), "--search-m: tx, ty, tz are fixed, so the search there must be 0"),
        ({"fixed": ["rx"]}, (5.0, 5.0, 5.0), None, None),  # one number means the axes that are free
        ({"fixed": ["rx"]}, (5.0, 5.0, 1.0), None, "--search-deg: rx is fixed"),
    ],
)
def test_a_search_along_fixed_axes(known: dict[str, Any], deg: Any, m: Any, says: str | None) -> None:
    with nullcontext() if says is None else pytest.raises(BadInputError, match=says):
        ConstraintOptions(**known).check_free("--search", deg, m, "the search")


def test_the_search_box() -> None:
    config = Config()
    plain = inputs.search_box("reference", config, None, None)
    assert plain.reach == (config.search.rotation_deg, config.search.translation_m)
    assert inputs.search_box("nominal", config, None, None).reach == NOMINAL_BOX.reach
    known = ConstraintOptions(rotation_only=True, bounds=[("ry", 2.0)]).apply_to(config)
    assert inputs.search_box("nominal", known, None, None) == SearchBox((10.0, 2.0, 10.0), (0.0, 0.0, 0.0))
    assert inputs.search_box("nominal", config, 0, 0).is_empty
    assert inputs.search_box("x.json", config, (1.0, 2.0, 3.0), None).rotation_deg == (1.0, 2.0, 3.0)


@pytest.mark.parametrize("yaw_deg", [180.0, pytest.param(90.0, marks=pytest.mark.slow)])
def test_side_and_rear_cameras(yaw_deg: float) -> None:
    """The edge of the scan by time runs through the middle of a rear camera's picture."""
    T = se3.perturb(nominal(yaw_deg), [2, -3, 1.5], np.zeros(3))
    T[:3, 3] = -T[:3, :3] @ [0.1, 0.2, -0.1]
    drive = SyntheticDrive(seed=3, frames=5, rings=32, width=480, height=180, speed=6.0, T_camera_lidar=T)
    result = calibrate(drive, "all", "nominal", yaw_deg, update(Config(), QUICK), None, None, None)
    assert result.status == CONVERGED, result.reason
    assert result.reference_error[0] < 0.4
    assert result.reference_error[1] < 0.06


# --- what a person reads ---------------------------------------------------------------------------------------------------


def test_summary_names_outlier_frames() -> None:
    names, scores = ("a", "b", "c", "d", "e"), (0.5, 0.24, float("nan"), 0.6, float("nan"))
    told = Result(np.eye(4), CONVERGED, frame_scores=scores, frame_names=names, frames_left_out=("c",), starts=(9, 180))
    lines = summary(told).splitlines()
    assert "search: 9 of 180 independent starts ended here" in lines
    assert "left out: c" in lines
    assert [line for line in lines if line.startswith("frame")] == [
        "frame b: score 0.240, median 0.500",
        "frame e: no edge points in sight, median 0.500",
    ]
    agreeing = summary(Result(np.eye(4), CONVERGED, frame_scores=(0.5, 0.6), frame_names=("a", "b")))
    assert not {"search", "left", "frame", "motion"} & {line.split()[0].rstrip(":") for line in agreeing.splitlines()}


def test_summary_says_which_scenes_show_what_is_not_known(drive: SyntheticDrive) -> None:
    unknown = np.diag(np.square([1e-4, 1e-4, 0.02, 1e-3, 1e-3, 1e-3]))
    refused = Result(np.eye(4), REFUSED, "why", refusal=RefusalCode.TOO_UNCERTAIN, optimum_covariance=unknown)
    line = "advice: not known well enough: roll; add frames that show edges at any distance towards the sides of the image"
    assert line in summary(refused, advice(refused, drive, Config())).splitlines()
    assert advice(replace(refused, refusal=RefusalCode.NOT_SIGNIFICANT), drive, Config()) == ""


def test_a_refusal_is_a_line_with_the_command_to_paste(drive: SyntheticDrive) -> None:
    given = ["calibrate", "drive", "--rectified", "--seed=1", "--search-deg", "1", "--json", "out.json", "--clock", "header"]

    def lines(initial: str, **told: Any) -> list[str]:
        args = Namespace(given=given, initial=initial, search_deg=1.0, search_m=0.1)
        wrong = told.get("cause") or told["refusal"]
        result = Result(np.eye(4), REFUSED, f"{wrong}; score 1", frame_names=("a",), **told)
        return summary(result, command=next_command(result, drive, Config(), args)).splitlines()

    wider = "refused: the optimum may be chance: calib-ros calibrate ... --search-deg 2 --search-m 0.2"
    whole = "calib-ros calibrate drive --rectified --seed=1 --clock header --search-deg 2 --search-m 0.2"
    assert lines("a b.json", refusal=RefusalCode.NOT_SIGNIFICANT)[:3] == [wider, f"next: {whole}", "score 1"]
    assert "--initial reference" in lines("nominal", refusal=RefusalCode.NOT_SIGNIFICANT)[1]
    apart = lines("nominal", refusal=RefusalCode.WRONG_TIMES, cause=Cause.TIME_OFFSET, refusal_figures={"seconds": 0.05})
    assert apart[0] == "refused: clocks apart: calib-ros calibrate ... --time-offset 0.05"
    first, view, *_ = lines("nominal", refusal=RefusalCode.NOT_SIGNIFICANT, cause=Cause.MIRRORED_IMAGE)
    assert (first, view) == (f"refused: {Cause.MIRRORED_IMAGE}", "next: calib-ros view drive --rectified --clock header")
    start = lines("a b.json", refusal=RefusalCode.WORSE_THAN_START)[0]
    assert start == "refused: no better extrinsic found: calib-ros check ... --extrinsic 'a b.json'"
    assert [more_frames(*counts) for counts in ((4, 8), (4, 100), (20, 100))] == ["--frames all", "--frames 0:100:5", ""]


def test_summary_gives_nobody_the_start_to_publish() -> None:
    kept, found = (summary(Result(np.eye(4), status, "nothing matches", initial=np.eye(4))) for status in (REFUSED, CONVERGED))
    assert "nothing matches" in kept
    publishing = "T_camera_lidar, the start", "static_transform_publisher", "from the start, --initial nominal"
    assert [[text in own for text in publishing] for own in (kept, found)] == [[True, False, False], [False, True, True]]


def test_summary_reports_deskewing(street: list) -> None:
    still = [replace(frame, twist=None) for frame in street]
    assert motion(street, MotionConfig()).endswith("in all frames, 2.9 to 3.0 m/s")
    moved = motion(street[:3] + still[:1], MotionConfig(time_offset_s=-0.004), "no scan")
    assert moved.endswith("in 3 of 4 frames, 3.0 to 3.0 m/s, time offset -4 ms; not in others: no scan")
    assert "m/s): no scan; the time offset has no effect" in motion(still, MotionConfig(time_offset_s=0.01), "no scan")
    assert "compensated already" in motion([replace(frame, compensated=True) for frame in still], MotionConfig())
    assert "motion.deskew: off" in motion(street, MotionConfig(deskew="off"))


def loaded(modules: set[str], *arguments: str) -> str:
    """Which of these modules a command has imported when it is done."""
    code = (
        "import sys; from calib_ros.cli.main import main\n"
        f"try: main({list(arguments)})\nexcept SystemExit: pass\n"
        f"print('LOADED', sorted({modules} & set(sys.modules)))"
    )
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.splitlines()[-1]


def test_commands_do_not_wait_for_heavy_libraries(street: list, tmp_path: Path) -> None:
    assert loaded({"numpy", "scipy", "cv2", "yaml", "rclpy"}, "--help") == "LOADED []"
    sample_sources.kitti(tmp_path, "odometry", street[:2])
    heavy = {"matplotlib", "rosbags", "onnxruntime", "scipy.stats", "scipy.optimize", "scipy.spatial", "scipy.sparse"}
    files = str(tmp_path), "--initial", "reference", "--search-deg", "1", "--json", str(tmp_path / "found.json")
    assert loaded(heavy | {"scipy.special"}, "calibrate", *files) == "LOADED []"
    assert json.loads((tmp_path / "found.json").read_text())["score"] is not None  # it has searched
    files = str(tmp_path), "--extrinsic", str(tmp_path / "found.json"), "--json", str(tmp_path / "checked.json")
    assert loaded(heavy, "check", *files) == "LOADED []"
    assert json.loads((tmp_path / "checked.json").read_text())["frames_used"] == 2


def test_a_missing_library_is_named_with_the_command_that_installs_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [name for name in sys.modules if name.startswith(("calib_ros.datasets.bag", "rosbags"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "rosbags", None)
    code, _, err = run(capsys, "convert", SOURCE, str(tmp_path / "bag"))
    assert (code, err) == (2, "calib-ros: 'convert' needs rosbags: python3 -m pip install rosbags\n")
