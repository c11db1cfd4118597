"""Classes in the score: gates, weights of edges by class and of frames by what they show."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from calib_ros.config import Config, SemanticsConfig, update
from calib_ros.frame import UNLABELLED, SemanticClass
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.classes import FrameSemantics, edge_weights
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.score.point_score import FastScore, near_image
from calib_ros_synthetic.drive import SyntheticDrive
from calib_ros_thesis.frame_weights import FEW_FRAMES_SHARE, frame_weights, importance

C = SemanticClass

MATCHED = update(Config(), {"semantics": {"match_classes": True, "weight_vegetation": 1.0, "weight_ground": 1.0}})


def street(width: int = 1242, height: int = 375) -> np.ndarray:
    """Ground below a building, a vehicle in the middle, a pole, and a part that nobody knows at the right."""
    classes = np.full((height, width), C.BUILDING, np.uint8)
    classes[height // 2 :] = C.GROUND
    classes[height // 2 - 40 : height // 2 + 40, width // 2 - 50 : width // 2 + 50] = C.VEHICLE
    classes[: height // 2, 100:104] = C.POLE
    classes[:, width - 80 :] = UNLABELLED
    return classes


def test_gates_are_open_on_and_close_around_their_classes() -> None:
    vehicles, upright = gates(street())
    row, left = 187, 621 - 50
    assert vehicles.dtype == np.float32
    assert vehicles[row, left : left + 100].min() > 0.99
    assert vehicles[row, left - 4] > 0.8  # borders of class maps are off by as much
    assert 0.2 < vehicles[row, left - 6] < 0.9
    assert vehicles[row, left - 14] < 0.001
    assert upright[100, 98:106].min() > 0.9
    assert upright[100, 80] == 0
    assert upright[row, 621] == 0
    assert vehicles[100, 102] == 0
    for gate in (vehicles, upright):  # open where the class is unknown
        assert gate[:, -70:].min() > 0.99
        assert gate[20, -120] == 0


def test_edge_weights_are_those_of_the_configuration() -> None:
    values = {"vehicle": 1.5, "person": 2.5, "pole": 3.5, "building": 0.7, "vegetation": 0.2, "ground": 0.1, "other": 0.9}
    config = SemanticsConfig(**{f"weight_{name}": value for name, value in values.items()})
    label = np.array([*C, UNLABELLED], np.uint8)
    expected = {C[name.upper()]: value for name, value in values.items()} | {C.CYCLIST: 2.5, C.SIGN: 3.5}
    weights = edge_weights(label, config)
    assert weights.dtype == np.float32
    np.testing.assert_allclose(weights, [expected.get(c, 0.9) for c in label.tolist()])
    assert edge_weights(np.zeros(0, np.uint8), config).shape == (0,)


def test_importance_is_the_share_of_main_classes_among_known_pixels() -> None:
    classes = np.full((10, 10), C.GROUND, np.uint8)
    assert importance(classes) == 0
    classes[0, :5] = [C.VEHICLE, C.PERSON, C.CYCLIST, C.POLE, C.SIGN]
    assert importance(classes) == pytest.approx(0.05)
    classes[5:] = UNLABELLED
    assert importance(classes) == pytest.approx(0.1)
    assert importance(np.full((4, 4), UNLABELLED, np.uint8)) is None


def test_frame_weights_grow_with_importance_and_have_mean_one() -> None:
    weights = frame_weights([0.0, 0.1, 0.35])
    assert weights.mean() == pytest.approx(1)
    assert weights[1] / weights[0] == pytest.approx((0.1 + FEW_FRAMES_SHARE) / FEW_FRAMES_SHARE)
    assert weights[2] / weights[1] == pytest.approx((0.35 + FEW_FRAMES_SHARE) / (0.1 + FEW_FRAMES_SHARE))
    weights = frame_weights([0.0, None, 0.2])  # unknown classes weigh as much as others on average
    assert weights[1] == 1
    assert weights[0] + weights[2] == pytest.approx(2)
    assert frame_weights([None, None]).tolist() == frame_weights([0.0, 0.0]).tolist() == [1, 1]
    assert frame_weights([]).shape == (0,)


@pytest.fixture(scope="module")
def features() -> tuple[FrameFeatures, np.ndarray]:
    """A frame whose edges are matched by class, and its extrinsic."""
    drive = SyntheticDrive(seed=3, frames=1, rings=32, width=640, height=192, speed=0)
    frame = drive[0]
    made = Calibrator(frame.camera, MATCHED).extract(frame, FrameSemantics(None, frame.classes, frame.cloud.label))
    assert isinstance(made, FrameFeatures)
    return made, drive.reference


def test_matched_edges_count_as_much_as_the_others(features: tuple[FrameFeatures, np.ndarray]) -> None:
    """At the truth, edges of vehicles and poles score about what they score against edges of anything."""
    made, T = features
    assert made.plain is not None
    matched, plain = (FastScore([f], T, MATCHED.score) for f in (made, made.plain))
    assert matched.points.shape == plain.points.shape
    assert made.points.label is not None
    near = near_image(made.points.xyz, T, made.camera, MATCHED.score.margin)
    tile = channels(made.points.label[near]) > 0
    assert 50 < tile.sum() < len(tile) / 1.5
    a, b = (s.sample(T, -1).copy() for s in (matched, plain))
    assert np.array_equal(a[~tile], b[~tile])
    of_gates, of_all = (float(np.average(e[tile], weights=plain.weights[tile])) for e in (a, b))
    assert of_gates == pytest.approx(of_all, rel=0.5)
    assert of_gates != of_all
    assert matched.at(-1).value(T) == pytest.approx(plain.at(-1).value(T), rel=0.3)


def test_edges_of_no_weight_are_left_out() -> None:
    drive = SyntheticDrive(seed=3, frames=1, rings=32, width=640, height=192, speed=0)
    frame = drive[0]
    config = update(Config(), {"semantics": {"weight_ground": 0.0, "weight_vehicle": 2.0}})
    made = Calibrator(frame.camera, config).extract(frame, FrameSemantics(None, None, frame.cloud.label))
    assert isinstance(made, FrameFeatures)
    assert made.plain is not None
    before, after = made.plain.points, made.points
    assert before.label is not None
    assert after.label is not None
    assert (before.label == C.GROUND).any()
    kept = before.label != C.GROUND
    assert np.array_equal(after.xyz, before.xyz[kept])
    factor = np.where(after.label == C.VEHICLE, 2, np.where(after.label == C.VEGETATION, 0.5, 1))
    np.testing.assert_allclose(after.strength, before.strength[kept] * factor, rtol=1e-6)
    assert made.importance is None


def test_weights_of_frames_reach_the_score(features: tuple[FrameFeatures, np.ndarray]) -> None:
    made, T = features
    rich, poor = dataclasses.replace(made, importance=0.35), dataclasses.replace(made, importance=0.05)
    score = FastScore([rich, poor], T, MATCHED.score)
    share = np.bincount(score.frame, score.weights)
    assert share[0] / share[1] == pytest.approx(0.4 / 0.1, rel=1e-3)
