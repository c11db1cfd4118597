"""A source whose frames say how fast the LiDAR moved, estimated from neighbouring scans where no odometry says it."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from calib_ros.config import MotionConfig
from calib_ros.datasets.source import Source
from calib_ros.errors import CalibrationError, MissingDependencyError
from calib_ros.frame import NANOSECONDS, Frame, PointCloud
from calib_ros.lidar.motion import Motion, estimate_motion, wanted

CACHED_CLOUDS = 4
Stamped = tuple[int, PointCloud]


class WithMotion:
    """A Source like the one given; frames without a twist get it from the scans before and after them, if they are near enough.

    tell: called once with a line for a person if estimates are wanted, but small_gicp is missing; frames then stay as they are.
    """

    def __init__(self, source: Source, config: MotionConfig, tell: Callable[[str], None] | None = None) -> None:
        self._source, self._config, self._tell = source, config, tell
        self.name, self.camera, self.reference = source.name, source.camera, source.reference
        self.camera_frame, self.lidar_frame = source.camera_frame, source.lidar_frame
        self._clouds: OrderedDict[int, Stamped | None] = OrderedDict()
        self._library_missing = False

    def __len__(self) -> int:
        return len(self._source)

    def __getitem__(self, index: int) -> Frame:
        """Frame `index`, with a twist if its neighbours allow one. Raises what the source raises for this frame."""
        frame = self._source[index]
        index %= max(len(self), 1)
        self._keep(index, _stamped(frame))
        if self._library_missing or not wanted(frame, self._config):
            return frame
        try:
            found = [motion.twist for motion in self._motions(index) if motion.twist is not None]
        except MissingDependencyError as error:
            self._library_missing = True
            if self._tell:
                self._tell(f"scans are not corrected for the vehicle's motion: {error}")
            return frame
        return replace(frame, twist=np.mean(found, axis=0)) if found else frame

    def describe(self) -> dict[str, str]:
        """As the source."""
        return self._source.describe()

    def _motions(self, index: int) -> list[Motion]:
        """Motion since the scan before, and until the scan after: their mean is that at the scan itself."""
        motions: list[Motion] = []
        for first, second in ((index - 1, index), (index, index + 1)):
            before, after = self._cloud(first), self._cloud(second)
            if before is not None and after is not None:
                gap = (after[0] - before[0]) / NANOSECONDS
                start = motions[0].twist if motions else None
                motions.append(estimate_motion(before[1], after[1], gap, self._config, start))
        return motions

    def _cloud(self, index: int) -> Stamped | None:
        """The cloud of a frame with its stamp; None if there is none that can be used."""
        if index not in self._clouds:
            try:
                self._keep(index, _stamped(self._source[index]) if 0 <= index < len(self) else None)
            except CalibrationError:  # a damaged neighbour is no fault of this frame
                self._keep(index, None)
        return self._clouds[index]

    def _keep(self, index: int, cloud: Stamped | None) -> None:
        self._clouds[index] = cloud
        self._clouds.move_to_end(index)
        while len(self._clouds) > CACHED_CLOUDS:
            self._clouds.popitem(last=False)


def _stamped(frame: Frame) -> Stamped | None:
    return None if frame.cloud_stamp is None or frame.compensated else (frame.cloud_stamp, frame.cloud)
