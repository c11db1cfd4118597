"""Is an optimum a calibration, or only the best of many chance alignments? And do all frames agree with it?

Its score is compared with a null distribution, the scores of extrinsics so far off that edges match by chance only, and with the
best optimum of the same search in a decoy. In doubt, the classes of points and pixels have a say.
"""

from __future__ import annotations

import numpy as np

from calib_ros.arrays import Covariance, Transform
from calib_ros.registration.acceptance.refusal import Refusal, low_score, not_significant, too_uncertain
from calib_ros.registration.covariance import unobservable_directions
from calib_ros.registration.score.chance import HIGHEST_DECOY_Z, UNDOUBTED_Z, null_extrinsics
from calib_ros.registration.score.point_score import PointScore
from calib_ros.result import RefusalCode, Result

WITH_90_PERCENT = 1.645  # standard deviations that a normal error exceeds in one of ten cases

# Semantic consistency: share of the null distribution that meets the classes better, and standard deviations above its mean. Of
# 43 right optima of single KITTI frames 34 are consistent and 3 inconsistent, of 74 wrong ones 11 and 39.
CONSISTENT_RANK, CONSISTENT_Z = 0.02, 1.5
INCONSISTENT_RANK = 0.15
# How much more probable the classes make a right optimum than a wrong one, from these counts.
RATIO_CONSISTENT, RATIO_INCONSISTENT = 5.0, 1 / 7.0


def check_significance(
    score: float, z_score: float, decoy_z: float | None, p: float, largest: float, ratio: float = 1.0
) -> Refusal | None:
    """Is the optimum no better than chance? p: its p value; largest: what is accepted; ratio: see semantic_likelihood_ratio.
    score: of the optimum; 0 is that of the mean of the maps, less, or NaN, of an image that shows nothing."""
    if p <= largest * ratio:
        return None
    if not score > 0:
        return low_score(score)
    return not_significant(z_score, HIGHEST_DECOY_Z if decoy_z is None else decoy_z, p, largest * ratio, ratio < 1)


def leaves_doubt(result: Result) -> bool:
    """Can classes change this result of an estimate without them? They help to find an optimum, and to tell it from chance."""
    if result.refusal in (RefusalCode.WRONG_INTRINSICS, RefusalCode.WRONG_TIMES):
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
