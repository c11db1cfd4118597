"""Is an optimum a calibration, or only the best of many chance alignments? And do all frames agree with it?

The score at the optimum is compared with a null distribution: the scores of extrinsics so far off that edges match by chance
only. In doubt, the classes of points and pixels decide whether the optimum is consistent with them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from calib_ros import se3
from calib_ros.config import RefineConfig
from calib_ros.errors import TooFewFeaturesError
from calib_ros.registration.constraints import SearchBox
from calib_ros.registration.refusal import LowPeakRatio, LowScore, TooFarFromStart, WorseThanStart
from calib_ros.registration.score import PointScore
from calib_ros.registration.semantic_init.score import label_score, select_views
from calib_ros.registration.semantic_init.view import ClassView

Matrix = NDArray[np.float64]

# The null distribution.
NEIGHBOURS = 128
HALF_WIDTH = np.array([np.deg2rad(6.0)] * 3 + [0.5] * 3)  # rad, m; edges move by tens of pixels: nothing matches but by chance
POINTS = 15000  # edge points used, so that many frames do not cost more

# What an optimum has to reach.
MIN_SCORE = 0.15  # a search in pictures of noise finds 0.05-0.15; calibrations score 0.23-1.3 (KITTI from 1 frame, synthetic)
ONE_FRAME_MARGIN = 0.09  # the peak ratio of one frame must be this share higher: 61 of 67 right optima are, 1 of 13 wrong ones

# Outlier frames. z-score of a frame as a share of the median of all: frames of the right image 0.6 to 2.5 (one of 42, a poor
# scene, 0.25), of another scene's image -0.12 to 0.2 on KITTI and synthetic drives.
OUTLIER_SHARE = 0.35
MIN_MEDIAN_Z = 2.5  # median z-score below which no frame matches, and none can judge the others
MIN_JUDGING_FRAMES = 4  # frames needed to tell which of them is an outlier

# Semantic consistency: share of the null distribution that meets the classes better, and standard deviations above its mean.
# With the network of the package, on single KITTI frames of two drives: of 43 right optima 34 are consistent and 3 are not, whose
# edges leave no doubt; of 74 wrong ones, in boxes beside the truth and in pictures of other places, 11 are consistent, 7 of them
# within 3.5 deg, and 39 are not (searched with borders of classes blended in by 0.2).
CONSISTENT_RANK, CONSISTENT_Z = 0.02, 1.5
INCONSISTENT_RANK = 0.15
# Factors on the required peak ratio. Of these optima the edges alone accept 41 right and 8 wrong ones, with the classes 43 and 9.
FACTOR_CONSISTENT, FACTOR_INCONSISTENT = 0.8, 1.2


@dataclass(frozen=True, eq=False)
class NullDistribution:
    """The score at an extrinsic against the scores of extrinsics spread around it.

    peak_ratio: the score over the 99th percentile of theirs; no unit. z_scores: (n_frames,) for every frame alone, how many of
    their standard deviations its score lies above their mean; NaN for a frame without points.

    Unlike the score itself both compare across scenes and sensors: a picture full of edges scores high anywhere. Measured
    with 3 and more frames on KITTI and synthetic streets of 16 and 64 rings: peak ratios of calibrations 2.0 to 5.6, of the
    best optimum for images of other scenes or looking elsewhere 1.1 to 2.0 (with 6 and more frames 2.4 to 4.0 against 1.1 to
    1.9).
    """

    peak_ratio: float
    z_scores: Matrix

    def outlier_frames(self) -> NDArray[np.intp]:
        """Frames that match no better than chance where the others match well: paired wrongly, or a covered lens."""
        z = self.z_scores
        if np.isfinite(z).sum() < MIN_JUDGING_FRAMES or np.nanmedian(z) < MIN_MEDIAN_Z:
            return np.zeros(0, np.intp)
        with np.errstate(invalid="ignore"):
            return np.flatnonzero(z < OUTLIER_SHARE * np.nanmedian(z))


def null_distribution(score: PointScore, T: Matrix) -> NullDistribution:
    """The null distribution around T_camera_lidar (4, 4), on the finest level."""
    part = score.subset(POINTS, np.random.default_rng(0))
    transforms = np.concatenate([[T], null_extrinsics(T)])
    of_frames = part.frame_values(transforms, part.n_levels - 1)
    share = np.bincount(part.frame, part.weights, part.n_frames)
    of_all = np.nan_to_num(of_frames) @ share
    here, others = of_frames[0], of_frames[1:]
    # A picture without any edge scores 0 everywhere: its z-score is 0.
    z_scores = (here - others.mean(axis=0)) / np.maximum(others.std(axis=0), 1e-6)
    return NullDistribution(float(of_all[0]) / max(float(np.percentile(of_all[1:], 99)), 1e-3), z_scores)


def null_extrinsics(T: Matrix) -> Matrix:
    """Extrinsics (NEIGHBOURS, 4, 4) spread around T (4, 4), so far off that nothing matches but by chance."""
    return np.asarray(_twists() @ T)


@cache
def _twists() -> Matrix:
    return se3.exp_many((qmc.Sobol(6, seed=0).random(NEIGHBOURS) * 2 - 1) * HALF_WIDTH)


def check_distance(initial: Matrix, T: Matrix, box: SearchBox | None, config: RefineConfig) -> TooFarFromStart | None:
    """Is T (4, 4) farther from the initial extrinsic than a refinement, or a search in `box`, is meant to reach?"""
    deg, m = se3.rotation_error_deg(initial, T), se3.translation_error_m(initial, T)
    max_deg, max_m = config.max_rotation_deg, config.max_translation_m
    if box is not None and not box.is_empty:  # corners of the box are sqrt(3) half widths away
        reach_deg, reach_m = box.reach
        max_deg, max_m = max(max_deg, 2 * reach_deg), max(max_m, 2 * reach_m)
    return TooFarFromStart(deg, m, max_deg, max_m) if deg > max_deg or m > max_m else None


def check_score(score: float) -> LowScore | None:
    """Is the score no more than pictures without edges reach? NaN is."""
    return None if score >= MIN_SCORE else LowScore(score, MIN_SCORE)


def check_improvement(is_worse: bool, score: float, initial_score: float) -> WorseThanStart | None:
    """Does the start score more, its prior counted?"""
    return WorseThanStart(score, initial_score) if is_worse else None


def check_peak_ratio(null: NullDistribution, required: float, factor: float = 1.0) -> LowPeakRatio | None:
    """Is the optimum no better than chance? factor: on `required`, see peak_ratio_factor."""
    if null.peak_ratio >= required * factor:
        return None
    return LowPeakRatio(null.peak_ratio, required * factor, inconsistent=factor > 1)


def required_peak_ratio(min_peak_ratio: float, n_frames: int) -> float:
    """The peak ratio that an optimum of n frames has to reach."""
    return min_peak_ratio * (1 + ONE_FRAME_MARGIN / max(n_frames, 1))


def is_borderline(share: float) -> bool:
    """Can the classes change the verdict? share: the peak ratio as a share of what is required without them."""
    return FACTOR_CONSISTENT <= share < FACTOR_INCONSISTENT


def semantic_consistency_score(views: Sequence[ClassView]) -> PointScore | None:
    """How well labelled points meet pixels of their class; None where the frames show too little in common."""
    try:
        return label_score(select_views(views)) if views else None
    except TooFewFeaturesError:
        return None


def peak_ratio_factor(consistency: PointScore | None, T: Matrix) -> float:
    """The factor on the required peak ratio at T_camera_lidar (4, 4), by how its semantic consistency compares with the null
    distribution; 1.0 without classes."""
    if consistency is None:
        return 1.0
    level = consistency.n_levels - 1
    here, others = consistency.at(level).value(T), consistency.values(null_extrinsics(T), level)
    beaten_by = float((others > here).mean())
    if beaten_by <= CONSISTENT_RANK and here - others.mean() >= CONSISTENT_Z * others.std():
        return FACTOR_CONSISTENT
    return FACTOR_INCONSISTENT if beaten_by > INCONSISTENT_RANK else 1.0
