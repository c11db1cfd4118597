"""How far the estimate may be off: its covariance, which directions the scenes do not show, and what to do with those.

Covariances (6, 6) are of left twists, which turn and shift the camera in its own optical axes (x right, y down, z forward), in
rad and m.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.arrays import Covariance, Matrix, Transform
from calib_ros.registration.objective import SYSTEMATIC_ERROR
from calib_ros.registration.score.point_score import PointScore
from calib_ros.registration.search.constraints import Limits, PoseConstraints
from calib_ros.registration.search.optimizers import levenberg_marquardt

REGIONS = 12  # of equal weight, side by side in the image; the slopes of regions and frames vary independently of each other
# Noise of a score in units of its curvature, per frame (0.002 to 0.02 of five scanners), that counts as that of so many cells.
USUAL_NOISE, USUAL_CELLS = 0.005, 6
# Effective points. Where a frame has fewer, its noise is at least so many times the usual one, as that of a mean; where all
# frames together have fewer, once more: their top is more often one of chance. Normalised errors squared fall from 15 to 5.
FEW_POINTS = 700.0
DUPLICATE_LEVEL = 1  # of the edge maps; their correlation tells whether frames show the same place
STEP = np.array([np.deg2rad(0.1)] * 3 + [0.01] * 3)  # rad, m; the top of the score is as narrow as that
LEAST_CURVATURE = 0.02  # of the Gauss-Newton scale; where the score bends upward it holds no information
UNKNOWN = np.array([1.0] * 3 + [10.0] * 3)  # rad, m; standard deviations where no point moves at all
FARTHEST = np.array([np.deg2rad(1.0)] * 3 + [0.3] * 3)  # rad, m; at which a profile is measured
PROFILE_ROUNDS, PROFILE_CHANGE = 2, 4.0  # of the variance of a direction per round, at most
NO_NOISE = 1e-9  # of a score
POINTS = 8000  # points that tell the curvature; more cost time and change nothing
LEAST_VARIANCE = 1e-18  # rad^2, m^2; less is what rounding leaves of an axis that is fixed

# Of disjoint halves of the data: unlike a decoy, they tell a biased optimum from the right one.
HALVED_POINTS = 6000  # edge points used for both, so that many frames do not cost more
MIN_POINTS = 60  # of a half: ten per unknown
HALF_LEVELS = (2, 3, 4)  # on which one is refined: coarse enough to leave an optimum that only both together hold up
# These make the errors of 111 single frames and 54 sets most likely; 2 of the single ones are accepted too far off, 6 without.
AGREEING, MOST = 0.7, 5.0
SECTOR = np.deg2rad(6.0)  # width of interleaved sectors of azimuth: wider than an object's edge, narrower than a scene

UNKNOWNS = 6  # of an extrinsic
INDEPENDENT = 2.0  # frames; one scene alone does not tell noise from what is wrong in it

AXIS_NAMES = ("pitch", "yaw", "roll", "sideways shift", "vertical shift", "forward shift")  # of a twist
TAKES_PART = 0.4  # share of the largest component of a direction, in units of the limits, from which an axis is named


def covariance(
    score: PointScore,
    T: Transform,
    systematic_error: Matrix = SYSTEMATIC_ERROR,
    constraints: PoseConstraints | None = None,
    inflation: float = 1.0,
    others: Sequence[Matrix] = (),
) -> Covariance:
    """Covariance (6, 6) at the optimum T (4, 4). A direction that the scenes do not show has a large variance.

    systematic_error: standard deviations (6,) that no number of frames goes below, rad and m. constraints: axes that are fixed
    have variance 0, and a prior adds its information. inflation: of the variance, by the disagreement of halves.
    others: optima (4, 4) nearby that a search has met; they count as far as the noise lets them be the right one.

    Inverse curvature of the score itself (the Gauss-Newton scale cannot tell a peak from a ridge of noise) times its noise, see
    `noise_level`, plus the systematic error; its size along every direction as `_profiled` has it.
    """
    axes = np.flatnonzero(constraints.limits.open_axes) if constraints else np.arange(6)
    C = np.zeros((6, 6))
    if not len(axes):
        return C
    units = np.outer(UNKNOWN[axes], UNKNOWN[axes])
    bread = inverse_curvature(score, T, axes)
    noise = noise_level(score, T, bread, axes)
    inner = inflation * _profiled(score, T, axes, noise * bread, noise)
    inner += _spread(score, T, others, inflation * noise)[np.ix_(axes, axes)]
    values, vectors = np.linalg.eigh(inner / units)
    inner = units * ((vectors * np.clip(values, 0, 1)) @ vectors.T) + np.diag(systematic_error[axes] ** 2)
    if constraints and constraints.prior:
        inner = np.linalg.inv(np.linalg.inv(inner) + np.diag(constraints.information()[axes]))
    C[np.ix_(axes, axes)] = 0.5 * (inner + inner.T)
    return C


def _profiled(score: PointScore, T: Transform, axes: NDArray[np.intp], C: Matrix, noise: float) -> Matrix:
    """The covariance C (k, k) of the axes (k,), the standard deviation of every principal direction where the score has fallen by
    half of its noise, as on a profile of the likelihood: the curvature at the very top is that of its finest structure."""
    part = score.subset(POINTS, np.random.default_rng(0)).at(-1)
    k = len(axes)
    scale = part.linearise(T)[1][np.ix_(axes, axes)] + np.diag(max(noise, NO_NOISE) / UNKNOWN[axes] ** 2)
    whitened = np.linalg.inv(np.linalg.cholesky(scale)).T  # unit steps along its columns move all points alike
    inverse = np.linalg.inv(whitened)
    values, vectors = np.linalg.eigh(inverse @ C @ inverse.T)
    directions, sigma = whitened @ vectors, np.sqrt(np.maximum(values, 0))
    top = part.value(T)
    for _ in range(PROFILE_ROUNDS):
        for j in range(k):
            # Farther away the score knows other optima, not this one.
            near = 1 / max(float(np.abs(directions[:, j] * sigma[j] / FARTHEST[axes]).max()), 1)
            xi = np.zeros(6)
            xi[axes] = directions[:, j] * sigma[j] * near
            fallen = top - 0.5 * (part.value(se3.exp(xi) @ T) + part.value(se3.exp(-xi) @ T))
            sigma[j] *= np.sqrt(np.clip(0.5 * noise * near**2 / max(fallen, NO_NOISE), 1 / PROFILE_CHANGE, PROFILE_CHANGE))
    return np.asarray((directions * sigma**2) @ directions.T)


def _spread(score: PointScore, T: Transform, others: Sequence[Matrix], noise: float) -> Covariance:
    """Second moment (6, 6) about T (4, 4) of optima nearby; one that scores less by the noise is exp(-1) times as probable."""
    top, moment, weight = score.at(-1).value(T), np.zeros((6, 6)), 1.0
    kept = [np.zeros(6)]
    for other in others:
        xi = se3.log(other @ se3.inverse(T))
        if any((np.abs(xi - own) < STEP).all() for own in kept):
            continue
        kept.append(xi)
        own_weight = float(np.exp(min(score.at(-1).value(other) - top, 0.0) / max(noise, NO_NOISE)))
        moment, weight = moment + own_weight * np.outer(xi, xi), weight + own_weight
    return np.asarray(moment / weight)


def inverse_curvature(score: PointScore, T: Transform, axes: NDArray[np.intp]) -> Matrix:
    """Inverse (k, k) of how the score bends down at its top T (4, 4) along some axes: by central differences of its gradient over
    STEP. Times the noise, it is the part of the covariance that more scenes average out."""
    part = score.subset(POINTS, np.random.default_rng(0))
    before, after = part.gradients(_steps() @ T, score.n_levels - 1).reshape(2, 6, 6)
    H = (before - after) / (2 * STEP[:, None])
    H = 0.5 * (H + H.T)
    units = np.outer(UNKNOWN[axes], UNKNOWN[axes])
    values, vectors = np.linalg.eigh(score.at(-1).linearise(T)[1][np.ix_(axes, axes)] * units)
    root = vectors / np.sqrt(np.maximum(values, 0) + USUAL_NOISE / len(score.frames))
    return np.asarray(units * inverse_above(H[np.ix_(axes, axes)] * units, root))


def inverse_above(H: Matrix, root: Matrix) -> Matrix:
    """Inverse (k, k) of a curvature H that may be indefinite: its eigenvalues relative to the Gauss-Newton scale, whose inverse
    is root root^T, rise to LEAST_CURVATURE."""
    values, vectors = np.linalg.eigh(root.T @ H @ root)
    half = root @ vectors
    return np.asarray((half / np.maximum(values, LEAST_CURVATURE)) @ half.T)


def noise_level(score: PointScore, T: Transform, bread: Matrix, axes: NDArray[np.intp]) -> float:
    """Noise of the score at its optimum T (4, 4), in units of its curvature: the dispersion of the slopes of cells, the regions
    of all frames, pooled over all directions, of which the sandwich H^-1 (sum g g^T) H^-1 (White 1980) has some far too small.

    bread: inverse curvature (k, k) of the axes (k,). Frames of one place count as fewer.
    """
    frames = score.frames
    p = T[:3, :3] @ score.points + T[:3, 3:]
    region = share_of_weight(np.arctan2(p[0], p[2]), score.weights, REGIONS)  # from left to right in the image
    cell = np.searchsorted(frames, score.frame) * REGIONS + region
    J = (score.jacobian(T, score.n_levels - 1) * score.weights)[axes]
    slopes = np.stack([np.bincount(cell, row, len(frames) * REGIONS) for row in J], axis=1)
    cells = int(np.count_nonzero(np.bincount(cell)))
    dispersion = cells / max(cells - 1, 1) * float(np.einsum("ij,jk,ik->", slopes, bread, slopes)) / len(axes)
    usual = USUAL_NOISE / len(frames)
    pooled = (cells * dispersion + USUAL_CELLS * usual) / (cells + USUAL_CELLS)
    fewer = FEW_POINTS / effective_points(score)
    if fewer * len(frames) > 1:
        pooled = max(pooled, usual * fewer * len(frames) * max(fewer, 1))
    return pooled * len(frames) / scenes_of(score)


def noise_of(score: PointScore, T: Transform, limits: Limits) -> float:
    """Noise of the score at its optimum T (4, 4): twice what is lost by one standard deviation; see `noise_level`."""
    axes = np.flatnonzero(limits.open_axes)
    return max(noise_level(score, T, inverse_curvature(score, T, axes), axes), NO_NOISE)


def effective_points(score: PointScore) -> float:
    """How many equally weighted points the points of a score are worth (Kish)."""
    return 1 / max(float(np.sum(np.square(score.weights, dtype=np.float64))), 1e-12)


def scenes_of(score: PointScore) -> float:
    """How many independent frames those of a score are worth, 1..n: n^2 / sum of all correlations of their edge maps, as for the
    mean of correlated measurements."""
    frames = score.frames
    if len(frames) < 2:
        return float(len(frames))
    correlation = score.atlas.correlation(min(DUPLICATE_LEVEL, score.n_levels - 1))
    return float(len(frames) ** 2 / correlation[np.ix_(frames, frames)].sum())


def freedom(score: PointScore) -> float:
    """Degrees of freedom of the noise of a score: the regions of all frames that show different places, with those that the usual
    noise counts for, less the unknowns."""
    return REGIONS * scenes_of(score) + USUAL_CELLS - UNKNOWNS - 1


def shows_noise(score: PointScore) -> bool:
    """Whether there are scenes enough to tell noise from what is wrong in one of them."""
    return scenes_of(score) >= INDEPENDENT


def shows_lens(score: PointScore) -> bool:
    """Whether intrinsics can be judged: by several scenes, one may gain much by chance, and not on unrolled pictures, where a
    shift is a rotation and lenses of another focal length are unrolled otherwise."""
    return shows_noise(score) and not score.camera.is_sphere


def share_of_weight(values: Matrix, weights: NDArray[np.float32], parts: int) -> NDArray[np.intp]:
    """Part (n,) of every value when they are sorted and divided into so many parts of equal weight."""
    order = np.argsort(values, kind="stable")
    out = np.empty(len(values), np.intp)
    below = np.cumsum(weights[order], dtype=np.float64)
    out[order] = np.minimum((below / below[-1] * parts).astype(np.intp), parts - 1)
    return out


@cache
def _steps() -> Matrix:
    """Twists of STEP along every axis (12, 4, 4): backwards, then forwards."""
    return se3.exp_many(np.concatenate([-np.diag(STEP), np.diag(STEP)]))


@dataclass(frozen=True)
class Direction:
    """An unobservable direction of the extrinsic. axes: those that take part, 0..5 of a twist. sigma: their standard deviations,
    rad or m. str() is its name with these."""

    axes: tuple[int, ...]
    sigma: tuple[float, ...]

    def __str__(self) -> str:
        known = zip(self.axes, self.sigma, strict=True)
        sizes = [(k, s < 0.5, f"{np.rad2deg(s):.2f} deg") if k < 3 else (k, s < 3, f"{100 * s:.0f} cm") for k, s in known]
        return " with ".join(f"{AXIS_NAMES[k]} ({size if shown else 'unknown'})" for k, shown, size in sizes)


def open_directions(covariance: Covariance, max_deg: float, max_m: float) -> list[Direction]:
    """Directions known less well than max_deg or max_m (standard deviations), the least known first; empty if there are none.

    covariance: (6, 6). A direction may couple axes: pitch looks like a vertical shift where all edges are equally far.
    """
    limit = np.concatenate([np.full(3, np.deg2rad(max_deg)), np.full(3, max_m)])
    values, vectors = np.linalg.eigh(covariance / np.outer(limit, limit))
    out = []
    for value, v in zip(values[::-1], vectors.T[::-1], strict=True):
        if value <= 1:
            break
        sigma = np.sqrt(value) * np.abs(v) * limit
        axes = [k for k in range(6) if abs(v[k]) >= TAKES_PART * np.abs(v).max()]
        out.append(Direction(tuple(axes), tuple(float(sigma[k]) for k in axes)))
    return out


def free_axes(covariance: Covariance) -> NDArray[np.bool_]:
    """(6,) axes that a covariance (6, 6) leaves open; a fixed one has no variance."""
    return np.asarray(np.diag(covariance) > LEAST_VARIANCE)


def distance(xi: Matrix, covariance: Covariance) -> tuple[float, int]:
    """Squared Mahalanobis distance of a twist (6,) by its covariance (6, 6), fixed axes left out, and its degrees of freedom."""
    return float(xi @ _information(covariance) @ xi), int(free_axes(covariance).sum())


def fused(T: Transform, covariance: Covariance, T_prior: Transform, prior: Matrix) -> tuple[Matrix, Matrix]:
    """Kalman update on SE(3): the extrinsic (4, 4) and its covariance (6, 6) from an estimate T with `covariance` and from what
    was known before, T_prior with covariance `prior`."""
    xi = se3.log(T @ se3.inverse(T_prior))
    gain = prior @ _information(prior + covariance)
    left = np.eye(6) - gain
    after = left @ prior @ left.T + gain @ covariance @ gain.T
    return se3.exp(gain @ xi) @ T_prior, 0.5 * (after + after.T)


def _information(covariance: Covariance) -> Matrix:
    """Information (6, 6) of a covariance; 0 along fixed axes. In units of the axes: a well known one would else be rounding."""
    free = free_axes(covariance)
    sigma = np.where(free, np.sqrt(np.maximum(np.diag(covariance), LEAST_VARIANCE)), np.inf)
    return np.asarray(np.linalg.pinv(covariance / np.outer(sigma, sigma), rcond=1e-12, hermitian=True) / np.outer(sigma, sigma))


def disagreement(score: PointScore, T: Transform, limits: Limits) -> float:
    """The distance of halves of the data, each refined from the optimum T (4, 4): squared, in units of what their covariances
    let expect, on average over several ways to halve the data, each at most MOST. About 1 for a right optimum; see `inflation`.

    limits: axes that are fixed stay so. 1.0 where there are too few points.
    """
    part = score.subset(HALVED_POINTS, np.random.default_rng(0))
    axes = np.flatnonzero(limits.open_axes)
    if not len(axes):
        return 1.0
    # A half of the weight has twice the noise of all.
    noise = 2 * noise_level(part, T, inverse_curvature(part, T, axes), axes)
    systematic = np.diag((2 * SYSTEMATIC_ERROR[axes]) ** 2)
    p, factors = T[:3, :3] @ part.points + T[:3, 3:], []
    quarter = share_of_weight(np.arctan2(p[0], p[2]), part.weights, 4)
    sector = np.floor(np.arctan2(part.points[1], part.points[0]) / SECTOR)
    # Sectors of the scan, sides of the image, middle, near ones, alternate frames.
    middle, near = (quarter == 0) | (quarter == 3), share_of_weight(p[2], part.weights, 2) > 0
    for half in (sector % 2 > 0, quarter >= 2, middle, near, part.frame % 2 > 0):
        if not MIN_POINTS <= np.count_nonzero(half) <= len(half) - MIN_POINTS:
            continue
        both = [part.select(np.flatnonzero(half == k)) for k in (False, True)]
        ends = [T, T]
        for level, (k, own) in product(HALF_LEVELS, enumerate(both)):
            ends[k] = levenberg_marquardt(own.at(level), ends[k], limits=limits, tolerance_deg=0.005, near=True)[0]
        expected = sum((noise * inverse_curvature(own, T, axes) for own in both), systematic)
        gap = se3.log(ends[0] @ se3.inverse(ends[1]))[axes]
        factors.append(float(gap @ np.linalg.solve(expected, gap)) / len(axes))
    return float(np.minimum(factors, MOST).mean()) if factors else 1.0


def inflation(disagreement: float) -> float:
    """By how much the variance of the optimum is larger than its curvature and its noise tell."""
    return AGREEING + disagreement
