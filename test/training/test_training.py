"""Training of the image network. Tests that need PyTorch are skipped without it."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from paths import ROOT

sys.path.insert(0, str(ROOT))  # training/ is no part of the installed package

from calib_ros.config import SemanticsConfig
from calib_ros.frame import Frame
from calib_ros_semantics.models.labels import CAMVID, lookup
from calib_ros_semantics.models.onnx_model import Deadline
from training import augment, data

NO_TORCH = "training needs PyTorch: see training/README.md"
ROAD, CAR = data.NAMES.index("road"), data.NAMES.index("car")


def drawn(seed: int) -> data.Pair:
    """A picture (90, 120) whose colours tell its classes: sky, building, car and road, some void."""
    labels = np.full((90, 120), ROAD, np.uint8)
    labels[:40] = data.BUILDING
    labels[:20] = data.SKY
    labels[50:70, 30 + seed : 70] = CAR
    labels[80:, :10] = data.VOID
    colours = np.full((data.VOID + 1, 3), 128, np.uint8)
    colours[[data.SKY, data.BUILDING, ROAD, CAR]] = (220, 230, 250), (150, 100, 60), (70, 70, 80), (180, 20, 20)
    return colours[labels], labels


PICTURES = [drawn(seed) for seed in range(4)]


def test_names_are_those_that_calib_ros_knows() -> None:
    assert list(data.NAMES) == CAMVID[:-1]


def test_rare_classes_weigh_more() -> None:
    labels = np.repeat(np.array([ROAD, CAR, data.VOID], np.uint8), [75, 25, 900])[None]
    weights = data.class_weights([labels])
    np.testing.assert_allclose(weights[[ROAD, CAR]], 1 / np.log([1.8, 1.3]), rtol=1e-6)  # of what is known
    assert weights.argmax() != CAR  # what never occurs has the largest
    assert weights[data.SKY] == pytest.approx(1 / np.log(1.05))


def test_iou_of_a_known_confusion() -> None:
    labels = np.array([[0, 0, 0, 1, 1, data.VOID]], np.uint8)
    found = np.array([[0, 0, 1, 1, 1, 5]], np.uint8)
    iou = data.iou(lambda _: found, [(np.zeros((1, 6, 3), np.uint8), labels)])
    np.testing.assert_allclose(iou[:2], [2 / 3, 2 / 3])
    assert np.isnan(iou[2:]).all()  # neither there nor predicted where anything is known


# Augmentation


@pytest.mark.parametrize("size", augment.SHAPES)
def test_a_crop_follows_from_its_generator(size: tuple[int, int]) -> None:
    first, again, other = (augment.training_crop(PICTURES, 0, size, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first[0], again[0])
    np.testing.assert_array_equal(first[1], again[1])
    assert (first[0] != other[0]).mean() > 0.5
    assert first[0].shape == (*size, 3)
    assert first[0].dtype == first[1].dtype == np.uint8
    assert size[0] % 16 == size[1] % 16 == 0


@pytest.mark.parametrize("seed", range(6))
def test_labels_move_with_the_picture(seed: int) -> None:
    image, labels = augment.random_canvas(PICTURES, seed % 4, (96, 288), np.random.default_rng(seed))
    colours = np.full((data.VOID + 1, 3), 128.0)
    for number in (data.SKY, data.BUILDING, ROAD, CAR):
        colours[number] = PICTURES[0][0][PICTURES[0][1] == number][0]
    # Inside a class, where the scaling mixes no colours, it is the class's; at a seam it may have mixed with what was cut off.
    inside = cv2.erode((cv2.Laplacian(labels, cv2.CV_16S) == 0).astype(np.uint8), np.ones((5, 5))) > 0
    assert inside.mean() > 0.4
    assert (np.abs(image[inside] - colours[labels[inside]]).max(1) <= 1.5).mean() > 0.998
    assert {data.BUILDING, ROAD} <= set(labels.ravel())


def test_movable_things_of_another_picture_come_with_their_labels() -> None:
    image, labels = augment.with_things_of(PICTURES[3], PICTURES[0])  # whose car is wider
    car = PICTURES[0][1] == CAR
    assert car.sum() > (PICTURES[3][1] == CAR).sum()
    np.testing.assert_array_equal(labels == CAR, car | (PICTURES[3][1] == CAR))
    np.testing.assert_array_equal(image[car], PICTURES[0][0][car])
    np.testing.assert_array_equal(labels[~car], PICTURES[3][1][~car])
    np.testing.assert_array_equal(image[~car], PICTURES[3][0][~car])
    smaller = tuple(part[:40] for part in PICTURES[0])
    assert augment.with_things_of(PICTURES[3], smaller) is PICTURES[3]


def test_other_light_leaves_neither_the_picture_nor_its_labels_changed() -> None:
    image, labels = drawn(0)
    before = image.copy(), labels.copy()
    found = [augment.recoloured(image, labels, np.random.default_rng(seed)) for seed in range(60)]
    np.testing.assert_array_equal(image, before[0])
    np.testing.assert_array_equal(labels, before[1])
    grey = np.mean([(f[..., 0] == f[..., 1]).all() and (f[..., 1] == f[..., 2]).all() for f in found])
    assert 0.15 < grey < 0.5  # GREY_SHARE of them, by chance of 60
    assert np.std([f.mean() for f in found]) > 15


# The network


@pytest.fixture(scope="module")
def torch() -> Iterator[Any]:
    module = pytest.importorskip("torch", reason=NO_TORCH)
    threads = module.get_num_threads()
    module.set_num_threads(1)
    yield module
    module.set_num_threads(threads)


def test_the_network_is_compact(torch: Any) -> None:
    from training.network import Network, parameters_of

    network = Network()
    assert 0.6e6 < parameters_of(network) < 0.9e6
    pictures = torch.randint(0, 256, (2, 3, 64, 96), dtype=torch.uint8)
    scores, auxiliary = network(pictures)
    assert scores.shape == (2, 11, 32, 48)
    assert auxiliary.shape == (2, 11, 8, 12)
    alone = network.eval()(pictures)
    torch.testing.assert_close(network.fuse()(pictures), alone, rtol=1e-3, atol=1e-4)


def run_of(folder: Path, epochs: int = 2) -> Any:
    from training.train import Run, Settings

    return Run(PICTURES, Settings(epochs=epochs, batch=2, seed=3), folder, workers=0)


def test_a_batch_depends_on_seed_epoch_and_number_only(torch: Any) -> None:
    from training.train import Batches, Settings

    settings = Settings(batch=2, seed=3)
    first, again, later = (Batches(PICTURES, settings, epoch) for epoch in (0, 0, 1))
    assert len(first) == 2
    again[0]
    for one, other in zip(first[1], again[1], strict=True):
        assert torch.equal(one, other)
    assert first[1][0].shape != later[1][0].shape or not torch.equal(first[1][0], later[1][0])


def test_training_resumes(torch: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from training import train

    monkeypatch.setattr(train, "SHAPES", ((64, 96), (48, 128)))
    whole, first = run_of(tmp_path / "whole"), run_of(tmp_path / "parts")
    for _ in range(2):
        whole.train_epoch()
    first.train_epoch()
    first.save()
    second = run_of(tmp_path / "parts")
    assert second.epoch == 1
    second.train_epoch()
    averages = [run.average.module.state_dict() for run in (whole, second)]
    for name, value in averages[0].items():
        torch.testing.assert_close(value, averages[1][name], msg=name)
    with pytest.raises(ValueError, match="use these, or another --out"):
        run_of(tmp_path / "parts", epochs=3)


def test_training_lowers_the_loss(torch: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from training import train

    monkeypatch.setattr(train, "SHAPES", ((64, 96),))
    run = run_of(tmp_path, epochs=12)
    losses = [run.train_epoch() for _ in range(12)]
    assert np.mean(losses[-3:]) < 0.8 * np.mean(losses[:3])


# The exported file


def exported(torch: Any, file: Path, size: tuple[int, int] | None) -> Any:
    """An untrained network as a file, and as calib_ros opens it."""
    for module in ("onnx", "onnxscript", "onnxruntime"):
        pytest.importorskip(module, reason=NO_TORCH)
    from calib_ros_semantics.models.image_classes import ImageNetwork
    from training.export import export
    from training.network import Network

    torch.manual_seed(0)
    export(Network().fuse(), file, size)
    return ImageNetwork(file, SemanticsConfig())


def test_an_exported_file_of_one_size_names_classes_and_licence(torch: Any, tmp_path: Path) -> None:
    opened = exported(torch, tmp_path / "streets.onnx", (64, 96))
    onnx = pytest.importorskip("onnx", reason=NO_TORCH)
    metadata = {entry.key: entry.value for entry in onnx.load(str(tmp_path / "streets.onnx")).metadata_props}
    assert "Apache-2.0" in metadata["license"]
    assert metadata["names"] == str(list(data.NAMES)).replace("'", '"')
    assert "96x64 RGB" in opened.describe()
    assert "-> scores: scores of 11 classes" in opened.describe()


def test_calib_ros_gives_the_classes_of_the_exported_file(torch: Any, tmp_path: Path, street: list[Frame]) -> None:
    file = tmp_path / "streets.onnx"
    opened = exported(torch, file, None)
    from training.predict import Predictor

    assert file.stat().st_size < 2e6
    image = street[0].image
    wanted = lookup(data.NAMES)[Predictor(file)(np.ascontiguousarray(image[..., ::-1]))]
    found = opened(street[0], Deadline(60)).classes
    assert len(np.unique(found)) > 1
    assert (found == wanted).mean() > 0.999
