"""What estimates find of the clocks, in the configuration and in the features of keyframes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib_ros.config import Config, MotionConfig
from calib_ros.config.sensors import MAX_OFFSET_S
from calib_ros.registration.features import FrameFeatures, at_time_offset
from calib_ros.registration.joint import clocks_are_estimated
from calib_ros.registration.nuisance.stamping import at_stamping, restamped
from calib_ros.result import Result


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
    offset = float(np.clip(known.time_offset_s, -MAX_OFFSET_S, MAX_OFFSET_S))
    sigma = motion.time_offset_sigma_s if known.time_offset_sigma_s is None else min(known.time_offset_sigma_s, MAX_OFFSET_S)
    return replace(config, motion=replace(motion, time_offset_s=offset, time_offset_sigma_s=sigma))


def with_clocks_moved(features: FrameFeatures, before: MotionConfig, after: MotionConfig) -> FrameFeatures:
    """Features as another configuration of the clocks would have extracted them; what another objective keeps stays."""
    if features.own is not None:
        return features
    return at_time_offset(restamped(features, before, after), after.time_offset_s - before.time_offset_s)
