"""Masks by Segment Anything: an encoder from an image to an embedding, a decoder from points to masks, and a grid of points."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import ModelError
from calib_ros.frame import Frame
from calib_ros_semantics.models.masks import (
    MIN_IOU,
    MIN_STABILITY,
    NMS_IOU,
    Mask,
    MaskModel,
    Proposals,
    accepted_masks,
    without_duplicates,
)
from calib_ros_semantics.models.onnx_model import Array, Deadline, InputImage, Normalisation, OnnxModel, Tensor, to_rgb

Points = NDArray[np.float64]
DEFAULT_SIDE = 1024  # px; size the models were trained at, and the default of graphs of dynamic size
CELL_PX = 16  # px of the frame of prompts per cell of the embedding, in all families
LOGIT_PX = 4  # px of the frame of prompts per logit
NO_POINT = -1.0  # label of a padding point
# A prompt is redundant in a mask so small that the grid has hardly another point in it, and among neighbours that are in the same
# mask and in none within it. On 94 real masks of a street this saves a fifth of the prompts, of finer grids a quarter, on
# synthetic streets, where less is nested, up to a third, and it loses no mask larger than a cell of the grid. Skipping all
# prompts in known masks would lose a quarter of those.
PROMPT_BATCH = 16  # prompts per run, if the export accepts several: more gain hardly any time, and take memory
SMALL_CELLS = 2.0  # area of a small mask, cells of the grid
NEIGHBOUR_SPACINGS, SAME_MASK_NEIGHBOURS = 1.1, 2  # reach of neighbours in spacings of the grid; how many of them
KNOWN = (
    "known are the exports of SAM, MobileSAM, EdgeSAM and NanoSAM (image_embeddings, point_coords, point_labels and some of "
    "mask_input, has_mask_input, orig_im_size; masks or low_res_masks, iou_predictions or scores), SAM2 (with high_res_feats_0, "
    "high_res_feats_1, image_embed), EfficientSAM (batched_point_coords, batched_point_labels, orig_im_size; output_masks), "
    "Hugging Face (input_points, input_labels; pred_masks, iou_scores) and, alone, FastSAM (output0, output1)"
)


IMAGENET = Normalisation(1.0, (123.675, 116.28, 103.53), (58.395, 57.12, 57.375))  # of RGB, in nearly all families
# How families prepare an image: its normalisation; whether the aspect ratio is kept and the rest of the input is zero, or the
# image stretched; and whether prompts are in pixels of the original image.
FAMILIES = {
    **dict.fromkeys(("sam", "mobilesam", "edgesam", "nanosam"), (IMAGENET, True, False)),
    "sam2": (IMAGENET, False, False),
    "efficientsam": (Normalisation(1 / 255), False, True),
    "samexporter": (Normalisation(1.0), True, False),  # the graph does it all
}


class Embedded(NamedTuple):
    """An encoded image. features: arrays by the name of the encoder's output. size: (H, W) of the image. frame: (h, w) of the
    coordinate frame of prompts. content: (h, w) of the image within it, from the upper left corner. own_pixels: see FAMILIES."""

    features: dict[str, Array]
    size: tuple[int, int]
    frame: tuple[float, float]
    content: tuple[float, float]
    own_pixels: bool


class Decoder:
    """An ONNX graph from embedding and points to masks. Raises ModelError if it fits no known export, or not the encoder.

    What its tensors are is told by their names, then by their shapes. features: pairs of an input and the name of the encoder's
    output that feeds it. batch: prompts per run.
    """

    def __init__(self, model: OnnxModel, encoder: OnnxModel) -> None:
        self.model = model
        left = list(model.inputs)
        points = _take(left, ("coords", "points"), lambda t: len(t.shape) in (3, 4) and t.shape[-1] == 2)
        if points is None or len(points.shape) not in (3, 4) or points.shape[-1] not in (2, None):
            raise _mismatch(model, encoder, "no input takes points")
        labels = _take(left, ("label",), lambda t: len(t.shape) == len(points.shape) - 1)
        if labels is None or len(labels.shape) != len(points.shape) - 1:
            raise _mismatch(model, encoder, "no input takes the labels of the points")
        self._points, self._labels = points, labels
        self._has_mask = _take(left, ("has_mask",), lambda t: t.shape in ((), (1,)))
        self._mask_input = _take(left, ("mask",), lambda t: len(t.shape) == 4 and t.shape[1] == 1)
        self._image_size = _take(left, ("size",), lambda t: t.shape == (2,))
        self._features = _features(left, model, encoder)
        outputs = list(model.outputs)
        largest = max(len(t.shape) for t in outputs)
        declared = model.sidecar.output
        names = (declared,) if declared else ("low_res", "mask")
        exactly = [t for t in outputs if t.name == declared]
        masks = exactly[0] if exactly else _take(outputs, names, lambda t: len(t.shape) == largest >= 3)
        if masks is None:
            raise _mismatch(model, encoder, "no output gives masks")
        self.masks = masks
        others = [t for t in outputs if t is not masks]
        self._score = _take(others, ("iou", "score"), lambda t: 1 <= len(t.shape) < len(masks.shape) - 1)
        self._nested = len(points.shape) == 4  # (1, prompts, points, 2)
        self.is_efficient = self._nested and self._image_size is not None  # EfficientSAM, which scales points itself
        self._fixed = points.shape[1 if self._nested else 0]
        self.batch = self._fixed or PROMPT_BATCH
        # Exports with nested points pad them themselves; the others expect a padding point where there is no box.
        self._slots = points.shape[-2] or (1 if self._nested else 2)

    def __call__(self, embedded: Embedded, points: Points, deadline: Deadline) -> Proposals:
        """Masks for prompts (n, 2), n <= batch, points in pixels of the image. Raises ModelError, BudgetError."""
        try:
            return self._run(embedded, points, deadline)
        except ModelError:
            if len(points) == 1 or self._fixed:
                raise
        self.batch = 1  # sizes declared as dynamic need not be
        parts = [self._run(embedded, point[None], deadline) for point in points]
        logits, score = np.concatenate([p.logits for p in parts]), np.concatenate([p.score for p in parts])
        return parts[0]._replace(logits=logits, score=score)

    def _run(self, embedded: Embedded, points: Points, deadline: Deadline) -> Proposals:
        outputs = [t.name for t in (self.masks, self._score) if t is not None]
        n = self._fixed or len(points)
        filled = points[np.minimum(np.arange(n), len(points) - 1)]
        masks, *scores = self.model.run(self._feeds(embedded, filled), deadline, outputs)
        if masks.ndim < 2 or masks.size == 0 or masks.size % (n * masks.shape[-2] * masks.shape[-1]):
            raise self.model.error(f"it gave masks {masks.shape} for {n} prompts")
        masks = masks.reshape(n, -1, *masks.shape[-2:])
        score = scores[0].astype(np.float32) if scores else np.ones(masks.shape[:2], np.float32)
        if score.size % n or (masks.shape[1] > 1 and score.size != n * masks.shape[1]):
            raise self.model.error(f"it gave masks {masks.shape} and scores {scores[0].shape} for {n} prompts")
        masks, score = masks[: len(points)], score.reshape(n, -1)[: len(points)]
        if masks.shape[1] == 1:  # the graph chose the best one
            score = score.max(axis=1, keepdims=True)
        logits, soft = _as_logits(masks)
        flat = logits.reshape(-1, *logits.shape[-2:])
        # The part of masks that covers the image: all of it, unless they have the shape of the padded frame.
        height, width = content = float(flat.shape[-2]), float(flat.shape[-1])
        padded, own = (abs(np.log(height / width) - np.log(s[0] / s[1])) for s in (embedded.frame, embedded.size))
        if own > padded and content != embedded.size:
            inner, frame = embedded.content, embedded.frame
            content = height * inner[0] / frame[0], width * inner[1] / frame[1]
        return Proposals(flat, score.ravel(), embedded.size, content, soft)

    def _feeds(self, embedded: Embedded, points: Points) -> dict[str, Array]:
        n, (height, width) = len(points), embedded.size
        own_pixels = embedded.own_pixels and self._image_size is not None
        factor = np.ones(2) if own_pixels else np.array([embedded.content[1] / width, embedded.content[0] / height])
        coords, labels = np.zeros((n, self._slots, 2)), np.full((n, self._slots), NO_POINT)
        coords[:, 0], labels[:, 0] = points * factor, 1
        feeds: dict[str, Array] = {t.name: embedded.features[source] for t, source in self._features}
        feeds[self._points.name] = coords[None] if self._nested else coords
        feeds[self._labels.name] = labels[None] if self._nested else labels
        if self._mask_input is not None:
            feeds[self._mask_input.name] = np.zeros(_filled(self._mask_input, n, [n, 1, *_coarse(embedded.frame)]))
        if self._has_mask is not None:
            feeds[self._has_mask.name] = np.zeros(_filled(self._has_mask, n, [n]))
        if self._image_size is not None:
            # With logits as another output, masks at full size would be computed in vain.
            small = not own_pixels and "low_res" in self.masks.name
            feeds[self._image_size.name] = np.array(_coarse(embedded.content) if small else embedded.size)
        return feeds


class SegmentAnything(MaskModel):
    """Encoder, a graph from an image to an embedding, and decoder, prompted on a grid over an image. ModelError if the encoder is
    none, or the two do not fit each other."""

    needed = f"a predicted IoU of {MIN_IOU:g} and a stability of {MIN_STABILITY:g}"

    def __init__(self, encoder: OnnxModel, decoder: OnnxModel, along: int) -> None:
        """along: prompts along the longer side of the image."""
        self.model, self.along = encoder, along
        self.fallback = "; ".join(model.fallback for model in (encoder, decoder) if model.fallback)
        self.decoder = Decoder(decoder, encoder)
        features = sum(len(t.shape) == 4 for t in encoder.outputs)
        found = InputImage.of(encoder, encoder.inputs, (3,))
        if found is None or not features:
            raise encoder.error("this is no encoder, which takes a picture and gives an embedding")
        self._input = found
        self._channels_last = found.axis == len(found.tensor.shape) - 1
        self.family = encoder.family(FAMILIES)
        if not self.family:
            self.family = "samexporter" if self._channels_last or np.issubdtype(found.tensor.dtype, np.integer) else "sam"
            if self.decoder.is_efficient or found.tensor.name.startswith("batched"):
                self.family = "efficientsam"
            elif features >= 3:
                self.family = "sam2"
        usual, self._padded, self._own_pixels = FAMILIES[self.family]
        self._normalised = Normalisation.of(encoder, usual)

    def describe(self) -> str:
        decoder = self.decoder.model
        return (
            f"Segment Anything ({self.family}), {self.along} prompts along the longer side, {self.decoder.batch} in a run, fed "
            f"as {self._normalised.text}, on {decoder.provider}; encoder: {self.model.tensors}; decoder: {decoder.tensors}"
        )

    def masks(self, frame: Frame, deadline: Deadline) -> list[Mask]:
        """Of everything in the frame's image."""
        embedded, decoder = self.embedded(frame.image, deadline), self.decoder
        return everything(
            lambda points: decoder(embedded, points, deadline), embedded.size, lambda: decoder.batch, self.along, deadline
        )

    def embedded(self, image: NDArray[np.uint8], deadline: Deadline) -> Embedded:
        """Embedding of an image (H, W) or (H, W, 3) BGR uint8 of any size. Raises ModelError, BudgetError."""
        height, width = image.shape[:2]
        rows, columns = self._input.size
        size = rows or DEFAULT_SIDE, columns or DEFAULT_SIDE
        if not (rows and columns) and self._own_pixels:
            size = height, width
        elif not (rows and columns) and self._channels_last:  # the graph pads by itself
            size = _scaled((height, width), DEFAULT_SIDE / max(height, width))
        inner = _scaled((height, width), min(size[0] / height, size[1] / width)) if self._padded else size
        whole = np.zeros((*size, 3), np.float32)
        whole[: inner[0], : inner[1]] = self._normalised(to_rgb(image, inner, self.model.sidecar.channels == "bgr"))
        outputs = self.model.run({self._input.tensor.name: self._input.arranged(whole)}, deadline)
        features = dict(zip((t.name for t in self.model.outputs), outputs, strict=True))
        coarsest = min((a.shape[-2:] for a in outputs if a.ndim == 4), key=lambda s: s[0] * s[1])
        frame = float(CELL_PX * coarsest[0]), float(CELL_PX * coarsest[1])
        factor = max(frame) / max(size)
        content = (inner[0] * factor, inner[1] * factor) if self._padded else frame
        return Embedded(features, (height, width), frame, content, self._own_pixels)


def everything(
    propose: Callable[[Points], Proposals], size: tuple[int, int], batch: Callable[[], int], along: int, deadline: Deadline
) -> list[Mask]:
    """Masks of everything in an image of this size (H, W), from a grid of prompts without redundant ones.

    propose: masks for prompts (n, 2), pixels. batch: prompts per call, which may shrink. along: see prompt_points. Raises
    BudgetError, and what `propose` raises.
    """
    found: list[Mask] = []
    prompted: list[Points] = []
    waiting = list(prompt_points(size, along))
    spacing = max(size) / along
    while waiting:
        deadline.check()
        prompts: list[Points] = []
        while waiting and len(prompts) < batch():
            point = waiting.pop(0)
            # Would a prompt there hardly find a new mask?
            own = _innermost(point, found)
            beside = (other for other in prompted if np.hypot(*(other - point)) <= NEIGHBOUR_SPACINGS * spacing)
            if own is None or (
                own.area >= SMALL_CELLS * spacing**2
                and sum(_innermost(other, found) is own for other in beside) < SAME_MASK_NEIGHBOURS
            ):
                prompts.append(point)
        if prompts:
            found = without_duplicates(found + accepted_masks(propose(np.array(prompts))), NMS_IOU)
            prompted += prompts
    return found


def prompt_points(size: tuple[int, int], along: int) -> Points:
    """Grid of prompts (n, 2), column and row, in an image (H, W): `along` of them on the longer side, as dense on the other.

    Those on every 2^k-th row and column come first: large objects are found first, and prompts of a batch lie far apart.
    """
    spacing = max(size) / along
    rows, columns = (max(round(n / spacing), 1) for n in size)
    j, i = (part.ravel() for part in np.mgrid[:rows, :columns])
    level = np.zeros(len(i), int)
    for k in range(1, along.bit_length() + 1):
        level[(i % 2**k == 0) & (j % 2**k == 0)] = k
    order = np.argsort(-level, kind="stable")
    points = np.stack([(i + 0.5) * size[1] / columns, (j + 0.5) * size[0] / rows], axis=1)
    return points[order] - 0.5


def _innermost(point: Points, masks: Iterable[Mask]) -> Mask | None:
    """The smallest mask that covers the point (2,)."""
    return min((mask for mask in masks if mask.covers(*(point + 0.5))), key=lambda mask: mask.area, default=None)


def _take(left: list[Tensor], names: Sequence[str], fits: Callable[[Tensor], bool]) -> Tensor | None:
    """Remove from the list and return the tensor with one of the names, else the first that fits."""
    named = (t for name in names for t in left if name in t.name.lower())
    found = next(named, None) or next(filter(fits, left), None)
    if found is not None:
        left.remove(found)
    return found


def _features(inputs: Iterable[Tensor], decoder: OnnxModel, encoder: OnnxModel) -> tuple[tuple[Tensor, str], ...]:
    """The output of the encoder for each of these inputs: that of the same name, else the first of a compatible shape."""
    given = {t.name: t for t in encoder.outputs}
    found = []
    for tensor in sorted(inputs, key=lambda t: t.name not in given):
        fitting = [tensor.name] if tensor.name in given else list(given)
        source = next((name for name in fitting if _compatible(given[name].shape, tensor.shape)), None)
        if source is None and tensor.name in given:
            raise _mismatch(decoder, encoder, f"the encoder gives {given[tensor.name]}, but the decoder takes {tensor}")
        if source is None:
            raise _mismatch(decoder, encoder, f"no output of the encoder fits the input {tensor}")
        del given[source]
        found.append((tensor, source))
    if not found:
        raise _mismatch(decoder, encoder, "no input takes the embedding")
    return tuple(found)


def _compatible(given: Sequence[int | None], taken: Sequence[int | None]) -> bool:
    return len(given) == len(taken) and all(None in (a, b) or a == b for a, b in zip(given, taken, strict=True))


def _mismatch(decoder: OnnxModel, encoder: OnnxModel, problem: str) -> ModelError:
    return ModelError(
        f"{encoder.path} and {decoder.path} are no pair of Segment Anything: {problem}; the encoder has {encoder.tensors}; "
        f"the decoder has {decoder.tensors}; {KNOWN}"
    )


def _scaled(size: tuple[int, int], factor: float) -> tuple[int, int]:
    height, width = (max(int(n * factor + 0.5), 1) for n in size)
    return height, width


def _coarse(size: tuple[float, float]) -> tuple[int, int]:
    return max(round(size[0] / LOGIT_PX), 1), max(round(size[1] / LOGIT_PX), 1)


def _filled(tensor: Tensor, n: int, usual: Sequence[int]) -> list[int]:
    """A shape with its dynamic sizes set."""
    if len(tensor.shape) != len(usual):
        return [size or n for size in tensor.shape]
    return [size or other for size, other in zip(tensor.shape, usual, strict=True)]


def _as_logits(masks: Array) -> tuple[NDArray[np.float32], bool]:
    """Masks as float32 logits with the threshold 0, and whether they are soft rather than binary."""
    if masks.dtype.kind not in "f":
        return np.where(masks > 0, np.float32(1), np.float32(-1)), False
    masks = masks.astype(np.float32, copy=False)
    if masks.min() < 0 or masks.max() > 1:
        return masks, True
    soft = bool(((masks > 0) & (masks < 1)).any())
    p = np.clip(masks, 1e-6, 1 - 1e-6)  # probabilities
    return np.log(p / (1 - p)), soft
