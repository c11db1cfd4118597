"""The extrinsic over time: a Kalman filter on SE(3) and on the clocks' offset.

The systematic error that all estimates share is kept apart, so that fusing does not lower it.
"""

from __future__ import annotations

import math

import numpy as np
import scipy

from calib_ros import se3
from calib_ros.arrays import Covariance, Transform
from calib_ros.config import MotionConfig
from calib_ros.registration.covariance import distance, free_axes, fused
from calib_ros.registration.objective import SYSTEMATIC_ERROR
from calib_ros.result import Result

# Part of every estimate's covariance. All estimates share it, so that fusing does not lower it.
SYSTEMATIC_COVARIANCE = np.diag(SYSTEMATIC_ERROR**2)
# Of the systematic covariance; an axis that a prior knows better than the systematic error would else count as fixed for ever.
MIN_RANDOM_SHARE = 1e-6
MIN_SHARE_NEW = 1e-3  # an estimate over no new keyframe at all still has a finite covariance
# Per axis and square root of a minute: a mount that warms up in the sun is followed, one that stays is averaged over minutes.
PROCESS_NOISE_DEG, PROCESS_NOISE_M, SECONDS_PER_MINUTE = 0.1, 0.01, 60.0
# An estimate farther from a settled extrinsic, or less probable given it, is rejected: a mount that drifts does not jump.
MAX_STEP_DEG, MAX_STEP_M = 1.0, 0.15
GATE = 1e-4
# Standard deviations by which an estimate's offset must differ to be another one than that known so far, where nothing has
# confirmed that, and where it is known: by chance one estimate in 20 or 16,000.
UNCONFIRMED_Z, KNOWN_Z = 2.0, 4.0
SAME_S = 1e-3  # s; time offsets nearer than this are the same: no stamps are better


class OffsetFilter:
    """The clocks' offset over time: a constant of which every estimate tells something.

    used_s: the offset that the extrinsic belongs to. It follows what is known of it in steps that count: points of all keyframes
    move with it.
    """

    def __init__(self, used_s: float) -> None:
        self.used_s, self._mean_s, self._information = used_s, used_s, 0.0

    @property
    def sigma_s(self) -> float | None:
        """Standard deviation, s; None if no estimate has told."""
        return float(self._information**-0.5) if self._information > 0 else None

    def differs(self, estimate: Result, deviations: float = UNCONFIRMED_Z) -> bool:
        """Does an estimate belong to another offset, by so many standard deviations of both, or to other stamps?"""
        if not estimate.converged or estimate.time_offset_s is None:
            return False
        sigma = math.hypot(estimate.time_offset_sigma_s or 0.0, self.sigma_s or 0.0)
        return estimate.stamping is not None or abs(estimate.time_offset_s - self.used_s) > max(deviations * sigma, SAME_S)

    def restart(self, estimate: Result) -> None:
        """Forget what was known; where the estimate tells nothing, keep it."""
        if estimate.time_offset_s is not None:
            self.used_s, self._mean_s, self._information = estimate.time_offset_s, estimate.time_offset_s, 0.0
            self._add(estimate.time_offset_sigma_s, 1.0, estimate.time_offset_s)

    def update(self, estimate: Result, share_new: float) -> None:
        """Fuse an estimate of whose keyframes only a share is new."""
        if estimate.time_offset_s is None:
            return
        sigma_s = estimate.time_offset_sigma_s
        if self._information <= 0:
            share_new = 1.0
        elif estimate.clock_sigma_s is not None:
            # What its own scenes tell: its standard deviation counts what was known before once more.
            sigma_s = estimate.clock_sigma_s
        self._add(sigma_s, share_new, estimate.time_offset_s)
        if abs(self._mean_s - self.used_s) > SAME_S:
            self.used_s = self._mean_s

    def _add(self, sigma_s: float | None, share_new: float, seconds: float) -> None:
        information = share_new / max(MotionConfig.time_offset_sigma_s if sigma_s is None else sigma_s, SAME_S) ** 2
        if information > 0:
            self._information += information
            self._mean_s += (seconds - self._mean_s) * information / self._information


class PoseFilter:
    """Kalman filter on SE(3) with a random walk as its process model, and the clocks' offset as the seventh unknown.

    T: T_camera_lidar (4, 4). spread: random part of its covariance (6, 6), of a left twist, rad and m. offset: of the clocks, to
    which T belongs. keyframes: how many the covariance rests on.
    """

    def __init__(self, T: Transform, spread: Covariance, offset: OffsetFilter | None = None) -> None:
        self.T, self.spread, self.offset = T, spread, offset or OffsetFilter(0.0)
        self.keyframes = 0.0

    @property
    def covariance(self) -> Covariance:
        """(6, 6), the systematic error included; a fixed axis has none."""
        moves = free_axes(self.spread)
        return np.asarray(self.spread * np.outer(moves, moves) + SYSTEMATIC_COVARIANCE * moves)

    def predict(self, seconds: float) -> None:
        """Add the process noise of a span of time: the mount may have moved a little."""
        step = np.concatenate([np.full(3, np.deg2rad(PROCESS_NOISE_DEG)), np.full(3, PROCESS_NOISE_M)])
        self.spread = self.spread + np.diag(free_axes(self.spread) * step**2) * max(seconds, 0.0) / SECONDS_PER_MINUTE

    def at_offset(self, estimate: Result) -> Transform:
        """T_camera_lidar (4, 4) of an estimate if its clocks' offset were that of the filter: what one estimate takes for a late
        image and another for a shift is no movement."""
        T, direction, own = estimate.T_camera_lidar, estimate.clock_direction, estimate.time_offset_s
        return T if own is None or direction is None else se3.exp(direction * (self.offset.used_s - own)) @ T

    def away(self, estimate: Result) -> tuple[float, float]:
        """Angle, deg, and distance, m, of an estimate from the filter's pose."""
        T = self.at_offset(estimate)
        return se3.rotation_error_deg(self.T, T), se3.translation_error_m(self.T, T)

    def why_too_far(self, estimate: Result) -> str:
        """Why an estimate is farther from the filter's pose than the process noise allows for; "" if it is not."""
        (deg, m), covariance = self.away(estimate), estimate.covariance
        away, kept = f"{deg:.2f} deg / {100 * m:.0f} cm away", "kept until more keyframes confirm it"
        if deg > MAX_STEP_DEG or m > MAX_STEP_M:
            limits = f"{MAX_STEP_DEG:g} deg / {100 * MAX_STEP_M:g} cm"
            return f"the estimate is {away} from the current extrinsic, beyond {limits}: {kept}"
        if covariance is not None and self.probability(self.at_offset(estimate), covariance) < GATE:
            return f"the estimate does not fit the current extrinsic ({away}, far beyond the uncertainty of both): {kept}"
        return ""

    def probability(self, T: Transform, covariance: Covariance) -> float:
        """Probability of an estimate T (4, 4) at least this far away, if the filter's pose is right."""
        squared, axes = distance(se3.log(T @ se3.inverse(self.T)), self.spread + covariance)
        return float(scipy.special.chdtrc(axes, max(squared, 0.0))) if axes else 1.0

    def update(self, estimate: Result, share_new: float, box: Covariance, restart: bool) -> None:
        """Fuse an estimate of whose keyframes only a share is new: the others are in the filter already.

        box: (6, 6), of an extrinsic of which nothing is known yet. restart: from there, instead of from earlier estimates.
        """
        before, covariance = self.offset.used_s, estimate.covariance
        if restart:
            self.offset.restart(estimate)
        else:
            self.offset.update(estimate, share_new)
        if covariance is None:
            self.T, self.spread = estimate.T_camera_lidar, box
            return
        if restart:
            self.spread, share_new, self.keyframes = box, 1.0, 0.0
        elif estimate.clock_direction is not None:
            self.T = se3.exp(estimate.clock_direction * (self.offset.used_s - before)) @ self.T
        self.keyframes += share_new * estimate.frames_used
        covariance = covariance - (np.zeros((6, 6)) if estimate.shared_covariance is None else estimate.shared_covariance)
        own = without_systematic_error(covariance) / max(share_new, MIN_SHARE_NEW)
        own = own + MIN_RANDOM_SHARE * SYSTEMATIC_COVARIANCE * free_axes(covariance)
        self.T, self.spread = fused(self.at_offset(estimate), own, self.T, self.spread)


def without_systematic_error(covariance: Covariance) -> Covariance:
    """The random part of an estimate's covariance (6, 6), which more frames would lower."""
    values, vectors = np.linalg.eigh(covariance - SYSTEMATIC_COVARIANCE * free_axes(covariance))
    return np.asarray((vectors * np.maximum(values, 0)) @ vectors.T)
