"""A short recording that goes on and on: forwards, backwards, and forwards again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib_ros.datasets.source import Source
from calib_ros.errors import BadInputError
from calib_ros.frame import NANOSECONDS, Frame


def reversed_time(frame: Frame, stamp: int) -> Frame:
    """The frame as in a film that runs backwards, with its cloud at `stamp` (ns): the car drives backwards, the head turns the
    other way round. Points straighten as they did before."""
    cloud = frame.cloud if frame.cloud.time is None else replace(frame.cloud, time=-frame.cloud.time)
    twist = None if frame.twist is None else -frame.twist
    return replace(frame, stamp=stamp - (frame.stamp - frame.moment_of_cloud), cloud_stamp=stamp, cloud=cloud, twist=twist)


def restamped(frame: Frame, stamp: int) -> Frame:
    """The frame with its cloud at `stamp` (ns), and its image as long after it as before."""
    return replace(frame, stamp=stamp + frame.stamp - frame.moment_of_cloud, cloud_stamp=stamp)


class ThereAndBack:
    """A short recording played forwards and backwards in turn until `seconds` are full, with stamps that go on.

    times: (n,) s of every frame's cloud after the first one's. The source is read through once, for its stamps. BadInputError if
    they do not rise.
    """

    def __init__(self, source: Source, seconds: float) -> None:
        self.source = source
        stamps = np.array([source[i].moment_of_cloud for i in range(len(source))], np.int64)
        n = len(stamps)
        gaps = np.diff(stamps) / NANOSECONDS
        if not (gaps > 0).all():
            raise BadInputError(f"{source.name}: its stamps do not rise from frame to frame, so that it cannot go on in time")
        order, times, forwards = [0], [0.0], [True]
        while n > 1 and times[-1] < seconds:
            ahead = (forwards[-1] and order[-1] < n - 1) or order[-1] == 0
            step = order[-1] if ahead else order[-1] - 1
            order.append(order[-1] + 1 if ahead else order[-1] - 1)
            times.append(times[-1] + float(gaps[step]))
            forwards.append(ahead)
        keep = max(int(np.searchsorted(times, seconds - 1e-6)), 1)  # sums of steps miss a round number by rounding
        self._order, self._forwards, self.times = order[:keep], forwards[:keep], np.array(times[:keep])
        self._start = int(stamps[0])
        self.name, self.camera, self.reference = source.name, source.camera, source.reference
        self.camera_frame, self.lidar_frame = source.camera_frame, source.lidar_frame

    def __len__(self) -> int:
        return len(self._order)

    def __getitem__(self, index: int) -> Frame:
        """Frame `index`; its name says which time round it is. IndexError past either end."""
        frame = self.source[self._order[index]]
        stamp = self._start + round(float(self.times[index]) * NANOSECONDS)
        changed = restamped(frame, stamp) if self._forwards[index] else reversed_time(frame, stamp)
        return replace(changed, name=f"{frame.name}@{self.times[index]:.1f}")

    def describe(self) -> dict[str, str]:
        """The recording's facts, and for how long it goes on."""
        facts = self.source.describe()
        return facts | {"frames": f"{len(self)}, there and back for {self.times[-1]:.1f} s; {facts.get('frames', '')}"}
