"""Frames that follow each other, around chosen ones: what motion is estimated from."""

from __future__ import annotations

from collections.abc import Sequence

from calib_ros.datasets.source import Source
from calib_ros.errors import CalibrationError
from calib_ros.frame import NANOSECONDS, Frame

RUN_S, ENOUGH = 5.0, 0.8  # s of frames, and the share of it from which no further ones are looked for
CENTRES = (0.5, 0.2, 0.8, 0.0, 1.0)  # around which of the chosen frames, as shares of their number


def neighbours(source: Source, positions: Sequence[int], max_gap_s: float, seconds: float = RUN_S) -> list[Frame]:
    """Frames of a source around some of the given positions, at least one, each at most max_gap_s from the next, in the order of
    their stamps. Together they last for `seconds`, or as long as there are any; a frame that cannot be read ends a run.
    """
    found: dict[int, Frame] = {}
    total = 0.0
    for share in CENTRES:
        centre = positions[min(int(share * len(positions)), len(positions) - 1)]
        first = None if centre in found else _read(source, centre)
        if first is None:
            continue
        found[centre] = first
        for step in (1, -1):
            total += _extend(source, centre, step, max_gap_s, seconds / 2, found)
        if total >= ENOUGH * seconds:
            break
    return sorted({frame.moment_of_cloud: frame for frame in found.values()}.values(), key=lambda frame: frame.moment_of_cloud)


def _extend(source: Source, start: int, step: int, max_gap_s: float, seconds: float, found: dict[int, Frame]) -> float:
    """Adds the frames after (step 1) or before (-1) position `start`, up to those found already; the seconds that they last."""
    last, lasted, k = found[start], 0.0, start + step
    while lasted < seconds and k not in found:
        frame = _read(source, k)
        if frame is None:
            break
        gap = step * (frame.moment_of_cloud - last.moment_of_cloud) / NANOSECONDS
        if not 0 < gap <= max_gap_s:
            break
        found[k], last = frame, frame
        lasted, k = lasted + gap, k + step
    return lasted


def _read(source: Source, position: int) -> Frame | None:
    try:
        return source[position] if 0 <= position < len(source) else None
    except CalibrationError:
        return None
