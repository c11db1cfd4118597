"""Extrinsic and intrinsics in rounds: pictures are rectified by the corrected camera, and what is left to correct is estimated.

The last estimate is that of the corrected camera, from the same start, and is accepted or refused like any other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from calib_ros.arrays import Transform
from calib_ros.camera import Camera
from calib_ros.config import CameraConfig, RefineConfig
from calib_ros.intrinsics import CENTRE, FOCAL, IntrinsicEstimate, RefinedCamera, change_between
from calib_ros.registration.acceptance.checks import check_uncertainty
from calib_ros.registration.acceptance.refusal import Refusal, joined
from calib_ros.result import REFUSED, Result

ROUNDS = 3  # at most: after two, changes are those by which pictures differ that are rectified a fraction of a pixel apart


def refined_with_camera(
    first: Result, given: Camera, whole: Callable[[Camera], Result], camera: CameraConfig, limits: RefineConfig | None
) -> Result:
    """The estimate with intrinsics of its own; where it is refused, there are none.

    first: by the given camera. whole: the estimate by another camera, from the same start. limits: to which uncertainty the
    extrinsic has to be known; None = to any.
    """
    found, result = first.refined_camera, first
    if found is None:  # too little is seen to estimate anything
        return first
    for _ in range(ROUNDS):
        result = whole(found.camera)
        left = result.refined_camera
        if left is None or not result.converged or result.covariance is None:
            return replace(result, refined_camera=None)
        if left.settled:
            break
        found = left
    else:
        return replace(result, refined_camera=None)
    refusal = None if limits is None else _uncertain(left, given, camera, limits)
    if refusal is not None:
        return replace(
            result,
            T_camera_lidar=result.T_camera_lidar if result.initial is None else result.initial,
            status=REFUSED,
            reason=joined([str(refusal), result.reason]),
            refusal=refusal.code,
            refusal_figures=refusal.figures,
            optimum=result.T_camera_lidar,
            covariance=None,
            refined_camera=None,
        )
    changes = {name: replace(change, value=change_between(given, found.camera, name)) for name, change in left.changes.items()}
    joint = _about(found.camera, result.T_camera_lidar, left, changes)
    clocks = np.zeros((6, 6)) if result.shared_covariance is None else result.shared_covariance
    extrinsic = joint.covariance[:6, :6]
    return replace(
        result,
        covariance=extrinsic + clocks,
        shared_covariance=clocks + extrinsic - (result.covariance - clocks),
        intrinsics=changes,
        refined_camera=joint,
    )


def _about(camera: Camera, T: Transform, left: RefinedCamera, changes: dict[str, IntrinsicEstimate]) -> RefinedCamera:
    """The joint covariance about the camera and T (4, 4), with the change that is left: a second moment."""
    along, off = left.directions, np.array([change.value for change in left.changes.values()])
    both = np.r_[along @ off, off]
    return RefinedCamera(camera, T, changes, left.covariance + np.outer(both, both))


def _uncertain(left: RefinedCamera, given: Camera, camera: CameraConfig, limits: RefineConfig) -> Refusal | None:
    """Is the extrinsic known well enough, with those intrinsics open that were corrected, but are known less well than usual?
    What usual calibrations leave open is not asked for, as with intrinsics that are given."""
    usual = {FOCAL: camera.focal_sigma, **dict.fromkeys(CENTRE, camera.centre_sigma * given.width)}
    along, lens = left.directions, left.covariance[6:, 6:]
    alone = left.covariance[:6, :6] - along @ lens @ along.T
    worse = np.array([change.observable and change.sigma > usual.get(name, 0.0) for name, change in left.changes.items()])
    open_part = lens * np.outer(worse, worse)
    return check_uncertainty(alone + along @ open_part @ along.T, limits.tolerance_deg, limits.tolerance_m)
