"""The clocks' offset as the seventh unknown: found where motions differ, with the right extrinsic, and not made up elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import QUICK, Scene, driven

from calib_ros import se3
from calib_ros.config import Config, update
from calib_ros.frame import NANOSECONDS
from calib_ros.registration.acceptance.checks import Acceptance
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import FeatureExtractor, at_time_offset
from calib_ros.registration.joint import Optimised
from calib_ros.registration.nuisance.parameters import Effect
from calib_ros.registration.nuisance.time_offset import TimeOffset, estimate_time_offset, linearise
from calib_ros.registration.score.point_score import FastScore
from calib_ros.registration.search.constraints import SearchBox, unlimited
from calib_ros.result import RefusalCode

BOX = SearchBox(1.5, 0.15)
DIFFERENT = [np.array([0, 0, turn, speed, 0, 0]) for turn, speed in ((0.0, 8.0), (0.25, 4.0), (-0.25, 6.0), (0.0, 0.0))]
ALIKE = [np.array([0, 0, 0, 8.0, 0, 0])] * 4


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(seed=3, rings=32)


FAST = [np.array([0, 0, turn, speed, 0, 0]) for turn, speed in ((0.0, 25.0), (0.6, 8.0), (-0.6, 12.0), (0.0, 0.0))]


@pytest.mark.parametrize(
    ("late_s", "twists", "box"),
    [
        (-0.1, DIFFERENT, BOX),
        pytest.param(0.03, DIFFERENT, None, id="by a refinement"),
        pytest.param(0.1, FAST, BOX, id="hides the match"),
        pytest.param(-0.3, DIFFERENT, BOX, id="beyond the usual range"),
        pytest.param(0.45, DIFFERENT, BOX, id="far beyond it", marks=pytest.mark.slow),
    ],
)
def test_an_offset_is_found_with_the_extrinsic(scene, late_s, twists, box):
    result = scene.quick.estimate(driven(scene, twists, late_s), scene.truth, box)
    scene.assert_found(result)
    assert result.time_offset_s == pytest.approx(late_s, abs=0.003)
    assert abs(result.time_offset_s - late_s) < 2 * max(result.time_offset_sigma_s, 0.001)
    assert 0 < result.time_offset_sigma_s < 0.01


def test_clocks_that_agree_stay_as_they_are(scene):
    features = driven(scene, DIFFERENT)
    result = scene.quick.estimate(features, scene.truth, BOX)
    fixed = Calibrator(scene.camera, update(QUICK, {"motion": {"time_offset": "fixed"}})).estimate(features, scene.truth, BOX)
    assert result.time_offset_s == 0.0
    assert 0 < result.time_offset_sigma_s < 0.005
    assert np.array_equal(result.T_camera_lidar, fixed.T_camera_lidar)
    assert fixed.time_offset_s is None


def test_the_offset_counts_from_the_configured_one(scene):
    known = Calibrator(scene.camera, update(QUICK, {"motion": {"time_offset_s": 0.2}}))
    result = known.estimate(driven(scene, DIFFERENT, 0.06), scene.truth, BOX)
    assert result.time_offset_s == pytest.approx(0.26, abs=0.003)


@pytest.mark.parametrize("twists", [ALIKE, [np.zeros(6)] * 4], ids=["constant motion", "standing still"])
def test_what_cannot_be_observed_is_not_told(scene, twists):
    result = scene.quick.estimate(driven(scene, twists), scene.truth, BOX)
    scene.assert_found(result)
    assert result.time_offset_s is None
    assert result.time_offset_sigma_s is None


def test_two_frames_are_too_few(scene):
    result = scene.quick.estimate(driven(scene, DIFFERENT, 0.06)[:2], scene.truth, BOX)
    assert result.time_offset_s is None


def test_the_derivative_is_that_of_the_score(scene):
    features = driven(scene, DIFFERENT, 0.02)
    twists, T = np.array(DIFFERENT), scene.off(([0.2, -0.1, 0.1], [0.02, 0.01, -0.02]))
    score = FastScore(list(features), T, QUICK.score)
    level, h = 1, 2e-4  # maps smooth enough for differences
    gradient, outer = linearise(score, T, twists, level)
    later, earlier = (score.moved(twists, x).at(level).value(T) for x in (h, -h))
    assert gradient[6] == pytest.approx((later - earlier) / (2 * h), rel=0.25)  # maps have their slopes over two pixels
    assert np.allclose(gradient[:6], score.at(level).linearise(T)[0], rtol=1e-4, atol=1e-6)
    assert np.linalg.eigvalsh(outer).min() > 0
    alike = linearise(score, T, np.array(ALIKE), level)[0]
    assert alike[6] == pytest.approx(gradient[:6] @ se3.adjoint(T) @ ALIKE[0], rel=1e-4)


def test_without_motion_nothing_is_estimated(scene):
    score = FastScore(list(scene.features), scene.truth, QUICK.score)
    twists = np.zeros((4, 6))
    assert estimate_time_offset(score, scene.truth, unlimited(scene.truth), None, twists, QUICK.motion, search=True) is None


def test_features_at_an_offset_are_those_of_that_configuration(scene):
    frame = replace(scene.frames[0], cloud_stamp=scene.frames[0].stamp, twist=np.array([0.01, -0.02, 0.3, 8.0, 0.5, 0.1]))
    shifted = FeatureExtractor(scene.camera, update(Config(), {"motion": {"time_offset_s": 0.05}}))(frame)
    moved = at_time_offset(FeatureExtractor(scene.camera)(frame), 0.05)
    assert np.allclose(shifted.points.xyz, moved.points.xyz, atol=1e-4)
    assert np.allclose(shifted.points.time, moved.points.time, atol=1e-6)
    late = FeatureExtractor(scene.camera)(replace(frame, stamp=frame.stamp - round(0.05 * NANOSECONDS)))
    assert np.allclose(late.points.xyz, moved.points.xyz, atol=1e-4)


def test_an_offset_that_cannot_be_reached_is_never_accepted_wrong(scene):
    result = scene.quick.estimate(driven(scene, DIFFERENT, 0.6), scene.truth, BOX)
    assert not result.converged or scene.is_near(result.T_camera_lidar, 0.3, 0.05)  # as the frame at rest has it


def test_an_offset_that_no_option_can_hold_is_refused(scene):
    far = Calibrator(scene.camera, update(QUICK, {"motion": {"time_offset_s": 0.48}}))
    result = far.estimate(driven(scene, DIFFERENT, 0.06), scene.truth, BOX)
    assert result.refusal is RefusalCode.WRONG_TIMES


@pytest.mark.parametrize(
    ("applied_s", "sigma_s", "refused"), [(0.1, 0.5, True), (0.1, 0.005, False), (0.0, 0.5, False), (0.6, 0.005, True)]
)
def test_an_extrinsic_at_clocks_that_nobody_is_told_of_is_refused(scene, applied_s, sigma_s, refused):
    """The features were moved by an offset that the frames do not show well enough to report it, or that no option can hold."""
    effect = Effect(np.zeros(6), 1 / sigma_s**2)
    offset = TimeOffset(applied_s, scene.truth, sigma_s, 1.0, effect, 0.3, 1.0, 0.1)
    found = Optimised([], None, scene.truth, None, offset, applied_s)
    wrong = Acceptance(Config(), 640, None)._check_offset(found)
    assert (wrong is not None) == refused
    assert wrong is None or wrong.seconds == applied_s
