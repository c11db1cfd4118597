"""All configured models together: a frame in, its semantics out."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import SemanticsConfig
from calib_ros.config.semantics import AUTO, BUILTIN, GEOMETRIC, SOURCE
from calib_ros.errors import BudgetError, CalibrationError, MissingDependencyError
from calib_ros.frame import UNLABELLED, Frame, SemanticClass
from calib_ros.registration.classes import ALL, CLOUD, IMAGE, MASKS, OF_CLASSES, OF_MASKS, FrameSemantics
from calib_ros_semantics.models.cloud_classes import CloudNetwork
from calib_ros_semantics.models.fast_sam import FastSam, is_fast_sam
from calib_ros_semantics.models.geometric_classes import ClusterClasses
from calib_ros_semantics.models.image_classes import ImageNetwork
from calib_ros_semantics.models.labels import Classes
from calib_ros_semantics.models.masks import MaskModel
from calib_ros_semantics.models.onnx_model import Deadline, OnnxModel, SegmentationModel, error_text
from calib_ros_semantics.models.ready import MaskFolder, ReadyClasses
from calib_ros_semantics.models.segment_anything import SegmentAnything
from calib_ros_semantics.models.weight_sets import WeightSet, file_of, weights_of

MAX_FAILURES = 3  # in a row, after which a model is switched off
ADVICE = {
    MASKS: "; take a smaller semantics.prompt_grid, a smaller network, more semantics.threads, or a larger budget",
    IMAGE: "; run it at a smaller size ('size: [height, width]' in a YAML beside it, or exported for one), take a smaller "
    "network, more semantics.threads, or a larger budget",
    CLOUD: "; export it for fewer columns, take a smaller network, more semantics.threads, or a larger budget",
}
# Shares of what has a class; of all pixels or points, where a network does not know what things stand on and before. In 47
# pictures of nine rigs two networks trained on other data find at least 11 % of ground, at most 8 % of one of the thin classes
# and at most 79 % of any class. A crowd before the bumper may be half of a picture.
MIN_GROUND, MAX_ONE = 0.01, 0.95
MAX_THIN = {SemanticClass.PERSON: 0.5, SemanticClass.CYCLIST: 0.5, SemanticClass.POLE: 0.25, SemanticClass.SIGN: 0.25}
MIN_USEFUL = 0.05  # share below which classes are of little use
BEHIND_THINGS = frozenset({SemanticClass.GROUND, SemanticClass.BUILDING, SemanticClass.VEGETATION, SemanticClass.SKY})
OF_INPUTS = "check what its inputs are scaled by (mean, std, scale, channels) and its labels, in a YAML beside it"


@dataclass(eq=False)
class ModelSlot:
    """A configured model. kind: name of its parameter. off: why it is no longer used; empty while it is. remarks: on its last
    output, see `judge`. loaded: the weights of `model`."""

    kind: str
    path: str
    model: SegmentationModel | None = None
    off: str = ""
    failures: int = 0
    remarks: tuple[str, str] = ("", "")
    loaded: WeightSet | None = None

    @property
    def weights(self) -> WeightSet | None:
        """What it runs with, or will; None for labels and shapes, and where there is no such file."""
        if self.loaded is not None:  # its file may be another one by now
            return self.loaded
        return None if self.path in (SOURCE, GEOMETRIC) else weights_of(file_of(self.path))

    @property
    def text(self) -> str:
        """Its parameter and what it runs with."""
        own = self.weights
        return f"{self.kind} {self.path if own is None else own.text}"


class SegmentationModels:
    """The configured models together, see registration.classes.Segmentation. One that fails is reported once and left out."""

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
        """Whether any model is configured and not switched off."""
        return any(not slot.off for slot in self.models)

    def in_use(self) -> list[str]:
        """A text per model that is not switched off: its parameter, and name, licence and fingerprint of its weights."""
        return [slot.text for slot in self.models if not slot.off]

    def describe(self) -> list[str]:
        """What is off and what is in use, for people; empty where no models are configured."""
        return [f"{model.kind} is off" for model in self.models if model.off] + self.in_use()

    def missing(self, *kinds: str) -> str:
        """Which of the kinds is not configured or off, and what to do; empty if all of them work."""
        for kind in kinds:
            slot = next((slot for slot in self.models if slot.kind == kind), None)
            if slot is None:
                return f"semantics.{kind} is not set, which a first guess needs; set it, or another initial.method"
            if slot.off:
                return f"semantics.{kind} is off ({slot.off}); correct it, or set another initial.method"
        return ""

    def load(self) -> list[str]:
        """Load all models now. Returns a line per model that does not run on the configured provider, or is switched off, as the
        built-in network without onnxruntime. ModelError or MissingDependencyError for one of the user that cannot be loaded."""
        notes = []
        with self._lock:
            for slot in self.models:
                try:
                    notes.append(self._loaded(slot).fallback)
                except MissingDependencyError as error:
                    if slot.path != BUILTIN:
                        raise
                    slot.off = str(error)
                    notes.append(f"semantics.{slot.kind} is off: {slot.off}")
        return [note for note in notes if note]

    def __call__(
        self,
        frame: Frame,
        cancelled: Callable[[], bool] = lambda: False,
        kinds: Sequence[str] = ALL,
        points: NDArray[np.intp] | None = None,
    ) -> FrameSemantics:
        """See Segmentation. Shapes are found among the points that are asked for alone, networks see the whole scan."""
        with self._lock:
            answers: dict[str, Any] = {}
            problems: list[str] = []
            seconds: list[tuple[str, float]] = []
            for slot in self.models:
                if slot.off or cancelled() or slot.kind not in kinds:
                    continue
                began = time.monotonic()
                # Edges of masks take precedence: they follow outlines more closely than classes.
                masked = answers.get(MASKS)
                borders = masked is None or not masked.any()
                answers[slot.kind] = self._run(slot, frame, cancelled, problems, borders, points)
                seconds.append((slot.kind, time.monotonic() - began))
        edges, pixels, of = answers.get(MASKS), answers.get(IMAGE), OF_MASKS
        if pixels is not None and pixels.borders is not None:
            edges, of = pixels.borders, OF_CLASSES
        classes = None if pixels is None else pixels.classes
        return FrameSemantics(edges, classes, answers.get(CLOUD), tuple(problems), tuple(seconds), of)

    def _run(
        self,
        slot: ModelSlot,
        frame: Frame,
        cancelled: Callable[[], bool],
        problems: list[str],
        borders: bool,
        points: NDArray[np.intp] | None,
    ) -> Any:
        try:
            first = slot.model is None
            model = self._loaded(slot)
        except Exception as error:  # no file of a user may stop the node, or cause a message with every keyframe
            slot.off = error_line(error, slot.kind)
            problems.append(f"semantics.{slot.kind} is off: {slot.off}")
            return None
        if first and model.fallback:
            problems.append(model.fallback)
        try:
            deadline = Deadline(self.config.budget_s, cancelled)
            if slot.path == GEOMETRIC and points is not None:
                answer = np.full(len(frame.cloud), UNLABELLED, np.uint8)
                answer[points] = model(replace(frame, cloud=frame.cloud.select(points)), deadline)
            else:
                answer = model(frame, deadline, borders)
        except Exception as error:  # whatever a user's model does with an image, the calibration continues
            if not cancelled():
                slot.failures += 1
                line = f"semantics.{slot.kind}, frame {frame.name or frame.stamp}: {error_line(error, slot.kind)}"
                if slot.failures == MAX_FAILURES:
                    slot.off = line
                    line += f"; off from now on after {MAX_FAILURES} failures in a row"
                problems.append(line)
            return None
        slot.failures = 0
        # No evidence, but no failure either: a covered lens has no ground, and is not covered for ever.
        doubt, little = judge(model, answer)
        for text, before, after in zip((doubt, little), slot.remarks, ("; such frames go without classes", ""), strict=True):
            if text and not before:
                problems.append(f"semantics.{slot.kind}, frame {frame.name or frame.stamp}: {text}{after}")
        slot.remarks = doubt, little
        return None if doubt else answer

    def _loaded(self, slot: ModelSlot) -> SegmentationModel:
        if slot.model is None:
            slot.model = load_model(slot.kind, slot.path, self.config)
            slot.loaded = slot.weights
        return slot.model


def load_model(kind: str, path: str, config: SemanticsConfig) -> SegmentationModel:
    """The model that the value `path` of the parameter `kind` names. ModelError, MissingDependencyError if that fails."""
    if path == GEOMETRIC:
        return ClusterClasses()
    if path == SOURCE or Path(path).is_dir():
        return READY[kind](path)
    return NETWORKS[kind](OnnxModel(file_of(path), config), config)


def _mask_network(model: OnnxModel, config: SemanticsConfig) -> MaskModel:
    if is_fast_sam(model, alone=not config.segment_anything_decoder):
        return FastSam(model)
    if config.segment_anything_decoder:
        return SegmentAnything(model, OnnxModel(config.segment_anything_decoder, config), config.prompt_grid)
    raise model.error(
        "it needs its decoder: set semantics.segment_anything_decoder to its ONNX file. FastSAM has none; networks for classes "
        "go to semantics.image_classes"
    )


# One adapter per kind of graph, and of what is ready without one.
NETWORKS: dict[str, Callable[[OnnxModel, SemanticsConfig], SegmentationModel]] = {
    MASKS: _mask_network,
    IMAGE: ImageNetwork,
    CLOUD: CloudNetwork,
}
READY: dict[str, Callable[[str], SegmentationModel]] = {
    MASKS: MaskFolder,
    IMAGE: partial(ReadyClasses, IMAGE),
    CLOUD: partial(ReadyClasses, CLOUD),
}


def judge(model: SegmentationModel, answer: Any) -> tuple[str, str]:
    """Why what a network found cannot be right, and if it can, why it hardly helps; else empty, as for masks, shapes and
    classes that are given."""
    if model.known is None:
        return "", ""
    classes = getattr(answer, "classes", answer)
    doubt = implausible(classes, model.known)
    return doubt, "" if doubt else of_little_use(classes)


def implausible(classes: Classes, known: Collection[int]) -> str:
    """Why a network's SemanticClass of pixels or points (any shape) cannot be right; empty if they can.

    known: classes that the network tells apart; one that it does not know cannot be missed.
    """
    count = np.bincount(classes.ravel(), minlength=256).astype(float)
    # Where it knows vehicles and people only, all that has a class may well be a vehicle.
    whole = classes.size if BEHIND_THINGS.isdisjoint(known) else count.sum() - count[UNLABELLED]
    share = count[: len(SemanticClass)] / max(whole, 1.0)
    if not share.any():
        return ""
    most = SemanticClass(int(share.argmax()))
    thin = max(MAX_THIN, key=lambda own: share[own] / MAX_THIN[own])
    if share[most] > MAX_ONE and len(known) > 2:
        what = f"{100 * share[most]:.0f} % are {most.name.lower()}"
    elif share[thin] > MAX_THIN[thin]:
        what = f"{100 * share[thin]:.0f} % are {thin.name.lower()}"
    elif SemanticClass.GROUND in known and share[SemanticClass.GROUND] < MIN_GROUND:
        what = f"no ground ({100 * share[SemanticClass.GROUND]:.1f} %), {most.name.lower()} the most"
    else:
        return ""
    return f"its classes are implausible: {what}; {OF_INPUTS}"


def of_little_use(classes: Classes) -> str:
    """Why classes of pixels or points (any shape) hardly help a calibration; empty if they do."""
    count = np.bincount(classes.ravel(), minlength=256)
    nothing = count[UNLABELLED] + count[SemanticClass.OTHER]
    if not classes.size or 1 - nothing / classes.size >= MIN_USEFUL:
        return ""
    share = f"{100 * nothing / classes.size:.0f} % have a class that is of no use here"
    return f"{share}; give 'labels:' in a YAML beside the model, or take one for streets"


def error_line(error: Exception, kind: str) -> str:
    """An error of a model of this kind in one line; with advice where its time was up."""
    if not isinstance(error, CalibrationError):
        return f"unexpected {type(error).__name__}: {error_text(error)}"
    return f"{error}{ADVICE[kind] if isinstance(error, BudgetError) else ''}"
