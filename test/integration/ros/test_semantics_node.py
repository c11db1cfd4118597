"""Models in the real node, over DDS: slow models delay nothing, unusable ones are named and left out."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from onnx_graphs import endless, failing, segmentation
from ros_peer import Peer, start_parameters
from sam_graphs import other
from vehicle import QUICK, Vehicle, is_right, off

from calib_ros.frame import Frame
from calib_ros.online.events import Event, Problem
from calib_ros_semantics.models.segmentation import MAX_FAILURES
from calib_ros_synthetic.drive import SyntheticDrive

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]
QUICK = {**QUICK, "online__min_keyframes": 2}


def start(T: np.ndarray) -> dict[str, Any]:
    return {**start_parameters(off(T)), "initial_from_tf": False, "semantics__segmentation": "auto", **QUICK}


def semantics(peer: Peer, text: str) -> str:
    """What /diagnostics says of semantics, as soon as that has the text in it."""
    return peer.until(lambda: text in (said := peer.values.get("semantics", "")) and said, f"diagnostics with {text}")


def accepted(peer: Peer) -> int:
    recalibrator = peer.recalibrator
    return recalibrator.current.accepted if recalibrator else 0


def test_estimates_go_on_and_the_node_ends_while_a_model_runs(street: list[Frame], drive: SyntheticDrive, tmp_path: Path) -> None:
    path, others = endless(tmp_path / "endless.onnx"), set(threading.enumerate())  # of pipelines that other tests left behind
    with Peer(**start(drive.reference), semantics__image_classes=str(path), semantics__budget_s=600.0) as peer:
        peer.publish(street[0], settle=False)
        peer.until(lambda: "calib_deadline" in _running(others), "a model that runs")
        for k, frame in enumerate(street[1:4]):
            peer.publish(frame, settle=False)
            peer.until(lambda n=k + 2: peer.recalibrator.keyframes_seen == n, "a keyframe")
        peer.until(lambda: accepted(peer) > 0, "an estimate without classes")
        answer = peer.get_extrinsic()
        assert answer.extrinsic.status == "converged"
        assert is_right(drive.reference, answer.extrinsic)
        peer.new_values()
        assert "calib_deadline" in _running(others), "the model has not ended"
        peer.node.stop()  # would take 600 s if it waited for the model
        # The thread of the models steps back for all others, so that on a busy machine its last steps take their time.
        peer.until(lambda: not _running(others), "the end of the model's threads")
        assert peer.calibration.health.errors == 0, peer.last_error()


def _running(others: set[threading.Thread]) -> list[str]:
    """Threads of models that are not among the others."""
    return [t.name for t in set(threading.enumerate()) - others if t.name in ("calib_semantics", "calib_deadline")]


def bad_models(folder: Path) -> dict[str, tuple[dict[str, Any], str, int]]:
    """Parameters, what is said of them, and how often."""
    good = segmentation(folder / "good.onnx", 19, outputs=[("scores", [1, 19, 256, 512])])
    (folder / "cut.onnx").write_bytes(good.read_bytes()[:300])
    (folder / "letter.onnx").write_text("Dear reader,\n")
    return {
        "missing": ({"image_classes": folder / "none.onnx"}, "semantics.image_classes is off: model", 1),
        "truncated": ({"image_classes": folder / "cut.onnx"}, "cannot be loaded", 1),
        "foreign": ({"image_classes": folder / "letter.onnx"}, "cannot be loaded", 1),
        "a classifier": ({"image_classes": other(folder / "other.onnx")}, "none of its outputs is a map of classes", 1),
        "another kind": ({"segment_anything": good}, "a network for classes of pixels is for semantics.image_classes", 1),
        "raising": ({"image_classes": failing(folder / "failing.onnx")}, "failing.onnx failed", MAX_FAILURES),
        "too slow": ({"image_classes": endless(folder / "endless.onnx"), "budget_s": 0.1}, "budget of 0.1 s", MAX_FAILURES),
    }


@pytest.mark.slow
def test_unusable_models_are_named_and_left_out(street: list[Frame], drive: SyntheticDrive, tmp_path: Path) -> None:
    with Peer(**start(drive.reference), online__mode="periodic", online__period_s=1.5) as peer:
        lines: list[str] = []
        sink = peer.pipeline._sink

        def listen(event: Event) -> None:
            if isinstance(event, Problem):
                lines.append(event.message)
            sink(event)

        peer.pipeline._sink = listen
        vehicle = Vehicle(peer, street, drive.reference)
        for name, (parameters, text, times) in bad_models(tmp_path).items():
            lines.clear()
            before = accepted(peer)
            defaults = {"image_classes": "", "segment_anything": "", "cloud_classes": "geometric", "budget_s": 30.0}
            new = {**defaults, **{k: v if isinstance(v, float) else str(v) for k, v in parameters.items()}}
            peer.change(**{f"semantics__{k}": v for k, v in new.items()})
            for _ in range(times + 1):
                peer.publish(vehicle.frame(1.0))
            assert len(lines) == times, (name, lines)
            assert all(text in line and "\n" not in line for line in lines), (name, lines)
            kind = next(iter(parameters))
            assert all(f"semantics.{kind}" in line for line in lines), name
            assert "off" in lines[-1], name
            assert f"{kind} is off" in semantics(peer, f"{kind} is off"), name
            assert accepted(peer) > before, name
            assert peer.get_extrinsic().extrinsic.status == "converged", name


def test_models_come_and_go_at_run_time(
    street: list[Frame], drive: SyntheticDrive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # This network sees brightness.
    monkeypatch.setattr("calib_ros_semantics.models.segmentation.judge", lambda model, answer: ("", ""))
    path = segmentation(tmp_path / "net.onnx", 19, outputs=[("scores", [1, 19, 256, 512])])
    with Peer(**start(drive.reference), online__mode="manual") as peer:
        vehicle = Vehicle(peer, street, drive.reference)
        peer.drive(vehicle.frame(1.0) for _ in range(3))
        recalibrator = peer.recalibrator
        assert semantics(peer, "3 keyframes").startswith("3 keyframes; image_classes ")  # the builtin one
        assert all(f.plain is not None and f.view is not None for f in recalibrator.buffer)
        peer.change(semantics__image_classes="")
        assert len(recalibrator.buffer) == 0
        peer.drive(vehicle.frame(1.0) for _ in range(3))
        assert semantics(peer, "none") == "none: no models are configured"
        assert all(f.plain is None for f in recalibrator.buffer)
        peer.change(semantics__image_classes=str(path))
        assert len(recalibrator.buffer) == 0
        peer.drive(vehicle.frame(1.0) for _ in range(4))
        assert all(f.plain is not None and f.view is not None for f in recalibrator.buffer)
        assert semantics(peer, "7 keyframes").startswith("7 keyframes; image_classes ")  # of both networks
        models = recalibrator.segmentation
        peer.change(search__starts=128, monitor__enabled=False)
        peer.publish(vehicle.frame(1.0))
        assert recalibrator.segmentation is models
        assert len(recalibrator.buffer) == 5
        peer.change(semantics__segmentation="none")
        peer.drive(vehicle.frame(1.0) for _ in range(3))
        assert all(f.plain is None for f in recalibrator.buffer)
        assert semantics(peer, "none") == "none: no models are configured"
        assert peer.calibration.health.errors == 0, peer.last_error()
        assert "semantics.provider" in peer.set(semantics__provider="abacus")
