"""The pose over time: a Kalman filter on SE(3), beside the systematic error that all estimates share."""

from __future__ import annotations

import numpy as np
import scipy

from calib_ros import se3
from calib_ros.arrays import Covariance, Transform
from calib_ros.registration.covariance import distance, free_axes, fused
from calib_ros.registration.objective import SYSTEMATIC_ERROR

# Part of every estimate's covariance. All estimates share it, so that fusing does not lower it.
SYSTEMATIC_COVARIANCE = np.diag(SYSTEMATIC_ERROR**2)
# Of the systematic covariance; an axis that a prior knows better than the systematic error would else count as fixed for ever.
MIN_RANDOM_SHARE = 1e-6
MIN_SHARE_NEW = 1e-3  # an estimate over no new keyframe at all still has a finite covariance
# Per axis and square root of a minute: a mount that warms up in the sun is followed, one that stays is averaged over minutes.
PROCESS_NOISE_DEG, PROCESS_NOISE_M, SECONDS_PER_MINUTE = 0.1, 0.01, 60.0


class PoseFilter:
    """Kalman filter on SE(3) with a random walk as its process model.

    T: T_camera_lidar (4, 4). spread: random part of its covariance (6, 6), of a left twist, rad and m. The systematic error that
    all estimates share is kept apart, so that fusing does not lower it.
    """

    def __init__(self, T: Transform, spread: Covariance) -> None:
        self.T, self.spread = T, spread

    @property
    def covariance(self) -> Covariance:
        """(6, 6), the systematic error included; a fixed axis has none."""
        moves = free_axes(self.spread)
        return np.asarray(self.spread * np.outer(moves, moves) + SYSTEMATIC_COVARIANCE * moves)

    def predict(self, seconds: float) -> None:
        """Add the process noise of a span of time: the mount may have moved a little."""
        step = np.concatenate([np.full(3, np.deg2rad(PROCESS_NOISE_DEG)), np.full(3, PROCESS_NOISE_M)])
        self.spread = self.spread + np.diag(free_axes(self.spread) * step**2) * max(seconds, 0.0) / SECONDS_PER_MINUTE

    def probability(self, T: Transform, covariance: Covariance) -> float:
        """Probability of an estimate T (4, 4) at least this far away, if the filter's pose is right."""
        squared, axes = distance(se3.log(T @ se3.inverse(self.T)), self.spread + covariance)
        return float(scipy.special.chdtrc(axes, max(squared, 0.0))) if axes else 1.0

    def update(self, T: Transform, covariance: Covariance, share_new: float) -> None:
        """Fuse an estimate of whose keyframes only a share is new: the others are in the filter already."""
        own = without_systematic_error(covariance) / max(share_new, MIN_SHARE_NEW)
        own = own + MIN_RANDOM_SHARE * SYSTEMATIC_COVARIANCE * free_axes(covariance)
        self.T, self.spread = fused(T, own, self.T, self.spread)


def without_systematic_error(covariance: Covariance) -> Covariance:
    """The random part of an estimate's covariance (6, 6), which more frames would lower."""
    values, vectors = np.linalg.eigh(covariance - SYSTEMATIC_COVARIANCE * free_axes(covariance))
    return np.asarray((vectors * np.maximum(values, 0)) @ vectors.T)
