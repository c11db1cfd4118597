"""Which cloud belongs to which image: by the moment at which a scan sweeps the camera's view, which its points tell.

Until a first cloud has been looked at nothing is paired; later ones may correct what is known.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

from calib_ros.config import Config
from calib_ros.lidar.sweep import SweepOffset
from calib_ros.online.pairing.epochs import ClockDifference
from calib_ros.online.pairing.synchronizer import Synchronizer

# Cloud messages kept: the one before a keyframe's is needed for the vehicle's motion, and the keyframe's own may wait for its
# image meanwhile.
CLOUDS_KEPT = 6
QUEUE = 8  # images and clouds that wait for their counterpart: twice what a stream of twice the rate brings in a late scan's time


@dataclass(frozen=True, eq=False)
class Intake:
    """An image and a cloud to be looked at. paired: they belong together; else any two, before it is known which do.
    cloud_stamp: ns, by the clock of the images; None = not known any more. before: the cloud before it, with its stamp."""

    image: Any
    cloud: Any
    paired: bool = True
    cloud_stamp: int | None = None
    before: tuple[int, Any] | None = None


class Pairing:
    """Images and clouds in, what is to be taken in out. Not thread-safe: its owner holds a lock, but for `sweep`, which belongs
    to the thread that takes in.

    clouds_are_decoded: the moments of sweeps can be told; else clouds belong to their stamps at first.
    """

    def __init__(self, config: Config, clouds_are_decoded: bool) -> None:
        self.synchronizer = Synchronizer(config.online.pair_tolerance_s, QUEUE, None if clouds_are_decoded else 0)
        self.sweep, self.clocks = SweepOffset(config.motion), ClockDifference()
        self._newest_image: Any = None  # messages to find out from when scans sweep the view, while that is not known
        self._newest_cloud: Any = None
        self._clouds: deque[tuple[int, Any]] = deque(maxlen=CLOUDS_KEPT)  # the newest messages, with their stamps

    def configure(self, config: Config) -> list[Intake]:
        """Use other constants from now on."""
        self.synchronizer.limit_s = config.online.pair_tolerance_s
        self.sweep.config = config.motion
        return self.use_sweep()

    def add(self, is_image: bool, stamp: int, message: Any) -> list[Intake]:
        """An image or a cloud message, stamp in ns, from which for a cloud the difference of the clocks is taken out."""
        if self.clocks.add(is_image, stamp, self.synchronizer.counts.pairs > 0):
            # What waits is stamped by other clocks than what comes.
            self.synchronizer.clear()
            self._clouds.clear()
        if is_image:
            self._newest_image = message
        else:
            stamp -= self.clocks.ahead
            self._clouds.append((stamp, message))
            self._newest_cloud = message
        return self._to_take_in(self.synchronizer.add(is_image, stamp, message))

    def use_sweep(self) -> list[Intake]:
        """Pair by what is known of the sweep. Of pairs that become final by it, the newest is to be taken in."""
        offset = self.sweep.ns
        return [] if offset is None else self._to_take_in(self.synchronizer.set_cloud_offset(offset)[-1:])

    def use_stamps(self) -> list[Intake]:
        """Pair by what the stamps are said to be, while nobody can tell the sweep."""
        if self.synchronizer.cloud_offset is not None:
            return []
        return self._to_take_in(self.synchronizer.set_cloud_offset(self.sweep.stamped_ns)[-1:])

    def _to_take_in(self, pairs: list[tuple[Any, Any]]) -> list[Intake]:
        """The pairs, or, while nothing is known of the sweep, what is to be looked at."""
        stamps = {id(message): stamp for stamp, message in self._clouds}
        found = []
        for image, cloud in pairs:
            at = stamps.get(id(cloud))
            earlier = [item for item in self._clouds if at is not None and item[0] < at]
            found.append(Intake(image, cloud, True, at, max(earlier, key=lambda item: item[0], default=None)))
        if self.sweep.ns is not None:
            self._newest_image = self._newest_cloud = None
        elif not pairs and self._newest_image is not None and self._newest_cloud is not None:
            found.append(Intake(self._newest_image, self._newest_cloud, paired=False))
            self._newest_cloud = None  # one look at each
        return found
