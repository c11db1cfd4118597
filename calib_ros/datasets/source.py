"""The protocol of datasets, pairing of stamps, and the LiDAR's motion from neighbouring scans."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera
from calib_ros.config import MotionConfig
from calib_ros.errors import CalibrationError, MissingDependencyError
from calib_ros.frame import NANOSECONDS, Frame, PointCloud
from calib_ros.lidar.ego_motion import Motion, estimate_motion, needs_ego_motion

Stamps = NDArray[np.int64]
Stamped = tuple[int, PointCloud]
CACHED_CLOUDS = 4


class Source(Protocol):
    """A sequence of synchronised frames; `source[i]` reads frame i, IndexError past the end."""

    @property
    def name(self) -> str:
        """Name of the folder or file, for display."""

    @property
    def camera(self) -> Camera:
        """The intrinsics; of the first frame where they differ between frames (see Frame.camera)."""

    @property
    def reference(self) -> NDArray[np.float64] | None:
        """T_camera_lidar (4, 4), None if unknown; of the first frame where they differ."""

    @property
    def camera_frame(self) -> str:
        """Name of the camera's optical frame."""

    @property
    def lidar_frame(self) -> str:
        """Name of the LiDAR's frame."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Frame: ...

    def describe(self) -> dict[str, str]:
        """Content of the source, for `calib-ros info`: label -> text."""


def describe_camera(camera: Camera) -> str:
    """One line about the intrinsics."""
    K = camera.K
    lens = "no distortion" if camera.is_pinhole else f"{camera.model} distortion"
    numbers = f"fx {K[0, 0]:.1f}, fy {K[1, 1]:.1f}, cx {K[0, 2]:.1f}, cy {K[1, 2]:.1f}"
    return f"{camera.width}x{camera.height}, {numbers}, {lens}"


def nearest_index(stamps: Stamps, wanted: Stamps) -> NDArray[np.intp]:
    """Index (m,) of the nearest of stamps (n >= 1, sorted) for each of wanted (m,); of two equally near, the earlier."""
    after = np.searchsorted(stamps, wanted)
    right = np.minimum(after, len(stamps) - 1)
    left = np.maximum(after - 1, 0)
    return np.where(np.abs(wanted - stamps[left]) <= np.abs(stamps[right] - wanted), left, right)


def nearest_pairs(a: Stamps, b: Stamps, tolerance: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pairs of two sorted arrays of stamps at most `tolerance` apart, nearest first, each stamp used once.

    Returns the indices (k,) into a and into b, in the order of a. Mutually nearest stamps are paired, then again among the rest,
    which equals a greedy choice by distance, without its loop over pairs.
    """
    left_a, left_b = np.arange(len(a)), np.arange(len(b))
    pairs: list[tuple[NDArray[np.intp], NDArray[np.intp]]] = []
    while len(left_a) and len(left_b):
        to_b = nearest_index(b[left_b], a[left_a])
        to_a = nearest_index(a[left_a], b[left_b])
        here = np.arange(len(left_a))
        mutual = (to_a[to_b] == here) & (np.abs(a[left_a] - b[left_b][to_b]) <= tolerance)
        if not mutual.any():
            break
        pairs.append((left_a[mutual], left_b[to_b[mutual]]))
        left_a, left_b = left_a[~mutual], np.delete(left_b, to_b[mutual])
    if not pairs:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    ia, ib = (np.concatenate(part) for part in zip(*pairs, strict=True))
    order = np.argsort(ia)
    return ia[order], ib[order]


class WithMotion:
    """A source whose frames without a twist get it from the scans before and after them, if these are near enough in time.

    tell: called once with a message if small_gicp is missing; frames then stay as they are.
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
        """Frame `index`, with a twist if its neighbours allow one. Raises what the source raises."""
        frame = self._source[index]
        index %= max(len(self), 1)
        self._keep(index, _stamped(frame))
        if self._library_missing or not needs_ego_motion(frame, self._config):
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
        """Motion since the previous scan, and until the next: their mean is the motion at the scan itself."""
        motions: list[Motion] = []
        for first, second in ((index - 1, index), (index, index + 1)):
            before, after = self._cloud(first), self._cloud(second)
            if before is not None and after is not None:
                gap = (after[0] - before[0]) / NANOSECONDS
                start = motions[0].twist if motions else None
                motions.append(estimate_motion(before[1], after[1], gap, self._config, start))
        return motions

    def _cloud(self, index: int) -> Stamped | None:
        """The cloud of a frame with its stamp; None if unusable."""
        if index not in self._clouds:
            try:
                self._keep(index, _stamped(self._source[index]) if 0 <= index < len(self) else None)
            except CalibrationError:  # a damaged neighbour does not make this frame unusable
                self._keep(index, None)
        return self._clouds[index]

    def _keep(self, index: int, cloud: Stamped | None) -> None:
        self._clouds[index] = cloud
        self._clouds.move_to_end(index)
        while len(self._clouds) > CACHED_CLOUDS:
            self._clouds.popitem(last=False)


def _stamped(frame: Frame) -> Stamped | None:
    return None if frame.cloud_stamp is None or frame.compensated else (frame.cloud_stamp, frame.cloud)
