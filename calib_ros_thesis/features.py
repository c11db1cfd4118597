"""Features of a frame for the thesis's objective: attributes of the points and edge maps of the image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera
from calib_ros.config import Config, ThesisConfig
from calib_ros.frame import PointCloud
from calib_ros.image.edges import REFERENCE_FOCAL_LENGTH, EdgeLevel, blurred_levels
from calib_ros.image.enhance import prepare
from calib_ros.lidar.edges import EdgePoints
from calib_ros.registration.features import FrameFeatures
from calib_ros_semantics.models.segmentation import OF_CLASSES, OF_MASKS
from calib_ros_thesis.cloud import PointAttributes, attributes
from calib_ros_thesis.image import blend, gradient_edges, smoothed
from calib_ros_thesis.maps import PointLevels

Map = NDArray[np.float32]
CLASS_EDGE_SHARE = 0.1  # of borders of classes, less than of masks: they follow outlines less closely


@dataclass(frozen=True, eq=False)
class ThesisFeatures:
    """Features of a frame for eq. 3.12.

    Attributes
    ----------
    fast : those of the fast score, which finds the start and validates the match of LiDAR and image.
    points : LiDAR frame, far ones first. map_levels : their levels in the maps.
    image_edges : E^I (h, w) in 0..1, for every smoothing of ``thesis.smoothing``.
    levels : the same edges at the resolutions of the fast score, (1, h, w) standardised.
    """

    fast: FrameFeatures
    points: PointAttributes
    map_levels: PointLevels
    image_edges: list[Map]
    levels: list[EdgeLevel]

    @property
    def name(self) -> str:
        """Of the frame."""
        return self.fast.name

    @property
    def camera(self) -> Camera:
        """Pinhole of the maps."""
        return self.fast.camera

    @property
    def stamp(self) -> int:
        """Of the image, ns."""
        return self.fast.stamp

    @property
    def has_reflectivity(self) -> bool:
        """False if the source gave no usable intensity."""
        return self.fast.has_reflectivity

    @property
    def twist(self) -> NDArray[np.float64] | None:
        """(6,) the LiDAR's velocity by which the points were moved to the image's moment, None = they were not."""
        return self.fast.twist

    @property
    def outline(self) -> EdgePoints:
        """What to draw of the scan's edges."""
        return self.fast.outline


def thesis_features(
    cloud: PointCloud,
    image: NDArray[np.uint8],
    fast: FrameFeatures,
    config: Config,
    semantic: Map | None = None,
    at_image: Map | None = None,
    edges_of: str = OF_MASKS,
) -> ThesisFeatures:
    """Features of a frame. image: rectified (h, w[, 3]) of fast.camera. semantic: edges (h, w) in 0..1 to blend in.
    at_image: (n, 3) deskewed points of the cloud, None = as measured. edges_of: see FrameSemantics.

    Raises TooFewFeaturesError if the scan is empty.
    """
    points = attributes(cloud, config.thesis, at_image)
    gradient = gradient_edges(prepare(image, config.image), config.thesis)
    edges = blend(gradient, semantic, semantic_share(config.thesis, edges_of))
    focal_length = float(fast.camera.K[0, 0])
    return ThesisFeatures(
        fast,
        points,
        PointLevels.of(points),
        [smoothed(edges, sigma * focal_length / REFERENCE_FOCAL_LENGTH) for sigma in config.thesis.smoothing],
        blurred_levels([edges], focal_length),
    )


def semantic_share(config: ThesisConfig, edges_of: str) -> float:
    """The share of semantic edges of that kind, see FrameSemantics, where they are blended with gradient edges."""
    return CLASS_EDGE_SHARE if edges_of == OF_CLASSES else config.semantic_share
