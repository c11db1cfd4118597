"""Networks that are named in the wrong place are known by their tensors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from onnx import helper
from onnx_graphs import Type, save, segmentation, value
from sam_graphs import encoder, fast_sam, other, raw_encoder, sam2_pair

from calib_ros.config import SemanticsConfig
from calib_ros.errors import ModelError
from calib_ros_semantics.models.image_classes import ImageNetwork
from calib_ros_semantics.models.network_kinds import NetworkKind, kind_of
from calib_ros_semantics.models.onnx_model import OnnxModel
from calib_ros_semantics.models.segment_anything import segmenter_of

CONFIG = SemanticsConfig()


def made(path: Path, *outputs: tuple) -> Path:
    """A graph that takes a picture and gives outputs of these shapes, all of them 0."""
    names = [f"o{k}" for k in range(len(outputs))]
    constants = {f"z{k}": np.zeros(shape, np.float32) for k, shape in enumerate(outputs)}
    nodes = [helper.make_node("ReduceMean", ["i"], ["m"], axes=[0, 1, 2, 3], keepdims=0)]
    nodes += [helper.make_node("Add", ["m", f"z{k}"], [name]) for k, name in enumerate(names)]
    declared = [value(name, list(shape)) for name, shape in zip(names, outputs, strict=True)]
    return save(path, nodes, [value("i", [1, 3, 320, 320])], declared, constants)


BOXES = {
    "YOLOv8": ((1, 84, 2100),),
    "YOLOv5": ((1, 6300, 85),),
    "after NMS": ((1, 300, 6),),
    "corners and scores": ((100, 4), (100,)),
    "heads by anchor": ((1, 3, 40, 40, 85), (1, 3, 20, 20, 85)),
    "heads of COCO": ((1, 255, 40, 40), (1, 255, 20, 20), (1, 255, 10, 10)),
    "one head of COCO": ((1, 85, 40, 40),),
    "heads of two classes": ((1, 28, 40, 40), (1, 28, 20, 20)),
}


@pytest.mark.parametrize("name", BOXES)
def test_detectors(tmp_path: Path, name: str) -> None:
    path = made(tmp_path / "n.onnx", *BOXES[name])
    assert kind_of(OnnxModel(path, CONFIG)) == NetworkKind.DETECTOR
    for load in (lambda: ImageNetwork(path, CONFIG), lambda: segmenter_of(SemanticsConfig(segment_anything=str(path)))):
        with pytest.raises(ModelError, match="this looks like a detector of boxes"):
            load()


def test_networks_for_masks_are_no_networks_for_classes(tmp_path: Path) -> None:
    for path, kind in (
        (encoder(tmp_path / "sam.onnx"), NetworkKind.ENCODER),
        (raw_encoder(tmp_path / "raw.onnx"), NetworkKind.ENCODER),
        (sam2_pair(tmp_path)[0], NetworkKind.ENCODER),
        (fast_sam(tmp_path / "fast.onnx", 256, np.full((300, 9), 0.01), np.eye(3)), NetworkKind.FAST_SAM),
    ):
        assert kind_of(OnnxModel(path, CONFIG)) == kind, path
        with pytest.raises(ModelError, match=f"this looks like {kind.value}"):
            ImageNetwork(path, CONFIG)


def test_classifiers_and_networks_for_classes(tmp_path: Path) -> None:
    assert kind_of(OnnxModel(other(tmp_path / "o.onnx"), CONFIG)) == NetworkKind.CLASSIFIER
    assert kind_of(OnnxModel(made(tmp_path / "c.onnx", (1, 1000)), CONFIG)) == NetworkKind.CLASSIFIER
    for outputs, graph in (
        ("o 1 19 256 512", {}),
        ("o 1 256 512 19", {"inputs": "1 256 512 3", "form": "NHWC to NHWC"}),
        ("argmax 1 256 512", {}),
        ("o 1 19 256 512; aux 1 19 256 512", {}),
    ):
        path = segmentation(tmp_path / "n.onnx", 19, outputs, **graph)
        assert kind_of(OnnxModel(path, CONFIG)) == NetworkKind.CLASSES, outputs
        with pytest.raises(ModelError, match="this looks like a network for classes of pixels"):
            segmenter_of(SemanticsConfig(segment_anything=str(path)))
    nodes = [helper.make_node("NonZero", ["i"], ["o"])]
    free = save(tmp_path / "f.onnx", nodes, [value("i", [1, 3, "h", "w"])], [value("o", None, Type.INT64)])
    assert kind_of(OnnxModel(free, CONFIG)) == NetworkKind.OTHER
