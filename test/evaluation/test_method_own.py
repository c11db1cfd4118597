"""The two methods of this project behave in the comparison as they do alone; and what all baselines have in common."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scenes import NEAR, Scene
from thesis_constants import with_constants

from calib_ros import se3
from calib_ros.config import Config, preset
from calib_ros.errors import TooFewFeaturesError
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import FeatureExtractor
from calib_ros.registration.objective import FastScore
from calib_ros.registration.search.constraints import Limits, SearchBox
from calib_ros.registration.search.optimizers import nelder_mead
from calib_ros_evaluation.methods.edges import Castorena, Levinson
from calib_ros_evaluation.methods.information import Nid, Pandey
from calib_ros_evaluation.methods.method import Method
from calib_ros_evaluation.methods.mulfeat import Mulfeat
from calib_ros_evaluation.methods.own import LINEARISATION, Own, Thesis, counted, methods
from calib_ros_thesis.score import ThesisScore

# The features of these scenes were made without semantics: what is compared with them has none either.
NONE = {"semantics": {"segmentation": "none"}}
PLAIN = Config.from_dict(NONE)
THESIS = with_constants(Config.from_dict({"refine": {"objective": "thesis"}, **NONE}), evaluations=60)
CLASSES = {"semantics": {"cloud_classes": "geometric"}}


# ---- ours ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("reach", [SearchBox(0.0, 0.0), SearchBox(2.0, 0.2)])
def test_ours_is_the_calibrator_to_the_bit(scene: Scene, reach: SearchBox):
    method, start = Own(PLAIN), scene.off(NEAR)
    features = [method.features(f) for f in scene.frames]
    outcome = method.optimise(features, start, reach)
    expected = Calibrator(scene.camera).estimate(scene.features, start, reach)
    assert expected.converged
    assert outcome.T.tobytes() == expected.T_camera_lidar.tobytes()
    assert outcome.refused == ""
    again = method.optimise(features, start, reach)
    assert (again.T.tobytes(), again.evaluations) == (outcome.T.tobytes(), outcome.evaluations)


def test_score_of_ours_is_the_finest_fast_score(scene: Scene):
    # Also where the configuration asks for the thesis's objective: that is another method.
    for config in (PLAIN, THESIS):
        method = Own(config)
        score = method.score([method.features(f) for f in scene.frames], scene.truth)
        direct = FastScore(scene.features, scene.truth, Config().score).at(-1)
        for T in (scene.truth, scene.off(NEAR)):
            assert score.value(T) == direct.value(T)
    assert method.name == "ours"


def test_evaluations_are_counted_one_by_one(scene: Scene):
    score = FastScore(scene.features, scene.truth, Config().score)
    some = score.subset(500, np.random.default_rng(0))
    many = np.stack([scene.truth] * 7)
    with counted() as count:
        for call, more in (
            (lambda: score.at(0).value(scene.truth), 1),
            (lambda: score.at(-1).linearise(scene.truth), LINEARISATION),
            (lambda: some.at(0).value(scene.truth), 1),
            (lambda: some.values(many, 2), 7),
            (lambda: score.values(many, 2), 7),
            (lambda: score.frame_values(many, 2), 7),
            (lambda: score.frame_scores(scene.truth), 1),
        ):
            before = count[0]
            call()
            assert count[0] - before == more
        value = score.at(-1).value(scene.truth)
    before = count[0]
    assert score.at(-1).value(scene.truth) == value
    assert count[0] == before


def test_too_little_in_the_image_is_a_refusal(scene: Scene):
    method, away = Own(), se3.from_parts(np.eye(3), [0, 0, -500.0])
    features = [method.features(f) for f in scene.frames[:1]]
    with pytest.raises(TooFewFeaturesError, match="edge points near the image"):
        method.score(features, away)
    outcome = method.optimise(features, away, SearchBox(1.0, 0.1))
    assert "edge points near the image" in outcome.refused
    assert np.array_equal(outcome.T, away)


# ---- the thesis ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def thesis() -> Thesis:
    return Thesis(THESIS)


def test_the_score_of_the_thesis_is_eq_3_12_over_frames(scene: Scene, thesis: Thesis):
    # Whatever objective is configured: the method is the thesis's.
    features = [Thesis(PLAIN).features(f) for f in scene.frames[:2]]
    extract = FeatureExtractor(scene.camera, THESIS)
    direct = ThesisScore([extract(f).own for f in scene.frames[:2]], scene.truth, THESIS)
    for T in (scene.truth, scene.off(NEAR)):
        J = direct.frame_scores(T, -1)
        assert Thesis(PLAIN).score(features, scene.truth).value(T) == pytest.approx(float(J.mean()), rel=1e-12)
    assert thesis.name == "thesis"


def test_the_thesis_goes_from_smoothing_to_smoothing(scene: Scene, thesis: Thesis):
    """From the start itself, by simplexes of 0.4 and 0.2 times the reach of 2 deg, and of what moves a point at 10 m as far."""
    features, start = [thesis.features(f) for f in scene.frames[:2]], scene.off(NEAR)
    reach = SearchBox(2.0, float(10 * np.deg2rad(2.0)))
    outcome = thesis.optimise(features, start, reach)
    direct = ThesisScore([f.own for f in features], start, THESIS)
    T = start
    for level, step in enumerate((0.8, 0.4)):
        T, _ = nelder_mead(direct.at(level), T, step, 60, limits=Limits(start, reach.half_width()))
    assert np.allclose(outcome.T, T, rtol=0, atol=1e-12)
    assert direct.at(-1).value(outcome.T) > direct.at(-1).value(start)
    assert se3.rotation_error_deg(scene.truth, outcome.T) < 0.6 * se3.rotation_error_deg(scene.truth, start)
    assert outcome.refused == ""
    assert 60 < outcome.evaluations <= 2 * 60 + 12
    again = thesis.optimise(features, start, reach)
    assert (again.T.tobytes(), again.evaluations) == (outcome.T.tobytes(), outcome.evaluations)


# ---- semantics ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [Own, Thesis])
def test_semantics_take_part_where_they_are_configured(scene: Scene, kind: type[Own] | type[Thesis]):
    plain, seen = kind(PLAIN).features(scene.frames[0]), kind(Config.from_dict(CLASSES)).features(scene.frames[0])
    assert plain.points.label is None
    assert seen.points.label is not None
    assert seen.points.label.any()


def test_a_preset_leaves_the_other_method_its_optimiser():
    found = {name: methods(preset("thesis"))[name].own_config.refine for name in ("ours", "thesis")}
    assert {name: (refine.objective, refine.optimizer) for name, refine in found.items()} == {
        "ours": ("fast", "auto"),
        "thesis": ("thesis", "nelder_mead"),
    }


# --- baselines ------------------------------------------------------------------------------------------------------------


METHODS = (Pandey(), Levinson(), Castorena(), Mulfeat(), Nid())
SIDES = np.eye(6)[:5] * np.repeat([1.0, 0.2], [3, 2])[:, None]  # deg and m; a street says little of what lies ahead


@pytest.fixture(scope="module", params=METHODS, ids=lambda m: m.name)
def method(request: pytest.FixtureRequest) -> Method:
    return request.param


@pytest.fixture(scope="module")
def features(method: Method, scene: Scene) -> list[Any]:
    return [method.features(frame) for frame in scene.frames]


def test_the_truth_scores_higher_than_what_is_1_deg_or_20_cm_off(method: Method, features: list[Any], scene: Scene) -> None:
    score = method.score(features, scene.truth)
    truth = score.value(scene.truth)
    for by in (*SIDES, *-SIDES):
        assert score.value(se3.perturb(scene.truth, by[:3], by[3:])) < truth, by


def test_optimiser_comes_nearer_and_is_repeatable(method: Method, features: list[Any], scene: Scene) -> None:
    start = se3.perturb(scene.truth, [0.4, -0.5, 0.4], [0.04, -0.03, 0.04])
    before = start.copy()
    found, again = (method.optimise(features, start, SearchBox(1.0, 0.1)) for _ in range(2))
    np.testing.assert_array_equal(found.T, again.T)
    assert (found.evaluations, found.refused) == (again.evaluations, "")
    np.testing.assert_array_equal(start, before)
    assert method.score(features, start).value(found.T) > method.score(features, start).value(start)
    assert se3.rotation_error_deg(scene.truth, found.T) < 0.6 * se3.rotation_error_deg(scene.truth, start)
    assert (np.abs(se3.log(found.T @ se3.inverse(start))) <= SearchBox(1.0, 0.1).half_width() + 1e-9).all()


def test_too_few_points_are_refused(method: Method, features: list[Any], scene: Scene) -> None:
    few = replace(scene.frames[0], cloud=scene.frames[0].cloud.select(np.arange(9)))
    with pytest.raises(TooFewFeaturesError, match="usable points"):
        method.features(few)
    ahead = replace(scene.frames[0], cloud=scene.frames[0].cloud.select(scene.frames[0].cloud.xyz[:, 0] > 2))
    backwards = se3.perturb(scene.truth, [0, 180, 0], [0, 0, 0])
    with pytest.raises(TooFewFeaturesError, match="check the initial extrinsic"):
        method.score([method.features(ahead)], backwards)
