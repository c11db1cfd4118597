"""The second half of a Segment Anything pair: an embedding and points become masks.

All known exports: the official one, of whose inputs others leave some out; SAM2 with features of three resolutions and many
prompts at once; EfficientSAM with a dimension more.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import ModelError
from calib_ros.semantics.deadline import Deadline
from calib_ros.semantics.onnx_model import Array, OnnxModel, Tensor
from calib_ros.semantics.segment_anything.encoders import Embedded, Encoder
from calib_ros.semantics.segment_anything.proposals import Proposals
from calib_ros.semantics.segment_anything.roles import Roles

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
