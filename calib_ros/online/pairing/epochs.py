"""Do the clocks of camera and LiDAR count from the same time? By the stamps of what is received at the same time."""

from __future__ import annotations

from collections import deque

import numpy as np

from calib_ros.frame import NANOSECONDS
from calib_ros.stamps import LONGEST_QUEUE_S, cause_of_difference, time_scales

# Changes from one stream to the other that agree, before anything is concluded; more where pairs were found before, since a clock
# that jumps usually comes back. Of a stream that goes on alone nothing is learnt: the other one has stopped, or gets lost.
SEEN, SEEN_LATER = 20, 200
STEADY_S = 1.0  # within which leads of one pair of clocks stay, messages of a camera at 1 Hz included


class ClockDifference:
    """ahead: ns by which clouds are stamped ahead of images that are received at the same time, if that is the difference of two
    time scales, which is exact, or more than messages can wait, which is known as they arrive, to some 0.1 s; else 0."""

    def __init__(self) -> None:
        self.ahead = 0
        self._image: int | None = None  # the newest stamps, ns
        self._cloud: int | None = None
        self._newest_is_image: bool | None = None
        self._leads: deque[int] = deque(maxlen=SEEN_LATER)

    def add(self, is_image: bool, stamp: int, paired: bool = False) -> bool:
        """The stamp of an image or a cloud, ns, as its driver has stamped it; True if it changes what is taken out.

        paired: whether there were pairs so far.
        """
        if is_image:
            self._image = stamp
        else:
            self._cloud = stamp
        goes_on_alone, self._newest_is_image = is_image == self._newest_is_image, is_image
        if goes_on_alone or self._image is None or self._cloud is None:
            return False
        self._leads.append(self._cloud - self._image)
        agrees = abs(self._cloud - self._image - self.ahead) <= STEADY_S * NANOSECONDS
        if agrees or len(self._leads) < SEEN:
            return False
        leads = np.array(self._leads)
        found = int(np.median(leads[-SEEN:]))
        scale = time_scales(found / NANOSECONDS)
        if scale is not None:
            found = int(np.copysign(scale[0], found)) * NANOSECONDS
        elif abs(found) <= LONGEST_QUEUE_S * NANOSECONDS:
            found = 0
        wanted = SEEN_LATER if paired and found else SEEN
        steady = len(leads) >= wanted and np.ptp(leads[-wanted:]) <= STEADY_S * NANOSECONDS
        if not steady or abs(found - self.ahead) <= STEADY_S * NANOSECONDS:
            return False
        self.ahead = found
        return True

    def describe(self) -> str:
        """For people; "" if there is no difference."""
        if not self.ahead:
            return ""
        seconds = abs(self.ahead) / NANOSECONDS
        side = "after" if self.ahead > 0 else "before"
        return (
            f"clouds are stamped {seconds:.0f} s {side} images received at the same time: {cause_of_difference(seconds)}; "
            "paired as received; synchronise the clocks (PTP, chrony)"
        )
