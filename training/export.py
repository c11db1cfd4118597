"""Writes the trained network as ONNX for calib_ros: python -m training.export CHECKPOINT FILE.onnx [--size HEIGHT WIDTH].

The file takes RGB pictures of grey levels as uint8, 1x3xHxW, and normalises them itself; its metadata name the classes. So
calib_ros needs no YAML beside it. Weights are stored as float16, and used as float32.
"""

from __future__ import annotations

import argparse
import json
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper

from training.data import NAMES
from training.network import STRIDE, Network
from training.predict import Predictor, classes_of, network_of, run_of

OPSET, IR_VERSION = 18, 10  # onnxruntime knows them since 1.18
HALVED = 64  # numbers; smaller tensors stay float32: they are cheap, and norms end up in them
AGREEMENT = 0.99  # of pixels with the network it was made of; float16 turns near ties, 0.2 % of them after two epochs
METADATA = {
    "names": json.dumps(NAMES),
    "description": "classes of pixels of streets; trained by calib_ros/training",
    "license": "Apache-2.0; trained on pictures rendered by calib_ros/training alone",
}


def export(network: Network, file: str | Path, size: tuple[int, int] | None = None) -> None:
    """Writes a network that is ready to run. size: (height, width), multiples of 16; None = any such size.

    ValueError for other sizes, and if the file does not give what the network gives.
    """
    if size is not None and any(n % STRIDE or n < STRIDE for n in size):
        raise ValueError(f"height and width {size} must be multiples of {STRIDE}")
    example = torch.zeros((1, 3, *(size or (192, 640))), dtype=torch.uint8)
    sizes = None if size is not None else ({2: torch.export.Dim.DYNAMIC, 3: torch.export.Dim.DYNAMIC},)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the exporter, about itself
        program = torch.onnx.export(
            network,
            (example,),
            dynamo=True,
            verbose=False,
            opset_version=OPSET,
            input_names=["image"],
            output_names=["scores"],
            dynamic_shapes=sizes,
        )
    assert program is not None  # None is of the old exporter
    model = program.model_proto
    if size is None:
        _name_sizes(model.graph)
    store(model, file, METADATA)
    _compare(network, file, size or (192, 640))


def store(model: Any, file: str | Path, metadata: Mapping[str, str]) -> None:
    """Write a model with this metadata alone, its large tensors as float16. onnx.checker.ValidationError if it is none."""
    _halve(model.graph)
    model.ir_version = IR_VERSION
    del model.metadata_props[:]
    for key, value in metadata.items():
        model.metadata_props.add(key=key, value=value)
    onnx.checker.check_model(model)
    onnx.save(model, str(file))


def _halve(graph: Any) -> None:
    """Stores large float32 tensors as float16, with a Cast each that onnxruntime computes once, when it loads the file."""
    casts, kept = [], []
    for tensor in graph.initializer:
        if tensor.data_type != TensorProto.FLOAT or np.prod(tensor.dims) < HALVED:
            kept.append(tensor)
            continue
        name = f"{tensor.name}_half"
        kept.append(numpy_helper.from_array(numpy_helper.to_array(tensor).astype(np.float16), name))
        casts.append(helper.make_node("Cast", [name], [tensor.name], to=TensorProto.FLOAT))
    nodes = [*casts, *graph.node]
    del graph.initializer[:], graph.node[:], graph.value_info[:]
    graph.initializer.extend(kept)
    graph.node.extend(nodes)
    for node in graph.node:
        del node.metadata_props[:]  # where in the Python code it came from
        node.doc_string = ""


def _name_sizes(graph: Any) -> None:
    """Readable names in place of formulas for the sizes that are free."""
    for tensor, names in ((graph.input[0], ("height", "width")), (graph.output[0], ("rows", "columns"))):
        for axis, name in zip((2, 3), names, strict=True):
            tensor.type.tensor_type.shape.dim[axis].dim_param = name


def _compare(network: Network, file: str | Path, size: tuple[int, int]) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (size[0] // STRIDE, size[1] // STRIDE, 3)).astype(np.uint8)
    picture = np.kron(picture, np.ones((STRIDE, STRIDE, 1), np.uint8))
    same = float(np.mean(Predictor(file)(picture) == classes_of(run_of(network), picture)))
    if same < AGREEMENT:
        Path(file).unlink()
        raise ValueError(f"{file} agrees with the network on {same:.1%} of the pixels only; export it with other versions")


def main() -> None:
    """Exports a checkpoint."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("file", type=Path)
    parser.add_argument("--size", type=int, nargs=2, metavar=("HEIGHT", "WIDTH"), help="the only size it takes; else any size")
    args = parser.parse_args()
    try:
        export(network_of(args.checkpoint), args.file, tuple(args.size) if args.size else None)
    except (ValueError, FileNotFoundError) as error:
        parser.error(str(error))
    print(f"{args.file}: {args.file.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
