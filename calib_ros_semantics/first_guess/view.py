"""What is kept of a frame for the first guess: its classes, small enough to be kept for every keyframe."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera
from calib_ros.errors import BadInputError
from calib_ros.frame import MAIN_CLASSES, UNLABELLED, PointCloud, SemanticClass

MAX_WIDTH = 640  # px; a pixel of a wide camera is then 0.15 deg, a tenth of what the guess has to find
CELL_DEG = 0.4  # points of one direction are one: as wide as the gaps between the rings of 64
MIN_RANGE, MAX_RANGE = 2.0, 80.0  # m; nearer is the vehicle itself, and farther hardly any network tells classes apart
# Points kept per class. Objects need some points each; what fills the view does not get clearer by more.
MAX_OBJECT_POINTS, MAX_SURFACE_POINTS = 1200, 600
# OTHER is left out: what it means differs from one source of classes to the next.
MATCHED = (*MAIN_CLASSES, SemanticClass.BUILDING, SemanticClass.VEGETATION, SemanticClass.GROUND)


@dataclass(frozen=True, eq=False)
class ClassView:
    """Classes of one frame.

    camera: pinhole at full size. classes: (camera.height // scale, camera.width // scale) uint8 SemanticClass, UNLABELLED where
    unknown, every scale-th pixel of the rectified image. xyz: (m, 3) float32 m, LiDAR frame, the nearest surface in every
    direction. label: (m,) uint8, one of MATCHED. At most 0.3 MB.
    """

    camera: Camera
    classes: NDArray[np.uint8]
    xyz: NDArray[np.float32]
    label: NDArray[np.uint8]
    scale: int = 1

    @property
    def matched(self) -> set[int]:
        """Those of MATCHED that both the image and the cloud show."""
        return {int(c) for c in np.intersect1d(self.classes, self.label)}


def class_view(cloud: PointCloud, classes: NDArray[np.uint8], camera: Camera) -> ClassView:
    """View of a labelled cloud and of the classes (h, w) of a rectified image of `camera`.

    BadInputError for a cloud without labels, a camera that is no pinhole, or an image of another size.
    """
    if cloud.label is None:
        raise BadInputError("a first guess needs a class for every point; this cloud has none: set semantics.cloud_classes")
    if not camera.is_pinhole or classes.shape != (camera.height, camera.width):
        raise BadInputError(
            f"a first guess needs the classes of a rectified image of {camera.width}x{camera.height}; "
            f"got {classes.shape[1]}x{classes.shape[0]}, {camera.model if len(camera.D) else 'no'} distortion"
        )
    scale = 1
    while camera.width > MAX_WIDTH * scale:
        scale *= 2
    height, width = camera.height // scale, camera.width // scale
    small = classes[scale // 2 :: scale, scale // 2 :: scale][:height, :width].copy()
    # Of the points the nearest of every direction are kept, if they are of a class that is matched.
    with np.errstate(invalid="ignore", over="ignore"):  # a broken scan holds any number; what overflows is far away
        distance = np.linalg.norm(cloud.xyz, axis=1)
        known = np.flatnonzero((distance >= MIN_RANGE) & (distance <= MAX_RANGE) & (cloud.label != UNLABELLED))
    p, r = cloud.xyz[known], distance[known]
    row = np.floor(np.rad2deg(np.arcsin(p[:, 2] / r)) / CELL_DEG).astype(np.int64)
    column = np.floor(np.rad2deg(np.arctan2(p[:, 1], p[:, 0])) / CELL_DEG).astype(np.int64)
    nearest_first = np.argsort(r, kind="stable")
    _, first = np.unique((row * 10_000 + column)[nearest_first], return_index=True)
    nearest = known[nearest_first[first]]
    rng, kept = np.random.default_rng(0), []
    for c in MATCHED:
        own = nearest[cloud.label[nearest] == c]
        most = MAX_OBJECT_POINTS if c in MAIN_CLASSES else MAX_SURFACE_POINTS
        kept.append(own if len(own) <= most else np.sort(rng.choice(own, most, replace=False)))
    keep = np.concatenate(kept)
    return ClassView(camera, small, cloud.xyz[keep], cloud.label[keep], scale)
