"""The default method of this project: the fast form, searched, optimised and validated by the calibrator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import Config
from calib_ros.errors import TooFewFeaturesError
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.score.fast_score import FastScore
from calib_ros.registration.score.point_score import LevelScore
from calib_ros.registration.search.constraints import SearchBox
from calib_ros_evaluation.methods.method import Extracting, Outcome

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
        judgement after the optimum; a linearisation counts as LINEARISATION. Too few points near the image are a refusal."""
        try:
            self.score(features, T)
        except TooFewFeaturesError as error:
            return Outcome(T, 0, str(error))
        count = _Count()
        calibrator = Calibrator(features[0].camera, self._extractors.config, self._segmentation, count)
        if calibrator.classes_in_doubt_only:
            plain = [f.plain or f for f in features]
            result = calibrator.estimate_in_doubt(plain, lambda: (features, ()), T, reach)
        else:
            result = calibrator.estimate(features, T, reach)
        return Outcome(result.T_camera_lidar, count.evaluations, "" if result.converged else result.reason)


class _Count:
    """An observer that counts evaluations."""

    evaluations = 0

    def evaluated(self, count: int) -> None:
        """See Observer."""
        self.evaluations += count

    def linearised(self) -> None:
        """See Observer."""
        self.evaluations += LINEARISATION

    def reached(self, T: Matrix) -> None:
        """See Observer."""
