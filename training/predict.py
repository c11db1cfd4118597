"""Classes of a picture from a network or from an exported file, as calib_ros would run it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from training.data import Image, Labels
from training.network import Network

MULTIPLE, LONGEST = 32, 1024  # px; the loader of calib_ros runs networks of any size at such sizes
Scores = NDArray[np.float32]
Run = Callable[[NDArray[np.uint8]], Scores]


class Predictor:
    """RGB (H, W, 3) uint8 -> class numbers (H, W), by an .onnx of any size."""

    def __init__(self, file: str | Path) -> None:
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
        name = session.get_inputs()[0].name
        self._run: Run = lambda pictures: np.asarray(session.run(None, {name: pictures})[0], np.float32)

    def __call__(self, image: Image) -> Labels:
        return classes_of(self._run, image)


def classes_of(run: Run, image: Image) -> Labels:
    """Class numbers (H, W) of a picture (H, W, 3) by a function of (1, 3, h, w) that gives scores (1, 11, ...)."""
    height, width = image.shape[:2]
    scale = min(1.0, LONGEST / max(height, width))
    rows, columns = (max(round(n * scale / MULTIPLE), 1) * MULTIPLE for n in (height, width))
    shrinks = rows <= height and columns <= width
    small = cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    scores = run(np.ascontiguousarray(small.transpose(2, 0, 1)[None], np.uint8))[0]
    planes = cv2.resize(np.ascontiguousarray(scores.transpose(1, 2, 0)), (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(planes.argmax(2), np.uint8)


def network_of(file: Path) -> Network:
    """The network of a checkpoint, with the averaged weights, ready to run."""
    network = Network()
    network.load_state_dict(torch.load(file, map_location="cpu", weights_only=True)["average"])
    return network.fuse()


def run_of(network: nn.Module) -> Run:
    """A network in evaluation mode as a function of arrays."""
    device = next(network.parameters()).device

    def run(pictures: NDArray[np.uint8]) -> Scores:
        with torch.inference_mode():
            return np.asarray(network(torch.from_numpy(pictures).to(device)).cpu().numpy(), np.float32)

    return run
