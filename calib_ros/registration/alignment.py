"""The steps of an estimate: optimise, leave outlier frames out, compare with the start, covariance and observability.

`Calibrator.estimate` takes them and then validates what they lead to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib_ros.arrays import Covariance, Matrix, Transform
from calib_ros.registration.acceptance.significance import NullDistribution, null_distribution
from calib_ros.registration.covariance import Direction, covariance, fused, unobservable_directions
from calib_ros.registration.objective import Objective, penalised
from calib_ros.registration.progress import SILENT, Progress
from calib_ros.registration.search.constraints import SearchBox
from calib_ros.registration.search.search import SearchResult

UNOBSERVABLE_DEG, UNOBSERVABLE_M = 1.0, 0.3  # standard deviations beyond which a direction counts as unobservable
NEGLIGIBLE = 3e-5  # of the score: what steps of a thousandth of a degree leave of an optimum
OUTLIER_ROUNDS = 3  # an outlier frame may hide another


@dataclass(frozen=True, eq=False)
class Alignment:
    """An optimum T (4, 4) without the outlier frames, whose indices are in `outliers`. null: the null distribution around T."""

    T: Transform
    outliers: tuple[int, ...]
    null: NullDistribution


@dataclass(frozen=True, eq=False)
class ObservablePose:
    """An extrinsic T (4, 4), its covariance (6, 6), and the directions that no scene shows, along which T is the start."""

    T: Transform
    covariance: Covariance
    unobservable: tuple[Direction, ...] = ()


def optimise(
    objective: Objective, initial: Transform, box: SearchBox | None, progress: Progress = SILENT
) -> tuple[Matrix, SearchResult | None]:
    """The optimum (4, 4) from a global search in a box around the initial extrinsic, or from that itself; and the search."""
    if box is None or box.is_empty:
        return objective.optimise(initial, searched=False, progress=progress), None
    search = objective.edges.search(initial, box, progress)
    return objective.optimise(search.T, searched=True, progress=progress), search


def reject_outlier_frames(objective: Objective, T: Transform, progress: Progress = SILENT) -> Alignment:
    """The optimum without the frames that match no better than chance there: one bad frame must not spoil it. The
    objective leaves them out from then on."""
    outliers: list[int] = []
    null = null_distribution(objective.edges.score, T)
    for _ in range(OUTLIER_ROUNDS):
        bad = null.outlier_frames()
        if not len(bad):
            break
        outliers += [int(j) for j in bad]
        objective.exclude(bad)
        T = objective.optimise(T, searched=True, progress=progress)
        null = null_distribution(objective.edges.score, T)
    return Alignment(T, tuple(sorted(outliers)), null)


def refine_start(objective: Objective, alignment: Alignment, start: Transform, progress: Progress = SILENT) -> Alignment:
    """The alignment; or, if it scores less than the start, the better of it and the optimum right at the start.

    The coarse levels move a correct start slightly, and with few frames sometimes to another optimum: 9 of
    25 runs of 5 consecutive KITTI frames from the true extrinsic ended on one that scores less than the start.
    """
    T = alignment.T
    if not penalised(objective, T) < penalised(objective, start):
        return alignment
    near = objective.refine(start, progress)
    better = near if penalised(objective, near) >= penalised(objective, T) else T
    alignment = reject_outlier_frames(objective, better, progress)
    missing = penalised(objective, start) - penalised(objective, alignment.T)
    return replace(alignment, T=start) if 0 < missing < NEGLIGIBLE else alignment


def observable_pose(
    objective: Objective, T: Transform, start: Transform, reach: Matrix, inflated: float, others: Sequence[Matrix] = ()
) -> ObservablePose:
    """The optimum T (4, 4) with its covariance; directions that no scene shows are kept from the start.

    reach: (6,) rad and m, how far from the start the extrinsic is expected: the standard deviations of a start that is fused.
    inflated: factor of the variance. others: optima (4, 4) nearby.
    """
    score, constraints, held = objective.smooth_score(T), objective.constraints, np.zeros(6)
    bias = objective.systematic_error
    C = covariance(score, T, systematic_error=bias, constraints=constraints, inflation=inflated, others=others)
    active = constraints.active_limits(T, score.at(-1).linearise(T)[0])
    if active.any():
        # At a limit the score is not at its maximum and its curvature means nothing: the limit gives the variance of that axis.
        held = np.where(active, np.minimum(np.diag(C), constraints.limits.half**2), 0.0)
        limits = replace(constraints.limits, half=np.where(active, 0.0, constraints.limits.half))
        constraints = replace(constraints, limits=limits)
        C = covariance(score, T, systematic_error=bias, constraints=constraints, inflation=inflated, others=others)
    optimum = ObservablePose(T, C + np.diag(held))
    unobservable = unobservable_directions(C, UNOBSERVABLE_DEG, UNOBSERVABLE_M)
    if not unobservable:
        return optimum
    kept, narrower = fused(T, C, start, np.diag(np.square(reach) * constraints.limits.open_axes))
    kept = objective.constraints.limits.clip(kept)  # composed rotations and translations exceed them by terms of second order
    if penalised(objective, kept) < penalised(objective, start):  # the score does observe them farther from the optimum
        return optimum
    return ObservablePose(kept, narrower + np.diag(held), tuple(unobservable))
