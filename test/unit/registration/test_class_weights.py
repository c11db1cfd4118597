"""Classes in the scores: weights of edges by class, and of frames by what they show."""

from __future__ import annotations

import numpy as np
import pytest

from calib_ros.config import Config, SemanticsConfig, update
from calib_ros.frame import UNLABELLED, SemanticClass
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.classes import FrameSemantics, edge_weights
from calib_ros.registration.features import FrameFeatures
from calib_ros_synthetic.drive import SyntheticDrive
from calib_ros_thesis.frame_weights import FEW_FRAMES_SHARE, frame_weights, importance

C = SemanticClass


def test_edge_weights_are_those_of_the_configuration() -> None:
    config = SemanticsConfig(
        weight_vehicle=1.5,
        weight_person=2.5,
        weight_pole=3.5,
        weight_building=0.7,
        weight_vegetation=0.2,
        weight_ground=0.1,
        weight_other=0.9,
    )
    label = np.array([*C, UNLABELLED], np.uint8)
    expected = {
        C.VEHICLE: 1.5,
        C.PERSON: 2.5,
        C.CYCLIST: 2.5,
        C.POLE: 3.5,
        C.SIGN: 3.5,
        C.BUILDING: 0.7,
        C.VEGETATION: 0.2,
        C.GROUND: 0.1,
    }
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


def test_a_frame_of_unknown_classes_weighs_as_much_as_others_on_average() -> None:
    weights = frame_weights([0.0, None, 0.2])
    assert weights[1] == 1
    assert weights[0] + weights[2] == pytest.approx(2)
    assert frame_weights([None, None]).tolist() == [1, 1]
    assert frame_weights([0.0, 0.0]).tolist() == [1, 1]
    assert frame_weights([]).shape == (0,)


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
