"""Segmentation without ROS: models, keyframes with semantics, and their effect on score and estimate."""

from __future__ import annotations

import gc
import json
import re
import sys
import weakref
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import yaml
from onnx_graphs import endless, failing, segmentation
from sam_graphs import other
from scenes import QUICK_SEARCH, RenderedDrive, same

from calib_ros import se3
from calib_ros.cli import main
from calib_ros.config import Config, OnlineConfig, SearchConfig, SemanticsConfig, TrackerConfig, update
from calib_ros.errors import MissingDependencyError, ModelError
from calib_ros.frame import MAIN_CLASSES, UNLABELLED, Frame
from calib_ros.frame import SemanticClass as C
from calib_ros.image.edges import blurred_levels, oriented_edges
from calib_ros.image.enhance import prepare
from calib_ros.online.keyframes import KeyframeBuffer
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.registration.acceptance.significance import UNDOUBTED_Z
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import FeatureExtractor
from calib_ros.registration.initial_guess import nominal, nominal_start
from calib_ros.registration.score.point_score import FastScore
from calib_ros.registration.search.constraints import SearchBox, pose_constraints
from calib_ros.result import CONVERGED, INITIAL, INSUFFICIENT, Result
from calib_ros_semantics.models.edge_classes import EDGE_SHARE, FEW_FRAMES_SHARE, frame_weights
from calib_ros_semantics.models.segmentation import MAX_FAILURES, OF_MASKS, FrameSemantics, Segmentation
from calib_ros_synthetic.drive import SyntheticDrive
from calib_ros_thesis.features import ThesisFeatures
from calib_ros_thesis.image import blend, gradient_edges, smoothed
from calib_ros_thesis.objective import ThesisObjective

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


def asked(frame: Frame, **semantics) -> tuple[Segmentation, FrameSemantics]:
    models = Segmentation(SemanticsConfig(**{"cloud_classes": "", **semantics}))
    return models, models(frame)


# --- the facade -----------------------------------------------------------------------------------------------------------


def bad_files(folder: Path) -> dict[str, tuple[Path, str]]:
    good = segmentation(folder / "good.onnx", 19, outputs=[("scores", [1, 19, 256, 512])])
    (folder / "cut.onnx").write_bytes(good.read_bytes()[:300])
    (folder / "picture.onnx").write_bytes(b"\x89PNG\r\n\x1a\n and what follows")
    return {
        "missing": (folder / "none.onnx", "there is no such file; correct the path or leave it empty"),
        "truncated": (folder / "cut.onnx", "cannot be loaded"),
        "foreign": (folder / "picture.onnx", "cannot be loaded"),
        "a folder of nothing": (folder / "empty", "holds no label pictures"),
        "no convention": (Path(other(folder / "classifier.onnx")), "this looks like a classifier of whole pictures"),
    }


def test_unloadable_model_is_reported_once_and_the_others_work(tmp_path, frame):
    (tmp_path / "empty").mkdir()
    for name, (path, text) in bad_files(tmp_path).items():
        models, seen = asked(frame, image_classes=str(path), cloud_classes="source")
        (line,) = seen.problems
        assert line.startswith("semantics.image_classes is off: "), name
        assert str(path) in line, name
        assert text in line, name
        assert "\n" not in line, name
        assert seen.classes is None
        assert np.array_equal(seen.labels, frame.cloud.label)
        again = models(frame)
        assert again.problems == ()
        assert [kind for kind, _ in again.seconds] == ["cloud_classes"]
        assert models.active
        with pytest.raises(ModelError, match=path.name):
            Segmentation(models.config).load()
        alone, _ = asked(frame, image_classes=str(path))
        assert not alone.active


@pytest.fixture
def any_classes(monkeypatch: pytest.MonkeyPatch) -> None:
    """For small graphs that find one class everywhere."""
    monkeypatch.setattr("calib_ros_semantics.models.segmentation.judge", lambda model, answer: ("", ""))


def test_classes_that_cannot_be_right_are_no_evidence_and_are_said_once(tmp_path, frame, monkeypatch):
    path = segmentation(tmp_path / "n.onnx", 19, outputs=[("scores", [1, 19, 256, 512])])
    models = Segmentation(SemanticsConfig(image_classes=str(path), cloud_classes=""))
    lines: list[str] = []
    for _ in range(MAX_FAILURES + 1):
        seen = models(lit(frame, 250))  # one colour, one class
        assert seen.classes is None
        assert seen.edges is None
        lines += seen.problems
    (line,) = lines
    assert "its classes are implausible: 100 % are " in line
    assert "mean, std, scale, channels" in line
    assert models.active, "a covered lens is no reason to switch a model off"
    monkeypatch.setattr("calib_ros_semantics.models.segmentation.judge", lambda model, answer: ("", ""))
    assert models(lit(frame, 250)).classes is not None
    monkeypatch.undo()
    assert len(models(lit(frame, 250)).problems) == 1, "again, after one that could be right"


def test_classes_of_little_use_are_said_once_and_used(tmp_path, frame):
    net = segmentation(tmp_path / "net.onnx", 19, outputs=[("scores", [1, 19, 256, 512])])
    (tmp_path / "net.yaml").write_text(f"labels: [{', '.join(['void'] * 18 + ['sky'])}]\n")
    grey = lit(frame, 0)
    image = grey.image.copy()
    image[:5] = 255
    models, seen = asked(replace(frame, image=image), image_classes=str(net))
    (line,) = seen.problems
    assert "98 % have a class that is of no use here; give 'labels:'" in line
    assert seen.classes is not None
    assert models(replace(frame, image=image)).problems == ()


@pytest.mark.usefixtures("any_classes")
def test_three_failures_in_a_row_switch_a_model_off(tmp_path, frame):
    """The network fails for what is bright."""
    models = Segmentation(SemanticsConfig(image_classes=str(failing(tmp_path / "failing.onnx")), cloud_classes=""))
    bright, dark = lit(frame, 250), lit(frame, 5)
    assert MAX_FAILURES == 3
    lines: list[str] = []
    for image in (bright, bright, dark, bright, bright):
        seen = models(image)
        assert (seen.classes is None) == (image is bright)
        lines += seen.problems
    assert len(lines) == 4
    assert all(line.startswith(f"semantics.image_classes, frame {frame.name}: ") for line in lines)
    assert all("failing.onnx failed" in line and "\n" not in line and " off " not in line for line in lines)
    assert models.active
    (last,) = models(bright).problems
    assert last.endswith("; off from now on after 3 failures in a row")
    assert not models.active
    assert models(dark).problems == ()
    assert models(dark).seconds == ()
    assert models(dark).classes is None


@pytest.mark.usefixtures("any_classes")
def test_exhausted_budget_is_a_failure_with_advice(tmp_path, frame):
    models, seen = asked(lit(frame, 250), image_classes=str(endless(tmp_path / "endless.onnx")), budget_s=0.2)
    (line,) = seen.problems
    assert "budget of 0.2 s (semantics.budget_s)" in line
    assert "take a smaller network, more semantics.threads, or a larger budget" in line
    assert seen.classes is None
    assert dict(seen.seconds)["image_classes"] > 0.2
    assert models(lit(frame, 5)).classes is not None  # which takes no time


def test_cancelled_run_is_not_a_failure(tmp_path, frame):
    models = Segmentation(SemanticsConfig(image_classes=str(endless(tmp_path / "endless.onnx")), cloud_classes="source"))
    for _ in range(MAX_FAILURES + 1):
        asked_before: list[bool] = []

        def from_the_second_on(asked_before=asked_before) -> bool:
            asked_before.append(True)
            return len(asked_before) > 1

        seen = models(lit(frame, 250), from_the_second_on)
        assert (seen.problems, seen.classes, seen.labels) == ((), None, None)
    assert models.active
    seen = models(frame, lambda: True)
    assert (seen.seconds, seen.problems, seen.labels) == ((), (), None)


def test_unconfigured_models_do_not_run(frame):
    for semantics in ({"image_classes": ""}, {"segmentation": "none", **SOURCE}, {"image_classes": "", "cloud_classes": ""}):
        models = Segmentation(SemanticsConfig(**semantics))
        assert models.models == []
        assert not models.active
        assert models.load() == []
        assert models(frame).problems == ()
    assert [m.kind for m in Segmentation(SemanticsConfig(image_classes="source")).models] == ["image_classes", "cloud_classes"]
    assert [m.kind for m in Segmentation(SemanticsConfig(image_classes="", cloud_classes="source")).models] == ["cloud_classes"]


def test_default_configuration_uses_the_packaged_network(frame):
    models = Segmentation(SemanticsConfig())
    assert [(m.kind, m.path) for m in models.models] == [("image_classes", "builtin"), ("cloud_classes", "geometric")]
    seen = models(frame)
    assert seen.problems == ()
    assert seen.classes.shape == frame.image.shape[:2]
    assert len(np.unique(seen.classes)) > 2
    assert seen.labels.shape == (len(frame.cloud),)


@pytest.mark.skipif("CUDAExecutionProvider" in onnxruntime.get_available_providers(), reason="CUDA is here")
def test_missing_provider_is_reported_once(tmp_path, frame, any_classes):
    path = segmentation(tmp_path / "net.onnx", 19, outputs=[("scores", [1, 19, 256, 512])])
    models, seen = asked(frame, image_classes=str(path), provider="cuda")
    assert seen.problems == ("onnxruntime has no cuda here: net.onnx runs on cpu",)
    assert seen.classes is not None
    assert models(frame).problems == ()
    fresh = Segmentation(models.config)
    assert fresh.load() == ["onnxruntime has no cuda here: net.onnx runs on cpu"]
    assert fresh(frame).problems == ()


def test_segmentation_is_repeatable(frame):
    for kind in ("source", "geometric"):
        a, b = (asked(frame, image_classes="source", cloud_classes=kind)[1] for _ in range(2))
        assert a.labels.tobytes() == b.labels.tobytes()
        assert a.classes.tobytes() == b.classes.tobytes()


# --- keyframes ------------------------------------------------------------------------------------------------------------


def recalibrator_of(drive, start, config: Config) -> Recalibrator:
    return Recalibrator(drive[0].camera, start, config, "cam", "velo")


def test_the_default_network_is_off_without_its_library_and_a_chosen_one_is_an_error(tmp_path, monkeypatch, drive, start):
    for library in ("onnxruntime", "sklearn"):
        monkeypatch.setitem(sys.modules, library, None)
    lean = Calibrator(drive[0].camera, update(QUICK, {"semantics": {"use": "always"}}))
    assert lean.segmentation.load() == [
        "semantics.image_classes is off: models need onnxruntime: python3 -m pip install onnxruntime",
    ]
    result = lean.calibrate(drive, start, SearchBox(2, 0.15))
    assert (result.status, result.reason) == (CONVERGED, "")
    shapes = Segmentation(SemanticsConfig(cloud_classes="geometric", image_classes=""))
    assert shapes.load() == []
    assert (shapes(drive[0]).labels == C.GROUND).any()
    with pytest.raises(MissingDependencyError, match="models need onnxruntime"):
        Segmentation(SemanticsConfig(image_classes=str(tmp_path / "own.onnx"))).load()


def asked_frames(monkeypatch) -> list[str]:
    """Names of the frames that models are asked about from now on."""
    names: list[str] = []
    real = Segmentation.__call__

    def spied(self, frame, *args, **kwargs):
        names.append(frame.name)
        return real(self, frame, *args, **kwargs)

    monkeypatch.setattr(Segmentation, "__call__", spied)
    return names


def test_classes_are_asked_for_where_the_edges_alone_leave_doubt(monkeypatch, drive, start):
    names = asked_frames(monkeypatch)
    box = SearchBox(2, 0.15)
    clear = Calibrator(drive[0].camera, QUICK).calibrate(drive, start, box)
    assert clear.converged
    assert clear.evidence.z_score >= UNDOUBTED_Z
    assert names == []
    always = Calibrator(drive[0].camera, update(QUICK, {"semantics": {"use": "always"}})).calibrate(drive, start, box)
    assert names == [f.name for f in drive]
    assert se3.rotation_error_deg(always.T_camera_lidar, clear.T_camera_lidar) < 0.1
    names.clear()
    swapped = [replace(f, image=drive[(k + 2) % len(drive)].image) for k, f in enumerate(drive)]
    stages: list[str] = []
    doubtful = Calibrator(drive[0].camera, QUICK).calibrate(swapped, start, box, lambda stage, _: stages.append(stage))
    assert doubtful.refusal is not None
    assert names == [f.name for f in drive]
    assert stages.index("features") < stages.index("search") < stages.index("classes")


@pytest.mark.parametrize(
    ("options", "waits"),
    [
        ({}, True),
        ({"use": "always"}, False),
        ({"image_classes": "other.onnx"}, False),
        ({"image_classes": "other.onnx", "use": "in_doubt"}, True),
        ({"segment_anything": "masks"}, False),
        ({"frame_weights": True}, False),
    ],
)
def test_what_a_user_asks_for_does_not_wait_for_doubt(options, waits):
    assert SemanticsConfig(**options).in_doubt_only is waits


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
    shapes = Segmentation(SemanticsConfig(cloud_classes="geometric", image_classes=""))
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
    recalibrator.configure(replace(recalibrator.config, search=SearchConfig(starts=64)))
    assert recalibrator.segmentation is recalibrator.calibrator.segmentation is models
    assert len(recalibrator.buffer) == 1
    recalibrator.configure(update(recalibrator.config, {"image": {"max_width": 320}}))
    assert recalibrator.ingest(drive[1])
    assert recalibrator.segment_keyframe() == ()
    assert [m.model for m in recalibrator.segmentation.models] == loaded
    recalibrator.configure(with_models(recalibrator.config, cloud_classes="geometric"))
    assert recalibrator.segmentation is recalibrator.calibrator.segmentation is not models
    assert len(recalibrator.buffer) == 0
    recalibrator.configure(with_models(recalibrator.config, segmentation="none"))
    assert not recalibrator.segments_keyframes
    assert recalibrator.ingest(drive[2])
    assert recalibrator.segment_keyframe() == ()
    assert recalibrator.newest().plain is None


def test_a_keyframe_is_replaced_by_its_semantic_features(drive, start):
    recalibrator = recalibrator_of(drive, start, with_models(**SOURCE))
    assert recalibrator.segment_keyframe() == ()  # there is nothing yet
    assert [recalibrator.ingest(f) for f in drive[:2]] == [True, True]
    plain = list(recalibrator.buffer)
    assert recalibrator.segment_keyframe() == ()
    first, second = recalibrator.buffer
    assert first is plain[0]  # the newest counts; this one was given up
    assert second.plain.points.xyz.tobytes() == plain[1].points.xyz.tobytes()
    assert second is not plain[1]
    assert (second.name, second.stamp) == (plain[1].name, plain[1].stamp)
    assert second.points.label is not None
    assert second.view is not None
    assert recalibrator.segment_keyframe() == ()
    assert list(recalibrator.buffer) == [first, second]
    assert recalibrator.segmenter.done == 1
    described = recalibrator.segmenter.describe(recalibrator.segmentation)
    took = r"image_classes \d+\.\d s; cloud_classes \d+\.\d s"
    assert re.fullmatch(rf"1 keyframes; {took}; image_classes source; cloud_classes source", described)


def test_raw_frames_are_not_kept(source, start):
    recalibrator = recalibrator_of([source[0]], start, with_models(**SOURCE))
    gone = []
    for k in range(3):
        frame = source[k]
        gone.append(weakref.ref(frame))
        recalibrator.ingest(frame)
    del frame
    gc.collect()
    assert [ref() is None for ref in gone] == [True, True, False]
    recalibrator.segment_keyframe()
    gc.collect()
    assert gone[2]() is None
    recalibrator.ingest(frame := source[3])
    gone.append(weakref.ref(frame))
    del frame
    recalibrator.reset()
    gc.collect()
    assert gone[3]() is None


def test_buffer_changes_during_segmentation(drive, start):
    """The models ask now and then whether to break off: a moment in which something else can happen."""
    config = with_models(update(QUICK, {"online": {"buffer_size": 2}}), **SOURCE)
    recalibrator = recalibrator_of(drive, start, config)
    recalibrator.ingest(drive[0])
    rest = iter(drive[1:3])

    def drives_on() -> bool:
        for frame in rest:
            assert recalibrator.ingest(frame)
        return False

    assert recalibrator.segment_keyframe(drives_on) == ()
    assert [f.name for f in recalibrator.buffer] == [f.name for f in drive[1:3]]  # the first has left
    assert all(f.plain is None for f in recalibrator.buffer)
    assert recalibrator.segment_keyframe() == ()
    assert [f.plain is None for f in recalibrator.buffer] == [True, False]

    recalibrator.ingest(drive[3])
    events = iter([recalibrator.reset, lambda: recalibrator.ingest(drive[3])])

    def begins_anew() -> bool:
        for event in events:
            event()
        return False

    assert recalibrator.segment_keyframe(begins_anew) == ()
    (only,) = recalibrator.buffer
    assert only.name == drive[3].name
    assert only.plain is None  # what was seen is of the keyframe before the reset
    assert recalibrator.segment_keyframe() == ()
    assert recalibrator.newest().plain.points.xyz.tobytes() == only.points.xyz.tobytes()


def test_the_monitor_compares_keyframes_without_semantics(drive, start, source):
    calibrator = Calibrator(source.camera, with_models(**SOURCE))
    plain = [calibrator.extract(f) for f in drive[:2]]
    seen = [calibrator.extract(f, calibrator.segmentation(f)) for f in drive[:2]]
    T = source.reference
    for count in (1, 2):
        with_classes, without = (calibrator.fast_objective(f[:count], T) for f in (seen, plain))
        assert with_classes.value(T) == without.value(T)
    assert FastScore(seen, T, QUICK.score).at(-1).value(T) != without.value(T)


def test_estimates_over_keyframes_of_both_kinds(drive, start, source):
    def mixed(config: Config) -> Result:
        recalibrator = recalibrator_of(drive, start, config)
        for k, frame in enumerate(drive):
            assert recalibrator.ingest(frame)
            if k % 2:
                assert recalibrator.segment_keyframe() == ()
        assert [f.plain is None for f in recalibrator.buffer] == [True, False, True, False]
        return recalibrator.estimate().result

    for more in ({}, {"cloud_classes": "geometric"}):
        config = with_models(**{**SOURCE, **more})
        found = mixed(config)
        assert found.status == CONVERGED, found.reason
        assert found.frames_used == FRAMES
        assert se3.rotation_error_deg(source.reference, found.T_camera_lidar) < 0.2, more
        assert se3.translation_error_m(source.reference, found.T_camera_lidar) < 0.04, more
    assert same(found, mixed(config))


# --- classes in the score -------------------------------------------------------------------------------------------------


def features_of(drive, **semantics):
    calibrator = Calibrator(drive[0].camera, with_models(**{**SOURCE, "frame_weights": True, **semantics}))
    return [calibrator.extract(f, calibrator.segmentation(f)) for f in drive]


def weight_of_frames(score: FastScore) -> np.ndarray:
    return np.bincount(score.frame, score.weights, score.n_frames)


def test_frames_weigh_by_their_share_of_main_classes(drive, source):
    """w_j of eq. 3.16."""
    T, (first, second) = source.reference, features_of(drive[:2])
    shares = []
    for frame, f in ((drive[0], first), (drive[1], second)):
        # The classes are those of the picture, which is not resized here.
        shares.append(np.isin(frame.classes, MAIN_CLASSES).sum() / (frame.classes != UNLABELLED).sum())
        assert f.importance == pytest.approx(shares[-1])
    assert abs(shares[0] - shares[1]) > 0.02
    w = (np.array(shares) + FEW_FRAMES_SHARE) / (np.mean(shares) + FEW_FRAMES_SHARE)
    assert frame_weights(shares) == pytest.approx(w)
    alike = weight_of_frames(FastScore([first.plain, second.plain], T, QUICK.score))
    weighed = weight_of_frames(FastScore([first, second], T, QUICK.score))
    assert weighed[1] / weighed[0] == pytest.approx(alike[1] / alike[0] * w[1] / w[0], rel=1e-4)
    # A keyframe whose classes are still to come counts as the mean of the others.
    assert frame_weights([*shares, None]) == pytest.approx([*w, 1])
    off = features_of(drive[:2], frame_weights=False)
    assert weight_of_frames(FastScore(off, T, QUICK.score)) == pytest.approx(alike, rel=1e-4)


def test_edges_weigh_by_their_class(frame, source):
    """Those of vegetation and ground half as much: by kind of edge, since each kind has its share of the whole."""
    (f,) = features_of([frame])
    score = FastScore([f.plain], source.reference, QUICK.score), FastScore([f], source.reference, QUICK.score)
    assert score[0].points.shape == score[1].points.shape
    ratio = score[1].weights / score[0].weights
    position = {tuple(p): k for k, p in enumerate(f.points.xyz)}
    at = np.array([position[tuple(p)] for p in score[1].points.T])
    label, kind = f.points.label[at], f.points.kind[at]
    compared = 0
    for k in np.unique(kind):
        own = kind == k
        light, full = (
            ratio[own & np.isin(label, c)] for c in ((C.VEGETATION, C.GROUND), (C.BUILDING, C.POLE, C.VEHICLE, C.OTHER))
        )
        if len(light) and len(full):
            compared += 1
            assert light / full[0] == pytest.approx(0.5, rel=1e-4)
            assert full / full[0] == pytest.approx(1, rel=1e-4)
    assert compared >= 2


def test_semantic_edges_are_blended_in_before_the_blur(frame):
    config = with_models(image_classes="", cloud_classes="")
    extract = FeatureExtractor(frame.camera, config)
    edges = np.zeros((2, *frame.image.shape[:2]), np.float32)
    edges[0, 40:200, 320], edges[1, 100, 50:300] = 1, 0.8
    own = extract(frame, FrameSemantics(edges)).levels
    gradient = oriented_edges(prepare(extract.working_image(frame.image), config.image), config.image)
    expected = blurred_levels(
        [np.asarray((1 - EDGE_SHARE) * g + EDGE_SHARE * s, np.float32) for g, s in zip(gradient, edges, strict=True)],
        float(extract.camera.K[0, 0]),
        local_contrast=True,
    )
    plain = extract(frame).levels
    for a, b, c in zip(own, expected, plain, strict=True):
        np.testing.assert_allclose(a.maps, b.maps, atol=1e-5)
        assert abs(a.maps - c.maps).max() > 0.1


def test_the_thesis_objective_has_semantic_edges_and_weights(drive, source):
    config = with_models(update(QUICK, {"refine": {"objective": "thesis"}}), **SOURCE, frame_weights=True)
    calibrator = Calibrator(source.camera, config)
    edges = np.zeros((2, *drive[0].image.shape[:2]), np.float32)
    edges[0, 40:200, 320], edges[1, 100, 50:300] = 1, 0.8
    features = [calibrator.extract(f, replace(calibrator.segmentation(f), edges=edges, edges_of=OF_MASKS)) for f in drive[:2]]
    assert all(isinstance(f, ThesisFeatures) and f.fast.plain is not None for f in features)
    image = calibrator.extract.working_image(drive[0].image)
    strength = np.minimum(edges[0] + edges[1], 1)
    blended = blend(gradient_edges(prepare(image, config.image), config.thesis), strength, config.thesis.semantic_share)
    focal = float(calibrator.extract.camera.K[0, 0])
    for sigma, own in zip(config.thesis.smoothing, features[0].image_edges, strict=True):
        np.testing.assert_allclose(own, smoothed(blended, sigma * focal / 721.5), atol=1e-3)
    known = pose_constraints(source.reference, config.constraints, 2)
    weights = ThesisObjective(features, source.reference, config, known).score.frame_weights
    expected = frame_weights([f.fast.importance for f in features])
    assert weights == pytest.approx(expected / expected.sum())
    assert abs(weights[0] - 0.5) > 0.01


# --- from nothing ---------------------------------------------------------------------------------------------------------


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
    states = []
    for frame in frames:
        assert recalibrator.ingest(frame)
        assert recalibrator.segment_keyframe() == ()
        if recalibrator.ready():
            states.append(recalibrator.estimate())
    first = states[0].result
    assert first.status == CONVERGED, first.reason
    assert "first guess from the classes of 3 of 3 frames" in first.reason
    final = recalibrator.current.result
    assert final.status == CONVERGED, final.reason
    assert se3.rotation_error_deg(truth, final.T_camera_lidar) < 0.3
    assert se3.translation_error_m(truth, final.T_camera_lidar) < 0.05
    # The way back is to knowing nothing: a guess may have been wrong.
    recalibrator.reset()
    assert np.array_equal(recalibrator.current.result.T_camera_lidar, nominal())


def test_a_guess_waits_for_classes(drive):
    """Keyframes come at once, what is in them later."""
    config = with_models(update(QUICK, {"online": {"min_keyframes": 2}, **GUESSED}), **SOURCE)
    recalibrator = recalibrator_of(drive, nominal_start(), config)
    for frame in drive[:2]:
        recalibrator.ingest(frame)
    waits = recalibrator.estimate().result
    assert waits.status == INSUFFICIENT
    assert waits.reason == "nothing is known of the extrinsic: waiting for the classes of keyframes, 0 of 2"
    assert not recalibrator.ready()
    recalibrator.segment_keyframe()
    assert recalibrator.ready()
    assert "1 of 2" in recalibrator.estimate().result.reason
    known = recalibrator_of(drive, nominal(), config)  # somebody gave that extrinsic
    known.ingest(drive[0])
    assert "nothing is known" not in known.estimate().result.reason


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    code = main.main(list(arguments))
    captured = capsys.readouterr()
    return code, captured.out, captured.err


SMALL = "synthetic:frames=1,rings=16,width=320,height=120"
STREET = "synthetic:seed=31,frames=3,width=640,height=240,speed=0,stride=30"


@pytest.mark.parametrize("command", ["calibrate", pytest.param("replay", marks=pytest.mark.slow)])
def test_calibrate_and_replay_from_a_semantic_start(tmp_path, capsys, command):
    quick = {
        "search": {"rounds": 2, "starts": 64},
        "online": {"min_keyframes": 3},
        "semantics": SOURCE,
    }
    (tmp_path / "classes.yaml").write_text(yaml.safe_dump(quick))
    arguments = (STREET, "--initial", "semantic", "--config", str(tmp_path / "classes.yaml"))
    if command == "calibrate":
        arguments = (*arguments, "--json", str(tmp_path / "result.json"))
    code, out, err = run(capsys, command, *arguments)
    assert code == 0, out + err
    found = json.loads((tmp_path / "result.json").read_text() if command == "calibrate" else out)
    assert "first guess from the classes of 3 of 3 frames" in found["reason"]
    truth = SyntheticDrive.from_text(STREET).reference
    assert se3.rotation_error_deg(truth, np.array(found["T_camera_lidar"])) < 0.3
    assert se3.translation_error_m(truth, np.array(found["T_camera_lidar"])) < 0.05


def test_missing_models_of_a_semantic_start_are_named(tmp_path, capsys):
    wrong = {
        "none.yaml": ({"image_classes": ""}, "semantic needs classes of pixels and points: leave semantics.segmentation"),
        "off.yaml": ({"segmentation": "none", **SOURCE}, "--initial semantic needs classes"),
        "points.yaml": ({"image_classes": "source", "cloud_classes": ""}, "--initial semantic needs classes"),
        "file.yaml": ({"image_classes": str(tmp_path / "net.onnx")}, "net.onnx: there is no such file"),
        "word.yaml": ({"image_class": "source"}, "image_class"),
    }
    for name, (semantics, text) in wrong.items():
        (tmp_path / name).write_text(yaml.safe_dump({"semantics": semantics}))
        for command in ("calibrate", "replay"):
            code, _, err = run(capsys, command, SMALL, "--initial", "semantic", "--config", str(tmp_path / name))
            if (name, command) == ("file.yaml", "replay"):
                assert (code, text in err) == (1, True)  # it goes on without, as the node does
                continue
            assert (code, len(err.splitlines())) == (2, 1), (name, command, err)
            assert text in err


def test_a_first_guess_does_not_need_classes_of_consecutive_keyframes(drive, source):
    """Slow models see one keyframe in several: those that have classes wait in the buffer until there are enough of them."""
    config = with_models(update(QUICK, {"online": {"buffer_size": 6, "min_keyframes": 3}, **GUESSED}), **SOURCE)
    recalibrator = Recalibrator(source.camera, nominal_start(), config)
    buffer = KeyframeBuffer(4)
    plain, seen = (
        recalibrator.calibrator.extract(drive[0], s) for s in (None, FrameSemantics(None, drive[0].classes, drive[0].cloud.label))
    )
    for features in (seen, plain, plain, seen, plain, plain, plain):
        buffer.add(features, lambda f: bool(Calibrator.views([f])))
    assert [f is seen for f in buffer.features] == [True, True, False, False]
    for _ in range(5):
        buffer.add(seen, lambda f: bool(Calibrator.views([f])))
    assert [f is seen for f in buffer.features] == [True] * 4
    assert buffer.incomplete
    # Masks are not needed for it, and are not asked for meanwhile.
    recalibrator.configure(with_models(recalibrator.config, **SOURCE, segment_anything="no.onnx"))
    assert recalibrator.ingest(drive[0])
    assert recalibrator.segment_keyframe() == ()


@pytest.mark.slow
def test_reset_returns_to_the_unknown_extrinsic(drive, source):
    config = with_models(update(QUICK, {"online": {"min_keyframes": 3}, **GUESSED}), **SOURCE)
    recalibrator = Recalibrator(source.camera, nominal_start(), config)

    def driven() -> Result:
        for frame in drive[:3]:
            recalibrator.ingest(frame)
            recalibrator.segment_keyframe()
        return recalibrator.estimate().result

    first = driven()
    assert first.converged, first.reason
    recalibrator.reset()
    assert recalibrator.current.result.status == INITIAL
    assert np.array_equal(recalibrator.tracker.T, nominal())
    assert np.allclose(driven().T_camera_lidar, first.T_camera_lidar, atol=1e-9)
    # Switched off it is nominal, and on again it is looked for, as long as no estimate has been taken in.
    recalibrator.reset()
    recalibrator.configure(update(recalibrator.config, {"initial": {"method": "nominal"}}))
    recalibrator.configure(update(recalibrator.config, GUESSED))
    assert driven().converged


def test_a_first_guess_after_a_reset_gets_classes_again(drive, start):
    settings = update(QUICK, {"semantics": {"use": "in_doubt"}, **GUESSED})
    recalibrator = recalibrator_of(drive, replace(nominal_start(), T_camera_lidar=nominal()), settings)
    assert recalibrator.needs_classes
    recalibrator._extrinsic_unknown = recalibrator._in_doubt = False  # as after an estimate without doubt
    assert not recalibrator.segments_keyframes
    recalibrator.reset()
    assert recalibrator.needs_classes
    assert recalibrator.segments_keyframes


def test_a_first_guess_that_is_asked_for_later_begins_with_new_keyframes(drive):
    recalibrator = recalibrator_of(drive, nominal_start(), QUICK)
    recalibrator.ingest(drive[0])
    recalibrator.configure(update(QUICK, GUESSED))
    assert recalibrator.needs_classes
    assert len(recalibrator.buffer) == 0  # their points have classes near the nominal view only


def test_nothing_is_estimated_again_where_no_classes_were_found(monkeypatch, drive, start):
    estimates = []
    real = Calibrator.estimate
    monkeypatch.setattr(Calibrator, "estimate", lambda self, *args, **kw: estimates.append(1) or real(self, *args, **kw))
    monkeypatch.setattr(Segmentation, "__call__", lambda *args, **kw: FrameSemantics(problems=("the model is broken",)))
    swapped = [replace(f, image=drive[(k + 2) % len(drive)].image) for k, f in enumerate(drive)]
    result = Calibrator(drive[0].camera, QUICK).calibrate(swapped, start, SearchBox(2, 0.15))
    assert not result.converged
    assert len(estimates) == 1
    assert "the model is broken" in result.reason
