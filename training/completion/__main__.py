"""Renders scenes, trains the completion network, writes it: python -m training.completion --data FOLDER --out FILE.onnx.

Called again, it goes on with rendering; training starts anew. The seed fixes everything.
"""

from __future__ import annotations

import argparse
import os
import time
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from calib_ros_thesis.maps import FAR_LEVEL, complete_depth
from training.completion.network import GREY, STRIDE, CompletionNetwork
from training.completion.scenes import Scene, numbers_in, read, render
from training.export import OPSET, store

SCENES, STEPS, RATE, SEED = 360, 1600, 4e-3, 1  # what the weights of the package come from
HELD_OUT = 20  # every 20th scene is validated
CROP, OF_EACH, AT_ONCE = (160, 320), 4, 2  # px; crops of a scene, which takes long to read, and scenes in a batch
CELL, AROUND = 8, 5  # px, cells; what is in no cell around one with a point is not asked for
BLIND = 0.3  # share of the crops without their image: where it is dark, or the extrinsic wrong, the depths have to do
STEEPEST = 1.0  # norm of the gradient above which a step is shortened
LOOK = 100  # steps from one line to the next
AGREEMENT = 2e-3  # share by which half of the depths of a file may differ from the network's
SIDECAR = "depth_scale: 1.0  # metres\nscale: 1.0  # grey levels as they are\n"
METADATA = {
    "name": "completion",
    "description": "dense depth from sparse depth and image; trained by calib_ros/training",
    "license": "Apache-2.0; trained on pictures rendered by calib_ros/training alone",
}
Arrays = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]  # image, sparse, dense: each (1, h, w)


def crop_of(scene: Scene, rng: np.random.Generator) -> Arrays:
    """A random part of a scene, flipped, brighter or darker, nearer or farther, with fewer points or without its image."""
    rows, columns = CROP
    pad = [(0, max(0, n - have)) for n, have in zip(CROP, scene.image.shape, strict=True)]
    image, sparse, dense = (np.pad(part, pad) for part in scene)
    # Mostly where there are points: above the scan there is nothing to learn.
    low, height = int(np.flatnonzero(sparse.any(axis=1)).min(initial=0)), image.shape[0]
    top = int(rng.integers(max(0, min(low - 20, height - rows)), height - rows + 1))
    left = int(rng.integers(0, image.shape[1] - columns + 1))
    cut = np.s_[top : top + rows, left : left + columns]
    grey, sparse, dense = image[cut].astype(np.float32), sparse[cut].copy(), dense[cut]
    if rng.random() < BLIND:
        grey[:] = GREY[0]
    grey = np.clip((grey - 128) * np.float32(rng.uniform(0.6, 1.4)) + np.float32(rng.uniform(90, 160)), 0, 255)
    if rng.random() < 0.3:
        sparse[rng.random(sparse.shape) < rng.uniform(0, 0.7)] = 0
    size = np.float32(np.exp(rng.uniform(-0.3, 0.3)))
    parts = (grey, sparse * size, dense * size)
    if rng.random() < 0.5:
        parts = tuple(part[:, ::-1] for part in parts)  # type: ignore[assignment]
    return tuple(np.ascontiguousarray(part[None], np.float32) for part in parts)  # type: ignore[return-value]


def batches(folder: Path, numbers: Sequence[int], steps: int, seed: int) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Images, sparse and dense depths (n, 1, h, w) of each step."""
    rng = np.random.default_rng([seed, 9])
    order = np.concatenate([rng.permutation(numbers) for _ in range(1 + AT_ONCE * steps // len(numbers))])
    for step in range(steps):
        scenes = [read(folder, int(n)) for n in order[AT_ONCE * step : AT_ONCE * (step + 1)]]
        crops = [crop_of(scene, rng) for scene in scenes for _ in range(OF_EACH)]
        image, sparse, dense = (torch.from_numpy(np.stack(parts)) for parts in zip(*crops, strict=True))
        yield image, sparse, dense


def loss_of(found: Tensor, sparse: Tensor, dense: Tensor) -> Tensor:
    """Mean difference of logarithms of depth, where there is one, and a point is near."""
    near = functional.max_pool2d(functional.max_pool2d((sparse > 0).float(), CELL), AROUND, 1, AROUND // 2)
    counted = functional.interpolate(near, scale_factor=CELL) * (dense > 0)
    difference = (torch.log(found.clamp(min=0.1)) - torch.log(dense.clamp(min=0.1))).abs()
    return (difference * counted).sum() / counted.sum().clamp(min=1)


def train(folder: Path, numbers: Sequence[int], steps: int, seed: int) -> CompletionNetwork:
    """A network trained on scenes. ValueError if its loss is lost."""
    torch.manual_seed(seed)
    network = CompletionNetwork()
    optimizer = torch.optim.AdamW(network.parameters(), RATE, weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, steps, pct_start=0.1)
    losses, began = [], time.monotonic()
    for step, (image, sparse, dense) in enumerate(batches(folder, numbers, steps, seed), 1):
        loss = loss_of(network(sparse, image), sparse, dense)
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(network.parameters(), STEEPEST)
        optimizer.step()
        schedule.step()
        losses.append(float(loss.detach()))
        if not np.isfinite(losses[-1]):
            raise ValueError(f"the loss of step {step} has become {losses[-1]}")
        if step % LOOK == 0:
            print(f"step {step}/{steps} loss {np.mean(losses[-LOOK:]):.4f} {time.monotonic() - began:.0f} s", flush=True)
    return network.fuse()


def whole(scene: Scene) -> tuple[Tensor, Tensor, Tensor]:
    """A scene as tensors (1, 1, h, w), cut to a multiple of the stride."""
    rows, columns = (n // STRIDE * STRIDE for n in scene.image.shape)
    image, sparse, dense = (torch.from_numpy(part[-rows:, :columns].astype(np.float32))[None, None] for part in scene)
    return image, sparse, dense


def validate(network: CompletionNetwork, folder: Path, numbers: Sequence[int]) -> list[str]:
    """Errors against exact depths on whole scenes, of the network with images and without, and of morphology (eq. 3.11), where
    that gives a depth; a line each."""
    errors: dict[str, list[NDArray[np.float32]]] = {}
    for image, sparse, dense in (whole(read(folder, n)) for n in numbers):
        levels = np.rint(100 * sparse[0, 0].numpy()).astype(np.int16)
        found = {"morphology": complete_depth(levels, FAR_LEVEL) / np.float32(100)}
        with torch.inference_mode():
            for name, shown in (("network", image), ("network without image", torch.full_like(image, GREY[0]))):
                found[name] = network(sparse, shown)[0, 0].numpy()
        true = dense[0, 0].numpy()
        counted = (true > 0) & (found["morphology"] > 0)
        for name, values in found.items():
            errors.setdefault(name, []).append(np.abs(values - true)[counted])
    lines = []
    for name, parts in errors.items():
        error = np.concatenate(parts)
        off = f"mean {error.mean():.3f} m, median {np.median(error):.3f} m, {100 * np.mean(error > 1):.1f} % by more than 1 m"
        lines.append(f"{len(parts)} held-out scenes, {name}: off by {off}")
    return lines


def export(network: CompletionNetwork, file: Path) -> None:
    """Writes a trained network for `thesis.completion`, and its YAML."""
    examples = torch.zeros((1, 1, 192, 640)), torch.zeros((1, 1, 192, 640))  # one tensor twice would be one input
    free = {2: torch.export.Dim.DYNAMIC, 3: torch.export.Dim.DYNAMIC}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the exporter, about itself
        program = torch.onnx.export(
            network,
            examples,
            dynamo=True,
            verbose=False,
            opset_version=OPSET,
            input_names=["depth", "image"],
            output_names=["dense"],
            dynamic_shapes=(free, free),
        )
    assert program is not None  # None is of the old exporter
    model = program.model_proto
    for tensor in (*model.graph.input, *model.graph.output):
        for axis, name in ((2, "height"), (3, "width")):
            tensor.type.tensor_type.shape.dim[axis].dim_param = name
    store(model, file, METADATA)
    file.with_suffix(".yaml").write_text(SIDECAR)


def compare(network: CompletionNetwork, file: Path, scene: tuple[Tensor, Tensor, Tensor]) -> None:
    """ValueError if a file does not give what its network gives, but for weights stored as float16."""
    image, sparse, _ = scene
    with torch.inference_mode():
        expected = network(sparse, image).numpy()
    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    found = session.run(None, {"depth": sparse.numpy(), "image": image.numpy()})[0]
    if float(np.median(np.abs(found / expected - 1))) > AGREEMENT:
        raise ValueError(f"{file} gives other depths than the network; export it with other versions")


def main() -> None:
    """Renders what is missing, trains, exports."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", required=True, type=Path, help="folder of rendered scenes")
    parser.add_argument("--out", required=True, type=Path, help="the ONNX file")
    parser.add_argument("--scenes", type=int, default=SCENES)
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1, help="of rendering")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    torch.set_num_threads(1)  # sums in one order: the same weights again
    try:
        render(args.data, args.seed, range(args.scenes), args.processes)
        numbers = [n for n in numbers_in(args.data) if n < args.scenes]
        network = train(args.data, [n for n in numbers if n % HELD_OUT], args.steps, args.seed)
        lines = validate(network, args.data, [n for n in numbers if n % HELD_OUT == 0])
        export(network, args.out)
        compare(network, args.out, whole(read(args.data, numbers[0])))
    except (ValueError, OSError) as error:
        parser.error(str(error))
    print("\n".join(lines))
    print(f"{args.out}: {args.out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
