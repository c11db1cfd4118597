"""The two methods of this project: its default, the fast form, searched, optimised and validated by the calibrator; and that of
the thesis, eq. 3.12 and 3.16, by the downhill simplex of Nelder and Mead (table 4.3); and all methods that can be compared."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import Config
from calib_ros.errors import TooFewFeaturesError
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.objective import FastScore
from calib_ros.registration.score.point_score import LevelScore, PointScore
from calib_ros.registration.search.constraints import SearchBox
from calib_ros.registration.search.optimizers import nelder_mead
from calib_ros_evaluation.methods.edges import Castorena, Levinson
from calib_ros_evaluation.methods.information import Nid, Pandey
from calib_ros_evaluation.methods.method import Extracting, Method, Outcome, Watched, search_limits, typical_step_deg
from calib_ros_evaluation.methods.mulfeat import Mulfeat
from calib_ros_thesis.config import thesis_of
from calib_ros_thesis.features import frame_weights
from calib_ros_thesis.score import ThesisLevelScore, ThesisScore

Matrix = NDArray[np.float64]
LINEARISATION = 4  # evaluations: a slope looks the maps up four times, a value once


@dataclass(frozen=True)
class Own(Extracting):
    """The calibrator with the search box of the reach. It refuses what it does not trust."""

    objective = "fast"
    name = "ours"
    title = "This project: oriented edge points of the scan with edges of the image"

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
        calibrator = Calibrator(features[0].camera, self.own_config, self.segmentation)
        with counted() as count:
            if calibrator.classes_in_doubt_only:
                plain = [f.plain or f for f in features]
                result = calibrator.again_in_doubt(calibrator.estimate(plain, T, reach), plain, lambda: (features, ()), T, reach)
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
    costs = {**dict.fromkeys(("samples", "values", "frame_values"), 1), **slopes}
    for name, cost in costs.items():
        setattr(FastScore, name, counting(name, cost))
    try:
        yield count
    finally:
        for name in costs:
            delattr(FastScore, name)


@dataclass(frozen=True)
class Thesis(Extracting):
    """Eq. 3.12 with the edges of the dense maps found anew at every evaluation, maximised from the start itself.

    first_step: size of the first simplex, as a share of the reach; with 0.8, single KITTI frames wander farther. It is halved on
    each next smoothing. ``thesis.evaluations`` limits the evaluations of a smoothing. Nothing beyond the reach is tried.
    """

    objective = "thesis"
    first_step: float = 0.4
    name = "thesis"
    title = "Thesis: edges of depth, reflectivity and objects with edges and classes of the image"

    def score(self, features: Sequence[FrameFeatures], T_prior: Matrix) -> ThesisLevelScore:
        """J at the last, finest smoothing; over frames the mean by their weights w_j, eq. 3.16, alike without classes."""
        return self._scores(features, T_prior).at(-1)

    def _scores(self, features: Sequence[FrameFeatures], T_prior: Matrix) -> ThesisScore:
        own = [f.own for f in features]
        return ThesisScore(own, T_prior, self.own_config, frame_weights([f.importance for f in own]).tolist())

    def optimise(self, features: Sequence[FrameFeatures], T: Matrix, reach: SearchBox) -> Outcome:
        """Smoothing after smoothing."""
        scores, limits = self._scores(features, T), search_limits(T, reach)
        step, evaluations = self.first_step * typical_step_deg(reach), thesis_of(self.config).evaluations
        watched = Watched(scores.at(0))
        for level in range(scores.n_levels):
            watched.score = scores.at(level)
            T, _ = nelder_mead(watched, T, step / 2**level, evaluations, limits=limits)
        return Outcome(T, watched.evaluations)


# In the order of the thesis's table 4.2, then what came after it.
METHODS = (Pandey, Levinson, Castorena, Mulfeat, Thesis, Nid, Own)
NAMES = tuple(method.name for method in METHODS)


def methods(config: Config) -> dict[str, Method]:
    """Name -> method, in the order of NAMES; all work with this configuration."""
    return {method.name: method(config=config) for method in METHODS}
