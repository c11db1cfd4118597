"""Classes: where the search begins, which p value is accepted, and weights of edges and of frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import RenderedDrive

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.config import Config, SearchConfig, update
from calib_ros.frame import UNLABELLED
from calib_ros.frame import SemanticClass as C
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.classes import FrameSemantics, consistency_score, edge_weights
from calib_ros.registration.estimate import RATIO_CONSISTENT, RATIO_INCONSISTENT, semantic_likelihood_ratio
from calib_ros.registration.initial_guess import nominal
from calib_ros.registration.objective import FastScore
from calib_ros.registration.search.constraints import SearchBox, unlimited
from calib_ros.registration.search.search import SEED_LEVELS, search
from calib_ros.result import CONVERGED, REFUSED, Evidence, RefusalCode, Result
from calib_ros_synthetic.drive import SyntheticDrive
from calib_ros_thesis.features import FEW_FRAMES_SHARE, frame_weights, importance

QUICK = Config(search=SearchConfig(rounds=2, starts=256, rotation_deg=2, translation_m=0.15))
SOURCE = update(QUICK, {"semantics": {"image_classes": "source", "cloud_classes": "source"}})
OFF = np.array([0.02, 0.2, -0.03, 0.1, -0.2, 0.1])  # rad, m: 11 deg to the side


@pytest.fixture(scope="module")
def source() -> SyntheticDrive:
    return RenderedDrive(seed=31, frames=2, width=640, height=240, speed=0, stride=30)


@pytest.fixture(scope="module")
def features(source):
    calibrator = Calibrator(source[0].camera, SOURCE)
    return [calibrator.extract(f, calibrator.segmentation(f)) for f in (source[0], source[1])]


def test_semantic_consistency_is_highest_at_the_truth(source, features):
    """Without common classes nothing is said about it."""
    consistency = consistency_score([f.view for f in features])
    assert semantic_likelihood_ratio(consistency, source.reference) == RATIO_CONSISTENT
    assert semantic_likelihood_ratio(consistency, se3.exp(-OFF) @ source.reference) == RATIO_INCONSISTENT
    assert consistency_score([]) is None
    blank = replace(features[0].view, classes=np.full_like(features[0].view.classes, UNLABELLED))
    assert consistency_score([blank]) is None
    assert semantic_likelihood_ratio(None, source.reference) == 1.0


def test_the_classes_decide_where_the_edges_leave_a_doubt(source, features):
    """Of a refinement for which a multiple of its p value is accepted without classes."""
    at, unseen = source.reference, [replace(f, view=None) for f in features]
    mixed = [replace(f, view=replace(f.view, classes=np.roll(f.view.classes, 160, axis=1))) for f in features]  # of another place
    for given, rows in (
        (features, [(0.5, CONVERGED, ""), (0.1, REFUSED, "the optimum may be chance")]),  # too little whatever the classes say
        (unseen, [(0.5, REFUSED, ""), (2, CONVERGED, "")]),
        # The same edges are not enough any more.
        (mixed, [(0.5, REFUSED, ""), (2, REFUSED, "few labelled points meet pixels of their class"), (10, CONVERGED, "")]),
    ):
        p_value = Calibrator(source.camera, SOURCE).estimate(given, at).evidence.p_value
        for share, status, says in rows:
            accepting = update(SOURCE, {"refine": {"max_p_value": share * p_value}})
            result = Calibrator(source.camera, accepting).estimate(given, at)
            assert result.status == status, (share, result.reason)
            assert says in result.reason
            assert given is mixed or "labelled points" not in result.reason


def test_the_search_is_seeded_by_classes_too(source, features):
    """By a strategy of their own, beside those that begin where edges meet best."""
    T = se3.perturb(source.reference, [3, -3, 3], [0.2, -0.2, 0.2])
    consistency = consistency_score([features[0].view])
    score = FastScore([features[0]], T, SOURCE.score, 0.9)
    optimised = []
    for guide in (None, consistency):
        found, again = (search(score, T, SearchBox(8, 0.5, 1), SOURCE.search, unlimited(T), 1.8, guide=guide) for _ in range(2))
        assert np.array_equal(found.T, again.T)
        assert se3.rotation_error_deg(source.reference, found.T) < 0.5
        optimised.append(found.optimised)
    assert optimised[1] == optimised[0] * (len(SEED_LEVELS) + 1) / len(SEED_LEVELS)


@pytest.mark.parametrize(
    ("refusal", "off_deg", "stays"),
    [
        (None, 0.1, False),
        (RefusalCode.TOO_UNCERTAIN, 0.1, True),
        (RefusalCode.NOT_SIGNIFICANT, 0.1, True),
        (RefusalCode.NOT_SIGNIFICANT, 2.0, False),
        (RefusalCode.WRONG_INTRINSICS, 0.1, False),
    ],
)
def test_what_edges_alone_are_sure_of_is_not_refused_there_for_want_of_evidence(
    monkeypatch: pytest.MonkeyPatch, refusal: RefusalCode | None, off_deg: float, stays: bool
) -> None:
    T = nominal()
    there = se3.perturb(T, [off_deg, 0, 0], [0, 0, 0])
    sure = Result(T, CONVERGED, evidence=Evidence(8.0, None, 0.001, 1.0))
    after = Result(there, CONVERGED) if refusal is None else Result(T, REFUSED, refusal=refusal, optimum=there)
    calibrator = Calibrator(Camera(np.array([[300.0, 0, 320], [0, 300, 120], [0, 0, 1]]), 640, 240))
    answers = iter((sure, after))
    monkeypatch.setattr(calibrator, "estimate", lambda *_: next(answers))
    plain, classified = [object()], [object()]
    found = calibrator.again_in_doubt(calibrator.estimate(plain, T), plain, lambda: (classified, ["with classes"]), T)
    assert found.converged == (stays or refusal is None)
    assert (found.evidence is sure.evidence) == stays
    assert (found.reason == "with classes") == stays


# --- weights --------------------------------------------------------------------------------------------------------------


def test_edges_of_vegetation_and_the_ground_weigh_half() -> None:
    label = np.array([*C, UNLABELLED], np.uint8)
    weights = edge_weights(label)
    assert weights.dtype == np.float32
    np.testing.assert_allclose(weights, [0.5 if c in (C.VEGETATION, C.GROUND) else 1 for c in label.tolist()])
    assert edge_weights(np.zeros(0, np.uint8)).shape == (0,)


def test_frame_weights_grow_with_the_share_of_main_classes_and_have_mean_one() -> None:
    classes = np.full((10, 10), C.GROUND, np.uint8)
    assert importance(classes) == 0
    classes[0, :5] = [C.VEHICLE, C.PERSON, C.CYCLIST, C.POLE, C.SIGN]
    assert importance(classes) == pytest.approx(0.05)
    classes[5:] = UNLABELLED
    assert importance(classes) == pytest.approx(0.1)
    assert importance(np.full((4, 4), UNLABELLED, np.uint8)) is None
    unknown = frame_weights([0.0, None, 0.2])
    assert (unknown[1], unknown.mean()) == (1, pytest.approx(1))
    assert frame_weights([0.0, 0.0]).tolist() == frame_weights([None, None]).tolist() == [1, 1]
    weights = frame_weights([0.0, 0.1, 0.35])
    assert weights.mean() == pytest.approx(1)
    assert weights[1] / weights[0] == pytest.approx((0.1 + FEW_FRAMES_SHARE) / FEW_FRAMES_SHARE)
    assert weights[2] / weights[1] == pytest.approx((0.35 + FEW_FRAMES_SHARE) / (0.1 + FEW_FRAMES_SHARE))


def test_weights_of_edges_change_their_strength_alone() -> None:
    frame = SyntheticDrive(seed=3, frames=1, rings=32, width=640, height=192, speed=0)[0]
    made = Calibrator(frame.camera).extract(frame, FrameSemantics(None, None, frame.cloud.label))
    assert made.plain is not None
    before, after = made.plain.points, made.points
    assert after.label is not None
    assert np.array_equal(after.xyz, before.xyz)
    np.testing.assert_allclose(after.strength, before.strength * edge_weights(after.label), rtol=1e-6)
    assert len(np.unique(edge_weights(after.label))) == 2
    assert made.levels is made.plain.levels
