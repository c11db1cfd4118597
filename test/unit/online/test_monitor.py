"""The monitor detects miscalibration on small scenes whose extrinsic is known; likelihood ratios mean what they say."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scenes import SIZE, RenderedDrive, Scene
from scipy.stats import multivariate_t

from calib_ros import se3
from calib_ros.config import Config, ConstraintsConfig, MonitorConfig
from calib_ros.lidar.edges import EdgePoints
from calib_ros.online import monitor as monitor_module
from calib_ros.online.evidence import MIN_REMEMBERED, REMEMBERED, MatchEvidence, ShiftNoise, shift_evidence
from calib_ros.online.monitor import (
    CONFIRM,
    TESTS_PER_HOUR,
    Assessment,
    Monitor,
    ShiftTest,
    Verdict,
    clock_covariance,
    measure_shift,
)
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.search.constraints import pose_constraints

SMALL = {"width": 480, "height": 180}
FRAMES = 10
EXACT = np.zeros((6, 6))
DISPLACEMENT = ([0.9, 1.5, -0.9], [0.03, -0.03, 0.02])  # 2 deg / 5 cm
HALF_DEG = ([0.35, -0.3, 0.25], [0, 0, 0])
CONFIG = MonitorConfig()


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(1, frames=FRAMES, **SMALL)


@pytest.fixture(scope="module")
def displaced(scene) -> list[FrameFeatures]:
    """The second half of the same street, seen by a camera that is displaced by DISPLACEMENT."""
    drive = RenderedDrive(seed=1, frames=FRAMES, **{**SIZE, **SMALL})
    assert np.array_equal(drive.reference, scene.truth)
    return [scene.calibrator.extract(drive.moved(k, scene.off(DISPLACEMENT))) for k in range(5, FRAMES)]


def without_edges(f: FrameFeatures) -> FrameFeatures:
    return replace(f, points=EdgePoints(np.zeros((0, 3), np.float32), np.zeros(0, np.float32), np.zeros(0, np.uint8)))


class Drive:
    """A monitor with its keyframes, fed one by one; the first `known` ones at the true extrinsic."""

    def __init__(self, scene: Scene, config: MonitorConfig = CONFIG, known: int = 0) -> None:
        self.scene, self.monitor = scene, Monitor(config)
        self.keyframes: list[FrameFeatures] = []
        assert self.verdicts(scene.features[:known], scene.truth) == [Verdict.CONSISTENT] * known

    def check(self, f: FrameFeatures, T: np.ndarray) -> Assessment:
        self.keyframes.append(f)
        return self.monitor.check(self.scene.calibrator, self.keyframes, T, EXACT)

    def verdicts(self, features: list[FrameFeatures], T: np.ndarray) -> list[Verdict]:
        return [self.check(f, T).verdict for f in features]


# --- one test -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 5])
def test_right_extrinsic_is_confirmed(scene, n):
    """The p value of a right extrinsic is no rarity: the noise that it is weighed with is not too small."""
    tests = [measure_shift(scene.calibrator, scene.features[k : k + n], scene.truth) for k in range(FRAMES - n + 1)]
    assert all(t.conclusive for t in tests)
    assert min(t.p_value for t in tests) > 0.01
    assert np.median([t.p_value for t in tests]) > 0.2
    assert max(t.evidence for t in tests) < 0
    assert max(t.deg for t in tests) < (0.6 if n == 1 else 0.15)
    assert min(t.z_score for t in tests) > 3


@pytest.mark.parametrize(
    ("by", "deg", "m"),
    [(HALF_DEG, 0.52, 0.0), (([0, 0, 0], [0.06, -0.05, 0.06]), 0.0, 0.1), (([1.2, 1.2, 1.0], [0, 0, 0]), 1.97, 0.0)],
    ids=["0.5 deg", "10 cm", "2 deg"],
)
def test_wrong_extrinsic_is_detected(scene, by, deg, m):
    """By five keyframes, each time, and told how wrong."""
    for k in range(0, FRAMES - 4, 2):
        found = measure_shift(scene.calibrator, scene.features[k : k + 5], scene.off(by))
        assert found.conclusive
        assert found.evidence > np.log(TESTS_PER_HOUR / CONFIG.false_alarms_per_hour)
        assert found.deg == pytest.approx(deg, abs=0.2)
        assert found.m == pytest.approx(m, abs=0.04)
        back = se3.exp(found.shift) @ scene.off(by)
        assert scene.is_near(back, 0.15, 0.04)


def test_uncertain_keyframes_do_not_contradict(scene):
    """0.5 deg off, and known no better than 0.5 deg."""
    unsure = np.diag(np.r_[[np.deg2rad(0.5)] * 3, [0.02] * 3] ** 2)
    sure, weighed = (measure_shift(scene.calibrator, scene.features[:5], scene.off(HALF_DEG), s) for s in (None, unsure))
    assert np.array_equal(sure.shift, weighed.shift)
    assert sure.p_value < 1e-4
    assert weighed.p_value > 0.1


def test_empty_scene_is_inconclusive(scene):
    empty = without_edges(scene.features[0])
    test = measure_shift(scene.calibrator, [empty], scene.off(DISPLACEMENT))
    assert (test.p_value, test.conclusive, test.z_score, test.shift.any()) == (1.0, False, 0.0, False)
    drive = Drive(scene)
    assert drive.check(empty, scene.off(DISPLACEMENT)).verdict == Verdict.INCONCLUSIVE
    # Not even beside scenes that tell something: these decide.
    assert drive.check(scene.features[1], scene.truth).verdict == Verdict.CONSISTENT


def test_fixed_axes_are_not_tested(scene):
    """The user has fixed a shift that is wrong by 8 cm: all estimates agree with it, and so must the monitor."""
    off = se3.exp(np.array([0, 0, 0, 0, 0.08, 0])) @ scene.truth
    config = replace(Config(), constraints=ConstraintsConfig(limit_m=(100.0, 0.0, 100.0)))
    calibrator = Calibrator(scene.camera, config)
    estimate = calibrator.estimate(scene.features[:5], off)
    assert estimate.converged, estimate.reason
    T = estimate.T_camera_lidar
    free, fixed = (measure_shift(calibrator, scene.features[:5], T, anchor=anchor) for anchor in (None, off))
    assert free.p_value < 1e-3
    assert fixed.p_value > 0.1
    assert pose_constraints(off, config.constraints, 5).limits.half[4] == 0
    assert abs(fixed.shift[4]) < 1e-4
    displaced = se3.exp(np.array([0, np.deg2rad(2), 0, 0, 0, 0])) @ T
    assert measure_shift(calibrator, scene.features[:5], displaced, anchor=off).p_value < 1e-4


# --- over time ------------------------------------------------------------------------------------------------------------


def test_mount_displacement_is_suspect_at_once_and_confirmed_soon(scene, displaced):
    drive = Drive(scene, known=5)
    for k, (verdict, text) in enumerate(
        (
            (Verdict.SUSPECT, "^the newest keyframe "),  # the four before it are still right
            (Verdict.SUSPECT, "^the newest 2 keyframes "),
            (Verdict.MOVED, "the newest 3 keyframes "),
        )
    ):
        found = drive.check(displaced[k], scene.truth)
        assert (found.verdict, found.since) == (verdict, 1 + k)
        assert re.search(text, found.message)
        assert found.p_value < 1e-3
    assert found.since == CONFIRM
    # The extrinsic is replaced, and the keyframes from before are dropped.
    drive.monitor.reset()
    drive.keyframes = drive.keyframes[-found.since :]
    assert drive.verdicts(displaced[3:], scene.off(DISPLACEMENT)) == [Verdict.CONSISTENT] * 2


def test_small_displacement_is_detected_by_several_keyframes(scene):
    """0.5 deg: the window finds it, one way or the other, and it is confirmed."""
    verdicts = Drive(scene, known=3).verdicts(scene.features[3:9], scene.off(HALF_DEG))
    assert Verdict.SUSPECT in verdicts[:3]
    assert Verdict.MOVED in verdicts


def test_single_outlier_keyframe_raises_no_alarm(scene):
    """A scan with another street's image leaves doubt, until the next ones."""
    odd = replace(scene.features[5], levels=Scene(2, frames=1, **SMALL).features[0].levels)
    drive = Drive(scene, known=5)
    assert drive.check(odd, scene.truth).verdict == Verdict.INCONCLUSIVE
    assert drive.monitor.in_doubt
    assert drive.verdicts(scene.features[6:9], scene.truth)[-1] == Verdict.CONSISTENT
    assert not drive.monitor.in_doubt


def test_a_small_shift_counts_only_while_the_motion_during_the_scan_is_known(scene):
    unknown = [replace(f, unknown_motion_s=0.05) for f in scene.features]
    assert not {Verdict.SUSPECT, Verdict.MOVED} & set(Drive(scene).verdicts(unknown, scene.off(HALF_DEG)))


def test_a_chance_optimum_does_not_speak_against_an_extrinsic(scene):
    """An empty road: the refinement ends somewhere, and claims to know it."""
    found = ShiftTest(1e-6, np.array([0, 0, 0, 0, 0, 0.5]), 8.0, True, evidence=20.0)
    told = [Monitor(CONFIG)._evidence(replace(found, significant=own), scene.features[:1]) for own in (True, False)]
    assert told == [20.0, 0.0]


def test_the_rate_of_false_alarms_is_the_threshold(scene, monkeypatch):
    """0.1 deg off: what one rate calls suspect is no evidence at another."""
    off = scene.off(([0.0, 0.09, 0.03], [0.006, 0, 0]))
    evidence = measure_shift(scene.calibrator, scene.features[:5], off).evidence
    verdicts = []
    monkeypatch.setattr(monitor_module, "LEAST_DEG", 0.01)
    for beside in (-1.0, 1.0):
        rate = TESTS_PER_HOUR / np.exp(evidence + beside)
        m = Monitor(replace(CONFIG, false_alarms_per_hour=float(rate)))
        verdicts.append(m.check(scene.calibrator, scene.features[:5], off, EXACT).verdict)
    assert verdicts == [Verdict.SUSPECT, Verdict.INCONCLUSIVE]


def poor(f) -> FrameFeatures:
    """A keyframe that shows a thirtieth of its edges."""
    return replace(f, points=f.points.select(np.arange(0, len(f.points), 30)))


def test_keyframes_that_show_next_to_nothing_take_no_part(scene):
    empty = [poor(f) for f in scene.features[:4]]
    drive = Drive(scene)
    keyframes = [*empty, *scene.features[4:6]]
    assert drive.monitor.informative(keyframes, scene.truth) == keyframes  # it is not known yet what is usual
    assert drive.verdicts(scene.features[:4], scene.truth) == [Verdict.CONSISTENT] * 4
    assert drive.monitor.informative(keyframes, scene.truth) == scene.features[4:6]
    assert drive.verdicts(empty, scene.truth) == [Verdict.CONSISTENT] * 4  # by the others of the window
    assert drive.verdicts(empty, scene.truth)[-1] == Verdict.INCONCLUSIVE
    # Of a scanner that never shows more, all take part.
    sparse = Drive(scene)
    sparse.monitor._counts.extend([60] * 5)
    assert sparse.monitor.informative(empty, scene.truth) == empty


def test_one_keyframe_tested_again_and_again_is_no_confirmation(scene, displaced):
    drive = Drive(scene, known=5)
    assert drive.check(displaced[0], scene.truth).verdict == Verdict.SUSPECT
    assert Verdict.MOVED not in drive.verdicts([poor(f) for f in displaced[1:]], scene.truth)
    assert Verdict.MOVED in drive.verdicts(displaced[1:4], scene.truth)


def test_an_extrinsic_far_off_is_not_called_right(scene):
    """The refinement ends in an optimum of chance: that says nothing."""
    far = scene.off(([0.0, 6.0, 0.0], [0.4, 0.0, 0.0]))
    assert not measure_shift(scene.calibrator, scene.features[:1], far).significant
    drive = Drive(scene)
    assert Verdict.CONSISTENT not in drive.verdicts(scene.features[:3], far)
    assert not drive.monitor._counts


def test_what_the_clocks_leave_open_in_a_bend_is_no_movement(scene):
    """5 ms late in a bend of 60 deg/s: 0.3 deg, whoever moved."""
    twist = np.array([0.0, 0.0, np.deg2rad(60.0), 4.0, 0.0, 0.0])
    bend = [replace(f, twist=twist) for f in scene.features[:5]]
    late = scene.truth @ se3.exp(-0.005 * twist)
    sigma = np.sqrt(np.diag(clock_covariance(bend, scene.truth, 0.005)))
    both = 0.3 * np.sqrt(1 + 0.6**2 / 5)  # common to all, and of each at most 3 ms
    assert np.rad2deg(np.linalg.norm(sigma[:3])) == pytest.approx(both)
    assert not clock_covariance(scene.features[:5], scene.truth, 0.005).any()  # motion not known
    exact, scattering = (
        Calibrator(scene.camera, replace(scene.calibrator.config, motion=replace(Config().motion, time_offset_sigma_s=known)))
        for known in (0.0, 0.005)
    )
    assert measure_shift(exact, bend, late).p_value < 1e-3
    assert measure_shift(scattering, bend, late).p_value > 0.05


def test_while_no_frames_have_shown_the_clocks_a_shift_along_the_way_is_no_movement(scene):
    """An extrinsic that has absorbed 30 ms at 8 m/s, and the vehicle stops."""
    ahead = np.array([0.0, 0.0, 0.0, 8.0, 0.0, 0.0])
    off, turned = scene.truth @ se3.exp(0.03 * ahead), scene.off(DISPLACEMENT)
    driving = [replace(f, twist=ahead) for f in scene.features]

    def verdicts(T, clock_sigma_s):
        monitor = Monitor(CONFIG)
        return [
            monitor.check(scene.calibrator, driving[: k + 1], T, EXACT, clock_sigma_s=clock_sigma_s).verdict
            for k in range(len(driving))
        ]

    assert Verdict.SUSPECT in verdicts(off, 0.003)
    assert not {Verdict.MOVED, Verdict.SUSPECT} & set(verdicts(off, 0.05))
    assert Verdict.MOVED in verdicts(turned, 0.05)


C = np.diag(np.r_[[np.deg2rad(0.1)] * 3, [0.02] * 3] ** 2)


@pytest.mark.parametrize("freedom", [12.0, 60.0])
def test_false_alarms_are_no_more_than_promised(freedom):
    """Of a right extrinsic the ratio is 1 on average, and rarely large."""
    shifts = multivariate_t(np.zeros(6), C, freedom, seed=1).rvs(8000)
    ratios = np.exp([shift_evidence(x, C, freedom) for x in shifts])
    assert ratios.mean() < 1.2
    for limit in (10.0, 100.0):
        assert np.mean(ratios >= limit) <= 1 / limit


@pytest.mark.parametrize("factor", [0.25, 1.0, 3.0])
def test_covariances_are_scaled_by_the_shifts_of_a_right_extrinsic(factor):
    noise, freedom = ShiftNoise(), 12.0
    assert noise.scale == 1.0
    shifts = multivariate_t(np.zeros(6), C, freedom, seed=2).rvs(20 * REMEMBERED)
    squared = factor * np.einsum("ij,jk,ik->i", shifts, np.linalg.inv(C), shifts)
    scales = []
    for k, own in enumerate(squared):
        noise.learn(own, 6, freedom)
        scales += [noise.scale] * (k >= REMEMBERED)
    expected = (MIN_REMEMBERED + REMEMBERED * factor) / (MIN_REMEMBERED + REMEMBERED)  # what was thought before counts a little
    assert np.median(scales) == pytest.approx(expected, rel=0.15)
    few = ShiftNoise()
    few.learn(0.0, 6, freedom)
    few.learn(0.0, 0, freedom)  # all axes are fixed: nothing is learnt
    assert few.scale == MIN_REMEMBERED / (MIN_REMEMBERED + 1)


def matching(z_scores: list[float], points: float = 400.0) -> MatchEvidence:
    match = MatchEvidence()
    for z in z_scores:
        match.learn(z, points)
    return match


def test_what_matches_as_chance_does_speaks_against_it():
    match = matching([6.0, 7.0, 8.0, 6.5, 7.5, 7.0, 6.0, 8.0])
    assert match.ratio(7.0, 400.0) < -4 < 4 < match.ratio(0.0, 400.0)
    assert match.ratio(3.5, 100.0) < 0  # with a quarter of the points half of the z-score is usual
    assert matching([6.0, 7.0]).ratio(0.0, 400.0) == 0.0  # it is not known yet what is usual
    assert abs(matching([1.0, 0.5, 1.5, 1.0, 0.8]).ratio(0.0, 400.0)) < 1  # a scene that never tells anything
