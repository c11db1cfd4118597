"""Two LiDARs while they drive: their scans registered now and then, fused over time, and whether the newest still fit. Where they
share no view, hand-eye of how both move from one scan to the next."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from itertools import combinations

import numpy as np
import scipy

from calib_ros import se3
from calib_ros.arrays import Covariance, Matrix, Transform
from calib_ros.config import RefineConfig
from calib_ros.errors import TooFewFeaturesError
from calib_ros.online.pacing import LONGEST_REST_S, REST_SPACING_S
from calib_ros.result import CONVERGED, INITIAL, INSUFFICIENT, MOVED, SUSPECT, Consumer, Extrinsic, Result
from calib_ros.rig.graph import SIGNIFICANCE, Edge, at_sensor, worst_sigmas
from calib_ros.rig.lidars import (
    MIN_MOTIONS,
    MOTION_KIND,
    SCANS,
    SCANS_KIND,
    SHARED,
    LidarScans,
    Registration,
    fused,
    hand_eye_edge,
    register,
    shared_share,
)

# Between registrations, s: until there are as many as are of use or while there is doubt, and at rest, with the keyframes.
QUICK_S, REST_S = 1.0, REST_SPACING_S[1]
LEAST = 3  # registrations of an edge: of two, either may be wrong
CONFIRM = 3  # that contradict the edge and agree with each other are a displacement, as many as keyframes of a camera
FAILED = 3  # registrations in a row, after which the edge is not relied on
MOTIONS = 120  # that hand-eye is made of: two minutes of driving
STEP_S = 0.1  # of which a velocity is taken for a motion, as long as a scan lasts
STANDING_M_S = 0.2  # below it the scene is the same as before: another scan of it tells nothing new


class LidarPair:
    """What is known of T_target_source. extrinsic: its estimate, the target in place of the camera. clock_sigma_s: standard
    deviation of the offset of the clocks. limits: what motion alone has to tell it to. Not thread-safe, but for reading
    `extrinsic`."""

    def __init__(self, target: str, source: str, clock_sigma_s: float, limits: RefineConfig) -> None:
        self.target, self.source, self._clock_sigma_s, self._limits = target, source, clock_sigma_s, limits
        self._motions: deque[tuple[Transform, Transform]] = deque(maxlen=MOTIONS)  # of both, while their scans do not match
        self._by_motion: Edge | None = None
        self._found: deque[Registration] = deque(maxlen=SCANS)
        self._against: deque[Registration] = deque(maxlen=CONFIRM)
        self._edge: tuple[Edge, float] | None = None  # with the scale of information
        self._failures = 0
        self.extrinsic = Extrinsic(Result(np.eye(4), INITIAL, "no scans of the same moment yet"))

    @property
    def every_s(self) -> float:
        """How often scans are to be registered."""
        if self._edge is None and self._motions:
            return QUICK_S if len(self._motions) < MOTIONS else REST_S
        if self._edge is None:
            return min(QUICK_S * 2.0**self._failures, LONGEST_REST_S)
        doubtful = self._failures or self._against or len(self._found) < SCANS
        return QUICK_S if doubtful else REST_S

    def add(self, a: LidarScans, b: LidarScans, T: Transform) -> None:
        """Register the newest scans of target and source. T: T_target_source (4, 4) to start from before there is an edge. Raises
        MissingDependencyError."""
        start = T if self._edge is None else self._edge[0].T
        (A, twist), (B, _) = a.still(len(a) - 1), b.still(len(b) - 1)
        try:
            if self._edge is None and shared_share(A, se3.transform(T, B)) < SHARED:
                raise TooFewFeaturesError("by their priors they share no view")
            self._take(register(A, B, start, twist, float(b.stamps[-1] - a.stamps[-1]) * 1e-9))
        except TooFewFeaturesError as error:
            self._failures += 1
            lost = self._edge is not None and self._failures >= FAILED
            self.say(SUSPECT if lost else self.extrinsic.result.status, str(error))
            if self._edge is None:
                self._follow(a.twist(len(a) - 1), b.twist(len(b) - 1), T)

    def _follow(self, of_target: Matrix | None, of_source: Matrix | None, T: Transform) -> None:
        """Hand-eye with the newest velocities (6,) as well."""
        if of_target is None or of_source is None or np.linalg.norm(of_target[3:]) < STANDING_M_S:
            return
        self._motions.append((se3.exp(of_target * STEP_S), se3.exp(of_source * STEP_S)))
        if len(self._motions) < MIN_MOTIONS:
            return
        A, B = (np.array(motions) for motions in zip(*self._motions, strict=True))
        self._by_motion = edge = hand_eye_edge(self.target, self.source, A, B, T)
        C = at_sensor(edge.T, edge.covariance)
        known = Consumer(self.source, self._limits.tolerance_deg, self._limits.tolerance_m).is_served(C)
        deg, m = worst_sigmas(C)
        uncertain = f"how both move tells it to {deg:.2f} deg and {100 * m:.0f} cm, 1 sigma"
        self.say(CONVERGED if known else INSUFFICIENT, "" if known else uncertain)

    @property
    def kind(self) -> str:
        """Of the edge."""
        return SCANS_KIND if self._edge is not None or self._by_motion is None else MOTION_KIND

    def _take(self, new: Registration) -> None:
        self._failures, status = 0, CONVERGED
        if self._edge is None or self._fits(new, *self._edge):
            standing = max(np.linalg.norm(r.twist[3:]) for r in (new, *list(self._found)[-1:])) < STANDING_M_S
            if standing and len(self._found) > LEAST:
                self._found.pop()
            self._found.append(new)
            self._against.clear()
        else:
            self._against.append(new)
            (edge, scale), pairs = self._edge, combinations(self._against, 2)
            agree = all(self._is_same(a.T, b.T, edge.covariance, scale, a, b) for a, b in pairs)
            status = MOVED if len(self._against) == CONFIRM and agree else SUSPECT
        if status == MOVED:  # until the next one
            self._found = deque(self._against, SCANS)
            self._against.clear()
        if status != SUSPECT and len(self._found) >= LEAST:
            self._edge = fused(self.target, self.source, self._found, self._clock_sigma_s)
        reason = f"the newest scans of {self.target} and {self.source} match elsewhere" if status in (SUSPECT, MOVED) else ""
        if self._edge is not None:
            self.say(status, reason)
        elif self._by_motion is None:
            self.say(INITIAL, "too few registrations yet")

    def _fits(self, new: Registration, edge: Edge, scale: float) -> bool:
        """Whether a registration may be of the transform of the edge, the clocks being off by what the edge says."""
        offset, sigma_s = edge.time_offset_s or 0.0, edge.time_sigma_s or 0.0
        C = edge.covariance + np.outer(new.twist, new.twist) * sigma_s**2
        return self._is_same(new.T, se3.exp(new.twist * offset) @ edge.T, C, scale, new)

    def _is_same(self, a: Transform, b: Transform, C: Covariance, scale: float, *measured: Registration) -> bool:
        """Whether transforms differ by what chance explains: by a covariance, and those of registrations of a common scale, which
        is known from all that were found."""
        xi = se3.log(a @ se3.inverse(b))
        C = sum((np.asarray(np.linalg.inv(new.information) * scale) for new in measured), C)
        n = len(self._found)
        return bool(scipy.special.fdtrc(6, 6 * max(n - 1, 1), float(xi @ np.linalg.solve(C, xi)) / 6) > SIGNIFICANCE)

    def say(self, status: str, reason: str) -> None:
        """Another status of what is known, and why, for a person."""
        edge, result = self._by_motion if self._edge is None else self._edge[0], Result(np.eye(4), status, reason)
        if edge is not None:
            result = replace(result, T_camera_lidar=edge.T, covariance=edge.covariance, frames_used=edge.samples)
            result = replace(result, time_offset_s=edge.time_offset_s, time_offset_sigma_s=edge.time_sigma_s)
        self.extrinsic = Extrinsic(result, accepted=int(edge is not None), usable=edge is not None and status == CONVERGED)
