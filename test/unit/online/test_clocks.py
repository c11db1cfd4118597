"""What the recalibrator does with an estimated time offset: keyframes, configuration, reset, and a start from a saved state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import QUICK, Scene

from calib_ros.config import Config, update
from calib_ros.lidar.deskew import moved
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.online.tracker import Tracker
from calib_ros.result import CONVERGED, INITIAL, Result, Stamping, parse

LATE_S = 0.06
TWISTS = [np.array([0, 0, turn, speed, 0, 0]) for turn, speed in ((0.0, 8.0), (0.25, 4.0), (-0.25, 6.0), (0.0, 2.0))]
CONFIG = update(
    QUICK,
    {
        "search": {"rotation_deg": 1.5, "translation_m": 0.15},
        "online": {"min_keyframes": 4, "similarity_threshold": 1.0},
        "monitor": {"enabled": False},
        "tracker": {"confirmations": 5},
    },
)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(seed=3)


def recalibrated(scene: Scene, config: Config = CONFIG) -> Recalibrator:
    """After one estimate from keyframes whose images are stamped late."""
    recalibrator = Recalibrator(scene.camera, scene.truth, config)
    for frame, twist in zip(scene.frames, TWISTS, strict=True):
        xyz = moved(frame.cloud.xyz, twist, np.full(len(frame.cloud), -LATE_S)).astype(np.float32)
        cloud = replace(frame.cloud, xyz=xyz, time=None)
        recalibrator.ingest(replace(frame, cloud=cloud, cloud_stamp=frame.stamp, twist=twist, compensated=True))
    assert recalibrator.ready()
    recalibrator.estimate()
    return recalibrator


def test_the_offset_is_used_and_saved_until_another_one_or_a_reset_replaces_it(scene):
    found = recalibrated(scene)
    result = found.current.result
    assert scene.is_near(result.T_camera_lidar, 0.15, 0.03)
    learnt = result.time_offset_s
    assert learnt == pytest.approx(LATE_S, abs=0.003)
    assert found.config.motion.time_offset_s == found.motion.config.time_offset_s == learnt
    assert len(found.keyframes) == 4
    truth = scene.calibrator.extract(scene.frames[0]).points.xyz
    assert np.abs(found.keyframes.features[0].points.xyz - truth).max() < 0.05  # 48 cm off before
    later = found.estimate().result
    assert later.time_offset_s == learnt
    assert scene.is_near(later.T_camera_lidar, 0.15, 0.03)

    found.configure(update(CONFIG, {"online": {"min_keyframes": 3}}))  # other parameters leave it alone
    assert (found.config.motion.time_offset_s, len(found.keyframes)) == (learnt, 4)
    found.configure(update(CONFIG, {"motion": {"max_time_offset_s": 0.06}}))  # those of the motion, too: the mount has not moved
    assert found.config.motion.time_offset_s == learnt
    assert found.config.motion.time_offset_sigma_s >= CONFIG.motion.time_offset_sigma_s  # by which stamps scatter
    saved = parse(replace(found.current.result, status=CONVERGED).dumps(), "a state")
    assert saved.time_offset_s == learnt
    assert saved.time_offset_sigma_s is not None
    found.reset()
    assert found.config.motion.time_offset_s == 0.0
    assert found.current.result.time_offset_s is None

    again = Recalibrator(scene.camera, saved, CONFIG)
    assert again.config.motion.time_offset_s == learnt
    again.configure(update(CONFIG, {"online": {"min_keyframes": 3}}))
    assert again.config.motion.time_offset_s == learnt
    assert again.ingest(scene.frames[0])
    again.configure(update(CONFIG, {"motion": {"time_offset_s": 0.01}}))
    assert (again.config.motion.time_offset_s, len(again.keyframes)) == (0.01, 0)


def test_a_fixed_offset_is_not_replaced(scene):
    fixed = recalibrated(scene, config=update(CONFIG, {"motion": {"time_offset": "fixed"}}))
    assert fixed.config.motion.time_offset_s == 0.0
    assert not fixed.current.result.converged


@pytest.mark.parametrize("value", ["soon", float("nan"), [0.1]])
def test_a_saved_offset_must_be_a_number(value):
    text = Result(np.eye(4), INITIAL).dumps(yaml_format=True).replace("time_offset_s: null", f"time_offset_s: {value}")
    with pytest.raises(Exception, match="time_offset_s must be numbers"):
        parse(text, "a file")


def estimate(x: float, offset: float | None = None) -> Result:
    T = np.eye(4)
    T[0, 3] = x
    sigma = None if offset is None else 0.002
    spread = np.diag([1e-8] * 3 + [1e-6] * 3)
    return Result(T, CONVERGED, covariance=spread, frames_used=5, time_offset_s=offset, time_offset_sigma_s=sigma)


def tracked(*estimates: Result, confirmations: int = 5) -> Tracker:
    tracker = Tracker(Result(np.eye(4), INITIAL), config=update(Config(), {"tracker": {"confirmations": confirmations}}))
    for new in estimates:
        tracker.update(new)
    return tracker


@pytest.mark.parametrize(
    ("confirmations", "before", "then", "x", "offset"),
    [
        (5, [estimate(0.4)] * 2, estimate(0.0, 0.08), 0.0, 0.08),  # what nothing has confirmed gives way
        (0, [estimate(0.0, 0.0)] * 3, estimate(0.4, 0.08), 0.0, 0.0),  # what is confirmed does not jump
        (5, [estimate(0.0, 0.0)], estimate(0.0), 0.0, 0.0),  # what is known outlasts frames that do not show it
    ],
)
def test_an_estimate_at_another_offset(confirmations, before, then, x, offset):
    extrinsic = tracked(*before, then, confirmations=confirmations).current
    assert extrinsic.result.T_camera_lidar[0, 3] == pytest.approx(x, abs=1e-6)
    assert extrinsic.result.time_offset_s == offset
    assert extrinsic.usable is (confirmations == 0)


def test_offsets_that_differ_by_their_noise_are_the_same_clocks():
    assert tracked(*(estimate(0.0, 0.001 * (k % 2)) for k in range(6)), confirmations=0).settled


AHEAD_M_S = 4.0  # how fast the points that are measured later move the extrinsic back


def alike(x: float, offset: float, sigma: float = 0.016) -> Result:
    """An estimate where all frames move at one speed: the extrinsic could be elsewhere with other clocks."""
    T, direction = np.eye(4), np.array([0.0, 0.0, 0.0, -AHEAD_M_S, 0.0, 0.0])
    T[0, 3] = x - AHEAD_M_S * offset
    clocks = {"time_offset_s": offset, "time_offset_sigma_s": sigma, "clock_sigma_s": sigma, "clock_direction": direction}
    spread, shared = np.diag([1e-5] * 3 + [1e-4] * 3), np.zeros((6, 6))
    shared[3, 3] = (AHEAD_M_S * sigma) ** 2
    return Result(T, CONVERGED, covariance=spread + shared, shared_covariance=shared, frames_used=5, **clocks)


def followed(tracker: Tracker, *estimates: Result, share_new: float = 0.2) -> Tracker:
    for new in estimates:
        known = tracker.update(new, share_new).result
        tracker.config = update(tracker.config, {"motion": {"time_offset_s": known.time_offset_s}})
    return tracker


@pytest.mark.parametrize("before", [2, 5])  # the second agrees with the first; an estimate over new keyframes alone is searched
def test_what_one_estimate_takes_for_a_late_image_and_another_for_a_shift_is_no_movement(before):
    tracker = followed(tracked(confirmations=0), *[alike(0.0, 0.0)] * before)
    for offset in (-0.039, 0.0, -0.026, 0.03) * 3:  # 16 cm from one to the next
        followed(tracker, alike(0.01, offset))
        known = tracker.current.result
        assert (known.status, tracker.settled) == (CONVERGED, True)
        at_none = known.T_camera_lidar[0, 3] + AHEAD_M_S * known.time_offset_s
        assert at_none == pytest.approx(0.0, abs=0.012)
        assert abs(known.time_offset_s) < 0.016
    assert known.time_offset_sigma_s < 0.01  # each of them has told something
    followed(tracker, alike(0.6, 0.0))  # another mount moves at any clock
    assert not tracker.current.result.converged


def test_an_offset_that_estimates_agree_on_is_followed_with_the_extrinsic():
    tracker = followed(tracked(confirmations=0), *[alike(0.0, 0.0)] * 2)
    followed(tracker, *[alike(0.0, -0.02, 0.011)] * 40)
    known = tracker.current.result
    assert known.time_offset_s == pytest.approx(-0.02, abs=0.003)
    assert known.T_camera_lidar[0, 3] == pytest.approx(-AHEAD_M_S * known.time_offset_s, abs=1e-6)
    tracker.update(alike(0.0, 0.05, 0.002))  # clearly other clocks
    assert tracker.current.result.time_offset_s == 0.05


@pytest.mark.parametrize(
    "changed",
    [
        {"motion": {"time_offset": "fixed"}},
        {"motion": {"max_time_offset_s": 0.0}},
        {"refine": {"objective": "thesis"}},
        {"motion": {"stamping": "stated"}},
    ],
    ids=["fixed", "triggered together", "thesis", "stated"],
)
def test_a_saved_offset_is_not_used_where_none_is_estimated(scene, changed):
    saved = replace(estimate(0.0, 0.05), T_camera_lidar=scene.truth, stamping=Stamping("counterclockwise", 180.0))
    recalibrator = Recalibrator(scene.camera, saved, update(CONFIG, changed))
    assert recalibrator.config.motion.time_offset_s == 0.0
    assert recalibrator.config.motion.spin == "clockwise"
    assert recalibrator.current.result.time_offset_s is None
    assert Recalibrator(scene.camera, saved, CONFIG).config.motion.spin == "counterclockwise"
