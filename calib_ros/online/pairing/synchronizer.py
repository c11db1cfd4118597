"""Synchronisation: pairs each image with the point cloud that was measured in its view at the nearest time."""

from __future__ import annotations

from bisect import insort
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Any

import numpy as np

from calib_ros.frame import NANOSECONDS
from calib_ros.stamps import Rhythm, Stamps, nearest_index, nearest_pairs, pair_tolerance

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
    waiting: list[tuple[int, Any]] = field(default_factory=list)
    latest: int | None = None
    rhythm: Rhythm = field(default_factory=Rhythm)

    def push(self, stamp: int, item: Any) -> int:
        """Insert in stamp order; returns how many old items were dropped."""
        self.rhythm.add(stamp)
        self.latest = stamp if self.latest is None else max(self.latest, stamp)
        insort(self.waiting, (stamp, item), key=itemgetter(0))
        dropped = max(len(self.waiting) - self.capacity, 0)
        del self.waiting[:dropped]
        return dropped

    def earliest_next(self) -> int:
        """Earliest stamp of a message still to come (half a period of jitter allowed)."""
        return (self.latest or 0) + self.rhythm.period // 2

    def stamps(self) -> Stamps:
        """Stamps (n,) of the waiting items."""
        return np.array([stamp for stamp, _ in list(self.waiting)], np.int64)


class Synchronizer:
    """Keeps messages that wait for a partner, and returns each pair once, as soon as no nearer partner can come.

    tolerance_s: messages farther apart are never paired; 0 = as the periods of both streams allow, which also bound any other
    value (`stamps.pair_tolerance`); as limit_s it may be replaced. capacity: images and clouds kept. cloud_offset: ns, from a
    cloud's stamp to the moment by which it belongs to an image; while it is None, nothing is paired. Messages are passed through
    untouched. counts: see SynchronizerCounts. Not thread-safe.
    """

    def __init__(self, tolerance_s: float, capacity: int, cloud_offset: int | None = 0) -> None:
        self.limit_s = tolerance_s
        self.cloud_offset = cloud_offset
        self.counts = SynchronizerCounts()
        self._images, self._clouds = _Stream(capacity), _Stream(capacity)
        self._newest_is_image: bool | None = None
        self._lead: int | None = None  # ns, see lead_s

    def set_cloud_offset(self, cloud_offset: int) -> list[tuple[Any, Any]]:
        """Use another offset, ns, from now on; returns the pairs that are now final."""
        if cloud_offset == self.cloud_offset:
            return []
        self.cloud_offset = cloud_offset
        return self._final_pairs()

    # ---- state, for diagnostics ---------------------------------------------------------------------------------------

    @property
    def tolerance(self) -> int:
        """Largest difference of a pair now, ns."""
        return pair_tolerance(self.periods, self.limit_s)

    @property
    def periods(self) -> tuple[int, int]:
        """Period of the images and of the clouds, ns; 0 = not known yet."""
        return self._images.rhythm.period, self._clouds.rhythm.period

    def missing_shares(self) -> tuple[float, float]:
        """Share of the images and of the clouds, 0 to 1, that are missing between those that came (`Rhythm.missing_share`)."""
        return self._images.rhythm.missing_share(), self._clouds.rhythm.missing_share()

    def nearest_gap_s(self) -> float | None:
        """Smallest difference, s, between the waiting images and clouds; None without one of them."""
        images, clouds = self._images.stamps(), self._cloud_moments()
        if not len(images) or not len(clouds):
            return None
        return float(np.abs(clouds[nearest_index(clouds, images)] - images).min() / NANOSECONDS)

    def lead_s(self) -> float | None:
        """How far the newest image was ahead of the newest cloud, s, negative if behind, when a message last followed one of the
        other stream: both have gone on then. None before."""
        return None if self._lead is None else (self._lead - (self.cloud_offset or 0)) / NANOSECONDS

    def alone_s(self) -> float:
        """For how long images have come without clouds since, by their stamps, s; negative: clouds without images."""
        if self._lead is None or self._images.latest is None or self._clouds.latest is None:
            return 0.0
        return (self._images.latest - self._clouds.latest - self._lead) / NANOSECONDS

    def outruns_queue(self) -> bool:
        """True if a full queue of one stream holds only messages that are newer than all of the other one."""
        streams = (self._images, self._images.stamps()), (self._clouds, self._cloud_moments())
        for (ahead, stamps), (_, others) in (streams, streams[::-1]):
            if len(stamps) == ahead.capacity and len(others) and stamps[0] > others[-1] + self.tolerance:
                return True
        return False

    def clear(self) -> None:
        """Drop the waiting messages, keep the counts."""
        self._images, self._clouds = _Stream(self._images.capacity), _Stream(self._clouds.capacity)
        self._newest_is_image = self._lead = None

    # ---- messages -----------------------------------------------------------------------------------------------------

    def add(self, is_image: bool, stamp: int, message: Any) -> list[tuple[Any, Any]]:
        """Add an image or a cloud, stamp in ns; returns the pairs that are now final."""
        counts, latest = self.counts, (self._images if is_image else self._clouds).latest
        if latest is not None and stamp < latest - JUMP_BACK_S * NANOSECONDS:
            counts.jumps_back += 1
            counts.unpaired_images += len(self._images.waiting)
            counts.unpaired_clouds += len(self._clouds.waiting)
            self.clear()
        if is_image:
            counts.images += 1
            counts.unpaired_images += self._images.push(stamp, message)
        else:
            counts.clouds += 1
            counts.unpaired_clouds += self._clouds.push(stamp, message)
        if is_image != self._newest_is_image and self._images.latest is not None and self._clouds.latest is not None:
            self._lead = self._images.latest - self._clouds.latest
        self._newest_is_image = is_image
        return self._final_pairs()

    def _cloud_moments(self) -> Stamps:
        return self._clouds.stamps() + (self.cloud_offset or 0)

    def _final_pairs(self) -> list[tuple[Any, Any]]:
        """Remove and return the oldest pairs that are final, with all older messages, which can find no partner any more."""
        if self.cloud_offset is None:
            return []
        images, clouds = self._images.waiting, self._clouds.waiting
        if not images or not clouds:
            return []
        at_image, at_cloud = self._images.stamps(), self._cloud_moments()
        pairs: list[tuple[Any, Any]] = []
        settled_images = settled_clouds = 0
        for i, c in zip(*nearest_pairs(at_image, at_cloud, self.tolerance), strict=True):
            if self._nearer_may_come(int(at_image[i]), int(at_cloud[c])):
                break
            pairs.append((images[i][1], clouds[c][1]))
            settled_images, settled_clouds = int(i) + 1, int(c) + 1
        self.counts.pairs += len(pairs)
        self.counts.unpaired_images += settled_images - len(pairs)
        self.counts.unpaired_clouds += settled_clouds - len(pairs)
        del images[:settled_images], clouds[:settled_clouds]
        return pairs

    def _nearer_may_come(self, image_moment: int, cloud_moment: int) -> bool:
        """True if a message still to come may be nearer to either than they are to each other."""
        if image_moment < cloud_moment:
            return self._images.earliest_next() < 2 * cloud_moment - image_moment
        next_cloud = self._clouds.earliest_next() + (self.cloud_offset or 0)
        return cloud_moment < image_moment and next_cloud < 2 * image_moment - cloud_moment
