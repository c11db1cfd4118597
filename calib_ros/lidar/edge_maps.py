"""Edges of a scan in the picture: sparse maps, density completion, edge operator (thesis 3.4.3, figures 3.13 to 3.16).

The maps hold integers: depth in cm, reflectivity in thousandths. OpenCV works on them several times faster than on floats,
and neither the order of sums nor the machine changes a result.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import ThesisConfig
from calib_ros.image import operators
from calib_ros.lidar import density
from calib_ros.lidar.attributes import PointAttributes

Levels = NDArray[np.int16]
Floats = NDArray[np.float32]
DEPTH_UNITS = 100.0  # levels per metre
REFLECTIVITY_UNITS = 1000.0  # levels of full scale; 1 is added, since 0 says that nothing was projected
FAR_LEVEL = 8190  # the Sobel kernels add up four times a level, which has to fit 16 bit
OBJECT_STEP = 1.0  # any change of the object is a full edge: labels are names, not sizes


@dataclass(frozen=True, eq=False)
class PointLevels:
    """Attributes of points (n,) as levels of the maps; density.EMPTY where a point has no place in the map.

    depth: of points above ground. The ground is large and bare of edges (thesis 3.3.2). label: object.
    """

    depth: Levels
    reflectivity: Levels
    label: NDArray[np.uint8]

    @staticmethod
    def of(points: PointAttributes) -> PointLevels:
        """The levels of points."""
        depth = np.clip(np.rint(points.depth * np.float32(DEPTH_UNITS)), 1, FAR_LEVEL).astype(np.int16)
        depth[points.ground] = density.EMPTY
        reflectivity = 1 + np.rint(points.reflectivity * np.float32(REFLECTIVITY_UNITS)).astype(np.int16)
        return PointLevels(depth, reflectivity, points.label)

    def select(self, keep: NDArray[np.intp]) -> PointLevels:
        """The levels of some points."""
        return PointLevels(self.depth[keep], self.reflectivity[keep], self.label[keep])


@dataclass(frozen=True, eq=False)
class EdgeMaps:
    """Every map (h, w) between the projected points and E^L: sparse Psi, dense Phi, edges delta (float32, 0..1)."""

    sparse_depth: Levels
    sparse_reflectivity: Levels
    sparse_object: NDArray[np.uint8]
    dense_depth: Levels
    dense_reflectivity: Levels
    dense_object: NDArray[np.uint8]
    depth_edges: Floats
    reflectivity_edges: Floats
    object_edges: Floats
    occupied: NDArray[np.bool_]

    @property
    def lidar_edges(self) -> Floats:
        """E^L (h, w): the mean of the three edge maps where a point was projected, 0 elsewhere."""
        total = self.depth_edges + self.reflectivity_edges + self.object_edges
        return np.asarray(np.where(self.occupied, total * np.float32(1 / 3), np.float32(0)), np.float32)


def far_level(config: ThesisConfig) -> int:
    """What depth is inverted about, in levels: the farthest that the filters let pass."""
    return min(round(config.max_depth * DEPTH_UNITS), FAR_LEVEL)


def low_level(config: ThesisConfig) -> int:
    """Levels of the dense reflectivity map from here down count as nothing."""
    return round(config.low_reflectivity * REFLECTIVITY_UNITS)


def edge_maps(pixels: NDArray[np.intp], levels: PointLevels, shape: tuple[int, int], config: ThesisConfig) -> EdgeMaps:
    """All maps of a picture of `shape` (h, w).

    pixels: (n,) flat, each at most once: the nearest point's. levels: of these points. The readable form; FastEdgeMaps gives
    the same E^L several times faster.
    """
    empty = np.zeros(shape[0] * shape[1], np.int16)
    depth, reflectivity, label = empty.copy(), empty.copy(), empty.astype(np.uint8)
    depth[pixels], reflectivity[pixels], label[pixels] = levels.depth, levels.reflectivity, levels.label
    occupied = np.zeros(len(empty), bool)
    occupied[pixels] = True

    dense_depth = density.complete_depth(depth.reshape(shape), far_level(config))
    completed = density.complete(reflectivity.reshape(shape))
    dense_reflectivity = np.where(completed > low_level(config), completed, np.int16(0))
    dense_object = density.close_gaps(label.reshape(shape), config.closing)

    def edges(dense: Levels | NDArray[np.uint8], step: float) -> Floats:
        return operators.edges(dense, config.operator, step, config.canny_low, config.canny_high)

    return EdgeMaps(
        depth.reshape(shape),
        reflectivity.reshape(shape),
        label.reshape(shape),
        dense_depth,
        dense_reflectivity,
        dense_object,
        edges(dense_depth, config.depth_step * DEPTH_UNITS),
        edges(dense_reflectivity, config.reflectivity_step * REFLECTIVITY_UNITS),
        edges(dense_object, OBJECT_STEP),
        occupied.reshape(shape),
    )
