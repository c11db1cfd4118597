"""What the thesis knows of each LiDAR point (3.3, figure 3.6). None of it depends on the extrinsic: computed once per scan."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import ThesisConfig
from calib_ros.errors import BadInputError
from calib_ros.frame import PointCloud
from calib_ros.lidar import filters
from calib_ros.lidar.clusters import cluster
from calib_ros.lidar.discontinuity import discontinuity
from calib_ros.lidar.ground import Plane, fit_ground
from calib_ros.lidar.scan import reflectivity, require_returns

SEED = 0  # of RANSAC
NO_OBJECT = 0
MAX_LABEL = 254  # object maps are 8 bit; clusters beyond are numbered from 1 again, the smallest ones

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class PointAttributes:
    """The filtered points of a scan, far ones first, so that near ones overwrite them in a projection.

    xyz: (n, 3) float32 m, LiDAR frame. depth: (n,) d of eq. 3.8, m. reflectivity: (n,) 0..1; zeros if the source has none.
    discontinuity: (n,) xi of eq. 3.10, m. ground: (n,) bool (algorithm 1). label: (n,) uint8, object (algorithm 2) or
    NO_OBJECT.
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
    """Cloud as recorded -> attributes of its points within the thresholds.

    at_image: (n, 3) where its points stand at the image's moment, None = where they were measured. It gives positions and
    depths; all else is found in the scan as measured, where the rings are regular.
    Neighbours in a ring are those of the whole scan. The ground is looked for before points are filtered by height and
    reflectivity: without it, a level slice through the objects would pass for it. Objects are looked for among the points left.
    Raises TooFewFeaturesError if hardly anything returned.
    """
    require_returns(cloud)
    if at_image is not None and at_image.shape != cloud.xyz.shape:
        raise BadInputError(f"at_image has shape {at_image.shape}, but the cloud {cloud.xyz.shape}")
    finite = cloud.finite_mask()
    at_image = cloud.xyz[finite] if at_image is None else at_image[finite]
    cloud = cloud.finite()
    xi = discontinuity(cloud)
    known = reflectivity(cloud.intensity)
    r = known if known is not None else np.zeros(len(cloud), np.float32)
    in_reach = np.flatnonzero(within_reach(cloud.xyz, config))
    passed = within_thresholds(cloud.xyz[in_reach], None if known is None else known[in_reach], config)
    ground = ground_points(cloud.xyz[in_reach], ground_plane(cloud.xyz[in_reach], config), config)[passed]
    keep = in_reach[passed]
    xyz, d = cloud.xyz[keep], filters.depth(cloud.xyz[keep])
    label = object_labels(xyz, d, ground, config)
    xyz, d = at_image[keep], filters.depth(at_image[keep])
    order = np.argsort(-d, kind="stable")
    whole = PointAttributes(xyz, d, r[keep], xi[keep], ground, label)
    return whole.select(order)


def within_reach(xyz: Floats, config: ThesisConfig) -> NDArray[np.bool_]:
    """Points (n,) at a depth and an azimuth that the filters let pass."""
    return np.asarray(
        filters.by_range(xyz, config.min_depth, config.max_depth)
        & filters.by_angle(xyz, config.azimuth_deg, config.azimuth_half_width_deg)
    )


def within_thresholds(xyz: Floats, r: Floats | None, config: ThesisConfig) -> NDArray[np.bool_]:
    """Points (n,) that pass all threshold filters (3.3.1). r: None = not told, and then its threshold says nothing."""
    passed = within_reach(xyz, config) & filters.by_height(xyz, config.min_height, config.max_height)
    return (
        passed if r is None else np.asarray(passed & filters.by_reflectivity(r, config.min_reflectivity, config.max_reflectivity))
    )


def ground_plane(xyz: Floats, config: ThesisConfig) -> Plane | None:
    """The ground among points (n, 3), LiDAR frame; None if there is none in sight."""
    return fit_ground(xyz, config.ground_distance, config.ground_iterations, config.ground_tilt_deg, config.ground_share, SEED)


def ground_points(xyz: Floats, plane: Plane | None, config: ThesisConfig) -> NDArray[np.bool_]:
    """Points (n,) on or below the ground; none without a plane."""
    return np.zeros(len(xyz), bool) if plane is None else np.asarray(plane.distance(xyz) < config.ground_distance)


def object_labels(xyz: Floats, d: Floats, ground: NDArray[np.bool_], config: ThesisConfig) -> NDArray[np.uint8]:
    """Objects among the points above ground within the range limit; (n,) uint8, largest object 1, NO_OBJECT elsewhere."""
    label = np.full(len(xyz), NO_OBJECT, np.uint8)
    near = np.flatnonzero(~ground & (d <= config.cluster_max_depth))
    found = cluster(xyz[near], config.cluster_eps, config.cluster_min_points, config.cluster_voxel)
    label[near[found >= 0]] = 1 + found[found >= 0] % MAX_LABEL
    return label
