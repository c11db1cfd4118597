"""The default method of this project: the fast form, searched, climbed and judged by the calibrator."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import Config
from calib_ros.errors import TooFewFeaturesError
from calib_ros.evaluation.methods.extraction import Extracting
from calib_ros.evaluation.methods.method import Outcome, Step
from calib_ros.registration.atlas import Atlas
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.fast_objective import FastObjective
from calib_ros.registration.fast_score import FastScore
from calib_ros.registration.features import Features
from calib_ros.registration.frame_features import FrameFeatures
from calib_ros.registration.objectives import Report
from calib_ros.registration.point_score import LevelScore, PointScore
from calib_ros.registration.scores import Score
from calib_ros.registration.search import Found
from calib_ros.registration.search_box import SearchBox

Matrix = NDArray[np.float64]
Map = NDArray[np.float32]
LINEARISATION = 4  # evaluations: a slope looks the maps up four times, a value once


@dataclass(frozen=True)
class Own(Extracting):
    """The calibrator with the search box of the reach. It refuses what it does not trust."""

    objective: ClassVar[str] = "fast"
    config: Config = field(default_factory=Config)
    name: str = "ours"
    title: str = "This project: oriented edge points of the scan with edges of the image"

    def score(self, features: Sequence[Features], T_prior: Matrix) -> LevelScore:
        """The fast score on its finest level."""
        own = [f for f in features if isinstance(f, FrameFeatures)]
        return FastScore(own, T_prior, self.config.score).at(-1)

    def optimise(self, features: Sequence[Features], T: Matrix, reach: SearchBox) -> Outcome:
        """Calibrator.estimate. Its evaluations are counted one by one, whether of all points or of some, also those of its
        judgement after the optimum; a linearisation counts as LINEARISATION. The trace holds what was better on the finest level
        after the search and after each level of the climb. Too few points near the image are a refusal, with no score (NaN)."""
        try:
            trace = _Trace(self.score(features, T), T)
        except TooFewFeaturesError as error:
            return Outcome(T, np.nan, 0, (Step(0, 0.0, T),), str(error))
        calibrator = Calibrator(features[0].camera, self._extraction.config, self._extraction.segmentation)
        calibrator.fast_form = partial(_TracedObjective, trace)
        result = calibrator.estimate(features, T, reach)
        refused = "" if result.converged else result.reason
        score = result.score if result.converged else result.initial_score
        return Outcome(result.T_camera_lidar, score, trace.evaluations, tuple(trace.steps), refused)


class _Trace:
    """Counts evaluations and notes extrinsics that are better by a score of its own, which does not count."""

    def __init__(self, score: Score, T: Matrix) -> None:
        self._score, self._best, self._started = score, score.value(T), time.process_time()
        self.evaluations, self.steps = 0, [Step(0, 0.0, T)]

    def note(self, T: Matrix) -> None:
        spent, value = time.process_time() - self._started, self._score.value(T)
        if value > self._best:
            self._best = value
            self.steps.append(Step(self.evaluations, spent, T))


class _CountedScore(FastScore):
    """The fast score; its copies count on the same trace."""

    def __init__(self, trace: _Trace, *args: Any, **kwargs: Any) -> None:
        self._trace = trace
        super().__init__(*args, **kwargs)

    def sample(self, T: Matrix, level: int) -> Map:
        self._trace.evaluations += 1
        return super().sample(T, level)

    def jacobian(self, T: Matrix, level: int) -> Map:
        self._trace.evaluations += LINEARISATION
        return super().jacobian(T, level)

    def values(self, transforms: Matrix, level: int) -> Matrix:
        return self._many(super().values, transforms, level)

    def frame_values(self, transforms: Matrix, level: int) -> Matrix:
        return self._many(super().frame_values, transforms, level)

    def _many(self, values: Any, transforms: Matrix, level: int) -> Matrix:
        before = self._trace.evaluations
        out = values(transforms, level)
        self._trace.evaluations = before + len(transforms)  # whether or not it samples them one by one
        return np.asarray(out)


class _TracedObjective(FastObjective):
    """The fast form that tells where it is after the search and after each level of a climb."""

    def __init__(self, trace: _Trace, *args: Any, **kwargs: Any) -> None:
        self._trace = trace
        super().__init__(*args, **kwargs)

    def scored(self, T: Matrix, atlas: Atlas | None, margin: float | None = None) -> PointScore:
        return _CountedScore(self._trace, self.features, T, self.config.score, margin, atlas)

    def search(self, T: Matrix, box: SearchBox, report: Report) -> Found:
        found = super().search(T, box, report)
        self._trace.note(found.T)
        return found

    def _ascent(self, score: PointScore, level: int, T: Matrix) -> Matrix:
        T = super()._ascent(score, level, T)
        self._trace.note(T)
        return T
