"""Is the optimum of an estimate to be used? What speaks for it, and the checks that may refuse it.

`refusal_of` is the acceptance test: no better than the start, other intrinsics or clocks, at the end of the trust region,
no better than chance, not known well enough, another objective elsewhere. Its limits are those of the stage ``refine``. One more
test follows elsewhere: of the node, over time (the gate of online/tracker.py).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib_ros import se3
from calib_ros.arrays import Covariance, Transform
from calib_ros.camera import Camera
from calib_ros.config import NO_LIMIT_DEG, NO_LIMIT_M, Config, MotionConfig
from calib_ros.config.sensors import FARTHEST_OFFSET_S, MAX_OFFSET_S
from calib_ros.registration.classes import consistency_score
from calib_ros.registration.covariance import disagreement, inflation, unobservable_directions
from calib_ros.registration.estimate import Alignment, Estimate
from calib_ros.registration.features import views_of
from calib_ros.registration.joint import Optimised, estimates_offset
from calib_ros.registration.judgement.clocks import refuse_clocks, with_known_motion
from calib_ros.registration.judgement.refusal import (
    Refusal,
    low_score,
    not_significant,
    objectives_disagree,
    too_far_from_start,
    too_uncertain,
    worse_than_start,
    wrong_times,
)
from calib_ros.registration.objective import Objective, penalised, trust_region
from calib_ros.registration.progress import Progress
from calib_ros.registration.score.chance import HIGHEST_DECOY_Z, UNDOUBTED_Z, null_extrinsics, p_value
from calib_ros.registration.score.point_score import PointScore
from calib_ros.registration.search.constraints import NEARLY, SearchBox
from calib_ros.registration.search.search import SearchResult, search_decoy
from calib_ros.result import Evidence, RefusalCode, Result

WITH_90_PERCENT = 1.645  # standard deviations that a normal error exceeds in one of ten cases

# Semantic consistency: share of the null distribution that meets the classes better, and standard deviations above its mean. Of
# 43 right optima of single KITTI frames 34 are consistent and 3 inconsistent, of 74 wrong ones 11 and 39.
CONSISTENT_RANK, CONSISTENT_Z = 0.02, 1.5
INCONSISTENT_RANK = 0.15
# How much more probable the classes make a right optimum than a wrong one, from these counts.
RATIO_CONSISTENT, RATIO_INCONSISTENT = 5.0, 1 / 7.0


def evidence_of(config: Config, objective: Objective, alignment: Alignment, search: SearchResult | None) -> Evidence:
    """What speaks for the optimum. Without a search, in doubt, a decoy is searched as far as a refinement goes."""
    score, limits, z_score = objective.edges.score, objective.constraints.limits, alignment.null.z_score
    decoy_z, rounds = (None, 1) if search is None else (search.decoy_z, search.rounds)
    if z_score < UNDOUBTED_Z and decoy_z is None:
        deg, m = trust_region()
        box = SearchBox(min(deg, SearchBox.MAX_DEG), min(m, SearchBox.MAX_M))
        decoy_z = search_decoy(score, alignment.T, box, config.search, limits)
    halves = disagreement(objective.smooth_score(alignment.T), alignment.T, limits)
    return Evidence(z_score, decoy_z, p_value(z_score, decoy_z, rounds), halves)


def refusal_of(found: Estimate, config: Config, camera: Camera, searched: bool, progress: Progress) -> Refusal | None:
    """Why the extrinsic of an estimate is not to be used: the first check that fails. camera: as it is stated. searched: a search
    led to it."""
    objective, T, start, limits = found.objective, found.T, found.start, found.objective.constraints.limits
    if penalised(objective, T) < penalised(objective, start):
        return worse_than_start(objective.value(T), objective.value(start))
    wrong = _check_intrinsics_and_clocks(found, config, camera, searched)
    if wrong is not None:
        return wrong
    reached, region = found.alignment.T, limits.trust_region
    # At its end the score still rises: no optimum, or one that the start does not justify.
    if region is not None:
        moved = np.abs(se3.log(reached @ se3.inverse(region.T)))
        if (moved >= NEARLY * region.half)[limits.open_axes].any():
            off = se3.error(found.initial, reached)
            return too_far_from_start(*off, float(np.rad2deg(region.half[0])), float(region.half[3]))
    wrong = _check_match(found, config.refine.max_p_value)
    # Only of a search: a refinement has a start to rely on, and is fused with it. What intrinsics and clocks leave open is
    # not asked: more scenes would not help.
    if wrong is None and searched and objective.agreement is None:
        wrong = check_uncertainty(found.covariance, config.refine.tolerance_deg, config.refine.tolerance_m)
    if wrong is None and objective.agreement is not None:
        # If the edges, begun at the optimum of another objective, end far away, one of the two is wrong.
        deg, m = se3.error(T, objective.edges.optimise(T, False, progress))
        if not (deg <= objective.agreement[0] and m <= objective.agreement[1]):
            return objectives_disagree(deg, m)
    return wrong


def _check_match(found: Estimate, largest: float) -> Refusal | None:
    """Do LiDAR and image match at the optimum better than by chance? In doubt, the classes have a say."""
    T, evidence, ratio = found.alignment.T, found.evidence, 1.0
    if largest * RATIO_INCONSISTENT < evidence.p_value <= largest * RATIO_CONSISTENT:  # they can change the verdict
        kept = [f for k, f in enumerate(found.optimised.features) if k not in found.alignment.outliers]
        ratio = semantic_likelihood_ratio(consistency_score(views_of(kept)), T)
    if evidence.p_value <= largest * ratio:
        return None
    score, decoy_z = found.objective.edges.score.at(-1).value(T), evidence.decoy_z_score
    if not score > 0:  # that of the mean of the maps; less, or NaN, is of an image that shows nothing
        return low_score(score)
    decoy_z = HIGHEST_DECOY_Z if decoy_z is None else decoy_z
    return not_significant(evidence.z_score, decoy_z, evidence.p_value, largest * ratio, ratio < 1)


def _check_intrinsics_and_clocks(found: Estimate, config: Config, camera: Camera, searched: bool) -> Refusal | None:
    """Are the intrinsics others than given, or the offset of the clocks? Where something is asked of the extrinsic."""
    optimised, objective, evidence, refine = found.optimised, found.objective, found.evidence, config.refine
    wrong, tolerance = check_offset(optimised, config.motion), (refine.tolerance_deg, refine.tolerance_m)
    limited = tolerance[0] < NO_LIMIT_DEG or tolerance[1] < NO_LIMIT_M
    if evidence.p_value > refine.max_p_value:  # where nothing matches, neither do clocks
        return None if wrong is None else replace(wrong, cause=None)
    fault = found.lens.fault(camera, *tolerance) if limited and found.lens is not None else None
    # A lens that is plainly wrong looks like other clocks, too, and those in vain: it is wrong at theirs as well.
    if fault is not None and (wrong is None or fault.code is RefusalCode.WRONG_INTRINSICS):
        return fault
    if wrong is not None or not limited:
        return wrong
    if not searched:
        return None
    moving = with_known_motion(optimised.features, objective.edges.score)
    # An offset that was found may be the best of those that were looked at only.
    if moving is not None and (optimised.seconds != 0 or not estimates_offset(optimised.features, config)):
        limits, prior_s = objective.constraints.limits, config.motion.time_offset_sigma_s
        inflated = inflation(evidence.disagreement)
        return refuse_clocks(moving[0], found.alignment.T, moving[1], limits, prior_s, tolerance, inflated)
    return None


def check_offset(optimised: Optimised, motion: MotionConfig) -> Refusal | None:
    """Is the time offset one that can be used, or does nothing near match?"""
    offset = optimised.offset
    if offset is None:
        return None
    in_all = motion.time_offset_s + optimised.seconds
    too_far = abs(optimised.seconds) > MAX_OFFSET_S or abs(in_all) > FARTHEST_OFFSET_S
    # Nobody is told of an offset that is not observable: the extrinsic would be that of other clocks.
    unobservable = optimised.seconds != 0 and not offset.observable(motion)
    if too_far or unobservable or offset.suspected(motion):
        return wrong_times(optimised.seconds if unobservable else offset.seconds, offset.gain)
    return None


def leaves_doubt(result: Result) -> bool:
    """Can classes change this result of an estimate without them? They help to find an optimum, and to tell it from chance."""
    if result.cause is not None or result.refusal in (RefusalCode.WRONG_INTRINSICS, RefusalCode.WRONG_TIMES):
        return False
    return not result.converged or result.evidence is None or result.evidence.z_score < UNDOUBTED_Z


def largest_sigmas(tolerance_deg: float, tolerance_m: float) -> tuple[float, float]:
    """Standard deviations, deg and m, of the axes of a rotation and a shift that are within the tolerance with 90 %, where the
    axes share it alike."""
    share = 1 / (WITH_90_PERCENT * np.sqrt(3))
    return share * tolerance_deg, share * tolerance_m


def check_uncertainty(covariance: Covariance, tolerance_deg: float, tolerance_m: float) -> Refusal | None:
    """Is an extrinsic of this covariance (6, 6) known to within the tolerance? Its rotation and its shift, with 90 %."""
    sigma = np.sqrt(np.diag(covariance))
    limits = largest_sigmas(tolerance_deg, tolerance_m)
    if max(np.rad2deg(np.linalg.norm(sigma[:3])) / limits[0], np.linalg.norm(sigma[3:]) / limits[1]) <= np.sqrt(3):
        return None
    return too_uncertain(unobservable_directions(covariance, *limits), tolerance_deg, tolerance_m)


def semantic_likelihood_ratio(consistency: PointScore | None, T: Transform) -> float:
    """How much more probable classes make it that T_camera_lidar (4, 4) is right, by its rank in the null distribution; 1.0
    without classes."""
    if consistency is None:
        return 1.0
    level = consistency.n_levels - 1
    here, others = consistency.at(level).value(T), consistency.values(null_extrinsics(T), level)
    beaten_by = float((others > here).mean())
    if beaten_by <= CONSISTENT_RANK and here - others.mean() >= CONSISTENT_Z * others.std():
        return RATIO_CONSISTENT
    return RATIO_INCONSISTENT if beaten_by > INCONSISTENT_RANK else 1.0
