"""Where the extrinsic is looked for: refinements and searches from the one that is checked, near it and far away."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib_ros.arrays import Matrix
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.search.constraints import SearchBox
from calib_ros.result import RefusalCode, Result
from calib_ros_check.alternatives import CheckInputs


class Looks:
    """The looks of one check, one after the other.

    optima: T_camera_lidar (4, 4) of all, whether they match beyond chance or not.
    """

    def __init__(self, inputs: CheckInputs) -> None:
        self.optima: list[Matrix] = []
        self._inputs = inputs

    def match(self, calibrator: Calibrator, features: Sequence[FrameFeatures], box: SearchBox | None) -> Result | None:
        """The match of a refinement (None), or of a search in a box; None if it is one of chance."""
        result = calibrator.estimate(features, self._inputs.T, box, self._inputs.progress)
        optimum = result.T_camera_lidar if result.converged else result.optimum
        if optimum is not None:
            self.optima.append(optimum)
        taken = result.converged or (result.refusal is RefusalCode.WRONG_TIMES and _is_match(result, calibrator))
        return result if taken else None


def match_of(result: Result) -> float:
    """z-score of a match."""
    return result.evidence.z_score if result.evidence is not None else -np.inf


def _is_match(result: Result, calibrator: Calibrator) -> bool:
    """Whether an optimum that is refused for another reason matches beyond chance."""
    return result.evidence is not None and result.evidence.p_value <= calibrator.config.refine.max_p_value
