"""Classes of points and pixels: what the core asks of a package that recognises some, and works without.

A package joins by the entry point ``calib_ros.classes``, see extensions.py; the built-in one is calib_ros_semantics.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from calib_ros import extensions
from calib_ros.arrays import Transform
from calib_ros.camera import Camera
from calib_ros.config import SemanticsConfig
from calib_ros.frame import Frame, PointCloud
from calib_ros.frame import SemanticClass as C
from calib_ros.registration.score.point_score import PointScore

OF_MASKS, OF_CLASSES = "masks", "classes"  # what semantic edges are the boundaries of
MASKS, IMAGE, CLOUD = "segment_anything", "image_classes", "cloud_classes"  # kinds of models, by their parameters
ALL, CLASSES = (MASKS, IMAGE, CLOUD), (IMAGE, CLOUD)
LIGHT_CLASSES, LIGHT_WEIGHT = (C.VEGETATION, C.GROUND), 0.5  # leaves and kerbs are less exact; all other classes weigh 1
EDGE_SHARE = 0.5  # of the edges of Segment Anything's masks in the edge maps of the fast score; the rest are gradients


@dataclass(frozen=True, eq=False)
class FrameSemantics:
    """Semantics of a frame at the size of the recorded image; None = unknown.

    edges: (2, H, W) float32 in 0..1, semantic edges with horizontal [0] and vertical [1] gradients; their sum is the strength.
    classes: (H, W) uint8, SemanticClass of the pixels. labels: (n,) uint8, of the points. problems: a line per model that failed.
    seconds: (kind of model, time taken). edges_of: OF_MASKS or OF_CLASSES, what the edges are the boundaries of.
    """

    edges: NDArray[np.float32] | None = None
    classes: NDArray[np.uint8] | None = None
    labels: NDArray[np.uint8] | None = None
    problems: tuple[str, ...] = ()
    seconds: tuple[tuple[str, float], ...] = ()
    edges_of: str = OF_MASKS


@dataclass(frozen=True, eq=False)
class PoseHypothesis:
    """A guess of T_camera_lidar (4, 4). score: comparable within one source; 0 = as good as chance. margin: by how much it beats
    the next hypothesis of another viewing direction. kind: its source. inliers: objects of the images that meet one in the cloud.
    """

    T: Transform
    score: float
    margin: float
    kind: str
    inliers: int


class Segmentation(Protocol):
    """The configured models together: a frame in, its semantics out. Loaded on first use, or by `load`."""

    config: SemanticsConfig

    @property
    def active(self) -> bool:
        """Whether any model is configured and not switched off."""

    def in_use(self) -> list[str]:
        """A text per model that is not switched off."""

    def missing(self, *kinds: str) -> str:
        """Which of the kinds is not configured or off, and what to do; empty if all of them work."""

    def load(self) -> list[str]:
        """Load all models now; a line per model that runs otherwise than configured."""

    def describe(self) -> list[str]:
        """What is off and what is in use, for people; empty where no models are configured."""

    def __call__(
        self,
        frame: Frame,
        cancelled: Callable[[], bool] = ...,
        kinds: Sequence[str] = ...,
        points: NDArray[np.intp] | None = None,
    ) -> FrameSemantics:
        """Semantics of a frame, with errors in its problems. cancelled: polled, True to stop. kinds: of the models to run.
        points: indices of the points whose classes are asked for, None = all."""


class ClassModels(Protocol):
    """What a package of models brings. A view is what it keeps of a frame's classes, small enough for every keyframe, with
    ``xyz`` (m, 3) float32 m in the LiDAR frame."""

    def segmentation(self, config: SemanticsConfig) -> Segmentation:
        """The models of a configuration."""

    def view(self, cloud: PointCloud, classes: NDArray[np.uint8], camera: Camera) -> Any:
        """Of a labelled cloud and the classes (h, w) of a rectified image of `camera`, a pinhole."""

    def consistency(self, views: Sequence[Any]) -> PointScore | None:
        """How well labelled points meet pixels of their class; None where the frames show too little in common."""

    def first_guess(self, views: Sequence[Any], seed: int, sweep: bool) -> list[PoseHypothesis]:
        """Hypotheses of the extrinsic, best first (thesis 3.5); sweep: not by centroids alone. TooFewFeaturesError if too few."""


class _NoModels:
    """A segmentation without models: nothing is ever known."""

    def __init__(self, config: SemanticsConfig) -> None:
        self.config = config

    active = False

    def in_use(self) -> list[str]:
        return []

    load = describe = in_use

    def missing(self, *kinds: str) -> str:
        return "no package that recognises classes is installed, which a first guess from classes needs; set initial.method"

    def __call__(self, frame: Frame, *_: Any, **__: Any) -> FrameSemantics:
        return FrameSemantics()


def class_models() -> ClassModels | None:
    """Of the package that is installed; None without one."""
    names = extensions.names(extensions.CLASSES)
    models: ClassModels | None = extensions.load(extensions.CLASSES, names[0]) if names else None
    return models


def segmentation(config: SemanticsConfig) -> Segmentation:
    """The models of a configuration; none where no package brings any."""
    models = class_models()
    return _NoModels(config) if models is None else models.segmentation(config)


def consistency_score(views: Sequence[Any]) -> PointScore | None:
    """See ClassModels; None without views, or without a package that made some."""
    models = class_models()
    return models.consistency(views) if views and models is not None else None


def edge_weights(label: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Classes of edge points (n,) -> their weights (n,) in the score (thesis 3.6)."""
    table = np.ones(256, np.float32)
    table[list(LIGHT_CLASSES)] = LIGHT_WEIGHT
    return np.asarray(table[label])
