"""Which recordings a fleet has, and of which vehicles."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from calib_ros.errors import BadInputError
from calib_ros_check.fleet.recordings import find_recordings, is_fleet


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
