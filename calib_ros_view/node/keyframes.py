"""~/keyframes: small pictures of the keyframes, drawn when somebody asks and on a thread of their own."""

from __future__ import annotations

import array
import time
from concurrent.futures import ThreadPoolExecutor

from calib_ros_msgs.msg import KeyframePicture as PictureMsg
from calib_ros_msgs.srv import GetKeyframes
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node

from calib_ros.errors import CalibrationError
from calib_ros.extensions import NodeService
from calib_ros.online.pipeline import Pipeline
from calib_ros.ros.answers import after_answers, done
from calib_ros.ros.conversions import time_message
from calib_ros.ros.diagnostics import Health
from calib_ros_view.node.gallery import NO_KEYFRAME, KeyframePicture, keyframe_pictures

Answer = tuple[list[KeyframePicture], float]


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
            pictures, response.cpu = drawn.result()
            response.keyframes = [picture_message(picture) for picture in pictures]
            response.success, response.message = True, f"the newest {len(pictures)} keyframes"
        except CalibrationError as error:
            response.success, response.message = False, str(error)
        except Exception as error:  # it would end the node
            response.success, response.message = False, self._health.unexpected(error)
        return response

    def _draw(self, count: int, width: int) -> Answer:
        started = time.thread_time()
        recalibrator = self._pipeline.recalibrator
        if recalibrator is None:
            raise CalibrationError(NO_KEYFRAME)
        pictures = keyframe_pictures(recalibrator, count, width)
        return pictures, time.thread_time() - started


def picture_message(picture: KeyframePicture) -> PictureMsg:
    """KeyframePicture -> calib_ros_msgs/KeyframePicture."""
    height, width = picture.image.shape[:2]
    message = PictureMsg(name=picture.name, age=picture.age_s, score=picture.score, width=width, height=height)
    message.stamp, message.edge_points, message.in_view = time_message(picture.stamp), picture.edge_points, picture.in_view
    message.data = array.array("B", picture.jpeg())
    return message
