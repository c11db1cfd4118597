"""Interface of a calibration method that can be compared, and what several methods share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera
from calib_ros.config import Config
from calib_ros.errors import TooFewFeaturesError
from calib_ros.frame import Frame, PointCloud
from calib_ros.image.enhance import to_gray
from calib_ros.lidar.deskew import deskewed_points
from calib_ros.lidar.range_image import reflectivity, require_returns
from calib_ros.registration.features import FeatureExtractor, FrameFeatures
from calib_ros.registration.score.point_score import Score, near_image
from calib_ros.registration.search.constraints import Limits, SearchBox, unlimited
from calib_ros.registration.search.optimizers import METRES_PER_RADIAN
from calib_ros_semantics.models.segmentation import SegmentationModels

Matrix = NDArray[np.float64]
REFINED_DEG = 0.4  # of a reach of zero, which refines a start that is right: a few pixels


@dataclass(frozen=True, eq=False)
class Outcome:
    """Where a method ended. T: T_camera_lidar (4, 4), the start if refused. evaluations: of the score. refused: why the method
    itself does not trust its optimum; empty if it does, or has no test for it."""

    T: Matrix
    evaluations: int
    refused: str = ""


@dataclass(frozen=True)
class Method(ABC):
    """A method as it was published: a score of the extrinsic and how it is maximised.

    All get the same frames, rectified and with the points moved to the image's moment, and know how far off the start may be.
    name: in tables and on the command line, a lower-case word. title: for people: authors and what is matched with what.
    """

    config: Config = field(default_factory=Config)
    name: ClassVar[str]
    title: ClassVar[str]

    @cached_property
    def own_config(self) -> Config:
        """The configuration with what the method itself chooses."""
        return self.config

    @cached_property
    def _last(self) -> list[FeatureExtractor]:
        return []

    def extractor(self, camera: Camera) -> FeatureExtractor:
        """Of the features of a camera's images; that of the last camera, whose look-up tables are kept, is used again."""
        if not self._last or self._last[0].source_camera != camera:
            self._last[:] = [FeatureExtractor(camera, self.own_config)]
        return self._last[0]

    @abstractmethod
    def features(self, frame: Frame) -> Any:
        """What the method keeps of a frame; does not depend on the extrinsic. CalibrationError if there is nothing to keep."""

    @abstractmethod
    def score(self, features: Sequence[Any], T_prior: Matrix) -> Score:
        """What is maximised over these frames of one camera. T_prior: (4, 4), near; points far outside its image may be left out.
        CalibrationError if too little falls into the image."""

    @abstractmethod
    def optimise(self, features: Sequence[Any], T: Matrix, reach: SearchBox) -> Outcome:
        """Calibrate from T_camera_lidar (4, 4). reach: how far off that may be, per axis."""


@dataclass(eq=False)
class Watched:
    """A score that counts its evaluations; a Score."""

    score: Score
    evaluations: int = 0

    def value(self, T: Matrix) -> float:
        """At T (4, 4)."""
        self.evaluations += 1
        return self.score.value(T)


@dataclass(frozen=True, eq=False)
class MeanScore:
    """The mean over frames of what `of_frame` makes of one at T_camera_lidar (4, 4); a Score."""

    frames: Sequence[Any]
    of_frame: Callable[[Any, Matrix], float]

    def value(self, T: Matrix) -> float:
        """At T (4, 4)."""
        return float(np.mean([self.of_frame(frame, T) for frame in self.frames]))


def typical_step_deg(reach: SearchBox) -> float:
    """One length for all axes (deg, and METRES_PER_RADIAN times that in translation) of the size of the reach: the geometric
    mean of what it allows in rotation and in translation; where only one of the two is open, that one."""
    deg, m = reach.reach
    of_shift = float(np.rad2deg(m / METRES_PER_RADIAN))
    if deg and of_shift:
        return float(np.sqrt(deg * of_shift))
    return max(deg, of_shift) or REFINED_DEG


def search_limits(T: Matrix, reach: SearchBox) -> Limits:
    """The start T (4, 4) is off by no more than the reach, axis by axis: no optimiser needs to look farther. A reach of zero
    bounds nothing."""
    return unlimited(T) if reach.is_empty else Limits(T, reach.half_width())


class Extracting(Method):
    """Base of methods that work with features of the calibrator. objective: of ``refine.objective``."""

    objective: ClassVar[str]

    @cached_property
    def own_config(self) -> Config:
        """See Method."""
        refine = self.config.refine
        # An optimiser that was chosen with another objective, as by a preset, is not this one's.
        optimizer = refine.optimizer if refine.objective in ("fast", self.objective) else "auto"
        return replace(self.config, refine=replace(refine, objective=self.objective, optimizer=optimizer))

    @cached_property
    def segmentation(self) -> SegmentationModels:
        """The models of the configuration."""
        return SegmentationModels(self.config.semantics)

    def features(self, frame: Frame) -> FrameFeatures:
        """Features of a frame, with semantics where the configuration asks for any. TooFewFeaturesError or BadTimesError if it
        cannot be used."""
        seen = self.segmentation(frame) if self.segmentation.active else None
        return self.extractor(frame.camera)(frame, seen)


@dataclass(frozen=True, eq=False)
class PointFeatures:
    """What a baseline keeps of a frame. camera: its pinhole. image: (h, w) what points are matched with. xyz: (n, 3) float32 m
    at the image's moment, LiDAR frame. value: (n,) of each point, what the method matches; None = nothing."""

    camera: Camera
    image: NDArray[Any]
    xyz: NDArray[np.float32]
    value: Any = None

    def select(self, keep: NDArray[np.intp]) -> PointFeatures:
        """Some of the points, by index."""
        return replace(self, xyz=self.xyz[keep], value=None if self.value is None else self.value[keep])


class Viewing(Method):
    """Base of the baselines, which project by eq. 2.3."""

    @cached_property
    def own_config(self) -> Config:
        """See Method."""
        return replace(self.config, image=replace(self.config.image, projection="pinhole"))

    def _preprocess(self, frame: Frame) -> tuple[PointFeatures, PointCloud]:
        """The grey image (h, w) uint8 with all points and their reflectivity, float32 in 0..1, None if the source has none; and
        the scan as it was measured, finite points only, in the source's order: neighbours are to be looked for in it.

        TooFewFeaturesError if hardly anything returned, BadTimesError for times that cannot be."""
        require_returns(frame.cloud)
        extract, measured = self.extractor(frame.camera), frame.cloud.finite()
        at_image = deskewed_points(frame, self.config.motion)
        xyz = measured.xyz if at_image is None else at_image[frame.cloud.finite_mask()]
        gray = to_gray(extract.working_image(frame.image))
        return PointFeatures(extract.camera, gray, xyz, reflectivity(measured.intensity)), measured


def near(features: Sequence[PointFeatures], T: Matrix, margin: float, least: int, what: str) -> list[PointFeatures]:
    """The points of each frame that project near the image at T (4, 4): within `margin` of its width.

    TooFewFeaturesError without a frame, or for fewer than `least` points per frame. what: for people.
    """
    if not features:
        raise TooFewFeaturesError("no frame can be used; give others")
    kept = [f.select(near_image(f.xyz, T, f.camera, margin)) for f in features]
    require(sum(len(f.xyz) for f in kept), least * len(features), what, "check the initial extrinsic")
    return kept


def require(found: int, needed: int, what: str, advice: str) -> None:
    """TooFewFeaturesError for fewer points than needed."""
    if found < needed:
        raise TooFewFeaturesError(f"only {found} points {what} (need {needed}); {advice}")
