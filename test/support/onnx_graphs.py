"""Small ONNX graphs with the names, shapes and types of known exports, which compute something that can be checked.

Class k of K is where a channel's value is nearest to centre k: score = 2 c v - c^2, which is a convolution of one pixel, after
normalisation as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto as Type
from onnx import helper, numpy_helper

IMAGENET = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
OPSET, IR = 17, 8  # as of exporters of 2023, far below what onnxruntime knows


def value(name: str, shape, kind=Type.FLOAT):
    """An input or output; shape: sizes, names of sizes, or None for an unknown rank."""
    return helper.make_tensor_value_info(name, kind, shape)


def save(path: Path, nodes, inputs, outputs, constants=None, metadata=None) -> Path:
    """An ONNX file of these nodes; constants: arrays by name."""
    initialisers = [numpy_helper.from_array(np.asarray(array), name) for name, array in (constants or {}).items()]
    graph = helper.make_graph(nodes, "graph", inputs, outputs, initialisers)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR)
    helper.set_model_props(model, metadata or {})
    onnx.save(model, str(path))
    return path


class Graph:
    """Nodes, one after the other."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: dict[str, np.ndarray] = {}

    def const(self, value: object, dtype: object = np.float32) -> str:
        name = f"c{len(self.constants)}"
        self.constants[name] = np.asarray(value, dtype)
        return name

    def ints(self, *values: int) -> str:
        return self.const(values, np.int64)

    def op(self, kind: str, *inputs: str, out: str = "", **attributes: object) -> str:
        name = out or f"n{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, list(inputs), [name], **attributes))
        return name

    def scores(self, x: str, kernels: tuple[np.ndarray, np.ndarray], out: str = "") -> str:
        """Of the classes that `weights` are of."""
        return self.op("Conv", x, *map(self.const, kernels), out=out)


def centres(classes: int, low: float = 0.0, high: float = 1.0) -> np.ndarray:
    """Values (K,) in the middle of K bands from low to high."""
    return low + (np.arange(classes) + 0.5) / classes * (high - low)


def kernels(at: np.ndarray, channel: int, mean: Sequence[float], std: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Kernels (K, C, 1, 1) and biases (K,) of the scores of one channel before its normalisation."""
    w = np.zeros((len(at), len(mean), 1, 1), np.float32)
    w[:, channel, 0, 0] = 2 * at * std[channel]
    return w, (2 * at * mean[channel] - at**2).astype(np.float32)


def weights(at: np.ndarray, channel: int, mean: Sequence[float], std: Sequence[float]) -> dict[str, np.ndarray]:
    """The same as constants "w" and "b"."""
    return dict(zip("wb", kernels(at, channel, mean, std), strict=True))


def segmentation(
    path: Path,
    classes: int,
    *,
    inputs: Sequence = (1, 3, 256, 512),
    outputs: Sequence[tuple[str, Sequence | None]],
    names: tuple[str, str] = ("input", "scores"),
    form: str = "NCHW",
    kind: int = Type.FLOAT,
    stride: int = 1,
    enlarged: int = 1,
    channel: int = 0,
    normal=IMAGENET,
    at: np.ndarray | None = None,
    metadata: dict[str, str] | None = None,
) -> Path:
    """A network whose class k is where an input channel is near its k-th centre (before normalisation).

    outputs: (name, shape) of what it gives: `names[1]` is that of the scores; others are made from them by what their name
    begins with: "argmax", "aux" (scores of the wrong class), "edge" (one channel), "mean" (one score per class). form: layout
    of the input and, as "NHWC to NHWC", of the scores. stride: pixels per cell of the scores. enlarged: cells per pixel.
    """
    given, scores = names
    g, last = Graph(), given
    if kind != Type.FLOAT:
        last = g.op("Cast", last, to=Type.FLOAT)
    if form.startswith(("HWC", "CHW")):
        last = g.op("Unsqueeze", last, g.ints(0))
    if form.split()[0].endswith("HWC"):
        last = g.op("Transpose", last, perm=[0, 3, 1, 2])
    if stride > 1:
        last = g.op("AveragePool", last, kernel_shape=[stride] * 2, strides=[stride] * 2)
    if enlarged > 1:
        last = g.op("Resize", last, "", g.const([1, 1, enlarged, enlarged]), mode="nearest")
    raw = g.scores(last, kernels(centres(classes) if at is None else at, channel, *normal), "" if "to" in form else scores)
    if form.endswith("to NHWC"):
        g.op("Transpose", raw, out=scores, perm=[0, 2, 3, 1])
    if form.endswith("to CHW"):
        g.op("Squeeze", raw, g.ints(0), out=scores)
    made = []
    for name, shape in outputs:
        out = Type.FLOAT
        if name.startswith("argmax"):
            keep = int(shape is None or len(shape) == 4)
            out = Type.FLOAT if "float" in name else Type.INT32 if "int32" in name else Type.INT64
            g.op("Cast", g.op("ArgMax", scores, axis=1, keepdims=keep), out=name, to=out)
        elif name.startswith("aux"):
            g.op("Neg", scores, out=name)
        elif name.startswith("edge"):
            g.op("ReduceMax", scores, out=name, axes=[1], keepdims=1)
        elif name.startswith("mean"):
            g.op("GlobalAveragePool", scores, out=name)
        made.append(value(name, shape, out))
    return save(path, g.nodes, [value(given, inputs, kind)], made, g.constants, metadata)


def endless(path: Path, turns: int = 10**7, above: float = 0.0, size: tuple = (64, 64)) -> Path:
    """A network for classes of pixels that takes minutes where its highest value is above a level (a loop), else no time."""
    body = helper.make_graph(
        [helper.make_node("Identity", ["go"], ["go_on"]), helper.make_node("Tanh", ["x"], ["y"])],
        "body",
        [value("i", [], Type.INT64), value("go", [], Type.BOOL), value("x", None)],
        [value("go_on", [], Type.BOOL), value("y", None)],
    )
    g = Graph()
    go = g.op("Greater", g.op("ReduceMax", "input", keepdims=0), g.const(above))
    g.scores(g.op("Loop", g.const(turns, np.int64), go, "input", body=body), kernels(centres(19), 0, *IMAGENET), "output")
    return save(path, g.nodes, [value("input", [1, 3, *size])], [value("output", [1, 19, *size])], g.constants)


def failing(path: Path) -> Path:
    """A network for classes of pixels that fails for what is brighter than the mean: it reshapes that to twice the size."""
    g = Graph()
    one = g.ints(1)
    flat = g.op("Reshape", g.op("ReduceMax", "input", keepdims=1, axes=[1, 2, 3]), one)
    more = g.op("Cast", g.op("Greater", flat, g.const([0.0])), to=Type.INT64)
    shape = g.op("Mul", g.op("Add", more, one), g.ints(1, 3, 64, 64))
    g.scores(g.op("Reshape", "input", shape), kernels(centres(19), 0, *IMAGENET), "output")
    return save(path, g.nodes, [value("input", [1, 3, 64, 64])], [value("output", [1, 19, 64, 64])], g.constants)


def range_network(
    path: Path,
    at: np.ndarray,
    channel: int,
    mean: Sequence[float],
    std: Sequence[float],
    *,
    size: tuple = (64, 1024),
    last: bool = False,
    mask: Sequence | None = None,
    outputs: Sequence[str] = ("output",),
    names: tuple[str, str] = ("input", "output"),
) -> Path:
    """A network for range images whose class k is where a channel is near its k-th centre (before normalisation).

    last: channels last, as of SqueezeSeg. mask: shape of a second input, by which the scores are multiplied. outputs: "output"
    (scores), "softmax", "argmax", or names beginning with "aux".
    """
    count, (height, width) = len(mean), size
    g, now = Graph(), names[0]
    if last:
        now = g.op("Transpose", now, perm=[0, 3, 1, 2])
    scores = g.scores(now, kernels(at, channel, mean, std))
    given = [value(names[0], [1, height, width, count] if last else [1, count, height, width])]
    if mask is not None:
        # Scores fall far below those of class 0 where the mask is 0: then no point may keep its class.
        empty = g.op("Sub", g.const(1), g.op("Reshape", "lidar_mask", g.ints(1, 1, height, width)))
        first_only = g.const(np.eye(1, len(at)).reshape(1, -1, 1, 1))
        scores = g.op("Add", scores, g.op("Mul", g.op("Mul", empty, g.const(1e6)), first_only))
        given.append(value("lidar_mask", mask))
    made = []
    for name in outputs:
        shape, kind = [1, len(at), height, width], Type.FLOAT
        out = names[1] if name in ("output", "softmax", "argmax") else name
        if name == "softmax":
            g.op("Softmax", scores, out=out, axis=1)
        elif name == "argmax":
            g.op("ArgMax", scores, out=out, axis=1, keepdims=0)
            shape, kind = [1, height, width], Type.INT64
        else:
            g.op("Neg" if name.startswith("aux") else "Identity", scores, out=out)
        made.append(value(out, shape, kind))
    return save(path, g.nodes, given, made, g.constants)
