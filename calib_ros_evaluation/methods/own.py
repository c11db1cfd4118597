"""The default method of this project: the fast form, searched, optimised and validated by the calibrator."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import Config
from calib_ros.errors import TooFewFeaturesError
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.score.point_score import FastScore, LevelScore, Score
from calib_ros.registration.search.constraints import SearchBox
from calib_ros_evaluation.methods.method import Extracting, Outcome, TracePoint

Matrix = NDArray[np.float64]
LINEARISATION = 4  # evaluations: a slope looks the maps up four times, a value once


@dataclass(frozen=True)
class Own(Extracting):
    """The calibrator with the search box of the reach. It refuses what it does not trust."""

    objective: ClassVar[str] = "fast"
    config: Config = field(default_factory=Config)
    name: str = "ours"
    title: str = "This project: oriented edge points of the scan with edges of the image"

    def score(self, features: Sequence[FrameFeatures], T_prior: Matrix) -> LevelScore:
        """The fast score on its finest level."""
        return FastScore(list(features), T_prior, self.config.score).at(-1)

    def optimise(self, features: Sequence[FrameFeatures], T: Matrix, reach: SearchBox) -> Outcome:
        """Calibrator.estimate. Its evaluations are counted one by one, whether of all points or of some, also those of its
        judgement after the optimum; a linearisation counts as LINEARISATION. The trace holds what was better on the finest level
        after the search and after each level of the optimisation. Too few points near the image are a refusal, with no
        score (NaN)."""
        try:
            trace = _Trace(self.score(features, T), T)
        except TooFewFeaturesError as error:
            return Outcome(T, np.nan, 0, (TracePoint(0, 0.0, T),), str(error))
        calibrator = Calibrator(features[0].camera, self._extraction.config, self._extraction.segmentation, trace)
        if calibrator.classes_in_doubt_only:
            plain = [f.plain or f for f in features]
            result = calibrator.estimate_in_doubt(plain, lambda: (features, ()), T, reach)
        else:
            result = calibrator.estimate(features, T, reach)
        refused = "" if result.converged else result.reason
        score = result.score if result.converged else result.initial_score
        return Outcome(result.T_camera_lidar, score, trace.evaluations, tuple(trace.steps), refused)


class _Trace:
    """An observer that counts evaluations and notes extrinsics that are better by a score of its own, which does not count."""

    def __init__(self, score: Score, T: Matrix) -> None:
        self._score, self._best, self._started = score, score.value(T), time.process_time()
        self.evaluations, self.steps = 0, [TracePoint(0, 0.0, T)]

    def evaluated(self, count: int) -> None:
        """See Observer."""
        self.evaluations += count

    def linearised(self) -> None:
        """See Observer."""
        self.evaluations += LINEARISATION

    def reached(self, T: Matrix) -> None:
        """See Observer."""
        spent, value = time.process_time() - self._started, self._score.value(T)
        if value > self._best:
            self._best = value
            self.steps.append(TracePoint(self.evaluations, spent, T))
