"""ONNX files of the size of well-known networks: stacks of convolutions with random weights.

What they answer means nothing, but is as long to work off: masks are discs around prompts and boxes of noise, classes are random.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

Models = tuple[dict[str, str], str]  # files by the parameter of the stage semantics; parameters and operations
Layers = Sequence[tuple[int, int, int]]  # channels, stride, how many of them; the kernels are 3x3


class Stack:
    """A graph that begins with convolutions. macs, parameters: of them, in 1e9 and 1e6."""

    def __init__(self, name: str, channels: int, size: tuple[int, int], layers: Layers) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []
        self.last, self.macs, self.parameters = name, 0.0, 0.0
        rng = np.random.default_rng(0)
        for out, first_stride, count in layers:
            for k in range(count):
                stride = first_stride if k == 0 else 1
                size = (size[0] // stride, size[1] // stride)
                weights = rng.normal(0, np.sqrt(2 / (9 * channels)), (out, channels, 3, 3)).astype(np.float32)
                self.op("Conv", self.last, self.constant(weights), pads=[1] * 4, strides=[stride] * 2)
                self.op("Relu", self.last)
                self.macs += weights.size * size[0] * size[1] / 1e9
                self.parameters += weights.size / 1e6
                channels = out

    def constant(self, values: Any, dtype: Any = np.float32) -> str:
        """Name of an array."""
        self.constants.append(numpy_helper.from_array(np.asarray(values, dtype), f"c{len(self.constants)}"))
        return str(self.constants[-1].name)

    def op(self, kind: str, *inputs: str, out: str = "", **attributes: Any) -> str:
        """Name of what a node gives, which becomes the last."""
        self.last = out or f"n{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, list(inputs), [self.last], **attributes))
        return self.last

    def nothing(self) -> str:
        """A number that rests on all convolutions, and is 0."""
        return self.op("Mul", self.op("ReduceMean", self.last, keepdims=0), self.constant(0))

    def save(self, path: Path, inputs: dict[str, Any], outputs: dict[str, Any]) -> str:
        """The ONNX file; tensors by name with their shapes."""
        tensors = (
            [helper.make_tensor_value_info(n, TensorProto.FLOAT, shape) for n, shape in own.items()] for own in (inputs, outputs)
        )
        graph = helper.make_graph(self.nodes, "load", *tensors, self.constants)
        onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), str(path))
        return str(path)

    def __str__(self) -> str:
        return f"{self.parameters:.1f} M, {self.macs:.1f} G"


def pair(folder: Path) -> Models:
    """As MobileSAM: encoder 6 M parameters, 38 G operations at 1024x1024; decoder 4 M, 1.5 G for each prompt. Its masks are discs
    around the prompt."""
    encoder = Stack("image", 3, (1024, 1024), [(64, 4, 7), (64, 2, 3), (128, 2, 10), (256, 1, 7)])
    encoder.op("Identity", encoder.last, out="image_embeddings")
    first = encoder.save(folder / "e.onnx", {"image": [1, 3, 1024, 1024]}, {"image_embeddings": [1, 256, 64, 64]})
    g = Stack("image_embeddings", 256, (64, 64), [(128, 2, 1), (256, 2, 2), (192, 1, 6), (256, 1, 1)])
    empty = g.nothing()
    cells = np.stack(np.meshgrid(np.arange(256), np.arange(256)))[None].astype(np.float32) * 4 + 2
    point = g.op("Reshape", g.op("ReduceMean", "point_coords", axes=[1], keepdims=0), g.constant([1, 2, 1, 1], np.int64))
    squares = g.op("Pow", g.op("Sub", g.constant(cells), point), g.constant(2))
    away = g.op("Sqrt", g.op("ReduceSum", squares, g.constant([1], np.int64)))
    radii = g.constant(np.reshape([15, 35, 60, 120], (1, 4, 1, 1)))
    g.op("Add", g.op("Sub", radii, away), empty, out="low_res_masks")
    g.op("Add", g.constant([[0.95] * 4]), empty, out="iou_predictions")
    inputs = {"image_embeddings": [1, 256, 64, 64], "point_coords": [1, "n", 2], "point_labels": [1, "n"]}
    second = g.save(folder / "d.onnx", inputs, {"low_res_masks": [1, 4, 256, 256], "iou_predictions": [1, 4]})
    return {"segment_anything": first, "segment_anything_decoder": second}, f"{encoder} and {g} a prompt"


def fast_sam(folder: Path) -> Models:
    """As FastSAM-s (YOLOv8s-seg): 12 M parameters, 55 G operations at 1024x1024; a hundred boxes."""
    g = Stack("images", 3, (1024, 1024), [(32, 2, 1), (64, 2, 5), (128, 2, 10), (256, 2, 9), (512, 2, 2)])
    rng, empty = np.random.default_rng(1), g.nothing()
    table = np.zeros((21504, 37), np.float32)
    table[:100, :2], table[:100, 2:4], table[:100, 4] = rng.uniform(400, 624, (100, 2)), rng.uniform(20, 200, (100, 2)), 0.8
    table[:100, 5:] = rng.normal(0.5, 1, (100, 32))
    g.op("Add", g.constant(table.T[None]), empty, out="output0")
    g.op("Add", g.constant(rng.normal(0.5, 1, (1, 32, 256, 256))), empty, out="output1")
    outputs = {"output0": [1, 37, 21504], "output1": [1, 32, 256, 256]}
    return {"segment_anything": g.save(folder / "f.onnx", {"images": [1, 3, 1024, 1024]}, outputs)}, str(g)


def camera(folder: Path) -> Models:
    """As PIDNet-S: 8 M parameters, 48 G operations at 1024x2048, 19 classes in an eighth of the size."""
    g = Stack("input", 3, (1024, 2048), [(32, 2, 5), (32, 2, 3), (64, 2, 4), (128, 2, 8), (256, 2, 10)])
    g.op("Resize", g.last, "", g.constant([1, 1, 4, 4]))
    g.op("Conv", g.last, g.constant(np.random.default_rng(1).normal(0, 0.1, (19, 256, 1, 1))), out="output")
    return {"image_classes": g.save(folder / "c.onnx", {"input": [1, 3, 1024, 2048]}, {"output": [1, 19, 128, 256]})}, str(g)


def scan(folder: Path) -> Models:
    """As SalsaNext: 7 M parameters, 63 G operations at 64x2048, 20 classes."""
    g = Stack("input", 5, (64, 2048), [(32, 1, 8), (64, 2, 26), (128, 2, 14), (256, 2, 6)])
    g.op("Resize", g.last, "", g.constant([1, 1, 8, 8]))
    g.op("Conv", g.last, g.constant(np.random.default_rng(1).normal(0, 0.1, (20, 256, 1, 1))), out="output")
    return {"cloud_classes": g.save(folder / "l.onnx", {"input": [1, 5, 64, 2048]}, {"output": [1, 20, 64, 2048]})}, str(g)
