"""How scans without point times are stamped: found from the scenes, with the right extrinsic, and told in the usual words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import QUICK, Scene

from calib_ros.config import update
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import FeatureExtractor
from calib_ros.registration.joint import convention
from calib_ros.registration.search.constraints import SearchBox
from calib_ros.result import Stamping, parse

BOX = SearchBox(1.5, 0.15)
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
