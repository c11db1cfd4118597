"""What the calibrator knows of an objective: the fast form and the thesis's eq. 3.12 behind one interface."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import Config
from calib_ros.registration.constraints import Known
from calib_ros.registration.optimizers import barzilai_borwein, levenberg_marquardt, nelder_mead
from calib_ros.registration.point_score import PointScore
from calib_ros.registration.scores import Score, SmoothScore
from calib_ros.registration.search import Found
from calib_ros.registration.search_box import SearchBox

Matrix = NDArray[np.float64]
Report = Callable[[str, float], None]
FIRST_STEP_DEG = 3.2  # of simplexes and ascents on the coarsest level of a smooth score; half of it on the next, and so on
NEAR = (1, 2)  # levels to begin with, near the optimum
AFTER_SEARCH = 3  # the level to go on with after a search


class Objective(Protocol):
    """What is maximised, and how. T is T_camera_lidar (4, 4) throughout; report(stage, 0..1) tells progress.

    floor: standard deviations (6,) of its bias, rad and m. known: limits and prior, which search and ascents obey.
    """

    floor: Matrix
    known: Known

    def value(self, T: Matrix) -> float:
        """The score."""
        ...

    def frame_scores(self, T: Matrix) -> Matrix:
        """The score frame by frame (n_frames,)."""
        ...

    def search(self, T: Matrix, box: SearchBox, report: Report) -> Found:
        """The best extrinsic in a box around T, to be climbed from."""
        ...

    def climb(self, T: Matrix, searched: bool, report: Report) -> Matrix:
        """The optimum uphill from T. searched: T is the result of a search, and near."""
        ...

    def stay(self, T: Matrix, report: Report) -> Matrix:
        """The optimum right at T, on the finest level alone."""
        ...

    def smooth(self, T: Matrix) -> PointScore:
        """A score with a slope that equals, or approximates, the objective near T: for the covariance."""
        ...

    def drop(self, frames: NDArray[np.intp]) -> None:
        """Leave frames out from now on."""
        ...

    def match(self) -> PointScore:
        """The fast score, which tells whether LiDAR and image match at all."""
        ...

    def doubt(self, T: Matrix, report: Report) -> str:
        """Why the optimum T may be no calibration; empty if nothing speaks against it."""
        ...


@dataclass(frozen=True, eq=False)
class WithPrior:
    """A score less the cost of a prior, for optimisers that know of no prior; a Score."""

    score: Score
    known: Known

    def value(self, T: Matrix) -> float:
        """At T (4, 4)."""
        return self.score.value(T) - self.known.cost(T)


def smooth_ascent(
    score: SmoothScore, T: Matrix, step_deg: float, config: Config, known: Known, tolerance_deg: float = 0.001
) -> Matrix:
    """By the configured optimiser, which is Levenberg-Marquardt where nothing is asked for."""
    evaluations, prior = 4 * config.search.simplex_evaluations, known.prior
    if config.refine.optimizer == "nelder_mead":
        return nelder_mead(score, T, step_deg, evaluations, None if prior is None else prior.value, known.limits)[0]
    if config.refine.optimizer == "barzilai_borwein":
        return barzilai_borwein(WithPrior(score, known), T, step_deg, evaluations=evaluations, limits=known.limits)[0]
    return levenberg_marquardt(score, T, config.refine.iterations, prior, known.limits, tolerance_deg, near=True)[0]
