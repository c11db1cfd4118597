"""Classes of the points of a frame (thesis 3.5), from a network for range images or from ready labels."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calib_ros.classes import UNLABELLED
from calib_ros.config import SemanticsConfig
from calib_ros.config.semantics import SOURCE
from calib_ros.errors import ModelError
from calib_ros.frame import Frame
from calib_ros.semantics import labels
from calib_ros.semantics.cloud_input import CloudInput
from calib_ros.semantics.cloud_projection import classes_of_points
from calib_ros.semantics.deadline import Deadline
from calib_ros.semantics.label_datasets import SQUEEZESEG
from calib_ros.semantics.label_files import LabelScans
from calib_ros.semantics.label_output import ClassOutput
from calib_ros.semantics.labels import Classes
from calib_ros.semantics.onnx_model import OnnxModel

FEWEST = 100  # points; a scan with fewer returns shows nothing
CONVENTIONS = (
    "scores NxCxHxW or NxHxWxC and class numbers Nx1xHxW or NxHxW, as of lidar-bonnetal, SqueezeSeg, SqueezeSegV3, SalsaNext, "
    "3D-MiniNet and CENet"
)


class CloudClasses:
    """Frame -> SemanticClass of each point of its cloud (n,) uint8, UNLABELLED where unknown or nothing returned.

    path: ONNX file of a network for range images, folder of .label files, or "source" for what the source itself knows.
    ModelError for what cannot be used.
    """

    def __init__(self, path: str, config: SemanticsConfig) -> None:
        self._make: CloudNetwork | LabelScans | SourceLabels
        if path == SOURCE:
            self._make = SourceLabels()
        elif Path(path).is_dir():
            self._make = LabelScans(path)
        else:
            self._make = CloudNetwork(path, config)

    def __call__(self, frame: Frame, deadline: Deadline) -> Classes:
        """ModelError: no classes for this frame. BudgetError: the time is up."""
        deadline.check()
        return np.where(frame.cloud.finite_mask(), self._make(frame, deadline), np.uint8(UNLABELLED))

    def describe(self) -> str:
        """What it is, what goes in, which classes come out."""
        return self._make.describe()

    @property
    def fallback(self) -> str:
        """Why the network does not run where it was asked to; empty if it does."""
        return self._make.model.fallback if isinstance(self._make, CloudNetwork) else ""

    @property
    def note(self) -> str:
        """In what the last scan is not what the network was made for; empty if it fits."""
        return self._make.note if isinstance(self._make, CloudNetwork) else ""


class SourceLabels:
    """Classes of points that came with the frame."""

    def __call__(self, frame: Frame, deadline: Deadline) -> Classes:
        if frame.cloud.label is None:
            raise ModelError(
                "cloud_classes = source, but this source knows no classes of points; use geometric, a network or a folder of "
                ".label files"
            )
        return frame.cloud.label

    def describe(self) -> str:
        return "classes of points that the source knows"


class CloudNetwork:
    """An ONNX file that gives classes of the pixels of a range image. ModelError if it fits no known convention."""

    def __init__(self, path: str, config: SemanticsConfig) -> None:
        self.model, self.note = OnnxModel(path, config), ""
        self._input = CloudInput(self.model)
        numbers = labels.NUMBERS_OF_CLOUDS
        if self._input.family in ("squeezeseg", "squeezesegv2"):  # its four would pass for the first four of SemanticKITTI
            numbers = {"squeezeseg": SQUEEZESEG, **numbers}
        self._output = ClassOutput(self.model, self._input.example(), labels.OF_CLOUDS, numbers, CONVENTIONS)
        self._input.settle(self._output.count)

    def __call__(self, frame: Frame, deadline: Deadline) -> Classes:
        returns = frame.cloud.finite_mask()
        if int(returns.sum()) < FEWEST:
            raise ModelError(f"the cloud has {int(returns.sum())} usable points; check that the LiDAR sees something")
        self._output.settle(deadline)
        self._input.settle(self._output.count)
        feeds, view, self.note = self._input.feed(frame.cloud.select(returns))
        size = view.index.shape
        pixels = self._output.run(feeds, deadline, size, size)
        found = np.full(len(frame.cloud), UNLABELLED, np.uint8)
        found[returns] = classes_of_points(view, pixels)
        return found

    def describe(self) -> str:
        return f"{self._input.family}: {self._input.text} -> {self._output.text}, on {self.model.provider}"
