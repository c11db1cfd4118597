"""Completion networks: what they are fed, what comes back, and which are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from onnx_graphs import completion, segmentation

from calib_ros.config import SemanticsConfig
from calib_ros.errors import BudgetError, ModelError
from calib_ros_semantics.models.completion import CompletionModel, completion_file
from calib_ros_semantics.models.onnx_model import Deadline

CONFIG = SemanticsConfig()
HEIGHT, WIDTH = 50, 70  # no multiples of 32


def run(path: Path, depth: np.ndarray, image: np.ndarray) -> np.ndarray:
    return CompletionModel(path, CONFIG)(depth.astype(np.float32), image.astype(np.uint8), Deadline(60))


def two_points() -> np.ndarray:
    depth = np.zeros((HEIGHT, WIDTH), np.float32)
    depth[20, 30], depth[HEIGHT - 1, WIDTH - 1] = 10.0, 7.0
    return depth


def grown(depth: np.ndarray) -> np.ndarray:
    """The largest value within 2 px, by hand."""
    wide = np.pad(depth, 2)
    return np.max([wide[y : y + depth.shape[0], x : x + depth.shape[1]] for y in range(5) for x in range(5)], axis=0)


@pytest.mark.parametrize("scale", [1.0, 256.0])
def test_depths_go_in_and_come_back_in_metres(tmp_path: Path, scale: float) -> None:
    """The border that makes the size a multiple of 32 is cut off again; the image is part of the sum by 0.01 of its level."""
    path = completion(tmp_path / "own.onnx", f"{{depth_scale: {scale}, scale: 1}}")
    image = np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH) % 200
    dense = run(path, two_points(), image)
    assert (dense.shape, dense.dtype) == ((HEIGHT, WIDTH), np.float32)
    np.testing.assert_allclose(dense, grown(two_points()) + 0.01 * image / scale, rtol=1e-5)


def test_inputs_are_told_apart_by_names_then_by_channels(tmp_path: Path) -> None:
    colours = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    colours[..., 0], colours[..., 2] = 50, 200  # BGR
    three = "guide 1 3 height width; sparse 1 1 height width", "x 1 1 height width; y 1 3 height width"
    for k, inputs in enumerate((*three, "lidar_depth 1 1 height width; im 1 3 height width")):
        for yaml, red in (("{depth_scale: 1, scale: 1}", 200), ("{depth_scale: 1, scale: 1, channels: bgr}", 50)):
            path = completion(tmp_path / f"{k}.onnx", yaml, inputs=inputs, channels=(0.01, 0, 0))
            np.testing.assert_allclose(run(path, two_points(), colours), grown(two_points()) + 0.01 * red, rtol=1e-5)
    # A grey network gets grey of a colour image, a colour one three times grey of a grey image.
    grey = completion(tmp_path / "grey.onnx")
    np.testing.assert_allclose(run(grey, two_points(), colours), grown(two_points()) + 0.66, atol=0.011)  # 0.299 R + 0.114 B
    both = completion(tmp_path / "both.onnx", inputs="depth 1 1 h w; image 1 3 h w", channels=(0.01, 0.01, 0.01))
    np.testing.assert_allclose(run(both, two_points(), colours[..., 0]), grown(two_points()) + 1.5, rtol=1e-5)


def test_a_network_of_one_size_gets_both_stretched(tmp_path: Path) -> None:
    """Points move with the image; of those that meet in a pixel the nearest stays."""
    twice = completion(tmp_path / "twice.onnx", inputs="depth 1 1 100 140; image 1 1 100 140", outputs="dense 1 1 100 140")
    dense = run(twice, two_points(), np.full((HEIGHT, WIDTH), 100))
    assert dense[20, 30] == pytest.approx(11.0)
    assert {tuple(p) for p in np.argwhere(dense > 8.5)} <= {(20 + y, 30 + x) for y in (-1, 0, 1) for x in (-1, 0, 1)}
    half = completion(tmp_path / "half.onnx", inputs="depth 1 1 25 35; image 1 1 25 35", outputs="dense 1 1 25 35")
    depth = np.zeros((HEIGHT, WIDTH), np.float32)
    depth[20, 30], depth[21, 31], depth[20, 31] = 30.0, 5.0, 60.0
    assert run(half, depth, np.zeros((HEIGHT, WIDTH)))[20, 30] == pytest.approx(5.0)
    sized = completion(tmp_path / "sized.onnx", "{depth_scale: 1, scale: 1, size: [100, 140]}")
    np.testing.assert_allclose(run(sized, two_points(), np.full((HEIGHT, WIDTH), 100)), dense, rtol=1e-6)


def test_what_is_no_depth_is_unknown(tmp_path: Path) -> None:
    path = completion(tmp_path / "odd.onnx", channels=(-0.01,))
    assert run(path, np.zeros((HEIGHT, WIDTH)), np.full((HEIGHT, WIDTH), 90)).max() == 0  # negative
    infinite = completion(tmp_path / "infinite.onnx", channels=(np.inf,))
    assert run(infinite, two_points(), np.full((HEIGHT, WIDTH), 90)).max() == 0
    assert run(infinite, two_points(), np.zeros((HEIGHT, WIDTH))).max() == 0  # 0 times infinity


def test_the_time_limit_holds(tmp_path: Path) -> None:
    model = CompletionModel(completion(tmp_path / "own.onnx"), CONFIG)
    with pytest.raises(BudgetError, match=r"semantics\.budget_s"):
        model(two_points(), np.zeros((HEIGHT, WIDTH), np.uint8), Deadline(0.0))


WRONG = {
    "takes sparse depth 1x1xHxW": {"inputs": "depth 1 2 h w; image 1 1 h w", "channels": (1.0,)},
    "cannot be told": {"inputs": "a 1 1 h w; im 1 1 h w"},
    "differ in size": {"inputs": "depth 1 1 64 64; image 1 1 1 64", "outputs": "dense 1 1 64 64"},
    "for inputs of 64x128 it gives 1x1x32x64": {"outputs": "dense 1 1 a b", "shrunk": 2},
    "which output is the dense depth": {"outputs": "dense 1 1 h w; confidence 1 1 h w"},
    "has no output 'depths'": {"yaml": "{depth_scale: 1, output: depths}"},
    "own.yaml, must say 'depth_scale:'": {"yaml": None},
    "must say 'depth_scale:', the units": {"yaml": "scale: 1"},
    "depth_scale = 0 must be a number above 0": {"yaml": "depth_scale: 0"},
    "'mean:' of the YAML beside it must have 1 or 1": {"yaml": "{depth_scale: 1, mean: [1, 2, 3]}"},
    "'size:' says": {"yaml": "{depth_scale: 1, size: [64, 64]}", "inputs": "depth 1 1 32 64; image 1 1 32 64"},
}


@pytest.mark.parametrize(("says", "own"), WRONG.items(), ids=list(WRONG))
def test_a_network_of_another_signature_is_refused(tmp_path: Path, says: str, own: dict) -> None:
    with pytest.raises(ModelError) as caught:
        CompletionModel(completion(tmp_path / "own.onnx", **own), CONFIG)
    text = str(caught.value)
    assert says in text
    assert "own." in text
    assert "\n" not in text


def test_files_of_other_kinds_are_refused(tmp_path: Path) -> None:
    classes = segmentation(tmp_path / "classes.onnx")
    classes.with_suffix(".yaml").write_text("depth_scale: 1")
    (tmp_path / "cut.onnx").write_bytes(classes.read_bytes()[:200])
    for path, says in ((classes, "takes sparse depth"), (tmp_path / "cut.onnx", "cannot be loaded"), (tmp_path, "a folder")):
        with pytest.raises(ModelError, match=says):
            CompletionModel(path, CONFIG)
    with pytest.raises(ModelError, match="no such file"):
        CompletionModel(completion_file("netwrok"), CONFIG)


def test_the_networks_of_the_package_say_what_they_are() -> None:
    text = CompletionModel(completion_file("network"), CONFIG).describe()
    assert text.startswith("completion network: ?x?, depth in 1/1 m, image grey, fed as v of grey levels v in 0..255")
