"""A fleet: which recordings it has, and from its files to its tables: bad ones, going on, changed files, workers that end."""

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
from calib_ros_check.fleet.recordings import Recording, find_recordings, is_fleet
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


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """The one worker is this process."""
    monkeypatch.setattr(module, "lost", None)


def options(folder: Path, **changes) -> FleetOptions:
    return FleetOptions([str(folder)], folder.parent / "out", **{"workers": 1, **changes})


def lines(folder: Path) -> int:
    return len((folder.parent / "out/results.jsonl").read_text().splitlines())


@pytest.mark.usefixtures("in_this_process")
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


@pytest.mark.usefixtures("in_this_process")
def test_a_recording_that_changed_and_other_options_are_checked_again(bad: Path) -> None:
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
        messages = {row.recording: row.message for row in check_fleet(options(bad)).rows}
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


@pytest.mark.usefixtures("in_this_process")
def test_a_folder_of_recordings_from_the_command_line(drive, street_bag: Path, bad: Path, capsys) -> None:
    shutil.copytree(street_bag, bad / "car/street")
    write_bag(drive, bad / "van/street")
    assert main(["check", str(bad), "--out", str(bad.parent / "out"), "--workers", "1", "--frames", "0,4"]) == 3
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
        (["--verbose"], "--verbose is for one recording"),
        (["--overlay", "x.png"], "check has its pictures on a page, by --report HTML"),
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


# --- which recordings, of which vehicles ----------------------------------------------------------------------------------


def bag(folder: Path, loose: bool = False) -> Path:
    """What looks like a bag from outside."""
    if loose:
        folder.parent.mkdir(parents=True, exist_ok=True)
        folder.write_bytes(b"x")
        return folder
    folder.mkdir(parents=True)
    (folder / f"{folder.name}_0.mcap").write_bytes(b"x")
    (folder / "metadata.yaml").write_text("x")
    return folder


def found(root: Path, *sources: Path | str, pattern: str | None = None) -> dict[str, str]:
    """Vehicles by path below the root."""
    recordings = find_recordings([str(source) for source in sources or (root,)], pattern)
    return {os.path.relpath(own.path, root): own.vehicle for own in recordings}


def test_folders_of_vehicles(tmp_path: Path) -> None:
    for name in ("car_1/a", "car_1/b", "car_2/a"):
        bag(tmp_path / name)
    (tmp_path / "car_2/copied").mkdir()  # an empty folder is a recording that got lost
    (tmp_path / "notes.txt").touch()
    (tmp_path / "car_2/.hidden").mkdir()
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs/log.txt").touch()
    vehicles = {"car_1/a": "car_1", "car_1/b": "car_1", "car_2/a": "car_2", "car_2/copied": "car_2"}
    assert found(tmp_path) == vehicles
    assert found(tmp_path, tmp_path / "car_2", tmp_path / "car_1") == vehicles
    assert found(tmp_path, tmp_path, tmp_path / "car_1/a") == vehicles  # each once
    assert found(tmp_path, tmp_path / "car_1") == {"car_1/a": "car_1", "car_1/b": "car_1"}
    for name in ("berlin/car/a", "paris/car/a", "paris/truck/a"):  # folders of the same name are different vehicles
        bag(tmp_path / "cities" / name)
    assert list(found(tmp_path / "cities").values()) == ["berlin/car", "paris/car", "paris/truck"]
    for name, vehicle in (("missing", "unknown"), ("set#scene-1", "unknown"), ("/data/car/missing", "car")):
        assert [(own.path, own.vehicle) for own in find_recordings([name])] == [(name, vehicle)]


def test_loose_files(tmp_path: Path) -> None:
    bag(tmp_path / "killed/car/drive/drive_0.db3", loose=True)  # a folder that a killed recorder left
    assert found(tmp_path / "killed") == {"car/drive": "car"}
    shutil.rmtree(tmp_path / "killed")
    bag(tmp_path / "day/a.mcap", loose=True)
    assert found(tmp_path) == {"day/a.mcap": "day"}
    bag(tmp_path / "day/b.mcap", loose=True)
    bag(tmp_path / "day/old.bag", loose=True)
    bag(tmp_path / "day/more/c")
    assert found(tmp_path) == {"day/a.mcap": "day", "day/b.mcap": "day", "day/old.bag": "day", "day/more/c": "more"}


def test_vehicles_by_pattern(tmp_path: Path) -> None:
    for name in ("2024-05-01/car7_a", "2024-05-02/car7_b", "2024-05-02/car8_a", "2024-05-02/other"):
        bag(tmp_path / name)
    vehicles = found(tmp_path, pattern=r"(?P<vehicle>car\d+)_")
    assert list(vehicles.values()) == ["car7", "car7", "car8", "unknown"]
    for pattern, says in (("(", "no regular expression"), ("car", "no group"), ("(?P<vehicle>bus)", "matches none of")):
        with pytest.raises(BadInputError, match=says):
            found(tmp_path, pattern=pattern)


def test_what_is_named_is_a_recording_whatever_it_is(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").touch()
    named = find_recordings([str(tmp_path / "notes.txt"), str(tmp_path / "gone"), "synthetic:seed=3"])
    assert [own.name for own in named] == ["notes.txt", "gone", "synthetic:seed=3"]
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder/notes.txt").touch()
    with pytest.raises(BadInputError, match="holds no recordings"):
        find_recordings([str(tmp_path / "folder")])


def test_a_fingerprint_changes_with_the_files_and_links_are_followed_once(tmp_path: Path) -> None:
    path = bag(tmp_path / "fleet/a")
    (first,) = find_recordings([str(tmp_path / "fleet")])
    assert find_recordings([str(tmp_path / "fleet")]) == [first]
    os.utime(path / "a_0.mcap", ns=(5, first.modified_ns + 5))
    (tmp_path / "linked").mkdir()  # links are followed, each folder once
    (tmp_path / "linked/a").symlink_to(path)
    (tmp_path / "linked/loop").symlink_to(tmp_path / "linked")
    assert list(found(tmp_path, tmp_path / "linked")) == ["linked/a"]
    (second,) = find_recordings([str(tmp_path / "fleet")])
    assert second.fingerprint != first.fingerprint
    assert second.modified_ns == first.modified_ns + 5


def test_what_is_a_fleet(tmp_path: Path) -> None:
    path = str(bag(tmp_path / "fleet/a"))
    (tmp_path / "empty").mkdir()
    for one in (path, "synthetic", str(tmp_path / "gone"), str(tmp_path / "empty")):
        assert not is_fleet([one]), one
    assert is_fleet([str(tmp_path / "fleet")])
    assert is_fleet([path, "synthetic"])


@pytest.mark.kitti
def test_kitti_drives_are_recordings(kitti_root: Path) -> None:
    assert [own.name for own in find_recordings([str(kitti_root / "raw")])] == ["2011_09_26_drive_0005_sync"]
    assert len(find_recordings([str(kitti_root)])) == 3
    assert not is_fleet([str(kitti_root / "raw")])
