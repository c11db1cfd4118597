"""Progress of an estimate, for whoever waits for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

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
