"""Whether a calibration is right, by the share of its neighbours that score worse (Levinson and Thrun 2013)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit

from calib_ros.errors import BadInputError
from calib_ros.evaluation.methods.levinson_grid import NEIGHBOURS, STEP_DEG, STEP_M, ManyScore, worse_share

Matrix = NDArray[np.float64]
RESOLUTION = 1 / (len(NEIGHBOURS) - 1)  # of a share; no deviation is known better


@dataclass(frozen=True)
class Distribution:
    """A normal distribution of F_C."""

    mean: float
    deviation: float

    def log_density(self, shares: ArrayLike) -> Matrix:
        """Natural logarithm of the density at shares (n,)."""
        z = (np.asarray(shares, float) - self.mean) / self.deviation
        return np.asarray(-0.5 * z * z - np.log(self.deviation * np.sqrt(2 * np.pi)))


# At the steps of worse_share, of single frames: 42, 30 of them KITTI's, with 24 errors each of 0.5 deg, 10 cm, or both. The
# authors, with scores over 9 frames and errors of their own, found 0.997 with 0.014 and 0.505 with 0.14.
RIGHT, WRONG = Distribution(0.89, 0.10), Distribution(0.57, 0.15)


def fitted(shares: ArrayLike) -> Distribution:
    """The normal distribution of shares (n,), at least two of them, else BadInputError."""
    shares = np.asarray(shares, float)
    if shares.ndim != 1 or len(shares) < 2:
        raise BadInputError(f"a distribution cannot be fitted to shares of shape {shares.shape}; give at least two frames")
    return Distribution(float(shares.mean()), max(float(shares.std(ddof=1)), RESOLUTION))


def fit(
    scores: Sequence[ManyScore],
    truths: Sequence[Matrix],
    errors: Sequence[Matrix],
    step_deg: float = STEP_DEG,
    step_m: float = STEP_M,
) -> tuple[Distribution, Distribution]:
    """F_C of right and of wrong calibrations, learned where the extrinsic is known.

    scores, truths: of every frame, its score and its T_camera_lidar (4, 4). errors: (4, 4), each put before every truth to
    make it wrong. step_deg, step_m: as of worse_share. BadInputError for fewer than two frames.
    """
    pairs = list(zip(scores, truths, strict=True))
    right = [worse_share(score, T, step_deg, step_m) for score, T in pairs]
    wrong = [worse_share(score, E @ T, step_deg, step_m) for score, T in pairs for E in errors]
    return fitted(right), fitted(wrong)


def probability_right(shares: ArrayLike, right: Distribution = RIGHT, wrong: Distribution = WRONG) -> float:
    """Probability 0..1 that the calibration is right, given F_C of the last frames (w,), and both as likely beforehand.

    By Bayes, the frames taken as independent. Frames of one place are not, and the probability is then too sure of itself.
    """
    return float(expit(np.sum(right.log_density(shares) - wrong.log_density(shares))))
