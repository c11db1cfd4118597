"""How a picture becomes the input of a network: size, channels, normalisation, layout."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.semantics.onnx_model import Array, OnnxModel, Tensor

# ImageNet's, of RGB in 0..1: nearly all networks of streets start from weights trained on it.
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
MULTIPLE = 32  # deepest stride in use: other sizes do not fit together where a network adds its levels
LONGEST = 1024  # px; networks of streets are trained on crops of 1024, and twice that takes four times as long
GREY_LEVELS = 2.0  # mean or std above this are of 0..255, not of 0..1


class ImageInput:
    """The input of a network that takes a picture. ModelError if it takes none, or its YAML contradicts it."""

    def __init__(self, model: OnnxModel) -> None:
        sidecar = model.sidecar
        found = [(t, layout) for t in model.inputs if (layout := _layout(t.shape)) is not None]
        if len(found) != 1 or len(model.inputs) != 1:
            raise model.error("a network for classes of pixels takes one picture as 1x3xHxW or 1xHxWx3")
        self.tensor, (self._axis, self.channels) = found[0]
        sizes = [n for k, n in enumerate(self.tensor.shape) if k != self._axis][-2:] or [None, None]
        self._size = _size(model, sizes)
        self._swap = sidecar.channels != "bgr"
        if not isinstance(sidecar.channels, str):
            raise model.error("'channels:' of a network for pictures must be rgb or bgr")
        self._scale, self._mean, self._std = _normalisation(model, self.tensor, self.channels)

    @property
    def text(self) -> str:
        """For people, such as "1024x512 RGB": width and height."""
        width, height = ("?" if n is None else n for n in self._size[::-1])
        order = "grey" if self.channels == 1 else "RGB" if self._swap else "BGR"
        return f"{width}x{height} {order}" + (f" (at most {LONGEST} wide)" if None in self._size else "")

    def size(self, height: int, width: int) -> tuple[int, int]:
        """Height and width at which a picture of this size goes in."""
        own_height, own_width = self._size
        scale = min(1.0, LONGEST / max(height, width))
        if own_height is not None:
            scale = own_height / height
        elif own_width is not None:
            scale = own_width / width
        rows, columns = (max(round(n * scale / MULTIPLE), 1) * MULTIPLE for n in (height, width))
        return own_height or rows, own_width or columns

    def feed(self, image: NDArray[np.uint8]) -> dict[str, Array]:
        """The input by its name for a picture (H, W) or (H, W, 3) BGR."""
        if self.channels == 1 and image.ndim == 3:
            image = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
        elif self.channels == 3 and image.ndim == 2:
            image = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
        height, width = self.size(*image.shape[:2])
        if image.shape[:2] != (height, width):
            # Of a larger picture all pixels count, else thin things would come and go.
            shrinks = height <= image.shape[0] and width <= image.shape[1]
            how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
            image = np.asarray(cv2.resize(image, (width, height), interpolation=how), np.uint8)
        picture = image.reshape(height, width, self.channels)
        values: Array = picture[..., ::-1].astype(np.float32) if self._swap else picture.astype(np.float32)
        values = (values * self._scale - self._mean) / self._std
        if np.issubdtype(self.tensor.dtype, np.integer):
            limits = np.iinfo(self.tensor.dtype)
            values = np.clip(np.rint(values), limits.min, limits.max)
        batch = values if len(self.tensor.shape) == 3 else values[None]
        return {self.tensor.name: np.ascontiguousarray(np.moveaxis(batch, -1, self._axis), self.tensor.dtype)}


def _layout(shape: Sequence[int | None]) -> tuple[int, int] | None:
    """Axis and number of the channels of a picture in an input of this shape; None if it is no picture."""
    if not shape:
        return 1, 3  # not even the rank is told: as nearly all have it
    if len(shape) not in (3, 4) or (len(shape) == 4 and shape[0] not in (None, 1)):
        return None
    first = len(shape) - 3
    if shape[first] in (1, 3):
        return first, int(shape[first] or 3)
    if shape[-1] in (1, 3):
        return len(shape) - 1, int(shape[-1] or 3)
    return (first, 3) if shape[first] is None else None


def _size(model: OnnxModel, own: Sequence[int | None]) -> tuple[int | None, int | None]:
    """Height and width of the graph, else those of its YAML, None where neither tells."""
    if model.sidecar.size is None:
        return own[0], own[1]
    if any(n not in (None, asked) for n, asked in zip(own, model.sidecar.size, strict=True)):
        raise model.error(f"it does not run at the height and width {list(model.sidecar.size)} that 'size:' says")
    return model.sidecar.size


def _normalisation(model: OnnxModel, tensor: Tensor, channels: int) -> tuple[np.float32, Array, Array]:
    """Scale, mean and std: of the YAML, else none for grey levels as integers, else ImageNet's."""
    scale, mean, std = model.sidecar.scale, model.sidecar.mean, model.sidecar.std
    for name, values in (("mean", mean), ("std", std)):
        if len(values) not in (0, 1, channels):
            raise model.error(f"'{name}:' must have {channels} numbers, one for each channel")
    if not mean and not std and scale is None:
        if np.issubdtype(tensor.dtype, np.integer):
            scale = 1.0
        else:
            mean, std = (MEAN, STD) if model.sidecar.channels != "bgr" else (MEAN[::-1], STD[::-1])
    mean, std = mean or (0.0,), std or (1.0,)
    if scale is None:
        scale = 1.0 if max(map(abs, mean + std)) > GREY_LEVELS else 1 / 255
    if channels == 1 and len(mean) == 3:  # ImageNet's for grey
        mean, std = (float(np.mean(mean)),), (float(np.mean(std)),)
    return np.float32(scale), np.asarray(mean, np.float32), np.asarray(std, np.float32)
