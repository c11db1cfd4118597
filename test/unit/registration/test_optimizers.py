"""The optimisers on scores whose optimum is known."""

from __future__ import annotations

import itertools

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


def near(T: np.ndarray, deg: float, m: float) -> bool:
    return se3.rotation_error_deg(OPTIMUM, T) < deg and se3.translation_error_m(OPTIMUM, T) < m


def test_levenberg_marquardt_finds_the_optimum():
    for seed in range(4):
        T, value = levenberg_marquardt(Bowl(), start(seed, 5, 0.5))
        assert near(T, 2e-3, 1e-3)
        assert value == pytest.approx(0.7, abs=1e-6)


def test_nelder_mead_finds_the_optimum_within_its_evaluations_and_in_spite_of_ripples():
    for seed in range(4):
        score = Bowl()
        T, value = nelder_mead(score, start(seed), 0.8, 600)
        assert near(T, 0.05, 0.05)
        assert value == pytest.approx(0.7, abs=1e-3)
        assert score.calls <= 610
    T, value = nelder_mead(Bumpy(), start(1), 0.8, 600)
    assert near(T, 0.2, 0.2)
    assert value > Bumpy().value(start(1))


def test_the_result_is_never_worse_than_the_start():
    for seed, score in itertools.product(range(5), (Bowl(), Bumpy(), Noise())):
        for T0 in (start(seed), OPTIMUM):
            for T, value in (levenberg_marquardt(score, T0), nelder_mead(score, T0, 0.8, 60)):
                assert value >= score.value(T0) - 1e-12
                assert value == pytest.approx(score.value(T), abs=1e-9)
                assert np.allclose(T[:3, :3].T @ T[:3, :3], np.eye(3), atol=1e-9)


def test_a_flat_score_is_left_where_it_is():
    flat = Bowl(curvature=np.zeros((6, 6)))
    for T, value in (levenberg_marquardt(flat, start(2)), nelder_mead(flat, start(2)), barzilai_borwein(flat, start(2))):
        assert np.allclose(T, start(2))
        assert value == 0.7


def test_nan_score_raises_no_error():
    class Broken(Bowl):
        def value(self, T):
            return float("nan")

        def linearise(self, T):
            return np.full(6, np.nan), np.full((6, 6), np.nan)

    for optimise in (levenberg_marquardt, nelder_mead, barzilai_borwein):
        T, value = optimise(Broken(), start(2))
        assert np.array_equal(T, start(2))
        assert np.isnan(value)


def test_the_same_start_gives_the_same_bits():
    for run in (lambda: levenberg_marquardt(Bowl(), start(3)), lambda: nelder_mead(Bumpy(), start(3))):
        (T1, v1), (T2, v2) = run(), run()
        assert np.array_equal(T1, T2)
        assert v1 == v2


def test_barzilai_borwein_finds_the_optimum():
    bowl = Bowl()
    for seed in range(6):
        T, value = barzilai_borwein(bowl, start(seed), 1.0, evaluations=1000)
        assert near(T, 0.15, 0.15)
        assert value == pytest.approx(bowl.value(T))
        assert value > bowl.value(start(seed))


def test_barzilai_borwein_takes_far_fewer_steps_than_a_fixed_step_where_axes_differ():
    """What its step length is for: along a valley forty times longer than wide."""
    bowl = Bowl(curvature=np.diag([400.0, 400, 400, 0.1, 0.1, 0.1]))
    begin = start(1)
    _, value = barzilai_borwein(bowl, begin, 2.0, evaluations=400)
    T = begin
    for _ in range(30):  # as many evaluations: steepest ascent of a step that does not overshoot
        gradient, _ = bowl.linearise(T)
        T = se3.exp(gradient / 400) @ T
    assert bowl.top - value < 0.1 * (bowl.top - bowl.value(T))


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


class Plateau(Bowl):
    """Whose Gauss-Newton scale is six times its curvature, as that of a mean of map values may be."""

    def linearise(self, T):
        gradient, curvature = super().linearise(T)
        return gradient, 6 * curvature


def test_near_the_optimum_the_curvature_is_learned():
    used = {}
    for near_it in (False, True):
        score = Plateau()
        T, value = levenberg_marquardt(score, start(3), 100, near=near_it)
        assert near(T, 0.02, 0.003)
        assert value > 0.7 - 1e-5
        used[near_it] = score.calls
    assert used[True] < 0.5 * used[False]
