"""The optimum that all frames agree on, or that lies right where the estimate started."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_ros.registration.objective import Objective, Report
from calib_ros.registration.validation import NullDistribution, null_distribution

Matrix = NDArray[np.float64]
RETRIES = 3  # a frame that disagrees may hide another


def reject_outlier_frames(objective: Objective, T: Matrix, report: Report) -> tuple[Matrix, list[int], NullDistribution]:
    """The optimum without the frames that match no better than chance, which they are, and what is around it: one bad frame
    must not spoil it."""
    left_out: list[int] = []
    around = null_distribution(objective.edge_score(), T)
    for _ in range(RETRIES):
        bad = around.outlier_frames()
        if not len(bad):
            break
        left_out += [int(j) for j in bad]
        objective.exclude(bad)
        T = objective.optimise(T, True, report)
        around = null_distribution(objective.edge_score(), T)
    return T, sorted(left_out), around


def penalised_score(objective: Objective, T: Matrix) -> float:
    """What is maximised: the score, less the cost of what is known beforehand."""
    return objective.value(T) - objective.constraints.cost(T)


def prefer_start(objective: Objective, T: Matrix, start: Matrix, report: Report) -> tuple[Matrix, list[int], NullDistribution]:
    """The optimum right at the start instead of T, if it scores no less; as without_disagreeing.

    The coarse levels lead a start that is already right a hair away, and with few frames to another optimum at times: 9 of
    25 runs of 5 consecutive KITTI frames from the true extrinsic ended on one that scores less than the start.
    """
    refine = objective.refine(start, report)
    return reject_outlier_frames(
        objective, refine if penalised_score(objective, refine) >= penalised_score(objective, T) else T, report
    )
