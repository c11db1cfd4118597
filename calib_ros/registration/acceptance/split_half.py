"""Split-half disagreement: do disjoint halves of the same data lead to the same extrinsic?

Unlike a decoy, this tells a biased optimum from the right one: the distance of halves, each refined by itself, is compared with
what their own curvatures let expect.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.arrays import Transform
from calib_ros.registration.covariance import inverse_curvature, noise_level, share_of_weight
from calib_ros.registration.objective import SYSTEMATIC_ERROR
from calib_ros.registration.score.point_score import PointScore
from calib_ros.registration.search.constraints import Limits
from calib_ros.registration.search.optimizers import levenberg_marquardt

POINTS = 6000  # edge points used for both halves, so that many frames do not cost more
MIN_POINTS = 60  # of a half: ten per unknown
LEVELS = (2, 3, 4)  # on which a half is refined: coarse enough to leave an optimum that only both halves together hold up
# These make the errors of 111 single frames and 54 sets most likely; 2 of the single ones are accepted too far off, 6 without.
AGREEING, MOST = 0.7, 5.0
SECTOR = np.deg2rad(6.0)  # width of interleaved sectors of azimuth: wider than an object's edge, narrower than a scene


def disagreement(score: PointScore, T: Transform, limits: Limits) -> float:
    """The distance of halves of the data, each refined from the optimum T (4, 4): squared, in units of what their covariances
    let expect, on average over several ways to halve the data, each at most MOST. About 1 for a right optimum; see `inflation`.

    limits: axes that are fixed stay so. 1.0 where there are too few points.
    """
    part = score.subset(POINTS, np.random.default_rng(0))
    axes = np.flatnonzero(limits.open_axes)
    if not len(axes):
        return 1.0
    # A half of the weight has twice the noise of all.
    noise = 2 * noise_level(part, T, inverse_curvature(part, T, axes), axes)
    systematic = np.diag((2 * SYSTEMATIC_ERROR[axes]) ** 2)
    factors = []
    for half in _halvings(part, T):
        both = [part.select(np.flatnonzero(half == k)) for k in (False, True)]
        ends = [T, T]
        for level, (k, own) in product(LEVELS, enumerate(both)):
            ends[k] = levenberg_marquardt(own.at(level), ends[k], limits=limits, tolerance_deg=0.005, near=True)[0]
        expected = sum((noise * inverse_curvature(own, T, axes) for own in both), systematic)
        gap = se3.log(ends[0] @ se3.inverse(ends[1]))[axes]
        factors.append(float(gap @ np.linalg.solve(expected, gap)) / len(axes))
    return float(np.minimum(factors, MOST).mean()) if factors else 1.0


def inflation(disagreement: float) -> float:
    """By how much the variance of the optimum is larger than its curvature and its noise tell."""
    return AGREEING + disagreement


def _halvings(score: PointScore, T: Transform) -> Iterator[NDArray[np.bool_]]:
    """Masks (n,) of halves with enough points: sectors of the scan, sides of the image, middle, near ones, alternate frames."""
    p = T[:3, :3] @ score.points + T[:3, 3:]
    quarter = share_of_weight(np.arctan2(p[0], p[2]), score.weights, 4)
    azimuth = np.arctan2(score.points[1], score.points[0])
    for mask in (
        np.floor(azimuth / SECTOR) % 2 > 0,
        quarter >= 2,
        (quarter == 0) | (quarter == 3),
        share_of_weight(p[2], score.weights, 2) > 0,
        score.frame % 2 > 0,
    ):
        if MIN_POINTS <= np.count_nonzero(mask) <= len(mask) - MIN_POINTS:
            yield mask
