"""Features of a frame for the thesis's objective: attributes of the points and edge maps of the image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera
from calib_ros.config import Config
from calib_ros.frame import PointCloud
from calib_ros.image.edges import REFERENCE_FOCAL_LENGTH, EdgeLevel, blurred_levels
from calib_ros.image.enhance import prepare
from calib_ros.registration.classes import OF_CLASSES, OF_MASKS
from calib_ros_thesis.cloud import PointAttributes, attributes
from calib_ros_thesis.config import ThesisConfig, thesis_of
from calib_ros_thesis.image import blend, gradient_edges, smoothed
from calib_ros_thesis.maps import PointLevels

Map = NDArray[np.float32]
CLASS_EDGE_SHARE = 0.1  # of borders of classes, less than of masks: they follow outlines less closely


@dataclass(frozen=True, eq=False)
class ThesisFeatures:
    """What eq. 3.12 keeps of a frame, as `FrameFeatures.own`.

    Attributes
    ----------
    camera : pinhole of the maps.
    points : LiDAR frame, far ones first. map_levels : their levels in the maps.
    image_edges : E^I (h, w) in 0..1, for every smoothing of ``thesis.smoothing``.
    levels : the same edges at the resolutions of the edges' own score, (1, h, w) standardised.
    importance : w_j of eq. 3.16; None where classes are not known, or frames are not weighted.
    """

    camera: Camera
    points: PointAttributes
    map_levels: PointLevels
    image_edges: list[Map]
    levels: list[EdgeLevel]
    importance: float | None = None


def thesis_features(
    cloud: PointCloud,
    image: NDArray[np.uint8],
    camera: Camera,
    config: Config,
    semantic: Map | None = None,
    at_image: Map | None = None,
    edges_of: str = OF_MASKS,
    importance: float | None = None,
) -> ThesisFeatures:
    """Features of a frame. image: rectified (h, w[, 3]) of camera. semantic: edges (h, w) in 0..1 to blend in.
    at_image: (n, 3) deskewed points of the cloud, None = as measured. edges_of: see FrameSemantics. importance: w_j.

    Raises TooFewFeaturesError if the scan is empty.
    """
    thesis = thesis_of(config)
    points = attributes(cloud, thesis, at_image)
    gradient = gradient_edges(prepare(image, config.image), thesis)
    edges = blend(gradient, semantic, semantic_share(thesis, edges_of))
    focal_length = float(camera.K[0, 0])
    return ThesisFeatures(
        camera,
        points,
        PointLevels.of(points),
        [smoothed(edges, sigma * focal_length / REFERENCE_FOCAL_LENGTH) for sigma in thesis.smoothing],
        blurred_levels([edges], focal_length),
        importance,
    )


def semantic_share(config: ThesisConfig, edges_of: str) -> float:
    """The share of semantic edges of that kind, see FrameSemantics, where they are blended with gradient edges."""
    return CLASS_EDGE_SHARE if edges_of == OF_CLASSES else config.semantic_share
