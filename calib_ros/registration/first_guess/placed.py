"""Where the camera stands, once it is known where it looks: a turn and a shift look alike on class maps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from calib_ros import se3
from calib_ros.config import GuessConfig
from calib_ros.registration.constraints import Limits, Prior
from calib_ros.registration.first_guess.in_view import InView
from calib_ros.registration.first_guess.poses import allowed, apart_deg, near_lidar
from calib_ros.registration.optimizers import levenberg_marquardt
from calib_ros.registration.point_score import PointScore
from calib_ros.registration.scores import SmoothScore

Matrix = NDArray[np.float64]
AROUND, AROUND_DEG = 512, 4.0  # places and turns tried around a hypothesis: those of 5 to 10 frames were at most 3.3 deg off
PLACES = 6  # of these, those that climb
COARSE_POINTS, FINE_POINTS = 3000, 12000
SAME_DEG, SAME_M = 2.0, 0.5  # hypotheses that are nearer than both are one
LEAST_IN_VIEW = 0.5  # of what hypotheses have in view in the middle
# Of the score per level, at a camera distance_m / 2 from the LiDAR. On coarse maps a shift hardly differs from a turn; on fine
# ones a strong prior drags: with damaged labels of 10 frames 4 of 12 guesses were nearer than 0.5 m with 0.03 on all levels, 9
# with 0.01, and 10 with these.
PRIOR_STRENGTH = (0.03, 0.01, 0.003)


def climbed(score: SmoothScore, level: int, T: Matrix, config: GuessConfig) -> Matrix:
    """The optimum that T (4, 4) leads to on a level, not far from the LiDAR."""
    limits: Limits = near_lidar(T, config)
    prior = Prior(limits.T, np.array([0.0] * 3 + [2 * PRIOR_STRENGTH[level] / (config.distance_m / 2) ** 2] * 3))
    return levenberg_marquardt(score, T, 12, prior, limits, tolerance_deg=0.02)[0]


def placed(score: PointScore, transforms: Matrix, config: GuessConfig, seed: int) -> tuple[Matrix, Matrix, NDArray[np.intp]]:
    """Hypotheses (k, 4, 4) by the points in view, from those of (j, 4, 4) and places around each: best first, their scores (k,)
    and which of the given ones each is from (k,).

    Places of one direction are compared by the mean of what is in view, directions by that mean times the root of the share in
    view at their best place: it stands out from chance as the mean of so many points does.
    """
    few, all_points = (score.subset(n, np.random.default_rng(seed)) for n in (COARSE_POINTS, FINE_POINTS))
    middle, fine = score.n_levels - 2, score.n_levels - 1
    least = LEAST_IN_VIEW * float(np.median(InView(few, middle).share(transforms)))
    parts = {level: InView(few, level, least) for level in (middle, fine)}
    found, origin = [], []
    for j, T in enumerate(transforms):
        tried = around(T, config, seed)
        order = np.argsort(-parts[middle].values(tried), kind="stable")[:PLACES]
        for own in tried[np.union1d(order, [0])]:
            for level, part in parts.items():
                own = climbed(part, level, own, config)
            found.append(own)
            origin.append(j)
    ends, source = np.array(found), np.array(origin)
    inside = allowed(ends, config)
    ends, source = ends[inside], source[inside]
    values = _standing_out(InView(all_points, fine, least), ends, source) if len(ends) else np.zeros(0)
    kept = distinct(ends, values, SAME_DEG, SAME_M)
    kept = kept[values[kept] > 0]  # the others look past everything
    return ends[kept], values[kept], source[kept]


def _standing_out(view: InView, ends: Matrix, source: NDArray[np.intp]) -> Matrix:
    """The scores (k,) of ends (k, 4, 4), those of one source compared by their means."""
    values, share = view.values(ends), view.share(ends)
    for j in np.unique(source):
        own = np.flatnonzero(source == j)
        values[own] *= np.sqrt(share[own[np.argmax(values[own])]])
    return values


def around(T: Matrix, config: GuessConfig, seed: int) -> Matrix:
    """T (4, 4), and extrinsics that look about the same way from anywhere near the LiDAR (k, 4, 4)."""
    unit = qmc.Sobol(6, seed=seed).random(AROUND) * 2 - 1
    out = se3.exp_many(np.pad(np.deg2rad(AROUND_DEG) * unit[:, :3], ((0, 0), (0, 3)))) @ se3.from_parts(T[:3, :3], np.zeros(3))
    out[:, :3, 3] = -np.einsum("kij,kj->ki", out[:, :3, :3], config.distance_m / np.sqrt(3) * unit[:, 3:])
    out[0] = T
    return out


def distinct(transforms: Matrix, values: Matrix, gap_deg: float, gap_m: float = np.inf) -> NDArray[np.intp]:
    """Indices of the extrinsics (k, 4, 4) best first, without those that a better one is nearer to than both gaps."""
    left, picked = np.argsort(-values, kind="stable"), []
    while len(left):
        best, left = left[0], left[1:]
        picked.append(best)
        apart = apart_deg(transforms[left], transforms[best]) > gap_deg
        apart |= np.linalg.norm(centres(transforms[left]) - centres(transforms[best][None]), axis=1) > gap_m
        left = left[apart]
    return np.array(picked, np.intp)


def centres(transforms: Matrix) -> Matrix:
    """Where the cameras of (k, 4, 4) stand in the LiDAR frame, (k, 3) m."""
    return np.asarray(-np.einsum("kji,kj->ki", transforms[:, :3, :3], transforms[:, :3, 3]))
