"""The global search: number of rounds, reported counts, limits of the box."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scenes import FAR, NEAR, Scene, assert_not_used, same

from calib_ros import se3
from calib_ros.config import Config, ScoreConfig, SearchConfig, update
from calib_ros.datasets import open_dataset
from calib_ros.errors import ConfigError
from calib_ros.registration.acceptance.significance import null_distribution
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.progress import Progress
from calib_ros.registration.score.point_score import FastScore
from calib_ros.registration.search.constraints import SearchBox, unlimited
from calib_ros.registration.search.search import AGREEMENT, FRUITLESS_ROUNDS, SearchResult, search

SMALL = SearchConfig(starts=32, rounds=8)
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
    frames: tuple[int, ...] = (0, 1),
    max_p_value: float = ACCEPTED,
) -> SearchResult:
    start = scene.off(by)
    score = FastScore([scene.features[k] for k in frames], start, ScoreConfig(), 0.9)
    return search(score, start, box, config, unlimited(start), max_p_value)


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


def test_starts_that_agree_on_what_may_be_chance_end_the_search_after_some_rounds(scene, monkeypatch, few_followed):
    monkeypatch.setattr("calib_ros.registration.search.search.AGREEMENT", 1)
    clear = found(scene, FAR, SearchBox(5, 0.3))
    assert clear.rounds < FRUITLESS_ROUNDS
    unclear = found(scene, FAR, SearchBox(5, 0.3), max_p_value=0.0)
    assert unclear.rounds == FRUITLESS_ROUNDS
    monkeypatch.setattr("calib_ros.registration.search.search.AGREEMENT", 1000)
    assert found(scene, FAR, SearchBox(5, 0.3)).rounds == SMALL.rounds


def test_the_decoy_is_searched_only_in_doubt(scene):
    clear = found(scene, FAR, SearchBox(5, 0.3))
    assert clear.decoy_z is None
    blurred = [replace(f, image=cv2.GaussianBlur(f.image, (0, 0), 12)) for f in scene.frames[:1]]
    features, start = [scene.calibrator.extract(f) for f in blurred], scene.off(FAR)
    score = FastScore(features, start, ScoreConfig(), 0.9)
    doubtful = search(score, start, SearchBox(5, 0.3), SMALL, unlimited(start), ACCEPTED)
    assert doubtful.decoy_z is not None
    assert 0 < doubtful.decoy_z < 8


def test_the_decoy_holds_no_alignment(scene):
    """The mirrored maps are the maps of the mirrored image, and the truth is nothing special there."""
    score = FastScore(scene.features, scene.truth, ScoreConfig())
    assert null_distribution(score, scene.truth).z_score > 10
    decoy = score.mirrored()
    assert null_distribution(decoy, scene.truth).z_score < 4
    frame, camera = scene.frames[0], scene.camera
    K = camera.K * [[1, 1, 0], [1, 1, 1], [1, 1, 1]] + [[0, 0, camera.width - 1 - camera.K[0, 2]], [0, 0, 0], [0, 0, 0]]
    other = replace(frame, image=np.ascontiguousarray(frame.image[:, ::-1]), camera=replace(camera, K=K))
    mirror = FastScore([Calibrator(other.camera).extract(other)], scene.truth, ScoreConfig(), 5.0)
    one = FastScore(scene.features[:1], scene.truth, ScoreConfig(), 5.0).mirrored()
    assert one.at(-1).value(scene.truth) == pytest.approx(mirror.at(-1).value(scene.truth), abs=0.02)


def test_the_result_counts_the_starts_of_the_search(scene):
    config = Config(search=SMALL)
    result = Calibrator(scene.camera, config).estimate(scene.features, scene.off(FAR), SearchBox(5, 0.3))
    scene.assert_found(result)
    assert result.starts is not None
    agreed, climbed = result.starts
    assert result.to_dict()["starts"] == {"agreed": agreed, "climbed": climbed}
    assert AGREEMENT <= agreed <= climbed
    assert scene.calibrator.estimate(scene.features, scene.off(NEAR)).starts is None


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
    few = Calibrator(scene.camera, Config(search=replace(SMALL, rounds=1)))
    assert_not_used(few.estimate(features, start, SearchBox(3, 0.2)), start)


# --- the box --------------------------------------------------------------------------------------------------------------


def test_box_widths_may_differ_per_axis(scene):
    start = scene.off(([0.5, -5, 0.5], [0.05, 0, -0.3]))
    scene.assert_found(scene.calibrator.estimate(scene.features, start, SearchBox((1.0, 7.0, 1.0), (0.1, 0.1, 0.4))))


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
