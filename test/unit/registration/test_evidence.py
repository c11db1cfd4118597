"""What speaks for an optimum: the p value against a decoy, the disagreement of halves, the accuracy that is reached."""

from __future__ import annotations

import numpy as np
import pytest

from calib_ros import se3
from calib_ros.config import ScoreConfig
from calib_ros.registration.acceptance.significance import check_uncertainty, p_value
from calib_ros.registration.acceptance.split_half import disagreement
from calib_ros.registration.score.point_score import FastScore
from calib_ros.registration.search.constraints import Limits, unlimited
from calib_ros.registration.search.optimizers import levenberg_marquardt


def test_p_value_compares_two_maxima_of_chance():
    assert p_value(5.0, 5.0) == pytest.approx(0.5)
    assert p_value(8.0, 5.0) < 0.01 < p_value(7.0, 5.0)
    # The best of ten rounds is as much higher as ten times the chance.
    assert p_value(8.0, 5.0, 10) == pytest.approx(10 * p_value(8.0, 5.0), rel=0.1)
    assert p_value(float("inf"), 5.0) > 0
    # Without a decoy, the highest that was ever seen counts.
    assert p_value(10.0, None) > p_value(10.0, 5.0)
    assert p_value(10.0, None) < 0.01


def test_halves_of_a_right_extrinsic_agree_and_halves_that_pull_apart_do_not(scene):
    T = scene.calibrator.estimate(scene.features, scene.truth).T_camera_lidar
    score = FastScore(scene.features, T, ScoreConfig())
    right = disagreement(score, T, unlimited(T))
    assert 0 < right < 2
    # One side of the scan turned by half a degree: the optimum lies between the two.
    bent = score.select(np.arange(score.points.shape[1]))
    side = (T[:3, :3] @ bent.points + T[:3, 3:])[0] > 0
    turn = se3.rotation_from_euler(np.deg2rad(0.5), 0, 0).astype(np.float32)
    bent.points[:, side] = turn @ bent.points[:, side]
    between = levenberg_marquardt(bent.at(-1), T)[0]
    apart = disagreement(bent, between, unlimited(T))
    assert apart > 1.5  # the covariance is inflated
    assert apart > 5 * right
    assert disagreement(score, T, Limits(T, np.zeros(6))) == 1.0


@pytest.mark.parametrize(("sigma_deg", "sigma_m", "known"), [(0.1, 0.02, True), (0.2, 0.02, False), (0.1, 0.04, False)])
def test_an_accuracy_is_asked_of_rotation_and_shift(sigma_deg, sigma_m, known):
    """0.5 deg and 10 cm with 90 %, over three axes each."""
    C = np.diag([np.deg2rad(sigma_deg)] * 3 + [sigma_m] * 3) ** 2
    refusal = check_uncertainty(C, 0.5, 0.1)
    assert (refusal is None) == known
    if refusal is not None:
        assert refusal.directions
        assert "add frames of other scenes" in str(refusal)
