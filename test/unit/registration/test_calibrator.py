"""The calibrator on a small synthetic drive whose extrinsic is known exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import FAR, NEAR, QUICK, QUICK_SEARCH, Scene, assert_not_used, same

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.config import Config, ImageConfig, RefineConfig, ScoreConfig, SearchConfig
from calib_ros.errors import BadInputError, ConfigError, TooFewFeaturesError
from calib_ros.frame import Frame, PointCloud
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import FeatureExtractor
from calib_ros.registration.objective import FastObjective
from calib_ros.registration.score.point_score import FastScore
from calib_ros.registration.search.constraints import SearchBox, unlimited
from calib_ros.registration.search.search import Optimum, SearchSpace, SeedingStrategy, add_optimum, search, seed_starts
from calib_ros.result import INSUFFICIENT, RefusalCode, Result


@pytest.fixture(scope="module")
def other() -> Scene:
    return Scene(2)


def cloudless(frame: Frame, name: str = "") -> Frame:
    return replace(frame, cloud=PointCloud(np.zeros((0, 3), np.float32)), name=name or frame.name)


# --- refinement -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("optimizer", ["levenberg_marquardt", "nelder_mead"])
def test_refinement_recovers_a_displaced_sensor(scene, optimizer, sign):
    start = scene.off(sign * np.array(NEAR))
    result = Calibrator(scene.camera, Config(refine=RefineConfig(optimizer=optimizer))).estimate(scene.features, start)
    scene.assert_found(result)
    assert result.score > result.initial_score + 0.1
    assert result.frames_used == len(result.frame_scores) == 4
    assert np.array_equal(result.initial, start)
    assert np.mean(result.frame_scores) == pytest.approx(result.score, abs=0.1)


def test_the_truth_is_kept(scene):
    result = scene.calibrator.estimate(scene.features, scene.truth)
    scene.assert_found(result)
    assert result.score >= result.initial_score


def test_an_estimate_is_its_own_best_start(scene):
    result = scene.calibrator.estimate(scene.features, scene.off(NEAR))
    for _ in range(2):
        again = scene.calibrator.estimate(scene.features, result.T_camera_lidar)
        assert again.converged, again.reason
        assert again.score >= again.initial_score
        assert se3.rotation_error_deg(result.T_camera_lidar, again.T_camera_lidar) < 0.03
        assert se3.translation_error_m(result.T_camera_lidar, again.T_camera_lidar) < 0.006
        result = again


def test_better_start_is_kept(scene, monkeypatch):
    """The ascent may lose its way, a hair or far: the optimum at the start then scores higher, and counts."""
    best = scene.calibrator.estimate(scene.features, scene.truth).T_camera_lidar

    def estimate(detour_deg: float) -> Result:
        end = se3.perturb(best, [0, detour_deg, 0], [0, 0, 0])
        with monkeypatch.context() as m:
            m.setattr(FastObjective, "optimise", lambda self, T, searched, progress: end)
            return scene.calibrator.estimate(scene.features, best)

    for detour_deg in (0.1, 0.35, 1.5):
        result = estimate(detour_deg)
        assert result.converged, result.reason
        assert result.score >= result.initial_score
        assert se3.rotation_error_deg(best, result.T_camera_lidar) < 0.03


def test_the_covariance_covers_the_error(scene):
    result = scene.calibrator.estimate(scene.features, scene.off(NEAR))
    error = se3.log(scene.truth @ se3.inverse(result.T_camera_lidar))
    sigma = np.sqrt(np.diag(result.covariance))
    assert (np.abs(error) < 4 * sigma).all()
    assert (sigma[:3] < np.deg2rad(1)).all()
    assert (sigma[3:] < 0.3).all()
    # What one frame says is less, and still covers the error.
    one = scene.calibrator.estimate(scene.features[:1], scene.off(NEAR))
    sigma_of_one = np.sqrt(np.diag(one.covariance))
    assert (sigma_of_one > sigma).all()
    assert (np.abs(se3.log(scene.truth @ se3.inverse(one.T_camera_lidar))) < 4 * sigma_of_one).all()
    assert (sigma_of_one[:3] < np.deg2rad(2)).all()


def test_a_move_beyond_the_limit_is_refused(scene, monkeypatch):
    start = scene.off(NEAR)
    for deg, m, says in ((0.3, 0.5, "at the limit of 0.3 deg / 0.5 m"), (3.0, 0.02, "0.02 m")):
        monkeypatch.setattr(f"{Calibrator.__module__}.REFINEMENT_DEG", deg)
        monkeypatch.setattr(f"{Calibrator.__module__}.REFINEMENT_M", m)
        result = Calibrator(scene.camera).estimate(scene.features, start)
        assert_not_used(result, start)
        assert says in result.reason
        assert "widen the search" in result.reason
        assert result.refusal is RefusalCode.TOO_FAR_FROM_START
        # Kept for inspection; it is where the leash ends, not the optimum beyond.
        xi = np.abs(se3.log(result.optimum @ se3.inverse(start)))
        half = np.array([np.deg2rad(deg)] * 3 + [m] * 3)
        assert (xi <= half * 1.001).all()
        assert (xi >= half * 0.97).any()


def test_grey_shrunk_and_unlit_input(scene):
    """Grey pictures, half the size, clouds without intensity: the same answer, a little less exact."""
    frames = [
        replace(f, image=np.ascontiguousarray(f.image[:, :, 1]), cloud=replace(f.cloud, intensity=None)) for f in scene.frames[:3]
    ]
    calibrator = Calibrator(scene.camera, replace(QUICK, image=ImageConfig(max_width=320)))
    assert calibrator.extract.camera.width == 320
    result = calibrator.calibrate(frames, scene.off(NEAR))
    scene.assert_found(result, 0.25, 0.06)
    assert "no intensity" in result.reason


@pytest.mark.parametrize(
    ("model", "D"), [("plumb_bob", [-0.25, 0.06, 5e-4, -1e-3, 0.0]), ("equidistant", [0.05, -0.02, 0.003, 0.0])]
)
def test_distorted_pictures_are_calibrated_as_they_are(model, D):
    camera = Camera(np.array([[330.0, 0, 315], [0, 332, 121], [0, 0, 1]]), 640, 240, model, np.array(D))
    lens = Scene(3, 2, camera=camera)
    lens.assert_found(lens.calibrator.estimate(lens.features, lens.off(NEAR)), 0.25, 0.05)
    # Taken for a pinhole, the same pictures give another answer.
    ideal = Camera(camera.K, 640, 240)
    frames = [replace(f, camera=ideal) for f in lens.frames]
    wrong = Calibrator(ideal, QUICK).calibrate(frames, lens.off(NEAR))
    assert not lens.is_near(wrong.T_camera_lidar, 0.25, 0.05)


# --- search ---------------------------------------------------------------------------------------------------------------


def test_search_recovers_starts_beyond_refinement(scene):
    start = scene.off(FAR)
    refined = scene.quick.estimate(scene.features, start)
    assert not refined.converged
    shares = []
    result = scene.calibrator.estimate(
        scene.features, start, SearchBox(5, 0.3), lambda stage, share: shares.append((stage, share))
    )
    scene.assert_found(result)
    assert {stage for stage, _ in shares} == {"search"}
    values = [share for _, share in shares]
    assert np.diff(values).min() > -1e-9
    assert len(set(values)) > 20
    assert (values[0] < 0.1, values[-1]) == (True, 1)


def test_the_same_input_gives_the_same_bits(scene):
    start, box = scene.off(FAR), SearchBox(5, 0.3)
    config = replace(QUICK, search=replace(QUICK_SEARCH, rounds=2))
    first, second = (Calibrator(scene.camera, config).calibrate(scene.frames[:2], start, box) for _ in range(2))
    assert same(first, second)
    reseeded = replace(config, search=replace(config.search, seed=1))
    third = Calibrator(scene.camera, reseeded).estimate(scene.features[:2], start, box)
    assert not np.array_equal(first.T_camera_lidar, third.T_camera_lidar)


def test_threads_do_not_change_the_answer(scene):
    import cv2

    threads = cv2.getNumThreads()
    try:
        results = []
        for n in (1, threads):
            cv2.setNumThreads(n)
            results.append(scene.quick.calibrate(scene.frames[:2], scene.off(NEAR)))
    finally:
        cv2.setNumThreads(threads)
    assert same(*results)


def test_the_search_stays_in_its_box(scene):
    score = FastScore(scene.features, scene.off(FAR), ScoreConfig())
    config, start = SearchConfig(starts=256, rounds=1), scene.off(FAR)
    found = search(score, start, SearchBox(1, 0.1), config, unlimited(start), 1.8)
    xi = se3.log(found.T @ se3.inverse(start))
    assert np.abs(np.rad2deg(xi[:3])).max() < 2.5
    assert np.abs(xi[3:]).max() < 0.35


@pytest.mark.parametrize("rounds", [1, pytest.param(8, marks=pytest.mark.slow)])
def test_a_box_that_does_not_hold_the_truth_is_refused(scene, rounds):
    start = se3.perturb(scene.truth, [0, 25, 0], [0, 0, 0])
    calibrator = Calibrator(scene.camera, replace(QUICK, search=replace(QUICK_SEARCH, rounds=rounds)))
    assert_not_used(calibrator.estimate(scene.features, start, SearchBox(3, 0.2)), start)


def test_starts_fill_the_box_and_differ(scene, monkeypatch):
    monkeypatch.setattr("calib_ros.registration.search.search.DISTINCT", 40)
    score = FastScore(scene.features, scene.truth, ScoreConfig())
    half = SearchBox(4, 0.2).half_width()
    assert half == pytest.approx([np.deg2rad(4)] * 3 + [0.2] * 3)
    space = SearchSpace(score, scene.truth, SearchBox(4, 0.2), SearchConfig(starts=300), unlimited(scene.truth))
    strategies = [SeedingStrategy(space.first, space.first, level) for level in (0, 1, 0)]
    rounds = [seed_starts(space, strategy, with_prior=k == 0) for k, strategy in enumerate(strategies)]
    units = [np.array([se3.log(T @ se3.inverse(scene.truth)) / half for T in starts]) for starts in rounds]
    for starts, unit, level in zip(rounds, units, (0, 1, 0), strict=True):
        assert len(starts) == 40
        assert np.abs(unit).max() <= 1 + 1e-9
        assert (np.ptp(unit, axis=0) > 0.4).all()
        assert np.median(np.ptp(unit, axis=0)) > 1.6
        apart = np.abs(unit[:, None] - unit).max(axis=2) + np.eye(40)
        assert apart.min() > 0.11
        values = [space.first.at(level).value(T) for T in starts]
        assert (np.diff(values) < 2e-3).all()  # the best first
    nearest = [np.abs(unit).max(axis=1).min() for unit in units]
    assert nearest[0] < 1e-9  # the prior, here the truth, is one of the first
    assert min(nearest[1:]) > 0.01
    between = [np.abs(units[i][:, None] - units[j]).max(axis=2).min() for i, j in ((0, 1), (0, 2), (1, 2))]
    assert min(between) > 1e-6  # no start is tried twice


def test_optima_that_are_the_same_count_together(scene):
    score = FastScore(scene.features, scene.truth, ScoreConfig())
    space = SearchSpace(score, scene.truth, SearchBox(4, 0.2), SearchConfig(), unlimited(scene.truth))
    optima: list[Optimum] = []
    best = scene.calibrator.estimate(scene.features, scene.truth).T_camera_lidar
    near, beside, apart = ([0.3, 0, 0], [0, 0, 0]), ([0.8, 0, 0], [0, 0, 0]), ([0, 0, 0], [0, 0.15, 0])
    for by in (near, ([0, 0, 0], [0, 0, 0]), ([0, 0, 0.2], [0, 0, 0]), ([0.2, 0, 0], [0.05, 0, 0]), beside, apart, near):
        T = se3.perturb(best, *by)
        add_optimum(optima, T, space.coarse.at(2).value(T) - space.penalty(T))
    assert [o.count for o in optima] == [5, 1, 1]
    # Of those that are the same the best is kept.
    assert np.array_equal(optima[0].T, se3.perturb(best, [0, 0, 0], [0, 0, 0]))
    assert np.array_equal(optima[1].T, se3.perturb(best, *beside))
    assert optima[0].value > max(o.value for o in optima[1:])
    assert optima[0].value == space.coarse.at(2).value(best) - space.penalty(best)


@pytest.mark.parametrize("values", [(-1, 0.1), (46, 0.1), (5, -0.1), (5, 3.1), (float("nan"), 0.1)])
def test_boxes_out_of_range_are_refused(values):
    with pytest.raises(ConfigError, match=r"SearchBox\.\w+ = .* is out of range \[0, (45|3)\]"):
        SearchBox(*values)


def test_an_empty_box_means_refine_only(scene):
    assert SearchBox(0, 0).is_empty
    assert not SearchBox(1, 0).is_empty
    assert not SearchBox(0, 0.1).is_empty
    start, two = scene.off(NEAR), scene.features[:2]
    assert same(scene.calibrator.estimate(two, start, SearchBox(0, 0)), scene.calibrator.estimate(two, start))


@pytest.mark.parametrize(
    ("box", "by"), [(SearchBox(5, 0), ([4, -3, 2], [0, 0, 0])), (SearchBox(0, 0.4), ([0, 0, 0], [0.3, -0.3, 0.3]))]
)
def test_an_axis_that_is_not_searched_is_still_refined(scene, box, by):
    scene.assert_found(scene.quick.estimate(scene.features, scene.off(by), box))


# --- what cannot be calibrated --------------------------------------------------------------------------------------------


# A search of eight rounds where nothing can be found takes half a minute; one round shows the same refusal.
REFINE_OR_SEARCH = pytest.mark.parametrize(
    ("box", "config"),
    [
        pytest.param(None, QUICK, id="refine"),
        pytest.param(SearchBox(5, 0.3), QUICK, id="one round"),
        pytest.param(SearchBox(5, 0.3), Config(), id="search", marks=pytest.mark.slow),
    ],
)


@REFINE_OR_SEARCH
def test_pictures_of_another_scene_are_refused(scene, other, box, config):
    frames = [replace(a, image=b.image) for a, b in zip(scene.frames, other.frames, strict=True)]
    assert_not_used(Calibrator(scene.camera, config).calibrate(frames, scene.truth, box), scene.truth)


@REFINE_OR_SEARCH
@pytest.mark.parametrize(
    ("level", "noise"),
    [
        pytest.param(0, 0, id="black"),
        pytest.param(255, 0, id="white", marks=pytest.mark.slow),
        pytest.param(40, 3, id="dark", marks=pytest.mark.slow),
        pytest.param(128, 80, id="noise"),
    ],
)
def test_pictures_that_show_nothing_are_refused(scene, level, noise, box, config):
    rng = np.random.default_rng(0)
    images = [np.clip(rng.normal(level, noise, f.image.shape), 0, 255).astype(np.uint8) for f in scene.frames]
    frames = [replace(f, image=image) for f, image in zip(scene.frames, images, strict=True)]
    assert_not_used(Calibrator(scene.camera, config).calibrate(frames[:2], scene.off(NEAR), box), scene.off(NEAR))


def test_swapped_frames_are_refused(scene):
    frames = [replace(f, image=scene.frames[(k + 2) % 4].image) for k, f in enumerate(scene.frames)]
    assert_not_used(scene.quick.calibrate(frames, scene.off(NEAR)), scene.off(NEAR))


def test_converged_score_is_at_least_the_initial_score(scene, other):
    """Whatever the start and the pictures."""
    rng = np.random.default_rng(0)
    for trial in range(6):
        features = [(scene, other)[trial % 2].features[k] for k in rng.choice(4, 2, replace=False)]
        start = se3.perturb(scene.truth, rng.uniform(-3, 3, 3), rng.uniform(-0.3, 0.3, 3))
        result = scene.quick.estimate(features, start)
        if result.converged:
            assert result.score >= result.initial_score
        else:
            assert_not_used(result, start)


def test_frame_with_an_empty_cloud_is_left_out_by_name(scene):
    frames = [scene.frames[0], cloudless(scene.frames[1], "lost"), *scene.frames[2:]]
    stages = []
    result = scene.quick.calibrate(frames, scene.off(NEAR), progress=lambda stage, share: stages.append((stage, share)))
    scene.assert_found(result)
    assert result.frames_used == 3
    assert "frame lost left out" in result.reason
    assert stages == [("features", k / 4) for k in (1, 2, 3, 4)]
    unnamed = replace(cloudless(scene.frames[1]), name="")
    assert "frame 1 left out" in scene.quick.calibrate([scene.frames[0], unnamed], scene.truth).reason


def test_frames_without_clouds_are_insufficient(scene):
    result = scene.calibrator.calibrate(
        [cloudless(f, f"f{k}") for k, f in enumerate(scene.frames)], scene.truth, SearchBox(5, 0.3)
    )
    assert_not_used(result, scene.truth, INSUFFICIENT)
    assert result.frames_used == 0
    assert "f0 left out" in result.reason
    assert "f3 left out" in result.reason
    with pytest.raises(TooFewFeaturesError):
        scene.calibrator.extract(cloudless(scene.frames[0]))


def test_initial_extrinsic_facing_away_has_too_few_points(scene, monkeypatch):
    monkeypatch.setattr("calib_ros.registration.score.point_score.MARGIN", 0.0)
    sky = se3.perturb(scene.truth, [90, 0, 0], [0, 0, 0])
    result = Calibrator(scene.camera).estimate(scene.features, sky)
    assert_not_used(result, sky, INSUFFICIENT)
    assert "wait for a scene with objects" in result.reason


def test_frames_that_do_not_belong_together_are_refused(scene, other):
    first = scene.frames[0]
    moved = replace(first, camera=Camera(first.camera.K + np.diag([2.0, 2, 0]), 640, 240), name="b")
    with pytest.raises(BadInputError, match="frame b carries another camera calibration"):
        scene.calibrator.calibrate([first, moved], scene.truth)
    with pytest.raises(BadInputError, match="000000 and z carry different calibrations"):
        scene.calibrator.calibrate([first, replace(other.frames[0], name="z")], scene.truth)
    unreferenced = replace(first, reference=None)
    scene.assert_found(scene.quick.calibrate([unreferenced, scene.frames[1]], scene.truth))


@pytest.mark.parametrize("initial", [np.eye(3), np.diag([1.0, 1, -1, 1]), np.full((4, 4), np.nan), "x"])
def test_an_initial_that_is_no_transform_is_refused(scene, initial):
    with pytest.raises(BadInputError, match="the initial extrinsic"):
        scene.calibrator.calibrate(scene.frames, initial)


def test_no_frames_are_refused(scene):
    with pytest.raises(BadInputError, match="no frames given"):
        scene.calibrator.calibrate([], scene.truth)


def test_features_do_not_depend_on_the_extrinsic(scene):
    frame, features = scene.frames[2], scene.features[2]
    assert (features.stamp, features.name, features.has_reflectivity) == (frame.stamp, frame.name, True)
    again = FeatureExtractor(scene.camera)(replace(frame, reference=None))
    assert np.array_equal(features.points.xyz, again.points.xyz)
    assert all(np.array_equal(a.maps, b.maps) for a, b in zip(features.levels, again.levels, strict=True))
