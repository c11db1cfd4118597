"""The first extrinsic of a recalibrator that knows nothing: from 5 s of driving, for any yaw of the camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import QUICK, RenderedDrive

from calib_ros import se3
from calib_ros.config import update
from calib_ros.frame import NANOSECONDS
from calib_ros.online.first_guess import ENOUGH_S, RUN_S, SPACING_S, FirstGuess
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.registration.initial_guess import nominal, nominal_start
from calib_ros.result import INSUFFICIENT, InitialSource

CONFIG = update(
    QUICK,
    {"initial": {"method": "motion"}, "online": {"min_keyframes": 4, "similarity_threshold": 1.0}, "monitor": {"enabled": False}},
)


def backward() -> np.ndarray:
    T = se3.perturb(nominal(180.0), np.array([2.0, -1.5, 1.0]), np.zeros(3))
    T[:3, 3] = -T[:3, :3] @ [-0.3, 0.1, -0.1]
    return T


@pytest.fixture(scope="module")
def drive() -> RenderedDrive:
    return RenderedDrive(seed=6, frames=16, rings=32, width=448, height=168, stride=3, T_camera_lidar=backward())


def test_a_camera_that_looks_backward_is_found_while_driving_and_a_reset_begins_anew(drive):
    recalibrator = Recalibrator(drive.camera, nominal_start(), update(CONFIG, {"initial": {"method": "auto"}}))
    for k in range(len(drive)):
        recalibrator.ingest(drive[k])
        if recalibrator.ready() and recalibrator.estimate().accepted:
            break
    T = recalibrator.current.result.T_camera_lidar
    assert recalibrator.current.accepted == 1
    assert se3.rotation_error_deg(backward(), T) < 0.5
    assert se3.translation_error_m(backward(), T) < 0.1
    assert recalibrator.tracker.initial.origin is InitialSource.MOTION
    assert not recalibrator.first_guess._run  # what was kept of the drive is free again
    recalibrator.reset()
    assert np.allclose(recalibrator.current.result.T_camera_lidar, nominal())
    recalibrator.ingest(drive[0])
    assert len(recalibrator.first_guess._run) == 1


@pytest.mark.parametrize("method", ["motion", "auto"])
def test_until_then_it_says_what_it_waits_for(drive, method):
    """Nominal is tried only after motion has been."""
    recalibrator = Recalibrator(drive.camera, nominal_start(), update(CONFIG, {"initial": {"method": method}}))
    for k in range(0, 11, 5):
        recalibrator.ingest(drive[k])
    extrinsic = recalibrator.estimate()
    assert (extrinsic.result.status, extrinsic.usable) == (INSUFFICIENT, False)
    assert "waiting for 4 s of driving" in extrinsic.result.reason
    assert recalibrator.first_guess.needs_classes is (method == "auto")


def test_a_known_start_is_not_guessed(drive):
    recalibrator = Recalibrator(drive.camera, backward(), CONFIG)
    for k in range(4):
        recalibrator.ingest(drive[4 * k])
    assert not recalibrator.first_guess._run
    assert recalibrator.estimate().result.status != INSUFFICIENT


def test_no_more_frames_are_kept_than_are_used(drive):
    guess, frame = FirstGuess(CONFIG), drive[0]
    for after in range(0, 20 * NANOSECONDS, NANOSECONDS // 10):
        guess.add(replace(frame, stamp=frame.stamp + after, cloud_stamp=frame.stamp + after))
    assert len(guess._run) <= RUN_S / SPACING_S + 1
    assert guess._lasted(guess._run) >= ENOUGH_S
