"""The extrinsic in force: takes in estimates that hold, turns away those that do not."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.online.monitor import drift
from calib_ros.result import REFUSED, Result

MAX_SIGMA = np.array([np.deg2rad(1.0)] * 3 + [0.3] * 3)  # rad, m; a less certain estimate says nothing
SETTLED_DEG, SETTLED_M = 0.3, 0.06  # successive estimates nearer than this agree
UNSETTLING_REFUSALS = 3  # so many in a row, and the whole box is searched again


@dataclass(frozen=True, eq=False)
class Extrinsic:
    """What the node tells the world: the accepted result, and how the newest estimate compares with it.

    result.status is the newest estimate's status. drift: see monitor.drift. accepted: estimates taken in so far.
    """

    result: Result
    drift: float = 0.0
    accepted: int = 0


class Tracker:
    """Holds the current extrinsic. Estimates are gated; the last good transform stays when one is refused."""

    def __init__(self, initial: Result, current: Result | None = None) -> None:
        self.initial = initial
        self.current = Extrinsic(current or initial)
        self.last_good: Result | None = self.current.result if self.current.result.converged else None
        self.settled = self._confirmed = False
        self._refused = 0
        self._start = self.current.result.T_camera_lidar

    @property
    def T(self) -> NDArray[np.float64]:
        """T_camera_lidar in force (4, 4)."""
        return self.current.result.T_camera_lidar

    @property
    def search_center(self) -> NDArray[np.float64]:
        """Where to search while not settled (4, 4): the initial extrinsic, until an estimate has been confirmed by another."""
        return self.T if self._confirmed else self._start

    def reset(self) -> None:
        """Back to the initial extrinsic."""
        self.current, self.settled = Extrinsic(self.initial), False
        self._confirmed, self._refused = False, 0
        self._start = self.initial.T_camera_lidar
        self.last_good = self.initial if self.initial.converged else None

    def offer(self, estimate: Result) -> Extrinsic:
        """Take in an estimate or turn it away; returns the extrinsic now in force."""
        problem = self._problem(estimate)
        last = self.current
        if problem:
            status = estimate.status if not estimate.converged else REFUSED
            kept = replace(last.result, status=status, reason=problem, frames_used=estimate.frames_used, score=estimate.score)
            self.current = Extrinsic(kept, last.drift, last.accepted)
            self._refused += 1
            if self._refused >= UNSETTLING_REFUSALS:  # refinement has lost the calibration: a mount may have been knocked
                self.settled = False
            return self.current
        self._refused = 0
        moved = drift(self.T, estimate.T_camera_lidar)
        self.settled = last.accepted > 0 and (
            se3.rotation_error_deg(self.T, estimate.T_camera_lidar) < SETTLED_DEG
            and se3.translation_error_m(self.T, estimate.T_camera_lidar) < SETTLED_M
        )
        self._confirmed = self._confirmed or self.settled
        self.last_good = estimate
        self.current = Extrinsic(estimate, moved, last.accepted + 1)
        return self.current

    def _problem(self, estimate: Result) -> str:
        if not estimate.converged:
            return estimate.reason or estimate.status
        if estimate.covariance is not None:
            sigma = np.sqrt(np.diag(estimate.covariance))
            if (sigma > MAX_SIGMA).any():
                deg, m = np.rad2deg(sigma[:3].max()), sigma[3:].max()
                return f"too uncertain (up to {deg:.2f} deg, {m:.2f} m): the scenes show too little; drive on"
        return ""
