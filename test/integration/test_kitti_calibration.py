"""Accuracy on real frames; needs KITTI."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import is_near

from calib_ros import se3
from calib_ros.config import Config
from calib_ros.datasets import open_dataset
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.initial_guess import nominal
from calib_ros.registration.search.constraints import SearchBox

pytestmark = pytest.mark.kitti


@pytest.mark.slow
def test_odometry_scenes_without_any_initial_extrinsic(kitti_root):
    """From nominal, camera looking ahead and no translation, to KITTI's own calibration."""
    source = open_dataset(kitti_root / "odometry/sequences/00")
    result = Calibrator(source.camera).calibrate([source[i] for i in range(len(source))], nominal(), SearchBox(10.0, 0.5))
    assert result.converged
    assert is_near(source.reference, result.T_camera_lidar, 0.12, 0.04)
    # The errors that the covariance foretells are of the size of the errors made.
    xi = se3.log(source.reference @ se3.inverse(result.T_camera_lidar))
    assert xi @ np.linalg.solve(result.covariance, xi) < 20


@pytest.mark.slow
def test_the_thesis_objective_on_three_scenes(kitti_root):
    source = open_dataset(kitti_root / "odometry/sequences/00")
    config = Config.from_dict({"refine": {"objective": "thesis"}, "thesis": {"dense_edges": "once_per_level"}})
    start = se3.perturb(source.reference, [0.6, -0.7, 0.5], [0.05, -0.06, 0.08])
    result = Calibrator(source.camera, config).calibrate([source[i] for i in (0, 3, 7)], start)
    assert result.converged, result.reason
    assert result.score > result.initial_score
    assert is_near(source.reference, result.T_camera_lidar, 0.6, 0.15)
