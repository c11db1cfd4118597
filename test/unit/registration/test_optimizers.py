"""The optimisers on scores whose optimum is known."""

from __future__ import annotations

import itertools
from functools import partial

import numpy as np
import pytest
from bowl import OPTIMUM, Bowl

from calib_ros import se3
from calib_ros.registration.search.optimizers import barzilai_borwein, levenberg_marquardt, nelder_mead


class Bumpy(Bowl):
    """With ripples that are no slope to follow."""

    def value(self, T):
        xi = se3.log(T @ se3.inverse(self.optimum))
        return super().value(T) + 0.002 * float(np.cos(3000 * xi[0]) + np.cos(300 * xi[4]))


class Noise(Bowl):
    """Nothing to find; slopes that lie."""

    def value(self, T):
        self.calls += 1
        return float(np.sin(1e5 * T.sum()))

    def linearise(self, T):
        return np.full(6, 30 * np.sin(3e5 * T.sum())), np.eye(6)


def start(seed: int, deg: float = 1.5, m: float = 0.25) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return se3.perturb(OPTIMUM, rng.uniform(-deg, deg, 3), rng.uniform(-m, m, 3))


@pytest.mark.parametrize(
    ("optimise", "far", "most_calls", "deg", "m", "less"),
    [
        (levenberg_marquardt, (5, 0.5), 200, 2e-3, 1e-3, 1e-6),
        (partial(nelder_mead, step_deg=0.8, evaluations=600), (1.5, 0.25), 610, 0.05, 0.05, 1e-3),
        (partial(barzilai_borwein, step_deg=1.0, evaluations=1000), (1.5, 0.25), 1000, 0.15, 0.15, 0.1),
    ],
)
def test_the_optimum_is_found_within_the_evaluations(optimise, far, most_calls, deg, m, less):
    for seed in range(4):
        score = Bowl()
        T, value = optimise(score, start(seed, *far))
        assert score.calls <= most_calls
        assert se3.rotation_error_deg(OPTIMUM, T) < deg
        assert se3.translation_error_m(OPTIMUM, T) < m
        assert value == pytest.approx(score.value(T), abs=1e-9)
        assert value > max(0.7 - less, score.value(start(seed, *far)))


def test_the_result_is_never_worse_than_the_start():
    for seed, score in itertools.product(range(5), (Bowl(), Bumpy(), Noise())):
        for T0 in (start(seed), OPTIMUM):
            for T, value in (levenberg_marquardt(score, T0), nelder_mead(score, T0, 0.8, 60)):
                assert value >= score.value(T0) - 1e-12
                assert value == pytest.approx(score.value(T), abs=1e-9)
                assert np.allclose(T[:3, :3].T @ T[:3, :3], np.eye(3), atol=1e-9)


def test_a_flat_score_and_nan_are_left_where_they_are():
    class Broken(Bowl):
        def value(self, T):
            return float("nan")

        def linearise(self, T):
            return np.full(6, np.nan), np.full((6, 6), np.nan)

    for optimise in (levenberg_marquardt, nelder_mead, barzilai_borwein):
        T, value = optimise(Broken(), start(2))
        assert np.array_equal(T, start(2))
        assert np.isnan(value)
        T, value = optimise(Bowl(curvature=np.zeros((6, 6))), start(2))
        assert np.allclose(T, start(2))
        assert value == 0.7


@pytest.mark.parametrize("evaluations", [20, 50, 137])
def test_barzilai_borwein_respects_its_budget_and_returns_the_best(evaluations):
    noise = Noise()
    begin = start(0)
    before = noise.value(begin)
    noise.calls = 0
    T, value = barzilai_borwein(noise, begin, evaluations=evaluations)
    assert noise.calls <= evaluations
    assert value >= before
    assert value == noise.value(T)
