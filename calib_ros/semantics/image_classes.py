"""Classes of the pixels of a frame (thesis 3.5), from a segmentation network or from ready labels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.config import SemanticsConfig
from calib_ros.config.semantics import BUILTIN, SOURCE
from calib_ros.errors import ModelError
from calib_ros.frame import Frame
from calib_ros.semantics import labels
from calib_ros.semantics.class_borders import Map, borders_of_classes, borders_of_scores
from calib_ros.semantics.label_files import LabelPictures
from calib_ros.semantics.labels import Classes, Layout, Names, Size, layout_of, resized, table_of
from calib_ros.semantics.onnx_model import GREY_LEVELS, Array, Deadline, OnnxModel, Tensor

# How a picture becomes the input of a network: size, channels, normalisation, layout.
# ImageNet's, of RGB in 0..1: nearly all networks of streets start from weights trained on it.
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
MULTIPLE = 32  # deepest stride in use: other sizes do not fit together where a network adds its levels
LONGEST = 1024  # px; networks of streets are trained on crops of 1024, and twice that takes four times as long


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


# The output of a network that holds classes: which it is, and reading it.
class ClassOutput:
    """The output of a network that counts, and what its numbers mean.

    feeds, size: an example of its inputs and their (height, width); if the file does not tell the sizes of its outputs, settle()
    runs it on them. by_count, by_number: see label_tables. conventions: those known, for the error. ModelError if none of its
    outputs holds classes.

    count: number of classes, None = it gives their numbers. name: that of the output, empty until it is settled. is_pidnet:
    it has the three outputs of PIDNet.
    """

    def __init__(
        self,
        model: OnnxModel,
        example: tuple[Mapping[str, Array], Size],
        by_count: Mapping[int, Names],
        by_number: Mapping[str, Names],
        conventions: str,
    ) -> None:
        asked = model.sidecar.output
        if asked and asked not in [t.name for t in model.outputs]:
            raise model.error(f"there is no output '{asked}', which {model.path.with_suffix('.yaml')} asks for")
        self._model, self._feeds, self._size = model, *example
        self._by_count, self._by_number, self._conventions = by_count, by_number, conventions
        self.count: int | None = None
        self.name, self.is_pidnet = "", False
        shapes = _declared(model, self._feeds)
        if shapes is not None:
            self._choose(shapes)

    def settle(self, deadline: Deadline) -> None:
        """Chooses the output if that has not been done. ModelError if none holds classes; BudgetError."""
        if not self.name:
            self._choose([out.shape for out in self._model.run(self._feeds, deadline)])

    def _choose(self, shapes: Sequence[tuple[int, ...]]) -> None:
        model, size = self._model, self._size
        layouts = [layout_of(shape, size) for shape in shapes]
        maps = {k: layout for k, layout in enumerate(layouts) if layout is not None}
        is_pidnet = not model.sidecar.output and _is_pidnet(model, maps, size)
        at = 1 if is_pidnet else _chosen(model, maps)
        if at is None:
            sizes = ", ".join(f"{t.name} {'x'.join(map(str, s))}" for t, s in zip(model.outputs, shapes, strict=True))
            raise model.error(
                f"none of its outputs is a map of classes for an input of {size[0]}x{size[1]} ({sizes}); known are "
                f"{self._conventions}"
            )
        self._table = table_of(model, maps[at].count, self._by_count, self._by_number)
        self.count, self.name, self.is_pidnet = maps[at].count, model.outputs[at].name, is_pidnet

    @property
    def text(self) -> str:
        """For people."""
        if not self.name:
            return "what it gives is seen in its first run"
        if self.count is not None:
            return f"{self.name}: scores of {self.count} classes"
        guess = self._table.guess
        return f"{self.name}: class numbers" + (f", read as {guess} until told otherwise by labels:" if guess else "")

    def run(self, feeds: Mapping[str, Array], deadline: Deadline, size: Size, wanted: Size) -> Classes:
        """Classes in the wanted size, of inputs of a size (height, width), once it is settled. ModelError, BudgetError."""
        return self.classes(self.values(feeds, deadline, size), wanted)

    def values(self, feeds: Mapping[str, Array], deadline: Deadline, size: Size) -> Array:
        """Scores (C, h, w), or numbers (h, w) if there is no count, of inputs of a size (height, width), once it is settled.

        ModelError, BudgetError.
        """
        found = self._model.run(feeds, deadline, [self.name])[0]
        layout = layout_of(found.shape, size)
        if layout is None or layout.count != self.count:
            raise self._model.error(f"its output {self.name} has become {'x'.join(map(str, found.shape))}")
        values = found.reshape(layout.shape)
        return values if layout.axis is None else np.moveaxis(values, layout.axis, 0)

    def classes(self, values: Array, wanted: Size) -> Classes:
        """Classes in the wanted size (height, width) of what values() gave. ModelError for what are no classes."""
        try:
            if self.count is not None:
                return self._table.classes(best(values, wanted))
            return resized(self._table.classes(_whole(values)), wanted)
        except ModelError as error:
            raise self._model.error(f"output {self.name}: {error}") from None

    def meaning(self) -> Classes:
        """SemanticClass (count,) of each score."""
        return self._table.classes(np.arange(self.count or 0))


def best(scores: NDArray[Any], size: Size) -> NDArray[np.int16]:
    """Number (H, W) of the class of highest score, scores (C, h, w); interpolated to the size first; -1 where all are NaN.

    Cells cover equal parts of the image, as networks place them that do not align corners.
    """
    highest, winner = np.full(size, -np.inf, np.float32), np.full(size, -1, np.int16)
    for number, score in enumerate(scores):
        plane = np.ascontiguousarray(score, np.float32)
        if plane.shape != size:
            plane = cv2.resize(plane, (size[1], size[0]), interpolation=cv2.INTER_LINEAR)
        better = plane > highest
        np.copyto(highest, plane, where=better)
        np.copyto(winner, np.int16(number), where=better)
    if winner.max() < 0:
        raise ModelError("there is no number in it; float16 may have overflowed, export it as float32")
    return winner


def _whole(values: NDArray[Any]) -> NDArray[np.int64]:
    """Class numbers, which some exports give as floats."""
    if values.dtype == np.bool_ or not np.isfinite(values).all() or (values != np.rint(values)).any():
        raise ModelError("it has one channel, but holds no class numbers: a network for a single class cannot be used")
    return values.astype(np.int64)


def _declared(model: OnnxModel, feeds: Mapping[str, Array]) -> list[tuple[int, ...]] | None:
    """Shapes of the outputs for these inputs, if the file tells them all."""
    if any(None in t.shape[1:] or not t.shape for t in model.inputs if t.name in feeds):
        return None
    shapes = []
    for t in model.outputs:
        shape = (1, *t.shape[1:]) if len(t.shape) > 2 and t.shape[0] is None else t.shape
        sizes = tuple(n for n in shape if n is not None)
        if not shape or len(sizes) < len(shape):
            return None
        shapes.append(sizes)
    return shapes


def _chosen(model: OnnxModel, maps: Mapping[int, Layout]) -> int | None:
    """Which output counts: that of the YAML; scores rather than numbers, integers rather than what may be a confidence."""
    if model.sidecar.output:
        at = [t.name for t in model.outputs].index(model.sidecar.output)
        return at if at in maps else None
    scores = [k for k, layout in maps.items() if layout.count is not None]
    integers = [k for k in maps if np.issubdtype(model.outputs[k].dtype, np.integer)]
    return next(iter(scores or integers or maps), None)


def _is_pidnet(model: OnnxModel, maps: Mapping[int, Layout], size: Size) -> bool:
    """Whether three outputs are those of PIDNet: two alike, in an eighth of the input's size unless enlarged, and boundaries.

    The middle one counts.
    """
    if len(model.outputs) != 3 or not {0, 1} <= set(maps) or maps[0].count is None or maps[0].shape != maps[1].shape:
        return False
    in_eighths = abs(size[1] / maps[1].cells[1] - 8) < 1
    boundaries = 2 in maps and maps[2].count is None
    return in_eighths or boundaries or model.sidecar.family.lower() == "pidnet"


# Exports by the name that a YAML may give as 'family:', and as people know them. It counts where PIDNet's outputs are enlarged.
FAMILIES = {
    name.lower(): name for name in ("mmsegmentation", "PIDNet", "DDRNet", "torchvision", "SegFormer", "EdgeNets", "ESPNetv2")
}
WEIGHTS = Path(__file__).parent / "weights" / "streets.onnx"  # made by training/, see its README.md
EXAMPLE = (256, 512)  # px; height and width to try a network of any size at
CONVENTIONS = (
    "scores NxCxHxW or NxHxWxC and class numbers Nx1xHxW or NxHxW, as of mmsegmentation, PIDNet, DDRNet, torchvision, SegFormer "
    "and EdgeNets, at the input's size or a part of it"
)


class PixelClasses(NamedTuple):
    """SemanticClass (H, W) uint8 of each pixel, and the borders of classes (2, H, W), see class_borders; None = not wanted."""

    classes: Classes
    borders: Map | None


class ImageClasses:
    """Frame -> SemanticClass of each pixel (H, W) uint8, UNLABELLED where unknown, in the size of the image.

    path: "builtin" for the network of this package, ONNX file of another, folder of label pictures, or "source" for what the
    source itself knows.
    ModelError for what cannot be used.
    """

    def __init__(self, path: str, config: SemanticsConfig) -> None:
        self._make: ImageNetwork | LabelPictures | SourceClasses
        if path == SOURCE:
            self._make = SourceClasses()
        elif Path(path).is_dir():
            self._make = LabelPictures(path)
        else:
            self._make = ImageNetwork(WEIGHTS if path == BUILTIN else path, config)

    def __call__(self, frame: Frame, deadline: Deadline) -> Classes:
        """ModelError: no classes for this frame. BudgetError: the time is up."""
        return self.segment(frame, deadline, borders=False).classes

    def segment(self, frame: Frame, deadline: Deadline, borders: bool = True) -> PixelClasses:
        """Classes and, if wanted, their borders, of one run of the network. Errors as above."""
        deadline.check()
        if isinstance(self._make, ImageNetwork):
            return self._make(frame, deadline, borders)
        classes = self._make(frame, deadline)
        return PixelClasses(classes, borders_of_classes(classes) if borders else None)

    def describe(self) -> str:
        """What it is, what goes in, which classes come out."""
        return self._make.describe()

    @property
    def fallback(self) -> str:
        """Why the network does not run where it was asked to; empty if it does."""
        return self._make.model.fallback if isinstance(self._make, ImageNetwork) else ""


class SourceClasses:
    """Classes of pixels that came with the frame."""

    def __call__(self, frame: Frame, deadline: Deadline) -> Classes:
        if frame.classes is None:
            raise ModelError(
                "image_classes = source, but this source knows no classes of pixels; name a network or a folder of label pictures"
            )
        return frame.classes

    def describe(self) -> str:
        return "classes of pixels that the source knows"


class ImageNetwork:
    """An ONNX file that gives classes of pixels. ModelError if it fits no known convention."""

    def __init__(self, path: str | Path, config: SemanticsConfig) -> None:
        self.model = OnnxModel(path, config)
        family = self.model.sidecar.family
        if family and family.lower() not in FAMILIES:
            raise self.model.error(f"family '{family}' is unknown; known are {', '.join(FAMILIES)}")
        self._input = ImageInput(self.model)
        size = self._input.size(*EXAMPLE)
        feeds = self._input.feed(np.zeros((*EXAMPLE, 3), np.uint8))
        self._output = ClassOutput(self.model, (feeds, size), labels.OF_IMAGES, labels.NUMBERS_OF_IMAGES, CONVENTIONS)

    def __call__(self, frame: Frame, deadline: Deadline, borders: bool) -> PixelClasses:
        self._output.settle(deadline)
        height, width = frame.image.shape[:2]
        values = self._output.values(self._input.feed(frame.image), deadline, self._input.size(height, width))
        classes = self._output.classes(values, (height, width))
        if not borders:
            return PixelClasses(classes, None)
        if self._output.count is None:
            return PixelClasses(classes, borders_of_classes(classes))
        return PixelClasses(classes, borders_of_scores(values, self._output.meaning(), (height, width)))

    def describe(self) -> str:
        return f"{self._family()}: {self._input.text} -> {self._output.text}, on {self.model.provider}"

    def _family(self) -> str:
        """What the export looks like; networks of one training framework all have its names."""
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
