"""The default method of this project: the fast form, searched, optimised and validated by the calibrator."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import Config
from calib_ros.errors import TooFewFeaturesError
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.score.fast_score import FastScore
from calib_ros.registration.score.point_score import LevelScore, PointScore
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
        calibrator = Calibrator(features[0].camera, self._extractors.config, self._segmentation)
        with counted() as count:
            if calibrator.classes_in_doubt_only:
                plain = [f.plain or f for f in features]
                result = calibrator.estimate_in_doubt(plain, lambda: (features, ()), T, reach)
            else:
                result = calibrator.estimate(features, T, reach)
        return Outcome(result.T_camera_lidar, count[0], "" if result.converged else result.reason)


@contextmanager
def counted() -> Iterator[list[int]]:
    """Counts evaluations of fast scores meanwhile: a list of their number."""
    count = [0]

    def counting(name: str, cost: int) -> Callable[..., Any]:
        def call(score: FastScore, transforms: Matrix, *args: Any) -> Any:
            count[0] += cost * (len(transforms) if transforms.ndim == 3 else 1)
            return getattr(PointScore, name)(score, transforms, *args)

        return call

    slopes = dict.fromkeys(("jacobian", "linearise", "gradients"), LINEARISATION)
    costs = {**dict.fromkeys(("sample", "values", "frame_values"), 1), **slopes}
    for name, cost in costs.items():
        setattr(FastScore, name, counting(name, cost))
    try:
        yield count
    finally:
        for name in costs:
            delattr(FastScore, name)
