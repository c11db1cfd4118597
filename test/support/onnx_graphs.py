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

    def scores(self, x: str, at: np.ndarray, channel: int, mean: Sequence[float], std: Sequence[float], out: str = "") -> str:
        """Scores of classes whose centres, before the normalisation of a channel, are at (K,)."""
        w = np.zeros((len(at), len(mean), 1, 1), np.float32)
        w[:, channel, 0, 0] = 2 * at * std[channel]
        return self.op("Conv", x, self.const(w), self.const(2 * at * mean[channel] - at**2), out=out)

    def save(self, path: Path, inputs: Sequence[tuple], outputs: Sequence[tuple], metadata: dict | None = None) -> Path:
        """As a file; inputs and outputs: name, shape, and type if it is not float."""
        given = [[value(*tensor) for tensor in tensors] for tensors in (inputs, outputs)]
        return save(path, self.nodes, *given, self.constants, metadata)


def centres(classes: int, low: float = 0.0, high: float = 1.0) -> np.ndarray:
    """Values (K,) in the middle of K bands from low to high."""
    return low + (np.arange(classes) + 0.5) / classes * (high - low)


def shape_of(text: str) -> list[int | str] | None:
    """Sizes and names of sizes, such as "batch 3 256 512"; "?" is an unknown rank."""
    return None if text == "?" else [int(n) if n.isdigit() else n for n in text.split()]


def tensors(text: str) -> list[tuple[str, list[int | str] | None]]:
    """Names and shapes, such as "scores 1 19 256 512; aux ?"."""
    pairs = (tensor.strip().split(" ", 1) for tensor in text.split(";"))
    return [(name, shape_of(shape)) for name, shape in pairs]


MADE_FROM_SCORES = ("argmax", "aux", "edge", "mean")


def segmentation(
    path: Path,
    classes: int = 19,
    outputs: str | Sequence[tuple[str, Sequence | None]] = "scores 1 19 256 512",
    *,
    inputs: str | Sequence | None = "1 3 256 512",
    names: tuple[str, str] | None = None,
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

    inputs, outputs: as (name, shape) or as text. Scores are the first output but those that are made from them, as their name
    begins: "argmax", "aux" (scores of the wrong class), "edge" (one channel), "mean" (one score per class). names: of the input
    and the scores. form: layout of the input and, as "NHWC to NHWC", of the scores. stride: pixels per cell of the scores.
    enlarged: cells per pixel.
    """
    mean, std = normal
    inputs = shape_of(inputs) if isinstance(inputs, str) else inputs
    outputs = tensors(outputs) if isinstance(outputs, str) else outputs
    first = next((name for name, _ in outputs if not name.startswith(MADE_FROM_SCORES)), "scores")
    given, scores = names or ("input", first)
    g, x = Graph(), given
    if kind != Type.FLOAT:
        x = g.op("Cast", x, to=Type.FLOAT)
    if form.startswith("HWC") or form.startswith("CHW"):
        x = g.op("Unsqueeze", x, g.ints(0))
    if form.split()[0].endswith("HWC"):
        x = g.op("Transpose", x, perm=[0, 3, 1, 2])
    if stride > 1:
        x = g.op("AveragePool", x, kernel_shape=[stride] * 2, strides=[stride] * 2)
    if enlarged > 1:
        x = g.op("Resize", x, "", g.const([1, 1, enlarged, enlarged]), mode="nearest")
    raw = g.scores(x, centres(classes) if at is None else at, channel, mean, std, out="" if "to" in form else scores)
    if form.endswith("to NHWC"):
        g.op("Transpose", raw, perm=[0, 2, 3, 1], out=scores)
    if form.endswith("to CHW"):
        g.op("Squeeze", raw, g.ints(0), out=scores)
    made = []
    for name, shape in outputs:
        out = Type.FLOAT
        if name.startswith("argmax"):
            keep = int(shape is None or len(shape) == 4)
            out = Type.FLOAT if "float" in name else Type.INT32 if "int32" in name else Type.INT64
            g.op("Cast", g.op("ArgMax", scores, axis=1, keepdims=keep), to=out, out=name)
        elif name.startswith("aux"):
            g.op("Neg", scores, out=name)
        elif name.startswith("edge"):
            g.op("ReduceMax", scores, axes=[1], keepdims=1, out=name)
        elif name.startswith("mean"):
            g.op("GlobalAveragePool", scores, out=name)
        made.append((name, shape, out))
    return g.save(path, [(given, inputs, kind)], made, metadata)


def endless(path: Path, turns: int = 10**12, above: float = 0.0, size: tuple = (64, 64)) -> Path:
    """A network for classes of pixels that does not end where its highest value is above a level (a loop), else no time."""
    turn = [helper.make_node("Identity", ["go"], ["go_on"]), helper.make_node("Tanh", ["x"], ["y"])]
    given = [value("i", [], Type.INT64), value("go", [], Type.BOOL), value("x", None)]
    body = helper.make_graph(turn, "body", given, [value("go_on", [], Type.BOOL), value("y", None)])
    g = Graph()
    go = g.op("Greater", g.op("ReduceMax", "input", keepdims=0), g.const(above))
    g.scores(g.op("Loop", g.const(turns, np.int64), go, "input", body=body), centres(19), 0, *IMAGENET, out="output")
    return g.save(path, [("input", [1, 3, *size])], [("output", [1, 19, *size])])


def failing(path: Path) -> Path:
    """A network for classes of pixels that fails for what is brighter than the mean: it reshapes that to twice the size."""
    g = Graph()
    high = g.op("Reshape", g.op("ReduceMax", "input", keepdims=1, axes=[1, 2, 3]), g.ints(1))
    factor = g.op("Add", g.op("Cast", g.op("Greater", high, g.const([0])), to=Type.INT64), g.ints(1))
    again = g.op("Reshape", "input", g.op("Mul", factor, g.ints(1, 3, 64, 64)))
    g.scores(again, centres(19), 0, *IMAGENET, out="output")
    return g.save(path, [("input", [1, 3, 64, 64])], [("output", [1, 19, 64, 64])])


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
    g, count, (height, width) = Graph(), len(mean), size
    x = g.op("Transpose", names[0], perm=[0, 3, 1, 2]) if last else names[0]
    scores = g.scores(x, at, channel, mean, std)
    given: list[tuple] = [(names[0], [1, height, width, count] if last else [1, count, height, width])]
    if mask is not None:
        # Scores fall far below those of class 0 where the mask is 0: then no point may keep its class.
        empty = g.op("Sub", g.const(1), g.op("Reshape", "lidar_mask", g.ints(1, 1, height, width)))
        first_only = g.const(1e6 * np.eye(1, len(at)).reshape(1, -1, 1, 1))
        scores = g.op("Add", scores, g.op("Mul", empty, first_only))
        given.append(("lidar_mask", mask))
    made: list[tuple] = []
    for name in outputs:
        out = names[1] if name in ("output", "softmax", "argmax") else name
        if name == "argmax":
            g.op("ArgMax", scores, axis=1, keepdims=0, out=out)
            made.append((out, [1, height, width], Type.INT64))
            continue
        how = {"axis": 1} if name == "softmax" else {}
        g.op("Softmax" if name == "softmax" else "Neg" if name.startswith("aux") else "Identity", scores, out=out, **how)
        made.append((out, [1, len(at), height, width]))
    return g.save(path, given, made)
