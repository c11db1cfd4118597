"""The recordings of a fleet: found below folders, each of a vehicle, and to be checked by itself."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from calib_ros.datasets.capture import is_capture
from calib_ros.datasets.folder import is_folder_dataset
from calib_ros.datasets.kitti import drives_in, layout_name
from calib_ros.datasets.once import is_once
from calib_ros.datasets.open import is_nuscenes, is_single
from calib_ros.errors import BadInputError

STORES = (".mcap", ".db3")  # a bag that is one file
OTHERS = (".bag",)  # ROS 1: reported with what to do
VEHICLE = "vehicle"  # the named group of a pattern
UNKNOWN = "unknown"


@dataclass(frozen=True)
class Recording:
    """A recording, and the job of checking it.

    path: as `open_dataset` takes it. vehicle: name of the vehicle, or the calibration, that it is of. modified_ns: when its files
    were last written, 0 if unknown. fingerprint: other where its files are; empty without files. camera, frames: instead of those
    of the options of the check, where recordings differ in them. options: see `options_key`.
    """

    path: str
    vehicle: str = ""
    modified_ns: int = 0
    fingerprint: str = ""
    camera: str = ""
    frames: str = ""
    options: str = ""

    @property
    def name(self) -> str:
        """Its own name, of the file or folder."""
        return Path(self.path).name or self.path

    @property
    def key(self) -> str:
        """Of the job: other for a recording that has changed, and for other options."""
        own = f"|{self.camera}|{self.frames}" if self.camera or self.frames else ""
        return f"{self.path}|{self.fingerprint}|{self.options}{own}"


def find_recordings(sources: Sequence[str], vehicle_pattern: str | None = None) -> list[Recording]:
    """All recordings that `sources` name or hold, each once, by path.

    sources: recordings, as `open_dataset` takes them, or folders with recordings in them or below. What is named and cannot be
    read, and empty folders among recordings, are recordings, too: they are reported as what they are. vehicle_pattern: regular
    expression with a group named "vehicle", searched for in each path; without, recordings in several folders belong to a vehicle
    per folder. Raises BadInputError for no recordings, or a pattern that is none, has no such group, or matches no path.
    """
    paths: dict[str, None] = {}
    for source in sources:
        found = _found_in(source)
        if not found:
            raise BadInputError(f"{source} holds no recordings; give a folder of ROS 2 bags, KITTI drives or plain folders")
        paths |= dict.fromkeys(found)
    vehicles = _by_folder(list(paths)) if vehicle_pattern is None else _by_pattern(list(paths), vehicle_pattern)
    return [replace(_with_files(path), vehicle=vehicle) for path, vehicle in zip(paths, vehicles, strict=True)]


def is_fleet(sources: Sequence[str]) -> bool:
    """Whether sources are more than one recording, or a folder of recordings. An empty folder alone is none."""
    if len(sources) != 1:
        return True
    path = Path(sources[0]).expanduser()
    try:
        if not path.is_dir() or is_single(path) or not any(path.iterdir()):
            return False
    except OSError:  # said when it is opened
        return False
    return len(drives_in(path)) != 1


def _found_in(source: str) -> list[str]:
    path = Path(source).expanduser()
    if not path.is_dir() or is_nuscenes(path):
        return [str(path.resolve()) if path.exists() and "#" not in source else source]
    found: list[Path] = []
    _look(path.resolve(), found, set())
    return [str(one) for one in sorted(found)]


def _look(folder: Path, found: list[Path], seen: set[str]) -> None:
    """Add the recordings at and below a folder; links are followed, each folder once."""
    real = os.path.realpath(folder)
    if real in seen:
        return
    seen.add(real)
    try:
        children = sorted(child for child in folder.iterdir() if not child.name.startswith("."))
    except OSError:
        found.append(folder)  # reported when it is opened
        return
    folders = [child for child in children if child.is_dir()]
    stores = [child for child in children if child.suffix in STORES and child.is_file()]
    # A recorder that was killed leaves no metadata, but files that are named after the folder.
    named = len(stores) == 1 and stores[0].stem.startswith(folder.name)
    whole = (folder / "metadata.yaml").exists() or named
    single = is_capture(folder) or is_folder_dataset(folder) or is_nuscenes(folder) or is_once(folder)
    if not children or whole or layout_name(folder) or single:
        found.append(folder)
        return
    found += [*stores, *(child for child in children if child.suffix in OTHERS and child.is_file())]
    for child in folders:
        _look(child, found, seen)


def _with_files(path: str) -> Recording:
    """A recording with what its files tell without being read."""
    newest, digest = 0, hashlib.sha256()
    try:
        files = [Path(path)] if Path(path).is_file() else sorted(one for one in Path(path).rglob("*") if one.is_file())
        for one in files:
            status = one.stat()
            newest = max(newest, status.st_mtime_ns)
            digest.update(f"{one.name} {status.st_size} {status.st_mtime_ns}\n".encode("utf-8", "surrogateescape"))
        if not files and Path(path).exists():
            newest = Path(path).stat().st_mtime_ns
    except (OSError, ValueError):  # reported when it is opened
        return Recording(path)
    return Recording(path, modified_ns=newest, fingerprint=digest.hexdigest()[:16] if files else "")


def _by_pattern(paths: list[str], pattern: str) -> list[str]:
    try:
        expression = re.compile(pattern)
    except re.error as error:
        raise BadInputError(f"--vehicle-pattern {pattern!r} is no regular expression ({error})") from None
    if VEHICLE not in expression.groupindex:
        raise BadInputError(f"--vehicle-pattern {pattern!r} has no group (?P<{VEHICLE}>...); put it around the vehicle's name")
    matches = [expression.search(path) for path in paths]
    if not any(matches):
        raise BadInputError(f"--vehicle-pattern {pattern!r} matches none of the recordings, such as {paths[0]}")
    return [(match and match.group(VEHICLE)) or UNKNOWN for match in matches]


def _by_folder(paths: list[str]) -> list[str]:
    """The name of each recording's folder; as much of its path as tells it from others of that name."""
    parents = [Path(path).parent for path in paths]
    distinct = sorted(set(parents))
    deepest = max(len(parent.parts) for parent in distinct)
    for depth in range(1, deepest + 1):
        names = ["/".join(parent.parts[-depth:]) for parent in distinct]
        if len(set(names)) == len(distinct):
            break
    else:  # none of them lies in a folder: names of scenes, or of drives that are no files
        names = [""]
    named = dict(zip(distinct, names, strict=True))
    return [named[parent].strip("/") or UNKNOWN for parent in parents]
