"""Eq. 3.12 over frames, as the calibrator makes it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib_ros.config import Config
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.objective import FastObjective
from calib_ros.registration.search.constraints import PoseConstraints, unlimited
from calib_ros_thesis.objective import ThesisObjective


def thesis_objective(
    features: Sequence[FrameFeatures], T: np.ndarray, config: Config, constraints: PoseConstraints | None = None
) -> ThesisObjective:
    """features: extracted for it."""
    of_edges = replace(config, refine=replace(config.refine, optimizer="auto"))
    return ThesisObjective(FastObjective(features, T, of_edges, constraints or PoseConstraints(unlimited(T))), T, config)
