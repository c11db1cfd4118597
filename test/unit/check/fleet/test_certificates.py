"""Certificates of data sets: right and wrong calibrations, several recordings of one, damaged files, going on."""

from __future__ import annotations

import base64
import csv
import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import sample_sources
from fleets import broken, checked, moved
from html_pages import Page
from scenes import RenderedDrive
from waiting import until

from calib_ros import se3
from calib_ros.cli.main import main
from calib_ros.config import MotionConfig
from calib_ros.lidar.deskew import deskewed_frame
from calib_ros_check.fleet.history import Certificate, certificate_of, row_of, vehicles
from calib_ros_check.fleet.recordings import find_claims
from calib_ros_check.outcome import Tolerance
from calib_ros_check.recording import CheckOptions

TURNED = se3.exp(np.r_[np.deg2rad([0.3, 1.6, 0.0]), 0.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two calibrations in one KITTI folder, the second wrong; one in another; a plain folder whose calibration is damaged."""
    drive = RenderedDrive(seed=1, frames=4, rings=64, width=640, height=240, stride=30)
    frames = [deskewed_frame(drive[k], MotionConfig()) for k in range(4)]
    root = tmp_path_factory.mktemp("sets") / "data"
    wrong = [replace(frame, reference=TURNED @ drive.reference) for frame in frames[2:]]
    other = [replace(frame, reference=se3.perturb(drive.reference, [0.05, 0, 0], [0, 0, 0])) for frame in frames[:2]]
    sample_sources.kitti(root / "training", "object", [*frames[:2], *wrong])
    sample_sources.kitti(root / "campus", "object", other)
    sample_sources.plain(root / "damaged")
    (root / "damaged/calibration.yaml").write_text("image_width: [")
    return root


def test_right_and_wrong_calibrations_of_a_data_set_are_told_apart(tree: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tree.parent / "out"
    assert main(["certify", str(tree), "--out", str(out), "--workers", "1"]) == 1
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "4 calibrations: 1 fail, 1 error, 0 inconclusive, 2 pass"
    with (out / "certificates.csv").open(newline="") as file:
        rows = {row["calibration"]: row for row in csv.DictReader(file)}
    assert {name: (row["verdict"], row["frames"]) for name, row in rows.items()} == {
        "training, camera 2 (1 of 2)": ("pass", "2"),
        "training, camera 2 (2 of 2)": ("fail", "2"),
        "campus, camera 2": ("pass", "2"),
        "damaged": ("error", "0"),
    }
    wrong = rows["training, camera 2 (2 of 2)"]
    assert float(wrong["ry_low"]) <= 1.6 <= float(wrong["ry_high"])
    assert float(wrong["ry_high"]) - float(wrong["ry_low"]) < 0.5
    assert "deg too far left" in wrong["message"]
    assert "calibration.yaml" in rows["damaged"]["message"]
    page = (out / "certificates.html").read_text()
    doubtful = page[page.index("Summary") : page.index("All calibrations")]
    assert doubtful.index("(2 of 2)") < doubtful.index("damaged")
    assert "campus" not in doubtful
    shown = [np.frombuffer(base64.b64decode(own.partition("base64,")[2]), np.uint8) for own in Page(page).sources]
    assert [cv2.imdecode(picture, cv2.IMREAD_COLOR).shape[1] for picture in shown] == [640] * 6

    before = (out / "results.jsonl").read_bytes()
    assert main(["certify", str(tree), "--out", str(out), "--workers", "1"]) == 1
    assert (out / "results.jsonl").read_bytes() == before  # nothing is checked again
    (tree / "damaged/calibration.yaml").write_text("image_width: {")
    main(["certify", str(tree), "--out", str(out), "--workers", "1"])
    assert len((out / "results.jsonl").read_bytes().splitlines()) == len(before.splitlines()) + 1


def test_what_was_killed_goes_on(tmp_path: Path) -> None:
    for k in range(6):
        sample_sources.kitti(tmp_path / f"2011_09_26/drive_{k}_sync", "raw")
    journal = tmp_path / "out/results.jsonl"
    arguments = ["certify", str(tmp_path / "2011_09_26"), "--out", str(tmp_path / "out"), "--workers", "1"]
    process = subprocess.Popen(
        [sys.executable, "-m", "calib_ros", *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        until(lambda: journal.exists() and journal.read_bytes().count(b"\n") > 1)
    finally:
        process.kill()
        process.wait()
    kept = journal.read_bytes()
    kept = kept[: kept.rindex(b"\n") + 1]
    main(arguments)
    assert journal.read_bytes().startswith(kept)
    paths = [json.loads(line)["job"]["path"] for line in journal.read_bytes().splitlines()[1:]]
    assert sorted(paths) == sorted({*paths})
    assert len(paths) == 6


def test_drives_of_a_day_share_a_calibration_and_frames_may_have_their_own(tmp_path: Path) -> None:
    day = tmp_path / "2011_09_26"
    for name in ("first_sync", "second_sync"):
        sample_sources.kitti(day / name, "raw")
    sample_sources.kitti(tmp_path / "object/training", "object")
    own = tmp_path / "object/training/calib/000001.txt"
    own.write_text(own.read_text().replace("P2: ", "P2: 1", 1))
    claims = find_claims([str(tmp_path)], CheckOptions())
    assert [(c.vehicle, c.name, c.camera, c.frames) for c in claims] == [
        ("2011_09_26, camera 2", "first_sync", "2", ""),
        ("2011_09_26, camera 2", "second_sync", "2", ""),
        ("object/training, camera 2 (1 of 2)", "training", "2", "0"),
        ("object/training, camera 2 (2 of 2)", "training", "2", "1"),
    ]
    assert [c.frames for c in find_claims([str(day)], CheckOptions(), 1)] == ["1", "1"]
    assert [c.camera for c in find_claims([str(day)], CheckOptions(camera="2"))] == ["", ""]


def test_a_calibration_is_named_by_the_recording_that_has_no_other(tmp_path: Path) -> None:
    sample_sources.kitti(tmp_path / "object/training", "object")
    shutil.copytree(tmp_path / "object/training", tmp_path / "other/training")
    changed = tmp_path / "object/training/calib/000001.txt"
    changed.write_text(changed.read_text().replace("P2: ", "P2: 1", 1))
    claims = find_claims([str(tmp_path)], CheckOptions())
    assert [(Path(c.path).parent.name, c.frames, c.vehicle) for c in claims] == [
        ("object", "0", "other/training and 1 more, camera 2"),
        ("other", "", "other/training and 1 more, camera 2"),
        ("object", "1", "object/training, camera 2"),
    ]


def test_scenes_and_cameras_of_nuscenes_are_claims(tmp_path: Path) -> None:
    sample_sources.nuscenes(tmp_path / "nuscenes")
    claims = find_claims([str(tmp_path / "nuscenes")], CheckOptions())
    assert claims
    assert all("#" in claim.path and claim.camera.startswith("CAM") for claim in claims)


def certificate(errors: list[list[float]], factor: float = 6.0, shared: np.ndarray | None = None) -> Certificate:
    """Of recordings whose scenes show these errors (6,), deg and m, by estimates of 0.3 deg and 6 cm."""
    rng = np.random.default_rng(2)
    made = [checked("set", k, moved(error), rng, factor) for k, error in enumerate(errors)]
    rows = [row_of(*one) for one in made]
    for row in rows:
        row.result["shared_covariance"] = None if shared is None else shared.tolist()
    (vehicle,), _ = vehicles(rows)
    return certificate_of(vehicle, Tolerance())


def test_recordings_that_tell_too_little_each_tell_enough_together() -> None:
    off = [0.0, 0.9, 0.0, 0.0, 0.0, 0.0]
    alone, together, right = certificate([off]), certificate([off] * 12), certificate([[0.0] * 6] * 12)
    assert (alone.verdict, together.verdict, right.verdict) == ("inconclusive", "fail", "pass")
    spans = [own.judgement.axes[1].high - own.judgement.axes[1].low for own in (alone, together)]
    assert spans[1] < 0.5 * spans[0]
    axis = together.judgement.axes[1]
    assert axis.low < -0.9 < axis.high < -0.5
    assert se3.rotation_error_deg(together.T_found, moved(off)) < 0.3
    assert together.frames == 120
    assert "0.5 deg" in together.reason


def test_what_intrinsics_leave_open_does_not_shrink_with_recordings() -> None:
    shared = np.diag([np.deg2rad(0.5)] * 3 + [0.0] * 3) ** 2
    off = [[0.0, 0.9, 0.0, 0.0, 0.0, 0.0]] * 12
    spans = [
        own.judgement.axes[1].high - own.judgement.axes[1].low for own in (certificate(off), certificate(off, shared=shared))
    ]
    assert spans[1] > 2 * spans[0]
    assert certificate(off, shared=shared).verdict == "inconclusive"


def test_sensors_that_move_while_the_calibration_stays_are_told() -> None:
    steady, moved_by = [0.0] * 6, [0.0, 0.0, 2.0, 0.0, 0.0, 0.0]
    found = certificate([steady] * 6 + [moved_by] * 6, factor=1.0)
    assert found.verdict == "fail"
    assert found.reason.startswith("the sensors moved 1 times while the calibration stayed; at worst: ")
    assert [change.after.recording for change in found.vehicle.changes] == ["drive_06"]
    assert found.values()["changes"] == 1


def test_a_calibration_without_anything_readable_is_an_error() -> None:
    (vehicle,), _ = vehicles([row_of(*broken("set", 0, "no such file"))])
    found = certificate_of(vehicle, Tolerance())
    assert (found.verdict, found.reason) == ("error", "no such file")
    assert found.values()["rotation_deg"] is None
