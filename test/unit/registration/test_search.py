"""The global search: rounds, reported counts, limits of the box, threads; and what speaks for its optimum."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from scenes import FAR, NEAR, Scene, same

from calib_ros import se3
from calib_ros.config import Config, ScoreConfig, SearchConfig, update
from calib_ros.datasets import open_dataset
from calib_ros.errors import ConfigError
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.covariance import disagreement
from calib_ros.registration.estimate import check_uncertainty
from calib_ros.registration.objective import FastScore
from calib_ros.registration.progress import SILENT, Progress
from calib_ros.registration.score.chance import p_value
from calib_ros.registration.search.constraints import Limits, SearchBox, unlimited
from calib_ros.registration.search.optimizers import levenberg_marquardt
from calib_ros.registration.search.parallel import Workers, cpu_time
from calib_ros.registration.search.search import FRUITLESS_ROUNDS, HOPELESS_ROUNDS, SearchResult, search

SMALL = SearchConfig(starts=32, rounds=8)
RANKED, LARGE = SearchConfig(starts=1024, rounds=2), SearchBox(6, 0.4)  # so large that starts are ranked first
ACCEPTED = 0.01  # largest p value


@pytest.fixture
def few_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    """So few starts are optimised in a round that it takes several."""
    monkeypatch.setattr("calib_ros.registration.search.search.DISTINCT", 4)
    monkeypatch.setattr("calib_ros.registration.search.search.CLIMBED", 2)


def found(
    scene: Scene,
    by: tuple[list[float], list[float]],
    box: SearchBox,
    config: SearchConfig = SMALL,
    max_p_value: float = ACCEPTED,
    progress: Progress = SILENT,
) -> SearchResult:
    start = scene.off(by)
    score = FastScore(scene.features[:2], start, ScoreConfig(), 0.9)
    return search(score, start, box, config, unlimited(start), max_p_value, progress=progress)


def test_starts_that_agree_end_the_search_and_are_counted(scene, monkeypatch, few_followed):
    """It goes on until as many starts as wanted have ended at the best optimum."""
    box, rounds = SearchBox(5, 0.3), []
    for agreement in (1, 5, 10):
        monkeypatch.setattr("calib_ros.registration.search.search.AGREEMENT", agreement)
        result = found(scene, FAR, box, replace(SMALL, rounds=50))
        assert scene.is_near(result.T, 0.1, 0.02)
        assert agreement <= result.agreed <= result.optimised
        assert result.optimised % result.rounds == 0
        rounds.append(result.rounds)
    assert rounds[0] < rounds[1] < rounds[2] < 50


def test_a_search_ends_where_starts_agree_on_what_may_be_chance_or_the_decoy_is_as_good(scene, monkeypatch, few_followed):
    monkeypatch.setattr("calib_ros.registration.search.search.AGREEMENT", 1)
    clear = found(scene, FAR, SearchBox(5, 0.3))
    assert clear.rounds < FRUITLESS_ROUNDS
    unclear = found(scene, FAR, SearchBox(5, 0.3), max_p_value=0.0)
    assert unclear.rounds == FRUITLESS_ROUNDS
    monkeypatch.setattr("calib_ros.registration.search.search.AGREEMENT", 1000)
    assert found(scene, FAR, SearchBox(5, 0.3)).rounds == SMALL.rounds
    mirrored = FastScore(scene.features[:2], start := scene.off(FAR), ScoreConfig(), 0.9).mirrored()
    assert search(mirrored, start, SearchBox(5, 0.3), SMALL, unlimited(start), ACCEPTED).rounds == HOPELESS_ROUNDS


def test_the_decoy_is_searched_only_in_doubt(scene):
    clear = found(scene, FAR, SearchBox(5, 0.3))
    assert clear.decoy_z is None
    blurred = [replace(f, image=cv2.GaussianBlur(f.image, (0, 0), 12)) for f in scene.frames[:1]]
    features, start = [scene.calibrator.extract(f) for f in blurred], scene.off(FAR)
    score = FastScore(features, start, ScoreConfig(), 0.9)
    doubtful = search(score, start, SearchBox(5, 0.3), SMALL, unlimited(start), ACCEPTED)
    assert doubtful.decoy_z is not None
    assert 0 < doubtful.decoy_z < 8


def test_search_without_a_match_ends_after_its_rounds(scene):
    """Pictures of another moment: no start finds anything, and the search says when to stop, not luck."""
    frames = [replace(f, image=scene.frames[(k + 2) % 4].image) for k, f in enumerate(scene.frames)]
    features = [scene.calibrator.extract(f) for f in frames]
    score, start = FastScore(features, scene.truth, ScoreConfig()), scene.off(NEAR)
    shares: list[float] = []
    watch = Progress(lambda stage, share: shares.append(share))
    for rounds in (1, 2):
        shares.clear()
        result = search(score, start, SearchBox(3, 0.2), replace(SMALL, rounds=rounds), unlimited(start), ACCEPTED, None, watch)
        assert result.rounds == rounds
        assert np.diff(shares).min() > -1e-9
        assert shares[-1] == 1


# --- the box --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "values", [(-1, 0.1), (5, 3.1), ((1.0, 2.0), 0.1), ((1.0, 46.0, 1.0), 0.1), (1.0, (0.1, float("nan"), 0.1)), ("wide", 0.1)]
)
def test_invalid_boxes_are_refused(values):
    with pytest.raises(ConfigError, match=r"SearchBox\.\w+ = .* is out of range .*; give a number, or three"):
        SearchBox(*values)


# --- repeatable -----------------------------------------------------------------------------------------------------------


def test_the_result_does_not_depend_on_the_start(scene):
    rng = np.random.default_rng(3)
    starts = [se3.perturb(scene.truth, rng.uniform(-0.8, 0.8, 3), rng.uniform(-0.08, 0.08, 3)) for _ in range(5)]
    results = [scene.calibrator.estimate(scene.features, T) for T in starts]
    for other in results[1:]:
        assert se3.rotation_error_deg(results[0].T_camera_lidar, other.T_camera_lidar) < 1e-3
        assert se3.translation_error_m(results[0].T_camera_lidar, other.T_camera_lidar) < 2e-4
        assert other.score == pytest.approx(results[0].score, abs=3e-5)  # steps of a thousandth of a degree end the ascent
    assert same(results[0], scene.calibrator.estimate(scene.features, starts[0]))


@pytest.mark.slow
def test_a_wide_box_among_near_shelves_is_searched_closer_by_where_starts_disagree():
    """From 20 deg / 1 m the six rounds alone end at an optimum that shares some of its edges, 1.7 deg / 42 cm away."""
    drive = open_dataset("synthetic:rig=os1_64_robot,scene=warehouse,frames=5")
    calibrator = Calibrator(drive.camera, update(Config(), {"semantics": {"image_classes": "", "cloud_classes": ""}}))
    start = np.random.default_rng([0, 0, 1, 2, 3, 4]).uniform(-1, 1, 6) * ([np.deg2rad(20)] * 3 + [1.0] * 3)
    result = calibrator.calibrate([drive[k] for k in range(5)], se3.exp(start) @ drive.reference, SearchBox(20, 1))
    assert result.converged, result.reason
    assert se3.rotation_error_deg(result.T_camera_lidar, drive.reference) < 0.2
    assert se3.translation_error_m(result.T_camera_lidar, drive.reference) < 0.02
    assert result.starts[0] >= 3


# --- threads --------------------------------------------------------------------------------------------------------------


class Ended(Exception):
    """What a callback raises."""


def on_threads(scene: Scene, threads: int, **options: Any) -> tuple[object, ...]:
    """The bits of a search on so many threads."""
    result = found(scene, FAR, LARGE, replace(RANKED, threads=threads), **options)
    nearby = tuple(T.tobytes() for T in result.nearby)
    return result.T.tobytes(), result.agreed, result.optimised, result.rounds, result.decoy_z, nearby


def test_any_number_of_threads_finds_the_same_to_the_last_bit(scene):
    reports: dict[int, list[float]] = {}
    results = {}
    for threads in (1, 2, 5):
        own = reports.setdefault(threads, [])
        results[threads] = on_threads(
            scene, threads, progress=Progress(lambda stage, share, own=own: own.append(share)), max_p_value=0.0
        )
    assert results[1][3] == 2
    assert results[1] == results[2] == results[5]
    assert reports[1] == reports[2] == reports[5]
    assert np.diff(reports[1]).min() > -1e-9


@pytest.mark.parametrize(("threads", "after"), [(1, 0.2), (2, 0.0), (2, 0.4)])
def test_a_callback_that_raises_ends_the_search(scene, threads, after):
    shares: list[float] = []

    def callback(stage: str, share: float) -> None:
        shares.append(share)
        if share >= after:
            raise Ended

    with pytest.raises(Ended):
        on_threads(scene, threads, progress=Progress(callback))
    assert all(share < after for share in shares[:-1])
    assert not [t.name for t in threading.enumerate() if t.name.startswith("calib_search")]
    calls = len(shares)
    assert on_threads(scene, threads) == on_threads(scene, 1)  # nothing of it is left
    assert len(shares) == calls


def test_the_cpu_time_of_the_pool_is_that_of_its_owner():
    def busy(seconds: float) -> None:
        began = time.thread_time()
        while time.thread_time() - began < seconds:
            pass

    for threads in (1, 2):
        before, own = cpu_time(), time.thread_time()
        with Workers(threads) as workers:
            list(workers.map(busy, [0.02, 0.03]))
        counted, own = cpu_time() - before, time.thread_time() - own
        assert counted >= 0.05
        assert counted - own == pytest.approx(0.0 if threads == 1 else 0.05, abs=0.02)


# --- evidence -------------------------------------------------------------------------------------------------------------


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
        assert "add frames of other scenes" in str(refusal)
