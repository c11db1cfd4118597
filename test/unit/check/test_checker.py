"""The check of an extrinsic on synthetic streets: right, wrong, and wrong for another reason than the mount."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scenes import RenderedDrive

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.cli import main
from calib_ros.config import Config, SearchConfig
from calib_ros.errors import BadInputError
from calib_ros.frame import PointCloud
from calib_ros.lidar.scanner_pose import ScannerPose
from calib_ros.registration.judgement.hypotheses import axis_rotations, distinct_poses, mix_ups
from calib_ros.registration.judgement.judge import FEW_FRAMES, NEAR, Candidate, Question
from calib_ros.result import CONVERGED, REFUSED, Cause, Evidence, RefusalCode, Result
from calib_ros_check.checker import WIDER, Checker, CheckInputs, look
from calib_ros_check.outcome import CauseState, CheckVerdict, Tolerance

pytestmark = pytest.mark.usefixtures("rendered_once")
QUICK = Config(search=SearchConfig(rounds=1, starts=64))
SOURCE = "synthetic:seed=1,frames=4,rings=64,width=640,height=240,stride=30"
BODY = se3.from_parts(se3.OPTICAL_FROM_BODY, np.zeros(3))


def camera(width, height, cx, cy, focal=500.0):
    return Camera(np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1]]), width, height)


@pytest.fixture(scope="module")
def made():
    return RenderedDrive(seed=1, frames=4, rings=64, width=640, height=240, stride=30)


@pytest.fixture(scope="module")
def drive(made):
    return [made[k] for k in (0, 2)], made.reference


@pytest.fixture(scope="module")
def checker(made):
    """Of a small search, which finds what is to be found here."""
    return Checker(made.camera, QUICK)


@pytest.mark.parametrize(("deg", "tolerance"), [(0.0, Tolerance()), (0.8, Tolerance(2.0, 0.2))])
def test_an_extrinsic_within_the_tolerance_passes(drive, checker, deg, tolerance):
    frames, truth = drive
    result = checker.check(frames, se3.perturb(truth, [0, deg, 0], [0, 0, 0]), tolerance)
    assert (result.verdict, result.cause) == (CheckVerdict.PASS, None), result.reason
    assert result.p_within > 0.9
    assert [axis.name for axis in result.axes] == ["rx", "ry", "rz", "tx", "ty", "tz"]
    json.loads(result.dumps())


@pytest.mark.parametrize(("deg", "m", "axis"), [([0, 1.2, 0], [0, 0, 0], "ry"), ([0, 0, 0], [0, 0.25, 0], "ty")])
def test_a_wrong_extrinsic_fails_on_its_axis_with_its_size(drive, checker, deg, m, axis):
    frames, truth = drive
    checked = se3.from_parts(se3.perturb(np.eye(4), deg, [0, 0, 0])[:3, :3] @ truth[:3, :3], truth[:3, 3] + m)
    result = checker.check(frames, checked)
    assert result.verdict is CheckVerdict.FAIL, result.reason
    found = {own.name: own for own in result.axes}[axis]
    assert found.verdict is CheckVerdict.FAIL
    assert found.low <= (max(deg) or max(m)) <= found.high
    mixed_up = next(own for own in result.causes if own.cause is Cause.INVERSE_TRANSFORM)
    assert (mixed_up.state, mixed_up.message) == (CauseState.EXCLUDED, "turned or shifted, the extrinsic matches")


def test_an_optimum_that_a_search_missed_is_looked_for_once_more(drive, monkeypatch):
    frames, truth = drive
    checker = Checker(frames[0].camera, QUICK)
    missed = Result(truth, REFUSED, "missed", refusal=RefusalCode.NOT_SIGNIFICANT)
    monkeypatch.setattr(checker._calibrator, "estimate", lambda *_: missed)
    result = checker.check(frames, se3.perturb(truth, [2.0, 0, 0], [0, 0, 0]))
    assert (result.verdict, result.cause) == (CheckVerdict.FAIL, None), result.reason
    assert {own.name for own in result.axes if own.verdict is CheckVerdict.FAIL} == {"rx"}


@pytest.mark.parametrize(("p_value", "taken"), [(0.004, True), (0.008, False)])
def test_further_looks_are_at_half_the_p_value_whatever_the_clocks(drive, monkeypatch, p_value, taken):
    """The limit is 0.01, which holds for an optimum that is refused for its time stamps as well."""
    frames, truth = drive
    checker = Checker(frames[0].camera, QUICK)
    doubt = Evidence(5.0, None, p_value, 1.0)
    late = Result(truth, REFUSED, "late", refusal=RefusalCode.WRONG_TIMES, evidence=doubt, optimum=truth)
    for calibrator in (checker._calibrator, checker._further):
        monkeypatch.setattr(calibrator, "estimate", lambda *_: late)
    inputs, optima = CheckInputs(truth, Tolerance()), []
    assert look(checker._calibrator, [], NEAR, inputs, optima) is late
    assert (look(checker._further, [], NEAR, inputs, optima) is late) == taken
    assert len(optima) == 2, "what is not taken competes all the same"


def test_a_check_may_be_ended_among_the_causes(drive, checker):
    (frames, truth), stages = drive, []

    def end(stage, share):
        stages.append((stage, share))
        if stage == "causes" and share > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        checker.check(frames, se3.inverse(truth), progress=end)
    assert {"features", "search", "causes"} <= {stage for stage, _ in stages}
    assert all(0 <= share <= 1 for _, share in stages)


def test_what_edges_find_far_away_needs_no_classes(drive, checker, monkeypatch):
    """A scene with few objects matches less by its classes than by its edges."""
    frames, truth = drive
    # This mount is nearly that of a cloud in the camera's body frame.
    monkeypatch.setattr(checker._judge, "explain", lambda *_: None)
    features = [checker._calibrator.extract(frame) for frame in frames]
    asked: list[str] = []
    checked = se3.perturb(truth, [0, 16.0, 6.0], [0, 0, 0])
    asked_for = CheckInputs(checked, Tolerance(), lambda numbers: asked.append("classes") or features)
    result = checker.check_features(features, asked_for)
    assert result.verdict is CheckVerdict.FAIL, result.reason
    assert result.rotation.error == pytest.approx(np.hypot(16, 6), abs=0.3)
    assert not asked


@pytest.mark.parametrize(
    ("wrong", "flip", "cause"),
    [
        (lambda T: se3.inverse(T), (), Cause.INVERSE_TRANSFORM),
        (lambda T: se3.inverse(BODY) @ T, (), Cause.BODY_FRAME),
        (lambda T: T @ se3.from_parts(axis_rotations()[0], np.zeros(3)), (), Cause.CLOUD_FRAME),
        (lambda T: T, (1,), Cause.MIRRORED_IMAGE),
        (lambda T: T, (0, 1), Cause.ROTATED_IMAGE),
    ],
)
def test_transforms_and_pictures_that_were_mixed_up_are_named(drive, checker, wrong, flip, cause):
    frames, truth = drive
    pictures = [replace(frame, image=np.ascontiguousarray(np.flip(frame.image, flip))) for frame in frames]
    result = checker.check(pictures, wrong(truth))
    assert (result.verdict, result.cause) == (CheckVerdict.FAIL, cause), result.reason


def test_a_cloud_in_another_frame_of_the_vehicle_is_named(drive, checker):
    frames, truth = drive
    T_base_lidar = se3.from_parts(se3.rotation_from_euler(0.3, 0.02, 0.0), [1.2, 0.1, 1.7])
    moved = [
        replace(f, cloud=replace(f.cloud, xyz=se3.transform(T_base_lidar, f.cloud.xyz).astype(np.float32)), compensated=True)
        for f in frames
    ]
    vehicle = {"base_link": truth @ se3.inverse(T_base_lidar), "imu": se3.perturb(truth, [0, 0, 40], [0.5, 0, 0])}
    result = checker.check(moved, truth, vehicle_frames=vehicle)
    assert (result.verdict, result.cause) == (CheckVerdict.FAIL, Cause.CLOUD_FRAME), result.reason
    assert "in the frame base_link" in result.reason
    causes = {finding.cause: finding.state for finding in result.causes}
    assert causes[Cause.TIME_OFFSET] is causes[Cause.FOCAL_LENGTH] is CauseState.NOT_JUDGED
    assert len(causes) == len(result.causes)


@pytest.mark.slow
def test_a_mount_that_is_far_off_is_no_cloud_in_the_body_frame(drive, checker):
    """Cameras that look ahead, next to the scanner, have about the extrinsic that such a cloud would have."""
    frames, truth = drive
    checked = se3.perturb(truth, [0, 12.0, 3.0], [0, 0, 0])
    result = checker.check(frames, checked)
    assert (result.verdict, result.cause) == (CheckVerdict.FAIL, None), result.reason
    assert result.rotation.error == pytest.approx(se3.rotation_error_deg(checked, truth), abs=0.3)
    link = se3.inverse(BODY) @ truth
    moved = [replace(f, cloud=replace(f.cloud, xyz=se3.transform(link, f.cloud.xyz).astype(np.float32))) for f in frames]
    assert checker.check(moved, checked).cause is Cause.CLOUD_FRAME


@pytest.mark.parametrize(("deg", "m"), [(0.02, 0.005), (0.03, 0.02)])
def test_what_does_not_pass_tells_by_which_tolerance_it_does(drive, checker, deg, m):
    (frames, truth), wider = drive, [Tolerance(k * deg, k * m) for k in WIDER]
    result = checker.check(frames, truth, Tolerance(deg, m))
    assert result.verdict is CheckVerdict.INCONCLUSIVE, result.reason
    at = next(own for own in wider if f"passes from {own} on" in result.notes)
    assert checker.check(frames, truth, at).verdict is CheckVerdict.PASS


def test_pictures_of_elsewhere_are_inconclusive_and_none_are_bad_input(drive, checker):
    frames, truth = drive
    with pytest.raises(BadInputError, match="no frames"):
        checker.check([], truth)
    noise = np.random.default_rng(0).integers(0, 255, frames[0].image.shape, dtype=np.uint8)
    result = checker.check([replace(frames[0], image=noise)], truth)
    assert result.verdict is CheckVerdict.INCONCLUSIVE
    assert result.T_estimated is None
    assert all(finding.state is CauseState.NOT_JUDGED for finding in result.causes)
    assert Cause.ALREADY_RECTIFIED not in {finding.cause for finding in result.causes}, "CameraInfo has no distortion"
    assert "more frames" in result.reason


def test_where_nothing_matches_the_effort_is_bounded(made, checker, monkeypatch):
    """Searches do not depend on the number of frames; pictures are taken anew of a few, and of all for the best guess alone."""
    barrel = replace(made.camera, D=np.array([-0.3, 0.08, 0.0, 0.0, 0.0]))
    checker = Checker(barrel, checker.config)
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 255, made[0].image.shape, dtype=np.uint8) for _ in range(FEW_FRAMES + 1)]
    frames = [replace(made[k], camera=barrel, image=image) for k, image in enumerate(noise)]
    features = [checker._calibrator.extract(frame) for frame in frames]
    taken: list[int] = []
    searches: list[object] = []

    def as_taken(camera, numbers):
        taken.append(len(features) if numbers is None else len(numbers))
        return features if numbers is None else [features[k] for k in numbers]

    for calibrator in (checker._calibrator, checker._further):
        estimate = calibrator.estimate
        monkeypatch.setattr(
            calibrator, "estimate", lambda *given, estimate=estimate: searches.append(given[2]) or estimate(*given)
        )
    result = checker.check_features(features, CheckInputs(made.reference, Tolerance(), as_taken=as_taken))
    assert result.verdict is CheckVerdict.INCONCLUSIVE, result.reason
    assert len(searches) == 3
    assert sum(count > FEW_FRAMES for count in taken) <= 2


@pytest.fixture(scope="module")
def symmetric(made):
    """A scene that is its own mirror image, seen by a camera without an offset to the side."""
    out = []
    for frame in (made[0], made[2]):
        P = se3.transform(made.reference, frame.cloud.xyz.astype(float))
        P = np.concatenate([P[P[:, 0] < 0], P[P[:, 0] < 0] * [-1, 1, 1]])
        half = frame.image[:, : made.camera.width // 2]
        cloud = PointCloud(se3.transform(se3.inverse(made.reference), P).astype(np.float32))
        out.append(replace(frame, cloud=cloud, image=np.concatenate([half, half[:, ::-1]], axis=1), compensated=True))
    return out, made.reference


@pytest.mark.parametrize("deg", [0.0, 1.5])
def test_a_mix_up_under_which_the_scene_is_symmetric_is_not_named(symmetric, checker, deg):
    frames, truth = symmetric
    result = checker.check(frames, se3.perturb(truth, [0, deg, 0], [0, 0, 0]))
    assert result.cause is None, result.reason


def test_every_hypothesis_is_another_one_and_none_is_the_extrinsic_itself():
    T = se3.perturb(BODY, [1, 2, 3], [0.1, 0.2, 0.3])
    made = mix_ups(T, camera(640, 480, 320.0, 240.0), frames={"base_link": se3.perturb(T, [0, 0, 0], [0, 1.7, 0])})
    assert {guess.cause for guess in made} == {
        *(Cause.INVERSE_TRANSFORM, Cause.BODY_FRAME, Cause.QUATERNION_ORDER, Cause.CLOUD_FRAME),
        *(Cause.MIRRORED_IMAGE, Cause.ROTATED_IMAGE),
    }
    for k, guess in enumerate(made):
        assert guess.mirrored or not np.allclose(guess.T, T)
        assert not any(np.allclose(guess.T, own.T) and guess.mirrored == own.mirrored for own in made[:k])


def test_the_place_of_the_scanner_is_that_which_most_scans_show():
    """Some scans hide where the scanner stands, some show it elsewhere."""
    shown, other = ScannerPose.given([1.2, 0.1, 1.7], [0, 0, 0]), ScannerPose.given([0.3, 0.0, 0.4], [0, 0, 0])
    found = distinct_poses([ScannerPose(), other, ScannerPose(), shown, ScannerPose.given([1.21, 0.1, 1.7], [0, 1, 0])])
    assert [list(np.round(pose.centre, 1)) for pose in found] == [[1.2, 0.1, 1.7], [0.3, 0.0, 0.4]]
    assert distinct_poses([ScannerPose()]) == []


def test_a_mix_up_that_leads_back_to_the_extrinsic_says_nothing_that_an_error_of_it_does_not():
    T = se3.perturb(BODY, [2, 1, 0], [0.1, -0.2, 0.3])
    made = mix_ups(T, camera(640, 480, 300.0, 240.0))
    twice = next(own for own in made if "applied twice; leave one out, and invert" in own.message)
    assert se3.rotation_error_deg(T, twice.T) < 10, "a camera that looks ahead"
    for optimum, says in ((T, False), (se3.perturb(T, [0.3, 0, 0], [0, 0, 0.5]), False), (twice.T, True)):
        assert Candidate(None, optimum, twice).says_more_than(T) is says  # type: ignore[arg-type]
    mirrored = next(own for own in made if own.mirrored)
    assert Candidate(None, T, mirrored).says_more_than(T)  # type: ignore[arg-type]


def test_hypotheses_share_the_maps_of_the_frames(drive, checker):
    """Maps of its own for each of them would take gigabytes."""
    frames, truth = drive
    features = [checker._calibrator.extract(frame) for frame in frames]
    tried = checker._judge.tried(Question(features, truth), mix_ups(truth, frames[0].camera))
    assert len({own.hypothesis.cause for own in tried}) > 2
    assert len({id(own.score.atlas.levels[-1].image) for own in tried}) == 1


def test_the_command_says_pass_and_writes_result_and_page(tmp_path, capsys):
    files = tmp_path / "check.json", tmp_path / "new" / "check.html"
    assert main.main(["check", SOURCE, "--frames", "0,2", "--json", str(files[0]), "--report", str(files[1])]) == 0
    assert capsys.readouterr().out.startswith("pass: ")
    found = json.loads(files[0].read_text())
    assert found["verdict"] == "pass"
    Result(np.array(found["T_estimated"]), CONVERGED, frame_names=tuple(found["frames"]), frame_scores=(1.0, 1.0)).save(files[0])
    assert main.main(["check", SOURCE, "--frames", "1,2", "--extrinsic", str(files[0]), "--verbose"]) == 0
    reason, *_, stages = capsys.readouterr().out.splitlines()
    assert reason.startswith("pass: by 1 of 2 frames that it was made from, which cannot refute it")
    assert [own.split()[0] for own in stages.split(": ")[1].split(", ")] == ["reading", "features", "search", "causes"]
    page = files[1].read_text()
    assert "data:image/jpeg;base64," in page
    assert 'src="http' not in page


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--extrinsic", "tf"], "is no bag"),
        (["--tolerance-deg", "0"], "the tolerance of the rotation, 0 deg, is out of range"),
        (["--frames", "9"], "outside 0..3"),
        (["--extrinsic", "missing.json"], "missing.json"),
        (["--frames", "0,1,0"], "position 0 is named twice"),
        (["--report", f"{__file__}/page.html"], f"{__file__} is a file, not a folder; name another"),
        (["--json", f"{__file__}/check.json"], f"{__file__} is a file, not a folder; name another"),
        (["--json", str(Path(__file__).parent)], "is a folder; name a file"),
        (["--report", ""], "--report is given without a name"),
    ],
)
def test_bad_input_is_one_line(options, message, capsys):
    assert main.main(["check", SOURCE, *options]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
