"""Wrong intrinsics in a check: another image size, a distortion that the image does not show, a principal point."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scenes import RenderedDrive

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.config import Config, MotionConfig, SearchConfig
from calib_ros.datasets import open_dataset
from calib_ros.registration.judgement.hypotheses import fisheyes, other_lenses, rectified_otherwise, resized, turned_over
from calib_ros.result import CONVERGED, Cause, Result
from calib_ros_check.causes import KNOW_CLOCKS, UNKNOWN_MOTION, clock_finding
from calib_ros_check.checker import Checker, CheckInputs
from calib_ros_check.outcome import CauseState, CheckVerdict, Tolerance

BARREL = np.array([-0.3, 0.08, 0.0, 0.0, 0.0])
QUICK = Config(search=SearchConfig(rounds=1, starts=64))


@pytest.fixture(scope="module")
def drive():
    made = RenderedDrive(seed=1, frames=4, rings=64, width=640, height=240, stride=30)
    return [made[k] for k in range(3)], made.reference


@pytest.fixture(scope="module")
def fisheye():
    made = open_dataset("synthetic:rig=os1_128_fisheye,scene=street,seed=3,frames=4,stride=30,width=640")
    return [made[k] for k in range(4)], made.reference


def checked(frames, camera, truth):
    return Checker(camera, QUICK).check([replace(frame, camera=camera) for frame in frames], truth)


def scaled(camera, focal, centre=1.0):
    """With other intrinsics; 0.5 and 0.5 are those of an image of half the size."""
    return replace(camera, K=camera.K * np.array([[focal, 1, centre], [1, focal, centre], [1, 1, 1]]))


@pytest.mark.parametrize(
    ("model", "D"),
    [
        ("plumb_bob", [-0.3, 0.08, 0.004, -0.006, 0.01]),
        ("rational_polynomial", [0.9, 0.1, 0.004, -0.003, 0.001, 1.2, 0.2, 0.01]),
        ("equidistant", [0.02, -0.004, 0.0008, -0.00015]),
    ],
)
def test_a_camera_turned_over_sees_a_turned_scene_upside_down(model, D):
    camera = Camera(np.array([[400.0, 0, 330], [0, 410.0, 110], [0, 0, 1]]), 640, 240, model, np.array(D))
    points = np.random.default_rng(0).uniform([-1, -0.4, 1], [1, 0.4, 3], (50, 3))
    upright = camera.project(points)[0]
    turned = turned_over(np.eye(4), camera).camera.project(points * [-1, -1, 1])[0]
    np.testing.assert_allclose(turned, [639, 239] - upright, atol=1e-6)


def test_guesses_about_cameras_with_and_without_a_distortion():
    K = np.array([[500.0, 0, 330], [0, 510.0, 120], [0, 0, 1]])
    straight, bent = Camera(K, 640, 240), Camera(K, 640, 240, D=BARREL)
    (fisheye,) = fisheyes(np.eye(4), straight)
    assert (fisheye.cause, fisheye.camera.model, fisheye.camera.is_pinhole) == (Cause.NOT_RECTIFIED, "equidistant", False)
    assert [*rectified_otherwise(np.eye(4), straight), *other_lenses(np.eye(4), bent), *fisheyes(np.eye(4), bent)] == []
    (rectified,) = rectified_otherwise(np.eye(4), bent)
    assert (rectified.cause, rectified.camera.is_pinhole) == (Cause.ALREADY_RECTIFIED, True)
    for camera, anew in ((straight, False), (bent, True)):
        made = list(resized(np.eye(4), camera, straight))
        assert {(guess.cause, guess.camera is not None) for guess in made} == {(Cause.OTHER_CAMERA, anew)}


@pytest.mark.parametrize("alpha", [0.0, 1.0])
def test_a_raw_picture_with_the_intrinsics_of_the_rectified_one_has_those_that_opencv_made_it_from(alpha):
    K, D = np.array([[1400.0, 0, 980], [0, 1400.0, 560], [0, 0, 1]]), np.array([-0.35, 0.12, 0.001, 0, 0])
    made = cv2.getOptimalNewCameraMatrix(K, D, (1920, 1080), alpha)[0]
    guesses = rectified_otherwise(np.eye(4), Camera(made, 1920, 1080, D=D))
    (found,) = (guess.camera.K for guess in guesses if guess.cause is Cause.OTHER_CAMERA)
    np.testing.assert_allclose(found, K, atol=1.0)


def test_raw_images_that_are_taken_for_rectified_are_to_be_taken_as_raw():
    camera = Camera(np.array([[500.0, 0, 330], [0, 510.0, 120], [0, 0, 1]]), 640, 240)
    for said, cure in ((True, "--no-rectified, or image_is_rectified: false to the node"), (False, "take the rectified topic")):
        own = replace(camera, said_rectified=said)
        guesses = *other_lenses(np.eye(4), own), *fisheyes(np.eye(4), own)
        found = [guess for guess in guesses if guess.cause is Cause.NOT_RECTIFIED]
        assert len(found) > 2
        assert all(cure in guess.message for guess in found)


@pytest.mark.parametrize(("count", "why"), [(1, "one frame does not tell"), (3, "all frames move alike")])
def test_what_is_not_known_of_the_clocks_comes_with_what_to_do(count, why):
    motion, result = MotionConfig(), Result(np.eye(4), CONVERGED)
    told, unknown = (
        clock_finding([SimpleNamespace(twist=own)] * count, result, 0.0, Tolerance(), motion) for own in (np.zeros(6), None)
    )
    assert told.message.endswith(f"{why}; {KNOW_CLOCKS}")
    assert unknown.message.endswith(UNKNOWN_MOTION)
    stated = clock_finding([], result, 0.0, Tolerance(), replace(motion, time_offset="fixed"))
    assert told.state is unknown.state is stated.state is CauseState.NOT_JUDGED
    assert "taken as stated" in stated.message


def test_intrinsics_of_half_the_image_size_are_named_with_the_factor(drive):
    frames, truth = drive
    result = checked(frames, scaled(frames[0].camera, 0.5, 0.5), truth)
    assert (result.verdict, result.cause) == (CheckVerdict.FAIL, Cause.OTHER_CAMERA), result.reason
    assert "scale fx, fy, cx and cy by 2" in result.reason


def test_a_distortion_of_a_rectified_image_is_named(drive):
    frames, truth = drive
    result = checked(frames, replace(frames[0].camera, D=BARREL), truth)
    assert (result.verdict, result.cause) == (CheckVerdict.FAIL, Cause.ALREADY_RECTIFIED), result.reason


@pytest.mark.slow
def test_a_distorted_camera_of_another_size_is_named(drive):
    frames, truth = drive
    lens = replace(frames[0].camera, D=BARREL)
    grid = np.stack(np.meshgrid(np.arange(lens.width), np.arange(lens.height)), axis=-1).reshape(-1, 1, 2).astype(np.float64)
    at = cv2.undistortPoints(grid, lens.K, lens.D, P=lens.K).reshape(lens.height, lens.width, 2).astype(np.float32)
    pictures = [replace(frame, image=cv2.remap(frame.image, at[..., 0], at[..., 1], cv2.INTER_LINEAR)) for frame in frames]
    assert checked(pictures, lens, truth).verdict is CheckVerdict.PASS
    result = checked(pictures, scaled(lens, 0.5, 0.5), truth)
    assert (result.verdict, result.cause) == (CheckVerdict.FAIL, Cause.OTHER_CAMERA), result.reason
    assert "scale fx, fy, cx and cy by 2" in result.reason


def test_a_principal_point_that_looks_like_a_rotation_is_possible(drive):
    frames, truth = drive
    K = np.add(frames[0].camera.K, [[0, 0, 20.0], [0, 0, 0], [0, 0, 0]])
    result = checked(frames, replace(frames[0].camera, K=K), truth)
    found = {finding.cause: finding for finding in result.causes}[Cause.PRINCIPAL_POINT]
    assert result.verdict is CheckVerdict.FAIL
    assert found.state in (CauseState.FOUND, CauseState.POSSIBLE)
    assert found.values["u_px"] == pytest.approx(-20.0, abs=6.0)
    assert "principal point" in result.reason


def test_a_lens_that_nobody_stated_makes_no_extrinsic_right(drive, monkeypatch):
    frames, truth = drive
    checker = Checker(scaled(frames[0].camera, 1.008), QUICK)
    features = [checker._calibrator.extract(replace(frame, camera=checker.camera)) for frame in frames]
    T = checker._calibrator.estimate(features, truth).T_camera_lidar
    lens = checker._judge.lens(checker._judge.score(features, T), T, 1.0, None)
    monkeypatch.setattr(checker, "_lens", lambda *_: (lens, None))
    result = checker.check_features(features, CheckInputs(lens.expected[1], Tolerance(0.5, 0.05)))
    found = {finding.cause: finding for finding in result.causes}[Cause.FOCAL_LENGTH]
    assert (result.verdict, found.state) == (CheckVerdict.INCONCLUSIVE, CauseState.POSSIBLE), result.reason
    assert f"or else {found.message}" in result.reason


@pytest.mark.slow
def test_wrong_intrinsics_of_a_fisheye_are_named(fisheye):
    """Its pictures are unrolled otherwise for each focal length."""
    frames, truth = fisheye
    camera = frames[0].camera
    right = checked(frames, camera, truth)
    assert right.verdict is CheckVerdict.PASS, right.reason
    longer = checked(frames, scaled(camera, 1.04), truth)
    assert longer.cause is Cause.FOCAL_LENGTH, longer.reason
    unrectified = checked(frames, Camera(camera.K, camera.width, camera.height), truth)
    assert unrectified.cause is Cause.NOT_RECTIFIED, unrectified.reason


def test_a_rotation_with_a_shift_is_no_principal_point(drive):
    frames, truth = drive
    result = checked(frames, frames[0].camera, se3.perturb(truth, [0, 2.0, 0], [0.3, 0, 0]))
    assert result.verdict is CheckVerdict.FAIL
    assert {finding.cause: finding.state for finding in result.causes}[Cause.PRINCIPAL_POINT] is CauseState.EXCLUDED
