"""Watching an estimate: progress for whoever waits for it, and an observer for studies of the optimisation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Callback = Callable[[str, float], None]
"""Takes the name of a stage and the share of it that is done, 0..1. It may raise, which ends the estimate."""


@dataclass(frozen=True)
class Progress:
    """Share of a stage that is done, reported to a callback, None = to nobody. first, last: the range of the stage that its own
    0..1 stands for."""

    callback: Callback | None = None
    stage: str = ""
    first: float = 0.0
    last: float = 1.0

    def __call__(self, share: float) -> None:
        """Report that `share` (0..1) of this part is done."""
        if self.callback is not None:
            self.callback(self.stage, self.first + (self.last - self.first) * share)

    def of(self, stage: str) -> Progress:
        """Progress of another stage, from its beginning."""
        return Progress(self.callback, stage)

    def part(self, first: float, last: float) -> Progress:
        """Progress of the range first..last of this one."""
        width = self.last - self.first
        return Progress(self.callback, self.stage, self.first + width * first, self.first + width * last)


SILENT = Progress()


class Observer(Protocol):
    """Watches an optimisation from the thread of the estimate, where ``search.threads`` is not used, and does not change it."""

    def evaluated(self, count: int) -> None:
        """The score of so many extrinsics has been computed."""

    def linearised(self) -> None:
        """The slope of the score and its Gauss-Newton matrix have been computed at one extrinsic."""

    def reached(self, T: NDArray[np.float64]) -> None:
        """The search, or one level of the optimisation, has ended at T_camera_lidar (4, 4)."""
