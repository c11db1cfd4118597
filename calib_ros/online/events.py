"""What the pipeline tells its owner, and what it asks it for."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera
from calib_ros.frame import Frame, PointCloud
from calib_ros.result import Extrinsic, Result


@dataclass(frozen=True, eq=False)
class FrameIngested:
    """A pair was decoded and ingested. image, cloud: its messages."""

    frame: Frame
    is_keyframe: bool
    image: Any
    cloud: Any


@dataclass(frozen=True, eq=False)
class ExtrinsicUpdated:
    """The current extrinsic or its status has changed. stamp: ns, of the newest data it was tested with; 0 before any."""

    extrinsic: Extrinsic
    stamp: int


@dataclass(frozen=True)
class Problem:
    """Something that a person should know, in one line."""

    message: str


@dataclass(frozen=True, eq=False)
class JobDone:
    """A deferred job is done. outcome: what it has returned."""

    outcome: Any


@dataclass(frozen=True)
class IntakeIdle:
    """All pairs so far are worked off."""


Event = FrameIngested | ExtrinsicUpdated | Problem | JobDone | IntakeIdle


def no_vehicle_frames(camera_frame: str, lidar_frame: str) -> dict[str, NDArray[np.float64]]:
    """Where no other frames of the vehicle are known."""
    return {}


@dataclass(frozen=True)
class Inputs:
    """What the pipeline asks its owner for, on worker threads.

    decode: image message, cloud message and camera -> frame. frame_ids: image and cloud message -> names of the camera frame and
    the LiDAR frame. initial: camera, camera frame and LiDAR frame -> extrinsic to start from; None = not known yet, to be asked
    again with the next pair. decode_cloud: cloud message -> its points, for scans whose pair was dropped, and to find when scans
    sweep the view; without it they belong to their stamps at first. vehicle_frames: names of camera frame and LiDAR frame ->
    T_camera_F (4, 4) of other frames F of the vehicle, by name.
    """

    decode: Callable[[Any, Any, Camera], Frame]
    frame_ids: Callable[[Any, Any], tuple[str, str]]
    initial: Callable[[Camera, str, str], Result | None]
    decode_cloud: Callable[[Any], PointCloud] | None = None
    vehicle_frames: Callable[[str, str], Mapping[str, NDArray[np.float64]]] = no_vehicle_frames
