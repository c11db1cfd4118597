"""~/keyframes: small pictures of the keyframes, drawn when somebody asks and on a thread of their own.

Keyframes keep no photo. What they keep, the edge maps and edge points that estimates are made from, shows better what the node
sees: edges of the image, and over them those of the scan.
"""

from __future__ import annotations

import array
import math
import time
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
from calib_ros_msgs.msg import KeyframePicture as PictureMsg
from calib_ros_msgs.srv import GetKeyframes
from numpy.typing import NDArray
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node

from calib_ros import se3
from calib_ros.errors import BadInputError, CalibrationError, TooFewFeaturesError
from calib_ros.extensions import NodeService
from calib_ros.frame import NANOSECONDS
from calib_ros.online.pipeline import Pipeline
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.overlay import PALETTE, depth_levels
from calib_ros.registration.features import FrameFeatures
from calib_ros.ros.conversions import time_message
from calib_ros.ros.diagnostics import Health
from calib_ros.ros.parts import after_answers, done

DEFAULT_WIDTH, LEAST_WIDTH, MOST_WIDTH = 320, 64, 1280  # px
JPEG_QUALITY = 80
WHITE_AT = 6.0  # deviations of an edge map that are drawn white; 0.5 % of its pixels are above
MAX_RANGE = 60.0  # m
NO_KEYFRAME = "no keyframe yet: wait for images and clouds"


class KeyframeServer(NodeService):
    """The service. Its thread begins with the first request; nothing is kept or drawn before."""

    def __init__(self, node: Node, pipeline: Pipeline, health: Health) -> None:
        self._node, self._pipeline, self._health = node, pipeline, health
        self._aside = ThreadPoolExecutor(max_workers=1, thread_name_prefix="calib_gallery")
        # A callback that awaits blocks its group: requests wait for each other, and nothing else for them.
        group = MutuallyExclusiveCallbackGroup()
        self._service = node.create_service(GetKeyframes, "~/keyframes", self._answer, callback_group=group)

    def stop(self) -> None:
        """Wait for an answer under way."""
        self._aside.shutdown(wait=True, cancel_futures=True)

    def destroy(self) -> None:
        """To be called after stop(); answers that are made already are sent before."""
        after_answers(self._node, lambda: self._node.destroy_service(self._service))

    async def _answer(self, request: GetKeyframes.Request, response: GetKeyframes.Response) -> GetKeyframes.Response:
        try:
            drawn = await done(self._node, self._aside.submit(self._draw, request.max_keyframes, request.max_width))
            response.keyframes, response.cpu = drawn.result()
            response.success, response.message = True, f"the newest {len(response.keyframes)} keyframes"
        except CalibrationError as error:
            response.success, response.message = False, str(error)
        except Exception as error:  # it would end the node
            response.success, response.message = False, self._health.unexpected(error)
        return response

    def _draw(self, count: int, width: int) -> tuple[list[PictureMsg], float]:
        started = time.thread_time()
        recalibrator = self._pipeline.recalibrator
        if recalibrator is None:
            raise CalibrationError(NO_KEYFRAME)
        pictures = keyframe_pictures(recalibrator, count, width)
        return pictures, time.thread_time() - started


def keyframe_pictures(recalibrator: Recalibrator, count: int = 0, width: int = 0) -> list[PictureMsg]:
    """Pictures of the newest `count` keyframes (0 = all), newest first, at most `width` px wide (0 = DEFAULT_WIDTH).

    Nothing of the recalibrator changes. 4 ms each at 640 x 192. CalibrationError without keyframes, BadInputError for a width
    beyond LEAST_WIDTH to MOST_WIDTH.
    """
    width = width or DEFAULT_WIDTH
    if not LEAST_WIDTH <= width <= MOST_WIDTH:
        raise BadInputError(f"pictures of keyframes are {LEAST_WIDTH} to {MOST_WIDTH} px wide, not {width}")
    kept = list(recalibrator.snapshot()[0])
    if not kept:
        raise CalibrationError(NO_KEYFRAME)
    T = recalibrator.current.result.T_camera_lidar
    chosen = kept[-count:] if count else kept
    try:
        scores = [float(own) for own in recalibrator.calibrator.objectives.of_edges(chosen, T).frame_scores(T)]
    except TooFewFeaturesError:
        scores = [math.nan] * len(chosen)
    newest = max(features.stamp for features in kept)
    pictures = []
    for features, score in zip(reversed(chosen), reversed(scores), strict=True):
        image, in_view = _draw(features, T, width)
        message = PictureMsg(name=features.name, stamp=time_message(features.stamp), score=score, in_view=in_view)
        message.age, message.edge_points = (newest - features.stamp) / NANOSECONDS, len(features.points)
        message.height, message.width = image.shape[:2]
        jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
        message.data = array.array("B", jpeg.tobytes())
        pictures.append(message)
    return pictures


def _draw(features: FrameFeatures, T: NDArray[np.float64], width: int) -> tuple[NDArray[np.uint8], int]:
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
