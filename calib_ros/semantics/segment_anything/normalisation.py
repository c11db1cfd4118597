"""Normalisation of the pixels that go into a network of Segment Anything: what is usual for its family, or what its YAML says."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.semantics.image_input import GREY_LEVELS
from calib_ros.semantics.onnx_model import OnnxModel


@dataclass(frozen=True)
class Normalisation:
    """(pixels * scale - mean) / std of grey levels 0..255. mean, std: of one number or one for each of the three channels."""

    scale: float
    mean: tuple[float, ...] = (0.0,)
    std: tuple[float, ...] = (1.0,)

    def __call__(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """Pixels (h, w, 3) as the network wants them, in the order of its channels."""
        mean, std = np.array(self.mean, np.float32), np.array(self.std, np.float32)
        result: NDArray[Any] = (pixels * np.float32(self.scale) - mean) / std
        return result


def normalisation_of(model: OnnxModel, usual: Normalisation) -> Normalisation:
    """That of the YAML beside a model, read as for a network of classes (see image_input), else the usual one, which is of RGB.

    ModelError if the YAML has neither one nor three numbers, or channels that no picture has.
    """
    own = model.sidecar
    if not isinstance(own.channels, str):
        raise model.error("'channels:' of the YAML beside it must be rgb or bgr")
    for name, values in (("mean", own.mean), ("std", own.std)):
        if len(values) not in (0, 1, 3):
            raise model.error(f"'{name}:' of the YAML beside it must have 1 or 3 numbers")
    if not own.mean and not own.std and own.scale is None:
        return Normalisation(usual.scale, usual.mean[::-1], usual.std[::-1]) if own.channels == "bgr" else usual
    mean, std, scale = own.mean or (0.0,), own.std or (1.0,), own.scale
    if scale is None:
        scale = 1.0 if max(map(abs, mean + std)) > GREY_LEVELS else 1 / 255
    return Normalisation(scale, mean, std)
