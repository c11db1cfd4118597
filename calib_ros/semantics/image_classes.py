"""Classes of the pixels of a frame (thesis 3.5), from a segmentation network or from ready labels."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from calib_ros.config import SemanticsConfig
from calib_ros.config.semantics import BUILTIN, SOURCE
from calib_ros.errors import ModelError
from calib_ros.frame import Frame
from calib_ros.semantics import labels
from calib_ros.semantics.class_borders import Map, borders_of_classes, borders_of_scores
from calib_ros.semantics.deadline import Deadline
from calib_ros.semantics.image_input import ImageInput
from calib_ros.semantics.label_files import LabelPictures
from calib_ros.semantics.label_output import ClassOutput
from calib_ros.semantics.labels import Classes
from calib_ros.semantics.onnx_model import OnnxModel

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


class Pixels(NamedTuple):
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
        return self.look(frame, deadline, borders=False).classes

    def look(self, frame: Frame, deadline: Deadline, borders: bool = True) -> Pixels:
        """Classes and, if wanted, their borders, of one run of the network. Errors as above."""
        deadline.check()
        if isinstance(self._make, ImageNetwork):
            return self._make(frame, deadline, borders)
        classes = self._make(frame, deadline)
        return Pixels(classes, borders_of_classes(classes) if borders else None)

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

    def __call__(self, frame: Frame, deadline: Deadline, borders: bool) -> Pixels:
        self._output.settle(deadline)
        height, width = frame.image.shape[:2]
        values = self._output.values(self._input.feed(frame.image), deadline, self._input.size(height, width))
        classes = self._output.classes(values, (height, width))
        if not borders:
            return Pixels(classes, None)
        if self._output.count is None:
            return Pixels(classes, borders_of_classes(classes))
        return Pixels(classes, borders_of_scores(values, self._output.meaning(), (height, width)))

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
