"""The first extrinsic, where nothing but the classes of the scenes tells where the camera looks (thesis 3.5)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import Features
from calib_ros.result import INSUFFICIENT, Result
from calib_ros.semantics.segmentation import CLOUD, IMAGE

Progress = Callable[[str, float], None]


def first_extrinsic(
    calibrator: Calibrator, features: Sequence[Features], initial: Result, needed: int, progress: Progress | None
) -> Result:
    """Estimate from the classes of at least `needed` of the keyframes, or why there is none yet.

    initial: gives the names of the frames, and the extrinsic until there is a better one.
    """
    known, missing = len(calibrator.views(features)), calibrator.segmentation.missing(IMAGE, CLOUD)
    if known < needed:
        reason = missing if missing else f"waiting for the classes of keyframes, {known} of {needed}"
        reason = f"nothing is known of the extrinsic: {reason}"
        return replace(initial, status=INSUFFICIENT, reason=reason, frames_used=0)
    result = calibrator.guess(features, progress=progress)
    if not result.converged:
        result = replace(result, T_camera_lidar=initial.T_camera_lidar)
    return replace(result, camera_frame=initial.camera_frame, lidar_frame=initial.lidar_frame)
