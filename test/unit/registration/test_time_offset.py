"""The clocks' offset as the seventh unknown: found where motions differ, with the right extrinsic, refused where it is fixed, and
not made up elsewhere; and how scans without point times are stamped."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import QUICK, Scene, assert_not_used, driven

from calib_ros.config import Config, update
from calib_ros.frame import NANOSECONDS
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.estimate import check_offset
from calib_ros.registration.features import FeatureExtractor, at_time_offset
from calib_ros.registration.joint import Optimised, convention
from calib_ros.registration.judgement.clocks import Effect, TimeOffset, estimate_time_offset, scatter_gain
from calib_ros.registration.objective import FastScore
from calib_ros.registration.search.constraints import SearchBox, unlimited
from calib_ros.result import RefusalCode, Result, Stamping, parse

BOX = SearchBox(1.5, 0.15)
STRAIGHT = np.array([0, 0, 0, 8.0, 0, 0])  # 8 m/s along the LiDAR's x axis
ALIKE = [STRAIGHT] * 4
FIXED = {"motion": {"time_offset": "fixed"}}


def velocities(*turns_and_speeds: tuple[float, float]) -> list[np.ndarray]:
    return [np.array([0, 0, turn, speed, 0, 0]) for turn, speed in turns_and_speeds]


DIFFERENT = velocities((0.0, 8.0), (0.25, 4.0), (-0.25, 6.0), (0.0, 0.0))
FAST = velocities((0.0, 25.0), (0.6, 8.0), (-0.6, 12.0), (0.0, 0.0))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(seed=3, rings=32)


@pytest.fixture(scope="module")
def dense() -> Scene:
    return Scene(seed=3)


def estimated(scene: Scene, twists: list[np.ndarray], late_s: float = 0.0, box: SearchBox | None = BOX, **options) -> Result:
    calibrator = Calibrator(scene.camera, update(QUICK, options))
    return calibrator.estimate(driven(scene, twists, late_s), scene.truth, box)


# --- estimated ------------------------------------------------------------------------------------------------------------


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
    result = estimated(scene, twists, late_s, box)
    scene.assert_found(result)
    assert result.time_offset_s == pytest.approx(late_s, abs=0.003)
    assert abs(result.time_offset_s - late_s) < 2 * max(result.time_offset_sigma_s, 0.001)
    assert 0 < result.time_offset_sigma_s < 0.01


def test_clocks_that_agree_stay_as_they_are(scene):
    result, fixed = estimated(scene, DIFFERENT), estimated(scene, DIFFERENT, **FIXED)
    assert result.time_offset_s == 0.0
    assert 0 < result.time_offset_sigma_s < 0.005
    assert np.array_equal(result.T_camera_lidar, fixed.T_camera_lidar)
    assert fixed.time_offset_s is None


def test_the_offset_counts_from_the_configured_one_and_must_be_one_that_an_option_can_hold(scene):
    result = estimated(scene, DIFFERENT, 0.06, motion={"time_offset_s": 2.0})
    assert result.time_offset_s == pytest.approx(2.06, abs=0.003)
    assert estimated(scene, DIFFERENT, 0.06, motion={"time_offset_s": 59.98}).refusal is RefusalCode.WRONG_TIMES


@pytest.mark.parametrize("twists", [ALIKE, [np.zeros(6)] * 4], ids=["constant motion", "standing still"])
def test_what_cannot_be_observed_is_not_told(scene, twists):
    result = estimated(scene, twists)
    scene.assert_found(result)
    assert result.time_offset_s is None
    assert result.time_offset_sigma_s is None


def test_two_frames_are_too_few_and_motion_is_needed(scene):
    assert scene.quick.estimate(driven(scene, DIFFERENT, 0.06)[:2], scene.truth, BOX).time_offset_s is None
    score, free = FastScore(list(scene.features), scene.truth, QUICK.score), unlimited(scene.truth)
    assert estimate_time_offset(score, scene.truth, free, None, np.zeros((4, 6)), QUICK.motion, search=True) is None


def test_features_at_an_offset_are_those_of_that_configuration(scene):
    frame = replace(scene.frames[0], cloud_stamp=scene.frames[0].stamp, twist=np.array([0.01, -0.02, 0.3, 8.0, 0.5, 0.1]))
    shifted = FeatureExtractor(scene.camera, update(Config(), {"motion": {"time_offset_s": 0.05}}))(frame)
    moved = at_time_offset(FeatureExtractor(scene.camera)(frame), 0.05)
    assert np.allclose(shifted.points.xyz, moved.points.xyz, atol=1e-4)
    assert np.allclose(shifted.points.time, moved.points.time, atol=1e-6)
    late = FeatureExtractor(scene.camera)(replace(frame, stamp=frame.stamp - round(0.05 * NANOSECONDS)))
    assert np.allclose(late.points.xyz, moved.points.xyz, atol=1e-4)


def test_an_offset_that_cannot_be_reached_is_never_accepted_wrong(scene):
    result = estimated(scene, DIFFERENT, 0.6)
    assert not result.converged or scene.is_near(result.T_camera_lidar, 0.3, 0.05)  # as the frame at rest has it


@pytest.mark.parametrize(
    ("applied_s", "seconds", "sigma_s", "gain", "refused"),
    [
        # The features were moved by an offset that the frames do not show well enough to report, or that no option can hold.
        *((0.1, 0.1, 0.5, 1.0, True), (0.1, 0.1, 0.005, 1.0, False), (0.0, 0.0, 0.5, 1.0, False), (0.6, 0.6, 0.005, 1.0, True)),
        # Other clocks are suspected only within the range that is searched.
        *((0.0, 0.3, 0.1, 4.0, True), (0.0, 0.3, 0.1, 2.0, False), (0.0, 0.3, 0.005, 4.0, False), (0.0, 0.95, 0.1, 4.0, False)),
    ],
)
def test_an_extrinsic_at_other_clocks_is_refused(scene, applied_s, seconds, sigma_s, gain, refused):
    offset = TimeOffset(seconds, scene.truth, sigma_s, gain, Effect(np.zeros(6), 1 / sigma_s**2), 0.3, 1.0, 0.1)
    wrong = check_offset(Optimised([], None, scene.truth, None, offset, applied_s), Config().motion)
    assert (wrong is not None) == refused


# --- taken for granted ----------------------------------------------------------------------------------------------------


def along(scene: Scene, covariance: np.ndarray) -> float:
    """Standard deviation along the direction of travel, m."""
    forward = scene.truth[:3, :3] @ STRAIGHT[3:] / np.linalg.norm(STRAIGHT[3:])
    return float(np.sqrt(forward @ covariance[3:, 3:] @ forward))


@pytest.mark.parametrize(("late_s", "unknown"), [(0.05, False), (-0.05, False), (0.05, True)])
def test_clocks_that_disagree_are_refused_and_named(dense, late_s, unknown):
    """Also beside a frame of unknown motion."""
    features = driven(dense, DIFFERENT, late_s)
    features[3] = replace(features[3], twist=None if unknown else features[3].twist)
    result = Calibrator(dense.camera, update(QUICK, FIXED)).estimate(features, dense.truth, BOX)
    assert_not_used(result, dense.truth)
    assert result.refusal is RefusalCode.WRONG_TIMES
    assert f"stamped {'late' if late_s > 0 else 'early'}" in result.reason
    assert "motion.time_offset_s" in result.reason


def left_open(result):
    """Covariance (6, 6) of what the clocks may have done to an extrinsic unnoticed."""
    shift = result.clock_direction * result.clock_sigma_s
    return np.outer(shift, shift)


def test_clocks_that_cannot_be_told_are_left_to_the_covariance(dense):
    result = estimated(dense, ALIKE, box=None)
    assert along(dense, left_open(result)) > 0.35  # 50 ms at 8 m/s
    assert along(dense, result.shared_covariance) > 0.02  # 3 ms
    exact = {"motion": {"time_offset_sigma_s": 0.0}, "camera": {"focal_sigma": 0.0}}
    sharp = estimated(dense, ALIKE, box=None, **exact)
    assert np.allclose(sharp.covariance + result.shared_covariance, result.covariance)
    assert not sharp.shared_covariance.any()


def test_stamps_that_scatter_hide_an_offset_where_frames_hardly_differ_in_speed(dense):
    """A share of the speed by which frames differ is that of the scatter by which an offset moves them."""
    for share in (0.03, 0.2):
        shares = np.array([1.0, 1.0, -1.0, -1.0]) * share
        twists = np.array([STRAIGHT * (1 + own) for own in shares])
        score = FastScore(list(driven(dense, list(twists), 0.0)), dense.truth, QUICK.score, margin=1.0)
        gain = scatter_gain(score, dense.truth, twists, unlimited(dense.truth))
        assert gain == pytest.approx(1 / (4 * share**2), rel=0.5)
    turning = np.array(velocities((0.0, 8.0), (0.25, 8.0), (-0.25, 8.0), (0.0, 8.0)))
    score = FastScore(list(driven(dense, list(turning), 0.0)), dense.truth, QUICK.score, margin=1.0)
    assert scatter_gain(score, dense.truth, turning, unlimited(dense.truth)) < 2  # turns tell the clocks whatever the speed


@pytest.mark.parametrize("known", [{"sigma_m": [0.005] * 3}, {"limit_m": [0.02] * 3}])
def test_what_is_known_in_advance_is_not_left_open(dense, known):
    result = estimated(dense, ALIKE, box=None, constraints=known)
    assert np.sqrt(np.diag(left_open(result))[3:].max()) < 0.3  # 0.4 without
    assert np.sqrt(np.diag(result.shared_covariance)[3:].max()) < 0.025


# --- how scans are stamped ------------------------------------------------------------------------------------------------


MOVING = {"rings": 32, "speed": 8.0, "stride": 20, "ride": "weaving", "frames": 4}


@pytest.fixture(scope="module")
def end_of_the_scan() -> Scene:
    return Scene(seed=3, spin="counterclockwise", stamp_at="end", **MOVING)


def without_times(scene: Scene, extract: FeatureExtractor) -> list:
    return [extract(replace(f, cloud=replace(f.cloud, time=None))) for f in scene.frames]


def test_spin_and_stamp_are_found(end_of_the_scan):
    scene = end_of_the_scan
    result = scene.quick.estimate(without_times(scene, scene.quick.extract), scene.truth, BOX)
    scene.assert_found(result)
    found, left = convention(result.stamping, result.time_offset_s, 0.1)
    assert abs(left) < 0.003
    assert found == "motion.spin: counterclockwise, motion.stamp_at: end, motion.stamp_azimuth_deg: 180"
    assert parse(result.dumps(), "a file").stamping == result.stamping


@pytest.mark.parametrize(
    ("motion", "times", "right"),
    [
        ({"spin": "counterclockwise", "stamp_at": "end", "stamp_azimuth_deg": 180.0}, False, True),
        ({}, True, True),
        ({"stamping": "stated"}, False, False),
    ],
    ids=["right", "points have times", "stated, though wrong"],
)
def test_a_convention_is_left_alone_where_it_is(end_of_the_scan, motion, times, right):
    scene, calibrator = end_of_the_scan, Calibrator(end_of_the_scan.camera, update(QUICK, {"motion": motion}))
    features = [calibrator.extract(f) for f in scene.frames] if times else without_times(scene, calibrator.extract)
    result = calibrator.estimate(features, scene.truth, BOX)
    assert result.stamping is None
    if right:
        scene.assert_found(result)
        assert result.time_offset_s == 0.0


def test_the_recalibrator_moves_its_keyframes_to_the_convention(end_of_the_scan):
    scene = end_of_the_scan
    config = update(
        QUICK,
        {
            "search": {"rotation_deg": 1.5, "translation_m": 0.15},
            "online": {"min_keyframes": 4, "similarity_threshold": 1.0},
            "monitor": {"enabled": False},
        },
    )
    recalibrator = Recalibrator(scene.camera, scene.truth, config)
    for frame in scene.frames:
        recalibrator.ingest(replace(frame, cloud=replace(frame.cloud, time=None)))
    recalibrator.estimate()
    assert recalibrator.config.motion.spin == "counterclockwise"
    assert recalibrator.current.result.stamping == Stamping("counterclockwise", 0.0)
    expected = scene.calibrator.extract(scene.frames[0]).points.xyz
    moved = recalibrator.keyframes.features[0].points.xyz
    assert moved.shape == expected.shape
    assert np.median(np.abs(moved - expected)) < 0.005


@pytest.mark.parametrize(
    ("seconds", "expected", "left"),
    [(0.051, "start", 0.001), (-0.049, "end", 0.001), (0.003, "middle", 0.003), (0.12, "start", 0.07)],
)
def test_an_offset_of_half_a_scan_is_a_convention(seconds, expected, left):
    found, rest = convention(Stamping("clockwise", 0.0), seconds, 0.1)
    assert f"motion.stamp_at: {expected}," in found
    assert rest == pytest.approx(left, abs=1e-9)
    assert convention(Stamping("none", 0.0), seconds, 0.1)[1] == seconds
