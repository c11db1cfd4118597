"""Classes of the pixels of a frame (thesis 3.5), from a segmentation network."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import SemanticsConfig
from calib_ros.frame import Frame
from calib_ros_semantics.models import labels
from calib_ros_semantics.models.class_borders import PixelClasses, borders_of_classes, borders_of_scores
from calib_ros_semantics.models.class_output import ClassOutput
from calib_ros_semantics.models.onnx_model import (
    Array,
    Deadline,
    InputImage,
    Normalisation,
    OnnxModel,
    SegmentationModel,
    fitted,
    to_rgb,
)
from calib_ros_semantics.models.tiles import Tiling

FAMILIES = ("mmsegmentation", "PIDNet", "DDRNet", "torchvision", "SegFormer", "EdgeNets", "ESPNetv2")
CONVENTIONS = (
    "scores NxCxHxW or NxHxWxC and class numbers Nx1xHxW or NxHxW, as of mmsegmentation, PIDNet, DDRNet, torchvision, SegFormer "
    "and EdgeNets, at the input's size or a part of it"
)
# Of RGB: nearly all networks of streets start from weights trained on it.
IMAGENET = Normalisation(1 / 255, (0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
SIZE_MULTIPLE = 32  # px; deepest stride in use: other sizes do not fit together where a network adds its levels
MAX_SIDE = 1024  # px; networks of streets are trained on crops of 1024, and twice that takes four times as long
# Of the input: 19 scores for each pixel, as they are inside a network that gives class numbers, take 0.6 GB.
MAX_PIXELS = 2048 * 4096
EXAMPLE_SIZE = (256, 512)  # px; height and width to try a network of any size at


class ImageNetwork(SegmentationModel):
    """An ONNX network for classes of pixels. ModelError if it fits no known convention, or its YAML contradicts it."""

    def __init__(self, model: OnnxModel, config: SemanticsConfig) -> None:
        self.model, self.fallback = model, model.fallback
        self._family = model.family(FAMILIES)
        found = InputImage.of(model, model.inputs, (3,))
        if found is None:
            raise model.error("a network for classes of pixels takes one picture as 1x3xHxW or 1xHxWx3")
        self._input, self._size = found, found.size
        rows, columns = (n or 1 for n in self._size)
        if rows * columns > MAX_PIXELS:
            raise model.error(
                f"it takes pictures of {rows}x{columns}, which need gigabytes inside the network; at most {MAX_PIXELS / 1e6:.1f} "
                "million pixels are taken, such as 2048x4096: export it for a smaller size"
            )
        self._swap, self._as_it_is = model.sidecar.channels != "bgr", np.issubdtype(found.tensor.dtype, np.integer)
        self._normalised = Normalisation.of(model, Normalisation(1.0) if self._as_it_is else IMAGENET)
        example = self.feed(np.zeros((*EXAMPLE_SIZE, 3), np.uint8)), self.size(*EXAMPLE_SIZE)
        self._output = ClassOutput(model, example, labels.OF_IMAGES, labels.NUMBERS_OF_IMAGES, CONVENTIONS)

    def __call__(self, frame: Frame, deadline: Deadline, borders: bool = True) -> PixelClasses:
        deadline.check()
        self._output.settle(deadline)
        size = frame.image.shape[0], frame.image.shape[1]
        values = self._values(frame.image, deadline)
        classes = self._output.classes(values, size)
        self.known = self._output.known
        if not borders:
            return PixelClasses(classes, None)
        if self._output.count is None:
            return PixelClasses(classes, borders_of_classes(classes))
        return PixelClasses(classes, borders_of_scores(values, self._output.meaning(), size))

    def _values(self, image: NDArray[np.uint8], deadline: Deadline) -> Array:
        """Scores or class numbers of an image, of one run or put together from several."""
        shape, (rows, columns) = (image.shape[0], image.shape[1]), self._size
        size = self.size(*shape)
        tiling = None if rows is None or columns is None else Tiling.of(shape, (rows, columns), MAX_SIDE)
        if tiling is None:  # in one run, stretched
            return self._output.values(self.feed(image), deadline, size)
        picture = fitted(image, tiling.size)
        parts = [self._output.values(self.feed(tile), deadline, size) for tile in tiling.cut(picture)]
        return tiling.numbers(parts) if self._output.count is None else tiling.scores(parts)

    def describe(self) -> str:
        family = self._family or ("PIDNet with auxiliary heads" if self._output.is_pidnet else "segmentation network")
        height, width = ("?" if n is None else n for n in self._size)
        order = "RGB" if self._swap else "BGR"
        free = f" (at most {MAX_SIDE} wide)" if None in self._size else " (pictures of another shape in tiles)"
        given = f"{width}x{height} {order}{free}, fed as {self._normalised.text}"
        return f"{family}: {given} -> {self._output.text}, on {self.model.provider}"

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

    def feed(self, image: NDArray[np.uint8]) -> dict[str, Array]:
        """The input by its name for an image (H, W) or (H, W, 3) BGR."""
        dtype = self._input.tensor.dtype
        values: Array = self._normalised(to_rgb(image, self.size(*image.shape[:2]), bgr=not self._swap))
        if self._as_it_is:
            values = np.clip(np.rint(values), np.iinfo(dtype).min, np.iinfo(dtype).max)
        return {self._input.tensor.name: self._input.arranged(values)}
