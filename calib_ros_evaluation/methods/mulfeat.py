"""MulFEAT (Zhang, Caesar and Rajan, "Multi-FEAT: Multi-Feature Edge Alignment for Targetless Camera-LiDAR Calibration",
arXiv 2207.07228), as the thesis describes it: eq. 4.6, tables 4.2 and 4.3."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import Config
from calib_ros.errors import TooFewFeaturesError
from calib_ros.frame import Frame, PointCloud
from calib_ros.image.edges import REFERENCE_FOCAL_LENGTH
from calib_ros.image.enhance import prepare
from calib_ros.lidar.range_image import RangeImage, range_image
from calib_ros.registration.score.point_score import project
from calib_ros.registration.search.constraints import SearchBox
from calib_ros.registration.search.optimizers import barzilai_borwein
from calib_ros_evaluation.methods.method import (
    MeanScore,
    Outcome,
    PointFeatures,
    Viewing,
    Watched,
    near,
    require,
    search_limits,
    typical_step_deg,
)
from calib_ros_thesis.cloud import PointAttributes, ground_plane, ground_points, object_labels, within_reach, within_thresholds
from calib_ros_thesis.cloud import depth as point_depth
from calib_ros_thesis.config import thesis_of
from calib_ros_thesis.image import gradient_edges, smoothed
from calib_ros_thesis.maps import REACH, PointLevels, edge_maps

# The edge probability of LiDAR points, on a cylinder around the scanner (MulFEAT; thesis 4.2.1, eq. 4.6).
STEEPEST = float(np.deg2rad(60.0))  # what is higher or lower would need a cylinder without end; no road scanner sees so far up
MAX_ROWS, MAX_COLUMNS = 2048, 16384  # cells of 0.02 deg and more; a few broken points must not cost the memory of millions

WHAT = "on LiDAR edges"

Matrix = NDArray[np.float64]
Floats = NDArray[np.float32]
Indices = NDArray[np.intp]


class Grid:
    """Cells of a cylinder of radius 1: row 0 is the highest, columns run counter-clockwise from azimuth -180 deg, and close the
    circle. top: height of the upper rim. row_step: height of a cell."""

    def __init__(self, scan: RangeImage, xyz: Floats, rows_per_ring: float, columns_per_step: float) -> None:
        """So many cells from one ring of the scan to the next, and from one azimuth to the next, for points (n, 3)."""
        height = _height(xyz)
        spacing = scan.azimuth_step
        if scan.layout == "rings" and len(scan.elevation) > 1:
            spacing = float(np.median(np.abs(np.diff(scan.elevation))))
        top, bottom = float(height.max()), float(height.min())
        self.row_step = max(spacing / rows_per_ring, (top - bottom) / (MAX_ROWS - 1), 1e-4)
        self.top, self.rows = top + self.row_step / 2, int((top - bottom) / self.row_step + 0.5) + 1
        self.columns = min(max(round(2 * np.pi * columns_per_step / scan.azimuth_step), 3), MAX_COLUMNS)

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
    thesis = thesis_of(config)
    in_reach = np.flatnonzero(within_reach(cloud.xyz, thesis) & (np.abs(_height(cloud.xyz)) < np.tan(STEEPEST)))
    xyz = cloud.xyz[in_reach]
    r = np.zeros(len(xyz), np.float32) if reflectivity is None else reflectivity[in_reach]
    passed = within_thresholds(xyz, None if reflectivity is None else r, thesis)
    if not passed.any():
        raise TooFewFeaturesError("no point of the cloud passes the thresholds of the stage thesis; widen them")
    # The ground is found before points are filtered by height: a level slice through the objects would look like it.
    ground = ground_points(xyz, ground_plane(xyz, thesis), thesis)[passed]
    xyz, r = xyz[passed], r[passed]
    depth = point_depth(xyz)
    points = PointAttributes(xyz, depth, r, np.zeros_like(depth), ground, object_labels(xyz, depth, ground, thesis))
    grid = Grid(range_image(cloud, config.lidar), xyz, rows_per_ring, columns_per_step)
    row, column = grid.cells(xyz)
    cell = row * grid.columns + column
    order = np.lexsort((depth, cell))
    nearest = order[np.diff(cell[order], prepend=-1) > 0]
    P = _edges(grid, row[nearest], column[nearest], PointLevels.of(points.select(nearest)), config)[row, column]
    some = np.flatnonzero(P)
    return in_reach[passed][some], P[some]


def _edges(grid: Grid, row: Indices, column: Indices, levels: PointLevels, config: Config) -> Floats:
    """Mean of the three edge maps (rows, columns), 0 in cells without a point. row, column: of points, one for a cell."""
    border = REACH + thesis_of(config).closing + 2  # as far as completion and edge operator look, so that the circle is closed
    width = grid.columns + 2 * border
    copies = column + border + np.array([[0], [grid.columns], [-grid.columns]])
    inside = np.flatnonzero((copies >= 0) & (copies < width))
    which = inside % len(row)
    pixels = row[which] * width + copies.ravel()[inside]
    maps = edge_maps(pixels, levels.select(which), (grid.rows, width), thesis_of(config))
    return maps.lidar_edges[:, border : border + grid.columns]


def _height(xyz: Floats) -> Floats:
    """Where lines of sight (n, 3) pass the cylinder of radius 1."""
    return np.asarray(xyz[:, 2] / np.maximum(np.hypot(xyz[:, 0], xyz[:, 1]), np.float32(1e-6)), np.float32)


@dataclass(frozen=True)
class Mulfeat(Viewing):
    """Method: the sum of P(E^L) E^C, times the share of LiDAR edges that meet an image edge, by steepest ascent.

    What the text leaves open. rows_per_ring, columns_per_step: cells of the cylinder from one ring and from one azimuth to the
    next, as large as the pixels of KITTI's camera. Maps, completion, ground, objects and the edge operator are those of the stage
    ``thesis``. E^C is the same operator on the grey picture, as in table 4.2; the paper takes the borders of a segmentation.
    smoothing: of E^C, px at 720 px focal length. lidar_edge, image_edge: P and E^C from here on are edges. Hidden points count.

    step_share: first and longest step, as a share of the reach; the half width of the differences is half of it. Both are halved
    round after round, down to a half width of finest_deg, half a pixel of KITTI. evaluations: of a round, at most. margin: points
    within this share of the image width around it are kept, enough for 10 deg or 0.5 m. min_points: per frame.
    """

    rows_per_ring: float = 5.0
    columns_per_step: float = 2.0
    smoothing: float = 1.5
    lidar_edge: float = 1 / 6
    image_edge: float = 0.3
    step_share: float = 0.5
    finest_deg: float = 0.04
    evaluations: int = 240
    margin: float = 0.3
    min_points: int = 200
    name = "mulfeat"
    title = "MulFEAT (Zhang et al. 2022): edges of depth, reflectivity and objects on a cylinder on image edges"

    def features(self, frame: Frame) -> PointFeatures:
        """P(E^L) and E^C. TooFewFeaturesError for fewer than min_points points with P above 0."""
        (view, measured), config = self._preprocess(frame), self.config
        index, P = edge_probability(measured, view.value, config, self.rows_per_ring, self.columns_per_step)
        require(len(index), self.min_points, WHAT, "check that the LiDAR sees objects")
        edges = gradient_edges(prepare(view.image), thesis_of(config))
        blur = self.smoothing * float(view.camera.K[0, 0]) / REFERENCE_FOCAL_LENGTH
        return PointFeatures(view.camera, smoothed(edges, blur), view.xyz[index], P)

    def score(self, features: Sequence[PointFeatures], T_prior: Matrix) -> MeanScore:
        """Mean of the frames' J. TooFewFeaturesError for fewer than min_points per frame near the image at T_prior."""
        return MeanScore(near(features, T_prior, self.margin, self.min_points, WHAT), self.matched)

    def matched(self, f: PointFeatures, T: Matrix) -> float:
        """J of eq. 4.6 of a frame; 0 without LiDAR edges in the image."""
        u, v, inside = project(f.xyz, T, f.camera)
        P, E = f.value[inside], f.image[v, u]
        is_edge = self.lidar_edge <= P
        n_matched = int(np.count_nonzero(is_edge & (self.image_edge <= E)))
        return n_matched / max(int(np.count_nonzero(is_edge)), 1) * float(P @ E)

    def optimise(self, features: Sequence[PointFeatures], T: Matrix, reach: SearchBox) -> Outcome:
        """Steepest ascent with the steps of Barzilai and Borwein, round after round from the best so far, within the reach."""
        watched, limits = Watched(self.score(features, T)), search_limits(T, reach)
        step = max(self.step_share * typical_step_deg(reach), 2 * self.finest_deg)
        while step / 2 >= self.finest_deg:
            T, _ = barzilai_borwein(watched, T, step, step / 2, self.evaluations, limits)
            step /= 2
        return Outcome(T, watched.evaluations)
