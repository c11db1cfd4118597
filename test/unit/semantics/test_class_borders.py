"""Class borders as semantic edges: exact values on small planes, from networks, and their use in the objective."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from masks_of_pictures import frame_of, later
from onnx_graphs import segmentation
from scenes import RenderedDrive
from thesis_constants import with_constants

from calib_ros.config import Config, SemanticsConfig, update
from calib_ros.frame import UNLABELLED, Frame
from calib_ros.frame import SemanticClass as C
from calib_ros.image.edges import blurred_levels, oriented_edges
from calib_ros.image.enhance import prepare
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.classes import EDGE_SHARE, IMAGE, OF_CLASSES, OF_MASKS
from calib_ros.registration.features import FeatureExtractor
from calib_ros_semantics.models.class_borders import IMAGE_BORDER, WEIGHTS, borders_of_classes, borders_of_scores, class_borders
from calib_ros_semantics.models.onnx_model import OnnxModel, SegmentationModel
from calib_ros_semantics.models.segmentation import SegmentationModels, load_model
from calib_ros_thesis.config import thesis_of
from calib_ros_thesis.features import CLASS_EDGE_SHARE, semantic_share
from calib_ros_thesis.image import blend, gradient_edges, smoothed

SIZE = (60, 80)


def split(left: int, right: int, at: int = 40, size: tuple[int, int] = SIZE) -> np.ndarray:
    """Classes (H, W) of two halves; the second begins with column `at`."""
    out = np.full(size, left, np.uint8)
    out[:, at:] = right
    return out


def logits(classes: np.ndarray, height: float = 30.0) -> np.ndarray:
    """Scores (10, H, W) of every SemanticClass that are sure of these classes."""
    return np.stack([height * (classes == c) for c in C]).astype(np.float32)


ALL = np.array(list(C), np.uint8)


def test_a_sure_step_is_a_full_edge_between_its_two_columns() -> None:
    borders = borders_of_classes(split(C.VEHICLE, C.GROUND))
    assert borders.shape == (2, *SIZE)
    assert borders.dtype == np.float32
    inner = slice(IMAGE_BORDER, -IMAGE_BORDER)
    assert np.allclose(borders[0, inner, 39:41], 1, atol=1e-5)
    # The slope of a binomial blur, of which 1, 5 and 10 of 16 lie that far: 5 beside the step, 2.5 and 0.5 farther off.
    assert np.allclose(borders[0, inner, 36:44] * 5, [0, 0.5, 2.5, 5, 5, 2.5, 0.5, 0], atol=1e-4)
    assert borders[0, :, :36].max() == borders[0, :, 44:].max() == 0
    assert borders[1].max() < 1e-5
    turned = borders_of_classes(np.ascontiguousarray(split(C.VEHICLE, C.GROUND).T))
    assert np.array_equal(turned[::-1].transpose(0, 2, 1), borders)


@pytest.mark.parametrize("angle", [0, 20, 45, 70, 90, 135, 160])
def test_the_strength_is_shared_out_by_the_direction_of_the_slope(angle: float) -> None:
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    normal = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
    classes = np.where((u - 40.2) * normal[0] + (v - 29.6) * normal[1] > 0, C.SKY, C.BUILDING).astype(np.uint8)
    horizontal, vertical = borders_of_classes(classes)[:, 10:-10, 10:-10]
    strength = horizontal + vertical
    assert 0.9 < strength.max() < 1.2
    on = strength > 0.5
    assert on.sum() >= 80
    assert np.abs(horizontal[on] / strength[on] - normal[0] ** 2).mean() < 0.04


def test_an_uncertain_border_is_weaker_in_proportion() -> None:
    sure = borders_of_classes(split(C.SKY, C.BUILDING))
    for low, high in ((0.2, 0.8), (0.45, 0.55), (0.5, 0.5)):
        sky = np.where(split(0, 1) == 1, high, low).astype(np.float32)
        found = class_borders({C.SKY: sky, C.BUILDING: 1 - sky}, SIZE)
        np.testing.assert_allclose(found, (high - low) * sure, atol=1e-5)
    # One that takes 16 columns has no place of its own.
    ramp = np.broadcast_to(np.clip((np.arange(80, dtype=np.float32) - 32) / 16, 0, 1), SIZE).copy()
    assert class_borders({C.SKY: ramp, C.BUILDING: 1 - ramp}, SIZE).max() == pytest.approx(1 / 16 / (5 / 16), abs=1e-4)


def test_the_weightier_class_of_a_border_counts() -> None:
    for left, right, strength in (
        *((C.SKY, c, 1.0) for c in C if c != C.SKY),
        *((main, C.GROUND, 1.0) for main in (C.VEHICLE, C.PERSON, C.CYCLIST, C.POLE, C.SIGN)),
        *((C.BUILDING, c, 0.4) for c in (C.VEGETATION, C.GROUND, C.OTHER)),
        (C.VEGETATION, C.GROUND, 0.4),
        *((c, UNLABELLED, 0.0) for c in C),
    ):
        for classes in (split(left, right), split(right, left)):
            borders = borders_of_classes(classes)
            assert borders[0, 30].max() == pytest.approx(strength, abs=1e-4)
            assert borders[1].max() < 1e-5
        assert set(WEIGHTS) == set(C) - {C.OTHER}


def test_only_unknown_regions_remove_a_border() -> None:
    """Half of the picture's rows are unknown on one side; the border above stays as it is."""
    classes = split(C.VEHICLE, C.GROUND)
    classes[30:, 40:] = UNLABELLED
    borders, whole = borders_of_classes(classes), borders_of_classes(split(C.VEHICLE, C.GROUND))
    assert np.allclose(borders[:, :26], whole[:, :26], atol=1e-5)
    assert borders[0, 34:].max() < 1e-4
    # A pole of two columns has two sides: the slope of one takes some of the other's.
    classes = split(C.BUILDING, C.BUILDING)
    classes[:, 40:42] = C.POLE
    assert borders_of_classes(classes)[0, 30, 36:46] == pytest.approx([0, 0.1, 0.5, 0.9, 0.5, 0.5, 0.9, 0.5, 0.1, 0], abs=1e-4)


def test_the_border_of_the_image_is_no_edge() -> None:
    assert borders_of_classes(np.full(SIZE, C.VEHICLE, np.uint8)).max() == 0
    assert borders_of_classes(split(C.VEHICLE, C.GROUND, at=2))[:, :, :IMAGE_BORDER].max() == 0
    borders = borders_of_classes(split(C.VEHICLE, C.GROUND))
    assert borders[:, :IMAGE_BORDER].max() == borders[:, -IMAGE_BORDER:].max() == 0
    assert borders[0, IMAGE_BORDER, 40] == borders[0, -IMAGE_BORDER - 1, 40] == pytest.approx(1, abs=1e-5)


def test_scores_probabilities_and_classes_agree() -> None:
    classes = split(C.VEHICLE, C.GROUND)
    classes[:20] = C.SKY
    classes[40:, 60:] = C.PERSON
    expected = borders_of_classes(classes)
    scores = logits(classes)
    one_hot = scores / 30
    for given in (scores, scores - 1000, one_hot, scores.astype(np.float16), scores.transpose(1, 2, 0).copy().transpose(2, 0, 1)):
        np.testing.assert_allclose(borders_of_scores(given, ALL, SIZE), expected, atol=1e-4)
    # Probabilities are not taken for scores, whose softmax would leave next to nothing of them.
    half = np.where(one_hot == 1, 0.75, 0.25 / 9).astype(np.float32)
    np.testing.assert_allclose(borders_of_scores(half, ALL, SIZE), (0.75 - 0.25 / 9) * expected, atol=1e-4)
    np.testing.assert_allclose(borders_of_scores(np.log(half), ALL, SIZE), (0.75 - 0.25 / 9) * expected, atol=1e-4)


def test_classes_of_a_network_that_mean_the_same_have_no_border_between_them() -> None:
    """Road, pavement, sky and void; whether it is one or the other ground is open everywhere."""
    left = split(1, 0) == 1
    scores = np.where(left, [[[20.0]], [[19.0]], [[0.0]], [[0.0]]], [[[19.0]], [[20.0]], [[0.0]], [[0.0]]])
    meaning = np.array([C.GROUND, C.GROUND, C.SKY, UNLABELLED], np.uint8)
    assert borders_of_scores(scores, meaning, SIZE).max() < 1e-4
    scores[2, :30], scores[3, :, 60:] = 60, 90
    borders = borders_of_scores(scores, meaning, SIZE)
    assert np.allclose(borders[1, 29:31, 5:55], 1, atol=1e-4)
    assert borders[0].max() < 0.1  # where three of them meet
    assert borders[:, :, 64:].max() < 1e-4


@pytest.mark.parametrize(
    ("size", "cell"), [((188, 624), 2), ((376, 1248), 8), ((376, 1248), 1), ((60, 80), 4), ((1200, 1600), 1)]
)
def test_scores_in_other_sizes_lie_where_the_classes_do(size: tuple[int, int], cell: int) -> None:
    """Cells of 2 pixels stay, those of 8 are enlarged first, as large pictures are reduced."""
    at = size[1] // 2
    scores = logits(split(C.VEHICLE, C.GROUND, at // cell, (size[0] // cell, size[1] // cell)), height=60.0)
    borders = borders_of_scores(scores, ALL, size)
    assert borders.shape == (2, *size)
    rows = borders[0, 10:-10:50]
    place = (rows * np.arange(size[1])).sum(axis=1) / rows.sum(axis=1)
    assert place == pytest.approx(np.full(len(rows), at - 0.5), abs=0.5)
    assert rows[:, at - 1 : at + 1].min() > 0.9
    assert (rows > 0.5).sum(axis=1).max() < 13
    assert borders[1].max() < 1e-4


def test_where_a_score_is_no_number_there_is_no_border() -> None:
    classes = split(C.VEHICLE, C.GROUND)
    scores, whole = logits(classes), borders_of_classes(classes)
    scores[C.GROUND, 20:24] = np.nan
    scores[C.SKY, 40] = np.inf
    borders = borders_of_scores(scores, ALL, SIZE)
    assert np.isfinite(borders).all()
    assert borders[:, 20:24].max() == borders[:, 40].max() == 0
    assert np.allclose(borders[:, 27:37], whole[:, 27:37], atol=1e-4)
    # What is ruled out altogether is a probability of 0.
    scores = logits(classes)
    scores[C.SKY] = -np.inf
    np.testing.assert_allclose(borders_of_scores(scores, ALL, SIZE), whole, atol=1e-4)


# Scores 2 c v - c^2 of these two classes differ by 20 (v - 0.5): 10 and -10 for white and black.
CENTRES = np.array([-4.5, 5.5])


def network(folder: Path, outputs: str = "scores 1 2 64 128") -> SegmentationModel:
    path = segmentation(folder / "net.onnx", 2, outputs, inputs="1 3 64 128", at=CENTRES)
    path.with_suffix(".yaml").write_text("labels: [building, sky]\n")
    return load_model(IMAGE, str(path), SemanticsConfig())


def grey(left: int, right: int) -> Frame:
    image = np.full((64, 128, 3), left, np.uint8)
    image[:, 64:] = right
    return frame_of(image, "a")


def test_a_network_gives_classes_and_borders_of_one_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = network(tmp_path)
    runs: list[object] = []
    run = OnnxModel.run
    monkeypatch.setattr(OnnxModel, "run", lambda *args, **kwargs: runs.append(args) or run(*args, **kwargs))
    for left, right in ((0, 255), (115, 140), (140, 115)):
        frame = grey(left, right)
        runs.clear()
        classes, borders = model(frame, later())
        assert len(runs) == 1
        assert classes[30, [10, 100]].tolist() == [C.SKY if v > 127 else C.BUILDING for v in (left, right)]
        sky = [1 / (1 + np.exp(-20 * (v / 255 - 0.5))) for v in (left, right)]
        assert borders[0, 30, 63:65] == pytest.approx(abs(sky[0] - sky[1]), abs=2e-3)
        assert borders[1].max() < 1e-3
    assert model(frame, later(), borders=False).borders is None


def test_a_network_of_class_numbers_has_borders_of_full_strength(tmp_path: Path) -> None:
    classes, borders = network(tmp_path, outputs="argmax 1 64 128")(grey(0, 255), later())
    assert np.array_equal(classes, split(C.BUILDING, C.SKY, 64, (64, 128)))
    assert np.array_equal(borders, borders_of_classes(classes))


@pytest.fixture(scope="module")
def frame() -> Frame:
    return RenderedDrive(seed=31, frames=1, width=640, height=240, speed=0, stride=30)[0]


def models(**semantics: object) -> SegmentationModels:
    return SegmentationModels(SemanticsConfig(**{"image_classes": "source", "cloud_classes": "", **semantics}))


def test_masks_come_before_classes(tmp_path: Path, frame: Frame) -> None:
    own = borders_of_classes(frame.classes)
    alone = models()(frame)
    assert np.array_equal(alone.edges, own)
    assert alone.edges_of == OF_CLASSES
    folder = tmp_path / "masks" / frame.name
    folder.mkdir(parents=True)
    cv2.imwrite(str(folder / "0.png"), 255 * (frame.classes == C.VEHICLE).astype(np.uint8))
    masked = models(segment_anything=str(tmp_path / "masks"))
    both = masked(frame)
    assert both.edges_of == OF_MASKS
    assert np.array_equal(both.edges, models(segment_anything=str(tmp_path / "masks"), image_classes="")(frame).edges)
    assert np.array_equal(both.classes, frame.classes)
    # Where masks fail, find nothing, or are not asked for, classes are heard.
    failed = masked(replace(frame, name="other"))
    assert len(failed.problems) == 1
    asked = masked(frame, kinds=("image_classes",))
    cv2.imwrite(str(folder / "0.png"), np.zeros(frame.image.shape[:2], np.uint8))
    for semantics in (failed, asked, masked(frame)):
        assert semantics.edges_of == OF_CLASSES
        assert np.array_equal(semantics.edges, own)


@pytest.mark.parametrize(("edges_of", "share"), [(OF_MASKS, EDGE_SHARE), (OF_CLASSES, 0.0)])
def test_a_share_of_masks_is_blended_in_before_the_blur(frame: Frame, edges_of: str, share: float) -> None:
    """Class borders are not: they are for the thesis's objective."""
    config = update(Config(), {"semantics": {"image_classes": "source", "cloud_classes": ""}})
    extract = FeatureExtractor(frame.camera, config)
    semantics = replace(SegmentationModels(config.semantics)(frame), edges_of=edges_of)
    gradient = oriented_edges(prepare(extract.working_image(frame.image)))
    edges = [np.asarray((1 - share) * g + share * s, np.float32) for g, s in zip(gradient, semantics.edges, strict=True)]
    blended = blurred_levels(edges, float(extract.camera.K[0, 0]), local_contrast=True)
    for a, b, c in zip(extract(frame, semantics).levels, blended, extract(frame).levels, strict=True):
        np.testing.assert_allclose(a.maps, b.maps, atol=1e-4)
        assert (abs(a.maps - c.maps).max() > 0.1) == (share > 0)
        assert share > 0 or np.array_equal(a.maps, c.maps)


@pytest.mark.parametrize(("edges_of", "share"), [(OF_CLASSES, CLASS_EDGE_SHARE), (OF_MASKS, 0.2)])
def test_thesis_objective_blends_in_semantic_edges(frame: Frame, edges_of: str, share: float) -> None:
    assert CLASS_EDGE_SHARE == 0.1
    semantics = {"image_classes": "source", "cloud_classes": "source"}
    config = update(Config(), {"refine": {"objective": "thesis"}, "semantics": semantics})
    config = with_constants(config, semantic_share=0.2)
    calibrator = Calibrator(frame.camera, config)
    seen = replace(calibrator.segmentation(frame), edges_of=edges_of)
    assert semantic_share(thesis_of(config), edges_of) == share
    whole = calibrator.extract(frame, seen)
    objective = calibrator.objectives([whole], frame.reference, frame.reference)
    assert objective.remark.startswith("eq. 3.12 ran on gradients and borders of classes" if edges_of == OF_CLASSES else "")
    assert bool(objective.remark) == (edges_of == OF_CLASSES)
    plain = calibrator.extract(frame)
    assert "ran on gradients, without classes" in calibrator.objectives([plain], frame.reference, frame.reference).remark
    features = whole.own
    image = calibrator.extract.working_image(frame.image)
    gradient = gradient_edges(prepare(image), thesis_of(config))
    expected = blend(gradient, np.minimum(seen.edges.sum(axis=0), 1), share)
    focal = float(calibrator.extract.camera.K[0, 0])
    for sigma, own in zip(thesis_of(config).smoothing, features.image_edges, strict=True):
        np.testing.assert_allclose(own, smoothed(expected, sigma * focal / 720.0), atol=1e-3)
        assert abs(own - smoothed(gradient, sigma * focal / 720.0)).max() > 0.05
