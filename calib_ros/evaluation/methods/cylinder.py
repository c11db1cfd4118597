"""The edge probability of LiDAR points, on a cylinder around the scanner (MulFEAT; thesis 4.2.1, eq. 4.6).

No extrinsic takes part, so that the maps, their completion and their edges are made once per scan.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import Config
from calib_ros.errors import TooFewFeaturesError
from calib_ros.frame import PointCloud
from calib_ros.lidar import filters
from calib_ros.lidar.attributes import (
    PointAttributes,
    ground_plane,
    ground_points,
    object_labels,
    within_reach,
    within_thresholds,
)
from calib_ros.lidar.density import REACH
from calib_ros.lidar.edge_maps import PointLevels, edge_maps
from calib_ros.lidar.scan import RangeImage, range_image

STEEPEST = float(np.deg2rad(60.0))  # what is higher or lower would need a cylinder without end; no road scanner sees so far up
MAX_ROWS, MAX_COLUMNS = 2048, 16384  # cells of 0.02 deg and more; a few broken points must not cost the memory of millions

Floats = NDArray[np.float32]
Indices = NDArray[np.intp]


@dataclass(frozen=True)
class Grid:
    """Cells of a cylinder of radius 1: row 0 is the highest, columns run counter-clockwise from azimuth -180 deg.

    top: height of the upper rim. row_step: height of a cell. column_step: width of one, rad; they close the circle.
    """

    top: float
    row_step: float
    rows: int
    columns: int

    @staticmethod
    def of(scan: RangeImage, xyz: Floats, rows_per_ring: float, columns_per_step: float) -> Grid:
        """So many cells from one ring of the scan to the next, and from one azimuth to the next, for points (n, 3)."""
        height = _height(xyz)
        spacing = scan.azimuth_step
        if scan.layout == "rings" and len(scan.elevation) > 1:
            spacing = float(np.median(np.abs(np.diff(scan.elevation))))
        top, bottom = float(height.max()), float(height.min())
        step = max(spacing / rows_per_ring, (top - bottom) / (MAX_ROWS - 1), 1e-4)
        columns = min(max(round(2 * np.pi * columns_per_step / scan.azimuth_step), 3), MAX_COLUMNS)
        return Grid(top + step / 2, step, int((top - bottom) / step + 0.5) + 1, columns)

    def cells(self, xyz: Floats) -> tuple[Indices, Indices]:
        """Rows and columns (n,) of points (n, 3)."""
        row = np.floor((self.top - _height(xyz)) / self.row_step).astype(np.intp)
        turn = (np.arctan2(xyz[:, 1], xyz[:, 0]) + np.pi) / (2 * np.pi)
        return np.clip(row, 0, self.rows - 1), np.floor(turn * self.columns).astype(np.intp) % self.columns


def edge_probability(
    cloud: PointCloud, reflectivity: Floats | None, config: Config, rows_per_ring: float, columns_per_step: float
) -> tuple[Indices, Floats]:
    """P(E^L) of the points of a finite scan as measured: indices (m,) into the cloud and P (m,), above 0 to 1.

    The three maps are depth (without ground), reflectivity and object of the points that pass the thresholds of the stage
    thesis, completed and their edges taken as for the thesis's own objective; P is their mean in the point's cell. Points of
    P = 0 are left out. reflectivity: (n,) 0..1, None = not known: its map shows no edges then. TooFewFeaturesError if no point
    passes.
    """
    thesis = config.thesis
    in_reach = np.flatnonzero(within_reach(cloud.xyz, thesis) & (np.abs(_height(cloud.xyz)) < np.tan(STEEPEST)))
    xyz = cloud.xyz[in_reach]
    r = np.zeros(len(xyz), np.float32) if reflectivity is None else reflectivity[in_reach]
    passed = within_thresholds(xyz, None if reflectivity is None else r, thesis)
    if not passed.any():
        raise TooFewFeaturesError("no point of the cloud passes the thresholds of the stage thesis; widen them")
    # The ground is looked for before points are filtered by height: a level slice through the objects would pass for it.
    ground = ground_points(xyz, ground_plane(xyz, thesis), thesis)[passed]
    xyz, r = xyz[passed], r[passed]
    depth = filters.depth(xyz)
    points = PointAttributes(xyz, depth, r, np.zeros_like(depth), ground, object_labels(xyz, depth, ground, thesis))
    grid = Grid.of(range_image(cloud, config.lidar), xyz, rows_per_ring, columns_per_step)
    row, column = grid.cells(xyz)
    cell = row * grid.columns + column
    order = np.lexsort((depth, cell))
    nearest = order[np.diff(cell[order], prepend=-1) > 0]
    P = _edges(grid, row[nearest], column[nearest], PointLevels.of(points.select(nearest)), config)[row, column]
    some = np.flatnonzero(P)
    return in_reach[passed][some], P[some]


def _edges(grid: Grid, row: Indices, column: Indices, levels: PointLevels, config: Config) -> Floats:
    """Mean of the three edge maps (rows, columns), 0 in cells without a point. row, column: of points, one for a cell."""
    border = REACH + config.thesis.closing + 2  # as far as completion and edge operator look, so that the circle is closed
    width = grid.columns + 2 * border
    copies = column + border + np.array([[0], [grid.columns], [-grid.columns]])
    inside = np.flatnonzero((copies >= 0) & (copies < width))
    which = inside % len(row)
    pixels = row[which] * width + copies.ravel()[inside]
    maps = edge_maps(pixels, levels.select(which), (grid.rows, width), config.thesis)
    return maps.lidar_edges[:, border : border + grid.columns]


def _height(xyz: Floats) -> Floats:
    """Where lines of sight (n, 3) pass the cylinder of radius 1."""
    return np.asarray(xyz[:, 2] / np.maximum(np.hypot(xyz[:, 0], xyz[:, 1]), np.float32(1e-6)), np.float32)
