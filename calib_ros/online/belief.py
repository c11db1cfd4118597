"""What is believed of the extrinsic over time: a Kalman filter on SE(3) whose state creeps like a random walk."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from calib_ros import se3
from calib_ros.config import TrackerConfig
from calib_ros.registration.observability import distance, fused, moving
from calib_ros.registration.uncertainty import FLOOR

Matrix = NDArray[np.float64]
BIAS = np.diag(FLOOR**2)  # part of every estimate's covariance; all estimates share it, so fusing does not lower it
MINUTE = 60.0  # s
LEAST = 1e-6  # of the bias; an axis that a prior tells better than the bias would else count as fixed for ever


class Belief:
    """T_camera_lidar (4, 4) with the covariance of a left twist (6, 6), rad and m, without the bias that estimates share."""

    def __init__(self, T: Matrix, spread: Matrix) -> None:
        self.T, self.spread = T, spread

    @property
    def covariance(self) -> Matrix:
        """(6, 6), the bias included; a fixed axis has none."""
        moves = moving(self.spread)
        return np.asarray(self.spread * np.outer(moves, moves) + BIAS * moves)

    def creep(self, seconds: float, config: TrackerConfig) -> None:
        """Time goes by: the mount may have moved a little."""
        step = np.concatenate([np.full(3, np.deg2rad(config.drift_deg)), np.full(3, config.drift_m)])
        self.spread = self.spread + np.diag(moving(self.spread) * step**2) * max(seconds, 0.0) / MINUTE

    def probability(self, T: Matrix, covariance: Matrix) -> float:
        """How probable an estimate T (4, 4) at least as far away is, if the belief is right."""
        squared, axes = distance(se3.log(T @ se3.inverse(self.T)), self.spread + covariance)
        return float(chi2.sf(squared, axes)) if axes else 1.0

    def take_in(self, T: Matrix, covariance: Matrix, share_new: float) -> None:
        """Fuse an estimate of which only a share of the frames is new: the others are in the belief already."""
        own = without_bias(covariance) / max(share_new, 1e-3) + LEAST * BIAS * moving(covariance)
        self.T, self.spread = fused(T, own, self.T, self.spread)


def without_bias(covariance: Matrix) -> Matrix:
    """The part of an estimate's covariance (6, 6) that more frames would lower."""
    values, vectors = np.linalg.eigh(covariance - BIAS * moving(covariance))
    return np.asarray((vectors * np.maximum(values, 0)) @ vectors.T)
