"""Rolling shutter: rows of an image are exposed one after the other, each while the vehicle is somewhere else.

A static point is seen by the row that it is projected to, t seconds after the middle row: the LiDAR is at exp(twist t) by then,
and the point at exp(-twist t) p in its frame. Which row that is depends on the extrinsic, but weakly: a degree is a few per cent
of the rows, so that the extrinsic of the start tells it well enough for a search, and its result for the final optimum.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.arrays import Matrix, Transform
from calib_ros.camera import Camera
from calib_ros.config import MotionConfig
from calib_ros.lidar.deskew import moved
from calib_ros.registration.features import FrameFeatures


def row_times(xyz: NDArray[np.floating], T: Transform, camera: Camera, readout_s: float) -> Matrix:
    """When the rows of the recorded image are exposed that points (n, 3) m are projected to at T_camera_lidar (4, 4): (n,) s
    after the middle row. Points beside the image count as on its border, those behind it as in its middle."""
    row = camera.project(se3.transform(T, xyz))[0][:, 1]
    share = (np.clip(row, 0, camera.height - 1) + 0.5) / camera.height - 0.5
    return np.asarray(np.nan_to_num(share) * readout_s)


def seen_by_rows(features: Sequence[FrameFeatures], T: Transform, camera: Camera, config: MotionConfig) -> list[FrameFeatures]:
    """Features whose points are where the rows of the image see them at T_camera_lidar (4, 4); the same where the shutter is
    global, the LiDAR's velocity is not known, or another objective keeps points of its own. camera: of the recorded images."""
    if not config.readout_s:
        return list(features)
    return [_seen_by_rows(f, T, camera, config.readout_s) for f in features]


def _seen_by_rows(features: FrameFeatures, T: Transform, camera: Camera, readout_s: float) -> FrameFeatures:
    if features.twist is None or features.own is not None:
        return features
    points = features.points
    time = row_times(points.xyz, T, camera, readout_s)
    return replace(features, points=replace(points, xyz=moved(points.xyz, features.twist, -time).astype(np.float32)))
