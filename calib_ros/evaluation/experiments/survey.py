"""What there is to evaluate on: the frames of each source that can be read, and which of them belong together."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import CalibrationError
from calib_ros.evaluation.experiments.setup import Setup
from calib_ros.evaluation.experiments.world import World
from calib_ros.frame import Frame
from calib_ros.sources import frame_positions

Matrix = NDArray[np.float64]
MOST_FRAMES = 60  # of a source; more are spread over it


@dataclass(frozen=True)
class Surveyed:
    """frames: positions in the source. groups: those of one camera and one reference, which can be estimated together.
    content: a checksum of each frame. notes: frames left out, and why."""

    label: str
    frames: tuple[int, ...]
    groups: tuple[tuple[int, ...], ...]
    content: tuple[str, ...]
    notes: tuple[str, ...] = ()


def survey(setup: Setup, frames: str, progress: Callable[[int, int], None] = lambda done, total: None) -> list[Surveyed]:
    """Look through all sources. frames: as for --frames, of each.

    Raises what a source raises that cannot be opened, or none of whose frames can be read; BadInputError without a reference.
    """
    said: list[str] = []
    world, out = World(setup, said.append), list[Surveyed]()
    positions = {s.label: spread(frame_positions(frames, len(world.source(s.label))), MOST_FRAMES) for s in setup.scenes}
    total, done = sum(map(len, positions.values())), 0
    for scene in setup.scenes:
        label, known, content, notes, groups = scene.label, [], [], [], dict[bytes, list[int]]()
        problem: CalibrationError | None = None
        for position in positions[label]:
            try:
                frame, reference = world.frame(label, position), world.reference(label, position)
                groups.setdefault(_calibration(frame, reference), []).append(position)
                content.append(f"{zlib.crc32(_sample(frame), zlib.crc32(_calibration(frame, reference))):08x}")
                known.append(position)
            except CalibrationError as error:
                problem = error
                notes.append(f"{label}, frame {position} left out: {error}")
            done += 1
            progress(done, total)
        if not known and problem:
            raise problem
        out.append(Surveyed(label, tuple(known), tuple(map(tuple, groups.values())), tuple(content), (*said, *notes)))
        said.clear()
    return out


def _calibration(frame: Frame, reference: Matrix) -> bytes:
    camera = frame.camera
    numbers = np.concatenate([camera.K.ravel(), camera.D, [camera.width, camera.height], reference.ravel()])
    return np.round(numbers, 9).tobytes()


def _sample(frame: Frame) -> bytes:
    """Part of a frame that another one hardly shares."""
    stamps = np.array([frame.stamp, frame.moment_of_cloud, len(frame.cloud)])
    return stamps.tobytes() + frame.cloud.xyz[::97].tobytes() + np.ascontiguousarray(frame.image[::7, ::7]).tobytes()


def spread(items: Sequence[int], count: int) -> list[int]:
    """At most `count` of the items, evenly spread, in their order."""
    if len(items) <= count:
        return list(items)
    return [items[k] for k in np.linspace(0, len(items) - 1, count).round().astype(int)]


def shared_out(surveyed: Sequence[Surveyed], count: int) -> list[tuple[str, int]]:
    """About `count` frames (label, position): each source gives alike many if it has them, evenly spread."""
    left, given = count, dict[str, list[int]]()
    for k, one in enumerate(sorted(surveyed, key=lambda s: len(s.frames))):  # those that have too few leave theirs to the others
        given[one.label] = spread(one.frames, max(left // (len(surveyed) - k), 1))
        left -= len(given[one.label])
    return [(one.label, position) for one in surveyed for position in given[one.label]]
