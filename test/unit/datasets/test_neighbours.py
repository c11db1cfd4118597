"""Which frames are read around the chosen ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from sample_sources import Listed

from calib_ros.camera import Camera
from calib_ros.datasets.source import neighbours
from calib_ros.errors import BadInputError
from calib_ros.frame import NANOSECONDS, Frame, PointCloud

CAMERA = Camera(np.array([[50.0, 0, 15.5], [0, 50, 11.5], [0, 0, 1]]), 32, 24)


class Timed(Listed):
    """Frames at these moments, s; None = a damaged one. read: positions in the order of reading."""

    def __init__(self, seconds: Sequence[float | None]) -> None:
        image, cloud = np.zeros((24, 32), np.uint8), PointCloud(np.zeros((0, 3), np.float32))
        stamps = [None if moment is None else round(moment * NANOSECONDS) for moment in seconds]
        super().__init__([Frame(image, cloud, CAMERA, stamp or 0, name=str(k)) for k, stamp in enumerate(stamps)])
        self.stamps, self.read = stamps, []

    def __getitem__(self, index: int) -> Frame:
        self.read.append(index)
        if self.stamps[index] is None:
            raise BadInputError("damaged")
        return super().__getitem__(index)


def names(frames: Sequence[Frame]) -> list[int]:
    return [int(frame.name) for frame in frames]


def test_five_seconds_around_the_middle_one_and_each_frame_once() -> None:
    source = Timed([0.1 * k for k in range(300)])
    found = neighbours(source, range(0, 300, 30))
    assert names(found) == list(range(125, 176))
    assert len(source.read) == len(set(source.read)) == 51


def test_what_a_run_lacks_others_add() -> None:
    """Runs of 11 frames between gaps: of 1 s each."""
    source = Timed([5.0 * (k // 11) + 0.1 * (k % 11) for k in range(110)])
    found = neighbours(source, [k for k in range(110) if k % 11 == 5])
    assert len(found) == 44
    stamps = [frame.stamp for frame in found]
    assert stamps == sorted(stamps)


def test_ends_damaged_frames_and_repeated_stamps_end_a_run() -> None:
    source = Timed([0.0, 0.1, None, 0.3, 0.4, 0.4, 0.5])
    assert names(neighbours(source, [3])) == [3, 4]
    assert names(neighbours(source, [0, 1])) == [0, 1]
    assert neighbours(source, [2]) == []
