"""What the recordings of a vehicle tell together, with tables and page; and certificates of data sets."""

from __future__ import annotations

import base64
import csv
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import sample_sources
from html_pages import Page
from scenes import RenderedDrive
from waiting import until

from calib_ros import se3
from calib_ros.cli.main import main
from calib_ros.config import MotionConfig
from calib_ros.errors import MissingDependencyError
from calib_ros.lidar.deskew import deskewed_frame
from calib_ros.registration.initial_guess import nominal
from calib_ros_check.cli import fleet_summary
from calib_ros_check.fleet.fleet import Fleet, FleetOptions, write_changes, write_csv, write_parquet
from calib_ros_check.fleet.history import Certificate, Row, certificate_of, row_of, utc, vehicles
from calib_ros_check.fleet.page import MOST_ROWS, change_size, plots, write_fleet_page
from calib_ros_check.fleet.recordings import Recording, find_claims
from calib_ros_check.jobs.pool import Answer
from calib_ros_check.outcome import CheckResult, Tolerance
from calib_ros_check.recording import CheckOptions
from calib_ros_check.tolerance import judge

SIGMA = np.r_[np.deg2rad([0.05] * 3), [0.01] * 3]
TURNED = se3.exp(np.r_[np.deg2rad([0.3, 1.6, 0.0]), 0.0, 0.0, 0.0])


def recording(vehicle: str, number: int) -> Recording:
    """The drive of a day."""
    return Recording(f"/data/{vehicle}/drive_{number:02d}", vehicle, (1_760_000_000 + 86_400 * number) * 10**9, "f")


def checked(vehicle: str, number: int, T: np.ndarray, rng: np.random.Generator, factor: float = 1.0) -> tuple[Recording, Answer]:
    """A recording and its answer: `nominal()` was checked, T (4, 4) is true, and estimated with SIGMA times a factor."""
    own, C = recording(vehicle, number), np.diag((factor * SIGMA) ** 2)
    estimate = se3.exp(factor * SIGMA * rng.standard_normal(6)) @ T
    found = judge(nominal(), estimate, C, Tolerance())
    verdict = found.verdict, "said", Tolerance(), nominal(), estimate, C, found.p_within
    axes = found.rotation, found.translation, found.axes
    result = CheckResult(*verdict, *axes, frames_used=10, data_stamp=own.modified_ns)
    return own, {"result": result.to_dict(), "cpu_s": 10.0, "bytes_read": 2_000_000, "peak_bytes": 300_000_000}


def broken(vehicle: str, number: int, message: str = "it is broken") -> tuple[Recording, Answer]:
    """A recording that could not be checked."""
    return recording(vehicle, number), {"error": message, "from": "input"}


def moved(steps: Sequence[float]) -> np.ndarray:
    """`nominal()` turned and shifted by (6,), deg and m."""
    return se3.exp(np.r_[np.deg2rad(steps[:3]), steps[3:]]) @ nominal()


@pytest.fixture(scope="module")
def fleet() -> Fleet:
    """`a` turned before its seventh recording, `b` has a wrong and a broken one, `c` changed at its newest."""
    rng = np.random.default_rng(4)
    right, turned, off = moved([0] * 6), moved([0.8, 0, 0, 0, 0, 0]), moved([0, 3.0, 0, 0, 0, 0])
    answers = [checked("a", k, right if k < 6 else turned, rng) for k in range(12)]
    answers += [checked("b", k, off if k == 4 else right, rng) if k != 7 else broken("b", k) for k in range(12)]
    answers += [checked("c", k, right if k < 11 else turned, rng) for k in range(12)]
    answers += [broken("d", 0, "nothing of it <b>works</b>")]
    return Fleet(*vehicles([row_of(*one) for one in reversed(answers)]))


def test_changes_name_vehicle_recordings_and_size(fleet: Fleet) -> None:
    assert [(c.vehicle, c.before.recording, c.after.recording, c.confirmed) for c in fleet.changes] == [
        ("a", "drive_05", "drive_06", True),
        ("c", "drive_10", "drive_11", False),
    ]
    change = fleet.changes[0]
    assert change.rotation_deg == pytest.approx(0.8, abs=0.15)
    assert change.value[0] == pytest.approx(np.deg2rad(0.8), abs=4 * np.sqrt(change.covariance[0, 0]))
    assert change.sigma[0] == pytest.approx(0.05 * np.sqrt(2 / 6), rel=0.5)
    assert re.match(r"0\.\d\d deg, \d\.\d cm: rx \+0\.\d\d deg ± 0\.0\d deg", change_size(change))


def test_rows_say_drift_changes_and_outliers(fleet: Fleet) -> None:
    rows = {(row.vehicle, row.recording): row for row in fleet.rows}
    assert [key for key, row in rows.items() if row.outlier] == [("b", "drive_04")]
    assert [key for key, row in rows.items() if row.changed] == [("a", "drive_06"), ("c", "drive_11")]
    assert rows["a", "drive_00"].drift_deg is None
    assert rows["a", "drive_06"].drift_deg == pytest.approx(0.8, abs=0.3)
    assert rows["a", "drive_06"].drift_sigma > 8
    assert rows["b", "drive_04"].drift_deg == pytest.approx(3.0, abs=0.3)
    usual = [r.drift_sigma for r in fleet.rows if r.drift_sigma is not None and not r.changed and not r.outlier]
    assert np.mean(np.array(usual) > 2) < 0.2
    assert rows["a", "drive_07"].drift_sigma < 4  # against those since the change
    assert (rows["b", "drive_07"].verdict, rows["b", "drive_07"].message) == ("error", "it is broken")
    assert rows["a", "drive_08"].verdict == "fail"
    assert rows["a", "drive_08"].errors["rx_deg"] == pytest.approx(-0.8, abs=0.3)
    assert rows["a", "drive_03"].time == "2025-10-12T08:53:20Z"
    assert list(fleet.counts) == ["fail", "error", "inconclusive", "pass"]
    assert fleet.counts["error"] == 2


def test_exit_codes() -> None:
    codes = {"pass": 0, "pass fail inconclusive error": 1, "pass inconclusive": 3, "error error": 2, "pass error": 3, "": 2}
    for verdicts, code in codes.items():
        rows = [Row("r", "v", "", verdict) for verdict in verdicts.split()]
        assert Fleet(*vehicles(rows)).exit_code == code, verdicts


def test_what_is_printed(fleet: Fleet) -> None:
    text = fleet_summary(fleet)
    assert text.splitlines()[0].startswith("37 recordings of 4 vehicles: ")
    assert "a changed between drive_05 (2025-10-14T08:53:20Z) and drive_06" in text
    assert "not confirmed, only the newest" in text
    assert ": it is broken" in text.split("  error: ")[1].splitlines()[0]


def test_times_come_from_the_data_unless_its_clock_was_never_set() -> None:
    own, answer = checked("a", 3, moved([0] * 6), np.random.default_rng(0))
    answer["result"]["data_stamp"] = 1_500_000_000 * 10**9
    assert row_of(own, answer).time == "2017-07-14T02:40:00Z"
    answer["result"]["data_stamp"] = 7 * 10**9
    assert row_of(own, answer).time_ns == own.modified_ns
    assert utc(0) == ""


def test_tables(fleet: Fleet, tmp_path: Path) -> None:
    write_csv(tmp_path / "fleet.csv", [row.values() for row in fleet.rows])
    with (tmp_path / "fleet.csv").open(newline="") as file:
        read = list(csv.DictReader(file))
    assert read[0].keys() == fleet.rows[0].values().keys()
    assert len(read) == 37
    assert read[0]["recording"] == "drive_00"
    assert float(read[0]["rx_deg"]) == pytest.approx(fleet.rows[0].errors["rx_deg"], rel=1e-5)
    assert (read[-1]["verdict"], read[-1]["rx_deg"], read[-1]["changed"]) == ("error", "", "false")
    write_changes(tmp_path / "changes.csv", fleet.changes)
    with (tmp_path / "changes.csv").open(newline="") as file:
        changes = list(csv.DictReader(file))
    assert [(c["vehicle"], c["after"], c["confirmed"]) for c in changes] == [
        ("a", "drive_06", "true"),
        ("c", "drive_11", "false"),
    ]
    assert float(changes[0]["rx_deg"]) == pytest.approx(0.8, abs=0.15)
    assert float(changes[0]["ty_m_sigma"]) < 0.02


def test_parquet_has_types_and_without_pyarrow_says_what_to_install(
    fleet: Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    write_parquet(tmp_path / "fleet.parquet", fleet.rows)
    table = parquet.read_table(tmp_path / "fleet.parquet")
    assert table.column_names == [*fleet.rows[0].values()]
    kinds = {"time_ns": "int64", "rx_deg": "double", "changed": "bool", "cause": "string"}
    assert {name: str(table.schema.field(name).type) for name in kinds} == kinds
    read = table.to_pylist()
    assert (read[0]["rotation_deg"], read[-1]["rotation_deg"]) == (fleet.rows[0].errors["rotation_deg"], None)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingDependencyError, match="pip install pyarrow"):
        write_parquet(tmp_path / "fleet.parquet", fleet.rows)


def page_of(fleet: Fleet, folder: Path) -> str:
    path = folder / "fleet.html"
    write_fleet_page(path, fleet, FleetOptions(["x"], folder), {"Command": "check x"})
    return path.read_text()


def test_page_says_it_all_without_network(fleet: Fleet, tmp_path: Path) -> None:
    page = page_of(fleet, tmp_path)
    assert not re.search(r"(src|href)=\"?(https?:)?//", page)
    summary_at, table_at = page.index('id="summary"'), page.index('id="all"')
    assert summary_at < page.index("<b>a</b> by 0.") < table_at
    assert "drive_04 (b)" in page[summary_at:table_at]
    assert page.count("<tr><td") == 37
    assert "nothing of it &lt;b&gt;works" in page
    assert page.count("<svg") == 6 * 3  # d has no estimate
    assert page.count('<line class="change"') == 6 * 2
    assert page.count(' outlier">') == 6
    shown = re.sub(r"<script>.*</script>", "", page.split("<main>")[1], flags=re.S)
    assert not re.search(r"\b(nan|inf|None)\b", shown, flags=re.I)


def test_a_large_fleet_has_a_page_of_what_wants_attention(fleet: Fleet, tmp_path: Path) -> None:
    many = [Row(f"r{k}", "v", "", "pass") for k in range(MOST_ROWS)] + [Row("bad", "v", "", "fail")]
    page = page_of(Fleet(*vehicles(many)), tmp_path)
    assert page.count("<tr><td") == MOST_ROWS
    assert ">bad</td>" in page
    assert "1 more recordings are in fleet.csv" in page


def test_plots_keep_within_their_frame(fleet: Fleet) -> None:
    for vehicle in fleet.vehicles:
        for plot in plots(vehicle, fleet.variances):
            assert len(plot["points"]) == len(vehicle.known)
            for point in plot["points"]:
                assert 0 < point["x"] < 380
                assert 18 <= point["high"] <= point["y"] <= point["low"] <= 132
    same_time = vehicles([Row("r", "v", "", "pass", path=str(k)) for k in range(3)])[0][0]
    assert plots(same_time, np.zeros(6)) == []


# --- certificates ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """The one worker is this process."""
    monkeypatch.setattr("calib_ros_check.fleet.check.lost", None)


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


@pytest.mark.usefixtures("in_this_process")
def test_right_and_wrong_calibrations_of_a_data_set_are_told_apart(tree: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tree.parent / "out"
    command = ["certify", str(tree), "--out", str(out), "--workers", "1"]
    assert main(command) == 1
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
    assert [cv2.imdecode(picture, cv2.IMREAD_COLOR).shape[1] for picture in shown] == [640] * 12

    before = (out / "results.jsonl").read_bytes()
    assert main(command) == 1
    assert (out / "results.jsonl").read_bytes() == before  # nothing is checked again
    (tree / "damaged/calibration.yaml").write_text("image_width: {")
    main(command)
    assert len((out / "results.jsonl").read_bytes().splitlines()) == len(before.splitlines()) + 1


@pytest.mark.usefixtures("in_this_process")
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
