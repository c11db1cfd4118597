"""What joins the pipeline to the world: ROS in the node, plain functions in tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from calib_ros.camera import Camera
from calib_ros.frame import Frame
from calib_ros.online.extrinsic import Extrinsic
from calib_ros.result import Result


def _nothing(image: Any, cloud: Any) -> None:
    return


@dataclass(frozen=True)
class Hooks:
    """What the pipeline asks of, and tells, its owner, on worker threads; after reset() on the thread that called it.

    decode: image and cloud message and camera -> frame. frame_ids: image and cloud message -> (camera frame, LiDAR frame).
    initial: camera, camera frame, LiDAR frame -> extrinsic to start from, None = not known yet, ask again with the next pair.
    on_extrinsic: a new state of the extrinsic and the stamp of the newest data in it. on_frame: a frame, and whether it
    became a keyframe. on_error: one line for a person. on_keyframe: image and cloud message of a new keyframe.
    """

    decode: Callable[[Any, Any, Camera], Frame]
    frame_ids: Callable[[Any, Any], tuple[str, str]]
    initial: Callable[[Camera, str, str], Result | None]
    on_extrinsic: Callable[[Extrinsic, int], None]
    on_frame: Callable[[Frame, bool], None]
    on_error: Callable[[str], None]
    on_keyframe: Callable[[Any, Any], None] = _nothing
