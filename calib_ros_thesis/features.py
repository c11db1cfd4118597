"""Features of a frame for the thesis's objective: attributes of the points and edge maps of the image."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera
from calib_ros.config import Config
from calib_ros.frame import MAIN_CLASSES, UNLABELLED, PointCloud
from calib_ros.image.edges import REFERENCE_FOCAL_LENGTH, EdgeLevel, blurred_levels
from calib_ros.image.enhance import prepare
from calib_ros.lidar.range_image import require_returns
from calib_ros.registration.classes import OF_CLASSES, OF_MASKS
from calib_ros_thesis.cloud import PointAttributes, attributes
from calib_ros_thesis.config import ThesisConfig, thesis_of
from calib_ros_thesis.image import blend, gradient_edges, smoothed
from calib_ros_thesis.maps import PointLevels

Map = NDArray[np.float32]
CLASS_EDGE_SHARE = 0.1  # of borders of classes, less than of masks: they follow outlines less closely
FEW_FRAMES_SHARE = 0.05  # added to the share of main classes, so that frames without any keep a part of their weight


V = TypeVar("V")


class Later(Generic[V]):
    """A value that is made when it is first asked for, by whichever thread needs it; what it is made of is kept until then."""

    def __init__(self, make: Callable[[], V]) -> None:
        self._make: Callable[[], V] | None = make

    def __call__(self) -> V:
        make = self._make
        if make is not None:  # two threads at once make the same value
            self._value, self._make = make(), None
        return self._value


@dataclass(frozen=True, eq=False)
class ImageEdges:
    """E^I (h, w) in 0..1, for every smoothing. levels: these at the resolutions of the edges' own score, (1, h, w)
    standardised."""

    smoothed: list[Map]
    levels: list[EdgeLevel]


@dataclass(frozen=True, eq=False)
class ThesisFeatures:
    """What eq. 3.12 keeps of a frame, as `FrameFeatures.own`. Points and edges are made when an estimate asks for them: they take
    longer than all else that is done with a keyframe, and many a keyframe's are replaced by those with semantic edges.

    camera: pinhole of the maps. scan: points in the LiDAR frame, far ones first, and their levels in the maps. edges: of the
    image. importance: w_j of eq. 3.16; None where classes are not known, or frames are not weighted. blended: what semantic edges
    in E^I are the boundaries of, see FrameSemantics; "" = there are none.
    """

    camera: Camera
    scan: Later[tuple[PointAttributes, PointLevels]]
    edges: Later[ImageEdges]
    importance: float | None = None
    blended: str = ""

    @property
    def points(self) -> PointAttributes:
        return self.scan()[0]

    @property
    def map_levels(self) -> PointLevels:
        return self.scan()[1]

    @property
    def image_edges(self) -> list[Map]:
        return self.edges().smoothed

    @property
    def levels(self) -> list[EdgeLevel]:
        return self.edges().levels


def thesis_features(
    cloud: PointCloud,
    image: NDArray[np.uint8],
    camera: Camera,
    config: Config,
    semantic: Map | None = None,
    at_image: Map | None = None,
    edges_of: str = OF_MASKS,
    importance: float | None = None,
    plain: ThesisFeatures | None = None,
) -> ThesisFeatures:
    """Features of a frame. TooFewFeaturesError if the scan is empty.

    image: rectified (h, w[, 3]) of camera. semantic: edges (h, w) in 0..1 to blend in. at_image: (n, 3) deskewed points of the
    cloud, None = as measured. edges_of: see FrameSemantics. importance: w_j. plain: features of the same frame, whose points are
    taken over.
    """
    require_returns(cloud)
    thesis = thesis_of(config)

    def scan() -> tuple[PointAttributes, PointLevels]:
        points = attributes(cloud, thesis, at_image)
        return points, PointLevels.of(points)

    def image_edges() -> ImageEdges:
        gradient = gradient_edges(prepare(image), thesis)
        edges = blend(gradient, semantic, semantic_share(thesis, edges_of))
        focal_length = float(camera.K[0, 0])
        levels = [smoothed(edges, sigma * focal_length / REFERENCE_FOCAL_LENGTH) for sigma in thesis.smoothing]
        return ImageEdges(levels, blurred_levels([edges], focal_length))

    return ThesisFeatures(
        camera,
        Later(scan) if plain is None else plain.scan,
        Later(image_edges),
        importance,
        "" if semantic is None else edges_of,
    )


def semantic_share(config: ThesisConfig, edges_of: str) -> float:
    """The share of semantic edges of that kind, see FrameSemantics, where they are blended with gradient edges."""
    return CLASS_EDGE_SHARE if edges_of == OF_CLASSES else config.semantic_share


def importance(classes: NDArray[np.uint8]) -> float | None:
    """w_j of eq. 3.16: the share of the main classes among the pixels (H, W) whose class is known; None if none is."""
    count = np.bincount(classes.ravel(), minlength=256)
    known = count.sum() - count[UNLABELLED]
    return None if known == 0 else float(count[list(MAIN_CLASSES)].sum() / known)


def frame_weights(shares: Sequence[float | None]) -> NDArray[np.float64]:
    """w_j of several frames (n,), of mean 1. One whose classes are not known, as they come later than the frame, weighs 1."""
    known = np.array([s for s in shares if s is not None])
    if not len(known):
        return np.ones(len(shares))
    mean = float(known.mean()) + FEW_FRAMES_SHARE
    return np.array([1.0 if s is None else (s + FEW_FRAMES_SHARE) / mean for s in shares])
