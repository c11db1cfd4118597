"""What estimates find of the clocks, in the configuration and in the features of keyframes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib_ros.config import Config, MotionConfig
from calib_ros.config.sensors import ESTIMATE, MAX_OFFSET_S
from calib_ros.registration.features import Features, FrameFeatures, at_time_offset
from calib_ros.registration.stamping import at_stamping, restamped
from calib_ros.result import Result


def with_clocks(config: Config, known: Result) -> Config:
    """The configuration with the time offset, and the stamping, of a result that knows them, where they may be estimated."""
    motion = config.motion
    if known.time_offset_s is None or motion.time_offset != ESTIMATE:
        return config
    if known.stamping is not None and motion.stamping == "auto":
        motion = at_stamping(motion, known.stamping)
    return replace(config, motion=replace(motion, time_offset_s=float(np.clip(known.time_offset_s, -MAX_OFFSET_S, MAX_OFFSET_S))))


def with_clocks_moved(features: Features, before: MotionConfig, after: MotionConfig) -> Features:
    """Features as another configuration of the clocks would have extracted them; those of the thesis's objective stay."""
    if not isinstance(features, FrameFeatures):
        return features
    return at_time_offset(restamped(features, before, after), after.time_offset_s - before.time_offset_s)
