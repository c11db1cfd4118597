"""Short windows of a recording, spread over it: which spans of time are read for a given number of frames."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from calib_ros.datasets.bag_index import Span
from calib_ros.stamps import Stamps

# Half widths of windows, in periods of the slower sensor. Four periods hold a frame and its neighbours whatever the phase of the
# two; where the messages of one are recorded later than those of the other, it takes more.
HALF_WIDTHS = (2.0, 6.0)
# Where in its slot a window is looked for: in the middle, and elsewhere if no frame is there, as in an interruption.
PLACES = (0.5, 0.2, 0.8)
ENOUGH = 0.5  # share of the slots that must have a frame
WORTHWHILE = 0.6  # share of the recording above which the whole of it is read instead


class Slots:
    """Equal parts of a recording, in each of which one frame with a neighbour on either side is looked for.

    start, stop: of the recording, ns. count: of slots. half: half the width of a window, ns.
    """

    def __init__(self, start: int, stop: int, count: int, half: int) -> None:
        self._half, self._count = half, count
        edges = np.linspace(start, stop, count + 1).astype(np.int64).tolist()
        worthwhile = 2 * half * count < WORTHWHILE * (stop - start)
        self._slots = list(pairwise(edges)) if worthwhile else []
        self._places = list(PLACES)
        self._read: list[Span] = []
        self._windows: dict[int, Span] = {}  # the newest of each slot
        self._frames: dict[int, int] = {}  # slot -> position of its frame

    def next_spans(self) -> list[Span]:
        """Windows to read next, apart from each other and from all before; none when every slot has its frame, or there is
        nowhere left to look. Where no slot has one in its middle, windows are too short, and no others are tried."""
        spans: list[Span] = []
        while self._places and not spans and (self._frames or not self._windows):
            place = self._places.pop(0)
            for slot, (start, stop) in enumerate(self._slots):
                middle = start + round(place * (stop - start))
                span = (middle - self._half, middle + self._half)
                if slot not in self._frames and not self._overlaps(span):
                    spans.append(span)
                    self._read.append(span)
                    self._windows[slot] = span
        return spans

    def _overlaps(self, span: Span) -> bool:
        return any(span[0] < stop and start < span[1] for start, stop in self._read)

    def look(self, images: Stamps, clouds: Stamps) -> None:
        """Look for the frames of the windows. images, clouds: (n,) recording times of all pairs, in their order."""
        self._frames = {}
        for slot, (start, stop) in self._windows.items():
            inside = (start <= images) & (images < stop) & (start <= clouds) & (clouds < stop)
            between = np.flatnonzero(inside)[1:-1]
            if len(between):
                self._frames[slot] = int(between[np.argmin(np.abs(images[between] - (start + stop) // 2))])

    @property
    def frames(self) -> list[int] | None:
        """Positions of the frames in the middle of the windows; None if too few have one."""
        return sorted(self._frames.values()) if len(self._frames) >= max(ENOUGH * self._count, 1) else None
