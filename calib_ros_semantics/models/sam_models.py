"""The pair of networks of Segment Anything: an encoder from an image to an embedding, a decoder from points to masks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import ModelError
from calib_ros_semantics.models.masks import Proposals
from calib_ros_semantics.models.onnx_model import Array, Deadline, Normalisation, OnnxModel, Tensor

DEFAULT_SIDE = 1024  # px; size the models were trained at, and the default of graphs of dynamic size
CELL_PX = 16  # px of the frame of prompts per cell of the embedding, in all families
LOGIT_PX = 4  # px of the frame of prompts per logit
NO_POINT = -1.0  # label of a padding point
KNOWN = (
    "known are the exports of SAM, MobileSAM, EdgeSAM and NanoSAM (image_embeddings, point_coords, point_labels and some of "
    "mask_input, has_mask_input, orig_im_size; masks or low_res_masks, iou_predictions or scores), SAM2 (with high_res_feats_0, "
    "high_res_feats_1, image_embed), EfficientSAM (batched_point_coords, batched_point_labels, orig_im_size; output_masks), "
    "Hugging Face (input_points, input_labels; pred_masks, iou_scores) and, alone, FastSAM (output0, output1)"
)


@dataclass(frozen=True)
class Preprocessing:
    """How a family prepares an image. padded: the aspect ratio is kept and the rest of the input is zero; else the image is
    stretched. own_pixels: prompts are in pixels of the original image."""

    normalised: Normalisation
    padded: bool = True
    own_pixels: bool = False


IMAGENET = Normalisation(1.0, (123.675, 116.28, 103.53), (58.395, 57.12, 57.375))  # of RGB, in nearly all families
SAM, SAM2 = Preprocessing(normalised=IMAGENET), Preprocessing(padded=False, normalised=IMAGENET)
EFFICIENT_SAM = Preprocessing(padded=False, normalised=Normalisation(1 / 255), own_pixels=True)
RAW = Preprocessing(normalised=Normalisation(1.0))  # the graph does it all
FAMILIES = {
    **dict.fromkeys(("sam", "mobilesam", "edgesam", "nanosam"), SAM),
    "sam2": SAM2,
    "efficientsam": EFFICIENT_SAM,
    "samexporter": RAW,
}


class Embedded(NamedTuple):
    """An encoded image. features: arrays by the name of the encoder's output. size: (H, W) of the image. frame: (h, w) of the
    coordinate frame of prompts. content: (h, w) of the image within it, from the upper left corner."""

    features: dict[str, Array]
    size: tuple[int, int]
    frame: tuple[float, float]
    content: tuple[float, float]


class Encoder:
    """An ONNX graph from an image to an embedding. Raises ModelError if its tensors are not those of an encoder."""

    def __init__(self, model: OnnxModel, efficient: bool = False) -> None:
        """efficient: whether the decoder is that of EfficientSAM."""
        self.model = model
        pictures = [t for t in model.inputs if _is_picture(t)]
        features = [t for t in model.outputs if len(t.shape) == 4]
        if len(model.inputs) != 1 or not pictures or not features:
            raise model.error("this is no encoder, which takes a picture and gives an embedding")
        self.input = pictures[0]
        self.channels_last = self.input.shape[-1] == 3 and self.input.shape[-3] != 3
        self.family, self.preprocessing = self._preprocessing(efficient)

    def _preprocessing(self, efficient: bool) -> tuple[str, Preprocessing]:
        family = declared_family(self.model)
        if family and family not in FAMILIES:
            raise self.model.error(f"family '{family}' in its YAML is unknown; known are {', '.join(FAMILIES)}, fastsam")
        if not family:
            family = "samexporter" if self.channels_last or np.issubdtype(self.input.dtype, np.integer) else "sam"
            if efficient or self.input.name.startswith("batched"):
                family = "efficientsam"
            elif sum(len(t.shape) == 4 for t in self.model.outputs) >= 3:
                family = "sam2"
        preprocessing = FAMILIES[family]
        return family, replace(preprocessing, normalised=Normalisation.of(self.model, preprocessing.normalised))

    def __call__(self, image: NDArray[np.uint8], deadline: Deadline) -> Embedded:
        """Embedding of an image (H, W) or (H, W, 3) BGR uint8 of any size. Raises ModelError, BudgetError."""
        height, width = image.shape[:2]
        size = self._input_size(height, width)
        padded = self.preprocessing.padded
        inner = _scaled((height, width), min(size[0] / height, size[1] / width)) if padded else size
        pixels = to_rgb(image, inner, self.model.sidecar.channels == "bgr")
        whole = np.zeros((*size, 3), np.float32)
        whole[: inner[0], : inner[1]] = self.preprocessing.normalised(pixels)
        tensor = whole if self.channels_last else whole.transpose(2, 0, 1)
        outputs = self.model.run({self.input.name: tensor if len(self.input.shape) == 3 else tensor[None]}, deadline)
        features = dict(zip((t.name for t in self.model.outputs), outputs, strict=True))
        coarsest = min((a.shape[-2:] for a in outputs if a.ndim == 4), key=lambda s: s[0] * s[1])
        frame = float(CELL_PX * coarsest[0]), float(CELL_PX * coarsest[1])
        factor = max(frame) / max(size)
        content = (inner[0] * factor, inner[1] * factor) if padded else frame
        return Embedded(features, (height, width), frame, content)

    def _input_size(self, height: int, width: int) -> tuple[int, int]:
        """Height and width of the input for an image of this size."""
        if self.model.sidecar.size:
            return self.model.sidecar.size
        rows, columns = self.input.shape[-3:-1] if self.channels_last else self.input.shape[-2:]
        if rows and columns:
            return rows, columns
        if self.preprocessing.own_pixels:
            return height, width
        if self.channels_last:  # the graph pads by itself
            return _scaled((height, width), DEFAULT_SIDE / max(height, width))
        return rows or DEFAULT_SIDE, columns or DEFAULT_SIDE


class Roles(NamedTuple):
    """What the tensors of a decoder are. features: pairs of an input and the name of the encoder's output that feeds it."""

    points: Tensor
    labels: Tensor
    mask_input: Tensor | None
    has_mask: Tensor | None
    image_size: Tensor | None
    features: tuple[tuple[Tensor, str], ...]
    masks: Tensor
    score: Tensor | None

    @property
    def in_own_pixels(self) -> bool:
        """Whether points are in pixels of the original image: EfficientSAM, whose decoder scales them itself."""
        return len(self.points.shape) == 4 and self.image_size is not None


class Decoder:
    """An ONNX graph from embedding and points to masks."""

    def __init__(self, model: OnnxModel, roles: Roles, encoder: Encoder, batch: int) -> None:
        """roles: of its tensors. batch: most prompts per run, if the graph takes several."""
        self.model, self.encoder, self.roles = model, encoder, roles
        self._nested = len(roles.points.shape) == 4  # (1, prompts, points, 2)
        many = roles.points.shape[1 if self._nested else 0]
        self.batch, self._fixed = many or batch, many
        fixed = roles.points.shape[-2]
        # Exports with nested points pad them themselves; the others expect a padding point where there is no box.
        self._slots = fixed or (1 if self._nested else 2)

    def __call__(self, embedded: Embedded, points: NDArray[np.float64], deadline: Deadline) -> Proposals:
        """Masks for prompts (n, 2), n <= batch, points in pixels of the image. Raises ModelError, BudgetError."""
        try:
            return self._run(embedded, points, deadline)
        except ModelError:
            if len(points) == 1 or self._fixed:
                raise
        self.batch = 1  # sizes declared as dynamic need not be
        parts = [self._run(embedded, point[None], deadline) for point in points]
        logits, score = np.concatenate([p.logits for p in parts]), np.concatenate([p.score for p in parts])
        return replace(parts[0], logits=logits, score=score)

    def _run(self, embedded: Embedded, points: NDArray[np.float64], deadline: Deadline) -> Proposals:
        outputs = [self.roles.masks.name] + ([self.roles.score.name] if self.roles.score else [])
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
        return Proposals(flat, score.ravel(), embedded.size, _content(embedded, flat.shape[-2:]), soft)

    def _feeds(self, embedded: Embedded, points: NDArray[np.float64]) -> dict[str, Array]:
        roles, n = self.roles, len(points)
        height, width = embedded.size
        own_pixels = self.encoder.preprocessing.own_pixels and roles.image_size is not None
        factor = np.ones(2) if own_pixels else np.array([embedded.content[1] / width, embedded.content[0] / height])
        coords, labels = np.zeros((n, self._slots, 2)), np.full((n, self._slots), NO_POINT)
        coords[:, 0], labels[:, 0] = points * factor, 1
        feeds: dict[str, Array] = {t.name: embedded.features[source] for t, source in roles.features}
        feeds[roles.points.name] = coords[None] if self._nested else coords
        feeds[roles.labels.name] = labels[None] if self._nested else labels
        if roles.mask_input is not None:
            feeds[roles.mask_input.name] = np.zeros(_filled(roles.mask_input, n, [n, 1, *_coarse(embedded.frame)]))
        if roles.has_mask is not None:
            feeds[roles.has_mask.name] = np.zeros(_filled(roles.has_mask, n, [n]))
        if roles.image_size is not None:
            # With logits as another output, masks at full size would be computed in vain.
            small = not own_pixels and "low_res" in roles.masks.name
            feeds[roles.image_size.name] = np.array(_coarse(embedded.content) if small else embedded.size)
        return feeds


def roles_of(decoder: OnnxModel, encoder: OnnxModel) -> Roles:
    """Roles of the tensors of a decoder, by their names, then by their shapes. ModelError if they fit no known export."""
    left = list(decoder.inputs)
    points = _take(left, ("coords", "points"), lambda t: len(t.shape) in (3, 4) and t.shape[-1] == 2)
    if points is None or len(points.shape) not in (3, 4) or points.shape[-1] not in (2, None):
        raise _mismatch(decoder, encoder, "no input takes points")
    labels = _take(left, ("label",), lambda t: len(t.shape) == len(points.shape) - 1)
    if labels is None or len(labels.shape) != len(points.shape) - 1:
        raise _mismatch(decoder, encoder, "no input takes the labels of the points")
    has_mask = _take(left, ("has_mask",), lambda t: t.shape in ((), (1,)))
    mask_input = _take(left, ("mask",), lambda t: len(t.shape) == 4 and t.shape[1] == 1)
    image_size = _take(left, ("size",), lambda t: t.shape == (2,))
    features = _features(left, decoder, encoder)
    outputs = list(decoder.outputs)
    largest = max(len(t.shape) for t in outputs)
    declared = decoder.sidecar.output
    if declared:
        masks = next((t for t in outputs if t.name == declared), None)
        if masks is None:
            raise decoder.error(f"there is no output '{declared}', which 'output:' of the YAML beside it names")
        outputs.remove(masks)
    else:
        masks = _take(outputs, ("low_res", "mask"), lambda t: len(t.shape) == largest >= 3)
    if masks is None:
        raise _mismatch(decoder, encoder, "no output gives masks")
    score = _take(outputs, ("iou", "score"), lambda t: 1 <= len(t.shape) < len(masks.shape) - 1)
    return Roles(points, labels, mask_input, has_mask, image_size, features, masks, score)


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
    found, nameless = [], []
    for tensor in inputs:
        source = given.pop(tensor.name, None)
        if source is None:
            nameless.append(tensor)
        elif not _compatible(source, tensor):
            raise _mismatch(decoder, encoder, f"the encoder gives {source}, but the decoder takes {tensor}")
        else:
            found.append((tensor, source.name))
    for tensor in nameless:
        name = next((name for name, source in given.items() if _compatible(source, tensor)), None)
        if name is None:
            raise _mismatch(decoder, encoder, f"no output of the encoder fits the input {tensor}")
        del given[name]
        found.append((tensor, name))
    if not found:
        raise _mismatch(decoder, encoder, "no input takes the embedding")
    return tuple(found)


def _compatible(given: Tensor, taken: Tensor) -> bool:
    sizes = zip(given.shape, taken.shape, strict=False)
    return len(given.shape) == len(taken.shape) and all(None in (a, b) or a == b for a, b in sizes)


def _mismatch(decoder: OnnxModel, encoder: OnnxModel, problem: str) -> ModelError:
    return ModelError(
        f"{encoder.path} and {decoder.path} are no pair of Segment Anything: {problem}; the encoder has {encoder.tensors}; "
        f"the decoder has {decoder.tensors}; {KNOWN}"
    )


def to_rgb(image: NDArray[np.uint8], size: tuple[int, int], bgr: bool = False) -> NDArray[np.float32]:
    """Image (H, W) or (H, W, 3) BGR -> (h, w, 3) float32 RGB or BGR, 0..255, at another size."""
    colour = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image
    shrinks = size[0] < image.shape[0]
    resized = cv2.resize(colour, size[::-1], interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    return np.asarray(resized if bgr else resized[:, :, ::-1], np.float32)


def declared_family(model: OnnxModel) -> str:
    """The family in the YAML beside a model, lower case, without underscores and hyphens; empty if it is not given."""
    return model.sidecar.family.lower().replace("_", "").replace("-", "")


def _scaled(size: tuple[int, int], factor: float) -> tuple[int, int]:
    height, width = (max(int(n * factor + 0.5), 1) for n in size)
    return height, width


def _is_picture(tensor: Tensor) -> bool:
    shape = tensor.shape
    channels = shape[-3::2] if len(shape) in (3, 4) else ()  # first or last after the batch
    return 3 in channels or (len(shape) == 4 and shape[1] is None)


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


def _content(embedded: Embedded, shape: tuple[int, ...]) -> tuple[float, float]:
    """Part (h, w) of masks of this shape that covers the image: all of it, unless they have the shape of the padded frame."""
    height, width = shape
    aspect = np.log(height / width)
    padded, own = (abs(aspect - np.log(s[0] / s[1])) for s in (embedded.frame, embedded.size))
    if own <= padded or (height, width) == embedded.size:
        return float(height), float(width)
    return height * embedded.content[0] / embedded.frame[0], width * embedded.content[1] / embedded.frame[1]
