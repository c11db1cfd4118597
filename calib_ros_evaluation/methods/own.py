"""The default method of this project: the fast form, searched, optimised and validated by the calibrator."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import Config
from calib_ros.errors import TooFewFeaturesError
from calib_ros.frame import Frame
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.constraints import SearchBox
from calib_ros.registration.features import FeatureExtractor, Features, FrameFeatures
from calib_ros.registration.optimizers import nelder_mead
from calib_ros.registration.score import FastScore, LevelScore, Score
from calib_ros.semantics.edge_classes import frame_weights
from calib_ros.semantics.segmentation import Segmentation
from calib_ros.thesis.features import ThesisFeatures
from calib_ros.thesis.score import ThesisLevelScore, ThesisScore
from calib_ros_evaluation.methods.method import Outcome, Step, Watched, typical_step_deg, within

Matrix = NDArray[np.float64]
LINEARISATION = 4  # evaluations: a slope looks the maps up four times, a value once


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
        semantics = self.segmentation(frame) if self.segmentation.active else None
        if semantics is not None:
            self.problems += [line for line in semantics.problems if line not in self.problems]
        return self._extract(frame, semantics)


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
        after the search and after each level of the optimisation. Too few points near the image are a refusal, with no
        score (NaN)."""
        try:
            trace = _Trace(self.score(features, T), T)
        except TooFewFeaturesError as error:
            return Outcome(T, np.nan, 0, (Step(0, 0.0, T),), str(error))
        calibrator = Calibrator(features[0].camera, self._extraction.config, self._extraction.segmentation, trace)
        result = calibrator.estimate(features, T, reach)
        refused = "" if result.converged else result.reason
        score = result.score if result.converged else result.initial_score
        return Outcome(result.T_camera_lidar, score, trace.evaluations, tuple(trace.steps), refused)


class _Trace:
    """An observer that counts evaluations and notes extrinsics that are better by a score of its own, which does not count."""

    def __init__(self, score: Score, T: Matrix) -> None:
        self._score, self._best, self._started = score, score.value(T), time.process_time()
        self.evaluations, self.steps = 0, [Step(0, 0.0, T)]

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
            self.steps.append(Step(self.evaluations, spent, T))


@dataclass(frozen=True)
class Thesis(Extracting):
    """Eq. 3.12 with the edges of the dense maps found anew at every evaluation, maximised from the start itself.

    first_step: size of the first simplex, as a share of the reach; with 0.8, single KITTI frames wander farther. It is halved on
    each next smoothing. ``thesis.evaluations`` limits the evaluations of a smoothing. Nothing beyond the reach is tried.
    """

    objective: ClassVar[str] = "thesis"
    config: Config = field(default_factory=Config)
    first_step: float = 0.4
    name: str = "thesis"
    title: str = "Thesis: edges of depth, reflectivity and objects with edges and classes of the image"

    def score(self, features: Sequence[Features], T_prior: Matrix) -> ThesisLevelScore:
        """J at the last, finest smoothing; over frames the mean by their weights w_j, eq. 3.16, alike without classes."""
        return self._scores(features, T_prior).at(-1)

    def _scores(self, features: Sequence[Features], T_prior: Matrix) -> ThesisScore:
        own = [f for f in features if isinstance(f, ThesisFeatures)]
        return ThesisScore(own, T_prior, self._extraction.config, frame_weights([f.fast.importance for f in own]).tolist())

    def optimise(self, features: Sequence[Features], T: Matrix, reach: SearchBox) -> Outcome:
        """Smoothing after smoothing. The trace holds what was better on the smoothing of its time; the outcome's score is that
        on the last one."""
        scores, limits = self._scores(features, T), within(T, reach)
        step, evaluations = self.first_step * typical_step_deg(reach), self.config.thesis.evaluations
        watched = Watched(scores.at(0))
        for level in range(scores.n_levels):
            watched.score, watched.best = scores.at(level), -np.inf
            T, _ = nelder_mead(watched, T, step / 2**level, evaluations, limits=limits)
        return watched.outcome(T)
