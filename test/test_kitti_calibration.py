"""Accuracy on real frames; needs KITTI."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib_ros import se3
from calib_ros.datasets import open_source
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.search import SearchBox

pytestmark = pytest.mark.kitti


def test_drive_0005_from_ten_starts(kitti_root: Path) -> None:
    """15 frames, starts uniform in 1.5 deg / 0.15 m per axis: at least 9 of 10 within 0.3 deg and 8 cm."""
    source = open_source(kitti_root / "raw/2011_09_26/2011_09_26_drive_0005_sync")
    reference = source.reference
    calibrator = Calibrator(source.camera)
    features = [calibrator.extract(source[i]) for i in range(0, 29, 2)]
    rng = np.random.default_rng(0)
    good = 0
    for _ in range(10):
        start = se3.perturb(reference, rng.uniform(-1.5, 1.5, 3), rng.uniform(-0.15, 0.15, 3))
        result = calibrator.estimate(features, start, SearchBox(3.0, 0.3))
        T = result.T_camera_lidar
        good += result.converged and se3.rotation_error_deg(reference, T) < 0.3 and se3.translation_error_m(reference, T) < 0.08
    assert good >= 9


def test_odometry_scenes_without_any_initial_extrinsic(kitti_root: Path) -> None:
    """From nominal, camera looking ahead and no translation, to KITTI's own calibration."""
    from calib_ros.registration.initial_guess import nominal

    source = open_source(kitti_root / "odometry/sequences/00")
    result = Calibrator(source.camera).calibrate([source[i] for i in range(len(source))], nominal(), SearchBox(10.0, 0.5))
    assert result.converged
    assert se3.rotation_error_deg(source.reference, result.T_camera_lidar) < 0.12
    assert se3.translation_error_m(source.reference, result.T_camera_lidar) < 0.04
    # The errors that the covariance foretells are of the size of the errors made.
    xi = se3.log(source.reference @ se3.inverse(result.T_camera_lidar))
    assert xi @ np.linalg.solve(result.covariance, xi) < 20


def test_wrong_images_are_not_converged_or_far_less_sure(kitti_root: Path) -> None:
    """Scans paired with images of other scenes must not pass for a calibration."""
    import dataclasses

    source = open_source(kitti_root / "odometry/sequences/00")
    frames = [source[i] for i in range(6)]
    mixed = [dataclasses.replace(frames[k], image=frames[(k + 3) % 6].image) for k in range(6)]
    right = Calibrator(source.camera).calibrate(frames, source.reference, SearchBox(2.0, 0.2))
    wrong = Calibrator(source.camera).calibrate(mixed, source.reference, SearchBox(2.0, 0.2))
    assert right.converged
    assert not wrong.converged or wrong.score < 0.6 * right.score
