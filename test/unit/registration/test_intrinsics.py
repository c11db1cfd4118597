"""Wrong intrinsics are named, with their size, and never become a mount; or they are corrected together with the extrinsic."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import QUICK, Scene, assert_not_used

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.config import CameraConfig, update
from calib_ros.errors import BadInputError
from calib_ros.intrinsics import ASPECT, CENTRE, FOCAL, NAMES, RADIAL, IntrinsicEstimate, RefinedCamera, change_between, changed
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.estimate import refined_with_camera
from calib_ros.registration.judgement.lens import LensEstimate, lens_unknowns
from calib_ros.registration.search.constraints import SearchBox
from calib_ros.result import CONVERGED, REFUSED, Cause, RefusalCode, Result

BOX = SearchBox(1.5, 0.15)
REFINE = update(QUICK, {"camera": {"intrinsics": "refine"}})
K = np.array([[700.0, 0, 630], [0, 690, 370], [0, 0, 1]])
K_WIDE = np.array([[420.0, 0, 475], [0, 421, 390], [0, 0, 1]])
LENSES = [
    Camera(K, 1280, 720),
    Camera(K, 1280, 720, D=np.array([-0.3, 0.1, 1e-3, 5e-4, 0.0])),
    Camera(K_WIDE, 960, 768, "equidistant", np.array([0.02, -0.004, 8e-4, -1.5e-4])),
]


def wrong(camera: Camera, focal: float = 0.0, u: float = 0.0, v: float = 0.0, corner: float = 0.0) -> Camera:
    """A focal length that is off by a share, a principal point by pixels, and a k1 that moves the corner by a share of its
    radius."""
    unit = lens_unknowns(CameraConfig(), camera, camera.rectified())[-1].unit
    for name, value in ((FOCAL, focal), (CENTRE[0], u), (CENTRE[1], v), (RADIAL, corner * unit)):
        camera = changed(camera, name, value) if value else camera
    return camera


def calibrated(scene: Scene, seen_by: Camera, box: SearchBox | None = BOX, config=QUICK, **options: object) -> Result:
    """The result with another camera."""
    calibrator = Calibrator(seen_by, update(config, options))
    start = scene.off(([0.4, -0.3, 0.2], [0.03, -0.02, 0.04]))
    return calibrator.calibrate([replace(f, camera=seen_by) for f in scene.frames[:3]], start, box)


# --- given ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("focal", "u", "v", "says"), [(0.03, 0, 0, "shorter"), (-0.04, 0, 0, "longer"), (0, 16, 0, "further to the left")]
)
def test_wrong_intrinsics_are_refused_and_named(scene, focal, u, v, says):
    result = calibrated(scene, wrong(scene.camera, focal, u, v))
    assert_not_used(result, result.initial)
    assert result.refusal is RefusalCode.WRONG_INTRINSICS
    assert says in result.reason
    assert [result.refusal_figures[name] for name in "uv"] == pytest.approx([-u, -v], abs=6)
    assert result.refusal_figures["focal"] == pytest.approx(-focal, abs=0.01)


def test_another_principal_point_is_a_turn_of_the_camera_that_is_stated(scene):
    result = calibrated(scene, wrong(scene.camera, v=-16))
    assert result.converged
    assert se3.translation_error_m(result.T_camera_lidar, scene.truth) < 0.06
    off = se3.log(result.T_camera_lidar @ se3.inverse(scene.truth))
    assert np.linalg.norm(off[:2]) > np.deg2rad(0.5)  # which its whole covariance knows
    assert off @ np.linalg.solve(result.covariance_with_intrinsics, off) < 22.5


def test_of_images_that_are_said_to_be_rectified_the_refusal_says_how_to_take_them_as_raw(scene):
    camera = wrong(scene.camera, -0.04)
    refused = calibrated(scene, replace(camera, said_rectified=True), None)
    assert refused.refusal is RefusalCode.WRONG_INTRINSICS
    assert "; the images are taken for rectified, but camera_info has a distortion" in refused.reason
    assert "--no-rectified, or image_is_rectified: false to the node" in refused.reason
    assert "--no-rectified" not in calibrated(scene, camera, None).reason


def test_right_intrinsics_are_estimated_as_given(scene):
    result = calibrated(scene, scene.camera)
    scene.assert_found(result)
    assert result.refined_camera is None  # unless asked for
    assert set(result.intrinsics) == set(NAMES)
    focal = result.intrinsics[FOCAL]
    assert focal.observable
    assert abs(focal.value) < 4 * focal.sigma < 0.02
    asked = calibrated(scene, scene.camera, config=REFINE)  # the noise of the scenes corrects nothing
    assert asked.refined_camera.camera == scene.camera
    assert np.array_equal(asked.T_camera_lidar, result.T_camera_lidar)


@pytest.mark.parametrize("focal", [-0.01, 0.01])
def test_a_focal_length_one_per_cent_off_is_an_unknown_and_no_reason_to_refuse(scene, focal):
    result = calibrated(scene, wrong(scene.camera, focal))
    exact = calibrated(scene, wrong(scene.camera, focal), camera={"focal_sigma": 0.0})
    assert result.converged
    assert result.intrinsics[FOCAL].value == pytest.approx(-focal, abs=0.006)
    assert exact.intrinsics == {}
    forward = scene.truth[:3, :3] @ [1.0, 0.0, 0.0]
    off = se3.log(result.T_camera_lidar @ se3.inverse(scene.truth))[3:] @ forward
    told, alone = (np.sqrt(forward @ C[3:, 3:] @ forward) for C in (result.covariance_with_intrinsics, result.covariance))
    assert abs(off) < 3 * told
    assert told > 1.5 * alone  # by how much the camera looks nearer or farther away
    assert np.allclose(result.covariance, exact.covariance)


def shown(name: str, value: float, sigma: float, shift_m: float, camera: Camera = LENSES[0]) -> LensEstimate:
    """The scenes show a change of an intrinsic by `value`, which shifts the optimum by so much forward."""
    unknowns = [own for own in lens_unknowns(CameraConfig(), camera, camera) if own.name == name]
    forward = np.array([[0, 0, 0, 0, 0, shift_m / value]]).T
    T, x, information = se3.exp(forward[:, 0] * value), np.array([value]), np.array([[sigma**-2.0]])
    return LensEstimate(tuple(unknowns), x, T, information, forward, 100.0, np.zeros(1), 10.0)


@pytest.mark.parametrize(
    ("name", "value", "sigma", "shift_m", "refusal"),
    [
        (FOCAL, 0.03, 0.002, 0.3, RefusalCode.WRONG_INTRINSICS),
        (FOCAL, 0.01, 0.002, 0.1, None),  # within what calibrations differ by
        (FOCAL, 0.01, 0.001, 0.2, RefusalCode.WRONG_INTRINSICS),  # these too: the scenes are sure that it matters
        (FOCAL, 0.03, 0.02, 0.3, None),  # the scenes hardly tell
        (FOCAL, 0.008, 0.001, 0.05, None),  # it does not matter
        (FOCAL, 0.03, 0.002, 0.05, RefusalCode.WRONG_INTRINSICS),  # points at the border are seen 0.7 deg elsewhere
        (FOCAL, 0.03, 0.008, 0.3, RefusalCode.TOO_UNCERTAIN),  # it may be plainly wrong
        (RADIAL, -0.05, 0.005, 0.3, RefusalCode.WRONG_INTRINSICS),
    ],
)
def test_what_is_refused_is_significant_and_matters(name, value, sigma, shift_m, refusal):
    fault = shown(name, value, sigma, shift_m).fault(LENSES[0], 0.5, 0.1)
    assert (fault and fault.code) == refusal


def test_square_pixels_are_doubted_less_readily_than_others():
    square = Camera(np.array([[700.0, 0, 630], [0, 700, 370], [0, 0, 1]]), 1280, 720)
    assert shown(ASPECT, 0.03, 0.0075, 0.3).fault(LENSES[0], 0.5, 0.1) is not None
    assert shown(ASPECT, 0.03, 0.0075, 0.3, square).fault(LENSES[0], 0.5, 0.1) is None
    assert shown(ASPECT, 0.03, 0.003, 0.3, square).fault(LENSES[0], 0.5, 0.1) is not None


def test_no_lens_is_blamed_where_the_score_hardly_gains():
    estimate = shown(RADIAL, -0.05, 0.005, 0.3)
    fault = replace(estimate, gain=1.0).fault(LENSES[0], 0.5, 0.1)
    assert fault is None or fault.code is RefusalCode.TOO_UNCERTAIN


def test_they_are_checked_where_it_is_wanted(scene):
    camera = wrong(scene.camera, -0.04)
    unchecked = calibrated(scene, camera, refine={"tolerance_deg": 180.0, "tolerance_m": 100.0})
    assert unchecked.refusal is not RefusalCode.WRONG_INTRINSICS
    assert calibrated(scene, camera, None).refusal is RefusalCode.WRONG_INTRINSICS  # without a search, too


@pytest.mark.parametrize(
    ("flip", "wrong_transform", "size", "cause"),
    [
        ((1,), np.asarray, 1.0, Cause.MIRRORED_IMAGE),
        ((), se3.inverse, 1.0, Cause.INVERSE_TRANSFORM),
        ((), np.asarray, 1.25, Cause.OTHER_CAMERA),
    ],
)
def test_where_nothing_matches_what_was_mixed_up_is_named(scene, flip, wrong_transform, size, cause):
    camera = replace(scene.camera, K=scene.camera.K * np.array([[size, 1, size], [1, size, size], [1, 1, 1]]))
    frames = [replace(f, image=np.ascontiguousarray(np.flip(f.image, flip)), camera=camera) for f in scene.frames[:2]]
    result = Calibrator(camera, QUICK).calibrate(frames, wrong_transform(scene.truth))
    assert_not_used(result, result.initial)
    assert result.cause is cause, result.reason


# --- refined --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("focal", "corner", "box"), [(-0.03, 0.02, BOX), (0.03, 0.0, None)])
def test_a_wrong_camera_is_corrected_with_the_extrinsic(scene, focal, corner, box):
    given = wrong(scene.camera, focal, corner=corner)
    result = calibrated(scene, given, box, REFINE)
    scene.assert_found(result, 0.3, 0.05)
    assert (result.starts is None) == (box is None)
    found = result.refined_camera
    assert found is not None
    for name, change in found.changes.items():
        assert abs(change_between(scene.camera, found.camera, name)) < 2.5 * change.sigma
        assert change.value == pytest.approx(change_between(given, found.camera, name), abs=1e-9)
    assert found.changes[FOCAL].observable
    assert found.changes[FOCAL].sigma < 0.003
    assert np.allclose(found.T_camera_lidar, result.T_camera_lidar)
    assert np.allclose(
        result.covariance_with_intrinsics, found.covariance[:6, :6]
    )  # the vehicle stands: the clocks leave nothing open
    assert np.linalg.eigvalsh(found.covariance / np.outer(*[np.sqrt(np.diag(found.covariance))] * 2)).min() > 0
    assert dict(result.intrinsics) == dict(found.changes)


@pytest.mark.parametrize(
    ("model", "D"), [("double_sphere", [-0.2, 0.5]), ("omnidir", [1.2, -0.1, 0.02, 1e-3, 0]), ("fov", [0.9])]
)
def test_of_models_without_a_radial_coefficient_focal_length_and_centre_are_refined(model, D):
    camera = Camera(K, 1280, 720, model, np.array(D))
    assert [own.name for own in lens_unknowns(CameraConfig(), camera, camera.rectified())] == [FOCAL, ASPECT, *CENTRE]
    assert lens_unknowns(CameraConfig(focal_sigma=0.0), camera, camera.rectified()) == ()


def test_unrolled_pictures_show_no_intrinsics(scene):
    calibrator = Calibrator(scene.camera, update(REFINE, {"image": {"projection": "sphere"}}))
    with pytest.raises(BadInputError, match="not observable"):
        calibrator.calibrate(scene.frames, scene.truth)
    score = calibrator.objectives([calibrator.extract(f) for f in scene.frames[:1]], scene.truth, scene.truth).edges.score
    assert lens_unknowns(CameraConfig(), scene.camera, score.camera) == ()


@pytest.mark.parametrize("camera", LENSES)
@pytest.mark.parametrize("name", NAMES)
def test_the_effect_of_a_lens_on_rays_is_that_of_its_own_model(camera, name):
    flat = camera.rectified()
    own = next(own for own in lens_unknowns(CameraConfig(), camera, flat) if own.name == name)
    value = 1e-3
    other = changed(camera, name, own.unit * value)
    h, w = own.field.shape[:2]
    for row, column in ((h // 2, w // 4), (h // 5, w // 2), (3 * h // 4, 7 * w // 8)):
        u, v = column / (w - 1) * (flat.width - 1), row / (h - 1) * (flat.height - 1)
        ray = np.array([(u - flat.K[0, 2]) / flat.K[0, 0], (v - flat.K[1, 2]) / flat.K[1, 1]])
        # The picture of the changed lens, looked at as one of the given lens, shows the ray where the shift says.
        seen = ray + value * own.field[row, column]
        assert other.project([[*ray, 1.0]])[0] == pytest.approx(camera.project([[*seen, 1.0]])[0], abs=0.02)
    assert np.linalg.norm(own.field, axis=2).max() > 0.1  # in the corner


# --- in rounds ------------------------------------------------------------------------------------------------------------


def estimate(change: float, sigma: float = 0.001, shift_m: float = 0.1, **options: object) -> Result:
    """Of a focal length, a standard deviation of which shifts the extrinsic by so much."""
    along = np.array([0, 0, 0, 0, 0, shift_m / sigma])
    covariance = np.zeros((7, 7))
    covariance[:6, :6] = 1e-6 * np.eye(6) + sigma**2 * np.outer(along, along)
    covariance[:6, 6] = covariance[6, :6] = sigma**2 * along
    covariance[6, 6] = sigma**2
    camera = changed(LENSES[0], FOCAL, change)
    left = RefinedCamera(camera, np.eye(4), {FOCAL: IntrinsicEstimate(change, sigma, True)}, covariance)
    assert left.directions[:, 0] == pytest.approx(along)
    values = {"covariance": 1e-6 * np.eye(6), "initial": np.eye(4), "refined_camera": left, **options}
    return Result(np.eye(4), CONVERGED, **values)


def test_rounds_end_where_nothing_is_left_and_the_covariance_is_about_the_camera_that_is_told():
    asked = []

    def whole(camera: Camera) -> Result:
        asked.append(camera)
        return estimate(0.02) if len(asked) == 1 else estimate(0.0005, shift_m=0.01)

    result = refined_with_camera(estimate(0.03), LENSES[0], whole)
    assert len(asked) == 2
    assert result.converged
    assert result.refined_camera.changes[FOCAL].value == pytest.approx(0.02)  # of the camera that was used last
    sigma = np.sqrt(result.refined_camera.covariance[6, 6])
    assert sigma == pytest.approx(np.hypot(0.001, 0.0005))
    assert np.sqrt(result.covariance_with_intrinsics[5, 5]) == pytest.approx(np.hypot(0.001, 0.01 * np.hypot(1, 0.5)))
    refused = replace(result, status=REFUSED, covariance=None)
    assert refined_with_camera(result, LENSES[0], lambda camera: refused).refined_camera is None


@pytest.mark.parametrize(("sigma", "shift_m", "open_"), [(0.012, 0.4, True), (0.012, 0.02, False), (0.002, 0.4, False)])
def test_a_correction_that_the_scenes_leave_too_open_is_refused(sigma, shift_m, open_):
    left = replace(shown(FOCAL, 0.001, sigma, shift_m * 0.02), centre=np.array([-0.05]))  # by 5 %
    fault = left.fault(LENSES[0], 0.5, 0.1)
    assert (fault is not None) is open_
