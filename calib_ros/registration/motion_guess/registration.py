"""The registration from a guess of the motion, and from whatever else is available where that does not converge."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import BadInputError, CalibrationError, MissingDependencyError, TooFewFeaturesError
from calib_ros.frame import Frame
from calib_ros.registration.acceptance.refusal import joined
from calib_ros.registration.classes import Hypothesis
from calib_ros.registration.features import FeatureExtractor
from calib_ros.registration.initial_guess import MOTION, SEMANTIC, nominal
from calib_ros.registration.motion_guess.guess import motion_guess
from calib_ros.registration.motion_guess.hypotheses import best_registration, better
from calib_ros.registration.search.constraints import NOMINAL_BOX, SearchBox
from calib_ros.result import INSUFFICIENT, InitialSource, RefusalCode, Result

Matrix = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Guesser:
    """Registers frames of which nothing is known.

    register: an initial extrinsic (4, 4) or the name of a guess, and the box around it, to a Result. frames: their number.
    consecutive: those whose motion is used. box: None = as each guess proposes. has_classes: whether SEMANTIC may be tried.
    """

    register: Callable[[Matrix | str, SearchBox | None], Result]
    frames: int
    consecutive: Sequence[Frame]
    extract: FeatureExtractor
    box: SearchBox | None
    has_classes: bool

    def from_motion(self) -> Result:
        """From the hypotheses of the motion. Raises MissingDependencyError as `motion_guess`."""
        try:
            guess = motion_guess(self.consecutive, self.extract, self.extract.config.search.seed)
        except TooFewFeaturesError as error:
            return self._insufficient(error)
        hypotheses = [Hypothesis(T, 1.0, 0.0, MOTION, 0) for T in guess.hypotheses]
        result, _ = best_registration(hypotheses, self.register, self.box or guess.box)
        return replace(result, reason=joined([result.reason, guess.note]), origin=InitialSource.MOTION)

    def from_anything(self) -> Result:
        """The first that converges from motion, from classes where there are some, and from the nominal extrinsic; else the
        best."""
        tried = {}
        try:
            tried[MOTION] = self.from_motion()
        except (BadInputError, MissingDependencyError) as error:
            tried[MOTION] = self._insufficient(error)
        if not tried[MOTION].converged and self.has_classes:
            tried[SEMANTIC] = self.register(SEMANTIC, self.box)
        if not any(result.converged for result in tried.values()):
            start = self.register(nominal(), self.box or NOMINAL_BOX)
            tried["nominal"] = replace(start, origin=InitialSource.NOMINAL)
        best = better(list(tried.values()))
        others = [f"not by {name}: {result.reason}" for name, result in tried.items() if result is not best]
        return replace(best, reason=joined([best.reason, *others]))

    def _insufficient(self, error: CalibrationError) -> Result:
        code = RefusalCode.TOO_FEW_FEATURES
        return Result(nominal(), INSUFFICIENT, str(error), frames_used=self.frames, initial=nominal(), refusal=code)
