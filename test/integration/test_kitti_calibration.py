"""Accuracy on real frames; needs KITTI."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scenes import is_near

from calib_ros import se3
from calib_ros.config import Config
from calib_ros.datasets import open_dataset
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.initial_guess import nominal
from calib_ros.registration.score.point_score import nearest_per_pixel, project
from calib_ros.registration.search.constraints import SearchBox
from calib_ros_thesis.maps import complete_depth

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
def test_wrong_images_are_not_converged_or_far_less_sure(kitti_root):
    """Scans paired with images of other scenes must not pass for a calibration."""
    source = open_dataset(kitti_root / "odometry/sequences/00")
    frames = [source[i] for i in range(6)]
    mixed = [dataclasses.replace(frames[k], image=frames[(k + 3) % 6].image) for k in range(6)]
    right = Calibrator(source.camera).calibrate(frames, source.reference, SearchBox(2.0, 0.2))
    wrong = Calibrator(source.camera).calibrate(mixed, source.reference, SearchBox(2.0, 0.2))
    assert right.converged
    assert not wrong.converged or wrong.score < 0.6 * right.score


def test_density_completion_against_left_out_points(kitti_root):
    """Every fifth projected point held out: half of them are met within 6 cm, nine tenths within 3 m."""
    source = open_dataset(kitti_root / "odometry/sequences/00")
    off = []
    for i in (0, 4, 8):
        frame = source[i]
        depth = np.hypot(*frame.cloud.xyz[:, :2].T)
        far_first = np.argsort(-depth)
        u, v, inside = project(frame.cloud.xyz[far_first], source.reference, source.camera)
        shape = (source.camera.height, source.camera.width)
        pixels, points = nearest_per_pixel(v * shape[1] + u, inside, shape[0] * shape[1])
        levels = np.rint(100 * depth[far_first][points]).clip(1, 8000).astype(np.int16)
        held = np.random.default_rng(0).permutation(np.arange(len(pixels)) % 5 == 0)
        sparse = np.zeros(shape[0] * shape[1], np.int16)
        sparse[pixels[~held]] = levels[~held]
        dense = complete_depth(sparse.reshape(shape), 8000)
        horizon = int(source.camera.K[1, 2])
        assert (sparse.reshape(shape)[horizon:] > 0).mean() < 0.06
        assert (dense[horizon:] > 0).mean() > 0.97
        off.append(np.abs(dense.ravel()[pixels[held]] - levels[held]) / 100)
    assert np.median(np.concatenate(off)) < 0.06
    assert np.percentile(np.concatenate(off), 90) < 3


@pytest.mark.slow
def test_the_thesis_objective_on_three_scenes(kitti_root):
    source = open_dataset(kitti_root / "odometry/sequences/00")
    config = Config.from_dict({"refine": {"objective": "thesis"}, "thesis": {"dense_edges": "once_per_level"}})
    start = se3.perturb(source.reference, [0.6, -0.7, 0.5], [0.05, -0.06, 0.08])
    result = Calibrator(source.camera, config).calibrate([source[i] for i in (0, 3, 7)], start)
    assert result.converged, result.reason
    assert result.score > result.initial_score
    assert is_near(source.reference, result.T_camera_lidar, 0.6, 0.15)
