"""The current extrinsic over time: fuses estimates that fit, rejects the others, and says whether to rely on it."""

from __future__ import annotations

import math
from dataclasses import replace
from enum import Enum
from typing import NamedTuple

import numpy as np

from calib_ros.arrays import Covariance, Transform
from calib_ros.config import Config
from calib_ros.config.online import MANUAL
from calib_ros.online.clocks import ClockEvidence
from calib_ros.online.monitor import Assessment, Verdict, normalised_innovation
from calib_ros.online.pose_filter import KNOWN_Z, SAME_S, OffsetFilter, PoseFilter, without_systematic_error
from calib_ros.online.sensor_health import SensorProblem
from calib_ros.registration.covariance import open_directions
from calib_ros.registration.search.constraints import REFINEMENT_DEG, REFINEMENT_M, pose_constraints
from calib_ros.result import BLINDED, CONVERGED, INITIAL, INSUFFICIENT, MOVED, REFUSED, SUSPECT, TENTATIVE, Extrinsic, Result

SETTLED_DEG, SETTLED_M = 0.3, 0.06  # successive estimates nearer than this agree
UNSETTLING_REJECTIONS = 3  # so many in a row, and the whole box is searched again
# Estimates in a row that must agree with the one before, after the calibration has moved: a few keyframes of one place may share
# a wrong optimum, and 2 did so on a KITTI junction.
RECOVERING = 3


class TrackerState(Enum):
    """What the current extrinsic rests on."""

    INITIAL = "no estimate yet"
    TENTATIVE = "one estimate, to be confirmed"
    CONFIRMED = "estimates and keyframes agree"
    LOST = "it has moved"


class Confirmations(NamedTuple):
    """What confirms an extrinsic. keyframes: consistent ones. estimates: that agree. clocks: 1 = frames that show the offset."""

    keyframes: int = 0
    estimates: int = 0
    clocks: int = 0


NOTHING = Confirmations()


class TrackerEvent(Enum):
    """What changes the state."""

    AGREES_WITH_SAVED = "the first estimate agrees with the saved extrinsic"
    ESTIMATE_ELSEWHERE = "an estimate that nothing confirms yet is accepted"
    ESTIMATE_CONFIRMED = "keyframes, another estimate and the clocks confirm it"
    OTHER_CLOCKS = "an estimate rests on another time offset"
    MOVED = "the monitor or a new search says that it has moved"
    FOUND_AGAIN = "estimates in a row agree, or one was asked for"


S, E = TrackerState, TrackerEvent

# A pair that is not listed cannot happen, and raises a KeyError. Going back to the initial extrinsic makes a new tracker.
TRANSITIONS: dict[tuple[TrackerState, TrackerEvent], TrackerState] = {
    (S.INITIAL, E.AGREES_WITH_SAVED): S.CONFIRMED,
    (S.INITIAL, E.ESTIMATE_ELSEWHERE): S.TENTATIVE,
    (S.INITIAL, E.MOVED): S.LOST,
    (S.INITIAL, E.OTHER_CLOCKS): S.INITIAL,
    (S.TENTATIVE, E.ESTIMATE_CONFIRMED): S.CONFIRMED,
    (S.TENTATIVE, E.ESTIMATE_ELSEWHERE): S.TENTATIVE,
    (S.TENTATIVE, E.OTHER_CLOCKS): S.INITIAL,
    (S.TENTATIVE, E.MOVED): S.LOST,
    (S.CONFIRMED, E.ESTIMATE_ELSEWHERE): S.TENTATIVE,
    (S.CONFIRMED, E.OTHER_CLOCKS): S.INITIAL,
    (S.CONFIRMED, E.MOVED): S.LOST,
    (S.LOST, E.MOVED): S.LOST,  # the monitor, of what an estimate has found meanwhile
    (S.LOST, E.FOUND_AGAIN): S.TENTATIVE,
    (S.LOST, E.OTHER_CLOCKS): S.INITIAL,
}


class Tracker:
    """Holds the current extrinsic. Estimates are gated and fused; the last good transform stays when one is rejected.

    config may be replaced at any time. current: what to publish, a new object after every change. state: what it rests on.
    last_good: the newest extrinsic to rely on, None before the first. settled: successive estimates agree, so that they refine
    instead of searching. sensor_problem: what is wrong with a sensor; None while both work. filter: pose and clocks' offset.
    """

    def __init__(self, initial: Result, current: Result | None = None, config: Config | None = None) -> None:
        """current: the extrinsic to go on with, where it is another than the initial one, which reset() goes back to."""
        self.config = config or Config()
        self.initial = initial
        self._begin(current or initial)

    def _begin(self, result: Result) -> None:
        self.last_good: Result | None = result if result.converged else None
        # Found to have moved with another camera model: see carry_over.
        self.state = TrackerState.LOST if result.status == MOVED else TrackerState.INITIAL
        self.settled = self._has_settled = False
        self._result, self._innovation = result, 0.0
        self._accepted = self._rejected_in_a_row = self._agreeing_in_a_row = 0
        self._accepted_since_moved = 0  # or since the beginning
        self._estimated_at = result.data_stamp
        self._consistent_keyframes, self._agreed = 0, False  # confirmations: keyframes, and another estimate
        self._clocks, offset = ClockEvidence(), OffsetFilter(self.config.motion.time_offset_s)
        offset.restart(result)
        self._objection = result.reason if self.lost else None  # of the monitor
        self.sensor_problem: SensorProblem | None = None
        self._assessment: Assessment | None = None
        self._search_start = result.T_camera_lidar
        self.filter = PoseFilter(self._search_start, self._box_covariance(), offset)
        self.current = self._extrinsic()

    # ---- state --------------------------------------------------------------------------------------------------------

    @property
    def T(self) -> Transform:
        """The current T_camera_lidar (4, 4)."""
        return self._result.T_camera_lidar

    @property
    def lost(self) -> bool:
        """True while the calibration has moved, and no agreement of estimates has confirmed another one."""
        return self.state is TrackerState.LOST

    @property
    def search_center(self) -> Transform:
        """Where to search while not settled (4, 4): the initial extrinsic, until an estimate has been confirmed by another."""
        return self.T if self._has_settled else self._search_start

    @property
    def monitored(self) -> bool:
        """True while there is an extrinsic for the monitor to test: an estimate, or a saved one."""
        return self.last_good is not None and not self.lost

    @property
    def suspect(self) -> bool:
        """True while the monitor has yet to decide whether the extrinsic still holds."""
        return self._objection is not None and not self.lost

    @property
    def steady(self) -> bool:
        """True while estimates agree, the newest was accepted, and nothing speaks against the extrinsic or is still to confirm
        it."""
        return self._in_line and not self.tentative

    @property
    def awaits_motion(self) -> bool:
        """True while it would be steady but for frames of another speed or turn."""
        return self._in_line and self.tentative and self.missing == Confirmations(clocks=1)

    @property
    def _in_line(self) -> bool:
        return self.settled and self._result.status == CONVERGED and not (self.suspect or self.lost)

    @property
    def spread(self) -> Covariance:
        """Random part of the current extrinsic's covariance (6, 6), rad and m: without the systematic error of all estimates."""
        if self._accepted:
            return self.filter.spread
        saved = self._result.covariance
        return np.zeros((6, 6)) if saved is None else without_systematic_error(saved)

    @property
    def clock_sigma_s(self) -> float | None:
        """Standard deviation of the clocks' offset, s, that the extrinsic may have absorbed while no frames have shown it; None
        = as configured."""
        return self.config.motion.max_time_offset_s if self.missing.clocks else None

    @property
    def carry_over(self) -> Result:
        """What another tracker goes on with: the last good extrinsic if there is one; a calibration that has moved stays so."""
        if self.lost:
            reason = self._objection or ""
            return _without_doubts(replace(self._result, T_camera_lidar=self.search_center, status=MOVED, reason=reason), None)
        known = self.last_good or self._result
        if self.tentative:
            return _without_doubts(replace(known, status=INITIAL, reason="not confirmed before"), None)
        return _without_doubts(known, known)

    # ---- changes ------------------------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Go back to the initial extrinsic."""
        self._begin(self.initial)

    def update(
        self, estimate: Result, share_new: float = 1.0, seconds: float = 0.0, on_request: bool = False, covers_all: bool = False
    ) -> Extrinsic:
        """Accept or reject an estimate; returns the current extrinsic afterwards.

        share_new: share of its keyframes that no accepted estimate rests on yet. seconds: of the data's own time since the last
        estimate. on_request: somebody wants it now, so that it may jump. covers_all: it rests on all keyframes that earlier ones
        rest on, and replaces them.
        """
        self.filter.predict(seconds)
        if abs(self.filter.offset.used_s - self.config.motion.time_offset_s) > SAME_S:  # stated anew
            self._start_anew()
            self.filter.offset = OffsetFilter(self.config.motion.time_offset_s)
        if self.suspect and not on_request:  # its keyframes are in question
            return self.current
        if self.filter.offset.differs(estimate) and (self.tentative or on_request):
            self._start_anew()
        why = "" if estimate.converged else estimate.reason or estimate.status
        if estimate.converged and self.settled and not on_request and estimate.covariance is not None:
            why = self.filter.why_too_far(estimate)
        if why:
            self._reject(estimate, why)
        else:
            self._accept(estimate, share_new, on_request, covers_all)
        return self._published()

    def _start_anew(self) -> None:
        """The extrinsic so far rests on a wrong time offset, and nothing has confirmed it: the next estimate is the first one."""
        self._change(TrackerEvent.OTHER_CLOCKS)
        self.settled = self._has_settled = False
        self._accepted_since_moved = self._agreeing_in_a_row = 0
        self._clocks = ClockEvidence()

    def apply(self, assessment: Assessment) -> Extrinsic:
        """Take over the monitor's assessment of the newest keyframes; returns the current extrinsic afterwards."""
        self._assessment = assessment
        if assessment.verdict is Verdict.MOVED:
            self._change(TrackerEvent.MOVED)
            self._search_start, self.settled, self._has_settled = self.T, False, False
            self._accepted_since_moved = self._agreeing_in_a_row = self._rejected_in_a_row = 0
        self._consistent_keyframes += assessment.verdict is Verdict.CONSISTENT
        against = assessment.verdict in (Verdict.SUSPECT, Verdict.MOVED)
        self._objection = assessment.message if against else None
        return self._published()

    def stop_monitoring(self) -> Extrinsic:
        """The monitor is off from now on: an extrinsic that is suspect would stay so for ever."""
        if self.suspect:
            self._objection = None
            self.current = self._extrinsic()
        return self.current

    def set_sensor_problem(self, problem: SensorProblem | None) -> Extrinsic:
        """A sensor shows nothing; None when both work again. Another figure of the same problem changes nothing."""
        if problem != self.sensor_problem:
            self.sensor_problem = problem
            self.current = self._extrinsic()
        return self.current

    # ---- estimates ----------------------------------------------------------------------------------------------------

    def _reject(self, estimate: Result, why: str) -> None:
        self._result = replace(
            self._result,
            status=REFUSED if estimate.converged else estimate.status,
            reason=why,
            frames_used=estimate.frames_used,
            score=estimate.score,
            refusal=estimate.refusal,
            cause=estimate.cause,
            optimum=estimate.optimum,
            optimum_covariance=estimate.optimum_covariance,
        )
        self._rejected_in_a_row += 1
        if self._rejected_in_a_row >= UNSETTLING_REJECTIONS:  # refinement has lost the calibration: the mount may have moved
            self.settled = False

    def _accept(self, estimate: Result, share_new: float, on_request: bool, covers_all: bool) -> None:
        before, (deg, m) = self.T, self.filter.away(estimate)
        saved = self._accepted == 0 and self.last_good is not None
        self._rejected_in_a_row, self._innovation = 0, normalised_innovation(before, estimate.T_camera_lidar)
        near = deg < SETTLED_DEG and m < SETTLED_M
        agrees = near and self._accepted_since_moved > 0
        if near and (self._accepted_since_moved or saved):
            self._agreed = True
            if self.state is TrackerState.INITIAL:
                self._change(TrackerEvent.AGREES_WITH_SAVED)
        elif on_request and self.lost:
            self._consistent_keyframes, self._agreed = 0, False
        elif on_request or not (self.lost or self._has_settled):
            self._change(TrackerEvent.ESTIMATE_ELSEWHERE)
        if on_request:
            self.settled = False
        elif self._has_settled and not self.settled and not self.lost and self.filter.why_too_far(estimate):
            # Rejected estimates have opened the search, and it ended elsewhere: one estimate is not enough to believe that.
            self._change(TrackerEvent.MOVED)
            self._accepted_since_moved, self._search_start = 0, before
        restart = not self.settled or covers_all or self.filter.offset.differs(estimate, KNOWN_Z)
        self._agreeing_in_a_row = self._agreeing_in_a_row + 1 if agrees else 0
        if self.lost and (self._agreeing_in_a_row >= RECOVERING or on_request):
            self._change(TrackerEvent.FOUND_AGAIN)
        self.settled = agrees and not self.lost
        self._has_settled = self._has_settled or agrees
        if self.suspect:  # the monitor's assessment was of another extrinsic
            self._objection, self._assessment = None, None
        self._accepted += 1
        self._accepted_since_moved += 1
        self._clocks.add(estimate, self.config)
        self._estimated_at = estimate.data_stamp
        self._result = self._fused(estimate, share_new, restart)
        if self._result.status == CONVERGED and not self.lost:
            self.last_good = self._result

    def _fused(self, estimate: Result, share_new: float, restart: bool) -> Result:
        """The estimate with the filter's pose and covariance; insufficient while a direction is not known well enough."""
        self.filter.update(estimate, share_new, self._box_covariance(), restart)
        if estimate.covariance is not None:
            # Both are within the limits; the pose between them on SE(3) may be a hair outside.
            limits = pose_constraints(self.initial.T_camera_lidar, self.config.constraints, 1).limits
            self.filter.T = limits.clip(self.filter.T)
        config, covariance = self.config.tracker, self.filter.covariance
        weak = open_directions(covariance, config.max_sigma_deg, config.max_sigma_m)  # more scenes would help there
        if estimate.shared_covariance is not None:
            covariance = covariance + estimate.shared_covariance
        whole = estimate.covariance_with_intrinsics
        if whole is not None and estimate.covariance is not None:
            whole = covariance + whole - estimate.covariance
        hidden = f"the scenes do not show {', '.join(map(str, weak))} well; drive on" if weak else ""
        reason = "; ".join(filter(None, [hidden, estimate.reason]))
        known = self.filter.offset.sigma_s
        return replace(
            estimate,
            time_offset_s=None if known is None else self.filter.offset.used_s,
            time_offset_sigma_s=known,
            stamping=estimate.stamping or self._result.stamping,
            T_camera_lidar=self.filter.T,
            covariance=None if estimate.covariance is None else covariance,
            covariance_with_intrinsics=whole,
            status=INSUFFICIENT if weak else CONVERGED,
            reason=reason,
        )

    def _box_covariance(self) -> Covariance:
        """Covariance (6, 6) of an extrinsic that has not settled: it lies in the search box."""
        search = self.config.search
        deg, m = search.rotation_deg or REFINEMENT_DEG, search.translation_m or REFINEMENT_M
        return np.diag(np.concatenate([np.full(3, np.deg2rad(deg)), np.full(3, m)]) ** 2)

    # ---- states -------------------------------------------------------------------------------------------------------

    def _change(self, event: TrackerEvent) -> None:
        self.state = TRANSITIONS[self.state, event]
        if event in (TrackerEvent.ESTIMATE_ELSEWHERE, TrackerEvent.MOVED):
            self._consistent_keyframes, self._agreed = 0, False

    def _published(self) -> Extrinsic:
        """The new current extrinsic, after a change that may have confirmed it: once confirmed, it stays so."""
        if self.state is TrackerState.TENTATIVE and not self.tentative:
            self._change(TrackerEvent.ESTIMATE_CONFIRMED)
        self.current = self._extrinsic()
        return self.current

    @property
    def tentative(self) -> bool:
        """True while the extrinsic rests on one estimate that neither further keyframes nor another estimate have confirmed."""
        return self.state is TrackerState.TENTATIVE and any(self.missing)

    @property
    def confirmations(self) -> Confirmations:
        """What the current extrinsic needs in all, as far as it is known by now."""
        keyframes, monitored = self.config.tracker.confirmations, self.config.monitor.enabled
        if self.state is TrackerState.CONFIRMED or not keyframes:
            return NOTHING
        if self.state is TrackerState.INITIAL and self.last_good is not None:  # a saved one
            return Confirmations(keyframes=1) if monitored else Confirmations(estimates=1)
        estimates = int(self.config.online.mode != MANUAL or not monitored)  # in mode manual no further one comes
        if self.lost:
            estimates = RECOVERING + 1
        clocks = self._clocks.open and self.config.motion.max_time_offset_s > 0
        return Confirmations(keyframes if monitored else 0, estimates, int(clocks))

    @property
    def missing(self) -> Confirmations:
        """Which of its confirmations the current extrinsic still lacks."""
        needed, agreeing = self.confirmations, int(self._agreed)
        if self.lost:
            agreeing = self._agreeing_in_a_row + min(self._accepted_since_moved, 1)
        keyframes, estimates = needed.keyframes - self._consistent_keyframes, needed.estimates - agreeing
        return Confirmations(max(keyframes, 0), max(estimates, 0), needed.clocks)

    # ---- what is published --------------------------------------------------------------------------------------------

    def _extrinsic(self) -> Extrinsic:
        """The newest result under the status that outweighs the others: moved, blinded, suspect, then the estimate's own."""
        result, assessment = self._result, self._assessment
        blinded = "" if self.sensor_problem is None else self.sensor_problem.message
        if self.lost:
            estimated = self._accepted_since_moved or self._rejected_in_a_row
            more = RECOVERING - self._agreeing_in_a_row
            missing = f"{more} more estimate{'s in a row' if more > 1 else ''} must agree with the new one"
            reason = f"estimate {result.status}: {result.reason or missing}" if estimated else self._objection
            result = result if estimated else _without_doubts(result, result)
            by_hand = "online.mode is manual: call ~/calibrate" if self.config.online.mode == MANUAL else ""
            result = replace(result, status=MOVED, reason="; ".join(filter(None, [reason, by_hand, blinded])))
        elif self.sensor_problem is not None:
            result = _without_doubts(replace(result, status=BLINDED, reason=blinded), result)
        elif self.suspect:
            result = _without_doubts(replace(result, status=SUSPECT, reason=self._objection or ""), result)
        elif result.converged and self.tentative:
            lacking, by = self.missing, "frames of another speed or turn, which show whether the clocks agree"
            if lacking.keyframes:
                by = f"{lacking.keyframes} more keyframe{'s' if lacking.keyframes > 1 else ''}"
            elif lacking.estimates:
                by = "another estimate"
            reason = "; ".join(filter(None, [f"to be confirmed by {by}", result.reason]))
            result = replace(result, status=TENTATIVE, reason=reason)
        elif result.converged and not self._accepted and not self._consistent_keyframes:
            result = replace(result, status=INITIAL, reason=result.reason or "from the saved state, not tested yet")
        told = assessment or Assessment(Verdict.INCONCLUSIVE, "", math.nan)
        monitored = told.message, told.p_value, self._is_usable(result.status), self._estimated_at, told.since_stamp
        return Extrinsic(result, self._innovation, self._accepted, *monitored)

    def _is_usable(self, status: str) -> bool:
        """Is the current extrinsic the last good one, tested since the start, without any objection?

        A single estimate that is refused objects to itself; several in a row to the extrinsic.
        """
        objection = self.tentative or status in (INITIAL, MOVED, BLINDED, SUSPECT)
        if objection or self.last_good is None or not (self._accepted or self._consistent_keyframes):
            return False
        current = np.array_equal(self.last_good.T_camera_lidar, self.T)
        return current and (status == CONVERGED or self._rejected_in_a_row < UNSETTLING_REJECTIONS)


def _without_doubts(result: Result, known: Result | None) -> Result:
    """The result without what an estimate was refused for. known: whose covariances it has, None = none."""
    own, whole = (None, None) if known is None else (known.covariance, known.covariance_with_intrinsics)
    return replace(result, covariance=own, covariance_with_intrinsics=whole, cause=None, refusal=None)
