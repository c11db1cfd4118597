"""Wrong intrinsics are named, with their size, and never become a mount."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scenes import QUICK, Scene, assert_not_used

from calib_ros.camera import Camera
from calib_ros.config import update
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.nuisance.lens import intrinsics
from calib_ros.registration.nuisance.parameters import best_alternative, check_parameters
from calib_ros.registration.score.point_score import FastScore
from calib_ros.registration.search.constraints import SearchBox, unlimited
from calib_ros.result import RefusalCode, Result

BOX = SearchBox(1.5, 0.15)


def changed(camera: Camera, focal: float = 0.0, u: float = 0.0, v: float = 0.0) -> Camera:
    K = camera.K.copy()
    K[[0, 1], [0, 1]] *= 1 + focal
    K[:2, 2] += np.array([u, v])
    return replace(camera, K=K)


def calibrated(scene: Scene, camera: Camera, box: SearchBox | None = BOX, **options: object) -> tuple[Result, np.ndarray]:
    """The result with another camera, and its start."""
    calibrator = Calibrator(camera, update(QUICK, options))
    start = scene.off(([0.4, -0.3, 0.2], [0.03, -0.02, 0.04]))
    return calibrator.calibrate([replace(f, camera=camera) for f in scene.frames], start, box), start


@pytest.mark.parametrize(
    ("focal", "u", "v", "says"),
    [
        (0.03, 0, 0, r"a focal length about [234]% shorter"),
        (-0.04, 0, 0, r"a focal length about [2346]% longer"),
        (0, 16, 0, r"the principal point about \d+ px further to the left"),
        (0, 0, -16, r"the principal point about \d+ px further down"),
    ],
)
def test_wrong_intrinsics_are_refused_and_named(scene, focal, u, v, says):
    result, start = calibrated(scene, changed(scene.camera, focal, u, v))
    assert_not_used(result, start)
    assert result.refusal is RefusalCode.WRONG_INTRINSICS
    assert result.reason.startswith("wrong intrinsics")
    assert np.isfinite(result.score)
    assert re.search(says, result.reason), result.reason


def test_right_intrinsics_pass(scene):
    result, _ = calibrated(scene, scene.camera)
    scene.assert_found(result)
    T = result.T_camera_lidar
    score = FastScore(scene.features, T, scene.calibrator.config.score)
    best = best_alternative(intrinsics(scene.camera.width), score, T, unlimited(T))
    assert best is None or best.gain < 1.5
    assert check_parameters(intrinsics(scene.camera.width), score, T, unlimited(T)) is None


def test_they_are_checked_where_something_is_searched_and_it_is_wanted(scene):
    wrong = changed(scene.camera, -0.04)
    refined, _ = calibrated(scene, wrong, None)
    unchecked, _ = calibrated(scene, wrong, refine={"check_intrinsics": False})
    assert RefusalCode.WRONG_INTRINSICS not in (refined.refusal, unchecked.refusal)
