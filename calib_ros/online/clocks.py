"""What estimates find of the clocks, in the configuration and in the features of keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib_ros.arrays import Matrix
from calib_ros.config import Config, MotionConfig
from calib_ros.config.sensors import FARTHEST_OFFSET_S, MAX_OFFSET_S
from calib_ros.frame import NANOSECONDS
from calib_ros.online.monitor import MIN_TWIST
from calib_ros.registration.covariance import open_directions
from calib_ros.registration.features import FrameFeatures, at_time_offset
from calib_ros.registration.joint import at_stamping, clocks_are_estimated, restamped
from calib_ros.registration.judgement.clocks import SIGNIFICANT_Z, STAMP_SCATTER_S
from calib_ros.result import Result

# Standard deviations by which an offset of motion.max_time_offset_s would show: five of six such offsets are then refused.
NOTICED = SIGNIFICANT_Z + 1


def usable_clocks(config: Config, known: Result) -> Result:
    """The result without what it knows of the clocks, if that does not belong to this configuration: estimated before clocks
    were fixed, or for a stamping that is now stated otherwise."""
    stated = known.stamping is not None and config.motion.stamping != "auto"
    if known.time_offset_s is None or (clocks_are_estimated(config) and not stated):
        return known
    return replace(known, time_offset_s=None, time_offset_sigma_s=None, stamping=None)


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


def with_clocks_kept(config: Config, stated: MotionConfig, used: MotionConfig, known: Result) -> Config:
    """Another configuration with what was found of the clocks, unless it states other ones. stated: before. used: what estimates
    have made of it. known: the newest."""
    if config.motion == stated:
        return replace(config, motion=used)
    names = ("time_offset", "time_offset_s", "stamping", "spin", "stamp_azimuth_deg", "stamp_at")
    same = all(getattr(stated, name) == getattr(config.motion, name) for name in names)
    return with_clocks(config, known) if same else config


def with_clocks_moved(features: FrameFeatures, before: MotionConfig, after: MotionConfig) -> FrameFeatures:
    """Features as another configuration of the clocks would have extracted them; what another objective keeps stays."""
    if features.own is not None:
        return features
    return at_time_offset(restamped(features, before, after), after.time_offset_s - before.time_offset_s)


class SeenMotion:
    """How the keyframes in the last estimate move: those of another speed or turn tell of the clocks.

    newest: stamp of the newest of them, ns, None before the first estimate.
    """

    def __init__(self) -> None:
        self.newest: int | None = None
        self._lowest = self._highest = np.full(6, np.nan)

    def learn(self, keyframes: Sequence[FrameFeatures]) -> float:
        """Those in an estimate, oldest first; returns how much newer they are than those in the last one, s, 0 = unknown."""
        if not keyframes:
            return 0.0
        before, self.newest = self.newest, keyframes[-1].stamp
        if len(twists := _twists(keyframes)):
            self._lowest, self._highest = twists.min(axis=0), twists.max(axis=0)
        return 0.0 if before is None else (self.newest - before) / NANOSECONDS

    def covers(self, keyframes: Sequence[FrameFeatures], new: int) -> bool:
        """Whether none of the newest `new` keyframes moves otherwise, by what counts as a motion."""
        twists = _twists(keyframes[max(len(keyframes) - new, 0) :])
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
            return bool(open_directions(covariance, config.tracker.max_sigma_deg, config.tracker.max_sigma_m))

        matters = sigma > 0 and leaves_open(largest)
        noticed = matters and (largest / sigma) ** 2 - 1 >= NOTICED**2  # by how much less is known of the offset in advance
        is_open = matters and (leaves_open(sigma) or not noticed)
        self._shown = self._shown or (matters and not is_open)
        self.open = is_open and not self._shown
