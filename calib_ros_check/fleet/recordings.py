"""The recordings of a fleet: found below folders, each of a vehicle, or of a calibration that a data set claims, and to be
checked by itself."""

from __future__ import annotations

import hashlib
import os
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib_ros.datasets.capture import is_capture
from calib_ros.datasets.folder import is_folder_dataset
from calib_ros.datasets.kitti import drives_in, layout_name
from calib_ros.datasets.nuscenes import NuScenesSource
from calib_ros.datasets.once import is_once
from calib_ros.datasets.open import is_nuscenes, is_single
from calib_ros.datasets.source import spread_positions
from calib_ros.errors import BadInputError, CalibrationError
from calib_ros_check.recording import FRAMES, CheckOptions, opened

STORES = (".mcap", ".db3")  # a bag that is one file
OTHERS = (".bag",)  # ROS 1: reported with what to do
VEHICLE = "vehicle"  # the named group of a pattern
UNKNOWN = "unknown"
DIGITS = 9  # of numbers in files, which copies round


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
        path, found = Path(source).expanduser(), list[Path]()
        if path.is_dir() and not is_nuscenes(path):
            _look(path.resolve(), found, set())
            if not found:
                raise BadInputError(f"{source} holds no recordings; give a folder of ROS 2 bags, KITTI drives or plain folders")
            paths |= dict.fromkeys(map(str, sorted(found)))
        else:
            paths[str(path.resolve()) if path.exists() and "#" not in source else source] = None
    if vehicle_pattern is None:
        return list(map(_recording, paths, _by_folder(list(paths))))
    try:
        expression = re.compile(vehicle_pattern)
    except re.error as error:
        raise BadInputError(f"--vehicle-pattern {vehicle_pattern!r} is no regular expression ({error})") from None
    if VEHICLE not in expression.groupindex:
        advice = f"has no group (?P<{VEHICLE}>...); put it around the vehicle's name"
        raise BadInputError(f"--vehicle-pattern {vehicle_pattern!r} {advice}")
    matches = [expression.search(path) for path in paths]
    if not any(matches):
        raise BadInputError(f"--vehicle-pattern {vehicle_pattern!r} matches none of the recordings, such as {next(iter(paths))}")
    return [_recording(path, (own and own.group(VEHICLE)) or UNKNOWN) for path, own in zip(paths, matches, strict=True)]


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


def _recording(path: str, vehicle: str) -> Recording:
    """With what its files tell without being read."""
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
        return Recording(path, vehicle)
    return Recording(path, vehicle, newest, digest.hexdigest()[:16] if files else "")


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


def find_claims(sources: Sequence[str], options: CheckOptions, count: int = FRAMES) -> list[Recording]:
    """All calibrations of data sets: of every recording in `sources`, every camera, and every frame where each has its own.

    Calibrations are the same where their numbers are; `vehicle` is the name of each. count: frames of each in a recording. What
    cannot be opened is a calibration of its own, so that its check says why.
    Raises as `find_recordings`.
    """
    found: dict[bytes, list[Recording]] = {}
    for recording in find_recordings(sources):
        scenes: Sequence[str] = ()
        if "#" not in recording.path and is_nuscenes(Path(recording.path)):
            with suppress(CalibrationError):  # the check says why
                scenes = NuScenesSource(recording.path).scenes
        for scene in [replace(recording, path=f"{recording.path}#{name}") for name in scenes] or [recording]:
            try:
                claims = list(_claims_of(scene, options, count))
            except CalibrationError:
                claims = [(os.fsencode(scene.path), scene)]
            for key, claim in claims:
                found.setdefault(key, []).append(claim)
    return _named(list(found.values()))


def _claims_of(recording: Recording, options: CheckOptions, count: int) -> Iterator[tuple[bytes, Recording]]:
    """What tells a calibration from others, and the recording with the frames that are of it."""
    first = opened(recording.path, options)
    cameras = [] if options.camera else [str(name) for name in getattr(first, "cameras", ())]
    for camera in cameras or [""]:
        claim = replace(recording, camera=camera)
        try:
            source = opened(recording.path, replace(options, camera=camera)) if camera else first
        except CalibrationError:
            yield os.fsencode(f"{recording.path} {camera}"), claim
            continue
        # Positions of the frames by their calibration.
        groups: dict[bytes, list[int]] = {}
        own: Any = getattr(source, "calibration_at", None)
        if own is None:
            D = np.r_[source.camera.D, np.zeros(14)][:14]
            groups[_key(source.camera.K, D, source.reference)] = list(range(len(source)))
        for k in range(0 if own is None else len(source)):
            groups.setdefault(_key(*own(k)), []).append(k)
        for key, positions in groups.items():
            chosen = [positions[k] for k in spread_positions(count, len(positions))]
            frames = "" if len(groups) == 1 and count == FRAMES else ",".join(map(str, chosen))
            yield source.camera_frame.encode() + key, replace(claim, frames=frames)


def _key(*numbers: Any) -> bytes:
    return b"".join(b"-" if one is None else (np.round(one, DIGITS) + 0.0).tobytes() for one in numbers)


def _named(groups: Sequence[Sequence[Recording]]) -> list[Recording]:
    """Each calibration by its recording, or the folder that has all of its recordings, and its camera."""
    paths = [[Path(claim.path).absolute() for claim in group] for group in groups]
    root = os.path.commonpath([path.parent for group in paths for path in group])
    uses = Counter(path for own in paths for path in own)
    names = []
    for group, own in zip(groups, paths, strict=True):
        is_folder = len(own) > 1 and len({path.parent for path in own}) == 1
        telling = min(own, key=lambda path: uses[path])  # the recording that has the fewest other calibrations
        name = os.path.relpath(telling.parent if is_folder else telling, root)
        name = Path(root).name if name == "." else name
        more = "" if is_folder or len(own) == 1 else f" and {len(own) - 1} more"
        names.append(f"{name}{more}, camera {group[0].camera}" if group[0].camera else f"{name}{more}")
    total, seen = Counter(names), Counter[str]()
    out = []
    for name, group in zip(names, groups, strict=True):
        seen[name] += 1
        full = name if total[name] == 1 else f"{name} ({seen[name]} of {total[name]})"
        out += [replace(claim, vehicle=full) for claim in group]
    return out
