"""What all baselines have in common: they score the truth highest, come nearer to it, and refuse what they cannot use."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scenes import Scene

from calib_ros import se3
from calib_ros.errors import TooFewFeaturesError
from calib_ros.registration.search.constraints import SearchBox
from calib_ros_evaluation.methods.edges import Castorena, Levinson
from calib_ros_evaluation.methods.information import Nid, Pandey
from calib_ros_evaluation.methods.method import Method
from calib_ros_evaluation.methods.mulfeat import Mulfeat

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
