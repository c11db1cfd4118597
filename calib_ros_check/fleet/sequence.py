"""Extrinsics of one vehicle in the order of time, as vectors with covariances, and how much they scatter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from calib_ros import se3
from calib_ros.arrays import Matrix

FLOOR = 1e-12  # rad^2, m^2; keeps a covariance of zeros invertible
# Differences of an axis from which its own scatter is estimated; of fewer, the median is less certain than the assumption that
# the three axes of rotation, and those of translation, scatter alike.
OWN_SCATTER = 60
MOST = 1e3  # times the usual variance: how much scatter is looked for


@dataclass(frozen=True, eq=False)
class Extrinsics:
    """Estimates of one extrinsic, in the order of time.

    values: (n, 6), rotation vector of R R_0^T and t - t_0 in the camera's axes, rad and m, against a common one of them.
    covariances: (n, 6, 6) of these.
    """

    values: Matrix
    covariances: Matrix

    def __len__(self) -> int:
        return len(self.values)

    def with_scatter(self, variances: Matrix) -> Extrinsics:
        """With the variances (6,) between recordings added to the covariances."""
        return Extrinsics(self.values, self.covariances + np.diag(variances))

    def at(self, positions: NDArray[np.intp]) -> Extrinsics:
        """Some of them."""
        return Extrinsics(self.values[positions], self.covariances[positions])


def extrinsics(transforms: ArrayLike, covariances: ArrayLike) -> Extrinsics:
    """From T_camera_lidar (n, 4, 4) and the covariances (n, 6, 6) of their left twists.

    The common one is that which turns least against all others, so that a few wrong ones do not matter.
    """
    T, C = np.asarray(transforms, float).reshape(-1, 4, 4), np.asarray(covariances, float).reshape(-1, 6, 6)
    if not len(T):
        return Extrinsics(np.zeros((0, 6)), np.zeros((0, 6, 6)))
    R, t = T[:, :3, :3], T[:, :3, 3]
    turns = np.arccos(np.clip((np.einsum("nij,mij->nm", R, R) - 1) / 2, -1, 1))
    common = int(np.argmin(np.median(turns, axis=1)))
    values = np.concatenate([Rotation.from_matrix(R @ R[common].T).as_rotvec(), t - t[common]], axis=1)
    A = np.array([se3.parts_jacobian(own) for own in T])
    return Extrinsics(values, A @ C @ np.swapaxes(A, 1, 2) + FLOOR * np.eye(6))


def scatter(sequences: Sequence[Extrinsics]) -> Matrix:
    """Variances (6,), rad^2 and m^2, by which recordings differ beyond their covariances: other scenes, loads, tyres.

    From the differences of successive recordings of each vehicle, which a change of the mount moves once and a wrong recording
    twice: the median of their squares, in units of their variances, is that of chi^2. Zero where the covariances explain them.
    """
    pairs = [own for own in sequences if len(own) > 1]
    if not pairs:
        return np.zeros(6)
    squares = np.concatenate([np.diff(own.values, axis=0) ** 2 for own in pairs])
    diagonals = [np.diagonal(own.covariances, axis1=1, axis2=2) for own in pairs]
    variances = np.concatenate([own[1:] + own[:-1] for own in diagonals])
    alike = [_excess(squares[:, part].ravel(), variances[:, part].ravel()) for part in (slice(0, 3), slice(3, 6))]
    if len(squares) < OWN_SCATTER:
        return np.repeat(alike, 3)
    return np.array([_excess(squares[:, axis], variances[:, axis]) for axis in range(6)])


def _excess(squares: Matrix, variances: Matrix) -> float:
    """Variance per recording, which differences of two have twice, that is missing in `variances` (n,) of differences."""
    wanted = float(chi2.median(1))

    def median(excess: float) -> float:
        return float(np.median(squares / (variances + 2 * excess)))

    if median(0.0) <= wanted:
        return 0.0
    low, high = 0.0, MOST * float(np.median(squares))
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if median(middle) > wanted else (low, middle)
    return high
