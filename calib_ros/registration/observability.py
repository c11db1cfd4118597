"""Which directions of the extrinsic the scenes show, and what to do with those that they do not."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3

Matrix = NDArray[np.float64]
# Left twists turn and shift the camera in its own optical axes: x right, y down, z forward.
NAMES = ("pitch", "yaw", "roll", "sideways shift", "vertical shift", "forward shift")
LEAST_VARIANCE = 1e-18  # rad^2, m^2; less is what rounding leaves of an axis that is fixed
TAKES_PART = 0.4  # of the largest component, each in units of its limit: an axis that belongs to a direction


def unseen(covariance: Matrix, max_deg: float, max_m: float) -> list[str]:
    """Directions known less well than max_deg or max_m (standard deviations), in words; empty if there are none.

    covariance: (6, 6) of a left twist, rad and m. A direction may couple axes: pitch looks like a vertical shift where all
    edges are equally far.
    """
    limit = np.concatenate([np.full(3, np.deg2rad(max_deg)), np.full(3, max_m)])
    values, vectors = np.linalg.eigh(covariance / np.outer(limit, limit))
    out = []
    for value, v in zip(values[::-1], vectors.T[::-1], strict=True):
        if value <= 1:
            break
        parts = [k for k in np.argsort(-np.abs(v)) if abs(v[k]) >= TAKES_PART * np.abs(v).max()]
        sigma = np.sqrt(value) * np.abs(v) * limit
        out.append(" with ".join(f"{NAMES[k]} ({_amount(int(k), float(sigma[k]))})" for k in sorted(parts)))
    return out


def _amount(axis: int, sigma: float) -> str:
    if axis < 3:
        return f"{np.rad2deg(sigma):.2f} deg" if sigma < 0.5 else "unknown"
    return f"{100 * sigma:.0f} cm" if sigma < 3 else "unknown"


def moving(covariance: Matrix) -> NDArray[np.bool_]:
    """(6,) axes that a covariance (6, 6) leaves open; a fixed one has no variance."""
    return np.asarray(np.diag(covariance) > LEAST_VARIANCE)


def distance(xi: Matrix, covariance: Matrix) -> tuple[float, int]:
    """Squared length of a twist (6,) in units of its covariance (6, 6), and how many axes it is of: chi squared for so many.

    Fixed axes are left out: two extrinsics with such an axis differ along it by the second order of the others.
    """
    return float(xi @ _inverse(covariance) @ xi), int(moving(covariance).sum())


def _inverse(covariance: Matrix) -> Matrix:
    """Information (6, 6) of a covariance; 0 along fixed axes. In units in which all axes vary alike: beside an axis that is
    unknown, one that is known well would else count as rounding."""
    free = moving(covariance)
    sigma = np.where(free, np.sqrt(np.maximum(np.diag(covariance), LEAST_VARIANCE)), np.inf)
    return np.asarray(np.linalg.pinv(covariance / np.outer(sigma, sigma), rcond=1e-12, hermitian=True) / np.outer(sigma, sigma))


def fused(T: Matrix, covariance: Matrix, T_prior: Matrix, prior: Matrix) -> tuple[Matrix, Matrix]:
    """The extrinsic from an estimate T (4, 4) with covariance (6, 6) and from what was known before, T_prior and `prior`; its
    covariance. Covariances are of left twists, rad and m.

    A Kalman update on SE(3): along a direction that the scenes do not show, the covariance is large and the prior stays.
    """
    xi = se3.log(T @ se3.inverse(T_prior))
    gain = prior @ _inverse(prior + covariance)
    left = np.eye(6) - gain
    after = left @ prior @ left.T + gain @ covariance @ gain.T
    return se3.exp(gain @ xi) @ T_prior, 0.5 * (after + after.T)
