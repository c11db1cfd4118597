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


def centres(classes: int, low: float = 0.0, high: float = 1.0) -> np.ndarray:
    """Values (K,) in the middle of K bands from low to high."""
    return low + (np.arange(classes) + 0.5) / classes * (high - low)


def weights(at: np.ndarray, channel: int, mean: Sequence[float], std: Sequence[float]) -> dict[str, np.ndarray]:
    """Kernels (K, C, 1, 1) and biases (K,) of the scores of one channel before its normalisation."""
    w = np.zeros((len(at), len(mean), 1, 1), np.float32)
    w[:, channel, 0, 0] = 2 * at * std[channel]
    return {"w": w, "b": (2 * at * mean[channel] - at**2).astype(np.float32)}


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
    constants = weights(centres(classes) if at is None else at, channel, mean, std)
    nodes, last = [], given
    if kind != Type.FLOAT:
        nodes, last = [*nodes, helper.make_node("Cast", [last], ["float"], to=Type.FLOAT)], "float"
    if form.startswith("HWC") or form.startswith("CHW"):
        constants["zero"] = np.array([0])
        nodes, last = [*nodes, helper.make_node("Unsqueeze", [last, "zero"], ["batch"])], "batch"
    if form.split()[0].endswith("HWC"):
        nodes, last = [*nodes, helper.make_node("Transpose", [last], ["first"], perm=[0, 3, 1, 2])], "first"
    if stride > 1:
        pool = helper.make_node("AveragePool", [last], ["pooled"], kernel_shape=[stride] * 2, strides=[stride] * 2)
        nodes, last = [*nodes, pool], "pooled"
    if enlarged > 1:
        constants["factors"] = np.array([1, 1, enlarged, enlarged], np.float32)
        nodes, last = [*nodes, helper.make_node("Resize", [last, "", "factors"], ["large"], mode="nearest")], "large"
    end = "raw" if "to" in form else scores
    nodes.append(helper.make_node("Conv", [last, "w", "b"], [end]))
    if form.endswith("to NHWC"):
        nodes.append(helper.make_node("Transpose", ["raw"], [scores], perm=[0, 2, 3, 1]))
    if form.endswith("to CHW"):
        constants["zero"] = np.array([0])
        nodes.append(helper.make_node("Squeeze", ["raw", "zero"], [scores]))
    made = []
    for name, shape in outputs:
        out = Type.FLOAT
        if name.startswith("argmax"):
            keep = int(shape is None or len(shape) == 4)
            out = Type.FLOAT if "float" in name else Type.INT32 if "int32" in name else Type.INT64
            nodes.append(helper.make_node("ArgMax", [scores], [f"{name}_64"], axis=1, keepdims=keep))
            nodes.append(helper.make_node("Cast", [f"{name}_64"], [name], to=out))
        elif name.startswith("aux"):
            nodes.append(helper.make_node("Neg", [scores], [name]))
        elif name.startswith("edge"):
            nodes.append(helper.make_node("ReduceMax", [scores], [name], axes=[1], keepdims=1))
        elif name.startswith("mean"):
            nodes.append(helper.make_node("GlobalAveragePool", [scores], [name]))
        made.append(value(name, shape, out))
    return save(path, nodes, [value(given, inputs, kind)], made, constants, metadata)


def endless(path: Path, turns: int = 10**7, above: float = 0.0, size: tuple = (64, 64)) -> Path:
    """A network for classes of pixels that takes minutes where its highest value is above a level (a loop), else no time."""
    body = helper.make_graph(
        [
            helper.make_node("Identity", ["go"], ["go_on"]),
            helper.make_node("Tanh", ["x"], ["y"]),
        ],
        "body",
        [value("i", [], Type.INT64), value("go", [], Type.BOOL), value("x", None)],
        [value("go_on", [], Type.BOOL), value("y", None)],
    )
    nodes = [
        helper.make_node("ReduceMax", ["input"], ["high"], keepdims=0),
        helper.make_node("Greater", ["high", "none"], ["go_at_all"]),
        helper.make_node("Loop", ["turns", "go_at_all", "input"], ["after"], body=body),
        helper.make_node("Conv", ["after", "w", "b"], ["output"]),
    ]
    constants = {"turns": np.array(turns), "none": np.array(above, np.float32), **weights(centres(19), 0, *IMAGENET)}
    return save(path, nodes, [value("input", [1, 3, *size])], [value("output", [1, 19, *size])], constants)


def failing(path: Path) -> Path:
    """A network for classes of pixels that fails for what is brighter than the mean: it reshapes that to twice the size."""
    nodes = [
        helper.make_node("ReduceMax", ["input"], ["high"], keepdims=1, axes=[1, 2, 3]),
        helper.make_node("Reshape", ["high", "one"], ["flat"]),
        helper.make_node("Greater", ["flat", "none"], ["bright"]),
        helper.make_node("Cast", ["bright"], ["more"], to=Type.INT64),
        helper.make_node("Add", ["more", "one"], ["factor"]),
        helper.make_node("Mul", ["factor", "size"], ["shape"]),
        helper.make_node("Reshape", ["input", "shape"], ["again"]),
        helper.make_node("Conv", ["again", "w", "b"], ["output"]),
    ]
    constants = {"one": np.array([1]), "none": np.zeros(1, np.float32), "size": np.array([1, 3, 64, 64])}
    constants |= weights(centres(19), 0, *IMAGENET)
    return save(path, nodes, [value("input", [1, 3, 64, 64])], [value("output", [1, 19, 64, 64])], constants)


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
    nodes, constants, now = [], weights(at, channel, mean, std), names[0]
    if last:
        nodes, now = [helper.make_node("Transpose", [now], ["first"], perm=[0, 3, 1, 2])], "first"
    nodes.append(helper.make_node("Conv", [now, "w", "b"], ["plain"]))
    given = [value(names[0], [1, height, width, count] if last else [1, count, height, width])]
    if mask is None:
        nodes.append(helper.make_node("Identity", ["plain"], ["scores"]))
    else:
        # Scores fall far below those of class 0 where the mask is 0: then no point may keep its class.
        constants["shape"], constants["far"] = np.array([1, 1, height, width]), np.array(1e6, np.float32)
        constants["one"], constants["first_only"] = (
            np.array(1, np.float32),
            np.eye(1, len(at), dtype=np.float32).reshape(1, -1, 1, 1),
        )
        nodes += [
            helper.make_node("Reshape", ["lidar_mask", "shape"], ["m"]),
            helper.make_node("Sub", ["one", "m"], ["empty"]),
            helper.make_node("Mul", ["empty", "far"], ["loss"]),
            helper.make_node("Mul", ["loss", "first_only"], ["raised"]),
            helper.make_node("Add", ["plain", "raised"], ["scores"]),
        ]
        given.append(value("lidar_mask", mask))
    made = []
    for name in outputs:
        shape, kind = [1, len(at), height, width], Type.FLOAT
        out = names[1] if name in ("output", "softmax", "argmax") else name
        if name == "softmax":
            nodes.append(helper.make_node("Softmax", ["scores"], [out], axis=1))
        elif name == "argmax":
            nodes.append(helper.make_node("ArgMax", ["scores"], [out], axis=1, keepdims=0))
            shape, kind = [1, height, width], Type.INT64
        else:
            nodes.append(helper.make_node("Neg" if name.startswith("aux") else "Identity", ["scores"], [out]))
        made.append(value(out, shape, kind))
    return save(path, nodes, given, made, constants)
