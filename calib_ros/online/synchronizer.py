"""Synchronisation: pairs images with point clouds by nearest time stamps."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from calib_ros.frame import NANOSECONDS

Image = TypeVar("Image")
Cloud = TypeVar("Cloud")
JUMP_BACK_S = 1.0  # stamps that run back further than this mean a new recording or a looping bag, not a late message


@dataclass
class SynchronizerCounts:
    """Messages and pairs so far, for diagnostics."""

    images: int = 0
    clouds: int = 0
    pairs: int = 0
    unpaired_images: int = 0
    unpaired_clouds: int = 0
    jumps_back: int = 0


@dataclass(eq=False)
class _Stream:
    capacity: int
    waiting: deque[tuple[int, object]] = field(default_factory=deque)
    latest: int | None = None
    period: int = 0

    def push(self, stamp: int, item: object) -> int:
        """Insert in stamp order; returns how many old items were dropped."""
        if self.latest is not None and stamp > self.latest:
            self.period = stamp - self.latest if self.period == 0 else min(self.period, stamp - self.latest)
        self.latest = stamp if self.latest is None else max(self.latest, stamp)
        place = len(self.waiting)
        while place and self.waiting[place - 1][0] > stamp:
            place -= 1
        self.waiting.insert(place, (stamp, item))
        dropped = 0
        while len(self.waiting) > self.capacity:
            self.waiting.popleft()
            dropped += 1
        return dropped

    def earliest_next(self) -> int:
        """Earliest stamp of a message still to come (half a period of jitter allowed)."""
        return (self.latest or 0) + self.period // 2


class Synchronizer(Generic[Image, Cloud]):
    """Keeps messages that wait for a partner, and returns each pair once, as soon as no nearer partner can come.

    tolerance_s: messages farther apart are never paired. capacity: images and clouds kept. Messages are passed through
    untouched. counts: see SynchronizerCounts. Not thread-safe.
    """

    def __init__(self, tolerance_s: float, capacity: int) -> None:
        self.tolerance = round(tolerance_s * NANOSECONDS)
        self.counts = SynchronizerCounts()
        self._images, self._clouds = _Stream(capacity), _Stream(capacity)

    def configure(self, tolerance_s: float, capacity: int) -> None:
        """Use other limits from now on."""
        self.tolerance = round(tolerance_s * NANOSECONDS)
        self._images.capacity = self._clouds.capacity = capacity

    def nearest_gap_s(self) -> float | None:
        """Smallest stamp difference, s, between the waiting images and clouds; None without one of them."""
        gaps = [abs(ti - tc) for ti, _ in self._images.waiting for tc, _ in self._clouds.waiting]
        return min(gaps) / NANOSECONDS if gaps else None

    def clear(self) -> None:
        """Drop the waiting messages, keep the counts."""
        self._images, self._clouds = _Stream(self._images.capacity), _Stream(self._clouds.capacity)

    def add_image(self, stamp: int, image: Image) -> list[tuple[Image, Cloud]]:
        """Add an image, stamp in ns; returns the pairs that are now final."""
        self._handle_jump(self._images, stamp)
        self.counts.images += 1
        self.counts.unpaired_images += self._images.push(stamp, image)
        return self._final_pairs()

    def add_cloud(self, stamp: int, cloud: Cloud) -> list[tuple[Image, Cloud]]:
        """Add a cloud, stamp in ns; returns the pairs that are now final."""
        self._handle_jump(self._clouds, stamp)
        self.counts.clouds += 1
        self.counts.unpaired_clouds += self._clouds.push(stamp, cloud)
        return self._final_pairs()

    def _handle_jump(self, stream: _Stream, stamp: int) -> None:
        if stream.latest is not None and stamp < stream.latest - JUMP_BACK_S * NANOSECONDS:
            self.counts.jumps_back += 1
            self.counts.unpaired_images += len(self._images.waiting)
            self.counts.unpaired_clouds += len(self._clouds.waiting)
            self.clear()

    def _final_pairs(self) -> list[tuple[Image, Cloud]]:
        """Remove and return the oldest pairs that are final, with all older messages, which can find no partner any more."""
        images, clouds = self._images.waiting, self._clouds.waiting
        pairs: list[tuple[Image, Cloud]] = []
        settled_images = settled_clouds = 0
        for i, c in self._nearest_pairs():
            if self._nearer_may_come(images[i][0], clouds[c][0]):
                break
            pairs.append((images[i][1], clouds[c][1]))  # type: ignore[arg-type]
            settled_images, settled_clouds = i + 1, c + 1
        self.counts.pairs += len(pairs)
        self.counts.unpaired_images += settled_images - len(pairs)
        self.counts.unpaired_clouds += settled_clouds - len(pairs)
        for waiting, settled in ((images, settled_images), (clouds, settled_clouds)):
            for _ in range(settled):
                waiting.popleft()
        return pairs

    def _nearest_pairs(self) -> list[tuple[int, int]]:
        """Positions of the images and clouds to pair, oldest first: nearest stamps first, none twice, and never an earlier
        image with a later cloud than another pair's."""
        candidates = sorted(
            (abs(ti - tc), i, c)
            for i, (ti, _) in enumerate(self._images.waiting)
            for c, (tc, _) in enumerate(self._clouds.waiting)
            if abs(ti - tc) <= self.tolerance
        )
        chosen: list[tuple[int, int]] = []
        for _, i, c in candidates:
            if all((i - a) * (c - b) > 0 for a, b in chosen):
                chosen.append((i, c))
        return sorted(chosen)

    def _nearer_may_come(self, image_stamp: int, cloud_stamp: int) -> bool:
        """True if a message still to come may be nearer to either than they are to each other."""
        if image_stamp < cloud_stamp:
            return self._images.earliest_next() < 2 * cloud_stamp - image_stamp
        return cloud_stamp < image_stamp and self._clouds.earliest_next() < 2 * image_stamp - cloud_stamp
