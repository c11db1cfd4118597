"""The command line as a user meets it: exit codes, files, one line for bad input."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from calib_ros import cli, open_source, se3
from calib_ros.errors import BadInputError
from calib_ros.result import Result
from calib_ros.sources import frame_positions

SOURCE = "synthetic:seed=1,frames=6,rings=32,width=640,height=192,speed=3"


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    code = cli.main(list(arguments))
    captured = capsys.readouterr()
    return code, captured.out, captured.err


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("cli") / "bag"
    assert cli.main(["convert", SOURCE, str(path), "--storage", "sqlite3"]) == 0
    return path


def test_info(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run(capsys, "info", str(bag))
    assert code == 0
    assert "640x192" in out
    assert "6 pairs" in out
    assert "/velodyne_points" in out


def test_calibrate_writes_result_and_overlay(bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    initial = tmp_path / "initial.json"
    truth = open_source(str(bag)).reference
    Result(se3.perturb(truth, [1, -1, 1], [0.05, 0.05, -0.05]), "initial").save(initial)
    files = {"json": tmp_path / "result.json", "png": tmp_path / "overlay.png"}
    arguments = ["calibrate", str(bag), "--initial", str(initial), "--search-deg", "2", "--search-m", "0.1"]
    code, out, _ = run(capsys, *arguments, "--json", str(files["json"]), "--overlay", str(files["png"]))
    assert code == 0, out
    assert "static_transform_publisher" in out
    result = json.loads(files["json"].read_text())
    expected = {
        "T_camera_lidar", "translation_m", "quaternion_xyzw", "camera_frame", "lidar_frame", "covariance", "score", "status",
        "reason", "frames_used", "elapsed_s", "reference_error", "stamp", "version",
    }  # fmt: skip
    assert set(result) == expected
    assert result["status"] == "converged"
    assert result["frames_used"] == 6
    assert (result["camera_frame"], result["lidar_frame"]) == ("camera", "velodyne")
    assert result["reference_error"]["rotation_deg"] < 0.3
    assert result["reference_error"]["translation_m"] < 0.08
    assert result["reference_error"]["rotation_deg"] == pytest.approx(
        se3.rotation_error_deg(truth, result["T_camera_lidar"]), abs=1e-6
    )
    assert cv2.imread(str(files["png"])).shape[1] >= 640

    # The result is a valid start, as YAML too; refining from there stays there.
    again = tmp_path / "again.yaml"
    refine = [
        "calibrate",
        str(bag),
        "--initial",
        str(files["json"]),
        "--search-deg",
        "0",
        "--search-m",
        "0",
        "--json",
        str(again),
    ]
    code, _, _ = run(capsys, *refine)
    assert code == 0
    second = yaml.safe_load(again.read_text())
    assert se3.rotation_error_deg(result["T_camera_lidar"], second["T_camera_lidar"]) < 0.03

    code, out, err = run(capsys, *refine[:-1], "-")
    assert json.loads(out)["status"] == "converged"
    assert "converged" in err


def test_same_command_same_bytes(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["calibrate", str(bag), "--initial", "nominal", "--frames", "0:6:2", "--seed", "3", "--json", "-"]
    first, second = (json.loads(run(capsys, *arguments)[1]) for _ in range(2))
    for result in (first, second):
        del result["elapsed_s"], result["stamp"]
    assert json.dumps(first) == json.dumps(second)


def test_not_converged_is_exit_code_1(bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Looking backwards nothing can match; the result is still written, with the reason and without an invented transform."""
    target = tmp_path / "result.json"
    arguments = ["calibrate", str(bag), "--yaw-deg", "180", "--search-deg", "1", "--search-m", "0.1", "--json", str(target)]
    code, _out, _ = run(capsys, *arguments)
    assert code == 1
    result = json.loads(target.read_text())
    assert result["status"] in ("refused", "insufficient")
    assert result["reason"]
    assert np.linalg.norm(result["translation_m"]) == 0  # the nominal start, not an estimate


def test_replay_prints_a_json_line_per_estimate(bag: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    config = tmp_path / "config.yaml"
    config.write_text("online: {min_keyframes: 3}\nsearch: {starts: 512, distinct: 16}\n")
    code, out, _ = run(capsys, "replay", str(bag), "--initial", "reference", "--config", str(config))
    assert code == 0
    lines = [json.loads(line) for line in out.splitlines()]
    assert [line["keyframes"] for line in lines] == [3, 4, 5, 6]
    assert lines[-1]["status"] == "converged"
    assert lines[-1]["reference_error"]["rotation_deg"] < 0.3


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["info", "{tmp}/missing"], "missing"),
        (["info", "{tmp}"], "{tmp}"),
        (["info", "synthetic:rings=17"], "rings"),
        (["calibrate", "{bag}", "--frames", "0:99:x"], "--frames"),
        (["calibrate", "{bag}", "--frames", "7"], "outside 0..5"),
        (["calibrate", "{bag}", "--initial", "{tmp}/none.json"], "none.json"),
        (["calibrate", "{bag}", "--initial", "{bad_json}"], "bad.json"),
        (["calibrate", "{bag}", "--config", "{bad_yaml}"], "line"),
        (["calibrate", "{bag}", "--config", "{out_of_range}"], "search.rotation_deg"),
        (["calibrate", "{bag}", "--search-deg", "400"], "rotation_deg"),
        (["calibrate", "{bag}", "--overlay", "{tmp}/no/such/folder.png"], "--overlay"),
        (["calibrate", "{bag}", "--seed", "-4"], "search.seed"),
        (["calibrate", "{bag}", "--objective", "magic"], "--objective"),
        (["convert", "{bag}", "{bag}"], "exists"),
        (["play", "{tmp}/missing"], "missing"),
        (["play", "{bag}", "--rate", "-1"], "rate"),
        (["dance"], "dance"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line_and_exit_code_2(bag: Path, tmp_path: Path, arguments: list[str], text: str) -> None:
    (tmp_path / "bad.json").write_text('{"T_camera_lidar": [[1, 0')
    (tmp_path / "bad.yaml").write_text("search:\n  rotation_deg: [1\n")
    (tmp_path / "range.yaml").write_text("search: {rotation_deg: 500.0}\n")
    names = {
        "tmp": tmp_path,
        "bag": bag,
        "bad_json": tmp_path / "bad.json",
        "bad_yaml": tmp_path / "bad.yaml",
        "out_of_range": tmp_path / "range.yaml",
    }
    arguments = [argument.format(**names) for argument in arguments]
    done = subprocess.run([sys.executable, "-m", "calib_ros", *arguments], capture_output=True, text=True)
    assert done.returncode == 2, done.stderr
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert text.format(**names) in done.stderr
    assert done.stdout == ""


def test_frame_positions() -> None:
    assert frame_positions("all", 3) == [0, 1, 2]
    assert frame_positions("0,2", 3) == [0, 2]
    assert frame_positions("1:9:3", 8) == [1, 4, 7]
    for text in ("", "a", "1,,2", "5:2", "-1", "1:2:3:4", "0:3:0"):
        with pytest.raises(BadInputError, match="--frames"):
            frame_positions(text, 3)


def test_mixing_calibrations_is_refused(kitti_root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = run(capsys, "calibrate", str(kitti_root / "object"), "--initial", "reference")
    assert code == 2
    assert "000000 and 000001" in err
    code, _, err = run(capsys, "calibrate", str(kitti_root / "object"), "--initial", "reference", "--frames", "1,2")
    assert code in (0, 1), err


def test_a_demo_does_not_touch_what_it_did_not_make(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
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
    import os
    import threading

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


def test_the_command_line_overrules_the_configuration(tmp_path):
    """Before the parts are checked against each other: this file's optimiser fits the fast form only."""
    from calib_ros.commands import configuration
    from calib_ros.errors import ConfigError

    path = tmp_path / "c.yaml"
    path.write_text("refine: {objective: thesis, optimizer: levenberg_marquardt}\nsearch:\n")
    with pytest.raises(ConfigError, match="needs a slope"):
        configuration(str(path))
    config = configuration(str(path), seed=7, objective="fast")
    assert (config.refine.objective, config.refine.optimizer, config.search.seed) == ("fast", "levenberg_marquardt", 7)
    assert configuration(None, None, "thesis").refine.objective == "thesis"
