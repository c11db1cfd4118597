"""A rig in small: the halves of a synthetic drive's pictures as two cameras around its LiDAR."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scenes import RenderedDrive

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.frame import Frame, PointCloud

HALVES = {"left": slice(0, 380), "right": slice(260, 640)}  # columns


class Half:
    """Some columns of a drive's pictures as a source of their own."""

    lidar_frame = "lidar"

    def __init__(self, drive: RenderedDrive, name: str) -> None:
        self._drive, self._columns, self.name, self.camera_frame = drive, HALVES[name], name, name
        K = drive.camera.K.copy()
        K[0, 2] -= self._columns.start
        own = drive.camera
        self.camera = Camera(K, self._columns.stop - self._columns.start, own.height, own.model, own.D)
        self.reference = drive.reference

    def __len__(self) -> int:
        return len(self._drive)

    def __getitem__(self, index: int) -> Frame:
        frame = self._drive[index]
        return replace(frame, image=np.ascontiguousarray(frame.image[:, self._columns]), camera=self.camera, classes=None)

    def describe(self) -> dict[str, str]:
        return {}


class TwoHalves:
    """A rig of one LiDAR and two cameras, which are the halves of one."""

    name, cameras, lidars, reference_sensor = "two halves", ("left", "right"), ("top",), "top"

    def __init__(self, drive: RenderedDrive) -> None:
        self._drive, self._pairs = drive, {name: Half(drive, name) for name in HALVES}

    def camera(self, name: str) -> Camera:
        return self._pairs[name].camera

    def frame_id(self, name: str) -> str:
        return name

    def reference(self, name: str) -> np.ndarray | None:
        return np.eye(4) if name == "top" else se3.inverse(self._drive.reference)

    def pair(self, camera: str, lidar: str) -> Half:
        return self._pairs[camera]

    def scans(self, lidar: str) -> Sequence[tuple[int, PointCloud]]:
        frames = [self._drive[k] for k in range(len(self._drive))]
        return [(frame.moment_of_cloud, frame.cloud) for frame in frames]
