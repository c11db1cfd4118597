"""Classes of the pixels of a frame (thesis 3.5), from a segmentation network or from ready labels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.config import SemanticsConfig
from calib_ros.config.semantics import SOURCE
from calib_ros.errors import ModelError
from calib_ros.frame import Frame
from calib_ros_semantics.models import labels
from calib_ros_semantics.models.class_borders import Map, borders_of_classes, borders_of_scores
from calib_ros_semantics.models.class_output import ClassOutput
from calib_ros_semantics.models.label_files import LabelPictures
from calib_ros_semantics.models.labels import Classes
from calib_ros_semantics.models.network_kinds import NetworkKind, kind_of
from calib_ros_semantics.models.onnx_model import GREY_LEVELS, Array, Deadline, OnnxModel, Tensor, formula
from calib_ros_semantics.models.tiles import Tiling
from calib_ros_semantics.models.weight_sets import file_of

# Exports by the name that a YAML may give as 'family:' (lower case) and as shown.
FAMILIES = {
    name.lower(): name for name in ("mmsegmentation", "PIDNet", "DDRNet", "torchvision", "SegFormer", "EdgeNets", "ESPNetv2")
}
CONVENTIONS = (
    "scores NxCxHxW or NxHxWxC and class numbers Nx1xHxW or NxHxW, as of mmsegmentation, PIDNet, DDRNet, torchvision, SegFormer "
    "and EdgeNets, at the input's size or a part of it"
)
# ImageNet's, of RGB in 0..1: nearly all networks of streets start from weights trained on it.
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
SIZE_MULTIPLE = 32  # px; deepest stride in use: other sizes do not fit together where a network adds its levels
MAX_SIDE = 1024  # px; networks of streets are trained on crops of 1024, and twice that takes four times as long
# Of the input: 19 scores for each pixel, as they are inside a network that gives class numbers, take 0.6 GB.
MAX_PIXELS = 2048 * 4096
EXAMPLE_SIZE = (256, 512)  # px; height and width to try a network of any size at


class ImageClasses:
    """Frame -> SemanticClass of each pixel (H, W) uint8, UNLABELLED where unknown, at the size of the image.

    path: "builtin" for the network of this package, an ONNX file, a folder of label pictures, or "source" for the labels of the
    dataset. Raises ModelError if unusable.
    """

    def __init__(self, path: str, config: SemanticsConfig) -> None:
        self._source: ImageNetwork | LabelPictures | SourceClasses
        if path == SOURCE:
            self._source = SourceClasses()
        elif Path(path).is_dir():
            self._source = LabelPictures(path)
        else:
            self._source = ImageNetwork(file_of(path), config)

    def __call__(self, frame: Frame, deadline: Deadline) -> Classes:
        """Classes of a frame. Raises ModelError without classes for it, BudgetError when the time is up."""
        return self.segment(frame, deadline, borders=False).classes

    def segment(self, frame: Frame, deadline: Deadline, borders: bool = True) -> PixelClasses:
        """Classes and, if requested, their borders, of one run of the network. Raises as above."""
        deadline.check()
        if isinstance(self._source, ImageNetwork):
            return self._source(frame, deadline, borders)
        classes = self._source(frame, deadline)
        return PixelClasses(classes, borders_of_classes(classes) if borders else None)

    def describe(self) -> str:
        """Kind, input and classes, as text."""
        return self._source.describe()

    @property
    def known(self) -> frozenset[int] | None:
        """SemanticClasses that the network tells apart, once it has run; None for classes that are given."""
        return self._source.known if isinstance(self._source, ImageNetwork) else None

    @property
    def fallback(self) -> str:
        """Why the network does not run on the configured provider; empty if it does."""
        return self._source.model.fallback if isinstance(self._source, ImageNetwork) else ""


class PixelClasses(NamedTuple):
    """classes: (H, W) uint8 SemanticClass. borders: (2, H, W) as of class_borders, None = not requested."""

    classes: Classes
    borders: Map | None


class SourceClasses:
    """Classes of the pixels that the dataset provides."""

    def __call__(self, frame: Frame, deadline: Deadline) -> Classes:
        if frame.classes is None:
            raise ModelError(
                "image_classes = source, but this source has no classes of pixels; name a network or a folder of label pictures"
            )
        return frame.classes

    def describe(self) -> str:
        return "classes of pixels of the source"


class ImageNetwork:
    """An ONNX network for classes of pixels. ModelError if it fits no known convention."""

    def __init__(self, path: str | Path, config: SemanticsConfig) -> None:
        self.model = OnnxModel(path, config)
        family = self.model.sidecar.family
        if family and family.lower() not in FAMILIES:
            raise self.model.error(f"family '{family}' is unknown; known are {', '.join(FAMILIES)}")
        kind, own = kind_of(self.model), self.model.sidecar
        if kind not in (NetworkKind.CLASSES, NetworkKind.OTHER) and not own.labels and not own.output:
            raise self.model.error(
                f"this looks like {kind.value}; semantics.image_classes takes a network for classes of pixels. If it is one, "
                f"name its classes by 'labels:' in {self.model.path.with_suffix('.yaml')}"
            )
        self._input = ImageInput(self.model)
        size = self._input.size(*EXAMPLE_SIZE)
        feeds = self._input.feed(np.zeros((*EXAMPLE_SIZE, 3), np.uint8))
        self._output = ClassOutput(self.model, (feeds, size), labels.OF_IMAGES, labels.NUMBERS_OF_IMAGES, CONVENTIONS)

    def __call__(self, frame: Frame, deadline: Deadline, borders: bool) -> PixelClasses:
        self._output.settle(deadline)
        height, width = frame.image.shape[:2]
        values = self._values(frame.image, deadline)
        classes = self._output.classes(values, (height, width))
        if not borders:
            return PixelClasses(classes, None)
        if self._output.count is None:
            return PixelClasses(classes, borders_of_classes(classes))
        return PixelClasses(classes, borders_of_scores(values, self._output.meaning(), (height, width)))

    def _values(self, image: NDArray[np.uint8], deadline: Deadline) -> Array:
        """Scores or class numbers of an image, of one run or put together from several."""
        size = self._input.size(*image.shape[:2])
        tiling = self._input.tiling(*image.shape[:2])
        if tiling is None:
            return self._output.values(self._input.feed(image), deadline, size)
        picture = fitted(image, tiling.size)
        parts = [self._output.values(self._input.feed(tile), deadline, size) for tile in tiling.cut(picture)]
        return tiling.numbers(parts) if self._output.count is None else tiling.scores(parts)

    @property
    def known(self) -> frozenset[int]:
        """The classes that it tells apart, once it has run."""
        return self._output.known

    def describe(self) -> str:
        return f"{self._family()}: {self._input.text} -> {self._output.text}, on {self.model.provider}"

    def _family(self) -> str:
        """The family as text, by the names of the tensors, which are those of the training framework."""
        model = self.model
        inputs, outputs = {t.name for t in model.inputs}, {t.name for t in model.outputs}
        if model.sidecar.family:
            return FAMILIES[model.sidecar.family.lower()]
        if "pixel_values" in inputs and "logits" in outputs:
            return "SegFormer (transformers)"
        if "out" in outputs and outputs <= {"out", "aux"}:
            return "torchvision"
        if self._output.is_pidnet:
            return "PIDNet with auxiliary heads"
        if self._output.name and self._output.count is None:
            return "network that gives class numbers (mmsegmentation)"
        return "EdgeNets" if self._output.count == len(labels.OF_IMAGES[20]) else "segmentation network"


class ImageInput:
    """The image input of a network: size, channels, normalisation, layout. ModelError if unusable or its YAML contradicts it."""

    def __init__(self, model: OnnxModel) -> None:
        sidecar = model.sidecar
        found = [(t, layout) for t in model.inputs if (layout := _layout(t.shape)) is not None]
        if len(found) != 1 or len(model.inputs) != 1:
            raise model.error("a network for classes of pixels takes one picture as 1x3xHxW or 1xHxWx3")
        self.tensor, (self._axis, self.channels) = found[0]
        sizes = [n for k, n in enumerate(self.tensor.shape) if k != self._axis][-2:] or [None, None]
        self._size = _size(model, sizes)
        rows, columns = (n or 1 for n in self._size)
        if rows * columns > MAX_PIXELS:
            raise model.error(
                f"it takes pictures of {rows}x{columns}, which need gigabytes inside the network; at most {MAX_PIXELS / 1e6:.1f} "
                "million pixels are taken, such as 2048x4096: export it for a smaller size"
            )
        self._swap = sidecar.channels != "bgr"
        if not isinstance(sidecar.channels, str):
            raise model.error("'channels:' of a network for pictures must be rgb or bgr")
        self._scale, self._mean, self._std = _normalisation(model, self.tensor, self.channels)
        self._declared = bool(sidecar.mean or sidecar.std or sidecar.scale is not None)

    @property
    def text(self) -> str:
        """As text, such as "1024x512 RGB" (width x height)."""
        width, height = ("?" if n is None else n for n in self._size[::-1])
        order = "grey" if self.channels == 1 else "RGB" if self._swap else "BGR"
        free = f" (at most {MAX_SIDE} wide)" if None in self._size else " (pictures of another shape in tiles)"
        size = f"{width}x{height} {order}{free}"
        return f"{size}, fed as {formula(float(self._scale), self._mean, self._std, self._declared)}"

    def size(self, height: int, width: int) -> tuple[int, int]:
        """Height and width of the input for an image of this size."""
        own_height, own_width = self._size
        scale = min(1.0, MAX_SIDE / max(height, width))
        if own_height is not None:
            scale = own_height / height
        elif own_width is not None:
            scale = own_width / width
        rows, columns = (max(round(n * scale / SIZE_MULTIPLE), 1) * SIZE_MULTIPLE for n in (height, width))
        return own_height or rows, own_width or columns

    def tiling(self, height: int, width: int) -> Tiling | None:
        """How an image of this size goes into an input of fixed size; None = in one run, stretched."""
        rows, columns = self._size
        return None if rows is None or columns is None else Tiling.of((height, width), (rows, columns), MAX_SIDE)

    def feed(self, image: NDArray[np.uint8]) -> dict[str, Array]:
        """The input by its name for an image (H, W) or (H, W, 3) BGR."""
        if self.channels == 1 and image.ndim == 3:
            image = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
        elif self.channels == 3 and image.ndim == 2:
            image = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
        height, width = self.size(*image.shape[:2])
        picture = fitted(image, (height, width)).reshape(height, width, self.channels)
        values: Array = picture[..., ::-1].astype(np.float32) if self._swap else picture.astype(np.float32)
        values = (values * self._scale - self._mean) / self._std
        if np.issubdtype(self.tensor.dtype, np.integer):
            limits = np.iinfo(self.tensor.dtype)
            values = np.clip(np.rint(values), limits.min, limits.max)
        batch = values if len(self.tensor.shape) == 3 else values[None]
        return {self.tensor.name: np.ascontiguousarray(np.moveaxis(batch, -1, self._axis), self.tensor.dtype)}


def fitted(image: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """An image (H, W) or (H, W, 3) at another size (height, width)."""
    if image.shape[:2] == size:
        return image
    # Averaging all pixels when shrinking keeps thin objects.
    shrinks = size[0] <= image.shape[0] and size[1] <= image.shape[1]
    how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, size[::-1], interpolation=how), np.uint8)


def _layout(shape: Sequence[int | None]) -> tuple[int, int] | None:
    """Axis and number of the channels of an input of this shape; None if it is not an image."""
    if not shape:
        return 1, 3  # unknown rank: the usual layout
    if len(shape) not in (3, 4) or (len(shape) == 4 and shape[0] not in (None, 1)):
        return None
    first = len(shape) - 3
    if shape[first] in (1, 3):
        return first, int(shape[first] or 3)
    if shape[-1] in (1, 3):
        return len(shape) - 1, int(shape[-1] or 3)
    return (first, 3) if shape[first] is None else None


def _size(model: OnnxModel, own: Sequence[int | None]) -> tuple[int | None, int | None]:
    """Height and width of the graph, else of its YAML; None where unknown."""
    if model.sidecar.size is None:
        return own[0], own[1]
    if any(n not in (None, given) for n, given in zip(own, model.sidecar.size, strict=True)):
        raise model.error(f"it does not run at the height and width {list(model.sidecar.size)} that 'size:' says")
    return model.sidecar.size


def _normalisation(model: OnnxModel, tensor: Tensor, channels: int) -> tuple[np.float32, Array, Array]:
    """Scale, mean and std: of the YAML, else none for an integer input, else ImageNet's."""
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
