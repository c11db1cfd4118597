"""FastSAM (Zhao et al. 2023): YOLOv8-seg finds everything at once, without prompts. What is left to do outside of the graph.

Detections are centre, size, confidence of each class and coefficients; a mask is the sum of prototypes by the coefficients.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import SemanticsConfig
from calib_ros.errors import ModelError
from calib_ros.frame import Frame
from calib_ros.semantics.deadline import Deadline
from calib_ros.semantics.onnx_model import Array, OnnxModel
from calib_ros.semantics.segment_anything.duplicates import without_duplicates
from calib_ros.semantics.segment_anything.encoders import SIDE, to_rgb
from calib_ros.semantics.segment_anything.masks import Mask, Masks
from calib_ros.semantics.segment_anything.normalisation import Normalisation, normalisation_of
from calib_ros.semantics.segment_anything.proposals import CELLS, clean, sample

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
