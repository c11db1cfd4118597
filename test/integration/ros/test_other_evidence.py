"""Other evidence in the real node, over DDS: models for classes, and the thesis's objective; at the start and at run time."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest
from onnx_graphs import endless, segmentation
from ros_peer import Peer, start_parameters
from vehicle import QUICK, Vehicle, is_right, off

from calib_ros import se3
from calib_ros_thesis.features import ThesisFeatures

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]
QUICK = {**QUICK, "online__min_keyframes": 2}


def start(T: np.ndarray) -> dict[str, Any]:
    return {**start_parameters(off(T)), "initial_from_tf": False, "semantics__segmentation": "auto", **QUICK}


def semantics(peer: Peer, text: str) -> str:
    """What /diagnostics says of semantics, as soon as that has the text in it."""
    return peer.until(lambda: text in (said := peer.values.get("semantics", "")) and said, f"diagnostics with {text}")


def test_estimates_go_on_and_the_node_ends_while_a_model_runs(street, drive, tmp_path):
    path, others = endless(tmp_path / "endless.onnx"), set(threading.enumerate())  # of pipelines that other tests left behind
    with Peer(**start(drive.reference), semantics__image_classes=str(path), semantics__budget_s=600.0) as peer:
        peer.publish(street[0], settle=False)
        peer.until(lambda: "calib_deadline" in _running(others), "a model that runs")
        for k, frame in enumerate(street[1:4]):
            peer.publish(frame, settle=False)
            peer.until(lambda n=k + 2: peer.recalibrator.keyframes.seen == n, "a keyframe")
        peer.until(lambda: peer.recalibrator.current.accepted, "an estimate without classes")
        answer = peer.get_extrinsic().extrinsic
        assert answer.status == "converged"
        assert is_right(drive.reference, answer)
        peer.new_values()
        assert "calib_deadline" in _running(others), "the model has not ended"
        peer.node.stop()  # would take 600 s if it waited for the model
        # The thread of the models steps back for all others, so that on a busy machine its last steps take their time.
        peer.until(lambda: not _running(others), "the end of the model's threads")
        assert peer.calibration.health.errors == 0, peer.last_error()


def _running(others: set[threading.Thread]) -> list[str]:
    """Threads of models that are not among the others."""
    return [t.name for t in set(threading.enumerate()) - others if t.name.startswith(("calib_semantics", "calib_deadline"))]


def test_models_come_and_go_at_run_time(street, drive, tmp_path, monkeypatch):
    # This network sees brightness.
    monkeypatch.setattr("calib_ros_semantics.models.segmentation.judge", lambda model, answer: ("", ""))
    path = segmentation(tmp_path / "net.onnx", 19, outputs=[("scores", [1, 19, 256, 512])])
    with Peer(**start(drive.reference), online__mode="manual") as peer:
        vehicle = Vehicle(peer, street, drive.reference)

        def drives(keyframes: int, classes: bool, said: str) -> None:
            """New keyframes with classes, or without; and what /diagnostics says."""
            assert peer.recalibrator is None or len(peer.recalibrator.keyframes) == 0
            peer.drive(vehicle.frame(1.0) for _ in range(keyframes))
            assert {f.plain is not None for f in peer.recalibrator.keyframes.features} == {classes}
            assert not classes or all(f.view is not None for f in peer.recalibrator.keyframes.features)
            assert semantics(peer, said).startswith(said)

        drives(3, True, "3 keyframes; image_classes ")  # the builtin one
        peer.change(semantics__image_classes="")
        drives(3, False, "none: no models are configured")
        peer.change(semantics__image_classes=str(path))
        drives(4, True, "7 keyframes; image_classes ")  # of both networks
        models = peer.recalibrator.segmentation
        peer.change(search__starts=128, monitor__enabled=False)
        peer.publish(vehicle.frame(1.0))
        assert peer.recalibrator.segmentation is models
        assert len(peer.recalibrator.keyframes) == 5
        peer.change(semantics__segmentation="none")
        drives(3, False, "none: no models are configured")
        assert peer.calibration.health.errors == 0, peer.last_error()
        peer.change(semantics__segmentation="auto", semantics__image_classes=str(tmp_path / "none.onnx"))
        peer.drive(vehicle.frame(1.0) for _ in range(3))  # an unusable one is named and left out
        assert "semantics.image_classes is off: " in peer.last_error()
        assert semantics(peer, "image_classes is off")
        assert peer.trigger("calibrate").success
        assert "semantics.provider" in peer.set(semantics__provider="abacus")


# --- the thesis's objective

REFINE_ONLY = {"search__rotation_deg": 0.0, "search__translation_m": 0.0, "online__min_keyframes": 3}


def near(T: np.ndarray) -> np.ndarray:
    return se3.perturb(T, [0.5, -0.4, 0.3], [0.03, -0.02, 0.03])


def test_the_objective_changes_at_run_time(street, drive, monkeypatch):
    def kinds() -> list[type]:
        return [type(f.own) for f in peer.recalibrator.keyframes.features]

    monkeypatch.setattr("calib_ros_thesis.config.ThesisConfig.evaluations", 30)
    with Peer(**start_parameters(near(drive.reference)), **REFINE_ONLY, online__mode="manual") as peer:
        peer.drive(street[:2])
        assert kinds() == 2 * [type(None)]
        peer.change(refine__objective="thesis")
        assert kinds() == []
        peer.drive(street[2:4])
        assert kinds() == 2 * [ThesisFeatures]
        message = peer.trigger("calibrate").message  # eq. 3.12 itself, edges anew at every evaluation
        assert "2 keyframes" in message
        assert "score nan" not in message
        # What cannot be is refused, and loses nothing.
        assert "thesis.dense_edges: once_per_level" in peer.set(refine__optimizer="levenberg_marquardt")
        assert kinds() == 2 * [ThesisFeatures]
        peer.change(thesis__operator="canny")
        assert kinds() == []
        peer.publish(street[4])
        assert [len(f.own.image_edges) for f in peer.recalibrator.keyframes.features] == [2]
        peer.change(refine__objective="fast")
        peer.drive(street[5:7])
        assert kinds() == 2 * [type(None)]
        done = peer.trigger("calibrate")
        assert done.success, done.message
