"""The first guess: hypotheses from centroids and from a sweep, judged and refined on the class maps (thesis 3.5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from calib_ros.config import GuessConfig
from calib_ros.errors import BadInputError, TooFewFeaturesError
from calib_ros.registration.first_guess.centroids import centroid_poses, possible_pairs
from calib_ros.registration.first_guess.class_score import judged, spread
from calib_ros.registration.first_guess.class_view import ClassView
from calib_ros.registration.first_guess.placed import AROUND_DEG, climbed, distinct, placed
from calib_ros.registration.first_guess.poses import allowed, apart_deg, poses
from calib_ros.registration.point_score import PointScore

Matrix = NDArray[np.float64]
CENTROIDS, SWEEP = "centroids", "sweep"
SWEEP_POSES = 4096  # a power of two, as Sobol's sequence wants it
SWEEP_POINTS, COARSE_POINTS, FINE_POINTS = 1000, 2000, 12000
STARTS, CLIMBED = 40, 15  # of all hypotheses, those that climb the coarsest level, and of these those that climb on
SAME_DEG = (6.0, 2.0, 1.0)  # hypotheses nearer than this are one: before they climb, after the coarsest level, at the end
OTHER_WAY_DEG = 2 * AROUND_DEG  # nearer hypotheses are places of one direction


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A guess of T_camera_lidar.

    T: (4, 4). score: of the class maps, 0 = as good as chance; mean log likelihood ratio of the points in view, times the root
    of their share. margin: by how much it beats the next hypothesis that looks another way. kind: "centroids" or "sweep", where
    it came from. inliers: objects of the images that meet one of their class in the cloud.
    """

    T: Matrix
    score: float
    margin: float
    kind: str
    inliers: int


def first_guess(views: Sequence[ClassView], config: GuessConfig | None = None, seed: int = 0) -> list[Hypothesis]:
    """Hypotheses of the extrinsic that all views have in common, best first; at least one.

    Nothing is known of the yaw; tilt and distance are limited by config. Deterministic for a seed. BadInputError for views of
    different cameras; TooFewFeaturesError if they show too little in common, or nothing of it meets.
    """
    config = config or GuessConfig()
    if not views:
        raise TooFewFeaturesError("a first guess needs at least one frame with classes of pixels and points; there is none")
    if any(view.camera != views[0].camera for view in views):
        raise BadInputError("the frames for a first guess are of different cameras; give only frames of one camera")
    views = spread(views)
    score = judged(views)
    pairs = possible_pairs(views, config)
    voted, swept = centroid_poses(pairs, views[0].camera.K, config, seed), _sweep(score, config, seed)
    starts = np.concatenate([voted, swept])
    kinds = np.array([CENTROIDS] * len(voted) + [SWEEP] * len(swept))
    T, kinds = _climbed(score, starts, kinds, config, seed)
    T, values, source = placed(score, T, config, seed) if len(T) else (T, np.zeros(0), np.zeros(0, np.intp))
    kinds = kinds[source]
    if not len(T):
        raise TooFewFeaturesError(
            f"no extrinsic within {config.tilt_deg:g} deg of level and {config.distance_m:g} m of the LiDAR brings the classes "
            "of points and pixels together; check labels, topics and time stamps, or use more frames"
        )
    return [
        Hypothesis(T[k], float(values[k]), _margin(T[k:], values[k:]), str(kinds[k]), pairs.inliers(T[k]))
        for k in range(min(len(T), config.candidates))
    ]


def _margin(T: Matrix, values: Matrix) -> float:
    """Of the first over the next one that looks another way."""
    others = values[apart_deg(T, T[0]) > OTHER_WAY_DEG]
    return float(values[0] - (others[0] if len(others) else 0.0))


def _sweep(score: PointScore, config: GuessConfig, seed: int) -> Matrix:
    """The best of many allowed extrinsics, by the coarsest level (k, 4, 4)."""
    unit = qmc.Sobol(6, seed=seed).random(SWEEP_POSES) * 2 - 1
    tilt, reach = np.deg2rad(config.tilt_deg), config.distance_m / np.sqrt(3)
    transforms = poses(np.pi * unit[:, 0], tilt * unit[:, 1], tilt * unit[:, 2], reach * unit[:, 3:])
    transforms = transforms[allowed(transforms, config)]
    values = score.subset(SWEEP_POINTS, np.random.default_rng(seed)).values(transforms, 0)
    return transforms[np.argsort(-values, kind="stable")[: 8 * STARTS]]


def _climbed(
    score: PointScore, starts: Matrix, kinds: NDArray[np.str_], config: GuessConfig, seed: int
) -> tuple[Matrix, NDArray[np.str_]]:
    """The optima that the starts (k, 4, 4) lead to, level by level, best first: extrinsics and kinds (k,)."""
    rng = np.random.default_rng(seed)
    parts = [score.subset(n, rng) for n in (COARSE_POINTS, COARSE_POINTS, FINE_POINTS)]
    T, kept = starts, distinct(starts, parts[0].values(starts, 0), SAME_DEG[0])[:STARTS]
    values = np.zeros(len(starts))
    for level, part in enumerate(parts):
        T, kinds = T[kept], kinds[kept]
        T = np.array([climbed(part.at(level), level, own, config) for own in T]).reshape(-1, 4, 4)
        inside = allowed(T, config)
        T, kinds = T[inside], kinds[inside]
        finer = min(level + 1, score.n_levels - 1)
        values = parts[finer].values(T, finer) if len(T) else np.zeros(0)
        kept = distinct(T, values, SAME_DEG[min(level + 1, 2)])[:CLIMBED]
    kept = kept[values[kept] > 0]  # the others bring nothing together, or look past everything
    return T[kept], kinds[kept]
