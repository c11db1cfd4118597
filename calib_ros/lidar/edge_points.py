"""Edge points of a scan. They do not depend on the extrinsic: found once per scan, re-projected ever after.

Source: depth discontinuity along the rings (thesis 3.4.3, eq. 3.10), extended by upward jumps, reflectivity steps and
edges against the sky.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import LidarConfig
from calib_ros.lidar.edge_cells import edge_cells
from calib_ros.lidar.edge_kinds import UPWARD, EdgeKind
from calib_ros.lidar.edge_places import between_points, between_rays
from calib_ros.lidar.scan import RangeImage

__all__ = ["UPWARD", "EdgeKind", "EdgePoints", "edge_points"]


@dataclass(frozen=True, eq=False)
class EdgePoints:
    """xyz: (n, 3) float32 in the LiDAR frame, shifted onto the edge. strength: (n,) float32. kind: (n,) uint8 EdgeKind.

    ring_spacing: rad, the sensor's median; upward edges are known only to half of it. time: (n,) float32, when each point was
    measured, s after the cloud's stamp as found in a scan, s after the image's moment once lidar/deskew.py has moved them there;
    None if not known. label: (n,) uint8 SemanticClass of what has the edge, None if the cloud has no classes.
    """

    xyz: NDArray[np.float32]
    strength: NDArray[np.float32]
    kind: NDArray[np.uint8]
    ring_spacing: float = float(np.deg2rad(0.4))
    time: NDArray[np.float32] | None = None
    label: NDArray[np.uint8] | None = None

    def __len__(self) -> int:
        return len(self.xyz)

    def select(self, keep: NDArray[np.intp]) -> EdgePoints:
        """Some of the points."""
        time = None if self.time is None else self.time[keep]
        label = None if self.label is None else self.label[keep]
        return EdgePoints(self.xyz[keep], self.strength[keep], self.kind[keep], self.ring_spacing, time, label)


def edge_points(scan: RangeImage, config: LidarConfig) -> EdgePoints:
    """All edge points of a range image, of every kind that the scan allows."""
    cells = edge_cells(scan, config)
    place = between_points if scan.layout == "projection" else between_rays
    placed = [place(scan, found, config) for found in cells]
    index = np.concatenate([p.index for p in placed])
    spacing = float(np.median(-np.diff(scan.elevation))) if len(scan.elevation) > 1 else np.pi
    return EdgePoints(
        np.concatenate([p.xyz for p in placed]),
        np.concatenate([p.strength for p in placed]).astype(np.float32),
        np.concatenate([np.full(len(p.index), found.kind, np.uint8) for found, p in zip(cells, placed, strict=True)]),
        spacing,
        None if scan.cloud.time is None else scan.cloud.time[index],
        None if scan.cloud.label is None else scan.cloud.label[index],
    )
