"""A fleet from its files to its tables: bad recordings, going on, changed files, workers that end."""

from __future__ import annotations

import csv
import os
import shutil
from pathlib import Path

import pytest

from calib_ros.cli.main import main
from calib_ros.config import Config, update
from calib_ros.datasets.bag_writer import write_bag
from calib_ros.errors import BadInputError
from calib_ros_check.fleet import check as module
from calib_ros_check.fleet.check import check_fleet, options_key, run_checks
from calib_ros_check.fleet.fleet import FleetOptions
from calib_ros_check.fleet.recordings import Recording
from calib_ros_check.outcome import Tolerance
from calib_ros_check.recording import CheckOptions
from calib_ros_semantics.models.weight_sets import of_package


@pytest.fixture
def bad(tmp_path: Path) -> Path:
    """Recordings that nobody can read, for different reasons."""
    folder = tmp_path / "fleet"
    (folder / "car/empty").mkdir(parents=True)
    (folder / "car/garbage.mcap").write_bytes(bytes(range(256)) * 20)
    (folder / "car/old.bag").write_bytes(b"#ROSBAG V2.0\n")
    return folder


def options(folder: Path, **changes) -> FleetOptions:
    return FleetOptions([str(folder)], folder.parent / "out", **{"workers": 1, **changes})


def lines(folder: Path) -> int:
    return len((folder.parent / "out/results.jsonl").read_text().splitlines())


def test_bad_recordings_are_rows(bad: Path) -> None:
    told: list[tuple[int, int]] = []
    fleet = check_fleet(options(bad), progress=lambda *counts: told.append(counts))
    assert fleet.exit_code == 2
    assert [row.verdict for row in fleet.rows] == ["error"] * 3
    messages = {row.recording: row.message for row in fleet.rows}
    assert "found nothing" in messages["empty"]
    assert "cannot be read" in messages["garbage.mcap"]
    assert "cannot be read" in messages["old.bag"]
    assert told[-1] == (3, 3)
    assert {path.name for path in fleet.files} >= {"fleet.html", "fleet.csv", "changes.csv"}
    assert all(path.stat().st_size for path in fleet.files)
    (page,) = (path for path in fleet.files if path.name == "fleet.html")
    assert "3 recordings of 0 vehicles" in page.read_text()


def test_a_recording_that_changed_and_other_options_are_checked_again(bad: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "lost", None)  # so that the one worker is this process
    check_fleet(options(bad))
    assert lines(bad) == 4
    (bad / "car/garbage.mcap").write_bytes(b"other")
    check_fleet(options(bad))
    assert lines(bad) == 5  # the others did not change
    check_fleet(options(bad, options=CheckOptions(tolerance=Tolerance(0.3, 0.05))))
    assert lines(bad) == 8
    (bad / "car/empty").rmdir()
    assert len(check_fleet(options(bad)).rows) == 2
    check_fleet(options(bad, fresh=True))
    assert lines(bad) == 3


def test_keys_of_options(tmp_path: Path) -> None:
    usual = options_key(CheckOptions())
    assert usual == options_key(CheckOptions())
    assert usual != options_key(CheckOptions(frames="0,1"))
    with pytest.raises(BadInputError):
        options_key(CheckOptions(extrinsic=str(tmp_path / "gone.json")))
    weights = tmp_path / "own.onnx"
    for named in ({"image_classes": str(weights)}, {"segment_anything": "sam.onnx", "segment_anything_decoder": str(weights)}):
        weights.write_bytes(of_package().read_bytes())
        trained = CheckOptions(config=update(Config(), {"semantics": named}))
        before = options_key(trained)
        assert options_key(trained) == before
        weights.write_bytes(weights.read_bytes()[:-1])
        assert options_key(trained) != before, "a recording is checked again with other weights"
    for wrong in ({"workers": -1}, {"false_alarms": 0.0}):
        with pytest.raises(BadInputError):
            FleetOptions(["x"], tmp_path, **wrong)


def deadly(options: CheckOptions, jobs: list[Recording]) -> list[dict]:
    """Like `run_checks`, but the garbage kills the process as a crash in a library does."""
    if "garbage" in jobs[0].path:
        os._exit(9)
    return run_checks(options, jobs)


def test_a_recording_that_ends_its_workers_is_a_row_and_is_tried_again(bad: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(module, "run_checks", deadly)
        messages = {row.recording: row.message for row in check_fleet(options(bad, workers=2)).rows}
    assert "did not end: its worker ended, also alone" in messages["garbage.mcap"]
    assert "found nothing" in messages["empty"]
    monkeypatch.setattr(module, "lost", None)  # so that the one worker is this process
    assert "cannot be read" in {row.recording: row.message for row in check_fleet(options(bad)).rows}["garbage.mcap"]


def test_a_recording_that_is_gone_is_blamed_on_the_machine(tmp_path: Path) -> None:
    (answer,) = run_checks(CheckOptions(), [Recording(str(tmp_path / "gone"), fingerprint="f")])
    assert "mount it on all workers" in answer["error"]
    assert answer["from"] == "other"
    (answer,) = run_checks(CheckOptions(), [Recording(str(tmp_path / "gone"))])
    assert "does not exist" in answer["error"]


def test_a_folder_of_recordings_from_the_command_line(drive, street_bag: Path, bad: Path, capsys) -> None:
    shutil.copytree(street_bag, bad / "car/street")
    write_bag(drive, bad / "van/street")
    out = str(bad.parent / "out")
    assert main(["check", str(bad), "--out", out, "--workers", "1", "--frames", "0,4"]) == 3
    said = capsys.readouterr().out
    assert said.startswith("5 recordings of 2 vehicles: 0 fail, 3 error, 0 inconclusive, 2 pass")
    with (bad.parent / "out/fleet.csv").open(newline="") as file:
        rows = {(row["vehicle"], row["recording"]): row for row in csv.DictReader(file)}
    for vehicle in ("car", "van"):
        row = rows[vehicle, "street"]
        assert float(row["rotation_deg"]) < 0.3
        assert float(row["cpu_s"]) > 0.1
        assert int(row["bytes_read"]) > 1_000_000
        assert int(row["peak_bytes"]) > 50_000_000


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["--report", "x.html"], "--report is for one recording"),
        (["--workers", "0"], "--workers 0: give at least 1"),
        (["--out", ""], "--out is given without a name"),
        (["--scheduler", "tcp://host"], "no Dask scheduler answers at 'tcp://host'"),
    ],
)
def test_options_of_a_fleet_are_refused_before_it_is_checked(bad: Path, given: list[str], message: str, capsys) -> None:
    folder = bad.parent / "out"
    assert main(["check", str(bad), "--out", str(folder), *given]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
    assert not (folder / "fleet.csv").exists()
