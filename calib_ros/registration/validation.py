"""Is an optimum a calibration, or only the best of many chance alignments? And does every frame agree with it?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from calib_ros import se3
from calib_ros.errors import TooFewFeaturesError
from calib_ros.registration.score import PointScore
from calib_ros.registration.semantic_init.score import judged, spread
from calib_ros.registration.semantic_init.view import ClassView

MIN_SCORE = 0.15  # a search in pictures of noise finds 0.05-0.15; calibrations score 0.23-1.3 (KITTI from 1 frame, synthetic)
NEIGHBOURS = 128
HALF_WIDTH = np.array([np.deg2rad(6.0)] * 3 + [0.5] * 3)  # rad, m; edges move by tens of pixels: nothing matches but by chance
POINTS = 15000  # edge points used, so that many frames do not cost more
# Standing out of a frame, as a share of the median of all. Frames of the right image 0.6 to 2.5 (one of 42, a poor scene, 0.25),
# of another scene's image -0.12 to 0.2 on KITTI and synthetic drives.
OUTLIER_SHARE = 0.35
MATCHING = 2.5  # median of the frames' standing out below which none matches, and none can judge
JUDGES = 4  # frames needed to tell which of them disagrees
ALONE = 0.09  # a single frame must stand out by this much more: 61 of 67 right optima of one frame do, 1 of 13 wrong ones


def required_peak_ratio(min_peak_ratio: float, n_frames: int) -> float:
    """What an optimum of n frames has to reach."""
    return min_peak_ratio * (1 + ALONE / max(n_frames, 1))


@dataclass(frozen=True, eq=False)
class NullDistribution:
    """The score at an extrinsic against those of extrinsics spread around it.

    distinctness: the score over the 99th percentile of theirs; no unit. standing_out: (n_frames,) for every frame alone, how
    many of their standard deviations its score lies above their mean; NaN for a frame without points.

    Unlike the score itself both compare across scenes and sensors: a picture full of edges scores high anywhere. Measured
    with 3 and more frames on KITTI and synthetic streets of 16 and 64 rings: distinctness of calibrations 2.0 to 5.6, of the
    best optimum for images of other scenes or looking elsewhere 1.1 to 2.0 (with 6 and more frames 2.4 to 4.0 against 1.1 to
    1.9).
    """

    peak_ratio: float
    z_scores: NDArray[np.float64]

    def outlier_frames(self) -> NDArray[np.intp]:
        """Frames that match no better than chance where the others match well: paired wrongly, or a covered lens."""
        z = self.z_scores
        if np.isfinite(z).sum() < JUDGES or np.nanmedian(z) < MATCHING:
            return np.zeros(0, np.intp)
        with np.errstate(invalid="ignore"):
            return np.flatnonzero(z < OUTLIER_SHARE * np.nanmedian(z))


def null_distribution(score: PointScore, T: NDArray[np.float64]) -> NullDistribution:
    """What is around T (4, 4), on the finest level."""
    part = score.subset(POINTS, np.random.default_rng(0))
    transforms = np.concatenate([[T], null_poses(T)])
    of_frames = part.frame_values(transforms, part.n_levels - 1)
    share = np.bincount(part.frame, part.weights, part.n_frames)
    of_all = np.nan_to_num(of_frames) @ share
    here, others = of_frames[0], of_frames[1:]
    # A picture without any edge scores 0 everywhere: it stands out by nothing.
    z_scores = (here - others.mean(axis=0)) / np.maximum(others.std(axis=0), 1e-6)
    return NullDistribution(float(of_all[0]) / max(float(np.percentile(of_all[1:], 99)), 1e-3), z_scores)


def null_poses(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """Extrinsics (NEIGHBOURS, 4, 4) spread around T (4, 4), so far off that nothing matches but by chance."""
    return np.asarray(_twists() @ T)


def chance(value: float, found: NullDistribution, needed: float, since: str = "") -> str:
    """Why an optimum of score `value` is no better than chance finds in pictures as rich in edges; empty if it is. since: what
    else speaks against it."""
    if not value >= MIN_SCORE:
        return (
            f"score {value:.2f} is below {MIN_SCORE:g}: the image shows nothing where the LiDAR sees edges; "
            "check exposure, lens, topics and time stamps"
        )
    if found.peak_ratio >= needed:
        return ""
    against = f", since {since}" if since else ""
    return (
        f"the optimum stands out {found.peak_ratio:.2f}-fold from its surroundings, {needed:.2f}-fold is needed{against}: "
        "LiDAR and image do not match here; use more scenes, widen the search, or check intrinsics, topics and time stamps"
    )


@cache
def _twists() -> NDArray[np.float64]:
    return se3.exp_many((qmc.Sobol(6, seed=0).random(NEIGHBOURS) * 2 - 1) * HALF_WIDTH)


# Classes as a second witness: do labelled points meet pixels of their class at the optimum that the edges have chosen?
Matrix = NDArray[np.float64]
# Share of the extrinsics around that meet the classes better, and standard deviations above their mean. With the network of the
# package, on single KITTI frames of two drives: of 43 right optima 34 agree and 3 disagree, whose edges leave no doubt; of 74
# wrong ones, in boxes beside the truth and in pictures of other places, 11 agree, 7 of them within 3.5 deg, and 39 disagree
# (searched with borders of classes blended in by 0.2).
AGREES, STANDS_OUT = 0.02, 1.5
CLASSES_DISAGREE = 0.15
# Of the distinctness of the edges that is needed. Of these optima the edges alone accept 41 right and 8 wrong ones, with the
# classes 43 and 9.
FACTOR_CONSISTENT, FACTOR_INCONSISTENT = 0.8, 1.2


def semantic_consistency_score(views: Sequence[ClassView]) -> PointScore | None:
    """The score of the classes of frames; None where they show too little in common."""
    try:
        return judged(spread(views)) if views else None
    except TooFewFeaturesError:
        return None


def is_borderline(peak_ratio: float) -> bool:
    """Whether the classes can change the verdict. distinctness: as a share of what is needed without them."""
    return FACTOR_CONSISTENT <= peak_ratio < FACTOR_INCONSISTENT


def peak_ratio_factor(witness: PointScore | None, T: Matrix) -> float:
    """The factor on the distinctness that T_camera_lidar (4, 4) needs, by what the classes say of it; 1.0 without a witness."""
    if witness is None:
        return 1.0
    level = witness.n_levels - 1
    here, others = witness.at(level).value(T), witness.values(null_poses(T), level)
    beaten_by = float((others > here).mean())
    if beaten_by <= AGREES and here - others.mean() >= STANDS_OUT * others.std():
        return FACTOR_CONSISTENT
    return FACTOR_INCONSISTENT if beaten_by > CLASSES_DISAGREE else 1.0


def objection(factor: float) -> str:
    """What a refusal says of a factor on the distinctness needed; empty where classes do not speak against the optimum."""
    return "few labelled points meet pixels of their class there" if factor > 1 else ""
