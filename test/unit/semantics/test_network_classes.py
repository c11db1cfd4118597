"""Classes of pixels and points from networks of every known convention, label files, and the source."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from masks_of_pictures import frame_of, later, png
from onnx import TensorProto as Type
from onnx import helper
from onnx_graphs import centres, endless, range_network, save, segmentation, shape_of, value

from calib_ros.config import SemanticsConfig
from calib_ros.errors import BudgetError, ModelError
from calib_ros.frame import UNLABELLED, PointCloud
from calib_ros.frame import SemanticClass as C
from calib_ros.registration.classes import CLOUD, IMAGE
from calib_ros_semantics.models.cloud_classes import BONNETAL, CENET, RANGE_FIRST, XYZ_FIRST, classes_of_points, range_view
from calib_ros_semantics.models.labels import (
    CAMVID,
    CITYSCAPES,
    CITYSCAPES_RAW,
    NUMBERS_OF_IMAGES,
    OF_IMAGES,
    SEMANTIC_KITTI,
    LabelTable,
    lookup,
)
from calib_ros_semantics.models.onnx_model import Deadline, SegmentationModel
from calib_ros_semantics.models.segmentation import load_model
from calib_ros_synthetic.drive import SyntheticDrive

CONFIG = SemanticsConfig()
pixel_model, point_model = partial(load_model, IMAGE), partial(load_model, CLOUD)
ROWS, COLUMNS = 3, 7  # blocks of the picture
DARK = np.zeros((64, 64, 3), np.uint8)


def blocks(height: int, width: int, classes: int, first: int = 0) -> np.ndarray:
    """Class number of each pixel (H, W): blocks, no two alike in a row, so that nothing can be turned or shifted unseen."""
    row = np.minimum(np.arange(height) * ROWS // height, ROWS - 1)[:, None]
    column = np.minimum(np.arange(width) * COLUMNS // width, COLUMNS - 1)[None]
    return (first + row * COLUMNS + column) % classes


def picture(numbers: np.ndarray, classes: int, channel: int = 2) -> np.ndarray:
    """(H, W, 3) BGR whose channel has the level of each class; the others have other ones."""
    level = np.rint(centres(classes, 0, 255)[numbers]).astype(np.uint8)
    image = np.stack([255 - level, np.full_like(level, 128), np.full_like(level, 30)], axis=2)
    image[..., channel] = level
    return image


def inner(numbers: np.ndarray, margin: int) -> np.ndarray:
    """Pixels farther than `margin` from the next block."""
    kernel = np.ones((2 * margin + 1,) * 2, np.uint8)
    plain = (numbers + 1).astype(np.uint8)
    return (cv2.erode(plain, kernel) == plain) & (cv2.dilate(plain, kernel) == plain)


def beside(path: Path, text: str) -> Path:
    path.with_suffix(".yaml").write_text(text)
    return path


def error_of(make) -> str:
    with pytest.raises(ModelError) as caught:
        make()
    assert "\n" not in str(caught.value)
    return str(caught.value)


DYNAMIC = "batch 3 height width"
FIVE = ["sky", "car", "road", "void", "tree"]
LEVELS = {"normal": ((0.0,) * 3, (1 / 255,) * 3)}  # the graph takes grey levels
OF_255 = ((103.53 / 255, 116.28 / 255, 123.675 / 255), (57.375 / 255, 57.12 / 255, 58.395 / 255))  # of BGR
CAFFE = ((104 / 255, 117 / 255, 123 / 255), (1 / 255,) * 3)
HEADS = "aux 1 19 64 128; s 1 19 64 128; aux2 1 19 64 128"
TILED = "RGB (pictures of another shape in tiles), fed as"
SMALL = {"inputs": "1 3 64 128", "margin": 12}


def case(outputs: str, classes=19, names=None, *, size=(375, 1242), margin=6, channel=2, yaml="", says="", **graph):
    """size, channel: of the picture, None = grey. margin: px, where strides blur. yaml: beside it. says: part of its text."""
    return (classes, names or OF_IMAGES[classes], size, margin, channel, yaml, says), {"outputs": outputs, **graph}


EXPORTS = {
    "mmsegmentation argmax": case("argmax 1 1 256 512", says="segmentation network: 512x256 RGB"),
    "mmsegmentation dynamic": case("argmax batch 1 h w", inputs=DYNAMIC, says="RGB (at most 1024 wide)"),
    "mmsegmentation logits": case("output 1 19 256 512", says="v / 255 - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225] of"),
    "PIDNet": case("output 1 19 32 64", stride=8, margin=40, says="segmentation network"),
    "PIDNet three heads": case(
        "aux 1 19 32 64; s 1 19 32 64; edge 1 1 32 64", stride=8, margin=40, says="PIDNet with auxiliary heads"
    ),
    "PIDNet heads alike": case("aux ?; s ?; aux2 ?", inputs=DYNAMIC, stride=8, margin=40, says="PIDNet with auxiliary heads"),
    "PIDNet told": case(HEADS, **SMALL, yaml="family: pidnet", says=f"PIDNet: 128x64 {TILED} (v / 255 - [0.485, 0.456, "),
    "DDRNet": case("1173 1 19 32 64; aux 1 19 32 64", stride=8, margin=40, names_of_tensors=("x.1", "1173")),
    "torchvision": case("out b 21 h w; aux b 21 h w", 21, inputs=DYNAMIC),
    "SegFormer": case(
        "logits batch_size num_labels height width", inputs="batch_size num_channels height width", stride=4, margin=20,
        names_of_tensors=("pixel_values", "logits"),
    ),
    # 150 classes cannot be told within half a cell of a border.
    "SegFormer ADE20K": case("logits 1 150 64 64", 150, inputs="1 3 256 256", stride=4, margin=20, size=(500, 520)),
    "EdgeNets": case("o 1 20 256 512", 20, [*CITYSCAPES, "background"]),
    "raw ids": case("o 1 34 256 512", 34, CITYSCAPES_RAW),
    "raw ids chosen": case("argmax 1 256 512", 34, CITYSCAPES_RAW),
    "CamVid": case("o 1 11 256 512", 11, CAMVID),
    "channels last": case("o 1 256 512 19", inputs="1 256 512 3", form="NHWC to NHWC"),
    "no batch": case("o 19 256 512", inputs="3 256 512", form="CHW to CHW"),
    "grey levels": case("argmax_int32 ?", inputs="1 h w 3", form="NHWC", kind=Type.UINT8, **LEVELS),
    "grey picture": case("s 1 19 256 512", channel=None),
    "half floats": case("s 1 19 256 512", kind=Type.FLOAT16),
    "numbers as floats": case("argmax_float 1 1 256 512"),
    "enlarged inside": case("s 1 19 256 512", inputs="1 3 128 256", enlarged=2, margin=10),
    "numbers enlarged inside": case("argmax ?", inputs=DYNAMIC, enlarged=4, size=(120, 400)),
    "numbers after their confidence": case("edge 1 1 256 512; argmax 1 1 256 512"),
    "nothing told": case("s ?", inputs=None),
    "scores before numbers": case("argmax 1 1 256 512; s 1 19 256 512"),
    "names in the file": case(
        *("o 1 3 256 512", 3, ["car", "sky", "tree"]), metadata={"names": "{0: 'car, auto', 1: 'sky', 2: 'tree'}"}
    ),
    "names of things we have no class for": case(
        *("o 1 3 256 512", 3, ["object", "person", "void"]),
        metadata={"id2label": '{"0": "zebra", "1": "person", "2": "background"}'},
    ),
    "YAML: grey levels, blue first": case(
        *("o 1 5 64 128", 5, FIVE), **SMALL, normal=OF_255, channel=0,
        yaml=f"channels: bgr\nmean: [103.53, 116.28, 123.675]\nstd: [57.375, 57.12, 58.395]\nlabels: {FIVE}",
    ),
    "YAML: mean alone": case(
        "o 1 19 256 512", normal=CAFFE, channel=0, yaml="mean: [104, 117, 123]\nchannels: bgr",
        says="BGR (pictures of another shape in tiles), fed as (v - [104, 117, 123]) of grey levels v in 0..255 (as its YAML",
    ),
    "YAML: size": case("o b 19 h w", inputs=DYNAMIC, yaml="size: [128, 256]\nlabels: cityscapes", margin=10, says="256x128 RGB"),
    "YAML: output": case("aux 1 19 64 128; o 1 19 64 128", **SMALL, yaml="output: o"),
    "YAML: labels of numbers": case("argmax 1 1 64 128", 12, CAMVID, **SMALL, yaml="labels: camvid"),
}  # fmt: skip


def test_what_is_assumed_of_a_network_is_said(tmp_path: Path) -> None:
    path = segmentation(tmp_path / "n.onnx", 34, "argmax 1 256 512")
    network = pixel_model(str(path), CONFIG)
    assert "argmax: class numbers, assumed to be cityscapes without labels: in its YAML, on cpu" in network.describe()
    network(frame_of(picture(np.full((64, 128), 26), 34)), later())
    assert "assumed to be cityscapes_raw without" in network.describe()
    assert (network(frame_of(picture(np.full((64, 128), 7), 34)), later()).classes == C.GROUND).all()
    assert pixel_model(str(beside(path, "labels: camvid")), CONFIG).describe().endswith("argmax: class numbers, on cpu")
    heads = segmentation(tmp_path / "heads.onnx", 19, HEADS, inputs="1 3 64 128")  # three, but not of PIDNet
    assert "-> aux: scores" in pixel_model(str(beside(heads, "family: DDRNet")), CONFIG).describe()


def test_the_picture_is_not_turned_and_edges_stay_where_they_are(tmp_path: Path) -> None:
    """Scores in eighths: the edge of two classes comes back within a pixel, in a picture that is no multiple of anything."""
    network = pixel_model(str(segmentation(tmp_path / "n.onnx", 19, "o b 19 h w", inputs=DYNAMIC, stride=8)), CONFIG)
    for height, width, edge in ((250, 1000, 400), (375, 1242, 500), (480, 640, 320), (1200, 1920, 900)):
        numbers = np.where(np.arange(width)[None] < edge, 8, 9) + np.zeros((height, 1), int)
        found = network(frame_of(picture(numbers, 19)), later()).classes
        assert set(np.unique(found)) == {C.VEGETATION, C.GROUND}
        upright = network(frame_of(np.ascontiguousarray(picture(numbers, 19).transpose(1, 0, 2))), later()).classes
        for at in ((found == C.VEGETATION).sum(axis=1), (upright == C.VEGETATION).sum(axis=0)):
            assert np.abs(at - edge).max() <= max(1, round(width / 1024 * 1.5)), (height, width)


@pytest.mark.parametrize(
    ("inputs", "sizes"),
    [
        (DYNAMIC, {(375, 1242): (320, 1024), (480, 640): (480, 640), (1200, 1920): (640, 1024), (2000, 1000): (1024, 512)}),
        ("1 3 512 w", {(375, 1242): (512, 1696), (480, 640): (512, 672)}),
        ("1 3 h 512", {(375, 1242): (160, 512), (480, 640): (384, 512)}),
        ("1 3 256 512", {(375, 1242): (256, 512)}),
    ],
)
def test_the_size_at_which_a_picture_goes_in(tmp_path: Path, inputs, sizes) -> None:
    """Its own shape in multiples of 32, at most 1024 along the longer side, unless the graph has sizes of its own."""
    network = pixel_model(str(segmentation(tmp_path / "n.onnx", 19, "o ?", inputs=inputs)), CONFIG)
    assert {own: network.size(*own) for own in sizes} == sizes


def test_label_dataset_is_chosen_once() -> None:
    """34 raw numbers stay raw in a frame whose own would pass for others; one that nobody has spoils all that follow."""
    numbers = np.array([[0, -1, 255], [18, 13, 10]])
    for table in (LabelTable(NUMBERS_OF_IMAGES), LabelTable({"": CITYSCAPES})):
        assert table.classes(numbers).tolist() == [[C.GROUND, UNLABELLED, UNLABELLED], [C.CYCLIST, C.VEHICLE, C.SKY]]
    for wrong in (-2, 70000):
        assert "which are no classes" in error_of(lambda wrong=wrong: table.classes(np.array([3, wrong])))
    table, low = LabelTable(NUMBERS_OF_IMAGES), np.array([[7, 8], [11, 255]])
    assert table.classes(low).tolist() == [[C.SIGN, C.VEGETATION], [C.PERSON, UNLABELLED]]
    assert table.guess == "cityscapes"
    table.classes(np.array([26, 33]))
    assert table.guess == "cityscapes_raw"
    assert table.classes(low).tolist() == [[C.GROUND, C.GROUND], [C.BUILDING, UNLABELLED]]
    for numbers in (np.array([60]), low):
        assert "7 to 60 so far, are those of no known" in error_of(lambda numbers=numbers: table.classes(numbers))


@pytest.mark.parametrize(
    ("classes", "outputs", "level", "says"),
    [
        (19, "edge 1 1 256 512", 77, "a network for a single class"),
        (60, "argmax 1 256 512", 254, "class numbers, 59 to 59 so far, are those of no known dataset"),
    ],
)
def test_outputs_that_turn_out_to_hold_no_classes(tmp_path: Path, classes: int, outputs: str, level: int, says: str) -> None:
    network = pixel_model(str(segmentation(tmp_path / "n.onnx", classes, outputs)), CONFIG)
    assert says in error_of(lambda: network(frame_of(DARK + np.uint8(level)), later()))


def test_the_first_run_of_a_network_of_any_size_can_be_broken_off(tmp_path: Path) -> None:
    """What it gives is not seen before it runs; that run ends with the call's own deadline, and the next call tries again."""
    frame, asked = frame_of(DARK), itertools.count()
    network = pixel_model(str(endless(tmp_path / "slow.onnx", above=-9.0, size=("h", "w"))), CONFIG)
    assert "output known after its first run" in network.describe()
    with pytest.raises(BudgetError, match="no longer wanted"):
        network(frame, Deadline(600, lambda: next(asked) > 5))
    with pytest.raises(BudgetError, match=r"budget of 0\.2 s"):
        network(frame, Deadline(0.2))
    network = pixel_model(str(endless(tmp_path / "quick.onnx", size=("h", "w"))), CONFIG)
    assert (network(frame, later()).classes == C.GROUND).all()
    assert "output: scores of 19 classes" in network.describe()
    scans = point_model(str(scan_network(tmp_path, "bonnetal", size=(64, "w"))), CONFIG)
    with pytest.raises(BudgetError, match="no longer wanted"):
        scans(frame_of(DARK, cloud=scan()), Deadline(60, lambda: True))
    assert "output known after its first run" in scans.describe()


def test_a_network_of_any_size_that_gives_no_classes_says_so_in_its_first_run(tmp_path: Path) -> None:
    nodes = [helper.make_node("NonZero", ["i"], ["places"])]
    path = save(tmp_path / "n.onnx", nodes, [value("i", shape_of(DYNAMIC))], [value("places", None, Type.INT64)])
    network = pixel_model(str(path), CONFIG)
    for _ in range(2):
        text = error_of(lambda: network(frame_of(DARK), later()))
        assert "none of its outputs is a map of classes for an input of 256x512 (places 4x393216); known are scores" in text


# Of a scanner with 64 rings and 1024 columns per turn, whose every ray has its own pixel in the range image of that size.
HIGH, LOW = 3.0, -25.0


def scan(columns: int = 1024) -> PointCloud:
    """Every direction once, ring after ring from the top; ranges vary smoothly from 3 to 75 m, intensities from 0 to 1."""
    down, turn = np.meshgrid((np.arange(64) + 0.5) / 64, (np.arange(columns) + 0.5) / columns, indexing="ij")
    pitch, yaw = np.deg2rad(HIGH - (HIGH - LOW) * down), (2 * turn - 1) * np.pi
    distance = 39 + 36 * np.sin(2 * yaw + 6 * down)
    towards = np.stack([np.cos(pitch) * np.cos(-yaw), np.cos(pitch) * np.sin(-yaw), np.sin(pitch)], axis=-1)
    xyz = (distance[..., None] * towards).reshape(-1, 3).astype(np.float32)
    return PointCloud(xyz, (0.5 + 0.5 * np.cos(5 * yaw - 3 * down)).ravel().astype(np.float32))


def classes_of(network: SegmentationModel, cloud: PointCloud) -> np.ndarray:
    return network(frame_of(DARK, cloud=cloud), later())


BANDS = {"range": (0.0, 80.0), "x": (-80.0, 80.0), "y": (-80.0, 80.0), "z": (-32.0, 4.0), "remission": (0.0, 1.0)}
FAMILIES = {
    "bonnetal": (RANGE_FIRST[:5], BONNETAL, SEMANTIC_KITTI),
    "cenet": (RANGE_FIRST[:5], CENET, SEMANTIC_KITTI),
    "squeezeseg": (XYZ_FIRST[:5], BONNETAL, ["unknown", "car", "pedestrian", "cyclist"]),
}


def scan_network(folder: Path, family: str, channel: str = "range", name: str = "network", **graph) -> Path:
    order, statistics, names = FAMILIES[family]
    at = centres(len(names), *BANDS[channel])
    mean, std = ([statistics[c][k] for c in order] for k in (0, 1))
    return range_network(folder / f"{name}.onnx", at, order.index(channel), mean, std, **graph)


def assert_labels(network: SegmentationModel, family: str, channel: str, cloud: PointCloud, share: float = 1.0) -> None:
    """Points get the class of the band that their own value lies in, but for those at its border."""
    names, (low, high) = FAMILIES[family][2], BANDS[channel]
    x, y, z = cloud.xyz.T
    own = {"range": np.linalg.norm(cloud.xyz, axis=1), "x": x, "y": y, "z": z, "remission": cloud.intensity}[channel]
    band = (own - low) / (high - low) * len(names)
    found = classes_of(network, cloud)
    assert found.shape == (len(cloud),)
    assert found.dtype == np.uint8
    clear = np.abs(band - np.rint(band)) > 0.02
    assert (found[clear] == lookup(names)[np.floor(band[clear]).astype(int)]).mean() >= share


TOLD = f"mean: {[CENET[c][0] for c in RANGE_FIRST[:5]]}\nstd: {[CENET[c][1] for c in RANGE_FIRST[:5]]}"
EXPORTS |= {
    "SalsaNext": ("bonnetal", {"name": "salsanext"}, "", BANDS),
    "CENet": ("cenet", {"name": "CENet_64x1024"}, "", BANDS),
    "SqueezeSeg": ("squeezeseg", {}, "", BANDS),
    "softmax": ("bonnetal", {"outputs": ["softmax"]}, ""),
    "class numbers": ("bonnetal", {"outputs": ["argmax"]}, ""),
    "auxiliary heads": ("cenet", {"outputs": ["output", "aux_2", "aux_4", "aux_8"]}, "family: cenet"),
    "three heads": ("bonnetal", {"outputs": ["output", "aux_2", "aux_4"]}, ""),
    "dynamic": ("bonnetal", {"size": ("height", "width")}, ""),
    "dynamic SqueezeSeg": ("squeezeseg", {"size": ("height", "width")}, ""),
    "dynamic width": ("bonnetal", {"size": (64, "width"), "outputs": ["softmax"]}, ""),
    "scan, channels last": ("squeezeseg", {"last": True}, ""),
    "mask": ("squeezeseg", {"last": True, "mask": [1, 64, 1024, 1]}, ""),
    "mask without channel": ("squeezeseg", {"mask": [1, 64, 1024]}, ""),
    "mask first": ("bonnetal", {"mask": [1, 1, 64, 1024]}, ""),
    "class numbers of SqueezeSeg": ("squeezeseg", {"outputs": ["argmax"], "mask": [1, 64, 1024]}, ""),
    "family told": ("cenet", {}, "family: CENet"),
    "channels told": ("squeezeseg", {}, "channels: [x, y, z, intensity, depth]"),
    "statistics told": ("cenet", {}, TOLD),
}


@pytest.mark.parametrize("name", EXPORTS)
def test_every_export_puts_every_class_at_its_place(tmp_path: Path, name: str) -> None:
    first, *others = EXPORTS[name]
    (assert_scan if isinstance(first, str) else assert_picture)(tmp_path, first, *others)


def assert_picture(folder: Path, expected: tuple, graph: dict) -> None:
    classes, names, size, margin, channel, yaml, says = expected
    own = {key: given for key, given in graph.items() if key != "names_of_tensors"}
    path = segmentation(folder / "n.onnx", classes, names=graph.get("names_of_tensors"), **own)
    network = pixel_model(str(beside(path, yaml)), CONFIG)
    for first in (0, 11) if classes > ROWS * COLUMNS else (0,):
        numbers = blocks(*size, classes, first)
        image = picture(numbers, classes, channel or 0)
        found = network(frame_of(image if channel is not None else image[..., 0].copy()), later()).classes
        assert found.shape == size
        assert found.dtype == np.uint8
        keep = inner(numbers, margin)
        assert keep.mean() > 0.3
        assert np.array_equal(found[keep], lookup(names)[numbers[keep]])
    scores = any(not part.strip().startswith(("argmax", "edge")) for part in graph["outputs"].split(";"))
    assert (f"scores of {classes} classes" if scores else "class numbers") in network.describe()
    assert says in network.describe()


def assert_scan(folder: Path, family: str, graph: dict, yaml: str, channels: Iterable[str] = ("range", "y")) -> None:
    for channel in channels:
        network = point_model(str(beside(scan_network(folder, family, channel, **graph), yaml)), CONFIG)
        assert_labels(network, family, channel, scan())
        assert network.note == ""
        assert channels is not BANDS or network.describe().startswith(f"{family}: 64x1024 ")


def test_assumed_statistics_are_said(tmp_path: Path) -> None:
    """Several outputs may be CENet's, whose mean and std are others."""
    said, heads = "(of bonnetal, assumed; say family: cenet, or mean and std, for others)", {"outputs": ["output", "aux_2"]}
    path = scan_network(tmp_path, "bonnetal", **heads)
    assert said in point_model(str(path), CONFIG).describe()
    for text in ("family: cenet", "family: bonnetal", TOLD):
        assert said not in point_model(str(beside(path, text)), CONFIG).describe()
    for other in (scan_network(tmp_path, "cenet", name="cenet", **heads), scan_network(tmp_path, "bonnetal", name="one")):
        assert said not in point_model(str(other), CONFIG).describe()


def test_empty_pixels_are_zero_and_far_points_do_not_hide_near_ones(tmp_path: Path) -> None:
    # Two points of one direction in the first pixel row of the left half, and one on the right.
    ahead = np.array([[10, 10, 0], [5, 5, 0], [8, -8, 0]], np.float32)
    view = range_view(ahead, (64, 1024), (3.0, -25.0))
    row = int((1 - 25 / 28) * 64)
    assert np.argwhere(view.index >= 0).tolist() == [[row, 384], [row, 640]]  # 45 deg to the left, and to the right
    assert view.index[row, 384] == 1  # the nearer of two
    many = np.concatenate([ahead, np.tile(ahead[2:], (200, 1))])
    feeds, _, note = point_model(str(scan_network(tmp_path, "bonnetal")), CONFIG).feed(PointCloud(many))
    image = feeds["input"][0]
    assert (image[:, view.index < 0] == 0).all()
    expected = [(np.sqrt(50) - 12.12) / 12.32, (5 - 10.88) / 11.47, (5 - 0.23) / 6.91, 1.04 / 0.86, -0.21 / 0.16]
    assert np.allclose(image[:, row, 384], expected, atol=1e-5)
    assert "no intensity" in note


def test_the_borders_of_the_range_image() -> None:
    """Elevations just out of the field of view go to the first and the last row; straight back is at the sides."""
    xyz = np.array([[10, 0, 0.9], [10, 0, -5.1], [-10, 1e-4, 0], [-10, -1e-4, 0], [-10, 0, 0]], np.float32)
    view = range_view(xyz, (64, 512), (3.0, -25.0))
    assert view.row[:2].tolist() == [0, 63]
    assert view.column.tolist() == [256, 256, 0, 511, 0]
    assert range_view(np.array([[10, 0, 1.1], [10, 0, -5.4]], np.float32), (64, 512), (3.0, -25.0)).index.max() == -1
    quarter = range_view(xyz, (64, 512), (3.0, -25.0), 90.0)
    assert quarter.inside.tolist() == [True, True, False, False, False]
    assert quarter.index.max() == 1


def test_points_without_a_return_have_no_class(tmp_path: Path) -> None:
    cloud = scan()
    xyz = cloud.xyz.copy()
    xyz[::3], xyz[1::7] = np.nan, 0
    network = point_model(str(scan_network(tmp_path, "bonnetal")), CONFIG)
    plain, found = (classes_of(network, given) for given in (cloud, PointCloud(xyz, cloud.intensity)))
    lost = ~PointCloud(xyz).finite_mask()
    assert (found[lost] == UNLABELLED).all()
    assert np.array_equal(found[~lost], plain[~lost])
    assert "usable points" in error_of(lambda: network(frame_of(DARK), later()))


def test_the_width_follows_the_scan(tmp_path: Path) -> None:
    """A network of any width runs at that of the scan; one of another width works, and says that it does not fit."""
    dynamic = point_model(str(scan_network(tmp_path, "bonnetal", name="any", size=(64, "w"))), CONFIG)
    for columns, width in ((480, 512), (512, 512), (1024, 1024), (1800, 2048), (2048, 2048)):
        feeds, _, note = dynamic.feed(scan(columns))
        assert (feeds["input"].shape[3], note) == (width, "")
    fixed = point_model(str(scan_network(tmp_path, "bonnetal", name="fixed")), CONFIG)
    for columns in (512, 2048):
        classes_of(fixed, scan(columns))
        assert f"takes 1024 columns per turn, but the scan has {columns}" in fixed.note
    classes_of(fixed, scan())
    assert fixed.note == ""


def test_another_field_of_view(tmp_path: Path) -> None:
    path, cloud = scan_network(tmp_path, "bonnetal", "z"), scan()
    tilted = PointCloud(cloud.xyz * np.array([1, 1, -1], np.float32), cloud.intensity)
    network = point_model(str(path), CONFIG)
    classes_of(network, tilted)
    assert "of the points lie outside of the elevations -25 to +3 deg" in network.note
    network = point_model(str(beside(path, "fov_deg: [25, -3]")), CONFIG)
    classes_of(network, tilted)
    assert network.note == ""
    assert "-3 to +25 deg" in network.describe()


def test_a_network_for_a_part_of_the_turn(tmp_path: Path) -> None:
    """SqueezeSeg's own networks see the quarter ahead, in columns as dense as the scanner's."""
    path = beside(scan_network(tmp_path, "squeezeseg", "y", size=(64, 512)), "azimuth_deg: 90")
    network, cloud = point_model(str(path), CONFIG), scan(2048)
    found = classes_of(network, cloud)
    assert network.note == ""
    ahead = np.abs(np.arctan2(cloud.xyz[:, 1], cloud.xyz[:, 0])) < np.deg2rad(45)
    assert (found[~ahead] == UNLABELLED).all()
    assert_labels(network, "squeezeseg", "y", cloud.select(ahead))


def test_classes_of_a_street_come_back_to_its_points() -> None:
    """True classes in the pixels: nearly all points get theirs back, hidden ones and those of thin things too."""
    cloud = SyntheticDrive(seed=2, frames=1, rings=64, width=64, height=48)[0].cloud.finite()
    for width, share in ((2048, 0.99), (1024, 0.985), (512, 0.975)):
        view = range_view(cloud.xyz, (64, width), (3.0, -25.0))
        pixels = np.where(view.index >= 0, cloud.label[view.index], np.uint8(UNLABELLED))
        found = classes_of_points(view, pixels)
        assert np.mean(found == cloud.label) > share
        taken = pixels[view.row, view.column]
        behind = np.abs(view.ranges[view.row, view.column] - view.range) > 5
        assert np.mean(found[behind] == cloud.label[behind]) > np.mean(taken[behind] == cloud.label[behind]) + 0.2


def test_labels_of_the_source(drive: SyntheticDrive) -> None:
    frame = drive[0]
    pixels, points = pixel_model("source", CONFIG), point_model("source", CONFIG)
    assert np.array_equal(pixels(frame, later()).classes, frame.classes)
    known = np.where(frame.cloud.finite_mask(), frame.cloud.label, UNLABELLED)
    assert np.array_equal(points(frame, later()), known)
    bare = replace(frame, classes=None, cloud=replace(frame.cloud, label=None))
    assert "has no classes of pixels" in error_of(lambda: pixels(bare, later()))
    assert "has no classes of points" in error_of(lambda: points(bare, later()))
    with pytest.raises(BudgetError):
        pixels(frame, Deadline(0.0))
    assert "source" in pixels.describe() + points.describe()


@pytest.mark.parametrize("palette", [False, True])
@pytest.mark.parametrize(("bits", "labels"), [(1, CAMVID), (2, CAMVID), (4, {1: "sky", 7: "car", 15: "tree", 3: "person"})])
def test_label_pictures_of_few_bits(tmp_path: Path, bits: int, labels, palette: bool) -> None:
    """As they are written where there are few classes; the width is no multiple of a byte."""
    numbers = blocks(90, 161, 2**bits)
    (tmp_path / "labels.yaml").write_text(f"labels: {'camvid' if labels is CAMVID else labels}")
    (tmp_path / "a.png").write_bytes(png(numbers, bits, palette))
    found = pixel_model(str(tmp_path), CONFIG)(frame_of(np.zeros((90, 161, 3), np.uint8), "a"), later()).classes
    assert np.array_equal(found, lookup(labels)[numbers])


def encoded(numbers: np.ndarray) -> bytes:
    return cv2.imencode(".png", numbers)[1].tobytes()


def test_a_folder_of_label_pictures(tmp_path: Path) -> None:
    assert "holds no label pictures *.png" in error_of(lambda: pixel_model(str(tmp_path), CONFIG))
    numbers = blocks(90, 160, 34).astype(np.uint8)
    frame = frame_of(np.zeros((90, 160, 3), np.uint8), "1317.000000005")
    for data in (encoded(numbers), encoded(numbers.astype(np.uint16)), png(numbers, 8, True)):
        (tmp_path / "1317.000000005.png").write_bytes(data)
        assert np.array_equal(pixel_model(str(tmp_path), CONFIG)(frame, later()).classes, lookup(CITYSCAPES_RAW)[numbers])
    # For a picture of twice the size.
    double = frame_of(np.zeros((180, 320), np.uint8), frame.name)
    expected = lookup(CITYSCAPES_RAW)[numbers].repeat(2, axis=0).repeat(2, axis=1)
    folder = pixel_model(str(tmp_path), CONFIG)
    assert np.array_equal(folder(double, later()).classes, expected)
    assert folder.describe() == "folder of 1 label pictures *.png"
    (tmp_path / "labels.yaml").write_text("labels: camvid")
    assert np.array_equal(pixel_model(str(tmp_path), CONFIG)(frame, later()).classes, lookup(CAMVID)[numbers])
    (tmp_path / "labels.yaml").write_text("labels: {0: sky, 1: cow}")
    assert "labels.yaml: class name 'cow'" in error_of(lambda: pixel_model(str(tmp_path), CONFIG))


def test_label_pictures_that_cannot_be_used(tmp_path: Path) -> None:
    frame = frame_of(np.zeros((90, 160, 3), np.uint8), "a")
    numbers = blocks(90, 160, 34).astype(np.uint8)
    (tmp_path / "a.png").write_bytes(encoded(numbers))
    folder = pixel_model(str(tmp_path), CONFIG)
    assert "b.png cannot be read" in error_of(lambda: folder(replace(frame, name="b"), later()))
    for name in ("", "../a", "x/a"):
        assert "is no plain file name: label pictures" in error_of(lambda name=name: folder(replace(frame, name=name), later()))
    for data, says in (
        (encoded(numbers)[:-20], "is not a complete PNG"),
        (b"", "is not a complete PNG"),
        (b"text", "is not a complete PNG"),
        (png(numbers, 8, True)[:200], "is not a complete PNG"),
        (png(numbers % 16, 4, True)[:200], "is not a complete PNG"),
        (encoded(np.dstack([numbers] * 3)), "has colours"),
        (encoded(numbers[:, :100]), "is 100x90, but the image 160x90"),
    ):
        (tmp_path / "a.png").write_bytes(data)
        assert says in error_of(lambda: folder(frame, later()))


def test_a_folder_of_label_files(tmp_path: Path) -> None:
    assert "holds no label files *.label" in error_of(lambda: point_model(str(tmp_path), CONFIG))
    cloud = PointCloud(np.array([[5, 0, 0], [6, 1, 0], [7, 0, 1], [np.nan] * 3, [9, 9, 0], [4, 4, 4]], np.float32))
    frame = frame_of(DARK, "000007", cloud)
    numbers = np.array([10, 252 + (3 << 16), 80, 40, 0, 71], "<u4")  # instances stand in the upper half
    numbers.tofile(tmp_path / "000007.label")
    folder = point_model(str(tmp_path), CONFIG)
    assert folder(frame, later()).tolist() == [C.VEHICLE, C.VEHICLE, C.POLE, UNLABELLED, UNLABELLED, C.VEGETATION]
    assert folder.describe() == "folder of 1 label files *.label"
    (tmp_path / "labels.yaml").write_text("labels: {10: person, 80: building}")
    found = point_model(str(tmp_path), CONFIG)(frame, later()).tolist()
    assert found == [C.PERSON, UNLABELLED, C.BUILDING, UNLABELLED, UNLABELLED, UNLABELLED]
    for wrong in (numbers[:-1], np.append(numbers, 0), numbers.view(np.uint8)[:-1]):
        wrong.tofile(tmp_path / "000007.label")
        assert "but the cloud 6 points" in error_of(lambda: folder(frame, later()))
    assert "000008.label cannot be read" in error_of(lambda: folder(replace(frame, name="000008"), later()))
