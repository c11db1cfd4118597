"""Semantic edges from Segment Anything: the configured model or folder, prompted on a grid over the image."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import SemanticsConfig
from calib_ros.frame import Frame
from calib_ros_semantics.models.fast_sam import FastSam, is_fast_sam
from calib_ros_semantics.models.masks import (
    MIN_IOU,
    MIN_STABILITY,
    NMS_IOU,
    Mask,
    MaskFolder,
    Proposals,
    accepted_masks,
    mask_edges,
    without_duplicates,
)
from calib_ros_semantics.models.network_kinds import NetworkKind, kind_of
from calib_ros_semantics.models.onnx_model import Deadline, OnnxModel, SegmentationModel
from calib_ros_semantics.models.sam_models import Decoder, Encoder, roles_of

Points = NDArray[np.float64]
Proposer = Callable[[Points], Proposals]
# A prompt is redundant in a mask so small that the grid has hardly another point in it, and among neighbours that are in the same
# mask and in none within it. On 94 real masks of a street this saves a fifth of the prompts, of finer grids a quarter, on
# synthetic streets, where less is nested, up to a third, and it loses no mask larger than a cell of the grid. Skipping all
# prompts in known masks would lose a quarter of those.
PROMPT_BATCH = 16  # prompts per run, if the export accepts several: more gain hardly any time, and take memory
SMALL_CELLS = 2.0  # area of a small mask, cells of the grid
NEIGHBOUR_SPACINGS, SAME_MASK_NEIGHBOURS = 1.1, 2  # reach of neighbours in spacings of the grid; how many of them


class MaskEdges(SegmentationModel):
    """Frame -> semantic edges (2, H, W) as of `mask_edges`, from the masks of `segmenter_of`."""

    def __init__(self, config: SemanticsConfig) -> None:
        self._segmenter = segmenter_of(config)
        self.fallback, self.needed = self._segmenter.fallback, self._segmenter.needed

    def __call__(self, frame: Frame, deadline: Deadline, borders: bool = True) -> NDArray[np.float32]:
        return mask_edges(self._segmenter(frame, deadline), (frame.image.shape[0], frame.image.shape[1]))

    def describe(self) -> str:
        return self._segmenter.describe()


def segmenter_of(config: SemanticsConfig) -> MaskFolder | FastSam | Prompted:
    """What gives the masks of everything in a frame's image: an encoder with its decoder, FastSAM, or a folder of masks.

    Raises ModelError, MissingDependencyError.
    """
    if Path(config.segment_anything).is_dir():
        return MaskFolder(config.segment_anything)
    first = OnnxModel(config.segment_anything, config)
    if is_fast_sam(first, alone=not config.segment_anything_decoder):
        return FastSam(first)
    return Prompted(first, _decoder_of(first, config), config.prompt_grid)


class Prompted:
    """Encoder and decoder, prompted on a grid over the image. ModelError if the two do not fit each other."""

    needed = f"a predicted IoU of {MIN_IOU:g} and a stability of {MIN_STABILITY:g}"

    def __init__(self, encoder: OnnxModel, decoder: OnnxModel, along: int) -> None:
        """along: prompts along the longer side of the image."""
        roles = roles_of(decoder, encoder)
        self.along = along
        self.fallback = "; ".join(model.fallback for model in (encoder, decoder) if model.fallback)
        self.encoder = Encoder(encoder, roles.in_own_pixels)
        self.decoder = Decoder(decoder, roles, self.encoder, PROMPT_BATCH)

    def describe(self) -> str:
        """Family, grid, and tensors of both files, as text."""
        encoder, decoder = self.encoder.model, self.decoder.model
        return (
            f"Segment Anything ({self.encoder.family}), {self.along} prompts along the longer side, {self.decoder.batch} in a "
            f"run, fed as {self.encoder.preprocessing.normalised.text}, on {decoder.provider}; encoder: {encoder.tensors}; "
            f"decoder: {decoder.tensors}"
        )

    def __call__(self, frame: Frame, deadline: Deadline) -> list[Mask]:
        """Masks of the frame's image. Raises ModelError, BudgetError."""
        embedded, decoder = self.encoder(frame.image, deadline), self.decoder
        return everything(
            lambda points: decoder(embedded, points, deadline), embedded.size, lambda: decoder.batch, self.along, deadline
        )


def _decoder_of(encoder: OnnxModel, config: SemanticsConfig) -> OnnxModel:
    if config.segment_anything_decoder:
        return OnnxModel(config.segment_anything_decoder, config)
    kind = kind_of(encoder)
    if kind not in (NetworkKind.ENCODER, NetworkKind.OTHER):
        raise encoder.error(
            f"this looks like {kind.value}; semantics.segment_anything takes the encoder of Segment Anything or FastSAM"
        )
    raise encoder.error("it needs its decoder: set semantics.segment_anything_decoder to its ONNX file. FastSAM has none")


def everything(propose: Proposer, size: tuple[int, int], batch: Callable[[], int], along: int, deadline: Deadline) -> list[Mask]:
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
            if not _is_redundant(point, prompted, found, spacing):
                prompts.append(point)
        if prompts:
            proposals = propose(np.array(prompts))
            found = without_duplicates(found + accepted_masks(proposals), NMS_IOU)
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


def _is_redundant(point: Points, prompted: Sequence[Points], found: Sequence[Mask], spacing: float) -> bool:
    """Whether a prompt at the point (2,) would hardly find a new mask. prompted: prompts so far. found: their masks."""
    own = _innermost(point, found)
    if own is None:
        return False
    if own.area < SMALL_CELLS * spacing**2:
        return True
    beside = (other for other in prompted if np.hypot(*(other - point)) <= NEIGHBOUR_SPACINGS * spacing)
    return sum(_innermost(other, found) is own for other in beside) >= SAME_MASK_NEIGHBOURS


def _innermost(point: Points, masks: Iterable[Mask]) -> Mask | None:
    """The smallest mask that covers the point (2,)."""
    return min((mask for mask in masks if mask.covers(*(point + 0.5))), key=lambda mask: mask.area, default=None)
