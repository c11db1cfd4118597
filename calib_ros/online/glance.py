"""A look at frames between keyframes: do they still match at the current extrinsic? At a small part of the cost of a keyframe.

The points in view are drawn into a small picture at the current extrinsic, and the edges of their depth are laid over the edges
of the image, shifted by some pixels each way. At a right extrinsic nothing matches much better than no shift. How much better
something may is learnt from the looks before: one that is worse than all of them says nothing about the extrinsic, but is worth a
test of the monitor. Neither rings nor an order of the points are needed.
"""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.arrays import Transform
from calib_ros.config import Config
from calib_ros.errors import CalibrationError
from calib_ros.frame import Frame
from calib_ros.image.edges import REFERENCE_FOCAL_LENGTH, blurred_levels, oriented_edges
from calib_ros.lidar.deskew import image_times, moved, used_twist
from calib_ros.online.pacing import is_due

# Between looks, s of the data's stamps, for a knock is to be told within a second: at 10 Hz every fourth frame, at rest every
# sixth. Of cameras in step, half as far apart as at rest: then they look at the same scans.
EVERY_S, REST_EVERY_S = 0.35, 0.55
KEPT = 50  # looks that tell what is usual: of as many more, one is by chance worse than all of these, in a quarter of a minute
LEAST_KEPT = 10
WIDTH = 320  # px of the small picture: a pixel is a quarter of a degree of usual lenses
BLUR = 1.5  # px; edges that are up to two pixels apart meet
REACH = 12  # px, to which edges are shifted each way: three degrees of usual lenses
BORDER = np.deg2rad(3.0)  # around the field of view, from which points in it are told
LEAST_POINTS = 50  # in view; fewer tell nothing
GAPS = 75.0  # percentile of the gaps between points, up to which they are closed: those of rings, or of a rosette
MOST_CLOSED = 15  # px
# Of the logarithm of depth: from pixel to pixel, that of the ground changes by less than FLAT from 3 deg below the horizon on.
FLAT, JUMP = 0.08, 0.25  # what is that much more counts as a full edge

Map = NDArray[np.float32]


class Glance:
    """Looks at frames, and tells those that are worth a test. in_step: with others, see `is_due`. struck: one was, and has not
    been tested yet. Not thread-safe."""

    def __init__(self, in_step: bool = False) -> None:
        self._in_step = in_step
        self.reset()

    def reset(self) -> None:
        """Forget what is usual."""
        self._losses: deque[float] = deque(maxlen=KEPT)
        self._looked_at: int | None = None  # stamp, ns
        self.struck = False

    def is_due(self, stamp: int, at_rest: bool = False) -> bool:
        """Whether the last look is long enough ago."""
        every_s = REST_EVERY_S if at_rest else REST_EVERY_S / 2 if self._in_step else EVERY_S
        return is_due(self._looked_at, stamp, every_s, self._in_step)

    def put_off(self, stamp: int) -> None:
        """A keyframe tells more than a look."""
        self._looked_at = stamp

    def strikes(self, frame: Frame, T: Transform, config: Config) -> bool:
        """Look at a frame at T_camera_lidar (4, 4): True if it matches worse than all others that were looked at."""
        try:
            loss = match_loss(frame, T, config)
        except CalibrationError:
            return False  # the frame itself is told elsewhere
        if loss is None:
            return False
        self.struck = len(self._losses) >= LEAST_KEPT and loss > max(self._losses)
        self._losses.append(loss)
        return self.struck


def match_loss(frame: Frame, T: Transform, config: Config) -> float | None:
    """By how much some shift of the edges of a scan over those of the image matches better than none at T (4, 4), in standard
    deviations over all shifts. None where there are too few points in view, or no edges."""
    nearness = nearness_picture(frame, T, config)
    if np.count_nonzero(nearness) < LEAST_POINTS:
        return None
    matches = np.zeros((2 * REACH + 1,) * 2)
    for of_image, of_scan in zip(image_edges(frame.image, config), depth_edges(nearness), strict=True):
        if (total := float(of_scan.sum())) > 0:
            around = cv2.copyMakeBorder(of_image, *(REACH,) * 4, cv2.BORDER_CONSTANT)
            matches += cv2.matchTemplate(around, of_scan, cv2.TM_CCORR) / total
    spread = float(matches.std())
    return (float(matches.max()) - float(matches[REACH, REACH])) / spread if spread > 0 else None


def nearness_picture(frame: Frame, T: Transform, config: Config) -> Map:
    """Inverse distance (h, WIDTH), 1/m, of the nearest point in every pixel of a small picture at T (4, 4); 0 = none."""
    camera, xyz = frame.camera, frame.cloud.xyz
    width = min(WIDTH, camera.width)
    scale = width / camera.width
    height = max(round(camera.height * scale), 1)
    # Of what the camera sees, or nearly so, from lidar.min_range on. Lost returns are not among them.
    centre = (-T[:3, :3].T @ T[:3, 3]).astype(np.float32)
    z = xyz @ T[2, :3].astype(np.float32) + np.float32(T[2, 3])
    square = (xyz * xyz) @ np.ones(3, np.float32)
    distance = np.sqrt(np.maximum(square - 2 * (xyz @ centre) + centre @ centre, 0))  # from the camera
    least = np.float32(np.cos(min(np.deg2rad(camera.field_deg) / 2 + BORDER, np.pi)))
    seen = np.flatnonzero((z > least * distance) & (square >= config.lidar.min_range**2))
    points = xyz[seen].astype(float)
    if (twist := used_twist(frame, config.motion)) is not None:
        time = None if frame.cloud.time is None else frame.cloud.time[seen]
        points = moved(points, twist, image_times(frame, points, time, config.motion))
    points = se3.transform(T, points)
    pixels, inside = camera.project(points)
    column, row = np.minimum(((pixels[inside] + 0.5) * scale).astype(np.intp), (width - 1, height - 1)).T
    picture = np.zeros(height * width, np.float32)
    np.maximum.at(picture, row * width + column, (1 / np.linalg.norm(points[inside], axis=1)).astype(np.float32))
    return picture.reshape(height, width)


def depth_edges(nearness: Map) -> tuple[Map, Map]:
    """Edges of depth, two (h, w) in 0..1, from inverse distances (h, w): across and down, on the nearer side of each jump."""
    gaps = usual_gap(nearness.T), usual_gap(nearness)
    kernel = np.ones([min(max(gap | 1, 3), MOST_CLOSED) for gap in gaps], np.uint8)
    level = cv2.morphologyEx(nearness, cv2.MORPH_CLOSE, kernel)
    np.log(level, out=level, where=level > 0)
    across, down = np.zeros_like(level), np.zeros_like(level)
    _mark_jumps(level, FLAT, across)
    if gaps[0] <= 2 * BLUR:  # rings farther apart do not tell where between them an edge lies
        _mark_jumps(level.T, FLAT * gaps[0], down.T)
    return across, down


def _mark_jumps(level: Map, flat: float, edges: Map) -> None:
    """Along the rows of logarithms (h, w), where 0 is unknown: those beyond `flat`, into edges (h, w)."""
    jump = np.where((level[:, 1:] != 0) & (level[:, :-1] != 0), np.diff(level), 0)
    strength = np.clip((np.abs(jump) - flat) / JUMP, 0, 1)
    edges[:, 1:] = np.where(jump > 0, strength, 0)
    np.maximum(edges[:, :-1], np.where(jump < 0, strength, 0), out=edges[:, :-1])


def usual_gap(picture: Map) -> int:
    """How far apart, px, drawn pixels of the same row usually are at most."""
    row, column = np.nonzero(picture)
    gaps = np.diff(column)[np.diff(row) == 0]
    return int(np.percentile(gaps, GAPS)) if len(gaps) else 1


def image_edges(image: NDArray[np.uint8], config: Config) -> Map:
    """Edges (2, h, w) of an image (H, W[, 3]) at a width of WIDTH, blurred: of horizontal and of vertical gradients."""
    height, width = image.shape[:2]
    step = max(width // (2 * WIDTH), 1)  # two samples a pixel are enough
    grey = np.ascontiguousarray(image[::step, ::step] if image.ndim == 2 else image[::step, ::step, 1])
    own = min(WIDTH, width)
    small = cv2.resize(grey, (own, max(round(height * own / width), 1)), interpolation=cv2.INTER_AREA)
    edges = oriented_edges(np.asarray(small, np.uint8))
    return blurred_levels(edges, REFERENCE_FOCAL_LENGTH, (BLUR,), local_contrast=True)[0].maps
