"""The first half of a Segment Anything pair: a picture becomes an embedding, in the way that the exporter of the file chose."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.config import SemanticsConfig
from calib_ros.errors import ModelError
from calib_ros.frame import Frame
from calib_ros.semantics.masks import CELLS, Mask, Masks, Proposals, clean, sample, without_duplicates
from calib_ros.semantics.onnx_model import GREY_LEVELS, Array, Deadline, OnnxModel, Tensor


# Normalisation of the pixels that go into a network of Segment Anything: what is usual for its family, or what its YAML says.
@dataclass(frozen=True)
class Normalisation:
    """(pixels * scale - mean) / std of grey levels 0..255. mean, std: of one number or one for each of the three channels."""

    scale: float
    mean: tuple[float, ...] = (0.0,)
    std: tuple[float, ...] = (1.0,)

    def __call__(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """Pixels (h, w, 3) as the network wants them, in the order of its channels."""
        mean, std = np.array(self.mean, np.float32), np.array(self.std, np.float32)
        result: NDArray[Any] = (pixels * np.float32(self.scale) - mean) / std
        return result


def normalisation_of(model: OnnxModel, usual: Normalisation) -> Normalisation:
    """That of the YAML beside a model, read as for a network of classes (see image_input), else the usual one, which is of RGB.

    ModelError if the YAML has neither one nor three numbers, or channels that no picture has.
    """
    own = model.sidecar
    if not isinstance(own.channels, str):
        raise model.error("'channels:' of the YAML beside it must be rgb or bgr")
    for name, values in (("mean", own.mean), ("std", own.std)):
        if len(values) not in (0, 1, 3):
            raise model.error(f"'{name}:' of the YAML beside it must have 1 or 3 numbers")
    if not own.mean and not own.std and own.scale is None:
        return Normalisation(usual.scale, usual.mean[::-1], usual.std[::-1]) if own.channels == "bgr" else usual
    mean, std, scale = own.mean or (0.0,), own.std or (1.0,), own.scale
    if scale is None:
        scale = 1.0 if max(map(abs, mean + std)) > GREY_LEVELS else 1 / 255
    return Normalisation(scale, mean, std)


SIDE = 1024  # px; what the models were trained on, and the default of graphs that take any size
PATCH = 16  # px of the frame of prompts per cell of the embedding, in all families
IMAGENET = Normalisation(1.0, (123.675, 116.28, 103.53), (58.395, 57.12, 57.375))  # of RGB, as nearly all families have it


@dataclass(frozen=True)
class Style:
    """What a family does to a picture.

    padded: it keeps its shape, and the rest of the input is zero; else it is stretched. own_pixels: prompts are in pixels of
    the picture as it came.
    """

    padded: bool = True
    normalised: Normalisation = IMAGENET
    own_pixels: bool = False


SAM, SAM2 = Style(), Style(padded=False)
EFFICIENT_SAM = Style(padded=False, normalised=Normalisation(1 / 255), own_pixels=True)
RAW = Style(normalised=Normalisation(1.0))  # the graph does it all
# By the name that a YAML beside the encoder may give, without underscores and minus signs.
FAMILIES = {
    **dict.fromkeys(("sam", "mobilesam", "edgesam", "nanosam"), SAM),
    "sam2": SAM2,
    "efficientsam": EFFICIENT_SAM,
    "samexporter": RAW,
}


@dataclass(frozen=True, eq=False)
class Embedded:
    """A picture that was encoded. features: arrays by the name of the encoder's output. size: (H, W) of the picture.

    frame: (h, w) of the frame of prompts. content: (h, w) of the picture within it, from its upper left corner.
    """

    features: dict[str, Array]
    size: tuple[int, int]
    frame: tuple[float, float]
    content: tuple[float, float]


class Encoder:
    """A graph from a picture to an embedding. ModelError if its tensors are no encoder's."""

    def __init__(self, model: OnnxModel, efficient: bool = False) -> None:
        """efficient: the decoder says that this is EfficientSAM."""
        self.model = model
        pictures = [t for t in model.inputs if _is_picture(t)]
        features = [t for t in model.outputs if len(t.shape) == 4]
        if len(model.inputs) != 1 or not pictures or not features:
            raise model.error("this is no encoder, which takes a picture and gives an embedding")
        self.input = pictures[0]
        self.channels_last = self.input.shape[-1] == 3 and self.input.shape[-3] != 3
        self.family, self.style = self._style(efficient)

    def _style(self, efficient: bool) -> tuple[str, Style]:
        own = self.model.sidecar
        asked = own.family.lower().replace("_", "").replace("-", "")
        if asked and asked not in FAMILIES:
            raise self.model.error(f"family '{own.family}' in its YAML is unknown; known are {', '.join(FAMILIES)}, fastsam")
        if asked:
            family = asked
        elif efficient or self.input.name.startswith("batched"):
            family = "efficientsam"
        elif sum(len(t.shape) == 4 for t in self.model.outputs) >= 3:
            family = "sam2"
        else:
            family = "samexporter" if self.channels_last or np.issubdtype(self.input.dtype, np.integer) else "sam"
        style = FAMILIES[family]
        return family, replace(style, normalised=normalisation_of(self.model, style.normalised))

    def __call__(self, image: NDArray[np.uint8], deadline: Deadline) -> Embedded:
        """Picture (H, W) or (H, W, 3) BGR uint8, any size. Raises ModelError, BudgetError."""
        height, width = image.shape[:2]
        wanted = self._size(height, width)
        if self.style.padded:
            factor = min(wanted[0] / height, wanted[1] / width)
            inner = max(int(height * factor + 0.5), 1), max(int(width * factor + 0.5), 1)
        else:
            inner = wanted
        pixels = to_rgb(image, inner, self.model.sidecar.channels == "bgr")
        whole = np.zeros((*wanted, 3), np.float32)
        whole[: inner[0], : inner[1]] = self.style.normalised(pixels)
        tensor = whole if self.channels_last else whole.transpose(2, 0, 1)
        outputs = self.model.run({self.input.name: tensor if len(self.input.shape) == 3 else tensor[None]}, deadline)
        features = dict(zip((t.name for t in self.model.outputs), outputs, strict=True))
        coarsest = min((a.shape[-2:] for a in outputs if a.ndim == 4), key=lambda s: s[0] * s[1])
        frame = float(PATCH * coarsest[0]), float(PATCH * coarsest[1])
        if not self.style.padded:
            return Embedded(features, (height, width), frame, frame)
        factor = max(frame) / max(wanted)
        return Embedded(features, (height, width), frame, (inner[0] * factor, inner[1] * factor))

    def _size(self, height: int, width: int) -> tuple[int, int]:
        """Height and width of the input for a picture of this size."""
        if self.model.sidecar.size:
            return self.model.sidecar.size
        rows, columns = self.input.shape[-3:-1] if self.channels_last else self.input.shape[-2:]
        if rows and columns:
            return rows, columns
        if self.style.own_pixels:
            return height, width
        if self.channels_last:  # the graph pads by itself
            factor = SIDE / max(height, width)
            return max(int(height * factor + 0.5), 1), max(int(width * factor + 0.5), 1)
        return rows or SIDE, columns or SIDE


def to_rgb(image: NDArray[np.uint8], size: tuple[int, int], bgr: bool = False) -> NDArray[np.float32]:
    """Picture (H, W) or (H, W, 3) BGR -> (h, w, 3) float32 RGB, or BGR, 0..255, at another size."""
    colour = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image
    shrinks = size[0] < image.shape[0]
    resized = cv2.resize(colour, size[::-1], interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    return np.asarray(resized if bgr else resized[:, :, ::-1], np.float32)


def _is_picture(tensor: Tensor) -> bool:
    shape = tensor.shape
    channels = shape[-3::2] if len(shape) in (3, 4) else ()  # first or last but for the batch
    return 3 in channels or (len(shape) == 4 and shape[1] is None)


# What the tensors of a decoder of masks are: by their names, then by their shapes.
KNOWN = (
    "known are the exports of SAM, MobileSAM, EdgeSAM and NanoSAM (image_embeddings, point_coords, point_labels and some of "
    "mask_input, has_mask_input, orig_im_size; masks or low_res_masks, iou_predictions or scores), SAM2 (with high_res_feats_0, "
    "high_res_feats_1, image_embed), EfficientSAM (batched_point_coords, batched_point_labels, orig_im_size; output_masks), "
    "Hugging Face (input_points, input_labels; pred_masks, iou_scores) and, alone, FastSAM (output0, output1)"
)


@dataclass(frozen=True)
class Roles:
    """What the tensors of a decoder are. features: (its input, name of the encoder's output)."""

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
        """Whether points are in pixels of the picture: EfficientSAM, whose decoder scales them itself."""
        return len(self.points.shape) == 4 and self.image_size is not None


def roles_of(decoder: OnnxModel, encoder: OnnxModel) -> Roles:
    """Roles of the decoder's tensors. ModelError, naming the tensors of both, if they fit no known export or not each other."""
    left = list(decoder.inputs)
    points = _take(left, ("coords", "points"), lambda t: len(t.shape) in (3, 4) and t.shape[-1] == 2)
    if points is None or len(points.shape) not in (3, 4) or points.shape[-1] not in (2, None):
        raise _misfit(decoder, encoder, "no input takes points")
    labels = _take(left, ("label",), lambda t: len(t.shape) == len(points.shape) - 1)
    if labels is None or len(labels.shape) != len(points.shape) - 1:
        raise _misfit(decoder, encoder, "no input takes the labels of the points")
    has_mask = _take(left, ("has_mask",), lambda t: t.shape in ((), (1,)))
    mask_input = _take(left, ("mask",), lambda t: len(t.shape) == 4 and t.shape[1] == 1)
    image_size = _take(left, ("size",), lambda t: t.shape == (2,))
    features = _features(left, decoder, encoder)
    outputs = list(decoder.outputs)
    largest = max(len(t.shape) for t in outputs)
    asked = decoder.sidecar.output
    if asked:
        masks = next((t for t in outputs if t.name == asked), None)
        if masks is None:
            raise decoder.error(f"there is no output '{asked}', which 'output:' of the YAML beside it names")
        outputs.remove(masks)
    else:
        masks = _take(outputs, ("low_res", "mask"), lambda t: len(t.shape) == largest >= 3)
    if masks is None:
        raise _misfit(decoder, encoder, "no output gives masks")
    score = _take(outputs, ("iou", "score"), lambda t: 1 <= len(t.shape) < len(masks.shape) - 1)
    return Roles(points, labels, mask_input, has_mask, image_size, features, masks, score)


def _take(left: list[Tensor], names: Sequence[str], fits: Callable[[Tensor], bool]) -> Tensor | None:
    """The tensor that a name belongs to, else the first that fits; it is taken out of the list."""
    named = (t for name in names for t in left if name in t.name.lower())
    found = next(named, None) or next(filter(fits, left), None)
    if found is not None:
        left.remove(found)
    return found


def _features(wanted: Iterable[Tensor], decoder: OnnxModel, encoder: OnnxModel) -> tuple[tuple[Tensor, str], ...]:
    """Which output of the encoder each of these inputs gets: that of the same name, else the first that has its shape."""
    given = {t.name: t for t in encoder.outputs}
    found, nameless = [], []
    for tensor in wanted:
        source = given.pop(tensor.name, None)
        if source is None:
            nameless.append(tensor)
        elif not _compatible(source, tensor):
            raise _misfit(decoder, encoder, f"the encoder gives {source}, but the decoder takes {tensor}")
        else:
            found.append((tensor, source.name))
    for tensor in nameless:
        name = next((name for name, source in given.items() if _compatible(source, tensor)), None)
        if name is None:
            raise _misfit(decoder, encoder, f"nothing is known that would belong to the input {tensor}")
        del given[name]
        found.append((tensor, name))
    if not found:
        raise _misfit(decoder, encoder, "no input takes the embedding")
    return tuple(found)


def _compatible(given: Tensor, taken: Tensor) -> bool:
    sizes = zip(given.shape, taken.shape, strict=False)
    return len(given.shape) == len(taken.shape) and all(None in (a, b) or a == b for a, b in sizes)


def _misfit(decoder: OnnxModel, encoder: OnnxModel, problem: str) -> ModelError:
    return ModelError(
        f"{encoder.path} and {decoder.path} are no pair of Segment Anything: {problem}; the encoder has {encoder.tensors}; "
        f"the decoder has {decoder.tensors}; {KNOWN}"
    )


# The second half of a Segment Anything pair: an embedding and points become masks.
IGNORED = -1.0  # label of a point that is none
COARSE = 4  # px of the frame of prompts per logit


class Decoder:
    """A graph from the embedding and points to masks; roles: what its tensors are."""

    def __init__(self, model: OnnxModel, roles: Roles, encoder: Encoder, batch: int) -> None:
        """batch: most prompts of one run, where the graph takes more than one."""
        self.model, self.encoder, self.roles = model, encoder, roles
        self._nested = len(roles.points.shape) == 4  # (1, prompts, points, 2)
        many = roles.points.shape[1 if self._nested else 0]
        self.batch, self._fixed = many or batch, many
        fixed = roles.points.shape[-2]
        # Exports of this shape fill up their points by themselves; the others want a point that is none where they have no box.
        self._slots = fixed or (1 if self._nested else 2)

    def __call__(self, embedded: Embedded, points: NDArray[np.float64], deadline: Deadline) -> Proposals:
        """Masks of prompts (n, 2), n <= batch, each a point in pixels of the picture. Raises ModelError, BudgetError."""
        if len(points) == 1 or self._fixed:
            return self._run(embedded, points, deadline)
        try:
            return self._run(embedded, points, deadline)
        except ModelError:
            self.batch = 1  # sizes that are said to be free need not be
        parts = [self._run(embedded, point[None], deadline) for point in points]
        first = parts[0]
        logits, score = np.concatenate([p.logits for p in parts]), np.concatenate([p.score for p in parts])
        return Proposals(logits, score, first.size, first.content, first.soft)

    def _run(self, embedded: Embedded, points: NDArray[np.float64], deadline: Deadline) -> Proposals:
        wanted = [self.roles.masks.name] + ([self.roles.score.name] if self.roles.score else [])
        n = self._fixed or len(points)
        filled = points[np.minimum(np.arange(n), len(points) - 1)]
        masks, *scores = self.model.run(self._feeds(embedded, filled), deadline, wanted)
        if masks.ndim < 2 or masks.size == 0 or masks.size % (n * masks.shape[-2] * masks.shape[-1]):
            raise self.model.error(f"it gave masks {masks.shape} for {n} prompts")
        masks = masks.reshape(n, -1, *masks.shape[-2:])
        score = scores[0].astype(np.float32) if scores else np.ones(masks.shape[:2], np.float32)
        if score.size % n or (masks.shape[1] > 1 and score.size != n * masks.shape[1]):
            raise self.model.error(f"it gave masks {masks.shape} and scores {scores[0].shape} for {n} prompts")
        masks, score = masks[: len(points)], score.reshape(n, -1)[: len(points)]
        if masks.shape[1] == 1:  # it chose the best one by itself
            score = score.max(axis=1, keepdims=True)
        logits, soft = _as_logits(masks)
        flat = logits.reshape(-1, *logits.shape[-2:])
        return Proposals(flat, score.ravel(), embedded.size, _content(embedded, flat.shape[-2:]), soft)

    def _feeds(self, embedded: Embedded, points: NDArray[np.float64]) -> dict[str, Array]:
        roles, n = self.roles, len(points)
        height, width = embedded.size
        own_pixels = self.encoder.style.own_pixels and roles.image_size is not None
        factor = np.ones(2) if own_pixels else np.array([embedded.content[1] / width, embedded.content[0] / height])
        coords, labels = np.zeros((n, self._slots, 2)), np.full((n, self._slots), IGNORED)
        coords[:, 0], labels[:, 0] = points * factor, 1
        feeds: dict[str, Array] = {t.name: embedded.features[source] for t, source in roles.features}
        feeds[roles.points.name] = coords[None] if self._nested else coords
        feeds[roles.labels.name] = labels[None] if self._nested else labels
        if roles.mask_input is not None:
            feeds[roles.mask_input.name] = np.zeros(_filled(roles.mask_input, n, [n, 1, *_coarse(embedded.frame)]))
        if roles.has_mask is not None:
            feeds[roles.has_mask.name] = np.zeros(_filled(roles.has_mask, n, [n]))
        if roles.image_size is not None:
            # Masks of the whole size would only be made to be thrown away where logits are given, too.
            small = not own_pixels and "low_res" in roles.masks.name
            feeds[roles.image_size.name] = np.array(_coarse(embedded.content) if small else embedded.size)
        return feeds


def _coarse(size: tuple[float, float]) -> tuple[int, int]:
    return max(round(size[0] / COARSE), 1), max(round(size[1] / COARSE), 1)


def _filled(tensor: Tensor, n: int, usual: Sequence[int]) -> list[int]:
    """A shape with its free sizes chosen."""
    if len(tensor.shape) != len(usual):
        return [size or n for size in tensor.shape]
    return [size or other for size, other in zip(tensor.shape, usual, strict=True)]


def _as_logits(masks: Array) -> tuple[NDArray[np.float32], bool]:
    """Masks as float32 with the threshold 0, and whether they are more than yes and no."""
    if masks.dtype.kind not in "f":
        return np.where(masks > 0, np.float32(1), np.float32(-1)), False
    masks = masks.astype(np.float32, copy=False)
    if masks.min() < 0 or masks.max() > 1:
        return masks, True
    soft = bool(((masks > 0) & (masks < 1)).any())
    p = np.clip(masks, 1e-6, 1 - 1e-6)  # probabilities
    return np.log(p / (1 - p)), soft


def _content(embedded: Embedded, shape: tuple[int, ...]) -> tuple[float, float]:
    """How much (h, w) of masks of this shape shows the picture: all of it, unless they have the shape of the padded frame."""
    height, width = shape
    aspect = np.log(height / width)
    padded, own = (abs(aspect - np.log(s[0] / s[1])) for s in (embedded.frame, embedded.size))
    if own <= padded or (height, width) == embedded.size:
        return float(height), float(width)
    return height * embedded.content[0] / embedded.frame[0], width * embedded.content[1] / embedded.frame[1]


# FastSAM (Zhao et al. 2023): YOLOv8-seg finds everything at once, without prompts. What is left to do outside of the graph.
GREY = 114.0  # of the border around the picture
# As FastSAM's authors set them. Its confidence is no predicted IoU, and its logits have no unit: min_iou and min_stability would
# drop nearly all.
CONFIDENCE, SAME_BOX = 0.4, 0.9
MOST = 300  # detections whose masks are made
MOST_AFTER_NMS = 300  # rows that exports with NMS inside give unless asked for others; without it there are thousands
LEAST = 5  # columns beside the coefficients: box and confidence of one class
Floats = NDArray[np.float32]


def is_fast_sam(model: OnnxModel, alone: bool) -> bool:
    """Whether a graph, given without a decoder, gives detections (1, c, n) and prototypes (1, p, h, w)."""
    if model.sidecar.family:
        return model.sidecar.family.lower().replace("_", "").replace("-", "") == "fastsam"
    return alone and {3, 4} <= {len(t.shape) for t in model.outputs}


class FastSam:
    """A graph of FastSAM as a Segmenter. ModelError if its tensors are others."""

    def __init__(self, model: OnnxModel, config: SemanticsConfig) -> None:
        self.model, self.config = model, config
        shapes = [t.shape for t in model.inputs]
        detections, maps = ([t.name for t in model.outputs if len(t.shape) == rank] for rank in (3, 4))
        if len(shapes) != 1 or len(shapes[0]) != 4 or not detections or not maps:
            raise model.error("this is no FastSAM, which takes pictures 1x3xHxW and gives detections 1xCxN, prototypes 1xPxhxw")
        asked = model.sidecar.output
        if asked and asked not in detections:
            raise model.error(f"'{asked}', which 'output:' of the YAML beside it names, is no output with detections 1xCxN")
        if _says_nms(model.metadata):
            raise _nms_inside(model)
        self._wanted = [asked or detections[0], *maps]
        self._normalised = normalisation_of(model, Normalisation(1 / 255))
        self._size = model.sidecar.size or (shapes[0][2] or SIDE, shapes[0][3] or SIDE)

    def describe(self) -> str:
        """The size at which it runs, and its tensors."""
        height, width = self._size
        return f"FastSAM, {width}x{height} RGB, on {self.model.provider}; {self.model.tensors}"

    def __call__(self, frame: Frame, deadline: Deadline) -> Masks:
        """Masks of the frame's image. Raises ModelError, BudgetError."""
        size = frame.image.shape[0], frame.image.shape[1]
        tensor, factor, corner = self._letterboxed(frame.image)
        found, *maps = (array[0] for array in self.model.run({self.model.inputs[0].name: tensor}, deadline, self._wanted))
        prototypes = self._prototypes(found, maps)
        boxes, score, coefficients = self._detections(found.astype(np.float32), len(prototypes))
        boxes -= np.tile(corner, 2)
        boxes /= np.tile(factor, 2)  # in pixels of the image from here on
        step = np.array(prototypes.shape[:0:-1]) / np.array(self._size[::-1])
        to_prototypes = np.zeros((2, 3))
        to_prototypes[[0, 1], [0, 1]] = step * factor
        to_prototypes[:, 2] = step * (0.5 * factor + corner) - 0.5
        masks: list[Mask] = []
        for k in _best(boxes, score):
            deadline.check()
            sampled, place = sample(np.tensordot(coefficients[k], prototypes, 1), to_prototypes, boxes[k], size)
            mask = Mask.of(clean(sampled > 0, max(size) / CELLS), place)
            if mask is not None:
                masks.append(replace(mask, score=min(float(score[k]), 1.0)))
        return Masks(size, tuple(without_duplicates(masks, self.config.nms_iou)))

    def _letterboxed(self, image: NDArray[np.uint8]) -> tuple[Floats, Floats, Floats]:
        """The input (1, 3, H, W), and where the picture is in it: pixels per pixel and corner, (2,) each."""
        size, own = image.shape[:2], self.model.sidecar
        factor = min(self._size[0] / size[0], self._size[1] / size[1])
        height, width = max(round(size[0] * factor), 1), max(round(size[1] * factor), 1)
        top, left = (self._size[0] - height) // 2, (self._size[1] - width) // 2
        picture = np.full((*self._size, 3), GREY, np.float32)
        picture[top : top + height, left : left + width] = to_rgb(image, (height, width), own.channels == "bgr")
        scale = np.array([width / size[1], height / size[0]], np.float32)
        return self._normalised(picture).transpose(2, 0, 1)[None], scale, np.array([left, top], np.float32)

    def _prototypes(self, found: Array, maps: Sequence[Array]) -> Floats:
        """Prototypes (p, h, w) among the maps: the last that the detections can have a coefficient for each of."""
        if any(_looks_like_nms(found, len(m)) for m in maps):
            raise _nms_inside(self.model)
        fitting = [m for m in maps if len(m) <= min(found.shape) - LEAST]  # other exports give maps of features, too
        if not fitting:
            raise self.model.error(f"it gave detections {found.shape}, which do not fit prototypes {[m.shape for m in maps]}")
        return fitting[-1].astype(np.float32, copy=False)

    def _detections(self, found: Array, prototypes: int) -> tuple[Floats, Floats, Floats]:
        """Boxes (n, 4) left, top, right, bottom in pixels of the input, confidence (n,), coefficients (n, p)."""
        rows = found.T if found.shape[0] < found.shape[1] else found
        classes = rows.shape[1] - 4 - prototypes
        rows = rows[np.isfinite(rows).all(axis=1)]
        score = rows[:, 4 : 4 + classes].max(axis=1)
        sure = score >= CONFIDENCE
        rows, score = rows[sure], score[sure]
        half = rows[:, 2:4] / 2
        return np.hstack([rows[:, :2] - half, rows[:, :2] + half]), score, rows[:, 4 + classes :]


def _says_nms(metadata: Mapping[str, str]) -> bool:
    """Whether the exporter wrote that NMS, or a head that does without, is inside: keys nms, end2end, or within args."""
    keys = (metadata.get(key, "").lower() == "true" for key in ("nms", "end2end"))
    return any(keys) or re.search(r"'nms':\s*True", metadata.get("args", "")) is not None


def _looks_like_nms(found: Array, prototypes: int) -> bool:
    """Whether rows (n, c) are corners, confidence, number of the class and coefficients: few, and classes are whole numbers."""
    if found.shape[0] > MOST_AFTER_NMS or found.shape[1] != 6 + prototypes:
        return False
    return bool((found[:, 5] == np.rint(found[:, 5])).all())


def _nms_inside(model: OnnxModel) -> ModelError:
    return model.error(
        "it was exported with NMS inside; export it with nms=False, and end2end=False where there is such a choice"
    )


def _best(boxes: Floats, score: Floats) -> list[int]:
    """Numbers of the surest detections, best first, without those whose box nearly is that of a surer one."""
    area = (boxes[:, 2:] - boxes[:, :2]).prod(axis=1)
    left, kept = np.argsort(-score, kind="stable"), list[int]()
    while len(left) and len(kept) < MOST:
        best, left = int(left[0]), left[1:]
        kept.append(best)
        low, high = np.maximum(boxes[left, :2], boxes[best, :2]), np.minimum(boxes[left, 2:], boxes[best, 2:])
        common = np.clip(high - low, 0, None).prod(axis=1)
        left = left[common <= SAME_BOX * (area[left] + area[best] - common)]
    return kept
