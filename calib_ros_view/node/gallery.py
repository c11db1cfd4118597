"""Small pictures of the keyframes, drawn when somebody asks: edges of the image, and over them those of the scan.

Keyframes keep no photo. What they keep, the edge maps and edge points that estimates are made from, shows better what the node
sees.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.errors import BadInputError, CalibrationError, TooFewFeaturesError
from calib_ros.frame import NANOSECONDS
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.overlay import PALETTE, depth_levels
from calib_ros.registration.features import FrameFeatures

DEFAULT_WIDTH, LEAST_WIDTH, MOST_WIDTH = 320, 64, 1280  # px
JPEG_QUALITY = 80
WHITE_AT = 6.0  # deviations of an edge map that are drawn white; 0.5 % of its pixels are above
MAX_RANGE = 60.0  # m
NO_KEYFRAME = "no keyframe yet: wait for images and clouds"

Picture = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class KeyframePicture:
    """A keyframe as others see it.

    image: (h, w, 3) BGR. stamp: ns. age_s: behind the newest keyframe. score: of this keyframe alone, NaN if it shows too little.
    edge_points: of the scan. in_view: those of them that are in the picture.
    """

    name: str
    stamp: int
    age_s: float
    score: float
    edge_points: int
    in_view: int
    image: Picture

    def jpeg(self) -> bytes:
        """The image, compressed."""
        return bytes(cv2.imencode(".jpg", self.image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes())


def keyframe_pictures(recalibrator: Recalibrator, count: int = 0, width: int = 0) -> list[KeyframePicture]:
    """Pictures of the newest `count` keyframes (0 = all), newest first, at most `width` px wide (0 = DEFAULT_WIDTH).

    Nothing of the recalibrator changes. 4 ms each at 640 x 192.
    CalibrationError without keyframes, BadInputError for a width beyond
    LEAST_WIDTH to MOST_WIDTH.
    """
    width = width or DEFAULT_WIDTH
    if not LEAST_WIDTH <= width <= MOST_WIDTH:
        raise BadInputError(f"pictures of keyframes are {LEAST_WIDTH} to {MOST_WIDTH} px wide, not {width}")
    kept = list(recalibrator.evidence()[0])
    if not kept:
        raise CalibrationError(NO_KEYFRAME)
    T = recalibrator.current.result.T_camera_lidar
    chosen = kept[-count:] if count else kept
    scores = _scores(recalibrator, chosen, T)
    newest = max(features.stamp for features in kept)
    pictures = []
    for features, score in zip(reversed(chosen), reversed(scores), strict=True):
        image, in_view = _draw(features, T, width)
        age = (newest - features.stamp) / NANOSECONDS
        pictures.append(KeyframePicture(features.name, features.stamp, age, score, len(features.points), in_view, image))
    return pictures


def _scores(recalibrator: Recalibrator, kept: list[FrameFeatures], T: NDArray[np.float64]) -> list[float]:
    try:
        return [float(score) for score in recalibrator.calibrator.objectives.of_edges(kept, T).frame_scores(T)]
    except TooFewFeaturesError:
        return [math.nan] * len(kept)


def _draw(features: FrameFeatures, T: NDArray[np.float64], width: int) -> tuple[Picture, int]:
    """The picture (h, w, 3) BGR, and how many edge points are in it."""
    camera = features.camera
    scale = min(width / camera.width, 1.0)
    size = max(round(camera.width * scale), 1), max(round(camera.height * scale), 1)
    finest = min(features.levels, key=lambda level: level.scale)
    strength = np.abs(finest.maps[:2]).max(axis=0)
    grey = np.asarray(np.clip(strength * (255 / WHITE_AT), 0, 255), np.uint8)
    image = np.asarray(cv2.cvtColor(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), cv2.COLOR_GRAY2BGR), np.uint8)
    points = se3.transform(T, features.points.xyz)
    uv, inside = camera.project(points)
    depth = points[inside, 2]
    order = np.argsort(-depth, kind="stable")  # the nearest are drawn last
    colours = PALETTE[depth_levels(depth[order], MAX_RANGE)]
    x, y = np.minimum((uv[inside][order] * scale).astype(np.intp), np.array(size) - 1).T
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        image[np.minimum(y + dy, size[1] - 1), np.minimum(x + dx, size[0] - 1)] = colours
    return image, int(np.count_nonzero(inside))
