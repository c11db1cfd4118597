"""Intrinsics that are corrected together with the extrinsic: right ones are found, and nothing else is made of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import QUICK, Scene, assert_not_used, same

from calib_ros.camera import Camera
from calib_ros.config import CameraConfig, update
from calib_ros.errors import BadInputError
from calib_ros.intrinsics import CENTRE, FOCAL, NAMES, RADIAL, IntrinsicEstimate, RefinedCamera, change_between, changed
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.camera_rounds import refined_with_camera
from calib_ros.registration.nuisance.refinement import joint_optimum, lens_parameters
from calib_ros.registration.search.constraints import SearchBox, unlimited
from calib_ros.result import CONVERGED, RefusalCode, Result

BOX = SearchBox(1.5, 0.15)
REFINE = update(QUICK, {"camera": {"intrinsics": "refine"}})
LENSES = [
    Camera(np.array([[700.0, 0, 630], [0, 690, 370], [0, 0, 1]]), 1280, 720),
    Camera(np.array([[700.0, 0, 630], [0, 690, 370], [0, 0, 1]]), 1280, 720, D=np.array([-0.3, 0.1, 1e-3, 5e-4, 0.0])),
    Camera(
        np.array([[420.0, 0, 475], [0, 421, 390], [0, 0, 1]]), 960, 768, "equidistant", np.array([0.02, -0.004, 8e-4, -1.5e-4])
    ),
]


def refined(scene: Scene, seen_by: Camera, **options: object) -> Result:
    calibrator = Calibrator(seen_by, update(REFINE, options))
    start = scene.off(([0.4, -0.3, 0.2], [0.03, -0.02, 0.04]))
    return calibrator.calibrate([replace(f, camera=seen_by) for f in scene.frames], start, BOX)


def wrong(camera: Camera, focal: float, corner: float) -> Camera:
    """A focal length that is off by a share, and a k1 that moves the corner by a share of its radius."""
    radial = lens_parameters(CameraConfig(), camera, camera.rectified())[-1]
    return changed(changed(camera, FOCAL, focal), RADIAL, corner * radial.unit)


@pytest.mark.parametrize(("focal", "corner"), [(0.03, 0.0), (-0.03, 0.02)])
def test_a_wrong_camera_is_corrected_with_the_extrinsic(scene, focal, corner):
    given = wrong(scene.camera, focal, corner)
    result = refined(scene, given)
    scene.assert_found(result, 0.3, 0.05)
    found = result.refined_camera
    assert found is not None
    for name, change in found.changes.items():
        assert abs(change_between(scene.camera, found.camera, name)) < 2.5 * change.sigma
        assert change.value == pytest.approx(change_between(given, found.camera, name), abs=1e-9)
    assert found.changes[FOCAL].observable
    assert found.changes[FOCAL].sigma < 0.003
    assert np.allclose(found.T_camera_lidar, result.T_camera_lidar)
    assert np.allclose(result.covariance, found.covariance[:6, :6])  # the vehicle stands: the clocks leave nothing open
    assert np.linalg.eigvalsh(found.covariance / np.outer(*[np.sqrt(np.diag(found.covariance))] * 2)).min() > 0
    assert dict(result.intrinsics) == dict(found.changes)


def test_a_right_camera_stays_so_and_runs_are_the_same(scene):
    first, second = (refined(scene, scene.camera) for _ in range(2))
    assert same(first, second)
    assert first.refined_camera.to_dict() == second.refined_camera.to_dict()
    scene.assert_found(first, 0.2, 0.04)
    for name, change in first.refined_camera.changes.items():
        assert abs(change.value) < 2.5 * change.sigma, name


def test_without_being_asked_nothing_is_corrected(scene):
    start = scene.off(([0.4, -0.3, 0.2], [0.03, -0.02, 0.04]))
    assert scene.quick.calibrate(scene.frames, start, BOX).refined_camera is None


def test_exact_intrinsics_are_left_alone(scene):
    names = [own.name for own in lens_parameters(CameraConfig(focal_sigma=0.0, centre_sigma=0.0), scene.camera, scene.camera)]
    assert names == [RADIAL]


def test_unrolled_pictures_show_no_intrinsics(scene):
    calibrator = Calibrator(scene.camera, update(REFINE, {"image": {"projection": "cylinder"}}))
    with pytest.raises(BadInputError, match="not observable"):
        calibrator.calibrate(scene.frames, scene.truth)
    score = calibrator.objectives([calibrator.extract(f) for f in scene.frames[:1]], scene.truth, scene.truth).edges.score
    assert joint_optimum(score, scene.truth, unlimited(scene.truth), None, scene.camera, CameraConfig(), 1.0) is None


@pytest.mark.parametrize("camera", LENSES)
@pytest.mark.parametrize("name", NAMES)
def test_the_effect_of_a_lens_on_rays_is_that_of_its_own_model(camera, name):
    flat = camera.rectified()
    own = next(own for own in lens_parameters(CameraConfig(), camera, flat) if own.name == name)
    value = 1e-3
    other = changed(camera, name, own.unit * value)
    h, w = own.field.shape[:2]
    for row, column in ((h // 2, w // 4), (h // 5, w // 2), (3 * h // 4, 7 * w // 8)):
        u, v = column / (w - 1) * (flat.width - 1), row / (h - 1) * (flat.height - 1)
        ray = np.array([(u - flat.K[0, 2]) / flat.K[0, 0], (v - flat.K[1, 2]) / flat.K[1, 1]])
        # The picture of the changed lens, looked at as one of the given lens, shows the ray where the shift says.
        seen = ray + value * own.field[row, column]
        assert other.project([[*ray, 1.0]])[0] == pytest.approx(camera.project([[*seen, 1.0]])[0], abs=0.02)
    corner = np.linalg.norm(own.field, axis=2).max()
    assert corner > 0.1


def test_changes_of_a_camera_and_their_sizes():
    for camera in LENSES:
        for name, value in zip(NAMES, (0.02, -3.0, 4.0, 0.01), strict=True):
            other = changed(camera, name, value)
            assert change_between(camera, other, name) == pytest.approx(value)
            assert (other.model, other.width, other.height) == (camera.model, camera.width, camera.height)
    assert len(changed(LENSES[0], RADIAL, 0.1).D) == 5


def estimate(change: float, sigma: float, shift_m: float = 0.1, **options: object) -> Result:
    """Of a focal length, a standard deviation of which shifts the extrinsic by so much."""
    along = np.array([0, 0, 0, 0, 0, shift_m / sigma])
    covariance = np.zeros((7, 7))
    covariance[:6, :6] = 1e-6 * np.eye(6) + sigma**2 * np.outer(along, along)
    covariance[:6, 6] = covariance[6, :6] = sigma**2 * along
    covariance[6, 6] = sigma**2
    camera = changed(LENSES[0], FOCAL, change)
    left = RefinedCamera(camera, np.eye(4), {FOCAL: IntrinsicEstimate(change, sigma, True)}, covariance)
    values = {"covariance": 1e-6 * np.eye(6), "initial": np.eye(4), "refined_camera": left, **options}
    return Result(np.eye(4), CONVERGED, **values)


def test_rounds_end_where_nothing_is_left_and_the_covariance_is_about_the_camera_that_is_told():
    asked = []

    def near(camera: Camera, T: np.ndarray) -> Result:
        asked.append(camera)
        return estimate(0.02 if len(asked) == 1 else 0.0005, 0.001)

    last = estimate(0.0005, 0.001, 0.01)
    result = refined_with_camera(estimate(0.03, 0.001), LENSES[0], near, lambda camera: last, CameraConfig(), REFINE.refine)
    assert len(asked) == 2
    assert result.converged
    assert result.refined_camera.changes[FOCAL].value == pytest.approx(0.0005)  # of the camera that the last round has told
    sigma = np.sqrt(result.refined_camera.covariance[6, 6])
    assert sigma == pytest.approx(np.hypot(0.001, 0.0005))
    assert np.sqrt(result.covariance[5, 5]) == pytest.approx(np.hypot(0.001, 0.01 * np.hypot(1, 0.5)))


def test_what_the_scenes_leave_too_open_is_refused():
    def result(sigma: float, shift_m: float) -> Result:
        last = estimate(0.0, sigma, shift_m)
        return refined_with_camera(last, LENSES[0], lambda c, T: last, lambda c: last, CameraConfig(), REFINE.refine)

    assert result(0.004, 0.2).converged  # as well as a focal length is known that is given
    refused = result(0.02, 0.2)
    assert_not_used(refused, np.eye(4))
    assert refused.refusal is RefusalCode.TOO_UNCERTAIN
    assert refused.refined_camera is None
    assert result(0.02, 0.02).converged  # it hardly matters


def test_of_a_refused_estimate_no_camera_is_told():
    last = replace(estimate(0.0, 0.001), status="refused", covariance=None)
    result = refined_with_camera(last, LENSES[0], lambda c, T: last, lambda c: last, CameraConfig(), None)
    assert result.refined_camera is None


def test_directions_follow_from_the_joint_covariance():
    left = estimate(0.0, 0.001, 0.1).refined_camera
    assert left.directions[:, 0] == pytest.approx([0, 0, 0, 0, 0, 100.0])
    assert set(CENTRE) < set(NAMES)


def test_intrinsics_are_searched_where_the_extrinsic_is_only_refined(scene):
    given = wrong(scene.camera, 0.03, 0.0)
    frames = [replace(f, camera=given) for f in scene.frames]
    result = Calibrator(given, REFINE).calibrate(frames, scene.off(([0.2, -0.1, 0.1], [0.02, -0.01, 0.02])))
    scene.assert_found(result, 0.3, 0.05)
    assert result.starts is None
    assert change_between(scene.camera, result.refined_camera.camera, FOCAL) == pytest.approx(0, abs=0.004)
