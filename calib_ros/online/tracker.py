"""The current extrinsic: takes in estimates that hold, turns away those that do not, and says whether to rely on it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from calib_ros import se3
from calib_ros.config import Config, TrackerConfig
from calib_ros.config.online import MANUAL
from calib_ros.online.monitor import MOVED_AWAY, RIGHT, SUSPICIOUS, Assessment, normalised_innovation
from calib_ros.registration.constraints import pose_constraints
from calib_ros.registration.covariance import SYSTEMATIC_ERROR, distance, fused, moving, unobservable_directions
from calib_ros.result import BLINDED, CONVERGED, INITIAL, INSUFFICIENT, MOVED, REFUSED, SUSPECT, Extrinsic, Result

# What is believed of the extrinsic over time: a Kalman filter on SE(3) whose state creeps like a random walk.
Matrix = NDArray[np.float64]
BIAS = np.diag(SYSTEMATIC_ERROR**2)  # part of every estimate's covariance; all estimates share it, so fusing does not lower it
MINUTE = 60.0  # s
LEAST = 1e-6  # of the bias; an axis that a prior tells better than the bias would else count as fixed for ever


class PoseFilter:
    """T_camera_lidar (4, 4) with the covariance of a left twist (6, 6), rad and m, without the bias that estimates share."""

    def __init__(self, T: Matrix, spread: Matrix) -> None:
        self.T, self.spread = T, spread

    @property
    def covariance(self) -> Matrix:
        """(6, 6), the bias included; a fixed axis has none."""
        moves = moving(self.spread)
        return np.asarray(self.spread * np.outer(moves, moves) + BIAS * moves)

    def predict(self, seconds: float, config: TrackerConfig) -> None:
        """Time goes by: the mount may have moved a little."""
        step = np.concatenate([np.full(3, np.deg2rad(config.process_noise_deg)), np.full(3, config.process_noise_m)])
        self.spread = self.spread + np.diag(moving(self.spread) * step**2) * max(seconds, 0.0) / MINUTE

    def probability(self, T: Matrix, covariance: Matrix) -> float:
        """How probable an estimate T (4, 4) at least as far away is, if the belief is right."""
        squared, axes = distance(se3.log(T @ se3.inverse(self.T)), self.spread + covariance)
        return float(chi2.sf(squared, axes)) if axes else 1.0

    def update(self, T: Matrix, covariance: Matrix, share_new: float) -> None:
        """Fuse an estimate of which only a share of the frames is new: the others are in the belief already."""
        own = without_bias(covariance) / max(share_new, 1e-3) + LEAST * BIAS * moving(covariance)
        self.T, self.spread = fused(T, own, self.T, self.spread)


def without_bias(covariance: Matrix) -> Matrix:
    """The part of an estimate's covariance (6, 6) that more frames would lower."""
    values, vectors = np.linalg.eigh(covariance - BIAS * moving(covariance))
    return np.asarray((vectors * np.maximum(values, 0)) @ vectors.T)


SETTLED_DEG, SETTLED_M = 0.3, 0.06  # successive estimates nearer than this agree
UNSETTLING_REJECTIONS = 3  # so many in a row, and the whole box is searched again
# Estimates in a row that must agree with the one before, after the calibration has moved: a few keyframes of one place may share
# a wrong optimum, and 2 did so on a KITTI junction.
RECOVERING = 3


class Tracker:
    """Holds the current extrinsic. Estimates are gated and fused; the last good transform stays when one is turned away."""

    def __init__(self, initial: Result, current: Result | None = None, config: Config | None = None) -> None:
        self.config = config or Config()
        self.initial = initial
        self._begin(current or initial)

    def _begin(self, result: Result) -> None:
        self.last_good: Result | None = result if result.converged else None
        self.settled = self._confirmed = False
        self.lost = result.status == MOVED  # found with another camera model: see carried
        self._result, self._innovation = result, 0.0
        self._accepted = self._refused = self._agreed = 0
        self._followed = 0  # estimates taken in since the calibration moved, or since the beginning
        self._doubt, self._blind = result.reason if self.lost else "", ""
        self._finding: Assessment | None = None
        self._start = result.T_camera_lidar
        self.filter = PoseFilter(self._start, self._box())
        self.current = self._told()

    @property
    def T(self) -> NDArray[np.float64]:
        """current T_camera_lidar (4, 4)."""
        return self._result.T_camera_lidar

    @property
    def search_center(self) -> NDArray[np.float64]:
        """Where to search while not settled (4, 4): the initial extrinsic, until an estimate has been confirmed by another."""
        return self.T if self._confirmed else self._start

    @property
    def monitored(self) -> bool:
        """True while there is an extrinsic to be tested by the monitor: an estimate, or a saved one."""
        return self.last_good is not None and not self.lost

    @property
    def spread(self) -> NDArray[np.float64]:
        """Covariance (6, 6) of the current extrinsic without the bias that all estimates share, rad and m."""
        if self._accepted:
            return self.filter.spread
        saved = self._result.covariance
        return np.zeros((6, 6)) if saved is None else without_bias(saved)

    @property
    def carry_over(self) -> Result:
        """What another tracker is to go on with: the last good one if there is one; a calibration that has moved stays so."""
        if self.lost:
            return replace(self._result, T_camera_lidar=self.search_center, status=MOVED, reason=self._doubt, covariance=None)
        return self.last_good or self._result

    @property
    def suspect(self) -> bool:
        """True while the monitor has yet to say whether the extrinsic still holds."""
        return bool(self._doubt) and not self.lost

    def reset(self) -> None:
        """Back to the initial extrinsic."""
        self._begin(self.initial)

    def update(
        self, estimate: Result, share_new: float = 1.0, seconds: float = 0.0, asked: bool = False, whole: bool = False
    ) -> Extrinsic:
        """Take in an estimate or turn it away; returns the current extrinsic after it.

        share_new: of its frames, how many no estimate taken in rests on yet. seconds: of the data's own time since the last one.
        asked: somebody wants it now, so that it may jump. whole: it rests on all that earlier ones rest on, and replaces them.
        """
        self.filter.predict(seconds, self.config.tracker)
        if self.suspect and not asked:  # its frames are in question
            return self.current
        problem = self._problem(estimate, asked)
        if problem:
            self._reject(estimate, problem)
        else:
            self._accept(estimate, share_new, asked, whole)
        self.current = self._told()
        return self.current

    def _reject(self, estimate: Result, problem: str) -> None:
        status = estimate.status if not estimate.converged else REFUSED
        self._result = replace(
            self._result, status=status, reason=problem, frames_used=estimate.frames_used, score=estimate.score
        )
        self._refused += 1
        if self._refused >= UNSETTLING_REJECTIONS:  # refinement has lost the calibration: a mount may have been knocked
            self.settled = False

    def _accept(self, estimate: Result, share_new: float, asked: bool, whole: bool) -> None:
        before, T = self.T, estimate.T_camera_lidar
        self._refused, self._innovation = 0, normalised_innovation(before, T)
        agrees = (
            se3.rotation_error_deg(before, T) < SETTLED_DEG and se3.translation_error_m(before, T) < SETTLED_M
        ) and self._followed > 0
        if asked:
            self.settled = False
        elif self._confirmed and not self.settled and not self.lost and self._too_far(estimate):
            # Refused estimates have opened the search, and it ended elsewhere: one estimate is not enough to believe that.
            self.lost, self._followed, self._start = True, 0, before
        if estimate.covariance is None:
            self.filter = PoseFilter(T, self._box())
        else:
            if not self.settled or whole:  # begins anew, from a box in which anything is as likely
                self.filter, share_new = PoseFilter(before, self._box()), 1.0
            self.filter.update(T, estimate.covariance, share_new)
            # Both are within the limits; what lies between them on SE(3) may be a hair outside.
            limits = pose_constraints(self.initial.T_camera_lidar, self.config.constraints, 1).limits
            self.filter.T = limits.clip(self.filter.T)
        self._agreed = self._agreed + 1 if agrees else 0
        self.lost = self.lost and self._agreed < RECOVERING and not asked
        self.settled = agrees and not self.lost
        self._confirmed = self._confirmed or agrees
        if self._doubt and not self.lost:  # what the monitor said was of another extrinsic
            self._doubt, self._finding = "", None
        self._accepted += 1
        self._followed += 1
        weak = unobservable_directions(self.filter.covariance, self.config.tracker.max_sigma_deg, self.config.tracker.max_sigma_m)
        reason = estimate.reason
        if weak:
            reason = "; ".join(
                filter(None, [f"the scenes do not show {', '.join(map(str, weak))} well; drive on", estimate.reason])
            )
        covariance = None if estimate.covariance is None else self.filter.covariance
        self._result = replace(
            estimate,
            T_camera_lidar=self.filter.T,
            covariance=covariance,
            status=INSUFFICIENT if weak else CONVERGED,
            reason=reason,
        )
        if not weak and not self.lost:
            self.last_good = self._result

    def apply(self, finding: Assessment) -> Extrinsic:
        """What the monitor found with the newest keyframes."""
        self._finding = finding
        if finding.verdict == MOVED_AWAY:
            self.lost, self.settled = True, False
            self._followed = self._agreed = self._refused = 0
            self._start, self._confirmed = self.T, False
        self._doubt = finding.text if finding.verdict in (SUSPICIOUS, MOVED_AWAY) else ""
        self.current = self._told()
        return self.current

    def stop_monitoring(self) -> Extrinsic:
        """Nobody tests the extrinsic any more: what was suspect would stay so for ever."""
        if self.suspect:
            self._doubt = ""
            self.current = self._told()
        return self.current

    def blinded(self, problem: str) -> Extrinsic:
        """A sensor shows nothing, for the reason given; "" when both see again."""
        if problem.partition("(")[0] != self._blind.partition("(")[0]:  # figures in brackets change with every frame
            self._blind = problem
            self.current = self._told()
        return self.current

    def _told(self) -> Extrinsic:
        result, finding = self._result, self._finding
        if self.lost:
            how = f"estimate {result.status}: {result.reason}" if self._followed or self._refused else self._doubt
            if self.config.online.mode == MANUAL:
                how += "; online.mode is manual: call ~/calibrate"
            result = replace(result, status=MOVED, reason="; ".join(filter(None, [how, self._blind])))
        elif self._blind:
            result = replace(result, status=BLINDED, reason=self._blind)
        elif self._doubt:
            result = replace(result, status=SUSPECT, reason=self._doubt)
        elif result.converged and not self._accepted and (finding is None or finding.verdict != RIGHT):
            result = replace(result, status=INITIAL, reason=result.reason or "from the saved state, not tested yet")
        verdict, p_value = ("", math.nan) if finding is None else (finding.text, finding.p_value)
        return Extrinsic(result, self._innovation, self._accepted, verdict, p_value)

    def _problem(self, estimate: Result, asked: bool) -> str:
        """Why an estimate is not to be taken in; empty if it is."""
        if not estimate.converged:
            return estimate.reason or estimate.status
        if not self.settled or asked or estimate.covariance is None:
            return ""
        why = self._too_far(estimate)
        return f"{why}: kept until more keyframes confirm it" if why else ""

    def _too_far(self, estimate: Result) -> str:
        """How far an estimate is from the current extrinsic, in words, if that is farther than it creeps; else empty."""
        limits, T = self.config.tracker, estimate.T_camera_lidar
        deg, m = se3.rotation_error_deg(self.T, T), se3.translation_error_m(self.T, T)
        if deg > limits.max_step_deg or m > limits.max_step_m:
            return (
                f"the estimate is {deg:.2f} deg / {100 * m:.0f} cm away from the current extrinsic, beyond "
                f"{limits.max_step_deg:g} deg / {100 * limits.max_step_m:g} cm"
            )
        if estimate.covariance is not None and self.filter.probability(T, estimate.covariance) < limits.gate:
            return (
                f"the estimate does not fit the current extrinsic ({deg:.2f} deg / {100 * m:.0f} cm away, far beyond what both "
                "leave open)"
            )
        return ""

    def _box(self) -> NDArray[np.float64]:
        """What is known of an extrinsic that has not settled: it lies in the search box."""
        search, refine = self.config.search, self.config.refine
        deg = search.rotation_deg or refine.max_rotation_deg
        m = search.translation_m or refine.max_translation_m
        return np.diag(np.concatenate([np.full(3, np.deg2rad(deg)), np.full(3, m)]) ** 2)
