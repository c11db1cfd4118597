"""All configured models together: a frame in, what they see in it out. A model that fails is said once and left out."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import SemanticsConfig
from calib_ros.config.semantics import AUTO, BUILTIN, GEOMETRIC
from calib_ros.errors import BudgetError, CalibrationError, MissingDependencyError
from calib_ros.frame import Frame
from calib_ros.semantics.onnx_model import Deadline, first_line

# What semantics make of a frame.
OF_MASKS, OF_CLASSES = "masks", "classes"  # what edges may be of


@dataclass(frozen=True, eq=False)
class FrameSemantics:
    """Semantics of one frame, in the size of the image as recorded; None = not known.

    edges: (2, H, W) float32 in 0..1, boundaries of masks with horizontal [0] and vertical [1] gradients (their sum is the
    strength), or borders of classes; edges_of tells which. classes: (H, W) uint8 SemanticClass of pixels. labels: (n,) uint8
    SemanticClass per point of the frame's cloud. problems: one line for each model that failed. seconds: time taken, by kind
    of model.
    """

    edges: NDArray[np.float32] | None = None
    classes: NDArray[np.uint8] | None = None
    labels: NDArray[np.uint8] | None = None
    problems: tuple[str, ...] = ()
    seconds: tuple[tuple[str, float], ...] = ()
    edges_of: str = OF_MASKS


FAILURES = 3  # in a row after which a model is switched off: what fails so often costs time and tells nothing new
MASKS, IMAGE, CLOUD = "segment_anything", "image_classes", "cloud_classes"
ALL, CLASSES = (MASKS, IMAGE, CLOUD), (IMAGE, CLOUD)
ADVICE = {
    MASKS: "; take a smaller semantics.prompt_grid, more semantics.threads, or a larger budget",
    IMAGE: "; take a smaller network, more semantics.threads, or a larger budget",
    CLOUD: "; take a smaller network, more semantics.threads, or a larger budget",
}


class SegmentationModel(Protocol):
    """A loaded model. fallback: why it does not run where it was asked to; empty if it does."""

    @property
    def fallback(self) -> str: ...

    def __call__(self, frame: Frame, deadline: Deadline) -> Any:
        """That part of Seen which the model is for; of pixels the classes. ModelError, BudgetError."""

    def describe(self) -> str:
        """What it is, takes and gives, for people."""


@dataclass(eq=False)
class ModelSlot:
    """One configured model. kind: name of its parameter. off: why it is not used any more; empty while it is."""

    kind: str
    path: str
    network: SegmentationModel | None = None
    off: str = ""
    failures: int = 0


class Segmentation:
    """The models of a configuration. They are loaded when first needed, which may take seconds, or by load()."""

    def __init__(self, config: SemanticsConfig) -> None:
        self.config = config
        chosen = {MASKS: config.segment_anything, IMAGE: config.image_classes, CLOUD: config.cloud_classes}
        if config.segmentation == "none":
            chosen = {}
        if chosen.get(CLOUD) == AUTO:
            chosen[CLOUD] = GEOMETRIC if chosen[IMAGE] else ""
        self.models = [ModelSlot(kind, path) for kind, path in chosen.items() if path]
        self._lock = threading.Lock()

    @property
    def active(self) -> bool:
        """True if there is a model that has not been switched off."""
        return any(not m.off for m in self.models)

    def missing(self, *kinds: str) -> str:
        """Which of the kinds nothing is configured for, or is off, and what to do; empty if all of them work."""
        for kind in kinds:
            model = next((m for m in self.models if m.kind == kind), None)
            if model is None:
                return f"semantics.{kind} is not set, which a first guess needs; set it, or semantics.first_guess: false"
            if model.off:
                return f"semantics.{kind} is off ({model.off}); mend it, or set semantics.first_guess: false"
        return ""

    def load(self) -> list[str]:
        """Load all models now; a line for each that does not run where it was asked to, or is switched off.

        The defaults, the built-in network and classes by shape, are switched off where onnxruntime or scikit-learn is missing:
        calibration works without them. ModelError or MissingDependencyError if a model that the user chose cannot be loaded.
        """
        notes = []
        with self._lock:
            for model in self.models:
                try:
                    notes.append(self._loaded(model).fallback)
                except MissingDependencyError as error:
                    default = model.path == BUILTIN or (model.kind == CLOUD and self.config.cloud_classes == AUTO)
                    if not default:
                        raise
                    model.off = str(error)
                    notes.append(f"semantics.{model.kind} is off: {model.off}")
        return [note for note in notes if note]

    def __call__(self, frame: Frame, cancelled: Callable[[], bool] = lambda: False, kinds: Sequence[str] = ALL) -> FrameSemantics:
        """What the models see in a frame. Whatever goes wrong is in Seen.problems, and that model's part is None.

        cancelled: asked now and then whether to break off, as at shutdown. kinds: of models to ask.
        """
        with self._lock:
            answers: dict[str, Any] = {}
            problems: list[str] = []
            seconds: list[tuple[str, float]] = []
            for model in self.models:
                if model.off or cancelled() or model.kind not in kinds:
                    continue
                began = time.monotonic()
                # Masks come first: they follow outlines more closely than classes.
                borders = not _are_edges(answers.get(MASKS))
                answers[model.kind] = self._run(model, frame, cancelled, problems, borders)
                seconds.append((model.kind, time.monotonic() - began))
        edges, pixels, of = answers.get(MASKS), answers.get(IMAGE), OF_MASKS
        if pixels is not None and pixels.borders is not None:
            edges, of = pixels.borders, OF_CLASSES
        classes = None if pixels is None else pixels.classes
        return FrameSemantics(edges, classes, answers.get(CLOUD), tuple(problems), tuple(seconds), of)

    def _run(self, model: ModelSlot, frame: Frame, cancelled: Callable[[], bool], problems: list[str], borders: bool) -> Any:
        try:
            first = model.network is None
            network = self._loaded(model)
        except Exception as error:  # nothing that is in somebody's file may end the node, or be said with every keyframe
            model.off = error_line(error)
            problems.append(f"semantics.{model.kind} is off: {model.off}")
            return None
        if first and network.fallback:
            problems.append(network.fallback)
        try:
            answer = run_model(network, frame, Deadline(self.config.budget_s, cancelled), borders)
        except Exception as error:  # whatever somebody's model makes of an image, the calibration goes on
            if not cancelled():
                problems.append(self._failed(model, frame, error))
            return None
        model.failures = 0
        return answer

    def _failed(self, model: ModelSlot, frame: Frame, error: Exception) -> str:
        model.failures += 1
        advice = ADVICE[model.kind] if isinstance(error, BudgetError) else ""
        line = f"semantics.{model.kind}, frame {frame.name or frame.stamp}: {error_line(error)}{advice}"
        if model.failures < FAILURES:
            return line
        model.off = line
        return f"{line}; off from now on after {FAILURES} failures in a row"

    def _loaded(self, model: ModelSlot) -> SegmentationModel:
        if model.network is None:
            model.network = load_model(model.kind, model.path, self.config)
        return model.network


def error_line(error: Exception) -> str:
    """What went wrong with a model, in one line."""
    return str(error) if isinstance(error, CalibrationError) else f"unexpected {type(error).__name__}: {first_line(error)}"


def run_model(network: SegmentationModel, frame: Frame, deadline: Deadline, borders: bool = True) -> Any:
    """What a model sees in a frame; of pixels the classes and, if wanted, their borders. ModelError, BudgetError."""
    from calib_ros.semantics.image_classes import ImageClasses

    return network.segment(frame, deadline, borders) if isinstance(network, ImageClasses) else network(frame, deadline)


def _are_edges(edges: NDArray[np.float32] | None) -> bool:
    return edges is not None and bool(edges.any())


def load_model(kind: str, path: str, config: SemanticsConfig) -> SegmentationModel:
    """One model. ModelError if it cannot be loaded. Modules are imported here: without models nothing of them is needed."""
    if kind == MASKS:
        from calib_ros.semantics.segment_anything import MaskEdges

        return MaskEdges(config)
    if kind == IMAGE:
        from calib_ros.semantics.image_classes import ImageClasses

        return ImageClasses(path, config)
    if path == GEOMETRIC:
        from calib_ros.lidar.segmentation import require_scikit_learn
        from calib_ros.semantics.geometric_classes import ClusterClasses

        require_scikit_learn()
        return ClusterClasses()
    from calib_ros.semantics.cloud_classes import CloudClasses

    return CloudClasses(path, config)
