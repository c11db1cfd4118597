"""What estimates find of the clocks, in the configuration and in the features of keyframes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib_ros import se3
from calib_ros.arrays import Matrix, Transform
from calib_ros.config import Config, MotionConfig
from calib_ros.config.sensors import FARTHEST_OFFSET_S, MAX_OFFSET_S
from calib_ros.online.monitor import MIN_TWIST
from calib_ros.registration.covariance import unobservable_directions
from calib_ros.registration.features import FrameFeatures, at_time_offset
from calib_ros.registration.joint import at_stamping, clocks_are_estimated, restamped
from calib_ros.registration.judgement.clocks import SIGNIFICANT_Z, STAMP_SCATTER_S
from calib_ros.result import Result

# Standard deviations by which an offset of motion.max_time_offset_s would show: five of six such offsets are then refused.
NOTICED = SIGNIFICANT_Z + 1
# Standard deviations by which an estimate's offset must differ to be another one than that known so far, where nothing has
# confirmed that, and where it is known: by chance one estimate in 20 or 16,000.
UNCONFIRMED_Z, KNOWN_Z = 2.0, 4.0
SAME_S = 1e-3  # s; time offsets nearer than this are the same: no stamps are better


def usable_clocks(config: Config, known: Result) -> Result:
    """The result without what it knows of the clocks, if that does not belong to this configuration: estimated before clocks
    were fixed, or for a stamping that is now stated otherwise."""
    stated = known.stamping is not None and config.motion.stamping != "auto"
    if known.time_offset_s is None or (clocks_are_estimated(config) and not stated):
        return known
    return replace(known, time_offset_s=None, time_offset_sigma_s=None, stamping=None)


def states_same_clocks(before: MotionConfig, after: MotionConfig) -> bool:
    """Whether what a user says of the clocks is the same, so that what was found of them still holds."""
    names = ("time_offset", "time_offset_s", "stamping", "spin", "stamp_azimuth_deg", "stamp_at")
    return all(getattr(before, name) == getattr(after, name) for name in names)


def with_clocks(config: Config, known: Result) -> Config:
    """The configuration with the time offset, how well it is known, and the stamping of a result that knows them."""
    known, motion = usable_clocks(config, known), config.motion
    if known.time_offset_s is None or known.time_offset_s == motion.time_offset_s:
        return config
    if known.stamping is not None:
        motion = at_stamping(motion, known.stamping)
    offset = float(np.clip(known.time_offset_s, -FARTHEST_OFFSET_S, FARTHEST_OFFSET_S))
    sigma = motion.time_offset_sigma_s
    if known.time_offset_sigma_s is not None:  # stamps scatter however well the offset is known
        sigma = min(max(known.time_offset_sigma_s, min(STAMP_SCATTER_S, sigma)), MAX_OFFSET_S)
    return replace(config, motion=replace(motion, time_offset_s=offset, time_offset_sigma_s=sigma))


def with_clocks_moved(features: FrameFeatures, before: MotionConfig, after: MotionConfig) -> FrameFeatures:
    """Features as another configuration of the clocks would have extracted them; what another objective keeps stays."""
    if features.own is not None:
        return features
    return at_time_offset(restamped(features, before, after), after.time_offset_s - before.time_offset_s)


class OffsetFilter:
    """The clocks' offset over time, the seventh unknown of a PoseFilter: a constant of which every estimate tells something.

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
        if self._information > 0:
            # What its own scenes tell: its standard deviation counts what was known before once more.
            own = estimate.time_offset_sigma_s if estimate.clock_sigma_s is None else estimate.clock_sigma_s
            self._add(own, share_new, estimate.time_offset_s)
        else:
            self._add(estimate.time_offset_sigma_s, 1.0, estimate.time_offset_s)
        if abs(self._mean_s - self.used_s) > SAME_S:
            self.used_s = self._mean_s

    def _add(self, sigma_s: float | None, share_new: float, seconds: float) -> None:
        information = share_new / max(MotionConfig.time_offset_sigma_s if sigma_s is None else sigma_s, SAME_S) ** 2
        if information > 0:
            self._information += information
            self._mean_s += (seconds - self._mean_s) * information / self._information


def at_offset(estimate: Result, seconds: float) -> Transform:
    """T_camera_lidar (4, 4) of an estimate if the clocks' offset were another one, s."""
    T, direction, own = estimate.T_camera_lidar, estimate.clock_direction, estimate.time_offset_s
    return T if own is None or direction is None else se3.exp(direction * (seconds - own)) @ T


class SeenMotion:
    """How the keyframes in the last estimate move: those of another speed or turn tell of the clocks.

    newest: stamp of the newest of them, ns, None before the first estimate.
    """

    def __init__(self) -> None:
        self.newest: int | None = None
        self._lowest = self._highest = np.full(6, np.nan)

    def learn(self, keyframes: Sequence[FrameFeatures]) -> None:
        """Those in an estimate, oldest first."""
        self.newest = keyframes[-1].stamp
        if len(twists := _twists(keyframes)):
            self._lowest, self._highest = twists.min(axis=0), twists.max(axis=0)

    def covers(self, keyframes: Sequence[FrameFeatures]) -> bool:
        """Whether none of these moves otherwise, by what counts as a motion."""
        twists = _twists(keyframes)
        return bool((twists >= self._lowest - MIN_TWIST).all() and (twists <= self._highest + MIN_TWIST).all())


def _twists(keyframes: Sequence[FrameFeatures]) -> Matrix:
    return np.array([f.twist for f in keyframes if f.twist is not None]).reshape(-1, 6)


class ClockEvidence:
    """Has an accepted estimate shown that the clocks agree? If not, is one open to an offset? Estimates at rest are neither.

    Each has to show it alone: what keyframes of one road have in common does not average out over several estimates.
    """

    def __init__(self) -> None:
        self.open = self._shown = False

    def add(self, estimate: Result, config: Config) -> None:
        """An accepted estimate."""
        direction, sigma, largest = estimate.clock_direction, estimate.clock_sigma_s, config.motion.max_time_offset_s
        if direction is None or sigma is None:
            return

        def leaves_open(seconds: float) -> bool:
            """Could an offset of the clocks that nobody has noticed, of this standard deviation, have moved the estimate? Where
            the vehicle always moves alike, an offset looks like another mount."""
            covariance = np.outer(direction, direction) * seconds**2
            return bool(unobservable_directions(covariance, config.tracker.max_sigma_deg, config.tracker.max_sigma_m))

        matters = sigma > 0 and leaves_open(largest)
        noticed = matters and (largest / sigma) ** 2 - 1 >= NOTICED**2  # by how much less is known of the offset in advance
        is_open = matters and (leaves_open(sigma) or not noticed)
        self._shown = self._shown or (matters and not is_open)
        self.open = is_open and not self._shown
