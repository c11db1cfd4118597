"""What may be wrong with a recording: changes of its frames that keep their scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.frame import NANOSECONDS, Frame

Matrix = NDArray[np.float64]


def with_intrinsics(frame: Frame, focal: float = 0.0, centre_px: Sequence[float] = (0.0, 0.0)) -> Frame:
    """The same picture with a CameraInfo that is wrong. focal: share of the focal length."""
    K = frame.camera.K.copy()
    K[[0, 1], [0, 1]] *= 1 + focal
    K[:2, 2] += centre_px
    camera: Camera = replace(frame.camera, K=K)
    return replace(frame, camera=camera)


def late(frame: Frame, seconds: float) -> Frame:
    """An image stamped late against the scan."""
    return replace(frame, cloud_stamp=frame.moment_of_cloud, stamp=frame.stamp + round(seconds * NANOSECONDS))


def in_other_frame(frame: Frame, T_other_cloud: Matrix) -> Frame:
    """The cloud, the twist and the extrinsic in another frame."""
    xyz = se3.transform(T_other_cloud, frame.cloud.xyz).astype(np.float32)
    twist = None if frame.twist is None else se3.adjoint(T_other_cloud) @ frame.twist
    reference = None if frame.reference is None else frame.reference @ se3.inverse(T_other_cloud)
    return replace(frame, cloud=replace(frame.cloud, xyz=xyz), twist=twist, reference=reference)


def turned(axis: Sequence[float], deg: float, shift: Sequence[float] = (0, 0, 0)) -> Matrix:
    """A transform (4, 4)."""
    T = se3.exp(np.concatenate([np.deg2rad(deg) * np.asarray(axis, float), np.zeros(3)]))
    T[:3, 3] = shift
    return T
