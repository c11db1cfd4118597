"""Classes of points by the shape of clusters, for LiDARs without a network.

The ground is what lies low; poles, signs, vehicles, cyclists and people are found by size and shape; the rest is vegetation
where it is rough, and a building where it is flat, upright and high. What shapes do not tell apart: a cyclist seen from ahead or
behind is a person, a lorry a building, and a slender trunk whose crown is out of sight a pole.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_ros.classes import UNLABELLED, SemanticClass
from calib_ros.frame import Frame, PointCloud
from calib_ros.lidar.scan import MIN_POINTS, reflectivity
from calib_ros.semantics.cluster_backdrop import backdrop
from calib_ros.semantics.cluster_ground import heights
from calib_ros.semantics.cluster_objects import find_objects
from calib_ros.semantics.cluster_poles import find_poles
from calib_ros.semantics.cluster_shapes import surfaces
from calib_ros.semantics.cluster_signs import find_signs
from calib_ros.semantics.deadline import Deadline

Floats = NDArray[np.float32]
Classes = NDArray[np.uint8]
RANGE = 60.0  # m; farther off a car has too few points to have a shape
GROUND = 0.2  # m; kerbs and rough grass are lower
TOP = 8.0  # m; higher up there are only houses and crowns, which what is below tells apart
SHELLS = (3.0, 5.0, 8.0, 12.0, 18.0, 26.0, 40.0)  # m; distances between which the edge of the field of view is sought
HIGHEST = 99.7  # percentile of the elevations there; a ring of 128 has 0.8 percent of the points, and above it there are strays
EDGE = np.float32(np.deg2rad(0.6))  # elevation below the highest returns that still belongs to the edge of the field of view


def cluster_classes(cloud: PointCloud, seed: int = 0) -> Classes:
    """SemanticClass of each point (n,) uint8; UNLABELLED where its shape tells nothing, beyond RANGE, and for no return.

    The cloud may come from any LiDAR that sees the ground and stands upright to 15 deg; only xyz and, for signs, the intensity
    are used. Without ground in sight nothing is labelled. Deterministic for a seed (of the ground's RANSAC). Raises
    MissingDependencyError without scikit-learn.
    """
    labels = np.full(len(cloud), UNLABELLED, np.uint8)
    seen = np.nonzero(cloud.finite_mask())[0]
    if len(seen) < MIN_POINTS:
        return labels
    xyz = heights(cloud.xyz[seen], seed)
    if xyz is None:
        return labels
    near = np.hypot(xyz[:, 0], xyz[:, 1]) < RANGE
    labels[seen[near & (xyz[:, 2] < GROUND)]] = SemanticClass.GROUND
    standing = near & (xyz[:, 2] >= GROUND) & (xyz[:, 2] < TOP)
    if standing.any():
        light = reflectivity(cloud.intensity)
        of_standing = None if light is None else light[seen[standing]]
        labels[seen[standing]] = _standing(xyz[standing], of_standing, _cut_off(cloud.xyz[seen])[standing])
    return labels


class ClusterClasses:
    """cluster_classes in place of a loaded network."""

    fallback = ""  # there is nothing that could run elsewhere

    def __call__(self, frame: Frame, deadline: Deadline) -> Classes:
        """Classes (n,) of the points of the frame's cloud. BudgetError when the time is up already."""
        deadline.check()
        return cluster_classes(frame.cloud)

    def describe(self) -> str:
        """For people."""
        return "shapes of clusters: ground, vehicles, people, cyclists, poles, signs, buildings, vegetation"


def _standing(xyz: Floats, light: Floats | None, cut: NDArray[np.bool_]) -> Classes:
    """Classes (n,) of points (n, 3) above the ground, z = height (m), reflectivity (n,) and whether they are cut off."""
    shape = surfaces(xyz)
    poles = find_poles(xyz)
    signs = find_signs(xyz, light) | poles.plate
    labels = backdrop(xyz, shape, cut)
    labels[poles.trunk] = SemanticClass.VEGETATION
    labels[poles.pole] = SemanticClass.POLE
    labels[signs] = SemanticClass.SIGN
    objects = find_objects(xyz, shape, cut, ~(poles.pole | poles.trunk | signs))
    return np.where(objects == UNLABELLED, labels, objects)


def _cut_off(xyz: Floats) -> NDArray[np.bool_]:
    """Points (n,) at the upper edge of the field of view, so that what they lie on may be taller. xyz: (n, 3) as measured.

    The edge is told by the highest returns as far off and farther: the lasers of many scanners lie some decimetres above or
    below its origin, which turns the edge up where it is near.
    """
    distance = np.hypot(xyz[:, 0], xyz[:, 1])
    elevation = np.arctan2(xyz[:, 2], distance)
    shell = np.digitize(distance, SHELLS)
    # Only above the horizon: every scanner sees that far up, and then the highest return may be the top of a car.
    edge = np.zeros(len(SHELLS) + 1)
    for k in range(len(edge)):
        inside = elevation[shell == k]
        if len(inside) >= MIN_POINTS:
            edge[k] = max(np.percentile(inside, HIGHEST), 0.0)
    edge = np.maximum.accumulate(edge[::-1])[::-1]
    return np.asarray(elevation > np.maximum(edge[shell] - EDGE, 0.0))
