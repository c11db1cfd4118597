"""The calibrations that a data set claims, and the frames that each is of: a fleet whose vehicles are calibrations."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from calib_ros.datasets.nuscenes import NuScenesSource
from calib_ros.datasets.open import is_nuscenes
from calib_ros.datasets.positions import spread_positions
from calib_ros.datasets.source import Source
from calib_ros.errors import CalibrationError
from calib_ros_check.fleet.recordings import Recording, find_recordings
from calib_ros_check.recording import FRAMES, CheckOptions, opened

DIGITS = 9  # of numbers in files, which copies round


def find_claims(sources: Sequence[str], options: CheckOptions, count: int = FRAMES) -> list[Recording]:
    """All calibrations of data sets: of every recording in `sources`, every camera, and every frame where each has its own.

    Calibrations are the same where their numbers are; `vehicle` is the name of each. count: frames of each in a recording. What
    cannot be opened is a calibration of its own, so that its check says why.
    Raises as `find_recordings`.
    """
    found: dict[bytes, list[Recording]] = {}
    for recording in find_recordings(sources):
        for scene in _scenes(recording):
            try:
                claims = list(_claims_of(scene, options, count))
            except CalibrationError:
                claims = [(os.fsencode(scene.path), scene)]
            for key, claim in claims:
                found.setdefault(key, []).append(claim)
    return _named(list(found.values()))


def _scenes(recording: Recording) -> list[Recording]:
    """Scenes of nuScenes as recordings."""
    scenes: Sequence[str] = ()
    if "#" not in recording.path and is_nuscenes(Path(recording.path)):
        with suppress(CalibrationError):  # the check says why
            scenes = NuScenesSource(recording.path).scenes
    return [replace(recording, path=f"{recording.path}#{name}") for name in scenes] or [recording]


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
        groups = _groups(source)
        for key, positions in groups.items():
            chosen = [positions[k] for k in spread_positions(count, len(positions))]
            frames = "" if len(groups) == 1 and count == FRAMES else ",".join(map(str, chosen))
            yield source.camera_frame.encode() + key, replace(claim, frames=frames)


def _groups(source: Source) -> dict[bytes, list[int]]:
    """Positions of the frames by their calibration. BadInputError for a file of calibrations that cannot be read."""
    own: Any = getattr(source, "calibration_at", None)
    if own is None:
        D = np.r_[source.camera.D, np.zeros(14)][:14]
        return {_key(source.camera.K, D, source.reference): list(range(len(source)))}
    groups: dict[bytes, list[int]] = {}
    for k in range(len(source)):
        groups.setdefault(_key(*own(k)), []).append(k)
    return groups


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
