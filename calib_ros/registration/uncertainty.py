"""How far the estimate may be off: covariance from how much the frames disagree, and from what is known of such scores."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.registration.constraints import SCORE_NOISE, Known
from calib_ros.registration.point_score import PointScore

Matrix = NDArray[np.float64]
# Bias that no number of frames averages out. With it and NOISE the mean of the normalised error squared is 4.1 over 250
# estimates of KITTI and synthetic drives from 1 to 20 frames (6 would be perfect): 1.5 on synthetic ones, 10 on a KITTI drive.
FLOOR = np.array([np.deg2rad(0.015)] * 3 + [0.008] * 3)  # rad, m

# Of the thesis's objective: 0.13-0.18 deg and 3.6-4.9 cm remain on 4 to 10 spread KITTI scenes.
THESIS_FLOOR = np.array([np.deg2rad(0.1)] * 3 + [0.03] * 3)

NOISE = 0.1 * SCORE_NOISE  # per frame, against the curvature of the score, which is a fifth of the Gauss-Newton scale
FEW = 2  # one frame is (1 + FEW) times noisier than frames of a set: nothing corrects what its scene suggests
# Frames that the usual noise of a score counts for: fewer than 6 cannot even span all directions by their disagreement.
USUAL_FRAMES = 5
STEP = np.array([np.deg2rad(0.1)] * 3 + [0.01] * 3)  # rad, m; the top of the score is as narrow as that
LEAST_CURVATURE = 0.02  # of the Gauss-Newton scale; where the score bends upward it tells nothing
UNKNOWN = np.array([1.0] * 3 + [10.0] * 3)  # rad, m; standard deviations where no point moves at all
POINTS = 8000  # points that tell the curvature; more cost time and change nothing


def covariance(
    score: PointScore,
    T: Matrix,
    level: int = -1,
    floor: Matrix = FLOOR,
    known: Known | None = None,
) -> Matrix:
    """Covariance (6, 6) of a left twist at the optimum T (4, 4), rad and m.

    A direction that the scenes do not show has a large variance, see observability.py. floor: standard deviations (6,) that no
    number of frames goes below, rad and m. known: axes that are fixed have variance 0, and a prior adds its information.

    Sandwich H^-1 (n/(n-1) sum g_f g_f^T) H^-1 over the frames' gradients g_f (White 1980), averaged with what a score of n
    frames usually has, NOISE / n H^-1, plus the floor. H is the curvature of the score itself: the Gauss-Newton scale cannot
    tell a peak from a ridge of noise, which has slopes just as steep.
    """
    axes = np.flatnonzero(known.limits.open_axes) if known else np.arange(6)
    C = np.zeros((6, 6))
    if not len(axes):
        return C
    n = len(np.unique(score.frame))
    noise = NOISE * (1 + FEW / n) / n
    units = np.outer(UNKNOWN[axes], UNKNOWN[axes])
    scale = score.at(level).linearise(T)[1][np.ix_(axes, axes)] * units
    bread = units * _inverse(curvature(score, T, level)[np.ix_(axes, axes)] * units, scale, noise)
    inner = noise * bread
    if n > 1:
        gradients = score.frame_gradients(T, level)[:, axes]
        spread = n / (n - 1) * gradients.T @ gradients
        inner = ((n - 1) * bread @ spread @ bread + USUAL_FRAMES * inner) / (n - 1 + USUAL_FRAMES)
    values, vectors = np.linalg.eigh(inner / units)
    inner = units * ((vectors * np.clip(values, 0, 1)) @ vectors.T) + np.diag(floor[axes] ** 2)
    if known and known.prior:
        inner = np.linalg.inv(np.linalg.inv(inner) + np.diag(known.told()[axes]))
    C[np.ix_(axes, axes)] = 0.5 * (inner + inner.T)
    return C


def curvature(score: PointScore, T: Matrix, level: int = -1) -> Matrix:
    """How the score bends down (6, 6) around T (4, 4) per left twist, by central differences of its gradient over STEP."""
    part = score.subset(POINTS, np.random.default_rng(0)).at(level)
    slopes = [[part.linearise(se3.exp(sign * step) @ T)[0] for sign in (-1, 1)] for step in np.diag(STEP)]
    H = np.array([(before - after) / (2 * h) for (before, after), h in zip(slopes, STEP, strict=True)])
    return np.asarray(0.5 * (H + H.T))


def _inverse(H: Matrix, scale: Matrix, least: float) -> Matrix:
    """Inverse of a curvature that may be indefinite: its eigenvalues relative to `scale` are raised to LEAST_CURVATURE.

    least: added to `scale`, which has no slope at all along what no point shows, or less than none by rounding.
    """
    values, vectors = np.linalg.eigh(scale)
    root = vectors / np.sqrt(np.maximum(values, 0) + least)
    values, vectors = np.linalg.eigh(root.T @ H @ root)
    half = root @ vectors
    return np.asarray((half / np.maximum(values, LEAST_CURVATURE)) @ half.T)
