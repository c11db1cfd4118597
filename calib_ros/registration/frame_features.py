"""What the fast score keeps of a frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera
from calib_ros.image.edges import EdgeLevel
from calib_ros.lidar.edge_points import EdgePoints
from calib_ros.registration.first_guess.class_view import ClassView


@dataclass(frozen=True, eq=False)
class FrameFeatures:
    """Features of one frame for the fast score. points: LiDAR frame. levels: coarse to fine. camera: pinhole of the maps.

    has_reflectivity: False if the source gave no usable intensity, so that reflectivity edges are missing. twist: (6,) the
    LiDAR's velocity, rad/s and m/s in its own frame, by which the points were moved to the image's moment; None = they were not.

    Where classes are known: importance: w_j of eq. 3.16. plain: the same frame without semantics, which is what the monitor
    compares with other frames. points.label tells whose edges points are; levels then have two maps for edges of any kind, and
    two more for each group of registration/class_edges.py. view: what the first guess needs, where points and pixels have
    classes.
    """

    points: EdgePoints
    levels: list[EdgeLevel]
    camera: Camera
    stamp: int
    name: str
    has_reflectivity: bool
    twist: NDArray[np.float64] | None = None
    importance: float | None = None
    plain: FrameFeatures | None = None
    view: ClassView | None = None

    @property
    def outline(self) -> EdgePoints:
        """What to draw of the scan's edges."""
        return self.points
