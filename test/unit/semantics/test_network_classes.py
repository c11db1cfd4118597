"""Classes of pixels and points from networks of every known convention, label files, and the source."""

from __future__ import annotations

import itertools
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from onnx import TensorProto as Type
from onnx import helper
from onnx_graphs import centres, endless, failing, range_network, save, segmentation, value

from calib_ros.camera import Camera
from calib_ros.config import SemanticsConfig
from calib_ros.datasets.kitti import KittiSource
from calib_ros.errors import BudgetError, ModelError
from calib_ros.frame import UNLABELLED, Frame, PointCloud
from calib_ros.frame import SemanticClass as C
from calib_ros_semantics.models.cloud_classes import (
    BONNETAL,
    CENET,
    RANGE_FIRST,
    XYZ_FIRST,
    CloudClasses,
    CloudInput,
    classes_of_points,
    range_view,
)
from calib_ros_semantics.models.image_classes import ImageClasses, ImageInput
from calib_ros_semantics.models.labels import (
    CAMVID,
    CITYSCAPES,
    CITYSCAPES_RAW,
    NUMBERS_OF_IMAGES,
    OF_IMAGES,
    SEMANTIC_KITTI,
    GuessedTable,
    LabelTable,
    lookup,
)
from calib_ros_semantics.models.onnx_model import Deadline, OnnxModel
from calib_ros_synthetic.drive import SyntheticDrive

CONFIG = SemanticsConfig()
ROWS, COLUMNS = 3, 7  # blocks of the picture
NO_POINTS = PointCloud(np.full((1, 3), np.nan, np.float32))


def later() -> Deadline:
    return Deadline(60)


def frame_of(image: np.ndarray, cloud: PointCloud = NO_POINTS, **more) -> Frame:
    height, width = image.shape[:2]
    return Frame(
        image, cloud, Camera(np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]]), width, height), **more
    )


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


def assert_sees(network: ImageClasses, classes: int, names, size=(375, 1242), margin: int = 6, channel: int = 2) -> None:
    """The network puts every class at its place in a picture of a size of its own."""
    for first in (0, 11):
        numbers = blocks(*size, classes, first)
        found = network(frame_of(picture(numbers, classes, channel)), later())
        assert found.shape == size
        assert found.dtype == np.uint8
        keep = inner(numbers, margin)
        assert keep.mean() > 0.3
        assert np.array_equal(found[keep], lookup(names)[numbers[keep]])


TRAIN_AND_BACKGROUND = [*CITYSCAPES, "background"]
STATIC = (1, 3, 256, 512)
DYNAMIC = ("batch", 3, "height", "width")
# Name -> (classes, names of them, margin in pixels where strides blur, arguments of the graph).
CAMERA_NETWORKS = {
    "mmsegmentation argmax": (19, CITYSCAPES, 6, {"outputs": [("argmax", [1, 1, 256, 512])], "names": ("input", "s")}),
    "mmsegmentation dynamic": (19, CITYSCAPES, 6, {"inputs": DYNAMIC, "outputs": [("argmax", ["batch", 1, "h", "w"])]}),
    "mmsegmentation logits": (19, CITYSCAPES, 6, {"outputs": [("output", [1, 19, 256, 512])], "names": ("input", "output")}),
    "PIDNet": (19, CITYSCAPES, 40, {"outputs": [("output", [1, 19, 32, 64])], "names": ("input", "output"), "stride": 8}),
    "PIDNet three heads": (
        *(19, CITYSCAPES, 40),
        {
            "outputs": [("aux", [1, 19, 32, 64]), ("s", [1, 19, 32, 64]), ("edge", [1, 1, 32, 64])],
            "names": ("input", "s"),
            "stride": 8,
        },
    ),
    "PIDNet three heads alike": (
        *(19, CITYSCAPES, 40),
        {"inputs": DYNAMIC, "outputs": [("aux", None), ("s", None), ("aux2", None)], "names": ("input", "s"), "stride": 8},
    ),
    "DDRNet": (
        *(19, CITYSCAPES, 40),
        {"outputs": [("1173", [1, 19, 32, 64]), ("aux", [1, 19, 32, 64])], "names": ("x.1", "1173"), "stride": 8},
    ),
    "torchvision": (
        *(21, None, 6),
        {"inputs": DYNAMIC, "outputs": [("out", ["b", 21, "h", "w"]), ("aux", ["b", 21, "h", "w"])], "names": ("image", "out")},
    ),
    "SegFormer": (
        *(19, CITYSCAPES, 20),
        {
            "inputs": ("batch_size", "num_channels", "height", "width"),
            "outputs": [("logits", ["batch_size", "num_labels", "height", "width"])],
            "names": ("pixel_values", "logits"),
            "stride": 4,
        },
    ),
    "SegFormer ADE20K": (
        *(150, None, 20),
        {
            "outputs": [("logits", [1, 150, 128, 128])],
            "inputs": (1, 3, 512, 512),
            "names": ("pixel_values", "logits"),
            "stride": 4,
        },
    ),
    "EdgeNets": (20, TRAIN_AND_BACKGROUND, 6, {"outputs": [("o", [1, 20, 256, 512])], "names": ("input", "o")}),
    "raw ids": (34, CITYSCAPES_RAW, 6, {"outputs": [("o", [1, 34, 256, 512])], "names": ("input", "o")}),
    "raw ids chosen": (34, CITYSCAPES_RAW, 6, {"outputs": [("argmax", [1, 256, 512])]}),
    "CamVid": (11, CAMVID, 6, {"outputs": [("o", [1, 11, 256, 512])], "names": ("input", "o")}),
    "channels last": (
        *(19, CITYSCAPES, 6),
        {"inputs": (1, 256, 512, 3), "outputs": [("o", [1, 256, 512, 19])], "names": ("i", "o"), "form": "NHWC to NHWC"},
    ),
    "no batch": (
        *(19, CITYSCAPES, 6),
        {"inputs": (3, 256, 512), "outputs": [("o", [19, 256, 512])], "names": ("i", "o"), "form": "CHW to CHW"},
    ),
    "grey levels": (
        *(19, CITYSCAPES, 6),
        {
            **{"inputs": (1, "h", "w", 3), "outputs": [("argmax int32", None)], "form": "NHWC", "kind": Type.UINT8},
            **{"normal": ((0.0,) * 3, (1 / 255,) * 3)},
        },
    ),
    "half floats": (19, CITYSCAPES, 6, {"outputs": [("s", [1, 19, 256, 512])], "names": ("i", "s"), "kind": Type.FLOAT16}),
    "numbers as floats": (19, CITYSCAPES, 6, {"outputs": [("argmax float", [1, 1, 256, 512])]}),
    "enlarged inside": (
        *(19, CITYSCAPES, 10),
        {"inputs": (1, 3, 128, 256), "outputs": [("s", [1, 19, 256, 512])], "names": ("i", "s"), "enlarged": 2},
    ),
    "numbers enlarged inside": (19, CITYSCAPES, 6, {"inputs": DYNAMIC, "outputs": [("argmax", None)], "enlarged": 4}),
    "numbers after their confidence": (
        *(19, CITYSCAPES, 6),
        {"outputs": [("edge", [1, 1, 256, 512]), ("argmax", [1, 1, 256, 512])]},
    ),
    "nothing told": (19, CITYSCAPES, 6, {"inputs": None, "outputs": [("s", None)], "names": ("i", "s")}),
    "scores before numbers": (
        *(19, CITYSCAPES, 6),
        {"outputs": [("argmax", [1, 1, 256, 512]), ("s", [1, 19, 256, 512])], "names": ("i", "s")},
    ),
    "names in the file": (
        *(3, ["car", "sky", "tree"], 6),
        {
            **{"outputs": [("o", [1, 3, 256, 512])], "names": ("i", "o")},
            "metadata": {"names": "{0: 'car, auto', 1: 'sky', 2: 'tree'}"},
        },
    ),
    "names of things we have no class for": (
        *(3, ["object", "person", "void"], 6),
        {
            **{"outputs": [("o", [1, 3, 256, 512])], "names": ("i", "o")},
            "metadata": {"id2label": '{"0": "zebra", "1": "person", "2": "background"}'},
        },
    ),
}


@pytest.mark.parametrize("name", CAMERA_NETWORKS)
def test_networks_for_pictures(tmp_path: Path, name: str) -> None:
    classes, names, margin, graph = CAMERA_NETWORKS[name]
    size = (375, 1242) if classes < 100 else (500, 520)  # 150 classes cannot be told within half a cell of a border
    graph = {"inputs": STATIC, **graph}
    network = ImageClasses(str(segmentation(tmp_path / "network.onnx", classes, **graph)), CONFIG)
    assert_sees(network, classes, names or OF_IMAGES[classes], size, margin)
    counts = (
        "class numbers" if all(o[0].startswith(("argmax", "edge")) for o in graph["outputs"]) else f"scores of {classes} classes"
    )
    assert counts in network.describe()
    assert network.describe().startswith(
        {"SegFormer": "SegFormer", "torchvision": "torchvision", "EdgeNets": "EdgeNets"}.get(name, "")
    )
    assert network.describe().startswith("PIDNet with") == name.startswith("PIDNet three")


def test_assumed_label_dataset_is_reported(tmp_path: Path) -> None:
    path = segmentation(tmp_path / "n.onnx", 34, outputs=[("argmax", [1, 256, 512])])
    network = ImageClasses(str(path), CONFIG)
    assert "argmax: class numbers, assumed to be cityscapes without labels: in its YAML, on cpu" in network.describe()
    network(frame_of(picture(np.full((64, 128), 26), 34)), later())
    assert "assumed to be cityscapes_raw without" in network.describe()
    found = network(frame_of(picture(np.full((64, 128), 7), 34)), later())
    assert (found == C.GROUND).all()
    assert ImageClasses(str(beside(path, "labels: camvid")), CONFIG).describe().endswith("argmax: class numbers, on cpu")


def test_the_family_of_a_network_for_pictures(tmp_path: Path) -> None:
    """A name of a known one is taken for it, whatever its case; PIDNet's counts where nothing else tells its three outputs."""
    heads = {"outputs": [(n, [1, 19, 64, 128]) for n in ("aux", "s", "aux2")], "names": ("i", "s"), "inputs": (1, 3, 64, 128)}
    path = beside(segmentation(tmp_path / "n.onnx", 19, **heads), "family: pidnet")
    assert (
        ImageClasses(str(path), CONFIG)
        .describe()
        .startswith("PIDNet: 128x64 RGB (pictures of another shape in tiles), fed as (v / 255 - [0.485, 0.456, ")
    )
    assert "-> aux: scores" in ImageClasses(str(beside(path, "family: DDRNet")), CONFIG).describe()


def test_the_picture_is_not_turned_and_edges_stay_where_they_are(tmp_path: Path) -> None:
    """Scores in eighths: the edge of two classes comes back within a pixel, in a picture that is no multiple of anything."""
    path = segmentation(tmp_path / "n.onnx", 19, inputs=DYNAMIC, outputs=[("o", ["b", 19, "h", "w"])], names=("i", "o"), stride=8)
    network = ImageClasses(str(path), CONFIG)
    for height, width, edge in ((256, 1024, 400), (250, 1000, 400), (375, 1242, 500), (480, 640, 320), (1200, 1920, 900)):
        numbers = np.where(np.arange(width)[None] < edge, 8, 9) + np.zeros((height, 1), int)
        found = network(frame_of(picture(numbers, 19)), later())
        assert set(np.unique(found)) == {C.VEGETATION, C.GROUND}
        at = (found == C.VEGETATION).sum(axis=1)
        assert np.abs(at - edge).max() <= max(1, round(width / 1024 * 1.5)), (height, width)
        upright = network(frame_of(np.ascontiguousarray(picture(numbers, 19).transpose(1, 0, 2))), later())
        assert np.abs((upright == C.VEGETATION).sum(axis=0) - edge).max() <= max(1, round(width / 1024 * 1.5))


@pytest.mark.parametrize(
    ("inputs", "sizes"),
    [
        (DYNAMIC, {(375, 1242): (320, 1024), (480, 640): (480, 640), (1200, 1920): (640, 1024), (2000, 1000): (1024, 512)}),
        ((1, 3, 512, "w"), {(375, 1242): (512, 1696), (480, 640): (512, 672)}),
        ((1, 3, "h", 512), {(375, 1242): (160, 512), (480, 640): (384, 512)}),
        (STATIC, {(375, 1242): (256, 512)}),
    ],
)
def test_the_size_at_which_a_picture_goes_in(tmp_path: Path, inputs, sizes) -> None:
    """Its own shape in multiples of 32, at most 1024 along the longer side, unless the graph has sizes of its own."""
    path = segmentation(tmp_path / "n.onnx", 19, inputs=inputs, outputs=[("o", None)], names=("i", "o"))
    network = ImageInput(OnnxModel(path, CONFIG))
    assert {own: network.size(*own) for own in sizes} == sizes


def test_numbers_that_are_to_be_ignored() -> None:
    numbers = np.array([[0, -1, 255], [18, 13, 10]])
    expected = [[C.GROUND, UNLABELLED, UNLABELLED], [C.CYCLIST, C.VEHICLE, C.SKY]]
    assert GuessedTable(NUMBERS_OF_IMAGES).classes(numbers).tolist() == expected
    assert LabelTable(CITYSCAPES).classes(numbers).tolist() == expected
    for wrong in (-2, 70000):
        with pytest.raises(ModelError, match="which are no classes"):
            LabelTable(CITYSCAPES).classes(np.array([3, wrong]))


def test_label_dataset_is_chosen_once() -> None:
    """34 raw numbers stay raw in a frame whose own would pass for others; one that nobody has spoils all that follow."""
    table, low = GuessedTable(NUMBERS_OF_IMAGES), np.array([[7, 8], [11, 255]])
    assert table.classes(low).tolist() == [[C.SIGN, C.VEGETATION], [C.PERSON, UNLABELLED]]
    assert table.guess == "cityscapes"
    table.classes(np.array([26, 33]))
    assert table.guess == "cityscapes_raw"
    assert table.classes(low).tolist() == [[C.GROUND, C.GROUND], [C.BUILDING, UNLABELLED]]
    with pytest.raises(ModelError, match="class numbers, 7 to 60 so far, are those of no known dataset"):
        table.classes(np.array([60]))
    with pytest.raises(ModelError, match="7 to 60 so far"):
        table.classes(low)


def test_grey_pictures(tmp_path: Path) -> None:
    path = segmentation(tmp_path / "n.onnx", 19, outputs=[("o", [1, 19, 256, 512])], names=("i", "o"))
    numbers = blocks(375, 1242, 19)
    found = ImageClasses(str(path), CONFIG)(frame_of(picture(numbers, 19)[..., 2].copy()), later())
    assert np.array_equal(found[inner(numbers, 6)], lookup(CITYSCAPES)[numbers[inner(numbers, 6)]])


def beside(path: Path, text: str) -> Path:
    path.with_suffix(".yaml").write_text(text)
    return path


def test_yaml_beside_a_network(tmp_path: Path) -> None:
    scores = {"outputs": [("o", [1, 5, 64, 128])], "names": ("i", "o"), "inputs": (1, 3, 64, 128)}
    five = ["sky", "car", "road", "void", "tree"]
    # In grey levels, blue first, with names of its own: the graph undoes what the YAML asks for.
    normal = ((103.53 / 255, 116.28 / 255, 123.675 / 255), (57.375 / 255, 57.12 / 255, 58.395 / 255))
    path = segmentation(tmp_path / "bgr.onnx", 5, **scores, normal=normal, channel=0)
    beside(path, f"channels: bgr\nmean: [103.53, 116.28, 123.675]\nstd: [57.375, 57.12, 58.395]\nlabels: {five}")
    assert_sees(ImageClasses(str(path), CONFIG), 5, five, margin=12, channel=0)
    # Only divided by 255.
    path = segmentation(tmp_path / "scaled.onnx", 5, **scores, normal=((0, 0, 0), (1, 1, 1)))
    beside(path, f"scale: 0.00392156862745098\nlabels: {dict(enumerate(five))}")
    assert_sees(ImageClasses(str(path), CONFIG), 5, five, margin=12)
    # A graph of any size at that of the YAML.
    dynamic = {"outputs": [("o", ["b", 19, "h", "w"])], "names": ("i", "o"), "inputs": DYNAMIC}
    path = beside(segmentation(tmp_path / "sized.onnx", 19, **dynamic), "size: [128, 256]\nlabels: cityscapes")
    network = ImageClasses(str(path), CONFIG)
    assert "256x128 RGB" in network.describe()
    assert_sees(network, 19, CITYSCAPES, margin=10)
    # Another output than the one that would have been taken.
    heads = {"outputs": [("aux", [1, 19, 64, 128]), ("o", [1, 19, 64, 128])], "names": ("i", "o"), "inputs": (1, 3, 64, 128)}
    path = beside(segmentation(tmp_path / "second.onnx", 19, **heads), "output: o")
    assert_sees(ImageClasses(str(path), CONFIG), 19, CITYSCAPES, margin=12)
    # Class numbers of another dataset.
    chosen = {"outputs": [("argmax", [1, 1, 64, 128])], "inputs": (1, 3, 64, 128)}
    path = beside(segmentation(tmp_path / "camvid.onnx", 12, **chosen), "labels: camvid")
    assert_sees(ImageClasses(str(path), CONFIG), 12, CAMVID, margin=12)


def test_a_yaml_that_does_not_fit_its_network(tmp_path: Path) -> None:
    for text, says in (
        ("labels: [road, sky]", "names 2 classes by 'labels:', but the network gives scores of 19"),
        ("labels: {19: road}", "but the network gives scores of 19"),
        ("labels: {0: raod}", "class name 'raod' is unknown; map it to one of other, vehicle"),
        ("labels: kitti", "labels = 'kitti' is none of cityscapes"),
        ("output: b", "there is no output 'b'"),
        ("mean: [1, 2]", "'mean:' must have 3 numbers"),
        ("size: [512, 512]", "does not run at the height and width \\[512, 512\\]"),
        ("channels: [range, x]", "must be rgb or bgr"),
        ("family: zzz", "family 'zzz' is unknown; known are mmsegmentation, pidnet"),
    ):
        path = segmentation(tmp_path / "n.onnx", 19, outputs=[("o", [1, 19, 256, 512])], names=("i", "o"))
        with pytest.raises(ModelError, match=says):
            ImageClasses(str(beside(path, text)), CONFIG)


def error_of(make) -> str:
    with pytest.raises(ModelError) as caught:
        make()
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_networks_for_pictures_of_unknown_layout_are_refused(tmp_path: Path) -> None:
    def made(classes: int = 19, **graph) -> Path:
        return segmentation(tmp_path / "n.onnx", classes, **{"names": ("i", "o"), **graph})

    text = error_of(lambda: ImageClasses(str(made(7, outputs=[("o", [1, 7, 256, 512])])), CONFIG))
    assert "scores of 7 classes" in text
    assert "'labels:' in" in text
    assert str(tmp_path / "n.yaml") in text
    assert "inputs: i float32 1x3x256x512; outputs: o float32 1x7x256x512" in text
    # Scores of the whole picture are no map.
    text = error_of(lambda: ImageClasses(str(made(outputs=[("mean", [1, 19, 1, 1])])), CONFIG))
    assert "this looks like a classifier of whole pictures" in text
    text = error_of(lambda: ImageClasses(str(beside(made(outputs=[("mean", [1, 19, 1, 1])]), "labels: cityscapes")), CONFIG))
    (tmp_path / "n.yaml").unlink()
    assert "(mean 1x19x1x1)" in text
    assert "mmsegmentation, PIDNet" in text
    assert "inputs: i float32 1x3x256x512" in text
    text = error_of(lambda: ImageClasses(str(scan_network(tmp_path, "bonnetal")), CONFIG))
    assert "takes one picture as 1x3xHxW" in text
    assert "input float32 1x5x64x1024" in text
    network = ImageClasses(str(made(outputs=[("edge", [1, 1, 256, 512])])), CONFIG)
    text = error_of(lambda: network(frame_of(np.full((64, 64, 3), 77, np.uint8)), later()))
    assert "a network for a single class" in text
    network = ImageClasses(str(made(60, outputs=[("argmax", [1, 256, 512])])), CONFIG)
    text = error_of(lambda: network(frame_of(np.full((64, 64, 3), 254, np.uint8)), later()))
    assert "class numbers, 59 to 59 so far, are those of no known dataset" in text


def test_files_without_a_network_are_refused(tmp_path: Path) -> None:
    for kind in (ImageClasses, CloudClasses):
        assert "no such file" in error_of(lambda kind=kind: kind(str(tmp_path / "gone.onnx"), CONFIG))
    (tmp_path / "text.onnx").write_text("not a model")
    assert "cannot be loaded" in error_of(lambda: ImageClasses(str(tmp_path / "text.onnx"), CONFIG))
    (tmp_path / "folder").mkdir()
    assert "holds no label pictures *.png" in error_of(lambda: ImageClasses(str(tmp_path / "folder"), CONFIG))
    assert "holds no label files *.label" in error_of(lambda: CloudClasses(str(tmp_path / "folder"), CONFIG))


def test_a_network_that_fails_or_takes_too_long(tmp_path: Path) -> None:
    bright, dark = (frame_of(np.full((64, 64, 3), level, np.uint8)) for level in (250, 10))
    network = ImageClasses(str(failing(tmp_path / "fails.onnx")), CONFIG)
    assert "fails.onnx failed: " in error_of(lambda: network(bright, later()))
    network = ImageClasses(str(endless(tmp_path / "endless.onnx")), CONFIG)
    with pytest.raises(BudgetError):
        network(bright, Deadline(0.2))
    with pytest.raises(BudgetError):
        network(dark, Deadline(60, lambda: True))
    assert (network(dark, later()) == C.GROUND).all()


def test_the_first_run_of_a_network_of_any_size_can_be_broken_off(tmp_path: Path) -> None:
    """What it gives is not seen before it runs; that run ends with the call's own deadline, and the next call tries again."""
    frame, asked = frame_of(np.zeros((64, 64, 3), np.uint8)), itertools.count()
    network = ImageClasses(str(endless(tmp_path / "slow.onnx", above=-9.0, size=("h", "w"))), CONFIG)
    assert "output known after its first run" in network.describe()
    with pytest.raises(BudgetError, match="no longer wanted"):
        network(frame, Deadline(600, lambda: next(asked) > 5))
    with pytest.raises(BudgetError, match=r"budget of 0\.2 s"):
        network(frame, Deadline(0.2))
    network = ImageClasses(str(endless(tmp_path / "quick.onnx", size=("h", "w"))), CONFIG)
    assert (network(frame, later()) == C.GROUND).all()
    assert "output: scores of 19 classes" in network.describe()
    scans = CloudClasses(str(scan_network(tmp_path, "bonnetal", size=(64, "w"))), CONFIG)
    with pytest.raises(BudgetError, match="no longer wanted"):
        scans(frame_of(np.zeros((8, 8), np.uint8), scan()), Deadline(60, lambda: True))
    assert "output known after its first run" in scans.describe()


def test_a_network_of_any_size_that_gives_no_classes_says_so_in_its_first_run(tmp_path: Path) -> None:
    nodes = [helper.make_node("NonZero", ["i"], ["places"])]
    path = save(tmp_path / "n.onnx", nodes, [value("i", DYNAMIC)], [value("places", None, Type.INT64)])
    network = ImageClasses(str(path), CONFIG)
    for _ in range(2):
        text = error_of(lambda: network(frame_of(np.zeros((64, 64, 3), np.uint8)), later()))
        assert "none of its outputs is a map of classes for an input of 256x512 (places 4x393216); known are scores" in text
    assert "there is no output 'b'" in error_of(lambda: ImageClasses(str(beside(path, "output: b")), CONFIG))


def test_execution_provider_is_reported(tmp_path: Path) -> None:
    path = segmentation(tmp_path / "n.onnx", 19, outputs=[("o", [1, 19, 256, 512])], names=("i", "o"))
    network = ImageClasses(str(path), SemanticsConfig(provider="tensorrt"))
    if "runs on cpu" in network.fallback:
        assert network.describe().endswith("on cpu")
    assert ImageClasses(str(path), CONFIG).fallback == ""


# Scans: a scanner with 64 rings and 1024 columns per turn whose every ray has its own pixel in the range image of that size.
TURN = 1024
HIGH, LOW = 3.0, -25.0


def scan(columns: int = TURN, seed: int = 0) -> PointCloud:
    """Every direction once, ring after ring from the top; ranges vary smoothly from 3 to 75 m, intensities from 0 to 1."""
    down, turn = np.meshgrid((np.arange(64) + 0.5) / 64, (np.arange(columns) + 0.5) / columns, indexing="ij")
    pitch, yaw = np.deg2rad(HIGH - (HIGH - LOW) * down), (2 * turn - 1) * np.pi
    distance = 39 + 36 * np.sin(2 * yaw + 6 * down + seed)
    towards = np.stack([np.cos(pitch) * np.cos(-yaw), np.cos(pitch) * np.sin(-yaw), np.sin(pitch)], axis=-1)
    xyz = (distance[..., None] * towards).reshape(-1, 3).astype(np.float32)
    return PointCloud(xyz, (0.5 + 0.5 * np.cos(5 * yaw - 3 * down)).ravel().astype(np.float32))


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


def values_of(cloud: PointCloud) -> dict[str, np.ndarray]:
    x, y, z = cloud.xyz.T
    return {"range": np.linalg.norm(cloud.xyz, axis=1), "x": x, "y": y, "z": z, "remission": cloud.intensity}


def assert_labels(network: CloudClasses, family: str, channel: str, cloud: PointCloud, share: float = 1.0) -> None:
    """Points get the class of the band that their own value lies in, but for those at its border."""
    names = FAMILIES[family][2]
    low, high = BANDS[channel]
    band = (values_of(cloud)[channel] - low) / (high - low) * len(names)
    found = network(frame_of(np.zeros((8, 8), np.uint8), cloud), later())
    assert found.shape == (len(cloud),)
    assert found.dtype == np.uint8
    clear = np.abs(band - np.rint(band)) > 0.02
    right = found[clear] == lookup(names)[np.floor(band[clear]).astype(int)]
    assert right.mean() >= share


@pytest.mark.parametrize("channel", BANDS)
@pytest.mark.parametrize(("family", "name"), [("bonnetal", "salsanext"), ("cenet", "CENet_64x1024"), ("squeezeseg", "any")])
def test_networks_for_scans(tmp_path: Path, family: str, name: str, channel: str) -> None:
    network = CloudClasses(str(scan_network(tmp_path, family, channel, name)), CONFIG)
    assert_labels(network, family, channel, scan())
    assert network.describe().startswith(f"{family}: 64x1024 ")
    assert network.note == ""


SCAN_EXPORTS = {
    "softmax": ("bonnetal", {"outputs": ["softmax"]}, ""),
    "class numbers": ("bonnetal", {"outputs": ["argmax"]}, ""),
    "auxiliary heads": ("cenet", {"outputs": ["output", "aux_2", "aux_4", "aux_8"]}, "family: cenet"),
    "three heads": ("bonnetal", {"outputs": ["output", "aux_2", "aux_4"]}, ""),
    "dynamic": ("bonnetal", {"size": ("height", "width")}, ""),
    "dynamic SqueezeSeg": ("squeezeseg", {"size": ("height", "width")}, ""),
    "dynamic width": ("bonnetal", {"size": (64, "width"), "outputs": ["softmax"]}, ""),
    "channels last": ("squeezeseg", {"last": True}, ""),
    "mask": ("squeezeseg", {"last": True, "mask": [1, 64, 1024, 1]}, ""),
    "mask without channel": ("squeezeseg", {"mask": [1, 64, 1024]}, ""),
    "mask first": ("bonnetal", {"mask": [1, 1, 64, 1024]}, ""),
    "class numbers of SqueezeSeg": ("squeezeseg", {"outputs": ["argmax"], "mask": [1, 64, 1024]}, ""),
    "family told": ("cenet", {}, "family: CENet"),
    "channels told": ("squeezeseg", {}, "channels: [x, y, z, intensity, depth]"),
    "statistics told": (
        "cenet",
        {},
        f"mean: {[CENET[c][0] for c in RANGE_FIRST[:5]]}\nstd: {[CENET[c][1] for c in RANGE_FIRST[:5]]}",
    ),
}


@pytest.mark.parametrize("name", SCAN_EXPORTS)
def test_exports_of_networks_for_scans(tmp_path: Path, name: str) -> None:
    family, graph, text = SCAN_EXPORTS[name]
    for channel in ("range", "y"):
        path = beside(scan_network(tmp_path, family, channel, **graph), text)
        assert_labels(CloudClasses(str(path), CONFIG), family, channel, scan())


def test_an_output_that_takes_too_much_memory_is_refused_with_a_size_that_fits(tmp_path: Path) -> None:
    """Before anything of that size is computed."""
    graph = {"inputs": (1, 3, 1024, 2048), "outputs": [("s", [1, 19, 4096, 8192])], "names": ("i", "s"), "enlarged": 4}
    path = segmentation(tmp_path / "large.onnx", 19, **graph)
    with pytest.raises(ModelError, match=r"takes 2\.6 GB for an input of 1024x2048.* export it for 640x1280 or less"):
        ImageClasses(str(path), CONFIG)


def test_an_input_that_takes_too_much_memory_is_refused(tmp_path: Path) -> None:
    """With the argmax inside the output is small, but not what it is made of."""
    path = segmentation(tmp_path / "large.onnx", 19, inputs=(1, 3, 4096, 8192), outputs=[("argmax", [1, 4096, 8192])])
    with pytest.raises(ModelError, match=r"pictures of 4096x8192.* at most 8\.4 million pixels"):
        ImageClasses(str(path), CONFIG)


def test_labels_without_a_class_of_use_are_refused(tmp_path: Path) -> None:
    path = segmentation(tmp_path / "n.onnx", 3, outputs=[("scores", [1, 3, 256, 512])])
    with pytest.raises(ModelError, match="none of its classes is of use here"):
        ImageClasses(str(beside(path, "labels: [object, void, unknown]")), CONFIG)
    assert ImageClasses(str(beside(path, "labels: [object, void, road]")), CONFIG)


def test_limits_of_a_size_are_named(tmp_path: Path) -> None:
    path = segmentation(tmp_path / "n.onnx", 19, inputs=DYNAMIC, outputs=[("s", None)], names=("i", "s"))
    with pytest.raises(ModelError, match=r"\[height, width\], each 8 to 8192 px"):
        ImageClasses(str(beside(path, "size: [16384, 16384]")), CONFIG)


def test_groups_of_neighbours_are_refused_by_name(tmp_path: Path) -> None:
    path = save(
        tmp_path / "mininet.onnx",
        [helper.make_node("Identity", ["image"], ["scores"]), helper.make_node("Identity", ["groups"], ["others"])],
        [value("image", [1, 11, 64, 2048]), value("groups", [1, 11, 16, 8192])],
        [value("scores", [1, 11, 64, 2048]), value("others", [1, 11, 16, 8192])],
    )
    with pytest.raises(ModelError, match="groups of neighbours, as 3D-MiniNet takes them"):
        CloudClasses(str(path), CONFIG)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "(v / 255 - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225] of grey levels v in 0..255 (assumed; its YAML may say"),
        (
            "mean: [104, 117, 123]\nchannels: bgr",
            "BGR (pictures of another shape in tiles), fed as (v - [104, 117, 123]) of grey levels v in 0..255 (as its",
        ),
        ("scale: 1.0", "RGB (pictures of another shape in tiles), fed as v of grey levels v in 0..255 (as its YAML says)"),
        ("scale: 0.5\nstd: [0.25]", "RGB (pictures of another shape in tiles), fed as v * 0.5 / [0.25] of grey levels"),
    ],
)
def test_what_a_network_for_pictures_is_fed_with_is_said(tmp_path: Path, text: str, said: str) -> None:
    path = segmentation(tmp_path / "n.onnx", 19, outputs=[("scores", [1, 19, 256, 512])])
    assert said in ImageClasses(str(beside(path, text)), CONFIG).describe()


def test_assumed_statistics_are_said(tmp_path: Path) -> None:
    """Several outputs may be CENet's, whose mean and std are others."""
    said, heads = "(of bonnetal, assumed; say family: cenet, or mean and std, for others)", {"outputs": ["output", "aux_2"]}
    path = scan_network(tmp_path, "bonnetal", **heads)
    assert said in CloudClasses(str(path), CONFIG).describe()
    statistics = f"mean: {[0.0] * 5}\nstd: {[1.0] * 5}"
    for text in ("family: cenet", "family: bonnetal", statistics):
        assert said not in CloudClasses(str(beside(path, text)), CONFIG).describe()
    for other in (scan_network(tmp_path, "cenet", name="cenet", **heads), scan_network(tmp_path, "bonnetal", name="one")):
        assert said not in CloudClasses(str(other), CONFIG).describe()


def test_empty_pixels_are_zero_and_far_points_do_not_hide_near_ones(tmp_path: Path) -> None:
    # Two points of one direction in the first pixel row of the left half, and one on the right.
    ahead = np.array([[10, 10, 0], [5, 5, 0], [8, -8, 0]], np.float32)
    view = range_view(ahead, (64, 1024), (3.0, -25.0))
    row = int((1 - 25 / 28) * 64)
    assert np.argwhere(view.index >= 0).tolist() == [[row, 384], [row, 640]]  # 45 deg to the left, and to the right
    assert view.index[row, 384] == 1  # the nearer of two
    many = np.concatenate([ahead, np.tile(ahead[2:], (200, 1))])
    feeds, _, note = CloudInput(OnnxModel(scan_network(tmp_path, "bonnetal"), CONFIG)).feed(PointCloud(many))
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
    network = CloudClasses(str(scan_network(tmp_path, "bonnetal")), CONFIG)
    plain = network(frame_of(np.zeros((8, 8), np.uint8), cloud), later())
    found = network(frame_of(np.zeros((8, 8), np.uint8), PointCloud(xyz, cloud.intensity)), later())
    lost = ~PointCloud(xyz).finite_mask()
    assert (found[lost] == UNLABELLED).all()
    assert np.array_equal(found[~lost], plain[~lost])
    assert "usable points" in error_of(lambda: network(frame_of(np.zeros((8, 8), np.uint8)), later()))


def test_the_width_follows_the_scan(tmp_path: Path) -> None:
    """A network of any width runs at that of the scan; one of another width works, and says that it does not fit."""
    frame = {columns: frame_of(np.zeros((8, 8), np.uint8), scan(columns)) for columns in (512, 2048)}
    dynamic = CloudInput(OnnxModel(scan_network(tmp_path, "bonnetal", name="any", size=(64, "w")), CONFIG))
    for columns in (480, 512, 1024, 1800, 2048):
        feeds, _, note = dynamic.feed(scan(columns))
        assert feeds["input"].shape[3] == min((512, 1024, 2048), key=lambda w: abs(np.log(w / columns)))
        assert note == ""
    fixed = CloudClasses(str(scan_network(tmp_path, "bonnetal", name="fixed")), CONFIG)
    for columns, cloud in frame.items():
        assert_labels(fixed, "bonnetal", "y", cloud.cloud, 0.0)
        assert f"takes 1024 columns per turn, but the scan has {columns}" in fixed.note
    fixed(frame_of(np.zeros((8, 8), np.uint8), scan()), later())
    assert fixed.note == ""


def test_another_field_of_view(tmp_path: Path) -> None:
    path = scan_network(tmp_path, "bonnetal", "z")
    cloud = scan()
    tilted = PointCloud(cloud.xyz * np.array([1, 1, -1], np.float32), cloud.intensity)
    network = CloudClasses(str(path), CONFIG)
    network(frame_of(np.zeros((8, 8), np.uint8), tilted), later())
    assert "of the points lie outside of the elevations -25 to +3 deg" in network.note
    beside(path, "fov_deg: [25, -3]")
    network = CloudClasses(str(path), CONFIG)
    network(frame_of(np.zeros((8, 8), np.uint8), tilted), later())
    assert network.note == ""
    assert "-3 to +25 deg" in network.describe()


def test_a_network_for_a_part_of_the_turn(tmp_path: Path) -> None:
    """SqueezeSeg's own networks see the quarter ahead, in columns as dense as the scanner's."""
    path = beside(scan_network(tmp_path, "squeezeseg", "y", size=(64, 512)), "azimuth_deg: 90")
    network, cloud = CloudClasses(str(path), CONFIG), scan(2048)
    found = network(frame_of(np.zeros((8, 8), np.uint8), cloud), later())
    assert network.note == ""
    ahead = np.abs(np.arctan2(cloud.xyz[:, 1], cloud.xyz[:, 0])) < np.deg2rad(45)
    assert (found[~ahead] == UNLABELLED).all()
    assert_labels(network, "squeezeseg", "y", cloud.select(ahead))


def test_classes_of_a_street_come_back_to_its_points() -> None:
    """True classes in the pixels: nearly all points get theirs back, hidden ones and those of thin things too."""
    cloud = SyntheticDrive(seed=2, frames=1, rings=64, width=320, height=96)[0].cloud.finite()
    for width, share in ((2048, 0.99), (1024, 0.985), (512, 0.975)):
        view = range_view(cloud.xyz, (64, width), (3.0, -25.0))
        pixels = np.where(view.index >= 0, cloud.label[view.index], np.uint8(UNLABELLED))
        found = classes_of_points(view, pixels)
        assert np.mean(found == cloud.label) > share
        taken = pixels[view.row, view.column]
        behind = np.abs(view.ranges[view.row, view.column] - view.range) > 5
        assert np.mean(found[behind] == cloud.label[behind]) > np.mean(taken[behind] == cloud.label[behind]) + 0.2


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("family: pointnet", "family 'pointnet' is unknown; known are bonnetal"),
        ("channels: rgb", "must be a list of range, x, y, z, remission, mask"),
        ("channels: [range, x, y, z, colour]", "must be a list of range"),
        ("channels: [range, x, y, z, depth]", "must name each channel once"),
        ("channels: [range, x, y]", "has no axis of 3 channels"),
        ("mean: [1, 2, 3]", "'mean:' must have 5 numbers"),
        ("size: [64, 512]", "does not run at the height and width"),
        ("labels: [car]", "names 1 classes"),
    ],
)
def test_a_yaml_that_does_not_fit_its_network_for_scans(tmp_path: Path, text: str, says: str) -> None:
    path = beside(scan_network(tmp_path, "bonnetal"), text)
    with pytest.raises(ModelError, match=says):
        CloudClasses(str(path), CONFIG)


def test_networks_for_scans_of_unknown_layout_are_refused(tmp_path: Path) -> None:
    camera = segmentation(tmp_path / "n.onnx", 19, outputs=[("o", [1, 19, 256, 512])], names=("i", "o"))
    text = error_of(lambda: CloudClasses(str(camera), CONFIG))
    assert "i has no axis of 5 or 6 channels" in text
    assert "inputs: i float32 1x3x256x512; outputs: o float32 1x19x256x512" in text
    seven = range_network(tmp_path / "seven.onnx", centres(7), 0, [0] * 5, [1] * 5)
    assert "scores of 7 classes, which are of no known dataset (these have 4, 19, 20)" in error_of(
        lambda: CloudClasses(str(seven), CONFIG)
    )


def test_labels_of_the_source(street: list[Frame]) -> None:
    frame = street[0]
    pixels, points = ImageClasses("source", CONFIG), CloudClasses("source", CONFIG)
    assert np.array_equal(pixels(frame, later()), frame.classes)
    returns = frame.cloud.finite_mask()
    found = points(frame, later())
    assert np.array_equal(found[returns], frame.cloud.label[returns])
    assert (found[~returns] == UNLABELLED).all()
    bare = replace(frame, classes=None, cloud=replace(frame.cloud, label=None))
    assert "has no classes of pixels" in error_of(lambda: pixels(bare, later()))
    assert "has no classes of points" in error_of(lambda: points(bare, later()))
    with pytest.raises(BudgetError):
        pixels(frame, Deadline(0.0))
    assert "source" in pixels.describe() + points.describe()


def packed_png(numbers: np.ndarray, bits: int, palette: bool) -> bytes:
    """A PNG (H, W) of so many bits per pixel, of grey levels or with a palette that has nothing to do with its numbers."""
    height, width = numbers.shape
    colours = bytes((37 * k + 11 * c) % 256 for k in range(2**bits) for c in range(3))
    each = np.unpackbits(numbers.astype(np.uint8)[..., None], axis=2)[..., 8 - bits :]
    rows = b"".join(b"\0" + row.tobytes() for row in np.packbits(each.reshape(height, -1), axis=1))
    out = b"\x89PNG\r\n\x1a\n"
    for kind, data in (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, bits, 3 if palette else 0, 0, 0, 0)),
        *([(b"PLTE", colours), (b"tRNS", b"\0")] if palette else []),
        (b"IDAT", zlib.compress(rows)),
        (b"IEND", b""),
    ):
        out += struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    return out


@pytest.mark.parametrize("palette", [False, True])
@pytest.mark.parametrize("bits", [1, 2, 4])
def test_label_pictures_of_few_bits(tmp_path: Path, bits: int, palette: bool) -> None:
    """As they are written where there are few classes; the width is no multiple of a byte."""
    numbers = blocks(90, 161, 2**bits)
    (tmp_path / "labels.yaml").write_text("labels: camvid" if bits < 4 else "labels: {1: sky, 7: car, 15: tree, 3: person}")
    names = CAMVID if bits < 4 else {1: "sky", 7: "car", 15: "tree", 3: "person"}
    (tmp_path / "a.png").write_bytes(packed_png(numbers, bits, palette))
    found = ImageClasses(str(tmp_path), CONFIG)(frame_of(np.zeros((90, 161, 3), np.uint8), name="a"), later())
    assert np.array_equal(found, lookup(names)[numbers])


def test_a_folder_of_label_pictures(tmp_path: Path) -> None:
    numbers = blocks(90, 160, 34)
    frame = frame_of(np.zeros((90, 160, 3), np.uint8), name="1317.000000005")
    grey = cv2.imencode(".png", numbers.astype(np.uint8))[1].tobytes()
    for data in (grey, cv2.imencode(".png", numbers.astype(np.uint16))[1].tobytes(), packed_png(numbers, 8, True)):
        (tmp_path / "1317.000000005.png").write_bytes(data)
        assert np.array_equal(ImageClasses(str(tmp_path), CONFIG)(frame, later()), lookup(CITYSCAPES_RAW)[numbers])
    # For a picture of twice the size.
    double = frame_of(np.zeros((180, 320), np.uint8), name=frame.name)
    expected = lookup(CITYSCAPES_RAW)[numbers].repeat(2, axis=0).repeat(2, axis=1)
    folder = ImageClasses(str(tmp_path), CONFIG)
    assert np.array_equal(folder(double, later()), expected)
    assert folder.describe() == "folder of 1 label pictures *.png"
    (tmp_path / "labels.yaml").write_text("labels: camvid")
    assert np.array_equal(ImageClasses(str(tmp_path), CONFIG)(frame, later()), lookup(CAMVID)[numbers])
    (tmp_path / "labels.yaml").write_text("labels: {0: sky, 1: cow}")
    assert "labels.yaml: class name 'cow'" in error_of(lambda: ImageClasses(str(tmp_path), CONFIG))


def test_label_pictures_of_other_sizes_are_refused(tmp_path: Path) -> None:
    frame = frame_of(np.zeros((90, 160, 3), np.uint8), name="a")
    numbers = blocks(90, 160, 34).astype(np.uint8)
    data = cv2.imencode(".png", numbers)[1].tobytes()
    (tmp_path / "a.png").write_bytes(data)
    folder = ImageClasses(str(tmp_path), CONFIG)
    assert "b.png cannot be read" in error_of(lambda: folder(replace(frame, name="b"), later()))
    for name in ("", "../a", "x/a"):
        assert "is no plain file name: label pictures" in error_of(lambda name=name: folder(replace(frame, name=name), later()))
    for wrong in (data[:-20], b"", b"text", packed_png(numbers, 8, True)[:200], packed_png(numbers % 16, 4, True)[:200]):
        (tmp_path / "a.png").write_bytes(wrong)
        assert "is not a complete PNG" in error_of(lambda: folder(frame, later()))
    (tmp_path / "a.png").write_bytes(cv2.imencode(".png", np.dstack([numbers] * 3))[1].tobytes())
    assert "has colours" in error_of(lambda: folder(frame, later()))
    (tmp_path / "a.png").write_bytes(cv2.imencode(".png", numbers[:, :100])[1].tobytes())
    assert "is 100x90, but the image 160x90" in error_of(lambda: folder(frame, later()))


def test_a_folder_of_label_files(tmp_path: Path) -> None:
    cloud = PointCloud(np.array([[5, 0, 0], [6, 1, 0], [7, 0, 1], [np.nan] * 3, [9, 9, 0], [4, 4, 4]], np.float32))
    frame = frame_of(np.zeros((8, 8), np.uint8), cloud, name="000007")
    numbers = np.array([10, 252 + (3 << 16), 80, 40, 0, 71], "<u4")  # instances stand in the upper half
    numbers.tofile(tmp_path / "000007.label")
    folder = CloudClasses(str(tmp_path), CONFIG)
    found = folder(frame, later()).tolist()
    assert found == [C.VEHICLE, C.VEHICLE, C.POLE, UNLABELLED, UNLABELLED, C.VEGETATION]
    assert folder.describe() == "folder of 1 label files *.label"
    (tmp_path / "labels.yaml").write_text("labels: {10: person, 80: building}")
    found = CloudClasses(str(tmp_path), CONFIG)(frame, later()).tolist()
    assert found == [C.PERSON, UNLABELLED, C.BUILDING, UNLABELLED, UNLABELLED, UNLABELLED]
    for wrong in (numbers[:-1], np.append(numbers, 0), numbers.view(np.uint8)[:-1]):
        wrong.astype(wrong.dtype).tofile(tmp_path / "000007.label")
        assert "but the cloud 6 points" in error_of(lambda: folder(frame, later()))
    assert "000008.label cannot be read" in error_of(lambda: folder(replace(frame, name="000008"), later()))


@pytest.mark.kitti
def test_semantic_kitti_labels_of_a_real_scan(kitti_root: Path) -> None:
    sequence = kitti_root / "odometry/sequences/00"
    frame = KittiSource(sequence)[0]
    found = CloudClasses(str(sequence / "labels"), CONFIG)(frame, later())
    raw = np.fromfile(sequence / "labels/000000.label", "<u4") & 0xFFFF
    assert np.array_equal(found == C.GROUND, np.isin(raw, [40, 44, 48, 49, 60, 72]))
    assert np.array_equal(found == C.POLE, raw == 80)
    assert np.array_equal(found == UNLABELLED, np.isin(raw, [0, 1]))
    height = frame.cloud.xyz[:, 2]
    assert np.median(height[found == C.GROUND]) < -1.5 < np.median(height[found == C.BUILDING])


@pytest.mark.kitti
def test_a_network_on_a_real_scan(tmp_path: Path, kitti_root: Path) -> None:
    """A scan of 2000 columns runs at 2048, and points get the class of their own range."""
    frame = KittiSource(kitti_root / "odometry/sequences/00")[0]
    network = CloudClasses(str(scan_network(tmp_path, "bonnetal", size=(64, "width"))), CONFIG)
    assert_labels(network, "bonnetal", "range", frame.cloud, 0.95)
    assert network.note == ""
