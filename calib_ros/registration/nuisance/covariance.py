"""The nuisance covariance: what intrinsics and clocks leave open of an extrinsic, however many such scenes there are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib_ros.arrays import Covariance, Transform
from calib_ros.config import Config
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.nuisance.parameters import Effect, NuisanceEstimate
from calib_ros.registration.nuisance.time_offset import ClockOffset, with_known_motion
from calib_ros.registration.score.point_score import PointScore
from calib_ros.registration.search.constraints import PoseConstraints


@dataclass(frozen=True, eq=False)
class Nuisance:
    """What intrinsics and clocks leave open of an optimum. covariance: (6, 6). clocks: effect of an offset as large as
    motion.max_time_offset_s; None where the motion is not known."""

    covariance: Covariance
    clocks: Effect | None = None


def nuisance_covariance(
    features: Sequence[FrameFeatures],
    score: PointScore,
    T: Transform,
    covariance: Covariance,
    constraints: PoseConstraints,
    config: Config,
    intrinsics: Sequence[NuisanceEstimate],
    offset_sigma_s: float,
    clocks: Effect | None = None,
) -> Nuisance:
    """What intrinsics and clocks leave open of the optimum T (4, 4) of these features, whose own covariance is (6, 6).

    intrinsics: what the scenes tell of them. offset_sigma_s: standard deviation of the clocks' offset, before these scenes or
    after them. clocks: effect of the offset, if it is known.
    """
    active = constraints.active_limits(T, score.at(-1).linearise(T)[0])  # not at its maximum along these
    limits = replace(constraints.limits, half=np.where(active, 0.0, constraints.limits.half))
    shared = np.zeros((6, 6))
    if not limits.open_axes.any():
        return Nuisance(shared)
    for estimate in intrinsics:
        shared += estimate.added_covariance(constraints, covariance)
    moving = with_known_motion(features, score)
    if moving is None:
        return Nuisance(shared)
    known, offset = clocks is not None, ClockOffset(offset_sigma_s, moving[1])
    if clocks is None or active.any():  # else it is that of the same optimum
        clocks = offset.effect(moving[0], T, limits)
    effect = replace(clocks, information=0.0) if known else clocks  # these scenes count only once
    shared += offset.added_covariance(effect, constraints, covariance)
    return Nuisance(shared, clocks.constrained(constraints, covariance, config.motion.max_time_offset_s))
