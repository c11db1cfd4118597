"""A look at frames between keyframes: do they still match at the current extrinsic? At a quarter of the cost of a keyframe.

The edges of the part of the scan that is in view are laid over the edges of a small picture at the current extrinsic, and shifted
by some pixels each way. At a right extrinsic nothing matches much better than no shift. How much better something may is learnt
from the looks before: one that is worse than all of them says nothing about the extrinsic, but is worth a test of the monitor.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.arrays import Transform
from calib_ros.camera import Camera
from calib_ros.config import Config
from calib_ros.errors import CalibrationError
from calib_ros.frame import NANOSECONDS, Frame, PointCloud
from calib_ros.image.edges import REFERENCE_FOCAL_LENGTH, blurred_levels, oriented_edges
from calib_ros.lidar.deskew import deskewed_edges
from calib_ros.lidar.edges import UPWARD, edge_points
from calib_ros.lidar.range_image import range_image

EVERY_S = 0.35  # between looks, by the data's stamps: every fourth frame at 10 Hz, for a knock is to be told within a second
KEPT = 50  # looks that tell what is usual: of as many more, one is by chance worse than all of these, in a quarter of a minute
LEAST_KEPT = 10
WIDTH = 320  # px of the small picture: a pixel is a quarter of a degree of usual lenses
BLUR = 1.5  # px; edges that are up to two pixels apart meet
REACH = 12  # px, to which edges are shifted each way: three degrees of usual lenses
DENSE_RINGS = 32  # of scanners with as many rings every second one is enough
BORDER = np.deg2rad(3.0)  # around the field of view, from which edges in it are told
LEAST_EDGES = 50  # in view; fewer tell nothing

Map = NDArray[np.float32]


class Glance:
    """Looks at frames, and tells those that are worth a test. Not thread-safe."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget what is usual."""
        self._losses: deque[float] = deque(maxlen=KEPT)
        self._looked_at: int | None = None  # stamp, ns

    def is_due(self, stamp: int) -> bool:
        """Whether the last look is long enough ago."""
        return self._looked_at is None or not 0 <= (stamp - self._looked_at) / NANOSECONDS < EVERY_S

    def put_off(self, stamp: int) -> None:
        """A keyframe tells more than a look."""
        self._looked_at = stamp

    def strikes(self, frame: Frame, T: Transform, config: Config) -> bool:
        """Look at a frame at T_camera_lidar (4, 4): True if it matches worse than all others that were looked at."""
        self._looked_at = frame.stamp
        try:
            loss = match_loss(frame, T, config)
        except CalibrationError:
            return False  # the frame itself is told elsewhere
        if loss is None:
            return False
        strikes = len(self._losses) >= LEAST_KEPT and loss > max(self._losses)
        self._losses.append(loss)
        return strikes


def match_loss(frame: Frame, T: Transform, config: Config) -> float | None:
    """By how much some shift of the edges of a scan over those of the image matches better than none at T (4, 4), in standard
    deviations over all shifts. None where there are too few edges, or the scan has no rings: its edges take too long."""
    cloud = in_view(frame.cloud, T, frame.camera)
    if len(cloud) < LEAST_EDGES:
        return None
    scan = range_image(cloud, config.lidar)
    if scan.layout != "rings":
        return None
    points = deskewed_edges(edge_points(scan, config.lidar), frame, config.motion)
    pixels, inside = frame.camera.project(se3.transform(T, points.xyz.astype(float)))
    if np.count_nonzero(inside) < LEAST_EDGES:
        return None
    upward, strength = np.isin(points.kind[inside], UPWARD), points.strength[inside]
    maps = small_edges(frame.image, config)
    height, width = maps.shape[1:]
    scale = width / frame.camera.width
    at = np.rint((pixels[inside] + 0.5) * scale - 0.5).astype(int)
    at = np.clip(at, 0, (width - 1, height - 1))
    matches = np.zeros((2 * REACH + 1,) * 2)
    for channel, own in enumerate((~upward, upward)):
        drawn = np.zeros((height, width), np.float32)
        np.add.at(drawn, (at[own, 1], at[own, 0]), strength[own] / max(float(strength[own].sum()), 1e-6))
        around = cv2.copyMakeBorder(maps[channel], *(REACH,) * 4, cv2.BORDER_CONSTANT)
        matches += cv2.matchTemplate(around, drawn, cv2.TM_CCORR)
    spread = float(matches.std())
    return (float(matches.max()) - float(matches[REACH, REACH])) / spread if spread > 0 else None


def in_view(cloud: PointCloud, T: Transform, camera: Camera) -> PointCloud:
    """The part of a cloud that a camera at T (4, 4) sees, and a little around it; of many rings every second one. Without
    intensities: their edges take as long as half of the others, and tell less."""
    along = cloud.xyz @ T[2, :3].astype(np.float32) + np.float32(T[2, 3])
    distance = np.sqrt(np.einsum("ij,ij->i", cloud.xyz, cloud.xyz))
    seen = along > np.float32(np.cos(min(np.deg2rad(camera.field_deg) / 2 + BORDER, np.pi))) * distance
    if cloud.ring is not None and len(cloud) and int(cloud.ring.max()) >= DENSE_RINGS - 1:
        seen &= cloud.ring % 2 == 0
    return replace(cloud, intensity=None, label=None).select(np.flatnonzero(seen))


def small_edges(image: NDArray[np.uint8], config: Config) -> Map:
    """Edges (2, h, w) of an image (H, W[, 3]) at a width of WIDTH, blurred: of horizontal and of vertical gradients."""
    grey = image if image.ndim == 2 else image[:, :, 1]
    width = min(WIDTH, grey.shape[1])
    small = cv2.resize(grey, (width, max(round(grey.shape[0] * width / grey.shape[1]), 1)), interpolation=cv2.INTER_AREA)
    edges = oriented_edges(np.asarray(small, np.uint8), config.image)
    return blurred_levels(edges, REFERENCE_FOCAL_LENGTH, (BLUR,), local_contrast=True)[0].maps
