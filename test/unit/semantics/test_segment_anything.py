"""Segment Anything: every known export gives each mask once and in its place."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import sam_graphs as graphs
from masks_of_pictures import compared, frame_of, iou, later, picture_of
from onnx_graphs import segmentation

from calib_ros.config import SemanticsConfig
from calib_ros.errors import BudgetError, ModelError
from calib_ros.registration.classes import MASKS
from calib_ros_semantics.models.masks import Mask, MaskModel
from calib_ros_semantics.models.onnx_model import Deadline
from calib_ros_semantics.models.segmentation import load_model

BACKGROUND = (90, 90, 90)
COLOUR = np.array([40.0, 60, 200])  # BGR
WIDE = {(40, 30, 200, 150): (40, 60, 200), (300, 60, 420, 330): (200, 60, 40), (480, 200, 610, 330): (40, 200, 60)}
TALL = {(20, 30, 140, 130): (40, 60, 200), (160, 100, 280, 460): (200, 60, 40), (30, 300, 110, 440): (40, 200, 60)}


def painted(size: tuple[int, int], shapes: dict) -> tuple[np.ndarray, list[np.ndarray]]:
    """Picture BGR and the masks of its background and rectangles (left, top, right, bottom), later ones on top."""
    image = np.full((*size, 3), BACKGROUND, np.uint8)
    number = np.zeros(size, int)
    for k, ((left, top, right, bottom), colour) in enumerate(shapes.items(), 1):
        image[top:bottom, left:right] = colour
        number[top:bottom, left:right] = k
    return image, [number == k for k in range(len(shapes) + 1)]


SCENES = {"wide": painted((360, 640), WIDE), "tall": painted((480, 300), TALL)}
IMAGE, TRUTH = SCENES["wide"]


def segmenter_of(config: SemanticsConfig) -> MaskModel:
    return load_model(MASKS, config.segment_anything, config)


def segment(config: SemanticsConfig, image: np.ndarray) -> list[Mask]:
    return segmenter_of(config).masks(frame_of(image), later())


def assert_finds(config: SemanticsConfig, image: np.ndarray, truth: list[np.ndarray], enough: float = 0.8) -> None:
    """Every thing, and none twice."""
    assert compared(segment(config, image), truth, enough)[:2] == (1.0, 0)


def settings(encoder: str, decoder: str = "", **others: object) -> SemanticsConfig:
    return SemanticsConfig(segment_anything=encoder, segment_anything_decoder=decoder, **{"prompt_grid": 5, **others})


def pair(encoder: dict | None = None, make: Callable = graphs.encoder, **decoder: object) -> Callable[[Path], tuple[str, str]]:
    """An encoder and the decoder of SAM's authors, with these options."""

    def saved(folder: Path) -> tuple[str, str]:
        return make(folder / "encoder.onnx", **(encoder or {})), graphs.official_decoder(folder / "decoder.onnx", **decoder)

    return saved


official = pair()
NAMES = {"image_embeddings": "feat", "point_coords": "xy", "point_labels": "kind", "mask_input": "prior"}
NAMES |= {"has_mask_input": "flag", "orig_im_size": "hw"}
NAMES |= {"masks": "out0", "iou_predictions": "out1", "low_res_masks": "out2"}
PAIRS = {
    "official": official,
    "official, one mask": pair(levels=graphs.LEVELS[:1]),
    "official, masks of the whole size only": pair(outputs=("masks", "iou_predictions")),
    "NanoSAM": pair(outputs=("iou_predictions", "low_res_masks"), sized=False),
    "encoder of 512": pair({"side": 512}, side=512),
    "samexporter": pair(make=graphs.raw_encoder),
    "samexporter of a fixed size": pair({"shape": [684, 1024, 3]}, graphs.raw_encoder),
    "other names": pair({"name": "x", "out": "y"}, names=NAMES),
    "float16": pair({"kind": graphs.HALF}, kind=graphs.HALF),
    "EdgeSAM": lambda folder: (pair({"name": "image"})(folder)[0], graphs.edge_sam_decoder(folder / "edge.onnx")),
    "SAM2": graphs.sam2_pair,
    "SAM2 that takes one prompt only": lambda folder: graphs.sam2_pair(folder, honest=False),
    "SAM2 that takes seven prompts": lambda folder: graphs.sam2_pair(folder, prompts=7),
    "EfficientSAM": graphs.efficient_sam_pair,
    "Hugging Face": graphs.transformers_pair,
}


def cell_of(shape: str, convention: str) -> float:
    """Pixels of the picture per cell of the graphs' colours, the larger of both directions."""
    height, width = SCENES[shape][0].shape[:2]
    side = 128 if "512" in convention else 256
    cell = max(height, width) / side
    return cell * 1.5 if "fixed size" in convention and shape == "tall" else cell


# Those that differ in how a picture comes into the graph, or its masks out of it.
ANY_SHAPE = [*(f"official{more}" for more in ("", ", masks of the whole size only")), "SAM2", "EfficientSAM"]
ANY_SHAPE += [f"samexporter{more}" for more in ("", " of a fixed size")]


@pytest.mark.parametrize(("convention", "shape"), [(c, "wide") for c in PAIRS] + [(c, "tall") for c in ANY_SHAPE])
def test_every_export_finds_each_thing_where_it_is(tmp_path: Path, convention: str, shape: str) -> None:
    image, truth = SCENES[shape]
    masks = segment(settings(*PAIRS[convention](tmp_path)), image)
    assert len(masks) == len(truth)
    # The model's own, which says that labels and prompts were as it wants them.
    assert [mask.score for mask in masks] == pytest.approx([0.97] * len(masks), abs=0.001)
    cell = cell_of(shape, convention)
    for true in truth:
        best = max((picture_of(mask, true.shape) for mask in masks), key=lambda picture: iou(picture, true))
        inner = cv2.distanceTransform(np.pad(true, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
        outer = cv2.distanceTransform((~true).astype(np.uint8), cv2.DIST_L2, 5)
        assert max(inner[true & ~best].max(initial=0), outer[best & ~true].max(initial=0)) <= cell + 1
        shift = np.mean(np.nonzero(best), axis=1) - np.mean(np.nonzero(true), axis=1)
        assert np.abs(shift).max() < 0.6 * cell
        assert shape == "tall" or iou(best, true) > 0.98  # the wide picture's edges lie between cells


def test_a_grey_picture_is_one_of_equal_colours(tmp_path: Path) -> None:
    image, truth = painted((360, 640), {box: (level,) * 3 for box, level in zip(WIDE, (30, 150, 220), strict=True)})
    assert_finds(settings(*official(tmp_path)), np.ascontiguousarray(image[:, :, 0]), truth)


def test_the_yaml_beside_the_encoder_tells_the_family(tmp_path: Path) -> None:
    encoder, decoder = official(tmp_path)
    # The same numbers as without, for grey levels 0..1.
    (tmp_path / "encoder.yaml").write_text("family: mobile_sam\nmean: [0.485, 0.456, 0.406]\nstd: [0.229, 0.224, 0.225]\n")
    assert segmenter_of(settings(encoder, decoder)).describe().startswith("Segment Anything (mobilesam), 5 prompts")
    assert_finds(settings(encoder, decoder), IMAGE, TRUTH)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", (COLOUR[::-1] - graphs.MEAN) / graphs.STD),
        ("channels: rgb", (COLOUR[::-1] - graphs.MEAN) / graphs.STD),
        ("channels: bgr", (COLOUR - graphs.MEAN[::-1]) / graphs.STD[::-1]),
        ("mean: [0.485, 0.456, 0.406]", COLOUR[::-1] / 255 - [0.485, 0.456, 0.406]),
        ("std: [0.2, 0.25, 0.5]", COLOUR[::-1] / 255 / [0.2, 0.25, 0.5]),
        ("mean: [120, 110, 100]", COLOUR[::-1] - [120, 110, 100]),
        ("std: [58, 57, 50]", COLOUR[::-1] / [58, 57, 50]),
        ("mean: [0, 0, 0]\nstd: [255]", COLOUR[::-1] / 255),
        ("mean: [1.2, 1.1, 1]\nstd: [0.5]", (COLOUR[::-1] / 255 - [1.2, 1.1, 1]) / 0.5),
        ("scale: 0.0078125", COLOUR[::-1] / 128),
        ("scale: 2\nmean: [1]", COLOUR[::-1] * 2 - 1),
    ],
)
def test_the_yaml_normalises_as_beside_a_network_of_classes(tmp_path: Path, text: str, expected: np.ndarray) -> None:
    encoder, decoder = official(tmp_path)
    (tmp_path / "encoder.yaml").write_text(text)
    image = np.full((64, 64, 3), COLOUR, np.uint8)
    halves = segmenter_of(settings(encoder, decoder))
    embedded = halves.embedded(image, later())
    cell = embedded.features["image_embeddings"][0, :48].reshape(4, 4, 3, 64, 64)[0, 0, :, 8, 8]
    assert (cell * 255 - graphs.MEAN) / graphs.STD == pytest.approx(expected, abs=1e-3)
    network = segmentation(tmp_path / "net.onnx", 19, "o 1 19 64 64", inputs="1 3 64 64")
    network.with_suffix(".yaml").write_text(text)
    fed = load_model("image_classes", str(network), SemanticsConfig()).feed(image)["input"]
    assert fed[0, :, 50, 50] == pytest.approx(expected, abs=1e-3)


def test_the_yaml_beside_the_decoder_names_the_masks(tmp_path: Path) -> None:
    config = settings(*official(tmp_path))
    for name in ("masks", "low_res_masks"):
        (tmp_path / "decoder.yaml").write_text(f"output: {name}")
        assert segmenter_of(config).decoder.masks.name == name
        assert_finds(config, IMAGE, TRUTH)
    (tmp_path / "decoder.yaml").write_text("output: mask")
    with pytest.raises(ModelError, match=r"decoder\.onnx: there is no output 'mask'.*low_res_masks"):
        segmenter_of(config)


@pytest.mark.parametrize("transposed", [False, True])
def test_fast_sam(tmp_path: Path, transposed: bool) -> None:
    palette = np.array([BACKGROUND, *WIDE.values()])[:, ::-1] / 255
    rows = []
    for k, (left, upper, right, lower) in enumerate([(0, 0, 640, 360), *WIDE]):
        for confidence, grown in ((0.9 - 0.1 * k, 0), (0.5, 1), (0.45, 12), (0.3, 0)):  # surest, its likes, and one unsure
            own = [(left + right) / 2, (upper + lower) / 2 + TOP, right - left + grown, lower - upper + grown]
            rows.append([*own, confidence, *np.eye(len(palette))[k]])
    rows += [[320, 320, 10, 10, 0.1, *np.zeros(len(palette))]] * 50
    model = segmenter_of(settings(graphs.fast_sam(tmp_path / "fast.onnx", 640, np.array(rows), palette, transposed)))
    masks = model.masks(frame_of(IMAGE), later())
    assert model.describe().startswith("FastSAM, 640x640 RGB, fed as v / 255 of grey levels v in 0..255 (assumed")
    assert compared(masks, TRUTH, 0.95) == (1.0, 0, 0)
    assert [mask.score for mask in masks] == pytest.approx([0.9, 0.8, 0.7, 0.6])


TWO_ALIKE = {(40, 30, 200, 150): (40, 60, 200), (300, 60, 420, 330): (40, 60, 200)}


def of_two(folder: Path, **wrong: float) -> list[Mask]:
    """Masks of two things of a colour; wrong: columns of the first's detection."""
    detections = np.array([[120, 90 + TOP, 160, 120, 0.9, 1], [360, 195 + TOP, 120, 270, 0.8, 1]] + [[0] * 6] * 20)
    for column, value in wrong.items():
        detections[0, int(column[1:])] = value
    path = graphs.fast_sam(folder / "fast.onnx", 640, detections, np.array([[200, 60, 40]]) / 255)
    return segment(settings(path), painted((360, 640), TWO_ALIKE)[0])


def test_fast_sam_cuts_off_what_lies_beyond_the_box(tmp_path: Path) -> None:
    assert np.abs(np.array([mask.box for mask in of_two(tmp_path)]) - list(TWO_ALIKE)).max() <= 4


TOP = 140  # rows above the wide picture's 360 in the middle of 640


def in_wide(folder: Path, unit: Callable[[np.ndarray], np.ndarray] = lambda c: c / 255, **more: object) -> str:
    """FastSAM that knows the things of the wide picture; unit: from grey levels to those that come into the graph."""
    palette = unit(np.array(list(WIDE.values()), float)[:, ::-1])
    boxes = [[(x0 + x1) / 2, (y0 + y1) / 2 + TOP, x1 - x0, y1 - y0] for x0, y0, x1, y1 in WIDE]
    rows = [[*box, 0.9, *one] for box, one in zip(boxes, np.eye(3), strict=True)] + [[0.0] * 8] * 20
    return graphs.fast_sam(folder / "fast.onnx", 640, np.array(rows), palette, **more)  # type: ignore[arg-type]


def assert_finds_things(path: str) -> None:
    assert compared(segment(settings(path), IMAGE), TRUTH[1:], 0.95) == (1.0, 0, 0)


def test_fast_sam_with_a_yaml(tmp_path: Path) -> None:
    path, yaml = in_wide(tmp_path, lambda colour: (colour - 100) / 50), tmp_path / "fast.yaml"
    yaml.write_text("mean: [100, 100, 100]\nstd: [50]\n")
    assert_finds_things(path)
    yaml.unlink()
    path = in_wide(tmp_path, extra=True)
    assert len(segment(settings(path), IMAGE)) == 0  # the first table has no detections
    yaml.write_text("output: output0")
    assert_finds_things(path)


@pytest.mark.parametrize(("column", "bad"), [("c0", np.nan), ("c3", np.inf), ("c3", -np.inf), ("c5", np.nan), ("c5", np.inf)])
def test_fast_sam_drops_nan_detections(tmp_path: Path, column: str, bad: float) -> None:
    masks = of_two(tmp_path, **{column: bad})
    assert [mask.score for mask in masks] == pytest.approx([0.8])
    assert masks[0].box == pytest.approx(list(TWO_ALIKE)[1], abs=4)


def test_fast_sam_with_nms_inside_that_its_file_does_not_tell(tmp_path: Path) -> None:
    """Corners, confidence, class, coefficients, filled up with nothing; fewer rows than columns, too."""
    without = {"nms": "False", "args": "{'batch': 1, 'nms': False}", "end2end": "False"}
    assert_finds_things(in_wide(tmp_path, metadata=without))
    rows = np.zeros((300, 9))
    rows[:3] = [[*np.add(box, [0, TOP, 0, TOP]), 0.9, 0, *one] for box, one in zip(WIDE, np.eye(3), strict=True)]
    palette = np.array(list(WIDE.values()))[:, ::-1] / 255
    for count in (300, 5):
        path = graphs.fast_sam(tmp_path / "fast.onnx", 640, rows[:count], palette, transposed=True)
        with pytest.raises(ModelError, match="it was exported with NMS inside"):
            segment(settings(path), IMAGE)


def test_deadline_ends_segmentation(tmp_path: Path) -> None:
    model, asked = segmenter_of(settings(*official(tmp_path))), itertools.count()
    # At once, and somewhere among the prompts.
    for deadline in (Deadline(0), Deadline(60, lambda: next(asked) > 8)):
        with pytest.raises(BudgetError):
            model.masks(frame_of(IMAGE), deadline)
