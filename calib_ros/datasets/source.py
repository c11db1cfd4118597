"""The protocol of datasets, which of their frames are used, and the LiDAR's motion from neighbouring scans."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera
from calib_ros.config import MotionConfig
from calib_ros.datasets.recent import Recent
from calib_ros.errors import BadInputError, CalibrationError, MissingDependencyError
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.lidar.accumulation import Accumulator, Stamped
from calib_ros.lidar.ego_motion import MAX_GAP_S, ROAD_SPEED, Motion, estimate_motion, without_motion

FRAMES_ADVICE = "give all, a list like 0,4,8 or a range like 0:100:5, by position from 0, not by name"
CACHED_CLOUDS, SCANS_PER_S = 4, 20
TOO_FAST = "{:.0f} m/s from frame {} to {} cannot be: give stamps as recorded (a folder's times.csv), or leave them out"
RUN_S, ENOUGH = 5.0, 0.8  # s of frames from which motion is estimated, and the share of it that is enough
CENTRES = (0.5, 0.2, 0.8, 0.0, 1.0)  # around which of the chosen frames, as shares of their number


class Source(Protocol):
    """A sequence of synchronised frames; `source[i]` reads frame i, IndexError past the end."""

    @property
    def name(self) -> str:
        """Name of the folder or file, for display."""

    @property
    def camera(self) -> Camera:
        """The intrinsics; of the first frame where they differ between frames (see Frame.camera)."""

    @property
    def reference(self) -> NDArray[np.float64] | None:
        """T_camera_lidar (4, 4), None if unknown; of the first frame where they differ."""

    @property
    def camera_frame(self) -> str:
        """Name of the camera's optical frame."""

    @property
    def lidar_frame(self) -> str:
        """Name of the LiDAR's frame."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Frame: ...

    def describe(self) -> dict[str, str]:
        """Content of the source, for `calib-ros info`: label -> text."""


def describe_camera(camera: Camera) -> str:
    """One line about the intrinsics."""
    K = camera.K
    lens = "no distortion" if camera.is_pinhole else f"{camera.model} distortion"
    numbers = f"fx {K[0, 0]:.1f}, fy {K[1, 1]:.1f}, cx {K[0, 2]:.1f}, cy {K[1, 2]:.1f}"
    return f"{camera.width}x{camera.height}, {numbers}, {lens}"


class WithMotion:
    """A source whose frames without a twist get it from the scans before and after them, if these are near enough in time. warn:
    called with a message if small_gicp is missing, where frames stay as they are, and at the first speed that no vehicle has.
    unknown: why the motion of a frame is not known, the last that was read. accumulate_s: time over which scans are put
    together, as ``lidar.accumulate_s``."""

    def __init__(
        self, source: Source, config: MotionConfig, warn: Callable[[str], None] | None = None, accumulate_s: float = 0.0
    ) -> None:
        self._source, self._config, self._warn = source, config, warn
        self._accumulate_s, self._accumulated = accumulate_s, Accumulator()
        self.name, self.camera, self.reference = source.name, source.camera, source.reference
        self.camera_frame, self.lidar_frame = source.camera_frame, source.lidar_frame
        self._clouds = Recent(CACHED_CLOUDS + round(accumulate_s * SCANS_PER_S))
        self._library_missing, self._fastest, self.unknown = False, ROAD_SPEED, ""

    def __len__(self) -> int:
        return len(self._source)

    def __getitem__(self, index: int) -> Frame:
        """Frame `index`, with a twist if its neighbours allow one. Raises what the source raises."""
        frame = self._source[index]
        index %= max(len(self), 1)
        self._clouds(index, lambda: _stamped(frame))
        if self._library_missing:
            return frame
        try:
            unknown = without_motion(frame, self._config)
            motions = [] if unknown else self._motions(index)
            if found := [motion.twist for motion in motions if motion.twist is not None]:
                frame = replace(frame, twist=np.mean(found, axis=0))
            elif frame.twist is None:
                self.unknown = next((motion.reason for motion in motions), unknown or "there is no scan before or after")
            # The scans before it, newest first, as far as they are usable.
            earlier = iter(map(self._cloud, range(index - 1, -1, -1)).__next__, None)
            return self._accumulated(frame, earlier, self._accumulate_s, self._config)
        except MissingDependencyError as error:
            self._library_missing = True
            if self._warn:
                self._warn(f"scans are not corrected for the vehicle's motion: {error}")
            return frame

    def describe(self) -> dict[str, str]:
        """As the source."""
        return self._source.describe()

    def _motions(self, index: int) -> list[Motion]:
        """Motion since the previous scan, and until the next: their mean is the motion at the scan itself."""
        motions: list[Motion] = []
        for first, second in ((index - 1, index), (index, index + 1)):
            before, after = self._cloud(first), self._cloud(second)
            if before is not None and after is not None:
                gap = (after[0] - before[0]) / NANOSECONDS
                start = motions[0].twist if motions else None
                motions.append(estimate_motion(before[1], after[1], gap, self._config, start))
                if motions[-1].speed > self._fastest and self._warn:
                    self._fastest = np.inf  # said once
                    self._warn(TOO_FAST.format(motions[-1].speed, first, second))
        return motions

    def _cloud(self, index: int) -> Stamped | None:
        """The cloud of a frame with its stamp; None if unusable: a damaged neighbour does not make a frame unusable."""
        return self._clouds(index, lambda: None if (frame := _readable(self._source, index)) is None else _stamped(frame))


def neighbours(source: Source, positions: Sequence[int]) -> list[Frame]:
    """Frames that follow each other within MAX_GAP_S around some of the given positions, in the order of their stamps. Together
    they last for RUN_S, or as long as there are any; a frame that cannot be read ends a run."""
    found: dict[int, Frame] = {}
    total = 0.0
    for share in CENTRES:
        centre = positions[min(int(share * len(positions)), len(positions) - 1)]
        first = None if centre in found else _readable(source, centre)
        if first is None:
            continue
        found[centre] = first
        total += sum(_extend(source, centre, step, found) for step in (1, -1))
        if total >= ENOUGH * RUN_S:
            break
    return sorted({frame.moment_of_cloud: frame for frame in found.values()}.values(), key=lambda frame: frame.moment_of_cloud)


def _extend(source: Source, start: int, step: int, found: dict[int, Frame]) -> float:
    """Adds the frames after (step 1) or before (-1) position `start`, up to those found already; the seconds that they last."""
    last, lasted, k = found[start], 0.0, start + step
    while lasted < RUN_S / 2 and k not in found:
        frame = _readable(source, k)
        if frame is None:
            break
        gap = step * (frame.moment_of_cloud - last.moment_of_cloud) / NANOSECONDS
        if not 0 < gap <= MAX_GAP_S:
            break
        found[k], last = frame, frame
        lasted, k = lasted + gap, k + step
    return lasted


def _readable(source: Source, position: int) -> Frame | None:
    try:
        return source[position] if 0 <= position < len(source) else None
    except CalibrationError:
        return None


def _stamped(frame: Frame) -> Stamped | None:
    return None if frame.cloud_stamp is None else (frame.cloud_stamp, frame.cloud)


def frame_positions(text: str, count: int) -> list[int]:
    """'all', '0,4,8' or '0:100:5' (0-based, end excluded, as Python slices) -> positions in a source of `count` frames.
    BadInputError for other text, positions out of range or named twice, or an empty selection."""
    selection = selected(text)
    positions: Sequence[int] = range(count)[selection] if isinstance(selection, slice) else selection
    wrong = [i for i in positions if not 0 <= i < count]
    if wrong:
        raise BadInputError(f"--frames {text}: position {wrong[0]} is outside 0..{count - 1} of this source")
    if not positions:
        raise BadInputError(f"--frames {text} selects none of the {count} frames; {FRAMES_ADVICE}")
    return list(positions)


def selected(text: str) -> slice | list[int]:
    """What a text says, whatever the source. BadInputError where it selects frames of none."""
    try:
        if text == "all":
            return slice(None)
        if ":" in text:
            parts = [int(part) if part.strip() else None for part in text.split(":")]
            if len(parts) > 3 or parts[2:] == [0]:
                raise ValueError
            return slice(*parts)
        listed = [int(part) for part in text.split(",")]
        if any(part.strip() != str(k) for part, k in zip(text.split(","), listed, strict=True)):  # 000004 is a name
            raise ValueError
    except ValueError:
        raise BadInputError(f"--frames {text}: {FRAMES_ADVICE}") from None
    twice = [k for k in listed if listed.count(k) > 1]
    if twice:  # it would count as independent evidence
        raise BadInputError(f"--frames {text}: position {twice[0]} is named twice; name each frame once")
    return listed


def spread_positions(number: int, count: int) -> list[int]:
    """Positions of about so many frames, evenly spread over a source of `count` frames; all if there are no more."""
    if number >= count:
        return list(range(count))
    return [int((k + 0.5) * count / number) for k in range(number)]
