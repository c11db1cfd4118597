"""Features as the calibrator extracts them, for the two methods of this project."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import ClassVar

from calib_ros.config import Config
from calib_ros.frame import Frame
from calib_ros.registration.features import FeatureExtractor, Features
from calib_ros.semantics.segmentation import Segmentation


class Extracting:
    """What methods have in common that work with features of the calibrator. objective: whose, of ``refine.objective``."""

    objective: ClassVar[str]
    config: Config

    @cached_property
    def _extraction(self) -> Extraction:
        return Extraction(replace(self.config, refine=replace(self.config.refine, objective=self.objective)))

    @property
    def problems(self) -> tuple[str, ...]:
        """What went wrong with the models of semantics so far, a line each."""
        return tuple(self._extraction.problems)

    def features(self, frame: Frame) -> Features:
        """Features of a frame, with semantics where the configuration asks for any. TooFewFeaturesError or BadTimesError if it
        cannot be used."""
        return self._extraction(frame)


class Extraction:
    """Features of frames, with semantics where the configuration asks for any. The models, and the look-up tables of the last
    camera's lens, are kept. problems: what went wrong with a model, a line each; such frames have features without it."""

    def __init__(self, config: Config) -> None:
        self.config, self.segmentation = config, Segmentation(config.semantics)
        self.problems: list[str] = []
        self._extract: FeatureExtractor | None = None

    def __call__(self, frame: Frame) -> Features:
        """Features of a frame for the configured objective. TooFewFeaturesError or BadTimesError if it cannot be used."""
        if self._extract is None or self._extract.source_camera != frame.camera:
            self._extract = FeatureExtractor(frame.camera, self.config)
        seen = self.segmentation(frame) if self.segmentation.wanted else None
        if seen is not None:
            self.problems += [line for line in seen.problems if line not in self.problems]
        return self._extract(frame, seen)
