"""The first guess (thesis 3.5): hypotheses of the extrinsic from the classes of points and pixels, without any prior.

They come from the centroids of objects (figure 3.20), and from a sweep over all yaws if wanted; maps of classes place them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import BadInputError, TooFewFeaturesError
from calib_ros.registration.classes import PoseHypothesis
from calib_ros.registration.initial_guess import MAX_DISTANCE_M, MAX_TILT_DEG, allowed, poses, rotation_distance_deg
from calib_ros.registration.score.chance import EvenPoints
from calib_ros.registration.score.point_score import PointScore
from calib_ros_semantics.first_guess.centroids import agreed_poses, find_pairs
from calib_ros_semantics.first_guess.score import AROUND_DEG, distinct, label_score, local_optimum, refine_positions, select_views
from calib_ros_semantics.first_guess.view import ClassView

Matrix = NDArray[np.float64]

# Hypotheses.
CANDIDATES = 5  # hypotheses kept, best first; the right one is hardly ever a later one
CENTROIDS, SWEEP = "centroids", "sweep"
SWEEP_POSES = 4096
SWEEP_POINTS, COARSE_POINTS, FINE_POINTS = 1000, 2000, 12000
STARTS, FOLLOWED = 40, 15  # of all hypotheses, those optimised on the coarsest level, and of these those that go on
SAME_DEG = (6.0, 2.0, 1.0)  # hypotheses nearer than this are one: at first, after the coarsest level, at the end
OTHER_WAY_DEG = 2 * AROUND_DEG  # nearer hypotheses are places of one direction


def first_guess(views: Sequence[ClassView], seed: int = 0, sweep: bool = True) -> list[PoseHypothesis]:
    """Hypotheses of the extrinsic that all views have in common, best first; at least one. The LiDAR's z axis points up within
    MAX_TILT_DEG, its yaw is unknown. sweep: try all yaws, whatever the centroids say.

    BadInputError for views of different cameras; TooFewFeaturesError if they show too little in common, or nothing of it meets.
    """
    if not views:
        raise TooFewFeaturesError("a first guess needs at least one frame with classes of pixels and points; there is none")
    if any(view.camera != views[0].camera for view in views):
        raise BadInputError("the frames for a first guess are of different cameras; give only frames of one camera")
    views = select_views(views)
    score = label_score(views)
    pairs = find_pairs(views)
    agreed, swept = np.empty((0, 4, 4)), _sweep(score, seed) if sweep else np.empty((0, 4, 4))
    try:
        agreed = agreed_poses(pairs, seed)
    except TooFewFeaturesError:
        if not sweep:
            raise
    starts = np.concatenate([agreed, swept])
    kinds = np.array([CENTROIDS] * len(agreed) + [SWEEP] * len(swept))
    T, kinds = _optimised(score, starts, kinds, seed)
    T, values, source = refine_positions(score, T, seed) if len(T) else (T, np.zeros(0), np.zeros(0, np.intp))
    values = values + pairs.per_object(T)
    order = np.argsort(-values, kind="stable")
    T, values, kinds = T[order], values[order], kinds[source][order]
    if not len(T):
        raise TooFewFeaturesError(
            f"no extrinsic within {MAX_TILT_DEG:g} deg of level and {MAX_DISTANCE_M:g} m of the LiDAR brings the classes "
            "of points and pixels together; check labels, topics and time stamps, or use more frames"
        )
    return [
        PoseHypothesis(T[k], float(values[k]), _margin(T[k:], values[k:]), str(kinds[k]), pairs.inliers(T[k]))
        for k in range(min(len(T), CANDIDATES))
    ]


def _margin(T: Matrix, values: Matrix) -> float:
    """Of the first over the next one of another viewing direction."""
    others = values[rotation_distance_deg(T, T[0]) > OTHER_WAY_DEG]
    return float(values[0] - (others[0] if len(others) else 0.0))


def _sweep(score: PointScore, seed: int) -> Matrix:
    """The best of many allowed extrinsics, by the coarsest level (k, 4, 4)."""
    unit = EvenPoints(6, seed=seed).next(SWEEP_POSES)
    tilt, reach = np.deg2rad(MAX_TILT_DEG), MAX_DISTANCE_M / np.sqrt(3)
    transforms = poses(np.pi * unit[:, 0], tilt * unit[:, 1], tilt * unit[:, 2], reach * unit[:, 3:])
    transforms = transforms[allowed(transforms)]
    values = score.subset(SWEEP_POINTS, np.random.default_rng(seed)).values(transforms, 0)
    return transforms[np.argsort(-values, kind="stable")[: 8 * STARTS]]


def _optimised(score: PointScore, starts: Matrix, kinds: NDArray[np.str_], seed: int) -> tuple[Matrix, NDArray[np.str_]]:
    """The optima that the starts (k, 4, 4) lead to, level by level, best first: extrinsics and kinds (k,)."""
    rng = np.random.default_rng(seed)
    parts = [score.subset(n, rng) for n in (COARSE_POINTS, COARSE_POINTS, FINE_POINTS)]
    T, kept = starts, distinct(starts, parts[0].values(starts, 0), SAME_DEG[0])[:STARTS]
    values = np.zeros(len(starts))
    for level, part in enumerate(parts):
        T, kinds = T[kept], kinds[kept]
        T = np.array([local_optimum(part.at(level), level, own) for own in T]).reshape(-1, 4, 4)
        inside = allowed(T)
        T, kinds = T[inside], kinds[inside]
        finer = min(level + 1, score.n_levels - 1)
        values = parts[finer].values(T, finer) if len(T) else np.zeros(0)
        kept = distinct(T, values, SAME_DEG[min(level + 1, 2)])[:FOLLOWED]
    kept = kept[values[kept] > 0]  # the others bring nothing together, or see nothing of the scene
    return T[kept], kinds[kept]
