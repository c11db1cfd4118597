"""Segmentation without ROS: models, keyframes with semantics, and their effect on score and estimate."""

from __future__ import annotations

import gc
import itertools
import json
import re
import sys
import weakref
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import onnxruntime
import pytest
import yaml
from onnx_graphs import endless, failing, segmentation
from scenes import QUICK_SEARCH, RenderedDrive

from calib_ros import se3
from calib_ros.cli import main
from calib_ros.config import Config, OnlineConfig, SemanticsConfig, TrackerConfig, update
from calib_ros.errors import MissingDependencyError, ModelError
from calib_ros.frame import MAIN_CLASSES, UNLABELLED, Frame
from calib_ros.frame import SemanticClass as C
from calib_ros.online.keyframes import KeyframeBuffer
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.classes import OF_CLASSES, FrameSemantics
from calib_ros.registration.initial_guess import nominal, nominal_start
from calib_ros.registration.objective import FastScore
from calib_ros.registration.score.chance import UNDOUBTED_Z
from calib_ros.registration.search.constraints import SearchBox
from calib_ros.result import CONVERGED, INITIAL, INSUFFICIENT, Result
from calib_ros_semantics.models.segmentation import MAX_FAILURES, SegmentationModels
from calib_ros_synthetic.drive import SyntheticDrive
from calib_ros_thesis.features import FEW_FRAMES_SHARE

pytestmark = pytest.mark.usefixtures("rendered_once")
FRAMES = 4
SOURCE = {"image_classes": "source", "cloud_classes": "source"}
# A small search is enough for these tests.
QUICK = Config(
    search=replace(QUICK_SEARCH, rotation_deg=2.0, translation_m=0.15),
    online=OnlineConfig(min_keyframes=2, buffer_size=FRAMES),
    tracker=TrackerConfig(confirmations=0),
)
GUESSED = {"initial": {"method": "semantic"}}


def with_models(config: Config = QUICK, **semantics) -> Config:
    return update(config, {"semantics": semantics})


@pytest.fixture(scope="module")
def source() -> SyntheticDrive:
    return RenderedDrive(seed=31, frames=FRAMES, width=640, height=240, speed=0, stride=30)


@pytest.fixture(scope="module")
def drive(source) -> list[Frame]:
    return [source[k] for k in range(FRAMES)]


@pytest.fixture(scope="module")
def frame(drive) -> Frame:
    return drive[0]


@pytest.fixture
def start(source) -> np.ndarray:
    return se3.perturb(source.reference, [0.8, -0.7, 0.9], [0.05, -0.06, 0.07])


def lit(frame: Frame, grey: int) -> Frame:
    return replace(frame, image=np.full_like(frame.image, grey))


def asked(frame: Frame, **semantics) -> tuple[SegmentationModels, FrameSemantics]:
    models = SegmentationModels(SemanticsConfig(**{"cloud_classes": "", **semantics}))
    return models, models(frame)


def test_unloadable_model_is_reported_once_and_the_others_work(tmp_path, frame):
    cut = segmentation(tmp_path / "cut.onnx")
    cut.write_bytes(cut.read_bytes()[:300])
    for path in (cut, tmp_path / "none.onnx"):
        models, seen = asked(frame, image_classes=str(path), cloud_classes="source")
        (line,) = seen.problems
        assert re.fullmatch(rf"semantics\.image_classes is off: .*{path}.*", line)
        assert seen.classes is None
        assert np.array_equal(seen.labels, frame.cloud.label)
        again = models(frame)
        assert again.problems == ()
        assert [kind for kind, _ in again.seconds] == ["cloud_classes"]
        assert models.active
        with pytest.raises(ModelError, match=path.name):
            SegmentationModels(models.config).load()
        assert not asked(frame, image_classes=str(path))[0].active


@pytest.fixture
def any_classes(monkeypatch: pytest.MonkeyPatch) -> None:
    """For small graphs that find one class everywhere."""
    monkeypatch.setattr("calib_ros_semantics.models.segmentation.judge", lambda model, answer: ("", ""))


def test_classes_that_cannot_be_right_are_no_evidence_and_are_said_once(tmp_path, frame, monkeypatch):
    path = segmentation(tmp_path / "n.onnx")
    models = SegmentationModels(SemanticsConfig(image_classes=str(path), cloud_classes=""))
    said = []
    for _ in range(MAX_FAILURES + 1):
        seen = models(lit(frame, 250))  # one colour, one class
        assert (seen.classes, seen.edges) == (None, None)
        said.append(len(seen.problems))
    assert said == [1, 0, 0, 0]
    assert models.active, "a covered lens is no reason to switch a model off"
    monkeypatch.setattr("calib_ros_semantics.models.segmentation.judge", lambda model, answer: ("", ""))
    assert models(lit(frame, 250)).classes is not None
    monkeypatch.undo()
    assert len(models(lit(frame, 250)).problems) == 1, "again, after one that could be right"


def test_classes_of_little_use_are_said_once_and_used(tmp_path, frame):
    net = segmentation(tmp_path / "net.onnx")
    (tmp_path / "net.yaml").write_text(f"labels: [{', '.join(['void'] * 18 + ['sky'])}]\n")
    grey = lit(frame, 0)
    grey.image[:5] = 255
    models, seen = asked(grey, image_classes=str(net))
    (line,) = seen.problems
    assert "98 % have a class that is of no use here" in line
    assert seen.classes is not None
    assert models(grey).problems == ()


@pytest.mark.usefixtures("any_classes")
def test_three_failures_in_a_row_switch_a_model_off(tmp_path, frame):
    """The network fails for what is bright."""
    models = SegmentationModels(SemanticsConfig(image_classes=str(failing(tmp_path / "failing.onnx")), cloud_classes=""))
    bright, dark = lit(frame, 250), lit(frame, 5)
    assert MAX_FAILURES == 3
    for image in (bright, bright, dark, bright, bright):
        seen = models(image)
        assert (seen.classes is None) == (len(seen.problems) == 1) == (image is bright)
        assert all(line.startswith(f"semantics.image_classes, frame {frame.name}: ") for line in seen.problems)
    assert models.active
    (last,) = models(bright).problems
    assert last.endswith("; off from now on after 3 failures in a row")
    assert not models.active
    after = models(dark)
    assert (after.problems, after.seconds, after.classes) == ((), (), None)


@pytest.mark.usefixtures("any_classes")
def test_exhausted_budget_is_a_failure_with_advice(tmp_path, frame):
    models, seen = asked(lit(frame, 250), image_classes=str(endless(tmp_path / "endless.onnx")), budget_s=0.2)
    (line,) = seen.problems
    assert "budget of 0.2 s (semantics.budget_s)" in line
    assert "take a smaller network, more semantics.threads, or a larger budget" in line
    assert (seen.classes, dict(seen.seconds)["image_classes"] > 0.2) == (None, True)
    models.config = replace(models.config, budget_s=60.0)
    assert models(lit(frame, 5)).classes is not None  # which takes no time, but on a busy machine


def test_cancelled_run_is_not_a_failure(tmp_path, frame):
    models = SegmentationModels(SemanticsConfig(image_classes=str(endless(tmp_path / "endless.onnx")), cloud_classes="source"))
    for _ in range(MAX_FAILURES + 1):
        count = itertools.count()
        seen = models(lit(frame, 250), lambda count=count: next(count) > 0)
        assert (seen.problems, seen.classes, seen.labels) == ((), None, None)
    assert models.active
    seen = models(frame, lambda: True)
    assert (seen.seconds, seen.problems, seen.labels) == ((), (), None)


@pytest.mark.parametrize(
    ("semantics", "expected"),
    [
        ({"segmentation": "none", **SOURCE}, {}),
        ({"image_classes": "", "cloud_classes": ""}, {}),
        ({"image_classes": ""}, {}),
        ({"image_classes": "", "cloud_classes": "source"}, {"cloud_classes": "source"}),
        ({"image_classes": "source"}, {"image_classes": "source", "cloud_classes": "geometric"}),
        ({}, {"image_classes": "builtin", "cloud_classes": "geometric"}),
    ],
)
def test_models_that_run(frame, semantics, expected):
    models = SegmentationModels(SemanticsConfig(**semantics))
    assert {m.kind: m.path for m in models.models} == expected
    assert (models.active, models.load()) == (bool(expected), [])
    seen = models(frame)
    assert seen.problems == ()
    assert "image_classes" not in expected or (seen.classes.shape == frame.image.shape[:2] and len(np.unique(seen.classes)) > 2)
    assert "cloud_classes" not in expected or seen.labels.shape == (len(frame.cloud),)


@pytest.mark.skipif("CUDAExecutionProvider" in onnxruntime.get_available_providers(), reason="CUDA is here")
def test_missing_provider_is_reported_once(tmp_path, frame, any_classes):
    path = segmentation(tmp_path / "net.onnx")
    models, seen = asked(frame, image_classes=str(path), provider="cuda")
    assert seen.problems == ("onnxruntime has no cuda here: net.onnx runs on cpu",)
    assert seen.classes is not None
    fresh = SegmentationModels(models.config)
    assert fresh.load() == [*seen.problems]
    assert models(frame).problems == fresh(frame).problems == ()


def recalibrator_of(drive, start, config: Config) -> Recalibrator:
    return Recalibrator(drive[0].camera, start, config, "cam", "velo")


def swapped(drive: list[Frame]) -> list[Frame]:
    """Pictures of other scenes."""
    return [replace(f, image=drive[(k + 2) % len(drive)].image) for k, f in enumerate(drive)]


def test_the_default_network_is_off_without_its_library_and_a_chosen_one_is_an_error(tmp_path, monkeypatch, drive, start):
    for library in ("onnxruntime", "sklearn"):
        monkeypatch.setitem(sys.modules, library, None)
    lean = Calibrator(drive[0].camera, update(QUICK, {"semantics": {"use": "always"}}))
    (line,) = lean.segmentation.load()
    assert line.startswith("semantics.image_classes is off: models need onnxruntime")
    result = lean.calibrate(drive, start, SearchBox(2, 0.15))
    assert (result.status, result.reason) == (CONVERGED, "")
    shapes = SegmentationModels(SemanticsConfig(cloud_classes="geometric", image_classes=""))
    assert shapes.load() == []
    assert (shapes(drive[0]).labels == C.GROUND).any()
    with pytest.raises(MissingDependencyError, match="models need onnxruntime"):
        SegmentationModels(SemanticsConfig(image_classes=str(tmp_path / "own.onnx"))).load()


def test_nothing_is_estimated_again_where_no_classes_were_found(monkeypatch, drive, start):
    estimates, real = [], Calibrator.estimate
    monkeypatch.setattr(Calibrator, "estimate", lambda self, *args, **kw: estimates.append(1) or real(self, *args, **kw))
    monkeypatch.setattr(SegmentationModels, "__call__", lambda *args, **kw: FrameSemantics(problems=("the model is broken",)))
    result = Calibrator(drive[0].camera, QUICK).calibrate(swapped(drive)[:2], start)
    assert not result.converged
    assert len(estimates) == 1
    assert "the model is broken" in result.reason


def test_classes_are_asked_for_where_the_edges_alone_leave_doubt(monkeypatch, drive, start):
    names, real = [], SegmentationModels.__call__
    monkeypatch.setattr(
        SegmentationModels, "__call__", lambda self, f, *args, **kw: names.append(f.name) or real(self, f, *args, **kw)
    )
    box, two = SearchBox(2, 0.15), drive[:2]
    every = [f.name for f in two]
    clear = Calibrator(drive[0].camera, QUICK).calibrate(two, start)
    assert clear.converged
    assert clear.evidence.z_score >= UNDOUBTED_Z
    assert names == []
    always = Calibrator(drive[0].camera, with_models(use="always", **SOURCE)).calibrate(two, start)
    assert names == every
    assert se3.rotation_error_deg(always.T_camera_lidar, clear.T_camera_lidar) < 0.1
    names.clear()
    stages: list[str] = []
    doubtful = Calibrator(drive[0].camera, QUICK).calibrate(swapped(drive)[:2], start, box, lambda stage, _: stages.append(stage))
    assert doubtful.refusal is not None
    assert names == every
    assert stages.index("features") < stages.index("search") < stages.index("classes")


def test_what_a_user_asks_for_does_not_wait_for_doubt():
    assert SemanticsConfig().in_doubt_only
    assert SemanticsConfig(image_classes="other.onnx", use="in_doubt").in_doubt_only
    asks = (("use", "always"), ("image_classes", "other.onnx"), ("segment_anything", "masks"), ("frame_weights", True))
    assert not any(SemanticsConfig(**{name: value}).in_doubt_only for name, value in asks)


def test_keyframes_are_segmented_until_an_estimate_leaves_no_doubt(drive, start):
    recalibrator = recalibrator_of(drive, start, QUICK)
    assert recalibrator.segments_keyframes
    for frame in drive:
        recalibrator.ingest(frame)
    recalibrator.estimate()
    assert recalibrator.current.result.evidence is None or recalibrator.current.accepted
    assert not recalibrator.segments_keyframes
    recalibrator.configure(update(recalibrator.config, {"semantics": {"use": "always"}}))
    assert recalibrator.segments_keyframes


def test_shapes_are_found_among_the_points_that_are_asked_for(drive):
    shapes = SegmentationModels(SemanticsConfig(cloud_classes="geometric", image_classes=""))
    points = np.flatnonzero(drive[0].cloud.xyz[:, 0] > 0)
    seen, all_of_them = shapes(drive[0], points=points).labels, shapes(drive[0]).labels
    assert (np.delete(seen, points) == UNLABELLED).all()
    assert (seen[points] == all_of_them[points]).mean() > 0.9


def test_models_stay_loaded_until_their_configuration_changes(drive, start):
    recalibrator = recalibrator_of(drive, start, with_models(**SOURCE))
    recalibrator.ingest(drive[0])
    assert recalibrator.segment_keyframe() == ()
    models = recalibrator.segmentation
    loaded = [m.model for m in models.models]
    assert None not in loaded
    for stages, kept in (({"search": {"starts": 64}}, 1), ({"image": {"max_width": 320}}, 0)):
        recalibrator.configure(update(recalibrator.config, stages))
        assert [m.model for m in recalibrator.segmentation.models] == loaded
        assert len(recalibrator.keyframes) == kept
    recalibrator.configure(with_models(recalibrator.config, cloud_classes="geometric"))
    assert recalibrator.segmentation is recalibrator.calibrator.segmentation is not models
    assert len(recalibrator.keyframes) == 0


def test_a_keyframe_is_replaced_by_its_semantic_features(drive, start):
    recalibrator = recalibrator_of(drive, start, with_models(**SOURCE))
    assert recalibrator.segment_keyframe() == ()  # there is nothing yet
    assert [recalibrator.ingest(f) for f in drive[:2]] == [True, True]
    plain = list(recalibrator.keyframes.features)
    assert recalibrator.segment_keyframe() == ()
    first, second = recalibrator.keyframes.features
    assert first is plain[0]  # the newest counts; this one was given up
    assert second is not plain[1]
    assert second.plain.points.xyz.tobytes() == plain[1].points.xyz.tobytes()
    assert (second.name, second.stamp) == (plain[1].name, plain[1].stamp)
    assert second.points.label is not None
    assert second.view is not None
    assert recalibrator.segment_keyframe() == ()
    assert list(recalibrator.keyframes.features) == [first, second]
    assert recalibrator.segmented[0] == 1
    took = r"1 keyframes; image_classes \d+\.\d s; cloud_classes \d+\.\d s; image_classes source; cloud_classes source"
    assert re.fullmatch(took, recalibrator.describe_semantics())


def test_raw_frames_are_not_kept(source, start):
    recalibrator, gone = recalibrator_of([source[0]], start, with_models(**SOURCE)), []

    def ingest(k: int) -> None:
        frame = source[k]
        gone.append(weakref.ref(frame))
        recalibrator.ingest(frame)

    def freed() -> list[bool]:
        gc.collect()
        return [ref() is None for ref in gone]

    for k in range(3):
        ingest(k)
    assert freed() == [True, True, False]
    recalibrator.segment_keyframe()
    assert freed()[2]
    ingest(3)
    recalibrator.reset()
    assert freed()[3]


def test_buffer_changes_during_segmentation(drive, start):
    """The models ask now and then whether to break off: a moment in which something else can happen."""
    recalibrator = recalibrator_of(drive, start, with_models(update(QUICK, {"online": {"buffer_size": 2}}), **SOURCE))

    def meanwhile(*events) -> Callable[[], bool]:
        left = iter(events)

        def happens() -> bool:
            for event in left:
                event()
            return False

        return happens

    recalibrator.ingest(drive[0])
    drives_on = [partial(recalibrator.ingest, frame) for frame in drive[1:3]]
    assert recalibrator.segment_keyframe(meanwhile(*drives_on)) == ()
    assert [f.name for f in recalibrator.keyframes.features] == [f.name for f in drive[1:3]]  # the first has left
    assert all(f.plain is None for f in recalibrator.keyframes.features)
    assert recalibrator.segment_keyframe() == ()
    assert [f.plain is None for f in recalibrator.keyframes.features] == [True, False]
    recalibrator.ingest(drive[3])
    assert recalibrator.segment_keyframe(meanwhile(recalibrator.reset, partial(recalibrator.ingest, drive[3]))) == ()
    (only,) = recalibrator.keyframes.features
    assert (only.name, only.plain) == (drive[3].name, None)  # what was seen is of the keyframe before the reset
    assert recalibrator.segment_keyframe() == ()
    assert recalibrator.newest().plain.points.xyz.tobytes() == only.points.xyz.tobytes()


def test_the_monitor_compares_keyframes_without_semantics(drive, start, source):
    calibrator = Calibrator(source.camera, with_models(**SOURCE))
    plain = [calibrator.extract(f) for f in drive[:2]]
    seen = [calibrator.extract(f, calibrator.segmentation(f)) for f in drive[:2]]
    T = source.reference
    for count in (1, 2):
        with_classes, without = (calibrator.objectives.of_edges(f[:count], T) for f in (seen, plain))
        assert with_classes.value(T) == without.value(T)
    assert FastScore(seen, T, QUICK.score).at(-1).value(T) != without.value(T)


def test_estimates_over_keyframes_of_both_kinds(drive, start, source):
    recalibrator = recalibrator_of(drive, start, with_models(image_classes="source"))
    for k, frame in enumerate(drive):
        assert recalibrator.ingest(frame)
        if k % 2:
            assert recalibrator.segment_keyframe() == ()
    assert [f.plain is None for f in recalibrator.keyframes.features] == [True, False, True, False]
    found = recalibrator.estimate().result
    assert found.status == CONVERGED, found.reason
    assert found.frames_used == FRAMES
    assert se3.rotation_error_deg(source.reference, found.T_camera_lidar) < 0.2
    assert se3.translation_error_m(source.reference, found.T_camera_lidar) < 0.04


def test_points_have_classes_for_another_objective_once_an_estimate_has_left_doubt(drive, start):
    config = with_models(update(QUICK, {"refine": {"objective": "thesis"}}), **SOURCE)
    recalibrator = recalibrator_of(drive, start, config)
    for frame, in_doubt, estimated_at in zip(drive, (True, False, True), (None, 1, 1), strict=False):
        recalibrator._in_doubt, recalibrator._seen_motion.newest = in_doubt, estimated_at
        assert recalibrator.ingest(frame)
        assert recalibrator.segments_keyframes
        assert recalibrator.segment_keyframe() == ()
    assert [f.own.blended for f in recalibrator.keyframes.features] == 3 * [OF_CLASSES]
    assert [f.view is None for f in recalibrator.keyframes.features] == [True, True, False]


def test_frames_weigh_by_their_share_of_main_classes(drive, source):
    """w_j of eq. 3.16, by the classes of the picture, which is not resized here."""
    config = with_models(update(QUICK, {"refine": {"objective": "thesis"}}), **SOURCE, frame_weights=True)
    calibrator = Calibrator(source.camera, config)
    features = [calibrator.extract(f, calibrator.segmentation(f)) for f in drive[:2]]
    shares = [np.isin(f.classes, MAIN_CLASSES).sum() / (f.classes != UNLABELLED).sum() for f in drive[:2]]
    assert [f.own.importance for f in features] == pytest.approx(shares)
    assert abs(shares[0] - shares[1]) > 0.02
    w = (np.array(shares) + FEW_FRAMES_SHARE) / (np.mean(shares) + FEW_FRAMES_SHARE)
    weights = calibrator.objectives(features, source.reference, source.reference).score.frame_weights
    assert weights == pytest.approx(w / w.sum())
    assert abs(weights[0] - 0.5) > 0.01


def turned(frame: Frame, yaw_deg: float) -> Frame:
    """The same with a LiDAR that is mounted otherwise."""
    R = se3.rotation_from_euler(np.deg2rad(yaw_deg), 0, 0)
    cloud = replace(frame.cloud, xyz=np.asarray(frame.cloud.xyz @ R.T, np.float32))
    return replace(frame, cloud=cloud, reference=frame.reference @ se3.from_parts(R.T, np.zeros(3)), twist=None)


def test_the_first_extrinsic_is_guessed_from_an_unknown_yaw(drive):
    config = with_models(update(QUICK, {"online": {"min_keyframes": 3}, **GUESSED}), **SOURCE)
    frames = [turned(f, -115) for f in drive]
    truth = frames[0].reference
    assert se3.rotation_error_deg(nominal(), truth) > 100
    recalibrator = recalibrator_of(frames, nominal_start(), config)

    def driven(count: int) -> list[Result]:
        states = []
        for frame in frames[:count]:
            assert recalibrator.ingest(frame)
            assert recalibrator.segment_keyframe() == ()
            if recalibrator.ready():
                states.append(recalibrator.estimate())
        return [state.result for state in states]

    first, final = driven(4)
    assert (first.status, final.status) == (CONVERGED, CONVERGED), (first.reason, final.reason)
    assert "first guess from the classes of 3 of 3 frames" in first.reason
    found = recalibrator.current.result.T_camera_lidar
    assert se3.rotation_error_deg(truth, found) < 0.3
    assert se3.translation_error_m(truth, found) < 0.05
    # The way back is to knowing nothing: a guess may have been wrong.
    recalibrator.reset()
    assert recalibrator.current.result.status == INITIAL
    for known in (recalibrator.current.result.T_camera_lidar, recalibrator.tracker.T):
        assert np.array_equal(known, nominal())
    # Switched off it is nominal, and on again it is looked for, as long as no estimate has been taken in.
    recalibrator.configure(update(config, {"initial": {"method": "nominal"}}))
    recalibrator.configure(config)
    (again,) = driven(3)
    assert np.allclose(again.T_camera_lidar, first.T_camera_lidar, atol=1e-9)


def test_a_guess_waits_for_classes(drive):
    """Keyframes come at once, what is in them later."""
    config = with_models(update(QUICK, {"online": {"min_keyframes": 2}, **GUESSED}), **SOURCE)
    recalibrator = recalibrator_of(drive, nominal_start(), config)
    for frame in drive[:2]:
        recalibrator.ingest(frame)
    waits = recalibrator.estimate().result
    assert waits.status == INSUFFICIENT
    assert waits.reason == "nothing is known of the extrinsic: waiting for the classes of 2 keyframes"
    assert not recalibrator.ready()
    recalibrator.segment_keyframe()
    assert recalibrator.ready()
    assert "1 so far" in recalibrator.estimate().result.reason
    known = recalibrator_of(drive, nominal(), config)  # somebody gave that extrinsic
    known.ingest(drive[0])
    assert "nothing is known" not in known.estimate().result.reason


SMALL = "synthetic:frames=1,rings=16,width=320,height=120"
STREET = "synthetic:seed=31,frames=3,width=640,height=240,speed=0,stride=30"


def test_calibrate_from_a_semantic_start(tmp_path, capsys):
    quick = {"search": {"rounds": 1, "starts": 64}, "online": {"min_keyframes": 3}, "semantics": SOURCE}
    (tmp_path / "classes.yaml").write_text(yaml.safe_dump(quick))
    code = main.main(["calibrate", STREET, "--initial", "centroids", "--config", str(tmp_path / "classes.yaml"), "--json", "-"])
    captured = capsys.readouterr()
    assert code == 0, captured
    found = json.loads(captured.out)
    assert "first guess from the classes of 3 of 3 frames" in found["reason"]
    truth = SyntheticDrive.from_text(STREET).reference
    assert se3.rotation_error_deg(truth, np.array(found["T_camera_lidar"])) < 0.3
    assert se3.translation_error_m(truth, np.array(found["T_camera_lidar"])) < 0.05


@pytest.mark.parametrize("command", ["calibrate", "replay"])
def test_missing_models_of_a_semantic_start_are_named(tmp_path, capsys, command):
    for semantics, text in (
        ({"image_classes": ""}, "semantic needs classes of pixels and points: leave semantics.segmentation"),
        ({"segmentation": "none", **SOURCE}, "--initial semantic needs classes"),
        ({"image_classes": "source", "cloud_classes": ""}, "--initial semantic needs classes"),
        ({"image_classes": str(tmp_path / "net.onnx")}, "net.onnx: there is no such file"),
        ({"image_class": "source"}, "image_class"),
    ):
        (tmp_path / "c.yaml").write_text(yaml.safe_dump({"semantics": semantics}))
        code = main.main([command, SMALL, "--initial", "semantic", "--config", str(tmp_path / "c.yaml")])
        err = capsys.readouterr().err
        assert text in err
        if command == "replay" and "no such file" in text:
            assert code == 1  # it goes on without, as the node does
        else:
            assert (code, len(err.splitlines())) == (2, 1), err


def test_a_first_guess_does_not_need_classes_of_consecutive_keyframes(drive, source):
    """Slow models see one keyframe in several: those that have classes wait in the buffer until there are enough of them."""
    config = with_models(update(QUICK, {"online": {"buffer_size": 6, "min_keyframes": 3}, **GUESSED}), **SOURCE)
    recalibrator = Recalibrator(source.camera, nominal_start(), config)
    buffer = KeyframeBuffer(4)
    plain, seen = (
        recalibrator.calibrator.extract(drive[0], s) for s in (None, FrameSemantics(None, drive[0].classes, drive[0].cloud.label))
    )
    for features in (seen, plain, plain, seen, plain, plain, plain):
        buffer.add(features, lambda f: f.view is not None)
    assert [f is seen for f in buffer.features] == [True, True, False, False]
    for _ in range(5):
        buffer.add(seen, lambda f: f.view is not None)
    assert [f is seen for f in buffer.features] == [True] * 4
    assert buffer.incomplete
    # Masks are not needed for it, and are not asked for meanwhile.
    recalibrator.configure(with_models(recalibrator.config, **SOURCE, segment_anything="no.onnx"))
    assert recalibrator.ingest(drive[0])
    assert recalibrator.segment_keyframe() == ()


def test_a_first_guess_gets_classes_after_a_reset_and_where_it_is_asked_for_later(drive):
    asks = {"semantics": {"use": "in_doubt"}, **GUESSED}
    recalibrator = recalibrator_of(drive, nominal_start(), update(QUICK, asks))
    assert recalibrator.first_guess.needs_classes
    recalibrator.first_guess.pending = recalibrator._in_doubt = False  # as after an estimate without doubt
    assert not recalibrator.segments_keyframes
    recalibrator.reset()
    assert (recalibrator.first_guess.needs_classes, recalibrator.segments_keyframes) == (True, True)
    recalibrator = recalibrator_of(drive, nominal_start(), QUICK)
    recalibrator.ingest(drive[0])
    recalibrator.configure(update(QUICK, asks))
    assert recalibrator.first_guess.needs_classes
    assert len(recalibrator.keyframes) == 0  # their points have classes near the nominal view only
