"""Unknowns besides the extrinsic: what they do to it, and what the scenes tell of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import QUICK, Scene, assert_not_used, driven

from calib_ros import se3
from calib_ros.config import update
from calib_ros.registration.acceptance.refusal import WrongIntrinsics, WrongTimes
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.nuisance.lens import FocalLength
from calib_ros.registration.nuisance.parameters import estimate_parameters, wrong_parameter
from calib_ros.registration.nuisance.time_offset import ClockOffset
from calib_ros.registration.score.point_score import FastScore
from calib_ros.registration.search.constraints import SearchBox, unlimited
from calib_ros.result import RefusalCode

FIXED = update(QUICK, {"motion": {"time_offset": "fixed"}})
STRAIGHT = np.array([0, 0, 0, 8.0, 0, 0])  # 8 m/s along the LiDAR's x axis
DIFFERENT = [np.array([0, 0, turn, speed, 0, 0]) for turn, speed in ((0.0, 8.0), (0.25, 4.0), (-0.25, 6.0), (0.0, 0.0))]


@pytest.fixture(scope="module")
def moving_scene() -> Scene:
    return Scene(seed=3)


def optimum(scene: Scene, features: list[FrameFeatures]) -> tuple[FastScore, np.ndarray]:
    T = scene.quick.estimate(features, scene.truth).T_camera_lidar
    return FastScore(list(features), T, QUICK.score), T


def wrong(parameters: list[ClockOffset], score: FastScore, T: np.ndarray) -> WrongIntrinsics | WrongTimes | None:
    return wrong_parameter(estimate_parameters(parameters, score, T, unlimited(T), search=True), 0.5, 0.1)


def test_constant_motion_moves_the_optimum_and_tells_nothing_of_the_clocks(moving_scene):
    score, T = optimum(moving_scene, driven(moving_scene, [STRAIGHT] * 4))
    effect = ClockOffset(0.05, np.array([STRAIGHT] * 4)).effect(score, T, unlimited(T))
    assert effect.sigma(0.05) > 0.04
    forward = T[:3, :3] @ STRAIGHT[3:]  # points ahead come nearer by the vehicle's way
    assert np.allclose(effect.direction[3:], -forward, atol=0.3)
    assert np.abs(effect.direction[:3]).max() < np.deg2rad(1.0)
    assert np.sqrt(effect.covariance(0.05).trace()) > 0.3


def test_different_motions_tell_of_the_clocks(moving_scene):
    score, T = optimum(moving_scene, driven(moving_scene, DIFFERENT))
    effect = ClockOffset(0.05, np.array(DIFFERENT)).effect(score, T, unlimited(T))
    assert effect.sigma(0.05) < 0.01
    assert effect.sigma(0.0) == 0.0
    assert wrong([ClockOffset(0.003, np.array(DIFFERENT))], score, T) is None
    assert not ClockOffset(0.05, np.zeros((4, 6))).effect(score, T, unlimited(T)).covariance(0.05).any()  # without motion


@pytest.mark.parametrize("late_s", [0.05, -0.05])
def test_clocks_that_disagree_are_refused_and_named(moving_scene, late_s):
    features = driven(moving_scene, DIFFERENT, late_s)
    result = Calibrator(moving_scene.camera, FIXED).estimate(features, moving_scene.truth, SearchBox(1.5, 0.15))
    assert_not_used(result, moving_scene.truth)
    assert result.refusal is RefusalCode.WRONG_TIMES
    assert f"stamped {'late' if late_s > 0 else 'early'}" in result.reason
    assert "motion.time_offset_s" in result.reason


def test_clocks_that_cannot_be_told_are_left_to_the_covariance(moving_scene):
    features = driven(moving_scene, [STRAIGHT] * 4)
    result = moving_scene.quick.estimate(features, moving_scene.truth)
    forward = moving_scene.truth[:3, :3] @ STRAIGHT[3:] / np.linalg.norm(STRAIGHT[3:])
    assert np.sqrt(forward @ result.clock_covariance[3:, 3:] @ forward) > 0.35  # 50 ms at 8 m/s
    assert np.sqrt(forward @ result.shared_covariance[3:, 3:] @ forward) > 0.02  # 3 ms
    exact = update(QUICK, {"motion": {"time_offset_sigma_s": 0.0}, "camera": {"focal_sigma": 0.0, "centre_sigma": 0.0}})
    sharp = Calibrator(moving_scene.camera, exact).estimate(features, moving_scene.truth)
    assert np.allclose(sharp.covariance + result.shared_covariance, result.covariance)
    assert not sharp.shared_covariance.any()


@pytest.mark.parametrize("speed", [2.0, 25.0])
def test_however_fast_it_is_the_clocks_are_not_known_from_constant_motion(moving_scene, speed):
    twist = STRAIGHT * speed / 8.0
    result = moving_scene.quick.estimate(driven(moving_scene, [twist] * 4), moving_scene.truth)
    forward = moving_scene.truth[:3, :3] @ STRAIGHT[3:] / np.linalg.norm(STRAIGHT[3:])
    assert np.sqrt(forward @ result.clock_covariance[3:, 3:] @ forward) == pytest.approx(0.05 * speed, rel=0.1)
    assert result.clock_sigma_s > 0.04


def test_what_is_known_in_advance_is_not_left_open(moving_scene):
    features = driven(moving_scene, [STRAIGHT] * 4)
    for known in ({"sigma_m": [0.005] * 3}, {"limit_m": [0.02] * 3}):
        held = Calibrator(moving_scene.camera, update(QUICK, {"constraints": known}))
        result = held.estimate(features, moving_scene.truth)
        assert np.sqrt(np.diag(result.clock_covariance)[3:].max()) < 0.3  # 0.4 without
        assert np.sqrt(np.diag(result.shared_covariance)[3:].max()) < 0.025


def test_frames_of_unknown_motion_do_not_hide_the_clocks(moving_scene):
    features = driven(moving_scene, DIFFERENT, 0.05)
    features[3] = replace(features[3], twist=None)
    result = Calibrator(moving_scene.camera, FIXED).estimate(features, moving_scene.truth, SearchBox(1.5, 0.15))
    assert result.refusal is RefusalCode.WRONG_TIMES


@pytest.mark.parametrize("late_s", [0.05, 0.1])
def test_the_offset_is_named_rightly_at_speed(moving_scene, late_s):
    twists = [np.array([0, 0, turn, 20.0 * share, 0, 0]) for turn, share in ((0.0, 1.0), (0.1, 0.9), (-0.1, 0.95), (0.0, 0.85))]
    T = moving_scene.truth @ se3.exp(twists[0] * late_s)  # where its search would end
    score = FastScore(list(driven(moving_scene, twists, late_s)), T, QUICK.score, margin=1.0)
    refusal = wrong([ClockOffset(0.003, np.array(twists))], score, T)
    assert refusal is not None
    assert refusal.seconds == pytest.approx(late_s, abs=0.01)


def test_another_focal_length_moves_the_camera_along_its_view(moving_scene):
    score, T = optimum(moving_scene, moving_scene.features)
    effect = FocalLength(0.01).effect(score, T, unlimited(T))
    assert effect.direction[5] > 2.0  # m for the whole of it: edges are 5 to 30 m away
    assert abs(effect.direction[5]) > 3 * np.abs(effect.direction[3:5]).max()
    assert 0.0 < effect.sigma(0.01) < 0.005
    fixed = replace(unlimited(T), half=np.array([np.inf] * 5 + [0.0]))
    assert FocalLength(0.01).effect(score, T, fixed).direction[5] == pytest.approx(0.0, abs=1e-3)
