"""What every dataset offers, whatever its files."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera
from calib_ros.frame import Frame


class Source(Protocol):
    """A sequence of synchronised frames; `source[i]` reads frame i when asked, IndexError past the end."""

    @property
    def name(self) -> str:
        """For people: the folder's or file's name."""

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
        """What the source holds, for `calib-ros info`: label -> text."""


def describe_camera(camera: Camera) -> str:
    """One line about the intrinsics."""
    K = camera.K
    lens = "no distortion" if camera.is_pinhole else f"{camera.model} distortion"
    numbers = f"fx {K[0, 0]:.1f}, fy {K[1, 1]:.1f}, cx {K[0, 2]:.1f}, cy {K[1, 2]:.1f}"
    return f"{camera.width}x{camera.height}, {numbers}, {lens}"
