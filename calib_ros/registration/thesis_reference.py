"""Eq. 3.12 of the thesis written out, every map in full: to be read, to make its pictures, and to test the fast form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import ThesisConfig
from calib_ros.lidar.edge_maps import EdgeMaps, edge_maps
from calib_ros.registration.projection import nearest_per_pixel, project
from calib_ros.registration.thesis_features import ThesisFeatures

Matrix = NDArray[np.float64]
Map = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class RegistrationMaps:
    """The maps (h, w) of one frame under one extrinsic: D^L and W^L of 3.4.4, E^L and all before it, E^I."""

    discontinuity: Map
    weight: Map
    lidar: EdgeMaps
    image_edges: Map

    def edge_registration_score(self) -> float:
        """J of eq. 3.12: the sum over all pixels of W D E^I + E^L E^I."""
        matched = (self.weight * self.discontinuity) * self.image_edges + self.lidar.lidar_edges * self.image_edges
        return float(np.sum(matched, dtype=np.float64))

    def lidar_mass(self) -> float:
        """The sum of W D + E^L: what J would be on an image that is all edge. J over this is the normalised score."""
        return float(np.sum(self.weight * self.discontinuity + self.lidar.lidar_edges, dtype=np.float64))


def registration_maps(features: ThesisFeatures, T: Matrix, config: ThesisConfig, smoothing: int = -1) -> RegistrationMaps:
    """All maps of a frame at T_camera_lidar (4, 4). smoothing: which of ``thesis.smoothing``."""
    points, camera = features.points, features.camera
    shape = (camera.height, camera.width)
    u, v, inside = project(points.xyz, T, camera)
    pixels, kept = nearest_per_pixel(v * camera.width + u, inside, camera.height * camera.width)
    discontinuity, weight = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    discontinuity.ravel()[pixels] = normalized_discontinuity(points.discontinuity, config)[kept]
    weight.ravel()[pixels] = points.weight(config.min_depth)[kept]
    lidar = edge_maps(pixels, features.map_levels.select(kept), shape, config)
    return RegistrationMaps(discontinuity, weight, lidar, features.image_edges[smoothing])


def normalized_discontinuity(xi: Map, config: ThesisConfig) -> Map:
    """xi of eq. 3.10 (n,) m -> 0..1, as the grey value of D^L: a jump of ``thesis.max_discontinuity`` and more is 1."""
    return np.asarray(np.minimum(xi / np.float32(config.max_discontinuity), 1), np.float32)
