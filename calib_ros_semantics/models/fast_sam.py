"""FastSAM (Zhao et al. 2023): YOLOv8-seg finds all masks at once, without prompts. Here, what is done outside the graph."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calib_ros.frame import Frame
from calib_ros_semantics.models.masks import NMS_IOU, Mask, MaskModel, found_mask, sample_logits, without_duplicates
from calib_ros_semantics.models.onnx_model import Array, Deadline, InputImage, Normalisation, OnnxModel, to_rgb
from calib_ros_semantics.models.segment_anything import DEFAULT_SIDE, FAMILIES

Floats = NDArray[np.float32]
BORDER_GREY = 114.0  # grey level around the letterboxed image
# As set by FastSAM's authors. Its confidence is not a predicted IoU, and its logits have no unit: MIN_IOU and MIN_STABILITY would
# drop nearly all masks.
MIN_CONFIDENCE, MAX_BOX_IOU = 0.4, 0.9
MAX_DETECTIONS = 300  # whose masks are made
MAX_NMS_ROWS = 300  # default of exports with NMS inside; without it there are thousands
NMS_INSIDE = "it was exported with NMS inside; export it with nms=False, and end2end=False where there is such a choice"
MIN_OTHER_COLUMNS = 5  # beside the coefficients: box and confidence of one class


class FastSam(MaskModel):
    """FastSAM: detections (1, c, n) and prototypes (1, p, h, w). Raises ModelError for other tensors."""

    needed = f"a confidence of {MIN_CONFIDENCE:g}"

    def __init__(self, model: OnnxModel) -> None:
        self.model, self.fallback = model, model.fallback
        found = InputImage.of(model, model.inputs, (3,))
        detections, maps = ([t.name for t in model.outputs if len(t.shape) == rank] for rank in (3, 4))
        asked = model.sidecar.output
        if found is None or not maps or not detections or (asked and asked not in detections):
            raise model.error(
                "this is no FastSAM, which takes pictures 1x3xHxW and gives prototypes 1xPxhxw and detections 1xCxN, which an "
                "'output:' in its YAML names"
            )
        told = [model.metadata.get(key, "").lower() == "true" for key in ("nms", "end2end")]
        if any(told) or re.search(r"'nms':\s*True", model.metadata.get("args", "")):
            raise model.error(NMS_INSIDE)
        self._outputs = [asked or detections[0], *maps]
        self._normalised = Normalisation.of(model, Normalisation(1 / 255))
        self._input, self._size = found, (found.size[0] or DEFAULT_SIDE, found.size[1] or DEFAULT_SIDE)

    def describe(self) -> str:
        height, width = self._size
        return f"FastSAM, {width}x{height} RGB, fed as {self._normalised.text}, on {self.model.provider}; {self.model.tensors}"

    def masks(self, frame: Frame, deadline: Deadline) -> list[Mask]:
        size = frame.image.shape[0], frame.image.shape[1]
        tensor, factor, corner = self._letterboxed(frame.image)
        found, *maps = (array[0] for array in self.model.run({self._input.tensor.name: tensor}, deadline, self._outputs))
        boxes, score, coefficients, prototypes = self._detections(found, maps)
        boxes -= np.tile(corner, 2)
        boxes /= np.tile(factor, 2)  # in pixels of the image from here
        step = np.array(prototypes.shape[:0:-1]) / np.array(self._size[::-1])
        to_prototypes = np.zeros((2, 3))
        to_prototypes[[0, 1], [0, 1]] = step * factor
        to_prototypes[:, 2] = step * (0.5 * factor + corner) - 0.5
        masks: list[Mask] = []
        for k in _suppress_boxes(boxes, score):
            deadline.check()
            sampled, place = sample_logits(np.tensordot(coefficients[k], prototypes, 1), to_prototypes, boxes[k], size)
            masks += found_mask(sampled > 0, size, place, float(score[k]))
        return without_duplicates(masks, NMS_IOU)

    def _letterboxed(self, image: NDArray[np.uint8]) -> tuple[Array, Floats, Floats]:
        """The input (1, 3, H, W), and the place of the image in it: scale (2,) and corner (2,), x and y."""
        size = image.shape[:2]
        factor = min(self._size[0] / size[0], self._size[1] / size[1])
        height, width = (max(round(n * factor), 1) for n in size)
        top, left = (self._size[0] - height) // 2, (self._size[1] - width) // 2
        picture = np.full((*self._size, 3), BORDER_GREY, np.float32)
        picture[top : top + height, left : left + width] = to_rgb(image, (height, width), self.model.sidecar.channels == "bgr")
        scale = np.array([width / size[1], height / size[0]], np.float32)
        return self._input.arranged(self._normalised(picture)), scale, np.array([left, top], np.float32)

    def _detections(self, found: Array, maps: Sequence[Array]) -> tuple[Floats, Floats, Floats, Floats]:
        """Boxes (n, 4) left, top, right, bottom in pixels of the input, confidence (n,), coefficients (n, p), and prototypes
        (p, h, w) among the maps: the last for which the detections have enough coefficients."""
        # Few rows of corners, confidence, class number and coefficients.
        if found.shape[0] <= MAX_NMS_ROWS and any(found.shape[1] == 6 + len(m) for m in maps):
            raise self.model.error(NMS_INSIDE)
        fitting = [m for m in maps if len(m) <= min(found.shape) - MIN_OTHER_COLUMNS]  # other exports also give feature maps
        if not fitting:
            raise self.model.error(f"it gave detections {found.shape}, which do not fit prototypes {[m.shape for m in maps]}")
        prototypes, rows = fitting[-1].astype(np.float32, copy=False), found.astype(np.float32)
        rows = rows.T if rows.shape[0] < rows.shape[1] else rows
        classes = rows.shape[1] - 4 - len(prototypes)
        rows = rows[np.isfinite(rows).all(axis=1)]
        score = rows[:, 4 : 4 + classes].max(axis=1)
        sure = score >= MIN_CONFIDENCE
        rows, score = rows[sure], score[sure]
        half = rows[:, 2:4] / 2
        return np.hstack([rows[:, :2] - half, rows[:, :2] + half]), score, rows[:, 4 + classes :], prototypes


def is_fast_sam(model: OnnxModel, alone: bool) -> bool:
    """Whether a graph is FastSAM. alone: it is configured without a decoder."""
    family = model.family((*FAMILIES, "fastsam"))
    return family == "fastsam" if family else alone and {3, 4} <= {len(t.shape) for t in model.outputs}


def _suppress_boxes(boxes: Floats, score: Floats) -> list[int]:
    """Indices of the detections of highest score, best first, after non-maximum suppression of their boxes (n, 4)."""
    area = (boxes[:, 2:] - boxes[:, :2]).prod(axis=1)
    left, kept = np.argsort(-score, kind="stable"), list[int]()
    while len(left) and len(kept) < MAX_DETECTIONS:
        best, left = int(left[0]), left[1:]
        kept.append(best)
        low, high = np.maximum(boxes[left, :2], boxes[best, :2]), np.minimum(boxes[left, 2:], boxes[best, 2:])
        common = np.clip(high - low, 0, None).prod(axis=1)
        left = left[common <= MAX_BOX_IOU * (area[left] + area[best] - common)]
    return kept
