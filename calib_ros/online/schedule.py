"""When estimates are made: online.mode over the data's time stamps, online.max_load over the wall clock."""

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
        if self._newest is None or self._estimated is None:
            return True
        elapsed = (self._newest - self._estimated) / NANOSECONDS
        return elapsed < 0 or elapsed >= self.config.period_s


class LoadLimit:
    """online.max_load over the wall clock: how much of one core estimates made of their own accord may take.

    Times are in s of a clock that never runs back. config may be replaced at any time.
    """

    def __init__(self, config: OnlineConfig) -> None:
        self.config = config
        self._began = self._took = 0.0

    def add_estimate(self, began: float, ended: float) -> None:
        """An estimate, on request or not, was made from `began` to `ended`."""
        self._began, self._took = began, max(ended - began, 0.0)

    def allows(self, now: float) -> bool:
        """True if the next estimate may begin; estimates on request never wait."""
        return self._took == 0.0 or now - self._began >= self._took / self.config.max_load
