"""Sources made of others, and what may be wrong with a recording: changes of its frames that keep their scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.config import MotionConfig
from calib_ros.datasets import open_dataset
from calib_ros.datasets.source import Source, WithMotion
from calib_ros.frame import NANOSECONDS, Frame

Matrix = NDArray[np.float64]


def frames_of(name: str, motion: MotionConfig | None = None) -> list[Frame]:
    """All frames of a source by its name; with the vehicle's motion from neighbouring scans, if that is wanted."""
    source: Source = open_dataset(name)
    source = source if motion is None else WithMotion(source, motion)
    return [source[k] for k in range(len(source))]


class Changed:
    """Another source with its frames changed, as they are asked for; itself a Source. camera, reference: those of the source."""

    def __init__(self, source: Source, change: Callable[[Frame], Frame] = lambda frame: frame) -> None:
        self.source, self._change = source, change
        self.name, self.camera, self.reference = source.name, source.camera, source.reference
        self.camera_frame, self.lidar_frame = source.camera_frame, source.lidar_frame

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, index: int) -> Frame:
        return self._change(self.source[index])

    def describe(self) -> dict[str, str]:
        """As the source."""
        return self.source.describe()


class Listed:
    """Frames in memory as a source."""

    camera_frame, lidar_frame = "camera", "lidar"

    def __init__(self, name: str, frames: Sequence[Frame]) -> None:
        self.name, self._frames, self.camera, self.reference = name, frames, frames[0].camera, frames[0].reference

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> Frame:
        return self._frames[index]

    def describe(self) -> dict[str, str]:
        return {}


def with_intrinsics(frame: Frame, focal: float = 0.0, centre_px: Sequence[float] = (0.0, 0.0)) -> Frame:
    """The same picture with a CameraInfo that is wrong. focal: share of the focal length."""
    K = frame.camera.K.copy()
    K[[0, 1], [0, 1]] *= 1 + focal
    K[:2, 2] += centre_px
    return replace(frame, camera=replace(frame.camera, K=K))


def late(frame: Frame, seconds: float) -> Frame:
    """An image stamped late against the scan."""
    return replace(frame, cloud_stamp=frame.moment_of_cloud, stamp=frame.stamp + round(seconds * NANOSECONDS))


def in_other_frame(frame: Frame, T_other_cloud: Matrix) -> Frame:
    """The cloud, the twist and the extrinsic in another frame."""
    xyz = se3.transform(T_other_cloud, frame.cloud.xyz).astype(np.float32)
    twist = None if frame.twist is None else se3.adjoint(T_other_cloud) @ frame.twist
    reference = None if frame.reference is None else frame.reference @ se3.inverse(T_other_cloud)
    return replace(frame, cloud=replace(frame.cloud, xyz=xyz), twist=twist, reference=reference)


def turned(axis: Sequence[float], deg: float, shift: Sequence[float] = (0, 0, 0)) -> Matrix:
    """A transform (4, 4)."""
    T = se3.exp(np.concatenate([np.deg2rad(deg) * np.asarray(axis, float), np.zeros(3)]))
    T[:3, 3] = shift
    return T
