"""A scan as the sensor saw it: a range image of elevation x azimuth, whatever the scanner and the order of its points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import LidarConfig
from calib_ros.errors import TooFewFeaturesError
from calib_ros.frame import PointCloud
from calib_ros.lidar.columns import azimuth_step, columns_of
from calib_ros.lidar.cones import ring_cones
from calib_ros.lidar.projection import Samples, most_cells, project
from calib_ros.lidar.rings import even_rows, find_rings
from calib_ros.lidar.strays import strays

MIN_POINTS = 100  # a scan with fewer returns shows nothing
SAME_SURFACE = 0.05  # share of the range by which neighbours on one surface may differ


@dataclass(frozen=True, eq=False)
class RangeImage:
    """Range image of a scan; row 0 is the highest, columns run counter-clockwise from azimuth -180 deg.

    range: (rows, cols) float32 metres, NaN where nothing returned; isolated holes are interpolated.
    index: (rows, cols) int32 into `cloud`, -1 where there is no measured point of a surface (interpolated holes
    and stray returns).
    elevation: (rows,) rad, median per ring. azimuth_step: rad. reflectivity: (n,) 0..1 per point of `cloud`, or None.
    layout: "rings" = a row is a ring and its rays run on a cone, cones: (rows, 2) as of ring_cones; "projection" = no rings,
    rows and columns are cells as wide as the points are apart; `range` then holds the range at the middle of the cell, and
    samples knows what lies in it.
    """

    range: NDArray[np.float32]
    index: NDArray[np.int32]
    elevation: NDArray[np.float64]
    azimuth_step: float
    cloud: PointCloud
    reflectivity: NDArray[np.float32] | None
    cones: NDArray[np.float64]
    samples: Samples | None = None

    @property
    def layout(self) -> str:
        """ "rings" or "projection"."""
        return "rings" if self.samples is None else "projection"


def range_image(cloud: PointCloud, config: LidarConfig) -> RangeImage:
    """Point cloud -> range image; the nearest return wins a cell. TooFewFeaturesError when hardly anything returned."""
    cloud = cloud.finite()
    distance = np.linalg.norm(cloud.xyz, axis=1)
    keep = distance >= config.min_range
    if int(keep.sum()) < MIN_POINTS:
        raise _too_few(int(keep.sum()))
    cloud, distance = cloud.select(keep), distance[keep]
    azimuth = np.arctan2(cloud.xyz[:, 1], cloud.xyz[:, 0])
    elevation = np.arcsin(cloud.xyz[:, 2] / distance)
    ring = None if config.layout == "projection" else find_rings(cloud, azimuth, elevation)
    if ring is None and config.layout != "rings":
        return _projection(cloud, Samples(azimuth, elevation, distance), config)
    return _rings(cloud, even_rows(elevation) if ring is None else ring, azimuth, elevation, distance, config)


def _rings(
    cloud: PointCloud,
    ring: NDArray[np.int32],
    azimuth: NDArray[np.floating],
    elevation: NDArray[np.floating],
    distance: NDArray[np.floating],
    config: LidarConfig,
) -> RangeImage:
    row, row_elevation = _rows_from_top(ring, elevation)
    step = azimuth_step(row, azimuth)
    columns = max(min(round(2 * np.pi / step), most_cells(len(row)) // len(row_elevation)), 1)
    step = max(step, 2 * np.pi / (columns + 0.5))  # wider only where there would have been too many columns
    column = columns_of(row, azimuth, columns)
    ranges = np.full((len(row_elevation), columns), np.nan, np.float32)
    index = np.full(ranges.shape, -1, np.int32)
    order = np.argsort(-distance, kind="stable")  # later writes win: nearest last
    ranges[row[order], column[order]] = distance[order]
    index[row[order], column[order]] = order
    stray = strays(ranges, config.jump_min, SAME_SURFACE)
    index[stray] = -1
    _fill_single_holes(ranges, config.hole_jump)
    cones = ring_cones(row, cloud.xyz, len(row_elevation))
    return RangeImage(ranges, index, row_elevation, step, cloud, reflectivity(cloud.intensity), cones)


def _projection(cloud: PointCloud, samples: Samples, config: LidarConfig) -> RangeImage:
    image = project(samples, config.jump_min, SAME_SURFACE)
    cones = np.stack([np.zeros(len(image.elevation)), np.tan(image.elevation)], axis=1)
    light = reflectivity(cloud.intensity)
    return RangeImage(image.range, image.index, image.elevation, image.step, cloud, light, cones, image.samples)


def require_returns(cloud: PointCloud) -> None:
    """TooFewFeaturesError if hardly a point of the cloud is a return; far cheaper than the range image."""
    usable = len(cloud.finite())
    if usable < MIN_POINTS:
        raise _too_few(usable)


def _too_few(usable: int) -> TooFewFeaturesError:
    return TooFewFeaturesError(f"the cloud has {usable} usable points; check that the LiDAR sees something and is not covered")


def _rows_from_top(ring: NDArray[np.int32], elevation: NDArray[np.floating]) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Ring numbers of any order (n,) -> row from the top (n,) and the median elevation of each row."""
    order = np.argsort(ring, kind="stable")
    names, first = np.unique(ring[order], return_index=True)
    medians = np.array([np.median(part) for part in np.split(elevation[order], first[1:])])
    from_top = np.argsort(-medians, kind="stable")
    row_of_name = np.empty(len(names), np.int32)
    row_of_name[from_top] = np.arange(len(names), dtype=np.int32)
    return row_of_name[np.searchsorted(names, ring)], medians[from_top]


def _fill_single_holes(ranges: NDArray[np.float32], hole_jump: float) -> None:
    left, right = np.roll(ranges, 1, 1), np.roll(ranges, -1, 1)
    with np.errstate(invalid="ignore"):
        hole = np.isnan(ranges) & (np.abs(left - right) < hole_jump)
    ranges[hole] = 0.5 * (left[hole] + right[hole])


def reflectivity(intensity: NDArray[np.float32] | None) -> NDArray[np.float32] | None:
    """Intensity in the driver's unit -> 0..1. Units in use: 0..1 (KITTI), 0..255 (most drivers), counts (Ouster).

    None when there is no intensity, or it is the same everywhere (drivers without it fill in a constant).
    """
    if intensity is None or len(intensity) == 0:
        return None
    values = np.nan_to_num(intensity, nan=0.0, posinf=0.0, neginf=0.0)
    high = float(np.percentile(values, 99.9))
    if high <= float(values.min()):
        return None
    full_scale = 1.0 if values.max() <= 1.5 else 255.0 if values.max() <= 256 else high
    return np.asarray(np.clip(values / np.float32(full_scale), 0, 1), np.float32)
