"""Models in the real node, over DDS: slow models delay nothing, unusable ones are named and left out."""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from onnx import helper
from onnx_graphs import IMAGENET, Type, centres, endless, failing, save, segmentation, value, weights
from rclpy.parameter import Parameter
from ros_peer import Peer, start_parameters
from sam_graphs import other
from vehicle import QUICK

from calib_ros import se3
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.online.events import Event, Problem
from calib_ros.ros.client import result_from_message
from calib_ros_semantics.models.segmentation import MAX_FAILURES
from calib_ros_synthetic.drive import SyntheticDrive

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]
QUICK = {**QUICK, "online__min_keyframes": 2}
SIZE = 64  # of the slow network's input, px


def start(T: np.ndarray) -> dict[str, Any]:
    off = se3.perturb(T, [0.8, -0.7, 0.6], [0.05, -0.04, 0.04])
    return {**start_parameters(off), "initial_from_tf": False, "semantics__segmentation": "auto", **QUICK}


def busy(path: Path, turns: int) -> Path:
    """A network for classes of pixels that convolves its input so many times before it answers."""
    inner = [
        helper.make_node("Identity", ["go"], ["go_on"]),
        helper.make_node("Conv", ["x", "kernel"], ["y"], pads=[1, 1, 1, 1]),
    ]
    given = [value("i", [], Type.INT64), value("go", [], Type.BOOL), value("x", None)]
    body = helper.make_graph(inner, "body", given, [value("go_on", [], Type.BOOL), value("y", None)])
    nodes = [
        helper.make_node("Conv", ["input", "widen"], ["wide"]),
        helper.make_node("Loop", ["turns", "yes", "wide"], ["after"], body=body),
        helper.make_node("ReduceMean", ["after"], ["mean"], axes=[1], keepdims=1),
        helper.make_node("Mul", ["mean", "none"], ["zero"]),
        helper.make_node("Add", ["input", "zero"], ["same"]),
        helper.make_node("Conv", ["same", "w", "b"], ["output"]),
    ]
    constants = {
        "widen": np.ones((32, 3, 1, 1), np.float32),
        "kernel": np.full((32, 32, 3, 3), 1 / 288, np.float32),
        "turns": np.array(turns),
        "yes": np.array(True),
        "none": np.array(0, np.float32),
        **weights(centres(19), 0, *IMAGENET),
    }
    return save(path, nodes, [value("input", [1, 3, SIZE, SIZE])], [value("output", [1, 19, SIZE, SIZE])], constants)


def drive_on(street: list[Frame]) -> Iterator[Frame]:
    """The frames over and over, with stamps that go on."""
    lap = 0
    while True:
        for frame in street:
            stamp = frame.stamp + lap * len(street) * NANOSECONDS
            yield dataclasses.replace(frame, stamp=stamp, cloud_stamp=None)
        lap += 1


def said(peer: Peer) -> dict[str, str]:
    return {v.key: v.value for v in peer.diagnostics[-1].status[0].values} if peer.diagnostics else {}


def semantics(peer: Peer, text: str) -> str:
    """What /diagnostics says of semantics, as soon as that has the text in it."""
    peer.until(lambda: text in said(peer).get("semantics", ""), 10, f"{text} in {said(peer).get('semantics')}")
    return said(peer)["semantics"]


def change(peer: Peer, **named: Any) -> None:
    answer = peer.node.set_parameters_atomically([Parameter(n.replace("__", "."), value=v) for n, v in named.items()])
    assert answer.successful, answer.reason


def accepted(peer: Peer) -> int:
    recalibrator = peer.calibration.pipeline.recalibrator
    return recalibrator.current.accepted if recalibrator else 0


def seconds_of(path: Path) -> float:
    """How long one run of a network takes here and now."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    feed = {"input": np.zeros((1, 3, SIZE, SIZE), np.float32)}
    session.run(None, feed)
    began = time.perf_counter()
    session.run(None, feed)
    return time.perf_counter() - began


@pytest.fixture(scope="module")
def slow(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network that takes about a second, whatever the machine."""
    folder = tmp_path_factory.mktemp("slow")
    trial = seconds_of(busy(folder / "trial.onnx", 100))
    return busy(folder / "slow.onnx", max(round(100 / trial), 1))


@pytest.mark.slow
def test_slow_models_delay_neither_estimates_nor_callbacks(street: list[Frame], drive: SyntheticDrive, slow: Path) -> None:
    # One estimate a second leaves the models, which step back for all others, their turn on a busy machine.
    seldom = {"online__mode": "periodic", "online__period_s": 10.0}
    with Peer(**start(drive.reference), **seldom, semantics__image_classes="") as peer:
        frames = drive_on(street)

        def fed(pairs: int, done: Callable[[], bool] = lambda: True) -> float:
            """99th percentile of the callbacks, ms, at ten pairs a second: so many, and on until done."""
            peer.calibration.health.callback_ms.clear()
            due, fed_so_far = time.monotonic(), 0
            while fed_so_far < pairs or (fed_so_far < 600 and not done()):
                due += 0.1
                time.sleep(max(due - time.monotonic(), 0))
                peer.publish(next(frames), settle=False)
                fed_so_far += 1
            return float(peer.calibration.health.callback_p99_ms)

        without = fed(20)
        peer.settle()
        assert accepted(peer) > 0
        change(peer, semantics__image_classes=str(slow), semantics__cloud_classes="geometric")
        recalibrator = peer.calibration.pipeline.recalibrator
        before, seen = accepted(peer), recalibrator.keyframes_seen
        with_models = fed(30, lambda: recalibrator.segmenter.done > 0 and accepted(peer) > before)
        keyframes, segmented = recalibrator.keyframes_seen - seen, recalibrator.segmenter.done
        # Few of many keyframes: the newest counts whenever the models are free.
        assert 0 < segmented < keyframes
        assert accepted(peer) > before
        # A callback that waited for the model would take as long as one run of it.
        assert with_models < max(3 * without, 500 * recalibrator.segmenter.seconds["image_classes"])
        assert f"image_classes {recalibrator.segmenter.seconds['image_classes']:.1f} s" in semantics(peer, " s; image_classes")
        assert recalibrator.segmenter.seconds["image_classes"] > 0.5
        peer.settle()
        answer = peer.get_extrinsic()
        assert answer.extrinsic.status == "converged"
        T = result_from_message(answer.extrinsic).T_camera_lidar
        assert se3.rotation_error_deg(drive.reference, T) < 0.4
        assert se3.translation_error_m(drive.reference, T) < 0.12


def test_estimates_go_on_and_the_node_ends_while_a_model_runs(street: list[Frame], drive: SyntheticDrive, tmp_path: Path) -> None:
    path, others = endless(tmp_path / "endless.onnx"), set(threading.enumerate())  # of pipelines that other tests left behind
    with Peer(**start(drive.reference), semantics__image_classes=str(path), semantics__budget_s=600.0) as peer:
        peer.publish(street[0], settle=False)
        pipeline = peer.calibration.pipeline
        peer.until(lambda: pipeline.recalibrator and pipeline.recalibrator.segmentation.models[0].model, what="a loaded model")
        time.sleep(0.3)  # by now it runs
        assert pipeline.segmenting
        for k, frame in enumerate(street[1:4]):
            peer.publish(frame, settle=False)
            peer.until(lambda n=k + 2: pipeline.recalibrator.keyframes_seen == n, what="a keyframe")
        peer.until(lambda: accepted(peer) > 0, what="an estimate without classes")
        assert pipeline.segmenting
        peer.node.stop()  # would take 600 s if it waited for the model
        # The thread of the models steps back for all others, so that on a busy machine its last steps take their time.
        peer.until(lambda: not _running(others), what="the end of the model's threads")
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
        "a classifier": ({"image_classes": other(folder / "other.onnx")}, "looks like a classifier of whole pictures", 1),
        "another kind": ({"segment_anything": good}, "looks like a network for classes of pixels", 1),
        "raising": ({"image_classes": failing(folder / "failing.onnx")}, "failing.onnx failed", MAX_FAILURES),
        "too slow": ({"image_classes": endless(folder / "endless.onnx"), "budget_s": 0.1}, "budget of 0.1 s", MAX_FAILURES),
    }


@pytest.mark.slow
def test_unusable_models_are_named_and_left_out(street: list[Frame], drive: SyntheticDrive, tmp_path: Path) -> None:
    with Peer(**start(drive.reference), online__mode="periodic", online__period_s=1.5) as peer:
        lines: list[str] = []
        sink = peer.calibration.pipeline._sink

        def listen(event: Event) -> None:
            if isinstance(event, Problem):
                lines.append(event.message)
            sink(event)

        peer.calibration.pipeline._sink = listen
        frames = drive_on(street)
        for name, (parameters, text, times) in bad_models(tmp_path).items():
            lines.clear()
            before = accepted(peer)
            defaults = {"image_classes": "", "segment_anything": "", "cloud_classes": "geometric", "budget_s": 30.0}
            new = {**defaults, **{k: v if isinstance(v, float) else str(v) for k, v in parameters.items()}}
            change(peer, **{f"semantics__{k}": v for k, v in new.items()})
            for _ in range(times + 1):
                peer.publish(next(frames))
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
        frames = drive_on(street)
        for _ in range(3):
            peer.publish(next(frames))
        recalibrator = peer.calibration.pipeline.recalibrator
        assert semantics(peer, "3 keyframes").startswith("3 keyframes; image_classes ")  # the builtin one
        assert all(f.plain is not None and f.view is not None for f in recalibrator.buffer)
        change(peer, semantics__image_classes="")
        assert len(recalibrator.buffer) == 0
        for _ in range(3):
            peer.publish(next(frames))
        assert semantics(peer, "none") == "none: no models are configured"
        assert all(f.plain is None for f in recalibrator.buffer)
        change(peer, semantics__image_classes=str(path))
        assert len(recalibrator.buffer) == 0
        for _ in range(4):
            peer.publish(next(frames))
        assert all(f.plain is not None and f.view is not None for f in recalibrator.buffer)
        assert semantics(peer, "7 keyframes").startswith("7 keyframes; image_classes 0.")  # of both networks
        models = recalibrator.segmentation
        change(peer, search__starts=128, monitor__enabled=False)
        peer.publish(next(frames))
        assert recalibrator.segmentation is models
        assert len(recalibrator.buffer) == 5
        change(peer, semantics__segmentation="none")
        for _ in range(3):
            peer.publish(next(frames))
        assert all(f.plain is None for f in recalibrator.buffer)
        assert semantics(peer, "none") == "none: no models are configured"
        assert peer.calibration.health.errors == 0, peer.last_error()
        refused = peer.node.set_parameters([Parameter("semantics.provider", value="abacus")])[0]
        assert not refused.successful
        assert "semantics.provider" in refused.reason
