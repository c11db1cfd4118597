"""The one standard of evidence: what convinces, and against what."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import RenderedDrive

from calib_ros import se3
from calib_ros.registration.covariance import freedom, shows_noise
from calib_ros.registration.judgement.judge import EVEN, Match, convinces, log_odds, rare_odds
from calib_ros_check.checker import Checker
from calib_ros_check.outcome import Tolerance
from calib_ros_check.tolerance import is_off

pytestmark = pytest.mark.usefixtures("rendered_once")
SHARP = np.diag([np.deg2rad(0.05) ** 2] * 3 + [0.01**2] * 3)


@pytest.fixture(scope="module")
def drive():
    return RenderedDrive(seed=1, frames=4, rings=64, width=640, height=240, stride=30)


@pytest.fixture(scope="module")
def score_of(drive):
    checker = Checker(drive.camera)
    features = [checker._calibrator.extract(drive[k]) for k in (0, 1, 2, 3)]
    return lambda numbers, T: checker._judge.score([features[k] for k in numbers], T)


def test_the_rarer_an_explanation_the_more_it_has_to_say():
    assert convinces(np.log(9.01), EVEN)
    assert not convinces(np.log(8.99), EVEN)
    assert not convinces(np.log(9.01), rare_odds(1))
    assert convinces(np.log(9 * 99 * 35) + 0.01, rare_odds(35))
    assert not convinces(np.log(9 * 99 * 35) - 0.01, rare_odds(35))


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
    assert is_off(Match(score_of((0, 2), T), T), SHARP, checked, Tolerance()) is off
