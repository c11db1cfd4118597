"""The verdict about a tolerance: probabilities, intervals and words; and the one standard of evidence."""

from __future__ import annotations

from fnmatch import fnmatch

import numpy as np
import pytest
from scenes import RenderedDrive
from scipy.special import stdtr

from calib_ros import se3
from calib_ros.errors import BadInputError
from calib_ros.registration.covariance import freedom, shows_noise
from calib_ros.registration.judgement.judge import Match, convinces, log_odds, rare_odds
from calib_ros.result import Cause
from calib_ros_check.checker import Checker
from calib_ros_check.outcome import CauseFinding, CauseState, CheckVerdict, Tolerance
from calib_ros_check.tolerance import deviation, is_off, judge, posterior_samples, reason_of, undecided

pytestmark = pytest.mark.usefixtures("rendered_once")
TRUTH = se3.from_parts(se3.OPTICAL_FROM_BODY, [0.1, -0.3, -0.2])
SHARP = np.diag([np.deg2rad(0.03) ** 2] * 3 + [0.01**2] * 3)
BLURRED = np.diag([np.deg2rad(1.0) ** 2] * 3 + [0.3**2] * 3)
FEW = np.diag([np.deg2rad(0.3) ** 2] * 3 + [0.03**2] * 3)
UNSHOWN, SHARED = np.diag([0.0] * 5 + [0.5**2]), np.diag([0.0] * 5 + [0.12**2])
PASS, FAIL, INCONCLUSIVE = CheckVerdict.PASS, CheckVerdict.FAIL, CheckVerdict.INCONCLUSIVE


@pytest.mark.parametrize(
    ("deg", "m", "known", "verdict"),
    [
        ([0, 0, 0], [0, 0, 0], (SHARP,), PASS),
        ([0.3, 0, 0], [0, 0.05, 0], (SHARP,), PASS),
        ([0, 0.9, 0], [0, 0, 0], (SHARP,), FAIL),
        ([0, 0, 0], [0, 0, 0.2], (SHARP,), FAIL),
        ([0.5, 0, 0], [0, 0, 0], (SHARP,), INCONCLUSIVE),
        ([0.4, 0, 0], [0.05, 0, 0], (BLURRED,), INCONCLUSIVE),
        # What five standard deviations are worth depends on how well these are known.
        ([2.0, 0, 0], [0, 0, 0], (FEW, np.inf), FAIL),
        ([2.0, 0, 0], [0, 0, 0], (FEW, 3.0), INCONCLUSIVE),
        # What is rare in advance is seen for all that.
        ([0, 0, 0], [0, 0.11, 0], (SHARP + np.diag([0.0] * 4 + [0.06**2, 0.0]),), INCONCLUSIVE),
        # What intrinsics leave open need not be shown by the scenes.
        ([0, 0, 0], [0, 0, 0], (SHARP + SHARED,), INCONCLUSIVE),
        ([0, 0, 0], [0, 0, 0], (SHARP + SHARED, np.inf, SHARED), PASS),
    ],
)
def test_a_verdict_follows_the_size_of_the_error_and_what_is_known_of_it(deg, m, known, verdict):
    """known: covariance, its degrees of freedom, and the part of it that intrinsics leave open."""
    covariance, *rest = known
    assert judge(se3.perturb(TRUTH, deg, m), TRUTH, covariance, Tolerance(0.5, 0.1), *rest).verdict is verdict


def test_what_the_scenes_do_not_show_is_inconclusive_on_that_axis_only():
    found = judge(TRUTH, TRUTH, SHARP + UNSHOWN, Tolerance(0.5, 0.1))
    assert [axis.verdict for axis in found.axes] == [PASS] * 5 + [INCONCLUSIVE]
    assert found.verdict is INCONCLUSIVE


@pytest.mark.parametrize(
    ("m", "known", "says"),
    [
        (0.0, SHARP, "wrong; with that mended, the extrinsic is right: rotation off by"),
        (0.1, BLURRED, "wrong; with that mended, the scenes do not tell whether it is right to within 0.5 deg / 10 cm"),
        (1.17, SHARP, "wrong; even with that mended the extrinsic seems to be off by more than 0.5 deg / 10 cm, rotation"),
    ],
)
def test_a_cause_is_a_cure_only_where_the_extrinsic_is_right_with_it_mended(m, known, says):
    cause, tolerance = CauseFinding(Cause.FOCAL_LENGTH, CauseState.FOUND, "wrong"), Tolerance(0.5, 0.1)
    judgement = judge(se3.perturb(TRUTH, [0, 0, 0], [0, 0, m]), TRUTH, known, tolerance)
    assert reason_of(judgement, tolerance, cause).startswith(says)


def test_an_error_that_is_seen_is_told_also_where_it_may_be_within_the_tolerance():
    near, C = Tolerance(0.5, 0.1), np.diag([np.deg2rad(0.05) ** 2] * 3 + [0.02**2] * 3)
    off = judge(se3.perturb(TRUTH, [0, 0, 0], [0.06, 0.09, 0]), TRUTH, C, near)
    assert reason_of(off, near, None).startswith("off by about 10.0 cm, not surely by more than 0.5 deg / 10 cm: use more frames")
    assert [axis.words.endswith("(+- 3.9 cm), within the tolerance") for axis in off.axes[3:]] == [True, False, False]


def test_samples_of_few_degrees_of_freedom_have_students_tails():
    C = np.diag([np.deg2rad(0.01) ** 2] * 3 + [0.001**2] * 3)  # far below the prior: as the noise itself
    sharp, few = (posterior_samples(np.zeros(6), C, Tolerance(90.0, 10.0), freedom) for freedom in (np.inf, 4.0))
    beyond = [float((np.abs(samples[:, 0]) > 3 * np.deg2rad(0.01)).mean()) for samples in (sharp, few)]
    assert beyond[0] == pytest.approx(0.0027, abs=0.001)
    assert beyond[1] == pytest.approx(2 * stdtr(4, -3), rel=0.35)


def test_an_undecided_judgement_fails_nowhere():
    found = undecided(judge(se3.perturb(TRUTH, [0, 3.0, 0], [0, 0, 0]), TRUTH, SHARP, Tolerance()))
    assert FAIL not in {found.verdict, found.rotation.verdict, *(axis.verdict for axis in found.axes)}
    assert found.axes[3].verdict is PASS


def test_verdicts_keep_their_probability():
    """Of errors of all sizes, seen with noise near the tolerance, at most one in ten verdicts is wrong."""
    rng, tolerance, wrong, said = np.random.default_rng(1), Tolerance(0.5, 0.1), 0, 0
    C = np.diag([np.deg2rad(0.15) ** 2] * 3 + [0.03**2] * 3)
    for _ in range(60):
        scale = np.exp(rng.uniform(np.log(1 / 8), np.log(8), 2))
        error = np.concatenate([np.deg2rad(0.5) * scale[0] * rng.normal(size=3), 0.1 * scale[1] * rng.normal(size=3)])
        checked = se3.from_parts(se3.exp(np.r_[error[:3], 0, 0, 0])[:3, :3] @ TRUTH[:3, :3], TRUTH[:3, 3] + error[3:])
        found = judge(checked, se3.exp(rng.multivariate_normal(np.zeros(6), C)) @ TRUTH, C, tolerance)
        within = np.linalg.norm(error[:3]) <= np.deg2rad(0.5) and np.linalg.norm(error[3:]) <= 0.1
        if found.verdict is not INCONCLUSIVE:
            said += 1
            wrong += (found.verdict is PASS) != within
    assert said > 30
    assert wrong <= 0.1 * said


def test_the_error_is_that_of_eq_2_19_and_its_covariance_follows_a_twist_of_the_estimate():
    checked = se3.perturb(TRUTH, [1.0, -2.0, 0.5], [0.1, 0.0, -0.05])
    error, _ = deviation(checked, TRUTH, SHARP)
    assert np.rad2deg(np.linalg.norm(error[:3])) == pytest.approx(se3.rotation_error_deg(TRUTH, checked))
    assert np.linalg.norm(error[3:]) == pytest.approx(se3.translation_error_m(TRUTH, checked))
    rng = np.random.default_rng(0)
    A = rng.normal(size=(6, 6)) * 1e-3
    twists = rng.multivariate_normal(np.zeros(6), A @ A.T, 20000)
    errors = np.array([deviation(TRUTH, T, A @ A.T)[0] for T in se3.exp_many(twists) @ TRUTH])
    assert np.allclose(np.cov(errors.T), deviation(TRUTH, TRUTH, A @ A.T)[1], rtol=0.1, atol=2e-8)


@pytest.mark.parametrize(
    ("deg", "m", "words"),
    [
        ([0, 0.8, 0], [0, 0, 0], "camera looks * too far left"),
        ([0.8, 0, 0], [0, 0, 0], "camera looks * too far down"),
        ([0, 0, -2], [0, 0, 0], "camera is rolled * too far clockwise"),
        ([0, -179, 0], [0, 0, 0], "camera looks backwards, turned by 179 deg"),
        ([0, 0, 178], [0, 0, 0], "camera is upside down, by 178 deg"),
        ([0, 0, 0], [0.3, 0, 0], "camera is * too far left"),
        ([0, 0, 0], [0, -0.3, 0], "camera is * too low"),
    ],
)
def test_the_direction_is_told_in_words(deg, m, words):
    R = se3.perturb(np.eye(4), deg, [0, 0, 0])[:3, :3]
    checked = se3.from_parts(R @ TRUTH[:3, :3], TRUTH[:3, 3] + m)
    if words.endswith("left"):  # against the projection itself: points lie too far right
        assert se3.transform(checked, se3.transform(se3.inverse(TRUTH), [[0.0, 0.0, 20.0]]))[0, 0] > 0.2
    assert any(fnmatch(axis.words, f"{words} (+- *)") for axis in judge(checked, TRUTH, SHARP, Tolerance()).axes)


@pytest.mark.parametrize(
    ("values", "part"),
    [((0.0, 0.1), "rotation"), ((float("nan"), 0.1), "rotation"), ((0.5, -1.0), "translation"), ((0.5, 100.0), "translation")],
)
def test_a_tolerance_out_of_range_is_named(values, part):
    with pytest.raises(BadInputError, match=f"tolerance of the {part}"):
        Tolerance(*values)


# --- what convinces, and against what -------------------------------------------------------------------------------------


KNOWN = np.diag([np.deg2rad(0.05) ** 2] * 3 + [0.01**2] * 3)


@pytest.fixture(scope="module")
def drive():
    return RenderedDrive(seed=1, frames=4, rings=64, width=640, height=240, stride=30)


@pytest.fixture(scope="module")
def score_of(drive):
    checker = Checker(drive.camera)
    features = [checker._calibrator.extract(drive[k]) for k in (0, 1, 2, 3)]
    return lambda numbers, T: checker._judge.score([features[k] for k in numbers], T)


def test_a_match_convinces_against_a_decoy_and_not_against_itself(drive, score_of):
    T = drive.reference
    score = score_of((0, 2), T)
    right, mirrored = Match(score, T), Match(score.mirrored(), T)
    assert convinces(log_odds(right, mirrored), rare_odds(35))
    assert log_odds(mirrored, right) < 0
    assert log_odds(right, right) == 0.0
    assert log_odds(right, None) > log_odds(right, mirrored) - 5


def test_one_scene_seen_four_times_tells_its_noise_as_badly_as_once(drive, score_of):
    one, again, several = (score_of(numbers, drive.reference) for numbers in ((0,), (0, 0, 0, 0), (0, 1, 2, 3)))
    assert freedom(again) == pytest.approx(freedom(one), abs=1.0)
    assert not shows_noise(again)
    assert shows_noise(several)
    assert freedom(several) > 2 * freedom(one)


@pytest.mark.parametrize(("deg", "off"), [(0.3, False), (3.0, True)])
def test_an_extrinsic_is_off_where_nothing_within_the_tolerance_matches_as_well(drive, score_of, deg, off):
    T = drive.reference
    checked = se3.perturb(T, [0, deg, 0], [0, 0, 0])
    assert is_off(Match(score_of((0, 2), T), T), KNOWN, checked, Tolerance()) is off
