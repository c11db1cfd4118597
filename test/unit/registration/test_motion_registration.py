"""The registration from the first guess of motion, and what takes its place where there is none."""

from __future__ import annotations

import numpy as np
from scenes import QUICK, SIZE, RenderedDrive

from calib_ros import se3
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.initial_guess import nominal
from calib_ros.result import CONVERGED, InitialSource


def test_auto_falls_back_on_the_nominal_extrinsic() -> None:
    """Of a vehicle that stops for every frame, without classes."""
    drive = RenderedDrive(seed=1, **SIZE)
    frames = [drive[k] for k in range(2)]
    result = Calibrator(frames[0].camera, QUICK).calibrate(frames, "auto")
    assert result.status == CONVERGED
    assert result.origin is InitialSource.NOMINAL
    assert "not by motion" in result.reason


def test_a_drive_is_calibrated_from_its_motion() -> None:
    """A camera that looks backward, registered from every fourth frame."""
    T = se3.perturb(nominal(180.0), np.array([2.0, -1.5, 1.0]), np.zeros(3))
    T[:3, 3] = -T[:3, :3] @ [-0.3, 0.1, -0.1]
    drive = RenderedDrive(seed=6, frames=11, rings=32, width=448, height=168, stride=3, T_camera_lidar=T)
    frames = [drive[k] for k in range(len(drive))]
    result = Calibrator(frames[0].camera, QUICK).calibrate(frames[::4], "motion", consecutive=frames)
    assert result.initial is not None
    assert se3.rotation_error_deg(T, result.initial) < 4
    assert result.status == CONVERGED
    assert result.origin is InitialSource.MOTION
    assert se3.rotation_error_deg(T, result.T_camera_lidar) < 0.5
