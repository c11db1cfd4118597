"""The result and its files: round trips and refusals."""

from __future__ import annotations

import itertools
import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
import yaml
from paths import FORMER_VERSION, ROOT

from calib_ros import io, se3
from calib_ros.camera import Camera
from calib_ros.cli.output import summary
from calib_ros.datasets.source import frame_positions
from calib_ros.errors import BadInputError
from calib_ros.intrinsics import IntrinsicEstimate, RefinedCamera
from calib_ros.io import write_atomically
from calib_ros.online.state import load_state, read_state
from calib_ros.result import CONVERGED, INSUFFICIENT, REFUSED, VERSION, Evidence, RefusalCode, Result, load, parse

T = se3.exp([0.1, -1.2, 0.9, 0.27, -0.05, -1e-7])
COVARIANCE = np.diag([1e-6, 2e-6, 3e-6, 1e-4, 2e-4, 3e-4])
RESULT = Result(
    *(T, CONVERGED, "frame 3 left out: état", 0.7251, COVARIANCE, 12, "cam_2", "velo", 1.23456),
    initial=np.eye(4),
    frame_scores=(0.7, math.nan, math.nan),
    frame_names=("a", "b", "c"),
    frames_left_out=("b",),
    starts=(3, 60),
    reference_error=(0.05, 0.012),
)


def same(a: Result, b: Result) -> None:
    assert np.allclose(a.T_camera_lidar, b.T_camera_lidar, atol=1e-12)
    assert (a.covariance is None) == (b.covariance is None)
    if a.covariance is not None:
        assert np.array_equal(a.covariance, b.covariance)
    assert a.score == b.score or (math.isnan(a.score) and math.isnan(b.score))
    for name in ("status", "reason", "frames_used", "camera_frame", "lidar_frame", "stamp"):
        assert getattr(a, name) == getattr(b, name), name


def test_files_of_the_former_version_still_load() -> None:
    for name in ("result.json", "result.yaml"):
        result = load(FORMER_VERSION / name)
        told = (result.status, result.frames_used, result.camera_frame, result.lidar_frame)
        assert told == ("converged", 6, "camera", "velodyne")
        assert se3.translation_error_m(np.eye(4), result.T_camera_lidar) == pytest.approx(0.3165, abs=1e-3)
        assert result.covariance is not None
        assert np.all(np.linalg.eigvalsh(result.covariance) > 0)
    path = FORMER_VERSION / "state.json"
    state = read_state(path)
    assert state.camera is not None
    result = load_state(path, state.camera, "camera", "velodyne")
    assert (result.status, result.frames_used) == ("converged", 6)
    np.testing.assert_allclose(result.T_camera_lidar, load(FORMER_VERSION / "result.json").T_camera_lidar, atol=1e-12)
    assert state.provenance is not None
    assert (state.provenance["accepted"], state.provenance["keyframes"]) == (4, 9)


def test_files_give_back_what_was_saved(tmp_path):
    for result, name in itertools.product(
        (RESULT, Result(np.eye(4), REFUSED, "why: not"), Result(T, INSUFFICIENT, score=1e-20)),
        ("result.json", "result.yaml", "result.YML", "result"),
    ):
        path = tmp_path / "new folder" / name
        result.save(path)
        same(load(path), result)
        assert path.read_text(encoding="utf-8").startswith("{") == (not name.lower().endswith(("yaml", "yml")))


def test_a_refused_optimum_is_written_beside_the_start():
    refused = Result(np.eye(4), REFUSED, "too far", refusal=RefusalCode.TOO_FAR_FROM_START, optimum=T)
    data = json.loads(refused.dumps())
    assert (data["refusal"], data["optimum"]) == ("too_far_from_start", T.tolist())
    assert np.array_equal(data["T_camera_lidar"], np.eye(4))
    data = json.loads(RESULT.dumps())
    assert (data["refusal"], data["optimum"]) == (None, None)
    assert {code.value for code in RefusalCode} <= set(re.findall(r"`(\w+)`", (ROOT / "docs/result.md").read_text()))


def test_the_format_is_the_documented_one():
    data = json.loads(RESULT.dumps())
    assert list(data) == [
        *("T_camera_lidar", "translation_m", "quaternion_xyzw", "camera_frame", "lidar_frame", "covariance"),
        *("covariance_with_intrinsics", "time_offset_s", "time_offset_sigma_s", "stamping", "score", "status", "reason"),
        *("refusal", "cause", "refusal_figures", "optimum", "evidence", "intrinsics", "frames_used", "frames", "starts"),
        *("elapsed_s", "reference_error", "stamp", "version"),
    ]
    assert np.array_equal(data["T_camera_lidar"], T)
    assert data["translation_m"] == T[:3, 3].tolist()
    assert np.allclose(se3.rotation_from_quaternion(data["quaternion_xyzw"]), T[:3, :3])
    assert data["reference_error"] == {"rotation_deg": 0.05, "translation_m": 0.012}
    assert (data["elapsed_s"], data["frames_used"], data["version"]) == (1.235, 12, VERSION)
    assert data["frames"] == [
        {"name": "a", "score": 0.7, "left_out": False},
        {"name": "b", "score": None, "left_out": True},
        {"name": "c", "score": None, "left_out": False},
    ]
    assert data["starts"] == {"agreed": 3, "climbed": 60}
    first, second = Result(T, CONVERGED).stamp, Result(T, CONVERGED).stamp
    assert first.endswith("+00:00")
    assert first <= second
    bare = Result(T, CONVERGED).to_dict()
    assert (bare["frames"], bare["starts"], bare["evidence"]) == ([], None, None)
    evidence = Evidence(7.3, 3.5, 0.003, 1.2, 2.5)
    told = {"z_score": 7.3, "decoy_z_score": 3.5, "p_value": 0.003, "disagreement": 1.2, "scenes": 2.5}
    assert replace(RESULT, evidence=evidence).to_dict()["evidence"] == told
    unseen = replace(RESULT, intrinsics={"focal_length_share": IntrinsicEstimate(0.0, math.inf, False)})
    assert unseen.to_dict()["intrinsics"] == {"focal_length_share": {"value": 0.0, "sigma": None, "observable": False}}
    assert yaml.safe_load(RESULT.dumps(yaml_format=True)) == data


def test_scores_that_are_no_number_become_null():
    for score in (math.nan, math.inf, -math.inf):
        text = Result(np.eye(4), REFUSED, "x", score).dumps()
        data = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
        assert data["score"] is data["covariance"] is data["reference_error"] is None
        assert math.isnan(parse(text, "x").score)


def test_partial_results_are_read():
    q = se3.quaternion_from_rotation(T[:3, :3]).tolist()
    result = parse(yaml.safe_dump({"translation_m": T[:3, 3].tolist(), "quaternion_xyzw": [3 * v for v in q]}), "x")
    assert np.allclose(result.T_camera_lidar, T)
    assert (result.camera_frame, result.lidar_frame, result.frames_used) == ("camera", "lidar", 0)
    assert result.covariance is None
    assert math.isnan(result.score)
    by_hand = parse("\ufeffT_camera_lidar:\n- [0, -1, 0, 1e-3]\n- [0, 0, -1, 2]\n- [1, 0, 0, -.5]\n- [0, 0, 0, 1]\n", "x")
    assert by_hand.T_camera_lidar.tolist() == [[0, -1, 0, 1e-3], [0, 0, -1, 2], [1, 0, 0, -0.5], [0, 0, 0, 1]]


EYE = json.dumps(np.eye(4).tolist())
GARBAGE = {
    "": "holds no result",
    "{": "neither valid JSON nor YAML",
    '{"a":' * 50000: "neither valid",
    '{"translation_m": [1, 2, 3]}': "needs T_camera_lidar",
    f'{{"T_camera_lidar": {EYE.replace("1.0", "9" * 400)}}}': "T_camera_lidar in x",
    f'{{"T_camera_lidar": {EYE.replace("1.0", "2.0")}}}': "not a rigid transform",
    "T_camera_lidar: &a [*a]": "neither valid",
    '{"translation_m": 5, "quaternion_xyzw": [0, 0, 0, 1]}': "x: translation_m must be 3",
    f'{{"translation_m": [1, 2, {"9" * 400}], "quaternion_xyzw": [0, 0, 0, 1]}}': "x: translation_m must be 3",
    '{"translation_m": [1, 2, 3], "quaternion_xyzw": [0, 0, 0, 0]}': "x: quaternion .* no rotation",
    f'{{"T_camera_lidar": {EYE}, "covariance": [[1, 2], [3, 4]]}}': "covariance must be a finite 6x6",
    f'{{"T_camera_lidar": {EYE}, "score": "good"}}': "must be numbers",
    f'{{"T_camera_lidar": {EYE}, "frames_used": 1e999}}': "must be numbers",
    f'{{"T_camera_lidar": {EYE}, "frames_used": 4294967296}}': "frames_used",
    f'{{"T_camera_lidar": {EYE}, "camera_frame": {{"a": 1}}}}': "camera_frame",
    f'{{"T_camera_lidar": {EYE}, "stamping": "fast"}}': "stamping must have a spin",
    f'{{"T_camera_lidar": {EYE}, "stamping": {{"spin": "clockwise", "azimuth_deg": 400}}}}': "stamping must have a spin",
}


def test_garbage_is_refused_in_one_line():
    for text in GARBAGE:
        with pytest.raises(BadInputError, match=GARBAGE[text]) as caught:
            parse(text, "x")
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("yaml_format", [False, True], ids=["json", "yaml"])
def test_a_file_cut_off_anywhere_is_refused_or_whole(yaml_format):
    text = RESULT.dumps(yaml_format)
    accepted = []
    for end in range(0, len(text), 3):
        try:
            result = parse(text[:end], "x")
        except BadInputError:
            continue
        accepted.append(end)
        assert np.allclose(result.T_camera_lidar, T, atol=1e-12)  # never a transform of half the digits
    assert yaml_format == bool(accepted[2:])  # JSON is whole or refused; of YAML, the end may be missing


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(BadInputError, match=r"cannot read .*none"):
        load(tmp_path / "none")
    with pytest.raises(BadInputError, match="cannot read"):
        load(tmp_path)
    (tmp_path / "binary").write_bytes(b"\x80\x81\xff")
    with pytest.raises(BadInputError, match="not a text file"):
        load(tmp_path / "binary")


# --- atomic files ---------------------------------------------------------------------------------------------------------


FULL = OSError(28, "No space left on device")


@pytest.mark.parametrize(
    ("step", "raised", "expected"),
    [*((step, FULL, BadInputError) for step in ("fsync", "replace", "chmod")), ("fsync", KeyboardInterrupt(), KeyboardInterrupt)],
)
def test_failed_or_interrupted_write_keeps_the_old_file(tmp_path, monkeypatch, step, raised, expected):
    path = tmp_path / "file"
    write_atomically(path, b"old")

    def failing(*_: object) -> None:
        raise raised

    monkeypatch.setattr(io.os, step, failing)
    with pytest.raises(expected):
        write_atomically(path, b"new")
    monkeypatch.undo()
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


# --- text for people ------------------------------------------------------------------------------------------------------


def test_summary_content():
    text = summary(RESULT)
    assert "converged: 12 frames, score 0.725" in text
    assert "frame 3 left out" in text
    assert "rx 0.06 ry 0.08 rz 0.10 deg, x 1.0 y 1.4 z 1.7 cm" in text
    assert "reference: 0.050 deg, 1.2 cm" in text
    assert f"moved {se3.rotation_error_deg(np.eye(4), T):.2f} deg, {100 * np.linalg.norm(T[:3, 3]):.1f} cm" in text
    command = text.splitlines()[-1]
    # A tf2 publisher's parent is the frame that points are mapped into.
    assert "--frame-id cam_2 --child-frame-id velo" in command


@pytest.mark.parametrize(
    ("text", "chosen"),
    [
        *(("all", range(10)), ("0,4,8", [0, 4, 8]), (" 3 , 1", [3, 1]), ("0:10:5", [0, 5]), (":2", [0, 1])),
        *(("8:100", [8, 9]), ("-2:", [8, 9]), ("::-4", [9, 5, 1])),
        *((text, None) for text in ("", "x", "1.5", "1,,2", "0:1:0", "1:2:3:4", "10", "-1", "5:5", "20:30", "all,1", "2,0,2")),
    ],
)
def test_frame_choices(text, chosen):
    if chosen is not None:
        assert frame_positions(text, 10) == list(chosen)
    else:
        with pytest.raises(BadInputError, match="--frames"):
            frame_positions(text, 10)


def test_a_refined_camera_is_read_as_it_was_written(tmp_path):
    camera = Camera(np.array([[700.0, 0, 630], [0, 690, 370], [0, 0, 1]]), 1280, 720, D=np.array([-0.3, 0.1, 1e-3, 5e-4, 0.0]))
    changes = {"focal_length_share": IntrinsicEstimate(0.03, 0.001, True), "k1": IntrinsicEstimate(0.0, math.inf, False)}
    refined = RefinedCamera(camera, T, changes, np.diag(np.arange(1.0, 9.0)))
    for name in ("result.json", "result.yaml"):
        replace(RESULT, refined_camera=refined).save(tmp_path / name)
        again = load(tmp_path / name).refined_camera
        assert again.camera == camera
        assert dict(again.changes) == changes
        assert np.array_equal(again.covariance, refined.covariance)
        assert np.allclose(again.T_camera_lidar, T, atol=1e-12)
    assert "refined_camera" not in RESULT.to_dict()


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (3, "must hold width"),
        ({"K": 1}, "K must be a finite 3x3 matrix"),
        ({"changes": [1]}, "must hold width"),
        ({"K": np.zeros((3, 3)).tolist()}, "must be positive"),
        ({"joint_covariance": [[1.0]]}, "six rows and one for each change"),
        ({"T_camera_lidar": None}, "T_camera_lidar of refined_camera"),
    ],
)
def test_a_damaged_refined_camera_is_named(wrong, says):
    camera = Camera(np.array([[700.0, 0, 630], [0, 690, 370], [0, 0, 1]]), 1280, 720)
    good = replace(RESULT, refined_camera=RefinedCamera(camera, T, {}, np.eye(6))).to_dict()
    bad = {**good, "refined_camera": {**good["refined_camera"], **wrong} if isinstance(wrong, dict) else wrong}
    with pytest.raises(BadInputError, match=re.escape(says)):
        parse(json.dumps(bad), "result.json")
