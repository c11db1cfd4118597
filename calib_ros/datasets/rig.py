"""Recordings of several cameras and LiDARs: the protocol, and opening one by the description of its sensors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol, overload

import numpy as np
from numpy.typing import NDArray

from calib_ros.arrays import Transform
from calib_ros.camera import Camera
from calib_ros.datasets.source import Source
from calib_ros.frame import PointCloud


class RigSource(Protocol):
    """The recording of a rig: every pair of a camera and a LiDAR is a Source of its own. What several of them need is read once,
    as long as it is among the newest. BadInputError for names that are none of its sensors."""

    @property
    def name(self) -> str:
        """For display."""

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras."""

    @property
    def lidars(self) -> tuple[str, ...]:
        """Names of the LiDARs."""

    @property
    def reference_sensor(self) -> str:
        """The sensor that `reference` is relative to."""

    def camera(self, name: str) -> Camera:
        """The intrinsics of a camera."""

    def frame_id(self, name: str) -> str:
        """TF frame of a sensor."""

    def reference(self, name: str) -> Transform | None:
        """T_reference_sensor (4, 4) of a sensor as the recording states it at its beginning; None if unknown."""

    def pair(self, camera: str, lidar: str) -> Source:
        """Images of a camera with the scans of a LiDAR that are next to them; the reference is T_camera_lidar."""

    def scans(self, lidar: str) -> Sequence[tuple[int, PointCloud]]:
        """All scans of a LiDAR with their stamps, ns, in time."""


class RecordedRig(RigSource, Protocol):
    """A rig whose images can be read for themselves, so that all of it can be written to a bag."""

    def pictures(self, camera: str) -> Sequence[tuple[int, NDArray[np.uint8]]]:
        """All images of a camera with their stamps, ns, in time."""

    def prior(self, name: str) -> Transform:
        """T_reference_sensor (4, 4) as somebody who mounts the sensors believes it."""


class Timed(Sequence[tuple[int, Any]]):
    """What a sensor measured, with its stamps, ns (n,): read when asked for."""

    def __init__(self, stamps: NDArray[np.int64], read: Callable[[int], Any]) -> None:
        self.stamps, self._read = stamps, read

    def __len__(self) -> int:
        return len(self.stamps)

    @overload
    def __getitem__(self, index: int) -> tuple[int, Any]: ...

    @overload
    def __getitem__(self, index: slice) -> list[tuple[int, Any]]: ...

    def __getitem__(self, index: int | slice) -> tuple[int, Any] | list[tuple[int, Any]]:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        index = range(len(self))[index]
        return int(self.stamps[index]), self._read(index)
