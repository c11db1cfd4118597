"""What the fast score keeps of a frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera
from calib_ros.image.edges import EdgeLevel
from calib_ros.lidar.edge_points import EdgePoints


@dataclass(frozen=True, eq=False)
class FrameFeatures:
    """Features of one frame for the fast score. points: LiDAR frame. levels: coarse to fine. camera: pinhole of the maps.

    has_reflectivity: False if the source gave no usable intensity, so that reflectivity edges are missing. twist: (6,) the
    LiDAR's velocity, rad/s and m/s in its own frame, by which the points were moved to the image's moment; None = they were not.
    """

    points: EdgePoints
    levels: list[EdgeLevel]
    camera: Camera
    stamp: int
    name: str
    has_reflectivity: bool
    twist: NDArray[np.float64] | None = None

    @property
    def outline(self) -> EdgePoints:
        """What to draw of the scan's edges."""
        return self.points
