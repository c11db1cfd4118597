"""What a method of calibration is, to those who compare several."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from calib_ros.frame import Frame
from calib_ros.registration.scores import Score
from calib_ros.registration.search_box import SearchBox

Matrix = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Step:
    """The best extrinsic T_camera_lidar (4, 4) after so many evaluations of the score and so many CPU seconds."""

    evaluations: int
    cpu_s: float
    T: Matrix


@dataclass(frozen=True, eq=False)
class Outcome:
    """Where a method ended. T: T_camera_lidar (4, 4), the start if refused. score: of T. evaluations: of the score.

    trace: the start, and every better extrinsic on the way. refused: why the method itself does not trust its optimum; empty if
    it does, or has no test for it.
    """

    T: Matrix
    score: float
    evaluations: int
    trace: tuple[Step, ...] = ()
    refused: str = ""


class Method(Protocol):
    """A method as it was published: a score of the extrinsic and how it is maximised.

    All get the same frames, rectified and with the points moved to the image's moment, and know how far off the start may be.
    """

    @property
    def name(self) -> str:
        """In tables and on the command line: a lower-case word."""
        ...

    @property
    def title(self) -> str:
        """For people: authors and what is matched with what."""
        ...

    def features(self, frame: Frame) -> Any:
        """What the method keeps of a frame; does not depend on the extrinsic. CalibrationError if there is nothing to keep."""
        ...

    def score(self, features: Sequence[Any], T_prior: Matrix) -> Score:
        """What is maximised over these frames of one camera. T_prior: (4, 4), near; points far outside its image may be left out.

        CalibrationError if too little falls into the image.
        """
        ...

    def optimise(self, features: Sequence[Any], T: Matrix, reach: SearchBox) -> Outcome:
        """Calibrate from T_camera_lidar (4, 4). reach: how far off that may be, per axis."""
        ...


@dataclass(eq=False)
class Watched:
    """A score that counts its evaluations and keeps the best extrinsic; a Score."""

    score: Score
    evaluations: int = 0
    best: float = -np.inf
    trace: list[Step] = field(default_factory=list)
    _started: float = field(default_factory=time.process_time)

    def value(self, T: Matrix) -> float:
        """At T (4, 4)."""
        value = self.score.value(T)
        self.evaluations += 1
        if value > self.best:
            self.best = value
            self.trace.append(Step(self.evaluations, time.process_time() - self._started, T))
        return value

    def outcome(self, T: Matrix, refused: str = "") -> Outcome:
        """Where it ended; T (4, 4) is not counted as an evaluation."""
        return Outcome(T, self.score.value(T), self.evaluations, tuple(self.trace), refused)
