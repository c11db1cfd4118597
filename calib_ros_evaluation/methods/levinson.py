"""Depth discontinuities on image edges (Levinson and Thrun 2013; thesis eq. 4.2 and 4.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import expit
from scipy.stats import norm

from calib_ros import se3
from calib_ros.config import Config
from calib_ros.frame import Frame
from calib_ros.registration.score.sampler import MIN_DEPTH
from calib_ros.registration.search.constraints import SearchBox
from calib_ros_evaluation.methods.method import Outcome, PointFeatures, Viewing, Watched, near, require
from calib_ros_thesis.cloud import discontinuity

Matrix = NDArray[np.float64]
Map = NDArray[np.float32]
WHAT = "before a depth discontinuity"
AROUND = np.ones((3, 3), np.uint8)
BLOCK = 32768  # points of several extrinsics at a time: their arrays stay in the processor's cache
NEIGHBOURS = np.array(sorted(product((-1, 0, 1), repeat=6), key=np.count_nonzero), np.float64)  # (729, 6), the centre first
RESOLUTION = 1 / (len(NEIGHBOURS) - 1)  # of a share; no deviation is known better
STEP_DEG, STEP_M = 0.2, 0.04  # of the test of a calibration: half and twice as much tell right from wrong less well


def grid_search(score: LevinsonScore, watched: Watched, T: Matrix, half_width: Matrix, finest: Matrix) -> Matrix:
    """The best extrinsic (4, 4) by grid search around T: of the 729 neighbours the best is moved to; while that is the centre
    itself, the step is halved, as long as it is above `finest` on any axis.

    The grid is laid out in the twist from T. half_width, finest: (6,) rad and m. The first step is half of half_width, and
    beyond half_width nothing is tried; an axis of half width 0 stays. watched: counts the evaluations of `score`.
    """
    centre, step = np.zeros(6), half_width / 2
    watched.value(T)
    while (step > finest).any():
        twists = centre + step * NEIGHBOURS[_differ(step)]
        twists = twists[(np.abs(twists) <= half_width + 1e-12).all(axis=1)]
        transforms = se3.exp_many(twists) @ T
        best = int(np.argmax(score.values(transforms)))
        watched.evaluations += len(transforms) - 1
        if best == 0:
            step = step / 2
        else:
            centre = twists[best]
        watched.value(transforms[best])
    return np.asarray(se3.exp(centre) @ T)


def _differ(step: Matrix) -> NDArray[np.intp]:
    """Rows of NEIGHBOURS that differ, given that axes of step 0 do not move."""
    return np.flatnonzero(~NEIGHBOURS[:, step == 0].any(axis=1))


def worse_share(score: LevinsonScore, T: Matrix) -> float:
    """F_C: the share of the 728 neighbours of T (4, 4), one step away along any of the axes, whose score is lower than that of T.

    Without structure it is about one half; at the optimum of a score that is well-behaved it is 1.
    """
    step = np.repeat([np.deg2rad(STEP_DEG), STEP_M], 3)
    values = score.values(se3.exp_many(step * NEIGHBOURS) @ T)
    return float(np.mean(values[1:] < values[0]))


def edge_image(gray: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """E: the largest absolute difference of every pixel of (h, w) to any of its 8 neighbours, grey levels."""
    highest, lowest = cv2.dilate(gray, AROUND), cv2.erode(gray, AROUND)
    return np.asarray(np.maximum(highest - gray, gray - lowest), np.uint8)


def edginess(E: NDArray[np.uint8], alpha: float, gamma: float) -> Map:
    """D of eq. 4.2: alpha E + (1 - alpha) max over all pixels of E gamma^distance, chessboard distance; (h, w) float32."""
    return np.asarray(np.float32(alpha) * E + np.float32(1 - alpha) * spread(E, gamma), np.float32)


def spread(E: NDArray[np.uint8], gamma: float) -> Map:
    """The maximum over all pixels of E gamma^distance, 0 < gamma < 1, exactly; (h, w) -> (h, w) float32.

    With B_r the maximum in the square of radius r, it is that of gamma^d B_d E over all d. Those below some n being done in F,
    the next n are gamma^n B_n F, since B_n B_d = B_(n+d): as many steps as a distance has binary digits.
    """
    F, n = E.astype(np.float32), 1
    while n < max(F.shape):
        fade = np.float32(gamma**n)
        if fade * F.max() <= F.min():  # nothing from so far away can be the largest
            break
        square = np.ones(2 * n + 1, np.uint8)
        wide = cv2.dilate(cv2.dilate(F, square[None]), square[:, None])
        F = np.maximum(F, fade * wide)
        n *= 2
    return np.asarray(F, np.float32)


@dataclass(frozen=True)
class Levinson(Viewing):
    """Method: the sum of xi D, by grid search. alpha, gamma, exponent and least_m are the published ones.

    finest_deg, finest_m: the search ends below; a pixel of KITTI's camera is 0.08 deg wide, its LiDAR measures to 2 cm. margin:
    points within this share of the image width around it are kept, enough for 10 deg or 0.5 m.
    """

    alpha: float = 1 / 3
    gamma: float = 0.98
    exponent: float = 0.5
    least_m: float = 0.3
    finest_deg: float = 0.02
    finest_m: float = 0.003
    margin: float = 0.3
    min_points: int = 50  # per frame; fewer discontinuities are a wall or a covered sensor
    config: Config = field(default_factory=Config)
    name: str = "levinson"
    title: str = "Levinson and Thrun (2013): depth discontinuities on image edges"

    def features(self, frame: Frame) -> PointFeatures:
        """Points in front of a depth discontinuity of more than least_m, and D. TooFewFeaturesError for fewer than min_points."""
        view, measured = self._preprocess(frame)
        jump = discontinuity(measured)
        keep = np.flatnonzero(jump > self.least_m)
        require(len(keep), self.min_points, WHAT, "check that the LiDAR sees objects in front of others")
        D = edginess(edge_image(view.image), self.alpha, self.gamma)
        return replace(view, image=D, value=jump ** np.float32(self.exponent)).select(keep)

    def score(self, features: Sequence[PointFeatures], T_prior: Matrix) -> LevinsonScore:
        """Mean of the frames' J. TooFewFeaturesError for fewer than min_points per frame near the image at T_prior."""
        return LevinsonScore(features, T_prior, self.margin, self.min_points)

    def optimise(self, features: Sequence[PointFeatures], T: Matrix, reach: SearchBox) -> Outcome:
        """Grid search within reach, by steps from half of it."""
        score = self.score(features, T)
        watched = Watched(score)
        finest = np.repeat([np.deg2rad(self.finest_deg), self.finest_m], 3)
        found = grid_search(score, watched, T, reach.half_width(), finest)
        return Outcome(found, watched.evaluations)


class LevinsonScore:
    """J of eq. 4.3, the mean over frames; a Score. Points outside the image, or less than MIN_DEPTH in front of it, add 0."""

    def __init__(self, features: Sequence[PointFeatures], T_prior: Matrix, margin: float, min_points: int) -> None:
        # (3, n) points, (n,) xi, and D (h + 1, w + 1) ravelled, 0 in the last row and column.
        self._frames = [
            (np.ascontiguousarray(f.xyz.T), f.value, np.pad(f.image, ((0, 1), (0, 1))).ravel())
            for f in near(features, T_prior, margin, min_points, WHAT)
        ]
        self.camera = features[0].camera

    def value(self, T: Matrix) -> float:
        """At T_camera_lidar (4, 4)."""
        return float(self.values(T[None])[0])

    def values(self, transforms: Matrix) -> Matrix:
        """At many T_camera_lidar (k, 4, 4) at once: (k,)."""
        M = (self.camera.K @ transforms[:, :3]).astype(np.float32)
        total = np.zeros(len(M))
        for xyz, xi, table in self._frames:
            step = max(BLOCK // max(len(xi), 1), 1)
            for k in range(0, len(M), step):
                total[k : k + step] += self._sampled(xyz, table, M[k : k + step]) @ xi
        return total / len(self._frames)

    def _sampled(self, xyz: Map, table: Map, M: Map) -> Map:
        """D (k, n) under the points (3, n) by projections M (k, 3, 4)."""
        width, height, n = self.camera.width, self.camera.height, xyz.shape[1]
        p = (M[:, :, :3].reshape(-1, 3) @ xyz).reshape(len(M), 3, n)
        p += M[:, :, 3:]
        u, v, z = p[:, 0], p[:, 1], p[:, 2]
        outside = z < MIN_DEPTH
        z[outside] = 1
        for row, size in ((u, width), (v, height)):
            row /= z
            np.rint(row, out=row)
            outside |= (row < 0) | (row >= size)
        u[outside], v[outside] = width, height
        v *= width + 1
        v += u  # exact: pictures of less than 2^24 pixels
        return table.take(v.astype(np.int32))


def fitted(shares: Sequence[float]) -> tuple[float, float]:
    """Mean and standard deviation of the normal distribution of shares (n,), at least two of them."""
    return float(np.mean(shares)), max(float(np.std(shares, ddof=1)), RESOLUTION)


def probability_right(shares: Sequence[float], right: tuple[float, float], wrong: tuple[float, float]) -> float:
    """Probability 0..1 that the calibration is right, given F_C of the last frames (w,), and both as likely beforehand.

    right, wrong: how F_C is distributed then, see `fitted`. By Bayes, the frames taken as independent. Frames of one place are
    not, and the probability is then too sure of itself.
    """
    return float(expit(np.sum(norm.logpdf(shares, *right) - norm.logpdf(shares, *wrong))))
