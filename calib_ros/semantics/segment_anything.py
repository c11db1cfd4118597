"""From the settings to masks: which kind of file was given, and what belongs to it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import SemanticsConfig
from calib_ros.errors import ModelError
from calib_ros.frame import Frame
from calib_ros.semantics.masks import Mask, MaskFolder, Masks, Proposals, judged, mask_edges, without_duplicates
from calib_ros.semantics.onnx_model import Deadline, OnnxModel
from calib_ros.semantics.sam_models import Decoder, Encoder, FastSam, is_fast_sam, roles_of

# Masks of everything in a picture: a grid of prompts, of which those are left out that would tell nothing new.
Points = NDArray[np.float64]
Answer = Callable[[Points], Proposals]
# A prompt tells nothing new in a mask so small that the grid holds hardly another point of it, and between two prompts that are
# in the same mask and in none within it. On 94 real masks of a street this saves a fifth of the prompts, of finer grids
# a quarter, on synthetic streets, where less is nested, up to a third, and it loses no mask larger than a cell of the grid. To
# leave out all prompts in known masks would lose a quarter of those.
FEW = 2.0  # cells of the grid
BESIDE, ENOUGH = 1.1, 2  # spacings of the grid; neighbours


def everything(
    answer: Answer, size: tuple[int, int], batch: Callable[[], int], config: SemanticsConfig, deadline: Deadline
) -> Masks:
    """Masks of a picture of this size (H, W). Raises BudgetError, and what `answer` raises.

    answer: masks that a model proposes for prompts (n, 2), pixels. batch: how many prompts it takes at the moment.
    """
    found: list[Mask] = []
    asked: list[Points] = []
    waiting = list(grid(size, config.prompt_grid))
    spacing = max(size) / config.prompt_grid
    while waiting:
        deadline.check()
        prompts: list[Points] = []
        while waiting and len(prompts) < batch():
            point = waiting.pop(0)
            if not _known(point, asked, found, spacing):
                prompts.append(point)
        if prompts:
            proposals = answer(np.array(prompts))
            found = without_duplicates(found + judged(proposals, config.min_iou, config.min_stability), config.nms_iou)
            asked += prompts
    return Masks(size, tuple(found))


def _known(point: Points, asked: Sequence[Points], found: Sequence[Mask], spacing: float) -> bool:
    """Whether masks tell already what a prompt at the point (2,) would, where the prompts `asked` have been."""
    own = _innermost(point, found)
    if own is None:
        return False
    if own.area < FEW * spacing**2:
        return True
    beside = (other for other in asked if np.hypot(*(other - point)) <= BESIDE * spacing)
    return sum(_innermost(other, found) is own for other in beside) >= ENOUGH


def _innermost(point: Points, masks: Iterable[Mask]) -> Mask | None:
    """The smallest mask with this point (2,)."""
    return min((mask for mask in masks if mask.covers(*(point + 0.5))), key=lambda mask: mask.area, default=None)


def grid(size: tuple[int, int], along: int) -> Points:
    """Prompts (n, 2), column and row, of a picture (H, W): `along` of them on the longer side and as dense on the other.

    Coarse to fine: those on every 2^k-th row and column come before those between them, so that large things are found
    first and prompts of one batch lie far apart.
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


class SegmentAnything:
    """Masks of everything in a frame's image, from config.segment_anything; a Segmenter.

    An encoder with its decoder, FastSAM alone, or a folder of ready masks. Raises ModelError, MissingDependencyError.
    """

    def __init__(self, config: SemanticsConfig) -> None:
        self.models: tuple[OnnxModel, ...] = ()
        if Path(config.segment_anything).is_dir():
            self._segmenter: MaskFolder | FastSam | Prompted = MaskFolder(config.segment_anything)
            return
        first = OnnxModel(config.segment_anything, config)
        if is_fast_sam(first, alone=not config.segment_anything_decoder):
            self._segmenter = FastSam(first, config)
            self.models = (first,)
        else:
            self._segmenter = Prompted(first, _decoder(first, config), config)
            self.models = self._segmenter.models

    @property
    def fallback(self) -> str:
        """Why a model does not run where it was asked to; empty if all do."""
        return "; ".join(model.fallback for model in self.models if model.fallback)

    def describe(self) -> str:
        """What it is, what goes in and comes out, for people."""
        return self._segmenter.describe()

    def __call__(self, frame: Frame, deadline: Deadline) -> Masks:
        """Masks in the size of the image. Raises ModelError, BudgetError."""
        return self._segmenter(frame, deadline)


class MaskEdges:
    """Frame -> semantic edges (2, H, W), see mask_edges, with the masks of SegmentAnything; raises as it does."""

    def __init__(self, config: SemanticsConfig) -> None:
        self.masks = SegmentAnything(config)

    @property
    def fallback(self) -> str:
        """Why a model does not run where it was asked to; empty if all do."""
        return self.masks.fallback

    def describe(self) -> str:
        """What it is, what goes in and comes out, for people."""
        return self.masks.describe()

    def __call__(self, frame: Frame, deadline: Deadline) -> NDArray[np.float32]:
        """ModelError: no edges for this frame. BudgetError: the time is up."""
        return mask_edges(self.masks(frame, deadline))


class Prompted:
    """A pair of encoder and decoder, prompted all over the picture; a Segmenter. ModelError if they are no pair."""

    def __init__(self, encoder: OnnxModel, decoder: OnnxModel, config: SemanticsConfig) -> None:
        roles = roles_of(decoder, encoder)
        self.models, self.config = (encoder, decoder), config
        self.encoder = Encoder(encoder, roles.in_own_pixels)
        self.decoder = Decoder(decoder, roles, self.encoder, config.prompt_batch)

    def describe(self) -> str:
        """The family, the grid, and the tensors of both files."""
        encoder, decoder = self.models
        return (
            f"Segment Anything ({self.encoder.family}), {self.config.prompt_grid} prompts along the longer side, "
            f"{self.decoder.batch} in a run, on {decoder.provider}; encoder: {encoder.tensors}; decoder: {decoder.tensors}"
        )

    def __call__(self, frame: Frame, deadline: Deadline) -> Masks:
        """Masks of the frame's image. Raises ModelError, BudgetError."""
        embedded = self.encoder(frame.image, deadline)
        return everything(
            lambda points: self.decoder(embedded, points, deadline),
            embedded.size,
            lambda: self.decoder.batch,
            self.config,
            deadline,
        )


def _decoder(encoder: OnnxModel, config: SemanticsConfig) -> OnnxModel:
    if not config.segment_anything_decoder:
        raise ModelError(
            f"{encoder.path} needs its decoder: set semantics.segment_anything_decoder to its ONNX file. FastSAM alone has none; "
            f"this file has {encoder.tensors}"
        )
    return OnnxModel(config.segment_anything_decoder, config)
