"""Point attributes of the thesis (3.3): filters, ground, objects, and depth discontinuity along the rings."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from calib_ros.frame import PointCloud
from calib_ros.lidar.range_image import reflectivity, require_returns
from calib_ros.lidar.rings import ring_of_points
from calib_ros.lidar.segmentation import Plane, cluster, fit_ground
from calib_ros_thesis.config import ThesisConfig

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]
SEED = 0  # of RANSAC
GROUND_TILT_DEG, GROUND_SHARE = 15.0, 0.05  # planes of more tilt, or of a smaller share of the points, are roofs and walls
CLUSTER_VOXEL = 0.15  # m; its points are clustered as one weighted point: the same objects, many times faster
NO_OBJECT = 0
MAX_LABEL = 254  # object maps are 8 bit; further clusters, the smallest ones, are numbered from 1 again
# rad; points across a wider gap, if it is also three times wider than usual, are at the ends of the field of view.
MAX_NEIGHBOUR_GAP = float(np.deg2rad(60.0))


@dataclass(frozen=True, eq=False)
class PointAttributes:
    """Attributes of the filtered points of a scan (figure 3.6), far points first: near ones overwrite them in a projection.

    xyz: (n, 3) float32, m, LiDAR frame. depth: (n,) d of eq. 3.8, m. reflectivity: (n,) 0..1; zeros if the source has none.
    discontinuity: (n,) xi of eq. 3.10, m. ground: (n,) bool (algorithm 1). label: (n,) uint8, object (algorithm 2) or NO_OBJECT.
    """

    xyz: Floats
    depth: Floats
    reflectivity: Floats
    discontinuity: Floats
    ground: NDArray[np.bool_]
    label: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.xyz)

    def select(self, keep: NDArray[np.bool_] | NDArray[np.intp]) -> PointAttributes:
        """The points of a mask or index array, in their order."""
        return PointAttributes(*(getattr(self, f.name)[keep] for f in fields(self)))

    def weight(self, nearest: float) -> Floats:
        """w^L (n,) in 0..1: mean of the reflectivity and of the inverse depth, which is 1 at `nearest` m (thesis 3.4.4)."""
        return np.asarray(0.5 * (self.reflectivity + np.minimum(np.float32(nearest) / self.depth, 1)), np.float32)


def attributes(cloud: PointCloud, config: ThesisConfig, at_image: Floats | None = None) -> PointAttributes:
    """Attributes of the points of a recorded cloud within the thresholds. TooFewFeaturesError for a scan with hardly any returns.

    at_image: (n, 3) deskewed points, None = as measured. Positions and depths are taken from them, everything else from the scan
    as measured, whose rings are regular. Discontinuities are those of the whole scan, objects clusters of the remaining points.
    """
    require_returns(cloud)
    finite = cloud.finite_mask()
    at_image = cloud.xyz[finite] if at_image is None else at_image[finite]
    cloud = cloud.finite()
    xi = discontinuity(cloud)
    known = reflectivity(cloud.intensity)
    r = known if known is not None else np.zeros(len(cloud), np.float32)
    in_reach = np.flatnonzero(within_reach(cloud.xyz, config))
    passed = within_thresholds(cloud.xyz[in_reach], None if known is None else known[in_reach], config)
    # Before heights are filtered: else a horizontal slice through the objects would be taken for the ground.
    ground = ground_points(cloud.xyz[in_reach], ground_plane(cloud.xyz[in_reach], config), config)[passed]
    keep = in_reach[passed]
    xyz, d = cloud.xyz[keep], depth(cloud.xyz[keep])
    label = object_labels(xyz, d, ground, config)
    xyz, d = at_image[keep], depth(at_image[keep])
    return PointAttributes(xyz, d, r[keep], xi[keep], ground, label).select(np.argsort(-d, kind="stable"))


def within_reach(xyz: Floats, config: ThesisConfig) -> Mask:
    """Points (n,) that pass the filters of depth and azimuth."""
    near = by_range(xyz, config.min_depth, config.max_depth)
    return np.asarray(near & by_angle(xyz, config.azimuth_deg, config.azimuth_half_width_deg))


def within_thresholds(xyz: Floats, r: Floats | None, config: ThesisConfig) -> Mask:
    """Points (n,) that pass all threshold filters (3.3.1). r: reflectivity, None = unknown and not filtered."""
    passed = within_reach(xyz, config) & by_height(xyz, config.min_height, config.max_height)
    return passed if r is None else np.asarray(passed & by_reflectivity(r, config.min_reflectivity, config.max_reflectivity))


def depth(xyz: Floats) -> Floats:
    """Horizontal distance from the LiDAR's axis, eq. 3.8; (n, 3) m -> (n,) m."""
    return np.hypot(xyz[:, 0], xyz[:, 1])


def by_range(xyz: Floats, low: float, high: float) -> Mask:
    """Points whose depth (eq. 3.8, m) lies in low..high; (n,) bool."""
    d = depth(xyz)
    return np.asarray((d >= low) & (d <= high))


def by_height(xyz: Floats, low: float, high: float) -> Mask:
    """Points whose height above the LiDAR (its z, m) lies in low..high; (n,) bool."""
    return np.asarray((xyz[:, 2] >= low) & (xyz[:, 2] <= high))


def by_reflectivity(reflectivity: Floats, low: float, high: float = 1.0) -> Mask:
    """Points whose reflectivity (n,) lies in low..high, such as signs and lane markings, or all others; (n,) bool."""
    return np.asarray((reflectivity >= low) & (reflectivity <= high))


def by_angle(xyz: Floats, center_deg: float, half_width_deg: float) -> Mask:
    """Points whose azimuth lies within half_width_deg of center_deg (0 = the LiDAR's +x, counter-clockwise); (n,) bool."""
    if half_width_deg >= 180:
        return np.ones(len(xyz), bool)
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    away = np.abs(np.angle(np.exp(1j * (azimuth - np.deg2rad(center_deg)))))
    return np.asarray(away <= np.deg2rad(half_width_deg))


def ground_plane(xyz: Floats, config: ThesisConfig) -> Plane | None:
    """The ground plane of points (n, 3), LiDAR frame; None if there is none."""
    limits = config.ground_distance, config.ground_iterations, GROUND_TILT_DEG, GROUND_SHARE
    return fit_ground(xyz, *limits, SEED, compared=max(len(xyz), 1))


def ground_points(xyz: Floats, plane: Plane | None, config: ThesisConfig) -> Mask:
    """Points (n,) on or below the ground; none without a plane."""
    return np.zeros(len(xyz), bool) if plane is None else np.asarray(plane.distance(xyz) < config.ground_distance)


def object_labels(xyz: Floats, d: Floats, ground: NDArray[np.bool_], config: ThesisConfig) -> NDArray[np.uint8]:
    """Objects among the points above ground within the range limit, (n,) uint8: largest object 1, NO_OBJECT elsewhere."""
    label = np.full(len(xyz), NO_OBJECT, np.uint8)
    near = np.flatnonzero(~ground & (d <= config.cluster_max_depth))
    found = cluster(xyz[near], config.cluster_eps, config.cluster_min_points, CLUSTER_VOXEL)
    label[near[found >= 0]] = 1 + found[found >= 0] % MAX_LABEL
    return label


def discontinuity(cloud: PointCloud) -> Floats:
    """xi of every point of a finite cloud, eq. 3.10, (n,) m: by how much the farther of its neighbours in the ring is behind it.

    Source: thesis 3.4.3; Levinson and Thrun 2013. Neighbours are the returns next to it by azimuth, across a full revolution too.
    """
    xyz = cloud.xyz
    if len(xyz) == 0:
        return np.empty(0, np.float32)
    q = np.linalg.norm(xyz, axis=1).astype(np.float32)
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    ring = ring_of_points(cloud, azimuth, np.arcsin(xyz[:, 2] / np.maximum(q, 1e-6)))
    order = np.lexsort((azimuth, ring))
    ring, along = ring[order], q[order]
    place = np.arange(len(ring))
    starts = np.flatnonzero(np.diff(ring, prepend=ring[0] - 1))
    ends = np.append(starts[1:], len(ring)) - 1
    last, following = place - 1, place + 1
    last[starts], following[ends] = ends, starts
    turn = azimuth[order]
    gap_before, gap_after = _gap(turn, turn[last]), _gap(turn, turn[following])
    limit = max(MAX_NEIGHBOUR_GAP, 3 * float(np.median(gap_after)))
    before, after = np.where(gap_before > limit, 0, along[last]), np.where(gap_after > limit, 0, along[following])
    xi = np.empty(len(q), np.float32)
    xi[order] = np.maximum(np.maximum(before, after) - along, 0)
    return xi


def _gap(a: NDArray[np.floating], b: NDArray[np.floating]) -> NDArray[np.floating]:
    """Angles between azimuths, 0..pi rad."""
    gap = np.abs(a - b)
    return np.minimum(gap, 2 * np.pi - gap)
