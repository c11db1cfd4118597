"""Wrong intrinsics are named, with their size, and never become a mount."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import QUICK, Scene, assert_not_used

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.config import update
from calib_ros.registration.acceptance.refusal import LeftOpen, WrongIntrinsics
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.nuisance.lens import FocalLength
from calib_ros.registration.nuisance.parameters import Effect, NuisanceEstimate, wrong_parameter
from calib_ros.registration.search.constraints import Limits, PoseConstraints, SearchBox
from calib_ros.result import RefusalCode, Result

BOX = SearchBox(1.5, 0.15)


def changed(camera: Camera, focal: float = 0.0, u: float = 0.0, v: float = 0.0) -> Camera:
    K = camera.K.copy()
    K[[0, 1], [0, 1]] *= 1 + focal
    K[:2, 2] += np.array([u, v])
    return replace(camera, K=K)


def calibrated(scene: Scene, seen_by: Camera, box: SearchBox | None = BOX, **options: object) -> tuple[Result, np.ndarray]:
    """The result with another camera, and its start."""
    calibrator = Calibrator(seen_by, update(QUICK, options))
    start = scene.off(([0.4, -0.3, 0.2], [0.03, -0.02, 0.04]))
    return calibrator.calibrate([replace(f, camera=seen_by) for f in scene.frames], start, box), start


@pytest.mark.parametrize(
    ("focal", "u", "v", "says"),
    [
        (0.03, 0, 0, "shorter"),
        (-0.04, 0, 0, "longer"),
        (0, 16, 0, "further to the left"),
        (0, 0, -16, "further down"),
    ],
)
def test_wrong_intrinsics_are_refused_and_named(scene, focal, u, v, says):
    result, start = calibrated(scene, changed(scene.camera, focal, u, v))
    assert_not_used(result, start)
    assert result.refusal is RefusalCode.WRONG_INTRINSICS
    assert says in result.reason
    assert result.refusal_figures["focal"] == pytest.approx(-focal, abs=0.01)
    assert result.refusal_figures["u"] == pytest.approx(-u, abs=6)
    assert result.refusal_figures["v"] == pytest.approx(-v, abs=6)


def test_right_intrinsics_are_estimated_as_given(scene):
    result, _ = calibrated(scene, scene.camera)
    scene.assert_found(result)
    assert set(result.intrinsics) == {"focal_length_share", "principal_point_x_px", "principal_point_y_px"}
    focal = result.intrinsics["focal_length_share"]
    assert focal.observable
    assert abs(focal.value) < 4 * focal.sigma < 0.02
    told = result.to_dict()["intrinsics"]["focal_length_share"]
    assert told == {"value": focal.value, "sigma": focal.sigma, "observable": True}


@pytest.mark.parametrize("focal", [-0.01, 0.01])
def test_a_focal_length_one_per_cent_off_is_an_unknown_and_no_reason_to_refuse(scene, focal):
    result, _ = calibrated(scene, changed(scene.camera, focal))
    exact, _ = calibrated(scene, changed(scene.camera, focal), camera={"focal_sigma": 0.0, "centre_sigma": 0.0})
    assert result.converged
    assert result.intrinsics["focal_length_share"].value == pytest.approx(-focal, abs=0.006)
    assert exact.intrinsics == {}
    forward = scene.truth[:3, :3] @ [1.0, 0.0, 0.0]
    off = se3.log(result.T_camera_lidar @ se3.inverse(scene.truth))[3:] @ forward
    told, without = (np.sqrt(forward @ r.covariance[3:, 3:] @ forward) for r in (result, exact))
    assert abs(off) < 3 * told
    assert told > 1.5 * without  # by how much the camera looks nearer or farther away


def unknown(value: float, sigma: float, prior: float, shift_m: float) -> NuisanceEstimate:
    """A focal length that shifts the optimum by so much."""
    direction = np.array([0, 0, 0, 0, 0, shift_m / value])
    return NuisanceEstimate(FocalLength(prior), value, Effect(direction, 1 / sigma**2))


@pytest.mark.parametrize(
    ("estimates", "refusal"),
    [
        ([unknown(0.03, 0.002, 0.005, 0.3)], WrongIntrinsics),
        ([unknown(0.01, 0.002, 0.005, 0.3)], None),  # within what calibrations differ by
        ([unknown(0.03, 0.02, 0.005, 0.3)], None),  # the scenes hardly tell
        ([unknown(0.03, 0.002, 0.005, 0.05)], None),  # it does not matter
        ([unknown(0.0182, 0.002, 0.005, 0.3)], WrongIntrinsics),  # p = 0.0007
        ([unknown(0.0182, 0.002, 0.005, 0.3)] * 3, LeftOpen),  # of three, but it is as likely as not that one is plainly wrong
        ([unknown(0.0182, 0.002, 0.005, 0.09)] * 3, None),  # it hardly matters
    ],
)
def test_what_is_refused_is_significant_and_matters(estimates, refusal):
    found = wrong_parameter(estimates, 0.5, 0.1)
    assert found is None if refusal is None else isinstance(found, refusal)


def test_what_is_known_in_advance_and_what_the_scenes_tell_are_weighed():
    told = unknown(0.01, 0.005, 0.005, 0.1)
    assert told.posterior == pytest.approx((0.005, 0.005 / np.sqrt(2)))
    moment = told.added_covariance(PoseConstraints(Limits(np.eye(4), np.full(6, np.inf))), np.eye(6))
    assert np.sqrt(moment[5, 5]) == pytest.approx(10 * np.hypot(0.005, 0.005 / np.sqrt(2)))
    nothing = NuisanceEstimate(FocalLength(0.005), 0.01, Effect(np.ones(6), 0.0))
    assert (nothing.sigma, nothing.deviations, nothing.is_observable) == (np.inf, 0.0, False)
    assert nothing.posterior == pytest.approx((0.0, 0.005))


def test_they_are_checked_where_something_is_searched_and_it_is_wanted(scene):
    wrong = changed(scene.camera, -0.04)
    refined, _ = calibrated(scene, wrong, None)
    unchecked, _ = calibrated(scene, wrong, refine={"tolerance_deg": 180.0, "tolerance_m": 100.0})
    assert RefusalCode.WRONG_INTRINSICS not in (refined.refusal, unchecked.refusal)
