"""Methods that match edges of the image: with depth discontinuities (Levinson and Thrun 2013; thesis eq. 4.2 and 4.3), and with
edges of a completed depth map (Castorena et al. 2016; eq. 4.4 and 4.5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import expit
from scipy.stats import norm

from calib_ros import se3
from calib_ros.frame import Frame
from calib_ros.registration.score.point_score import Score, project
from calib_ros.registration.score.sampler import MIN_DEPTH
from calib_ros.registration.search.constraints import SearchBox
from calib_ros.registration.search.optimizers import AXES, LEVEL
from calib_ros_evaluation.methods.method import MeanScore, Outcome, PointFeatures, Viewing, Watched, near, require
from calib_ros_thesis.cloud import discontinuity

Matrix = NDArray[np.float64]
Map = NDArray[np.float32]
Pixels = NDArray[np.intp]
WHAT = "before a depth discontinuity"
AROUND = np.ones((3, 3), np.uint8)
BLOCK = 32768  # points of several extrinsics at a time: their arrays stay in the processor's cache
NEIGHBOURS = np.array(sorted(product((-1, 0, 1), repeat=6), key=np.count_nonzero), np.float64)  # (729, 6), the centre first
RESOLUTION = 1 / (len(NEIGHBOURS) - 1)  # of a share; no deviation is known better
STEP_DEG, STEP_M = 0.2, 0.04  # of the test of a calibration: half and twice as much tell right from wrong less well
# Of the ascent, see `fista`.
GROWTH = 2.0  # of the step length before every iteration: the score is steeper here and flatter there
GAIN = 0.1  # share of the slope's promise that a step must gain: a score that counts pixels promises too much for half of it
WIDEST = 0.25  # of the box; half width of the first differences. From an eighth most runs end on the first ripple
SHORT = 0.25  # of that half width; a shorter step means that the slope belongs to something narrower


def grid_search(score: LevinsonScore, T: Matrix, half_width: Matrix, finest: Matrix) -> tuple[Matrix, int]:
    """The best extrinsic (4, 4) by grid search around T, and how often the score was evaluated: of the 729 neighbours the best is
    moved to; while that is the centre itself, the step is halved, as long as it is above `finest` on any axis.

    The grid is laid out in the twist from T. half_width, finest: (6,) rad and m. The first step is half of half_width, and
    beyond half_width nothing is tried; an axis of half width 0 stays.
    """
    centre, step, evaluations = np.zeros(6), half_width / 2, 1
    while (step > finest).any():
        twists = centre + step * NEIGHBOURS[~NEIGHBOURS[:, step == 0].any(axis=1)]
        twists = twists[(np.abs(twists) <= half_width + 1e-12).all(axis=1)]
        best = int(np.argmax(score.values(se3.exp_many(twists) @ T)))
        evaluations += len(twists)
        if best == 0:
            step = step / 2
        else:
            centre = twists[best]
    return np.asarray(se3.exp(centre) @ T), evaluations


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
    name = "levinson"
    title = "Levinson and Thrun (2013): depth discontinuities on image edges"

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
        finest = np.repeat([np.deg2rad(self.finest_deg), self.finest_m], 3)
        return Outcome(*grid_search(self.score(features, T), T, reach.half_width(), finest))


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


def slopes(image: Map) -> tuple[Map, Map]:
    """|grad_x|, |grad_y| of (h, w): absolute forward differences; 0 in the last column and row, which have no next one."""
    return np.abs(np.diff(image, axis=1, append=image[:, -1:])), np.abs(np.diff(image, axis=0, append=image[-1:]))


def slopes_at_points(size: tuple[int, int], sigma: float, u: Pixels, v: Pixels, depth: Map) -> tuple[Pixels, Map, Map]:
    """Flat pixels (m,) with a point, and there |grad_x phi| and |grad_y phi| of eq. 4.4, m per px, by normalised convolution
    (Knutsson and Westin 1993): phi at a pixel is the mean of the measured depths around it, weighed by a Gaussian of `sigma` px.
    Where a point and its neighbours to the right and below lie there is always one in reach, and phi is asked for nowhere else.

    size: height and width of the picture. u, v, depth: (n,) column, row and depth in m of points in it, far ones first: the
    nearest hides the others. Pixels in the last column and row are left out.
    """
    if len(u) == 0:
        return np.zeros(0, np.intp), np.zeros(0, np.float32), np.zeros(0, np.float32)
    (height, w), reach = size, max(round(3 * sigma), 1)  # px; of the kernel, beyond which a Gaussian is nearly 0
    kernel = np.asarray(cv2.getGaussianKernel(2 * reach + 1, sigma, cv2.CV_32F), np.float32)
    kernel = kernel / kernel.max()  # 1 in the middle: the share of a lonely point must not get lost in rounding
    top = max(int(v.min()) - reach, 0)
    rows = min(int(v.max()) + reach + 1, height) - top  # nothing lies above and below
    sparse, measured = np.zeros((2, rows, w), np.float32)
    sparse[v - top, u], measured[v - top, u] = depth, 1
    sums, shares = (cv2.sepFilter2D(of, -1, kernel, kernel).ravel() for of in (sparse, measured))
    measured[:, -1] = 0
    if top + rows == height:
        measured[-1] = 0
    shown = np.flatnonzero(measured)
    here, right, below = (np.asarray(sums[shown + k] / shares[shown + k], np.float32) for k in (0, 1, w))
    return shown + top * w, np.abs(right - here), np.abs(below - here)


def fista(
    score: Score, T: Matrix, half_width: Matrix, finest_deg: float, evaluations: int, begin: Matrix | None = None
) -> tuple[Matrix, float]:
    """The best extrinsic (4, 4) seen by accelerated ascent from `begin`, or T, and its score.

    It stays in the box of twists of half_width (6,) rad and m around T; a step onto its walls is the proximal one. Every step
    follows the slope at a point y beyond the last one, by t_k = (1 + sqrt(1 + 4 t_(k-1)^2)) / 2, and is halved until it gains
    enough. When the score falls, the acceleration starts anew from the best (O'Donoghue and Candes 2015). The slope is taken
    by central differences, half as wide whenever nothing more is gained, down to finest_deg (and what METRES_PER_RADIAN makes
    of it). Ends there, or when the next iteration might need more than `evaluations`.
    """
    box, finest = half_width / AXES, np.deg2rad(finest_deg)
    axes, used = np.eye(6)[box > 0], 0

    x = np.zeros(6) if begin is None else np.clip(se3.log(begin @ se3.inverse(T)) / AXES, -box, box)
    best, highest = x, -np.inf

    def value(x: Matrix) -> float:
        nonlocal used, best, highest
        used += 1
        found = score.value(se3.exp(x * AXES) @ T)
        if found > highest and (np.abs(x) <= box).all():  # differences are taken across its walls, too
            best, highest = x, found
        return found

    here = value(x)
    y, at_y, t, rate = x, here, 1.0, np.inf
    epsilon, longest = max(WIDEST * box.max(), finest), 0.5 * box.max()
    while used + 2 * len(axes) + 2 <= evaluations and len(axes):
        slope = np.zeros(6)
        for axis in axes:
            slope += axis * (value(y + epsilon * axis) - value(y - epsilon * axis)) / (2 * epsilon)
        steepness = float(np.linalg.norm(slope))
        if not steepness > LEVEL:  # NaN, too
            break
        rate = min(GROWTH * rate, longest / steepness)
        while True:
            new = np.clip(y + rate * slope, -box, box)
            moved, there = new - y, value(new)
            if there >= at_y + GAIN * float(slope @ moved) or rate * steepness < SHORT * epsilon or used >= evaluations:
                break
            rate /= 2
        short = bool(np.abs(moved).max() < SHORT * epsilon)
        if short or there <= here:
            if short or t == 1:
                if epsilon <= finest:
                    break
                epsilon, rate = max(epsilon / 2, finest), np.inf
            x = y = best
            here, at_y, t = highest, highest, 1.0
            continue
        following = (1 + np.sqrt(1 + 4 * t * t)) / 2
        y = np.clip(new + (t - 1) / following * (new - x), -box, box)
        x, here, t = new, there, following
        at_y = here if np.array_equal(y, x) else value(y)
    return np.asarray(se3.exp(best * AXES) @ T), highest


@dataclass(frozen=True)
class Castorena(Viewing):
    """Method: -F of eq. 4.4, by FISTA.

    w: F has to be small where the depth is steep at edges of the image, so w must be small there: exp(-gamma |grad I|). Eq. 4.5
    as the thesis prints it has no minus, and F would be smallest where depth edges avoid those of the image.
    F: as printed it falls as 1/|Omega|, though the denominator is to make the number of points not count; the score is
    -|Omega| F, that is, with means for the sums, whose curves peak nearer to the truth.

    gamma: for I in 0..1. image_sigma, depth_sigma: px, the blur of I and of the completion. scales: of both blurs, one search
    after the other; the last is the score. finest_deg: half width of the last differences, half a pixel of KITTI's camera.
    margin: points within this share of the image width around it are kept, enough for 10 deg or 0.5 m.
    """

    gamma: float = 50.0
    image_sigma: float = 1.0
    depth_sigma: float = 1.5
    scales: tuple[float, ...] = (4.0, 2.0, 1.0)
    finest_deg: float = 0.05
    evaluations: int = 500  # per scale; most searches end after 100 to 300
    margin: float = 0.3
    min_points: int = 500  # per frame; of fewer no map can be completed
    name = "castorena"
    title = "Castorena et al. (2016): edges of the completed depth map on image edges"

    def features(self, frame: Frame) -> PointFeatures:
        """The grey picture, and all points, far ones first. TooFewFeaturesError if hardly anything returned."""
        view, _ = self._preprocess(frame)
        order = np.argsort(-np.linalg.norm(view.xyz, axis=1), kind="stable")
        return replace(view, value=None).select(order)

    def score(self, features: Sequence[PointFeatures], T_prior: Matrix) -> MeanScore:
        """Mean of the frames' scores. TooFewFeaturesError for fewer than min_points per frame near the image at T_prior."""
        return self._score(features, T_prior, self.scales[-1])

    def _score(self, features: Sequence[PointFeatures], T_prior: Matrix, scale: float) -> MeanScore:
        """-|Omega| F with both blurs `scale` times as wide."""
        kept = near(features, T_prior, self.margin, self.min_points, "near the image")
        weights = [(f.xyz, edge_weights(f.image, self.gamma, self.image_sigma * scale).reshape(2, -1)) for f in kept]
        camera = features[0].camera

        def of_frame(frame: tuple[Map, Map], T: Matrix) -> float:
            xyz, w = frame
            u, v, points = project(xyz, T, camera)
            depth = xyz[points] @ T[2, :3].astype(np.float32) + np.float32(T[2, 3])
            pixels, x, y = slopes_at_points((camera.height, camera.width), self.depth_sigma * scale, u, v, depth)
            return -misfit((w[0][pixels], w[1][pixels]), (x, y))

        return MeanScore(weights, of_frame)

    def optimise(self, features: Sequence[PointFeatures], T: Matrix, reach: SearchBox) -> Outcome:
        """FISTA within reach, coarse to fine; the evaluations of all searches are counted."""
        watched, found = Watched(self.score(features, T)), T
        start = watched.value(T)
        for scale in self.scales[:-1]:
            coarse = Watched(self._score(features, T, scale))
            found, _ = fista(coarse, T, reach.half_width(), self.finest_deg * scale, self.evaluations, found)
            watched.evaluations += coarse.evaluations
        found, end = fista(watched, T, reach.half_width(), self.finest_deg, self.evaluations, found)
        return Outcome(found if end > start else T, watched.evaluations)


def edge_weights(gray: NDArray[np.uint8], gamma: float, sigma: float) -> Map:
    """w_x and w_y of eq. 4.5, (2, h, w): exp(-gamma |grad_k I|), I in 0..1 and blurred by a Gaussian of sigma px, 0 = not."""
    image = gray.astype(np.float32) / np.float32(255)
    if sigma > 0:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), np.float32)
    return np.asarray(np.exp(np.float32(-gamma) * np.stack(slopes(image))), np.float32)


def misfit(weights: tuple[Map, Map], steepness: tuple[Map, Map]) -> float:
    """|Omega| F of eq. 4.4 by w_k and |grad_k phi| at the pixels of Omega, (m,) for k = x and y.

    1 per direction where depth and image edges have nothing to do with each other; so it counts, too, where there is no edge.
    """
    total = 0.0
    for w, slope in zip(weights, steepness, strict=True):
        N = float(w.sum(dtype=np.float64)) * float(slope.sum(dtype=np.float64))
        total += len(w) * float(w @ slope) / N if N > 0 else 1.0
    return total
