"""Extrinsics of cameras that stand upright near the LiDAR: the nominal one, and what a first guess may be."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.arrays import Matrix, Transform
from calib_ros.registration.search.constraints import Limits
from calib_ros.result import INITIAL, InitialSource, Result

# Instead of an extrinsic: to be found from the classes of points and pixels, the motion in consecutive frames, or either.
SEMANTIC, CENTROIDS, MOTION, AUTO = "semantic", "centroids", "motion", "auto"
BY_CLASSES = (SEMANTIC, CENTROIDS)
GUESSES = (*BY_CLASSES, MOTION, AUTO)
# Where classes look for the camera, which vehicles carry near the LiDAR and level; a wider search finds more optima of chance.
MAX_TILT_DEG, MAX_DISTANCE_M = 25.0, 2.0  # between the verticals of camera and LiDAR, and between the two


def nominal(yaw_deg: float = 0.0) -> Transform:
    """T_camera_lidar (4, 4) of a camera at the LiDAR that looks along the LiDAR's +x axis, turned left by yaw_deg."""
    turn = se3.rotation_from_euler(np.deg2rad(-yaw_deg), 0, 0)
    return se3.from_parts(se3.OPTICAL_FROM_BODY @ turn, np.zeros(3))


def nominal_start(yaw_deg: float = 0.0) -> Result:
    """The nominal extrinsic as an initial one, where no saved state, parameters or TF gave another."""
    reason = "nominal: no saved state, parameters or TF gave one"
    return Result(nominal(yaw_deg), INITIAL, reason, origin=InitialSource.NOMINAL)


def poses(yaw: Matrix, pitch: Matrix, roll: Matrix, centre: Matrix) -> Matrix:
    """T_camera_lidar (k, 4, 4) of cameras at centre (k, 3) m in the LiDAR frame that look along its +x axis, turned left by yaw,
    then up by pitch, then clockwise by roll; (k,) rad each."""
    X, Z = np.eye(6)[[0, 2]]
    rolled, pitched, turned = (
        se3.exp_many(np.multiply.outer(-a, axis))[:, :3, :3] for a, axis in ((roll, Z), (pitch, X), (yaw, Z))
    )
    R = rolled @ pitched @ nominal()[:3, :3] @ turned
    T = np.tile(np.eye(4), (len(R), 1, 1))
    T[:, :3, :3] = R
    T[:, :3, 3] = -np.einsum("kij,kj->ki", R, centre)
    return T


def allowed(transforms: Matrix) -> NDArray[np.bool_]:
    """Which of the extrinsics (k, 4, 4) are as upright as MAX_TILT_DEG and as near as MAX_DISTANCE_M."""
    down = -transforms[:, 1, 2]  # of the camera's y axis, along the LiDAR's -z
    distance = np.linalg.norm(transforms[:, :3, 3], axis=1)
    return np.asarray((down >= np.cos(np.deg2rad(MAX_TILT_DEG))) & (distance <= MAX_DISTANCE_M))


def near_lidar(T: Transform) -> Limits:
    """Limits for an optimisation from T (4, 4) that keep the camera at the LiDAR: free to turn, not to go away."""
    half = np.array([np.inf] * 3 + [MAX_DISTANCE_M] * 3)
    return Limits(se3.from_parts(T[:3, :3], np.zeros(3)), half)


def rotation_distance_deg(transforms: Matrix, T: Transform) -> Matrix:
    """Angles (k,) in deg between the rotations of (k, 4, 4) and of T (4, 4)."""
    trace = np.einsum("kij,ij->k", transforms[:, :3, :3], T[:3, :3])
    return np.asarray(np.rad2deg(np.arccos(np.clip((trace - 1) / 2, -1, 1))))
