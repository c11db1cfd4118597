"""Instances of classes: connected regions of pixels, clusters of points (thesis 3.5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.frame import MAIN_CLASSES
from calib_ros.lidar.segmentation import cluster

CLUSTER_EPS = 0.8  # m; points of an object are nearer to each other, parked cars are not
CLUSTER_MIN_POINTS = 4  # of a scan downsampled to 0.4 deg: a person at 30 m has about 10


@dataclass(frozen=True, eq=False)
class ImageInstances:
    """Instances in an image, class after class.

    cls: (k,) uint8 SemanticClass. centroid: (k, 2) float64 px, mean of the pixels. area: (k,) int32 px. box: (k, 4) int32 left,
    top, width, height, px. cut: (k,) bool, touching the border of the image, so that the centroid is not that of the object.
    """

    cls: NDArray[np.uint8]
    centroid: NDArray[np.float64]
    area: NDArray[np.int32]
    box: NDArray[np.int32]
    cut: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.cls)


@dataclass(frozen=True, eq=False)
class CloudInstances:
    """Instances in a cloud, class after class.

    cls: (k,) uint8 SemanticClass. centroid: (k, 3) float64 m, mean of the points, LiDAR frame. points: (k,) int32, their number.
    """

    cls: NDArray[np.uint8]
    centroid: NDArray[np.float64]
    points: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.cls)


def image_instances(classes: NDArray[np.uint8], min_area: int, wanted: Sequence[int] = MAIN_CLASSES) -> ImageInstances:
    """Connected regions (8 neighbours) of at least min_area pixels in classes (h, w). wanted: SemanticClasses."""
    height, width = classes.shape
    cls, centroid, stats = [], [np.empty((0, 2))], [np.empty((0, 5), np.int32)]
    for c in wanted:
        _, _, found, middle = cv2.connectedComponentsWithStats((classes == c).astype(np.uint8), connectivity=8)
        large = 1 + np.flatnonzero(found[1:, cv2.CC_STAT_AREA] >= min_area)  # 0 is the background
        cls += [c] * len(large)
        centroid.append(middle[large])
        stats.append(found[large])
    box, area = np.split(np.concatenate(stats), [4], axis=1)
    left, top, wide, high = box.T
    cut = (left == 0) | (top == 0) | (left + wide == width) | (top + high == height)
    return ImageInstances(np.array(cls, np.uint8), np.concatenate(centroid), area[:, 0], box, cut)


def cloud_instances(xyz: NDArray[np.float32], label: NDArray[np.uint8], wanted: Sequence[int] = MAIN_CLASSES) -> CloudInstances:
    """Clusters of the points (n, 3) of each wanted class by DBSCAN. label: (n,) SemanticClass.

    The points should be uniform in angle, like pixels: a mean of all points of a scan is biased to where its rings are dense.
    """
    cls, centroid, points = [], [np.empty((0, 3))], [np.empty(0, np.int32)]
    for c in wanted:
        own = xyz[label == c]
        member = cluster(own, CLUSTER_EPS, CLUSTER_MIN_POINTS)
        count = np.bincount(member[member >= 0])
        sums = [np.bincount(member[member >= 0], own[member >= 0, k], len(count)) for k in range(3)]
        cls += [c] * len(count)
        centroid.append(np.stack(sums, axis=1) / count[:, None])
        points.append(count.astype(np.int32))
    return CloudInstances(np.array(cls, np.uint8), np.concatenate(centroid), np.concatenate(points))
