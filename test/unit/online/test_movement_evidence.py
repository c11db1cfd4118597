"""Likelihood ratios of the monitor: what they say, and that they keep what they promise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_t

from calib_ros.online.evidence import MIN_REMEMBERED, REMEMBERED, MatchEvidence, ShiftNoise, shift_evidence

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
