"""The monitor detects miscalibration on small synthetic scenes whose extrinsic is known exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import SIZE, RenderedDrive, Scene

from calib_ros import se3
from calib_ros.config import Config, ConstraintsConfig, MonitorConfig
from calib_ros.lidar.edges import EdgePoints
from calib_ros.online.monitor import Assessment, Monitor, ShiftTest, Verdict, measure_shift
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.search.constraints import pose_constraints

SMALL = {"width": 480, "height": 180}
FRAMES = 10
EXACT = np.zeros((6, 6))
DISPLACEMENT = ([0.9, 1.5, -0.9], [0.03, -0.03, 0.02])  # 2 deg / 5 cm
CONFIG = MonitorConfig()


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(1, frames=FRAMES, **SMALL)


@pytest.fixture(scope="module")
def other_scene() -> Scene:
    return Scene(2, frames=FRAMES, **SMALL)


each_scene = pytest.mark.parametrize("name", ["scene", pytest.param("other_scene", marks=pytest.mark.slow)])


@pytest.fixture(scope="module")
def displaced(scene) -> list[FrameFeatures]:
    """The same street, seen by a camera that is displaced by DISPLACEMENT."""
    drive = RenderedDrive(seed=1, frames=FRAMES, **{**SIZE, **SMALL})
    assert np.array_equal(drive.reference, scene.truth)
    return [scene.calibrator.extract(drive.moved(k, scene.off(DISPLACEMENT))) for k in range(FRAMES)]


def without_edges(f: FrameFeatures) -> FrameFeatures:
    return replace(f, points=EdgePoints(np.zeros((0, 3), np.float32), np.zeros(0, np.float32), np.zeros(0, np.uint8)))


def other_image(f: FrameFeatures, image_of: FrameFeatures) -> FrameFeatures:
    """The scan of one moment with the image of another."""
    return replace(f, levels=image_of.levels)


class Drive:
    """A monitor with its keyframes, fed one by one."""

    def __init__(self, scene: Scene, config: MonitorConfig = CONFIG, spread: np.ndarray = EXACT) -> None:
        self.scene, self.monitor, self.spread = scene, Monitor(config), spread
        self.keyframes: list[FrameFeatures] = []

    def check(self, f: FrameFeatures, T: np.ndarray) -> Assessment:
        self.keyframes.append(f)
        return self.monitor.check(self.scene.calibrator, self.keyframes, T, self.spread)

    def verdicts(self, features: list[FrameFeatures], T: np.ndarray) -> list[Verdict]:
        return [self.check(f, T).verdict for f in features]


# --- one test -------------------------------------------------------------------------------------------------------------


@each_scene
@pytest.mark.parametrize("n", [1, 5])
def test_right_extrinsic_is_confirmed(request, name, n):
    """The p value of a right extrinsic is no rarity: the noise that it is weighed with is not too small."""
    s = request.getfixturevalue(name)
    tests = [measure_shift(s.calibrator, s.features[k : k + n], s.truth) for k in range(FRAMES - n + 1)]
    assert all(t.conclusive for t in tests)
    assert min(t.p_value for t in tests) > 0.01
    assert np.median([t.p_value for t in tests]) > 0.2
    assert max(t.deg for t in tests) < (0.6 if n == 1 else 0.15)
    assert min(t.z_score for t in tests) > 3


@pytest.mark.parametrize(
    ("by", "deg", "m"),
    [
        (([0.35, -0.3, 0.25], [0, 0, 0]), 0.52, 0.0),
        (([0, 0, 0], [0.06, -0.05, 0.06]), 0.0, 0.1),
        (([1.2, 1.2, 1.0], [0, 0, 0]), 1.97, 0.0),
    ],
    ids=["0.5 deg", "10 cm", "2 deg"],
)
@each_scene
def test_wrong_extrinsic_is_detected(request, name, by, deg, m):
    """By five keyframes, each time, and told how wrong."""
    s = request.getfixturevalue(name)
    for k in range(0, FRAMES - 4, 2):
        found = measure_shift(s.calibrator, s.features[k : k + 5], s.off(by))
        assert found.conclusive
        assert found.p_value < CONFIG.false_alarm_rate / 10
        assert found.deg == pytest.approx(deg, abs=0.2)
        assert found.m == pytest.approx(m, abs=0.04)
        back = se3.exp(found.shift) @ s.off(by)
        assert s.is_near(back, 0.15, 0.04)


def test_uncertain_keyframes_do_not_contradict(scene):
    """0.5 deg off, and known no better than 0.5 deg."""
    by = ([0.35, -0.3, 0.25], [0, 0, 0])
    unsure = np.diag(np.r_[[np.deg2rad(0.5)] * 3, [0.02] * 3] ** 2)
    sure, weighed = (measure_shift(scene.calibrator, scene.features[:5], scene.off(by), s) for s in (None, unsure))
    assert np.array_equal(sure.shift, weighed.shift)
    assert sure.p_value < 1e-4
    assert weighed.p_value > 0.1


def test_empty_scene_is_inconclusive(scene):
    test = measure_shift(scene.calibrator, [without_edges(scene.features[0])], scene.off(DISPLACEMENT))
    assert (test.p_value, test.conclusive, test.z_score) == (1.0, False, 0.0)
    assert not test.shift.any()
    drive = Drive(scene)
    assessment = drive.check(without_edges(scene.features[0]), scene.off(DISPLACEMENT))
    assert assessment.verdict == Verdict.INCONCLUSIVE
    assert "few edges" in assessment.message
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


def test_the_same_keyframes_give_the_same_bits(scene):
    a, b = (measure_shift(scene.calibrator, scene.features[:5], scene.off(DISPLACEMENT)) for _ in range(2))
    assert a.p_value == b.p_value
    assert np.array_equal(a.shift, b.shift)


# --- over time ------------------------------------------------------------------------------------------------------------


def test_mount_displacement_is_suspect_at_once_and_confirmed_soon(scene, displaced):
    drive = Drive(scene)
    assert drive.verdicts(scene.features[:5], scene.truth) == [Verdict.CONSISTENT] * 5
    first = drive.check(displaced[5], scene.truth)
    assert (first.verdict, first.since) == (Verdict.SUSPECT, 1)  # the four before it are still right
    assert first.message.startswith("the newest keyframe ")
    assert first.p_value < CONFIG.false_alarm_rate
    second = drive.check(displaced[6], scene.truth)
    assert (second.verdict, second.since) == (Verdict.SUSPECT, 2)
    third = drive.check(displaced[7], scene.truth)
    assert (third.verdict, third.since) == (Verdict.MOVED, CONFIG.confirm)
    assert third.message.startswith("the calibration has moved: the newest 3 keyframes ")
    # The extrinsic is replaced, and the keyframes from before are dropped.
    drive.monitor.reset()
    drive.keyframes = drive.keyframes[-third.since :]
    assert drive.verdicts(displaced[8:], scene.off(DISPLACEMENT)) == [Verdict.CONSISTENT, Verdict.CONSISTENT]


@pytest.mark.parametrize("confirm", [*(pytest.param(n, marks=pytest.mark.slow) for n in (1, 4)), 2])
def test_number_of_confirming_keyframes_is_configurable(scene, displaced, confirm):
    drive = Drive(scene, replace(CONFIG, confirm=confirm))
    drive.verdicts(scene.features[:5], scene.truth)
    verdicts = drive.verdicts(displaced[5:10], scene.truth)
    wait = max(confirm - 1, 1)  # the first one is only suspect, whatever comes
    assert verdicts[: wait + 1] == [Verdict.SUSPECT] * wait + [Verdict.MOVED]


def test_small_displacement_is_detected_by_several_keyframes(scene):
    """0.5 deg: the window finds it, one way or the other, and it is confirmed."""
    by = ([0.35, -0.3, 0.25], [0, 0, 0])
    drive = Drive(scene)
    drive.verdicts(scene.features[:3], scene.truth)
    verdicts = drive.verdicts(scene.features[3:], scene.off(by))
    assert Verdict.SUSPECT in verdicts[:3]
    assert Verdict.MOVED in verdicts[:6]


def test_single_outlier_keyframe_raises_no_alarm(scene):
    """A scan with another street's image: suspect, and right again with the next ones."""
    other = Scene(2, frames=1, **SMALL)
    drive = Drive(scene)
    assert drive.verdicts(scene.features[:5], scene.truth) == [Verdict.CONSISTENT] * 5
    odd = drive.check(other_image(scene.features[5], other.features[0]), scene.truth)
    assert odd.verdict == Verdict.SUSPECT
    after = drive.verdicts(scene.features[6:9], scene.truth)
    assert after[-1] == Verdict.CONSISTENT
    assert Verdict.MOVED not in after


def test_displacement_below_the_threshold_is_not_suspect_repeatedly(scene):
    """0.1 deg off and believed exact: the estimates follow that, and must not be held up for it."""
    off = scene.off(([0.0, 0.1, 0.0], [0, 0, 0]))
    sharp = replace(CONFIG, false_alarm_rate=0.5, least_deg=0.3, least_m=0.1)
    assert measure_shift(scene.calibrator, scene.features[:5], off).p_value < 0.25  # it shows
    drive = Drive(scene, sharp)
    drive.verdicts(scene.features[:1], off)
    assert Verdict.SUSPECT not in drive.verdicts(scene.features[1:6], off)
    strict = Drive(scene, replace(sharp, least_deg=0.0, least_m=0.0))
    assert Verdict.SUSPECT in strict.verdicts(scene.features[:6], off)


def test_the_rate_of_false_alarms_is_the_threshold(scene):
    """0.2 deg off: what one rate calls suspect is no evidence at another."""
    off = scene.off(([0.0, 0.2, 0.1], [0.02, 0, 0]))
    p = measure_shift(scene.calibrator, scene.features[:5], off).p_value
    assert 1e-6 < p / 2 < 0.25
    for rate, verdict in ((min(4 * p, 0.5), Verdict.SUSPECT), (p / 2, Verdict.CONSISTENT)):
        config = replace(CONFIG, false_alarm_rate=rate, least_deg=0.05, least_m=0.01)
        m = Monitor(config)
        assert m.check(scene.calibrator, scene.features[:5], off, EXACT).verdict == verdict


def test_single_frame_with_a_shifted_optimum_raises_no_alarm(scene):
    """As along what its scene does not show: it matches at the extrinsic as well as others do."""
    m = Monitor(CONFIG)
    shift = np.array([0, 0, 0, 0, 0, 0.5])
    for matches, against in ((8.0, False), (6.0, True), (2.0, True)):
        m._z_scores.extend([8.0] * 5)
        test = ShiftTest(1e-6, shift, matches, True)
        assert m._contradicts(test, 0.01, scene.features[:1]) == against
        several = replace(test, keyframes=2)
        assert m._contradicts(several, 0.01, scene.features[:2])  # several frames do not slide together
        assert not m._contradicts(replace(several, conclusive=False), 0.01, scene.features[:2])


def test_an_optimum_that_may_be_chance_raises_no_alarm(scene):
    """An empty road: the refinement ends somewhere, and claims to know it well."""
    m = Monitor(CONFIG)
    test = ShiftTest(1e-9, np.array([0, 0, 0, 0, 0, 0.5]), 6.0, True, keyframes=2)
    assert m._contradicts(test, 0.01, scene.features[:2])
    assert not m._contradicts(replace(test, significant=False), 0.01, scene.features[:2])


def test_a_frame_of_few_edges_need_not_match_as_well_as_others(scene):
    """z-scores grow with the root of the points: with a sixteenth of them a right extrinsic has a quarter of the usual one."""
    m = Monitor(CONFIG)
    m._z_scores.extend([16.0 / np.sqrt(1600)] * 5)
    fits = ShiftTest(0.5, np.zeros(6), 4.0, True, points=1600)
    assert m._contradicts(fits, 0.01, scene.features[:1])
    assert not m._contradicts(replace(fits, points=400), 0.01, scene.features[:1])
    assert m._contradicts(replace(fits, points=400, z_score=2.0), 0.01, scene.features[:1])
    # So few that a wrong extrinsic could match as well.
    assert not m._contradicts(replace(fits, points=100, z_score=0.5), 0.01, scene.features[:1])


def poor(f) -> FrameFeatures:
    """A keyframe that shows a thirtieth of its edges."""
    return replace(f.fast, points=f.fast.points.select(np.arange(0, len(f.fast.points), 30)))


def test_keyframes_that_show_next_to_nothing_take_no_part(scene):
    empty = [poor(f) for f in scene.features[:4]]
    drive = Drive(scene)
    keyframes = [*empty, *scene.features[4:6]]
    assert drive.monitor.telling(keyframes, scene.truth) == keyframes  # it is not known yet what is usual
    assert drive.verdicts(scene.features[:4], scene.truth) == [Verdict.CONSISTENT] * 4
    assert drive.monitor.telling(keyframes, scene.truth) == scene.features[4:6]
    assert drive.verdicts(empty, scene.truth) == [Verdict.CONSISTENT] * 4  # by the others of the window
    assert drive.verdicts(empty, scene.truth)[-1] == Verdict.INCONCLUSIVE
    # Of a scanner that never shows more, all take part.
    sparse = Drive(scene)
    sparse.monitor._counts.extend([60] * 5)
    assert sparse.monitor.telling(empty, scene.truth) == empty


def test_one_keyframe_tested_again_and_again_is_no_confirmation(scene, displaced):
    drive = Drive(scene)
    drive.verdicts(scene.features[:5], scene.truth)
    assert drive.check(displaced[5], scene.truth).verdict == Verdict.SUSPECT
    assert Verdict.MOVED not in drive.verdicts([poor(f) for f in displaced[6:]], scene.truth)
    assert Verdict.MOVED in drive.verdicts(displaced[6:9], scene.truth)


def test_an_extrinsic_far_off_is_not_called_right(scene):
    """The refinement ends in an optimum of chance: that says nothing."""
    far = scene.off(([0.0, 6.0, 0.0], [0.4, 0.0, 0.0]))
    assert not measure_shift(scene.calibrator, scene.features[:1], far).significant
    drive = Drive(scene)
    assert Verdict.CONSISTENT not in drive.verdicts(scene.features[:3], far)
    assert not drive.monitor._z_scores


def test_pictures_of_another_scene_are_not_significant(scene):
    mirrored = [scene.calibrator.extract(replace(f, image=np.ascontiguousarray(f.image[:, ::-1]))) for f in scene.frames[:1]]
    assert not measure_shift(scene.calibrator, mirrored, scene.truth).significant
    right = measure_shift(scene.calibrator, scene.features[:1], scene.truth)
    assert right.significant
    assert 100 < right.points < len(scene.features[0].fast.points)


def test_a_small_shift_counts_only_while_the_motion_during_the_scan_is_known(scene):
    m = Monitor(CONFIG)
    still = [replace(f.fast, unknown_motion_s=0.0) for f in scene.features[:2]]
    unknown = [still[0], replace(still[1], unknown_motion_s=0.011)]  # 10 Hz, a lens of 80 deg
    small = ShiftTest(1e-6, np.array([0, np.deg2rad(0.2), 0, 0, 0, 0.08]), 8.0, True, keyframes=2)
    assert m._contradicts(small, 0.01, still)
    assert not m._contradicts(small, 0.01, unknown)
    assert m._contradicts(replace(small, shift=2 * small.shift), 0.01, unknown)


def test_fewer_keyframes_than_suspected_raise_no_error(scene, displaced):
    """The buffer was cut short meanwhile."""
    drive = Drive(scene)
    drive.verdicts(scene.features[:5], scene.truth)
    drive.check(displaced[5], scene.truth)
    drive.keyframes = []
    assert drive.check(displaced[6], scene.truth).verdict == Verdict.SUSPECT
    assert drive.check(displaced[7], scene.truth).verdict == Verdict.MOVED
