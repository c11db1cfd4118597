"""The first half of a Segment Anything pair: a picture becomes an embedding, in the way that the exporter of the file chose."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.semantics.deadline import Deadline
from calib_ros.semantics.onnx_model import Array, OnnxModel, Tensor
from calib_ros.semantics.segment_anything.normalisation import Normalisation, normalisation_of

SIDE = 1024  # px; what the models were trained on, and the default of graphs that take any size
PATCH = 16  # px of the frame of prompts per cell of the embedding, in all families
IMAGENET = Normalisation(1.0, (123.675, 116.28, 103.53), (58.395, 57.12, 57.375))  # of RGB, as nearly all families have it


@dataclass(frozen=True)
class Style:
    """What a family does to a picture.

    padded: it keeps its shape, and the rest of the input is zero; else it is stretched. own_pixels: prompts are in pixels of
    the picture as it came.
    """

    padded: bool = True
    normalised: Normalisation = IMAGENET
    own_pixels: bool = False


SAM, SAM2 = Style(), Style(padded=False)
EFFICIENT_SAM = Style(padded=False, normalised=Normalisation(1 / 255), own_pixels=True)
RAW = Style(normalised=Normalisation(1.0))  # the graph does it all
# By the name that a YAML beside the encoder may give, without underscores and minus signs.
FAMILIES = {
    **dict.fromkeys(("sam", "mobilesam", "edgesam", "nanosam"), SAM),
    "sam2": SAM2,
    "efficientsam": EFFICIENT_SAM,
    "samexporter": RAW,
}


@dataclass(frozen=True, eq=False)
class Embedded:
    """A picture that was encoded. features: arrays by the name of the encoder's output. size: (H, W) of the picture.

    frame: (h, w) of the frame of prompts. content: (h, w) of the picture within it, from its upper left corner.
    """

    features: dict[str, Array]
    size: tuple[int, int]
    frame: tuple[float, float]
    content: tuple[float, float]


class Encoder:
    """A graph from a picture to an embedding. ModelError if its tensors are no encoder's."""

    def __init__(self, model: OnnxModel, efficient: bool = False) -> None:
        """efficient: the decoder says that this is EfficientSAM."""
        self.model = model
        pictures = [t for t in model.inputs if _is_picture(t)]
        features = [t for t in model.outputs if len(t.shape) == 4]
        if len(model.inputs) != 1 or not pictures or not features:
            raise model.error("this is no encoder, which takes a picture and gives an embedding")
        self.input = pictures[0]
        self.channels_last = self.input.shape[-1] == 3 and self.input.shape[-3] != 3
        self.family, self.style = self._style(efficient)

    def _style(self, efficient: bool) -> tuple[str, Style]:
        own = self.model.sidecar
        asked = own.family.lower().replace("_", "").replace("-", "")
        if asked and asked not in FAMILIES:
            raise self.model.error(f"family '{own.family}' in its YAML is unknown; known are {', '.join(FAMILIES)}, fastsam")
        if asked:
            family = asked
        elif efficient or self.input.name.startswith("batched"):
            family = "efficientsam"
        elif sum(len(t.shape) == 4 for t in self.model.outputs) >= 3:
            family = "sam2"
        else:
            family = "samexporter" if self.channels_last or np.issubdtype(self.input.dtype, np.integer) else "sam"
        style = FAMILIES[family]
        return family, replace(style, normalised=normalisation_of(self.model, style.normalised))

    def __call__(self, image: NDArray[np.uint8], deadline: Deadline) -> Embedded:
        """Picture (H, W) or (H, W, 3) BGR uint8, any size. Raises ModelError, BudgetError."""
        height, width = image.shape[:2]
        wanted = self._size(height, width)
        if self.style.padded:
            factor = min(wanted[0] / height, wanted[1] / width)
            inner = max(int(height * factor + 0.5), 1), max(int(width * factor + 0.5), 1)
        else:
            inner = wanted
        pixels = to_rgb(image, inner, self.model.sidecar.channels == "bgr")
        whole = np.zeros((*wanted, 3), np.float32)
        whole[: inner[0], : inner[1]] = self.style.normalised(pixels)
        tensor = whole if self.channels_last else whole.transpose(2, 0, 1)
        outputs = self.model.run({self.input.name: tensor if len(self.input.shape) == 3 else tensor[None]}, deadline)
        features = dict(zip((t.name for t in self.model.outputs), outputs, strict=True))
        coarsest = min((a.shape[-2:] for a in outputs if a.ndim == 4), key=lambda s: s[0] * s[1])
        frame = float(PATCH * coarsest[0]), float(PATCH * coarsest[1])
        if not self.style.padded:
            return Embedded(features, (height, width), frame, frame)
        factor = max(frame) / max(wanted)
        return Embedded(features, (height, width), frame, (inner[0] * factor, inner[1] * factor))

    def _size(self, height: int, width: int) -> tuple[int, int]:
        """Height and width of the input for a picture of this size."""
        if self.model.sidecar.size:
            return self.model.sidecar.size
        rows, columns = self.input.shape[-3:-1] if self.channels_last else self.input.shape[-2:]
        if rows and columns:
            return rows, columns
        if self.style.own_pixels:
            return height, width
        if self.channels_last:  # the graph pads by itself
            factor = SIDE / max(height, width)
            return max(int(height * factor + 0.5), 1), max(int(width * factor + 0.5), 1)
        return rows or SIDE, columns or SIDE


def to_rgb(image: NDArray[np.uint8], size: tuple[int, int], bgr: bool = False) -> NDArray[np.float32]:
    """Picture (H, W) or (H, W, 3) BGR -> (h, w, 3) float32 RGB, or BGR, 0..255, at another size."""
    colour = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image
    shrinks = size[0] < image.shape[0]
    resized = cv2.resize(colour, size[::-1], interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    return np.asarray(resized if bgr else resized[:, :, ::-1], np.float32)


def _is_picture(tensor: Tensor) -> bool:
    shape = tensor.shape
    channels = shape[-3::2] if len(shape) in (3, 4) else ()  # first or last but for the batch
    return 3 in channels or (len(shape) == 4 and shape[1] is None)
