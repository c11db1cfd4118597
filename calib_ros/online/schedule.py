"""When estimates are made: online.mode and online.rest_period_s over the data's time stamps."""

from __future__ import annotations

from calib_ros.config import OnlineConfig
from calib_ros.config.online import CONTINUOUS, PERIODIC
from calib_ros.frame import NANOSECONDS


class Schedule:
    """online.mode over the data's own time stamps: the same recording gives the same estimates at any speed.

    config may be replaced at any time. Stamps are in ns.
    """

    def __init__(self, config: OnlineConfig) -> None:
        self.config = config
        self._newest: int | None = None
        self._estimated: int | None = None
        self._estimated_before: int | None = None

    def add_frame(self, stamp: int) -> None:
        """A frame, keyframe or not, with its stamp."""
        self._newest = stamp

    def start_estimate(self) -> None:
        """An estimate begins, on request or not: the next period counts from the newest frame."""
        self._estimated_before, self._estimated = self._estimated, self._newest

    def cancel_estimate(self) -> None:
        """The estimate that began last ended without a result."""
        self._estimated = self._estimated_before

    @property
    def due(self) -> bool:
        """True if new keyframes are to be estimated now. Periodic: the first ones at once, as after a clock was set back."""
        if self.config.mode != PERIODIC:
            return self.config.mode == CONTINUOUS
        return self._elapsed(self.config.period_s)

    @property
    def rested(self) -> bool:
        """True if the last estimate was so long ago that an extrinsic in which nothing has changed is estimated again."""
        return self._elapsed(self.config.rest_period_s)

    def _elapsed(self, period_s: float) -> bool:
        if self._newest is None or self._estimated is None:
            return True
        elapsed = (self._newest - self._estimated) / NANOSECONDS
        return elapsed < 0 or elapsed >= period_s
