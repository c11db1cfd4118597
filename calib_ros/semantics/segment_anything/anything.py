"""From the settings to masks: which kind of file was given, and what belongs to it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import SemanticsConfig
from calib_ros.errors import ModelError
from calib_ros.frame import Frame
from calib_ros.semantics.deadline import Deadline
from calib_ros.semantics.onnx_model import OnnxModel
from calib_ros.semantics.segment_anything.decoders import Decoder
from calib_ros.semantics.segment_anything.encoders import Encoder
from calib_ros.semantics.segment_anything.everything import everything
from calib_ros.semantics.segment_anything.fast_sam import FastSam, is_fast_sam
from calib_ros.semantics.segment_anything.mask_edges import mask_edges
from calib_ros.semantics.segment_anything.mask_folder import MaskFolder
from calib_ros.semantics.segment_anything.masks import Masks
from calib_ros.semantics.segment_anything.roles import roles_of


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
