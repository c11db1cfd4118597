"""Files that are no model for what they are named for: one clear error each, with the file, when they are loaded."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import sam_graphs as graphs
from onnx import helper
from onnx_graphs import centres, range_network, save, segmentation, value

from calib_ros.config import SemanticsConfig
from calib_ros.errors import ModelError
from calib_ros.registration.classes import CLOUD, IMAGE, MASKS
from calib_ros_semantics.models.segmentation import load_model

Made = Callable[[Path], Path | tuple[Path | str, ...] | str]
SAID = "none of its outputs is a map of classes"
UNKNOWN = "which are of no known dataset"
NO_DECODER = "set semantics.segment_anything_decoder to its ONNX file. FastSAM has none; networks for classes go to semantics"
NMS = "it was exported with NMS inside; export it with nms=False"


def net(outputs: str = "o 1 19 256 512", **graph) -> Made:
    """A network for pictures."""
    return lambda folder: segmentation(folder / "n.onnx", outputs=outputs, **graph)


def ranges(classes: int = 20) -> Made:
    """A network for scans."""
    return lambda folder: range_network(folder / "n.onnx", centres(classes), 0, [0] * 5, [1] * 5)


def made(*outputs: tuple[int, ...]) -> Made:
    """A graph that takes a picture and gives outputs of these shapes, all of them 0."""

    def saved(folder: Path) -> Path:
        names = [f"o{k}" for k in range(len(outputs))]
        constants = {f"z{k}": np.zeros(shape, np.float32) for k, shape in enumerate(outputs)}
        nodes = [helper.make_node("ReduceMean", ["i"], ["m"], axes=[0, 1, 2, 3], keepdims=0)]
        nodes += [helper.make_node("Add", ["m", f"z{k}"], [name]) for k, name in enumerate(names)]
        declared = [value(name, list(shape)) for name, shape in zip(names, outputs, strict=True)]
        return save(folder / "n.onnx", nodes, [value("i", [1, 3, 320, 320])], declared, constants)

    return saved


def mininet(folder: Path) -> Path:
    inputs, outputs = ([value(f"{kind}{k}", [1, 11, 64, 2048 + k]) for k in (0, 1)] for kind in "io")
    nodes = [helper.make_node("Identity", [f"i{k}"], [f"o{k}"]) for k in (0, 1)]
    return save(folder / "n.onnx", nodes, inputs, outputs)


def encoder(folder: Path, **more) -> str:
    return graphs.encoder(folder / "n.onnx", **more)


def decoder(folder: Path) -> str:
    return graphs.official_decoder(folder / "decoder.onnx")


def fast(**metadata: str) -> Made:
    return lambda folder: graphs.fast_sam(folder / "n.onnx", 640, np.zeros((9, 8)), np.eye(3), metadata=metadata)


OTHERS = {
    "YOLOv8": ((1, 84, 2100),),
    "YOLOv5": ((1, 6300, 85),),
    "boxes after NMS": ((1, 300, 6),),
    "corners and scores": ((100, 4), (100,)),
    "heads by anchor": ((1, 3, 40, 40, 85), (1, 3, 20, 20, 85)),
    "heads of COCO": ((1, 255, 40, 40), (1, 255, 20, 20), (1, 255, 10, 10)),
    "heads of two classes": ((1, 28, 40, 40), (1, 28, 20, 20)),
    "FastSAM": ((1, 37, 2100), (1, 32, 80, 80)),
    "encoder of Segment Anything": ((1, 256, 20, 20),),
    "encoder of SAM2": ((1, 32, 80, 80), (1, 64, 40, 40), (1, 256, 20, 20)),
    "classifier": ((1, 1000),),
    "classifier of 19 classes": ((1, 19, 1, 1),),
}
# What is made; for which parameter; the YAML beside it; and what the error says.
REFUSED: dict[str, tuple[Made, str, str, str]] = {
    "too few names": (net(), IMAGE, "labels: [road, sky]", "names 2 classes by 'labels:', but the network gives scores of 19"),
    "a name too many": (net(), IMAGE, "labels: {19: road}", "but the network gives scores of 19"),
    "a misspelt name": (net(), IMAGE, "labels: {0: raod}", "class name 'raod' is unknown; map it to one of other, vehicle"),
    "no such dataset": (net(), IMAGE, "labels: kitti", "labels = 'kitti' is none of cityscapes"),
    "no such output": (net(), IMAGE, "output: b", "there is no output 'b'"),
    "two means": (net(), IMAGE, "mean: [1, 2]", "'mean:' of the YAML beside it must have 1 or 3 numbers"),
    "another size": (net(), IMAGE, "size: [512, 512]", "does not run at the height and width [512, 512]"),
    "channels of scans": (net(), IMAGE, "channels: [range, x]", "must be rgb or bgr"),
    "no such family": (net(), IMAGE, "family: zzz", "family 'zzz' is unknown; known are mmsegmentation, PIDNet"),
    "a huge size": (net("s ?", inputs="b 3 h w"), IMAGE, "size: [16384, 16384]", "[height, width], each 8 to 8192 px"),
    "no class of use": (
        *(net("s 1 3 256 512", classes=3), IMAGE, "labels: [object, void, unknown]"),
        "none of its classes is of use here",
    ),
    "seven classes": (net("o 1 7 256 512", classes=7), IMAGE, "", f"scores of 7 classes, {UNKNOWN}"),
    "its tensors": (
        *(net("o 1 7 256 512", classes=7), IMAGE, ""),
        "inputs: input float32 1x3x256x512; outputs: o float32 1x7x256x512",
    ),
    "256 features": (net("s 1 256 64 64", classes=256, inputs="1 3 64 64"), IMAGE, "", "If it is Segment Anything, it goes to"),
    "a network for scans": (ranges(), IMAGE, "", "takes one picture as 1x3xHxW"),
    "a large output": (
        *(net("s 1 19 4096 8192", inputs="1 3 1024 2048", enlarged=4), IMAGE, ""),
        "takes 2.6 GB for an input of 1024x2048, and at most 1 GB are taken; export it for 640x1280 or less",
    ),
    "a large input": (
        *(net("argmax 1 4096 8192", inputs="1 3 4096 8192"), IMAGE, ""),
        "pictures of 4096x8192, which need gigabytes inside the network; at most 8.4 million pixels",
    ),
    "a network for pictures": (net(), CLOUD, "", "takes one range image as 1xCxHxW or 1xHxWxC of 5 or 6 channels"),
    "seven classes of scans": (ranges(7), CLOUD, "", f"scores of 7 classes, {UNKNOWN}"),
    "3D-MiniNet": (mininet, CLOUD, "", "groups of neighbours, as 3D-MiniNet takes them"),
    "no such family of scans": (ranges(), CLOUD, "family: pointnet", "family 'pointnet' is unknown; known are bonnetal"),
    "colours of scans": (ranges(), CLOUD, "channels: rgb", "must be a list of range, x, y, z, remission, mask"),
    "no such channel": (ranges(), CLOUD, "channels: [range, x, y, z, colour]", "must be a list of range"),
    "a channel twice": (ranges(), CLOUD, "channels: [range, x, y, z, depth]", "each once"),
    "three channels": (ranges(), CLOUD, "channels: [range, x, y]", "of 3 channels"),
    "three means": (ranges(), CLOUD, "mean: [1, 2, 3]", "'mean:' must have 5 numbers"),
    "another width": (ranges(), CLOUD, "size: [64, 512]", "does not run at the height and width"),
    "one name": (ranges(), CLOUD, "labels: [car]", "names 1 classes"),
    "no decoder": (encoder, MASKS, "", NO_DECODER),
    "a network for classes as decoder": (
        lambda folder: (encoder(folder), segmentation(folder / "o.onnx")),
        *(MASKS, "", "o.onnx are no pair of Segment Anything: no input takes points; the encoder has inputs: input_image"),
    ),
    "the other way round": (lambda folder: (decoder(folder), encoder(folder)), MASKS, "", "are no pair"),
    "another side": (
        lambda folder: (encoder(folder, side=512), decoder(folder)),
        *(MASKS, "", "the encoder gives image_embeddings float32 1x256x32x32, but the decoder takes image_embeddings"),
    ),
    "a decoder that is gone": (
        lambda folder: (encoder(folder), "gone.onnx"),
        MASKS,
        "",
        "model gone.onnx: there is no such file",
    ),
    "a family of SAM": (
        lambda folder: (encoder(folder), decoder(folder)),
        *(MASKS, "family: segnet", "family 'segnet' is unknown; known are sam, mobilesam"),
    ),
    "four stds": (lambda folder: (encoder(folder), decoder(folder)), MASKS, "std: [1, 2, 3, 4]", "must have 1 or 3 numbers"),
    "four stds of FastSAM": (fast(), MASKS, "std: [1, 2, 3, 4]", "'std:' of the YAML beside it must have 1 or 3 numbers"),
    "no such table": (fast(), MASKS, "output: nothing", "there is no output 'nothing', which"),
    "NMS": (fast(nms="True"), MASKS, "", NMS),
    "an end-to-end head": (fast(end2end="True"), MASKS, "", NMS),
    "NMS among arguments": (fast(args="{'batch': 1, 'half': False, 'nms': True}"), MASKS, "", NMS),
}
for _name, _outputs in OTHERS.items():
    _counted = _name == "FastSAM" or (len(_outputs[0]) == 4 and _outputs[0][2] > 1)
    REFUSED[f"{_name} for pixels"] = made(*_outputs), IMAGE, "", UNKNOWN if _counted else SAID
    if _name != "FastSAM":
        REFUSED[f"{_name} for masks"] = made(*_outputs), MASKS, "", NO_DECODER


@pytest.mark.parametrize("name", REFUSED)
def test_models_that_cannot_be_used(tmp_path: Path, name: str) -> None:
    make, kind, yaml, says = REFUSED[name]
    files = make(tmp_path)
    first, second = files if isinstance(files, tuple) else (files, "")
    (tmp_path / "n.yaml").write_text(yaml)
    with pytest.raises(ModelError) as caught:
        load_model(kind, str(first), SemanticsConfig(segment_anything=str(first), segment_anything_decoder=str(second)))
    text = str(caught.value)
    assert says in text
    assert "\n" not in text
    assert str(tmp_path) in text or "gone.onnx" in text
