"""The first extrinsic, where nothing but the classes of the scenes tells where the camera looks (thesis 3.5)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import Features
from calib_ros.result import INSUFFICIENT, Result

Progress = Callable[[str, float], None]


def first_extrinsic(
    calibrator: Calibrator, features: Sequence[Features], initial: Result, needed: int, waiting: bool, progress: Progress | None
) -> Result:
    """Estimate from the classes of at least `needed` of the keyframes, or why there is none yet.

    initial: gives the names of the frames, and the extrinsic until there is a better one. waiting: more classes will come.
    """
    known = len(calibrator.views(features))
    if known < needed and waiting:
        reason = f"nothing is known of the extrinsic: waiting for the classes of keyframes, {known} of {needed}"
        return replace(initial, status=INSUFFICIENT, reason=reason, frames_used=0)
    result = calibrator.guess(features, progress=progress)
    if not result.converged:
        result = replace(result, T_camera_lidar=initial.T_camera_lidar)
    return replace(result, camera_frame=initial.camera_frame, lidar_frame=initial.lidar_frame)
