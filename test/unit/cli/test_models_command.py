"""`calib-ros models`: its output, pictures and exit codes."""

from __future__ import annotations

import re
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import onnxruntime
import pytest
import yaml
from onnx_graphs import endless, failing, range_network, segmentation
from sam_graphs import official_decoder, raw_encoder

from calib_ros.cli import main
from calib_ros.frame import Frame, PointCloud
from calib_ros.frame import SemanticClass as C
from calib_ros_semantics.class_pictures import COLORS, UNKNOWN, classes_on_image, cloud_from_above
from calib_ros_synthetic.drive import SyntheticDrive

pytestmark = pytest.mark.usefixtures("rendered_once")
SOURCE = "synthetic:seed=31,frames=2,rings=32,width=640,height=240"
SMALL = "synthetic:seed=31,frames=2,rings=16,width=320,height=120"
CHANNELS = ([12.12, 10.88, 0.23, -1.04, 0.21], [12.32, 11.47, 6.91, 0.86, 0.16])  # as of SemanticKITTI; any would do here


@pytest.fixture(scope="module")
def drive() -> SyntheticDrive:
    return SyntheticDrive.from_text(SOURCE)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory, drive: SyntheticDrive) -> Path:
    """Models of every kind, good and bad."""
    folder = tmp_path_factory.mktemp("models")
    raw_encoder(folder / "encoder.onnx")
    official_decoder(folder / "decoder.onnx")
    segmentation(folder / "net.onnx", 19, outputs=[("scores", [1, 19, 256, 512])])
    range_network(folder / "range.onnx", np.linspace(-20, 20, 20), 3, *CHANNELS)
    endless(folder / "endless.onnx")
    failing(folder / "failing.onnx")
    (folder / "cut.onnx").write_bytes((folder / "net.onnx").read_bytes()[:300])
    (folder / "masks" / "000001").mkdir(parents=True)
    for k, cls in enumerate((C.VEHICLE, C.BUILDING, C.POLE)):
        cv2.imwrite(str(folder / "masks" / "000001" / f"{k}.png"), 255 * (drive[1].classes == cls).astype(np.uint8))
    return folder


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    code = main.main(["models", *map(str, arguments)])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def parts(out: str) -> dict[str, list[str]]:
    """The lines of each kind of model."""
    blocks = [block.splitlines() for block in out.strip().split("\n\n")[1:]]
    return {block[0].partition(":")[0]: [line.strip() for line in block] for block in blocks}


def test_every_kind_is_tried_and_shown(capsys, files, tmp_path, drive, monkeypatch):
    # These networks see brightness and height.
    monkeypatch.setattr("calib_ros_semantics.cli.judge", lambda model, answer: ("", ""))
    out_folder = tmp_path / "deep" / "out"
    code, out, err = run(
        *(capsys, SOURCE, "--frame", 1, "--out", out_folder),
        *("--segment-anything", files / "masks", "--image-classes", files / "net.onnx", "--cloud-classes", files / "range.onnx"),
    )
    assert (code, err) == (0, "")
    assert out.splitlines()[0] == f"tried on frame 000001: 640x240, {len(drive[1].cloud)} points"
    found = parts(out)
    assert list(found) == ["segment_anything", "image_classes", "cloud_classes"]
    for kind, lines in found.items():
        timing = next(line for line in lines if line.startswith("loaded in"))
        loaded, first, best = map(float, re.findall(r"([\d.]+) s", timing)[:3])
        assert 0 <= best <= first < 30 > loaded
        assert any(line.startswith("1 thread, at most") for line in lines)
        assert f"picture: {out_folder / kind}.png" in lines
    assert any(re.fullmatch(r"boundaries on [1-9][\d.]* % of the pixels", line) for line in found["segment_anything"])
    for kind, things in (("image_classes", "pixels: "), ("cloud_classes", "points: ")):
        (listed,) = re.findall(things + r"((?:\w+ [\d.]+ %,? ?)+)", " ".join(found[kind]))  # of several lines, if need be
        shares = [float(text) for text in re.findall(r"([\d.]+) %", listed)]
        assert shares == sorted(shares, reverse=True)
        assert sum(shares) == pytest.approx(100, abs=0.1 * len(shares))
    assert found["image_classes"][-1] == f"picture: {out_folder}/class_borders.png"
    assert any("segmentation network" in line and "fed as (v / 255 - [" in line for line in found["image_classes"])
    assert "19 classes, on cpu" in " ".join(found["image_classes"])
    # The range image is that of another scanner, which is worth a word.
    (note,) = (line for line in found["cloud_classes"] if line.startswith("NOTE: "))
    assert "range.onnx takes 1024 columns per turn" in note
    for kind, size in (("segment_anything", 640), ("image_classes", 640), ("class_borders", 640), ("cloud_classes", 900)):
        assert cv2.imread(str(out_folder / f"{kind}.png")).shape[1] == size


def test_labels_of_the_source_are_shown(capsys, tmp_path, drive):
    code, out, _ = run(capsys, SOURCE, "--image-classes", "source", "--cloud-classes", "source", "--out", tmp_path)
    assert code == 0
    share = 100 * np.mean(drive[0].classes == C.GROUND)
    assert f"ground {share:.1f} %" in next(line for line in out.splitlines() if "pixels: " in line)
    picture = cv2.imread(str(tmp_path / "image_classes.png"))
    assert np.array_equal(picture, classes_on_image(drive[0], drive[0].classes))
    assert np.array_equal(cv2.imread(str(tmp_path / "cloud_classes.png")), cloud_from_above(drive[0], drive[0].cloud.label))


@pytest.mark.skipif("CUDAExecutionProvider" in onnxruntime.get_available_providers(), reason="CUDA is here")
def test_configuration_is_used_and_fallback_reported(capsys, files, tmp_path, monkeypatch):
    monkeypatch.setattr("calib_ros_semantics.cli.judge", lambda model, answer: ("", ""))
    semantics = {"image_classes": str(files / "net.onnx"), "cloud_classes": "", "provider": "cuda", "threads": 2, "budget_s": 7.0}
    (tmp_path / "own.yaml").write_text(yaml.safe_dump({"semantics": semantics}))
    code, out, _ = run(capsys, SMALL, "--config", tmp_path / "own.yaml")
    assert code == 0
    found = parts(out)
    assert list(found) == ["image_classes"]
    assert "NOTE: onnxruntime has no cuda here: net.onnx runs on cpu" in found["image_classes"]
    assert any(line.startswith("2 threads, ") for line in found["image_classes"])
    assert "of the budget of 7 s" in out
    code, out, _ = run(capsys, SMALL, "--config", tmp_path / "own.yaml", "--image-classes", "source")
    assert "image_classes: source" in out


def test_failing_model_is_reported_and_the_others_are_tried(capsys, files, tmp_path, monkeypatch):
    (tmp_path / "short.yaml").write_text("semantics: {budget_s: 0.3}\n")
    for name, text, more in (
        ("none.onnx", "there is no such file", ()),
        ("cut.onnx", "cannot be loaded", ()),
        ("failing.onnx", "failing.onnx failed: ", ()),
        ("decoder.onnx", "decoder.onnx", ()),
        ("endless.onnx", "(semantics.budget_s); run it at a smaller size", ("--config", tmp_path / "short.yaml")),
    ):
        code, out, err = run(capsys, SMALL, "--image-classes", files / name, "--cloud-classes", "source", *more)
        assert (code, err.count("\n")) == (2, 1), name
        assert err.startswith("calib-ros: semantics.image_classes: "), name
        assert text in err, name
        found = parts(out)
        assert list(found) == ["cloud_classes"], name
        assert any(line.startswith("points: ") for line in found["cloud_classes"]), name
    code, _, err = run(capsys, SMALL, "--segment-anything", files / "encoder.onnx", "--cloud-classes", "")
    assert code == 2
    assert "set semantics.segment_anything_decoder" in err
    lines = Mock(side_effect=ValueError("two lines\nof somebody's library"))
    monkeypatch.setattr("calib_ros_semantics.models.image_classes.ImageNetwork.__call__", lines)
    code, out, err = run(capsys, SMALL, "--image-classes", files / "net.onnx", "--cloud-classes", "source")
    assert (code, err) == (2, "calib-ros: semantics.image_classes: unexpected ValueError: two lines of somebody's library\n")
    assert any(line.startswith("points: ") for line in parts(out)["cloud_classes"])


def test_classes_that_cannot_be_right_are_told(capsys, files, drive):
    code, out, err = run(capsys, SOURCE, "--image-classes", "source", "--cloud-classes", files / "range.onnx")
    assert (code, err.count("\n")) == (1, 1)
    assert err.startswith(f"calib-ros: semantics.cloud_classes, {files / 'range.onnx'}: its classes are implausible: ")
    assert "points: " in out, "what it found is shown all the same"


def test_empty_segmentation_is_explained(capsys, files):
    (files / "few.yaml").write_text("semantics: {prompt_grid: 3}\n")
    pair = ("--segment-anything", files / "encoder.onnx", "--segment-anything-decoder", files / "decoder.onnx")
    code, out, _ = run(capsys, SMALL, *pair, "--config", files / "few.yaml")
    assert code == 0
    assert "boundaries on 0.0 % of the pixels: there was no mask, or none with what it needs, a predicted IoU of 0.88" in out
    description = [line for line in parts(out)["segment_anything"] if "Segment Anything (samexporter)" in line]
    assert len(description) == 1
    assert max(map(len, out.splitlines())) < 130


# --- pictures -------------------------------------------------------------------------------------------------------------


def test_pictures_show_classes_where_they_are(drive) -> None:
    frame = drive[0]
    classes = np.full(frame.image.shape[:2], C.GROUND, np.uint8)
    classes[:, 320:] = C.SKY
    grey = Frame(np.full_like(frame.image, 100), frame.cloud, frame.camera)
    picture = classes_on_image(grey, classes)
    assert picture.shape == (266, 640, 3)
    for u, own in ((100, C.GROUND), (500, C.SKY)):
        assert np.abs(picture[120, u] - (0.45 * 100 + 0.55 * np.array(COLORS[own]))).max() < 1.5
    names = {tuple(p) for p in picture[240:].reshape(-1, 3).tolist()}
    assert {COLORS[C.GROUND], COLORS[C.SKY]} <= names
    assert not {COLORS[C.VEHICLE], UNKNOWN} & names


def test_rare_classes_lie_on_top_from_above(drive) -> None:
    """A pole on the ground, ahead and to the left; what did not return is nowhere."""
    spot = np.repeat([[20.0, 10, 0]], 30, axis=0)
    xyz = np.r_[spot[:1], spot, [[np.nan] * 3]].astype(np.float32)
    label = np.array([C.POLE, *[C.GROUND] * 30, C.VEHICLE], np.uint8)
    picture = cloud_from_above(Frame(drive[0].image, PointCloud(xyz), drive[0].camera), label)
    v, u = np.argwhere((picture[:900] == COLORS[C.POLE]).all(axis=2)).mean(axis=0)
    assert (u, v) == pytest.approx((450 - 450 / 4, 450 - 450 / 2), abs=2)
    assert not (picture[:900] == COLORS[C.GROUND]).all(axis=2).any()
    assert not (picture == COLORS[C.VEHICLE]).all(axis=2).any()
