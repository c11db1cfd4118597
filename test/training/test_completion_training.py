"""The completion network's scenes, training and export. Tests that need PyTorch are skipped without it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from paths import ROOT

sys.path.insert(0, str(ROOT))  # training/ is no part of the installed package

from calib_ros.config import SemanticsConfig
from calib_ros_semantics.models.completion import CompletionModel
from calib_ros_semantics.models.onnx_model import Deadline
from training.completion import scenes

SEED, NUMBER = 1, 3  # a town through a small camera
NO_TORCH = "training needs PyTorch: see training/README.md"


@pytest.fixture(scope="module")
def scene() -> scenes.Scene:
    found = scenes.scene_of(SEED, NUMBER)
    assert found is not None
    return found


def test_a_scan_measures_the_depths_of_the_picture(scene) -> None:
    """But for noise, what lies in between the pixels, and points that the camera does not see."""
    both = (scene.sparse > 0) & (scene.dense > 0)
    assert both.sum() > 3000
    ratio = scene.sparse[both] / scene.dense[both]
    assert abs(np.median(ratio) - 1) < 0.002
    assert np.mean(np.abs(ratio - 1) < 0.03) > 0.85
    assert 0.01 < np.mean(scene.sparse > 0) < 0.3
    assert scene.dense.max() <= scenes.FARTHEST
    again = scenes.scene_of(SEED, NUMBER)
    assert again is not None
    assert all(np.array_equal(a, b) for a, b in zip(scene, again, strict=True))


def test_scenes_are_files_that_are_written_once(tmp_path: Path, scene) -> None:
    for kind in scenes.KINDS:
        (tmp_path / kind).mkdir()
    assert scenes.write(tmp_path, SEED, NUMBER)
    assert not scenes.write(tmp_path, SEED, NUMBER)
    assert scenes.numbers_in(tmp_path) == [NUMBER]
    found = scenes.read(tmp_path, NUMBER)
    assert np.array_equal(found.image, scene.image)
    for a, b in ((found.sparse, scene.sparse), (found.dense, scene.dense)):
        np.testing.assert_allclose(a, b, atol=0.5 / scenes.UNITS + 1e-6)
    (tmp_path / "dense" / f"{NUMBER:06}.png").unlink()
    with pytest.raises(FileNotFoundError, match="no rendered scenes"):
        scenes.numbers_in(tmp_path)
    (tmp_path / "seed.txt").write_text("seed 7\n")
    with pytest.raises(ValueError, match="holds scenes of seed 7"):
        scenes.render(tmp_path, SEED, [], 1)


@pytest.fixture(scope="module")
def torch() -> Any:
    return pytest.importorskip("torch", reason=NO_TORCH)


def test_an_untrained_network_spreads_what_was_measured(torch, tmp_path: Path) -> None:
    """Already before the training; and its file gives the same."""
    from training.completion.__main__ import compare, export
    from training.completion.network import CompletionNetwork

    torch.manual_seed(0)
    network, file = CompletionNetwork().fuse(), tmp_path / "own.onnx"
    sparse, image = np.zeros((64, 96), np.float32), np.full((64, 96), 90, np.uint8)
    sparse[::6, ::6] = 20.0
    export(network, file)
    compare(network, file, tuple(torch.from_numpy(a.astype(np.float32))[None, None] for a in (image, sparse, sparse)))
    dense = CompletionModel(file, SemanticsConfig())(sparse, image, Deadline(60))
    np.testing.assert_allclose(dense, 20.0, rtol=0.01)


def test_training_lowers_the_loss(torch, tmp_path: Path, scene) -> None:
    from training.completion.__main__ import loss_of, train, whole
    from training.completion.network import CompletionNetwork

    for kind in scenes.KINDS:
        (tmp_path / kind).mkdir()
    scenes.write(tmp_path, SEED, NUMBER)
    image, sparse, dense = whole(scenes.read(tmp_path, NUMBER))
    torch.manual_seed(1)  # as the training does: it begins with this network
    networks = CompletionNetwork().fuse(), train(tmp_path, [NUMBER], 40, 1)
    with torch.inference_mode():
        before, after = (float(loss_of(network(sparse, image), sparse, dense)) for network in networks)
    assert after < 0.95 * before
