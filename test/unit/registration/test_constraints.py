"""Pose constraints, fixed and bounded axes and priors; and the optimisers on scores whose optimum is known."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from bowl import CURVATURE, OPTIMUM, Bowl
from scenes import NEAR, QUICK, Scene
from thesis_constants import with_constants

from calib_ros import se3
from calib_ros.config import Config, ConstraintsConfig, update
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.search.constraints import SCORE_NOISE, Limits, SearchBox, pose_constraints
from calib_ros.registration.search.optimizers import barzilai_borwein, levenberg_marquardt, nelder_mead

INF = np.inf
# Small enough that twists add, to the tolerances below; beyond the bounds of the tests on every axis.
AWAY = np.array([-0.012, 0.01, 0.008, -0.09, 0.08, 0.06])
ANCHOR = se3.exp(AWAY) @ OPTIMUM

Optimise = Callable[..., tuple[np.ndarray, float]]
OPTIMIZERS: dict[str, tuple[Optimise, float]] = {  # with how near they come, in rad and m / 10
    "levenberg_marquardt": (lambda score, T, limits: levenberg_marquardt(score, T, 60, limits=limits), 3e-4),
    "nelder_mead": (lambda score, T, limits: nelder_mead(score, T, 0.8, 1500, limits=limits), 1.2e-3),
    "barzilai_borwein": (lambda score, T, limits: barzilai_borwein(score, T, 0.5, 0.05, 4000, limits=limits), 1.2e-3),
}
ALL = pytest.mark.parametrize("optimizer", OPTIMIZERS)


def twist(T: np.ndarray, T0: np.ndarray = ANCHOR) -> np.ndarray:
    return se3.log(T @ se3.inverse(T0))


def best_with(fixed: dict[int, float], curvature: np.ndarray = CURVATURE) -> np.ndarray:
    """Twist (6,) of the best extrinsic from ANCHOR if some axes have the given values: the quadratic's, solved for the others."""
    top = twist(OPTIMUM)
    out, held = top.copy(), np.isin(np.arange(6), list(fixed))
    out[list(fixed)] = list(fixed.values())
    out[~held] -= np.linalg.solve(curvature[np.ix_(~held, ~held)], curvature[np.ix_(~held, held)] @ (out - top)[held])
    return out


def assert_twist(T: np.ndarray, expected: np.ndarray, tolerance: float) -> None:
    assert np.abs((twist(T) - expected) / [1, 1, 1, 10, 10, 10]).max() < tolerance, (twist(T), expected)


def camera_centre(T: np.ndarray) -> np.ndarray:
    """Where the camera is in the LiDAR frame."""
    return -T[:3, :3].T @ T[:3, 3]


# --- limits ---------------------------------------------------------------------------------------------------------------


@ALL
def test_fixed_axes_stay_and_the_others_go_to_the_best_that_is_left(optimizer):
    for fixed in ((0,), (4,), (3, 4, 5), (0, 1, 2), (0, 2, 4, 5), (0, 1, 3, 4, 5), range(6)):
        run, tolerance = OPTIMIZERS[optimizer]
        half = np.where(np.isin(np.arange(6), fixed), 0, INF)
        T, value = run(Bowl(), ANCHOR, Limits(ANCHOR, half))
        assert np.abs(twist(T)[list(fixed)]).max() < 1e-12
        assert_twist(T, best_with(dict.fromkeys(fixed, 0.0)), tolerance)
        assert value == pytest.approx(Bowl().value(T), abs=1e-12)
        assert value > Bowl().value(ANCHOR) or len(fixed) == 6


@ALL
def test_a_start_out_of_bounds_is_brought_in_and_nothing_is_tried_outside(optimizer):
    """Bounds are not around the start, and whatever is scored lies within them."""
    run, tolerance = OPTIMIZERS[optimizer]
    half = np.array([0.004, 0.004, INF, 0.02, 0, INF])
    seen: list[np.ndarray] = []

    class Spy(Bowl):
        def value(self, T):
            seen.append(twist(T))
            return super().value(T)

    start = se3.exp([0.03, -0.02, 0.01, 0.2, 0.1, -0.1]) @ ANCHOR
    T, _ = run(Spy(), start, Limits(ANCHOR, half))
    if optimizer == "barzilai_borwein":  # its differences reach over the bounds by their own width
        half = half + 0.01 * np.array([0.1, 0.1, 0.1, 1, 1, 1])
    assert (np.abs(seen) <= half + 1e-12).all()
    top = twist(OPTIMUM)
    at = {0: 0.004 * np.sign(top[0]), 1: 0.004 * np.sign(top[1]), 3: 0.02 * np.sign(top[3]), 4: 0.0}
    assert_twist(T, best_with(at), tolerance)


# --- priors ---------------------------------------------------------------------------------------------------------------


def test_constraints_from_configuration_units():
    config = ConstraintsConfig(
        limit_deg=(0.0, 2.0, 180.0), limit_m=(0.1, 100.0, 0.0), sigma_deg=(0.5, 0.0, 1.0), sigma_m=(0.0, 0.02, 0.0)
    )
    known = pose_constraints(ANCHOR, config, 4)
    assert known.limits.half == pytest.approx([0, np.deg2rad(2), INF, 0.1, INF, 0])
    assert np.array_equal(known.limits.T, ANCHOR)
    assert known.prior is not None
    assert np.array_equal(known.prior.T, ANCHOR)
    expected = [SCORE_NOISE / 4 / s**2 if s else 0 for s in (np.deg2rad(0.5), 0, np.deg2rad(1), 0, 0.02, 0)]
    assert known.prior.information == pytest.approx(expected)
    nothing = pose_constraints(ANCHOR, ConstraintsConfig(), 4)
    assert np.isinf(nothing.limits.half).all()
    assert nothing.prior is None


@pytest.mark.parametrize("n", [1, 10])
@pytest.mark.parametrize("optimizer", ["levenberg_marquardt", "nelder_mead"])
def test_a_prior_and_a_score_are_weighed_as_two_measurements(optimizer, n):
    """The score of n frames measures with information n H / SCORE_NOISE, the prior with 1 / sigma^2: between them lies the mean
    of the two, weighted by their information."""
    sigma_deg, sigma_m = np.array([0.5, 1.0, 0.7]), np.array([0.12, 0.2, 0.15])
    config = ConstraintsConfig(sigma_deg=tuple(sigma_deg), sigma_m=tuple(sigma_m))
    prior = pose_constraints(ANCHOR, config, n).prior
    assert prior is not None
    of_prior = np.diag(1 / np.concatenate([np.deg2rad(sigma_deg), sigma_m]) ** 2)
    of_score = n / SCORE_NOISE * CURVATURE
    expected = np.linalg.solve(of_score + of_prior, of_score @ twist(OPTIMUM))
    if optimizer == "nelder_mead":
        T, _ = nelder_mead(Bowl(), ANCHOR, 0.8, 2000, lambda T: prior.cost(T)[0])
    else:
        T, _ = levenberg_marquardt(Bowl(), ANCHOR, 60, prior)
    assert_twist(T, expected, 1e-3)


# --- the whole method -----------------------------------------------------------------------------------------------------


def calibrator(scene: Scene, refine: dict[str, Any] | None = None, **constraints) -> Calibrator:
    return Calibrator(scene.camera, update(QUICK, {"constraints": constraints, "refine": refine or {}}))


def from_start(result) -> np.ndarray:
    """Twist (6,) in deg and m from the initial extrinsic to the result."""
    xi = twist(result.T_camera_lidar, result.initial)
    return np.concatenate([np.rad2deg(xi[:3]), xi[3:]])


@pytest.mark.parametrize(
    ("optimizer", "box"), [("auto", None), ("nelder_mead", None), ("barzilai_borwein", None), ("auto", SearchBox(4, 0.2))]
)
def test_a_camera_whose_place_is_known_is_only_turned(scene, optimizer, box):
    start = scene.off(([0.6, -0.5, 0.6] if box is None else [2.5, -3, 2], [0, 0, 0]))
    start[:3, 3] = -start[:3, :3] @ camera_centre(scene.truth)
    result = calibrator(scene, {"optimizer": optimizer}, limit_m=[0, 0, 0]).estimate(scene.features, start, box)
    scene.assert_found(result, 0.12, 0.02)
    assert np.allclose(camera_centre(result.T_camera_lidar), camera_centre(start), atol=1e-9)


@pytest.mark.parametrize(("optimizer", "box"), [("auto", None), ("nelder_mead", None), ("auto", SearchBox(4, 0.2))])
def test_a_turn_beyond_its_bound_ends_there(scene, optimizer, box):
    start = scene.off(([0, -0.5, 0], [0, 0, 0]))
    result = calibrator(scene, {"optimizer": optimizer}, limit_deg=[180, 0.3, 180], limit_m=[0.05, 0.05, 0.05]).estimate(
        scene.features, start, box
    )
    assert result.converged, result.reason
    moved = from_start(result)
    assert moved[1] == pytest.approx(0.3, abs=2e-3)
    assert np.abs(moved).max() <= 0.3 + 1e-9
    assert np.abs(moved[3:]).max() <= 0.05 + 1e-9


def test_bounds_count_from_the_anchor(scene):
    """As of a recalibration, which begins where it ended last time."""
    anchor, start = scene.off(([0, 0.4, 0], [0, 0, 0])), scene.off(([0, 0.15, 0], [0, 0, 0]))
    result = calibrator(scene, limit_deg=[180, 0.3, 180]).estimate(scene.features, start, anchor=anchor)
    assert result.converged, result.reason
    moved = np.rad2deg(twist(result.T_camera_lidar, anchor)[1])
    assert moved == pytest.approx(-0.3, abs=1e-6)
    assert np.array_equal(result.initial, start)


@pytest.mark.parametrize("box", [None, SearchBox(3, 0.2)])
def test_strong_priors_hold_and_weak_priors_yield(scene, box):
    start, refine = scene.off(NEAR), {"max_p_value": 1}
    tight = {"sigma_deg": [0.02] * 3, "sigma_m": [0.002] * 3}
    result = calibrator(scene, refine, **tight).estimate(scene.features, start, box)
    assert result.converged, result.reason
    moved = from_start(result) / ([0.02] * 3 + [0.002] * 3)
    assert 0.01 < np.abs(moved).max() < 2.5
    wide = {"sigma_deg": [2.0] * 3, "sigma_m": [0.3] * 3}
    scene.assert_found(calibrator(scene, refine, **wide).estimate(scene.features, start, box))


@pytest.mark.parametrize("dense_edges", ["once_per_level", "every_evaluation"])
def test_thesis_objective_respects_constraints(scene, dense_edges):
    values = {
        "refine": {"objective": "thesis"},
        "thesis": {"dense_edges": dense_edges},
        "constraints": {"limit_deg": [180, 0.2, 180], "limit_m": [0, 0, 0]},
    }
    thesis = Calibrator(scene.camera, with_constants(Config.from_dict(values), evaluations=30))
    start = scene.off(([0, 0.6, 0], [0, 0, 0]))
    start[:3, 3] = -start[:3, :3] @ camera_centre(scene.truth)
    features = [thesis.extract(f) for f in scene.frames[:2]]
    objective = thesis.objectives(features, start, start)
    T = objective.optimise(start)
    assert np.allclose(camera_centre(T), camera_centre(start), atol=1e-9)
    assert np.rad2deg(twist(T, start)[1]) == pytest.approx(-0.2, abs=2e-3)
    stay = objective.refine(start)
    assert np.rad2deg(np.abs(twist(stay, start)[1])) <= 0.2 + 1e-9
    assert np.allclose(camera_centre(stay), camera_centre(start), atol=1e-9)


# --- optimisers alone -----------------------------------------------------------------------------------------------------


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
