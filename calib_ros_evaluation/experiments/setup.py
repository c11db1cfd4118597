"""Sources of an evaluation: what is evaluated on, which of its frames can be used, and what a worker keeps of them."""

from __future__ import annotations

import hashlib
import json
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import calib_ros
import calib_ros_check
import calib_ros_evaluation
import calib_ros_semantics
import calib_ros_synthetic
import calib_ros_thesis
from calib_ros.config import Config
from calib_ros.datasets import Source, open_dataset
from calib_ros.datasets.source import WithMotion, frame_positions
from calib_ros.errors import BadInputError, CalibrationError, MissingDependencyError
from calib_ros.frame import Frame
from calib_ros_check.checker import Checker
from calib_ros_evaluation.methods.method import Method
from calib_ros_evaluation.methods.own import methods

Matrix = NDArray[np.float64]
MOST_FRAMES = 60  # of a source; more are spread over it
FRAMES, FEATURES = 12, 24  # kept by a worker: 4 MB for a KITTI frame, and up to 20 MB for its features
PACKAGES = (calib_ros, calib_ros_check, calib_ros_evaluation, calib_ros_semantics, calib_ros_synthetic, calib_ros_thesis)


@dataclass(frozen=True)
class SourceSpec:
    """A source. label: its name among all. path, options: as open_dataset takes them. reference: rows of a
    T_camera_lidar (4, 4) that counts instead of the source's own; empty = the source's."""

    label: str
    path: str
    camera: int | str | None = None
    options: tuple[tuple[str, str], ...] = ()
    reference: tuple[tuple[float, ...], ...] = ()


@dataclass(frozen=True)
class Setup:
    """The same for all jobs of an evaluation."""

    scenes: tuple[SourceSpec, ...]
    config: Config

    def scene(self, label: str) -> SourceSpec:
        """The scene of a label; KeyError if there is none."""
        return {scene.label: scene for scene in self.scenes}[label]

    @property
    def fingerprint(self) -> str:
        """Of the configuration; differs where results may."""
        text = json.dumps(self.config.to_dict(), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def code_fingerprint() -> str:
    """Of the code that answers may depend on: two states of it must not share a folder, though their version be the same."""
    found = hashlib.sha256()
    for package in PACKAGES:
        folder = Path(package.__path__[0])
        for path in sorted(folder.rglob("*.py")):
            found.update(f"{package.__name__}/{path.relative_to(folder).as_posix()}\0".encode() + path.read_bytes())
    return found.hexdigest()[:16]


def labels(paths: Sequence[str]) -> list[str]:
    """A short name for each source, no two alike."""
    out: list[str] = []
    for path in paths:
        path = path.encode("utf-8", "replace").decode()  # names of other encodings cannot be written
        parts = [part for part in Path(path).parts if part not in ("/", "..", ".")] or [path]
        label = parts[-1]
        # "00" and "training" are names of places in a dataset, not of drives.
        if len(parts) > 1 and (len(label) < 4 or label in ("training", "testing")):
            label = f"{parts[-2]}/{label}"
        names = (label, *(f"{label} ({n})" for n in range(2, len(out) + 3)))
        out.append(next(name for name in names if name not in out))
    return out


class SourceGoneError(BadInputError):
    """A frame that was there cannot be read."""


# Errors that say nothing of a method: an evaluation stops, and goes on when they are mended.
NOT_THE_METHODS = (SourceGoneError, MissingDependencyError)


class WorkerCache:
    """Sources, frames and features that jobs need, computed once while they are kept. note: called with lines for people."""

    def __init__(self, setup: Setup, note: Callable[[str], None] | None = None) -> None:
        self.setup, self.config, self._note = setup, setup.config, note
        self.methods: dict[str, Method] = methods(setup.config)
        self._warm: set[str] = set()
        self.source = lru_cache(maxsize=None)(self._opened)
        self.frame = lru_cache(FRAMES)(self._read)
        self.features = lru_cache(FEATURES)(self._made)
        self.checker = lru_cache(maxsize=1)(lambda label: Checker(self.source(label).camera, self.config))

    def _opened(self, label: str) -> Source:
        """The source of a scene. BadInputError if it cannot be opened."""
        scene = self.setup.scene(label)
        source = open_dataset(scene.path, camera=scene.camera, **dict(scene.options))
        return WithMotion(source, self.config.motion, self._note, self.config.lidar.accumulate_s)

    def _read(self, label: str, position: int) -> Frame:
        """A frame of a scene. SourceGoneError if it cannot be read."""
        try:
            return self.source(label)[position]
        except CalibrationError as error:
            raise SourceGoneError(str(error)) from error

    def reference(self, label: str, position: int) -> Matrix:
        """T_camera_lidar (4, 4) that counts as true for a frame. BadInputError if there is none."""
        own = self.setup.scene(label).reference
        if own:
            return np.array(own)
        stated = self.frame(label, position).reference
        stated = self.source(label).reference if stated is None else stated
        if stated is None:
            raise BadInputError(f"{label} states no reference extrinsic to compare with; give one by --reference FILE")
        return stated

    def _made(self, method: str, label: str, position: int) -> tuple[Any, float]:
        """A method's features of a frame, and the CPU seconds that they took when they were made."""
        frame = self.frame(label, position)
        if method not in self._warm:  # the first frame would pay for imports and look-up tables
            self._warm.add(method)
            self.methods[method].features(frame)
        started = time.process_time()
        made = self.methods[method].features(frame)
        return made, time.process_time() - started


@lru_cache(maxsize=1)
def worker_cache(setup: Setup) -> WorkerCache:
    """The cache of this process; that of another setup is dropped."""
    return WorkerCache(setup)


@dataclass(frozen=True)
class SourceSummary:
    """frames: positions in the source. groups: those of one camera and one reference, which can be estimated together.
    content: a checksum of each frame. notes: frames left out, and why."""

    label: str
    frames: tuple[int, ...]
    groups: tuple[tuple[int, ...], ...]
    content: tuple[str, ...]
    notes: tuple[str, ...] = ()


def inspect_sources(
    setup: Setup, frames: str, progress: Callable[[int, int], None] = lambda done, total: None
) -> list[SourceSummary]:
    """Read all sources once. frames: as for --frames, of each.

    Raises what a source raises that cannot be opened, or none of whose frames can be read; BadInputError without a reference.
    """
    reported: list[str] = []
    cache, out = WorkerCache(setup, reported.append), list[SourceSummary]()
    positions = {s.label: spread(frame_positions(frames, len(cache.source(s.label))), MOST_FRAMES) for s in setup.scenes}
    total, done = sum(map(len, positions.values())), 0
    for scene in setup.scenes:
        label, known, content, notes, groups = scene.label, [], [], [], dict[bytes, list[int]]()
        problem: CalibrationError | None = None
        for position in positions[label]:
            try:
                frame, reference = cache.frame(label, position), cache.reference(label, position)
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
        out.append(SourceSummary(label, tuple(known), tuple(map(tuple, groups.values())), tuple(content), (*reported, *notes)))
        reported.clear()
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


def shared_out(summaries: Sequence[SourceSummary], count: int) -> list[tuple[str, int]]:
    """About `count` frames (label, position): each source gives alike many if it has them, evenly spread."""
    left, given = count, dict[str, list[int]]()
    for k, one in enumerate(sorted(summaries, key=lambda s: len(s.frames))):  # those that have too few leave theirs to the others
        given[one.label] = spread(one.frames, max(left // (len(summaries) - k), 1))
        left -= len(given[one.label])
    return [(one.label, position) for one in summaries for position in given[one.label]]
