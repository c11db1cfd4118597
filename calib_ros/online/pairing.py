"""Which cloud belongs to which image: by the moment at which a scan sweeps the camera's view, which its points tell; by which
clocks both are stamped; and why some find no partner.

Until a first cloud has been looked at nothing is paired; later ones may correct what is known.
"""

from __future__ import annotations

from bisect import insort
from collections import deque
from dataclasses import dataclass, field, replace
from operator import itemgetter
from typing import Any

import numpy as np

from calib_ros.config import Config, OnlineConfig
from calib_ros.config.options import bounds
from calib_ros.frame import NANOSECONDS
from calib_ros.lidar.sweep import SweepOffset
from calib_ros.stamps import (
    LONGEST_QUEUE_S,
    Rhythm,
    Stamps,
    cause_of_difference,
    nearest_index,
    nearest_pairs,
    pair_tolerance,
    time_scales,
)

# Cloud messages kept: the one before a keyframe's is needed for the vehicle's motion, and the keyframe's own may wait for its
# image meanwhile.
CLOUDS_KEPT = 6
QUEUE = 8  # images and clouds that wait for their counterpart: twice what a stream of twice the rate brings in a late scan's time
JUMP_BACK_S = 1.0  # stamps that run back further than this mean a new recording or a looping bag, not a late message
# Changes from one stream to the other that agree, before anything is concluded; more where pairs were found before, since a clock
# that jumps usually comes back. Of a stream that goes on alone nothing is learnt: the other one has stopped, or gets lost.
SEEN, SEEN_LATER = 20, 200
STEADY_S = 1.0  # within which leads of one pair of clocks stay, messages of a camera at 1 Hz included
WINDOW = 11  # checks, at one a second: what happened in 10 s
# Of the slower stream, from which share without partner on it is a problem: some messages get lost on most vehicles, and two of
# the least number may still wait.
UNPAIRED_SHARE, MIN_MESSAGES = 0.3, 10
MISSING_SHARE, LASTING = 0.1, 0.5  # of a stream's messages, from which on their loss is named; and the part of it until which
OTHER_CLOCK_S = 1.0  # between the newest stamps of both streams; drivers deliver within half a second
SILENT_PERIODS = 2.5  # without a message: one may be lost, and another one late


@dataclass
class SynchronizerCounts:
    """Messages and pairs so far, for diagnostics."""

    images: int = 0
    clouds: int = 0
    pairs: int = 0
    unpaired_images: int = 0
    unpaired_clouds: int = 0
    jumps_back: int = 0
    cleared: int = 0


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
        self.counts.cleared += 1

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
            # A message still to come may be nearer to either than they are to each other.
            image, cloud = int(at_image[i]), int(at_cloud[c])
            if image < cloud and self._images.earliest_next() < 2 * cloud - image:
                break
            if cloud < image and self._clouds.earliest_next() + self.cloud_offset < 2 * image - cloud:
                break
            pairs.append((images[i][1], clouds[c][1]))
            settled_images, settled_clouds = int(i) + 1, int(c) + 1
        self.counts.pairs += len(pairs)
        self.counts.unpaired_images += settled_images - len(pairs)
        self.counts.unpaired_clouds += settled_clouds - len(pairs)
        del images[:settled_images], clouds[:settled_clouds]
        return pairs


class ClockDifference:
    """ahead: ns by which clouds are stamped ahead of images that are received at the same time, if that is the difference of two
    time scales, which is exact, or more than messages can wait, which is known as they arrive, to some 0.1 s; else 0."""

    def __init__(self) -> None:
        self.ahead = 0
        self._image: int | None = None  # the newest stamps, ns
        self._cloud: int | None = None
        self._newest_is_image: bool | None = None
        self._leads: deque[int] = deque(maxlen=SEEN_LATER)

    def add(self, is_image: bool, stamp: int, paired: bool = False) -> bool:
        """The stamp of an image or a cloud, ns, as its driver has stamped it; True if it changes what is taken out.

        paired: whether there were pairs so far.
        """
        if is_image:
            self._image = stamp
        else:
            self._cloud = stamp
        goes_on_alone, self._newest_is_image = is_image == self._newest_is_image, is_image
        if goes_on_alone or self._image is None or self._cloud is None:
            return False
        self._leads.append(self._cloud - self._image)
        agrees = abs(self._cloud - self._image - self.ahead) <= STEADY_S * NANOSECONDS
        if agrees or len(self._leads) < SEEN:
            return False
        leads = np.array(self._leads)
        found = int(np.median(leads[-SEEN:]))
        scale = time_scales(found / NANOSECONDS)
        if scale is not None:
            found = int(np.copysign(scale[0], found)) * NANOSECONDS
        elif abs(found) <= LONGEST_QUEUE_S * NANOSECONDS:
            found = 0
        wanted = SEEN_LATER if paired and found else SEEN
        steady = len(leads) >= wanted and np.ptp(leads[-wanted:]) <= STEADY_S * NANOSECONDS
        if not steady or abs(found - self.ahead) <= STEADY_S * NANOSECONDS:
            return False
        self.ahead = found
        return True

    def describe(self) -> str:
        """For people; "" if there is no difference."""
        if not self.ahead:
            return ""
        seconds = abs(self.ahead) / NANOSECONDS
        side = "after" if self.ahead > 0 else "before"
        return (
            f"clouds are stamped {seconds:.0f} s {side} images received at the same time: {cause_of_difference(seconds)}; "
            "paired as received; synchronise the clocks (PTP, chrony)"
        )


@dataclass(frozen=True, eq=False)
class Intake:
    """An image and a cloud to be looked at. paired: they belong together; else any two, before it is known which do.
    cloud_stamp: ns, by the clock of the images; None = not known any more. before: the cloud before it, with its stamp."""

    image: Any
    cloud: Any
    paired: bool = True
    cloud_stamp: int | None = None
    before: tuple[int, Any] | None = None


class Pairing:
    """Images and clouds in, what is to be taken in out. Not thread-safe: its owner holds a lock, but for `sweep`, which belongs
    to the thread that takes in.

    clouds_are_decoded: the moments of sweeps can be told; else clouds belong to their stamps at first.
    """

    def __init__(self, config: Config, clouds_are_decoded: bool) -> None:
        self.synchronizer = Synchronizer(config.online.pair_tolerance_s, QUEUE, None if clouds_are_decoded else 0)
        self.sweep, self.clocks = SweepOffset(config.motion), ClockDifference()
        self._newest_image: Any = None  # messages to find out from when scans sweep the view, while that is not known
        self._newest_cloud: Any = None
        self._clouds: deque[tuple[int, Any]] = deque(maxlen=CLOUDS_KEPT)  # the newest messages, with their stamps

    def configure(self, config: Config) -> list[Intake]:
        """Use other constants from now on."""
        self.synchronizer.limit_s = config.online.pair_tolerance_s
        self.sweep.config = config.motion
        return self.use_sweep()

    def add(self, is_image: bool, stamp: int, message: Any) -> list[Intake]:
        """An image or a cloud message, stamp in ns, from which for a cloud the difference of the clocks is taken out."""
        if self.clocks.add(is_image, stamp, self.synchronizer.counts.pairs > 0):
            # What waits is stamped by other clocks than what comes.
            self.synchronizer.clear()
            self._clouds.clear()
        if is_image:
            self._newest_image = message
        else:
            stamp -= self.clocks.ahead
            self._clouds.append((stamp, message))
            self._newest_cloud = message
        return self._to_take_in(self.synchronizer.add(is_image, stamp, message))

    def use_sweep(self) -> list[Intake]:
        """Pair by what is known of the sweep. Of pairs that become final by it, the newest is to be taken in."""
        offset = self.sweep.ns
        return [] if offset is None else self._to_take_in(self.synchronizer.set_cloud_offset(offset)[-1:])

    def use_stamps(self) -> list[Intake]:
        """Pair by what the stamps are said to be, while nobody can tell the sweep."""
        if self.synchronizer.cloud_offset is not None:
            return []
        return self._to_take_in(self.synchronizer.set_cloud_offset(self.sweep.stamped_ns)[-1:])

    def _to_take_in(self, pairs: list[tuple[Any, Any]]) -> list[Intake]:
        """The pairs, or, while nothing is known of the sweep, what is to be looked at."""
        stamps = {id(message): stamp for stamp, message in self._clouds}
        found = []
        for image, cloud in pairs:
            at = stamps.get(id(cloud))
            earlier = [item for item in self._clouds if at is not None and item[0] < at]
            found.append(Intake(image, cloud, True, at, max(earlier, key=lambda item: item[0], default=None)))
        if self.sweep.ns is not None:
            self._newest_image = self._newest_cloud = None
        elif not pairs and self._newest_image is not None and self._newest_cloud is not None:
            found.append(Intake(self._newest_image, self._newest_cloud, paired=False))
            self._newest_cloud = None  # one look at each
        return found


class PairingHealth:
    """Watches a synchronizer; `check` is to be called about once a second. Not thread-safe."""

    def __init__(self, synchronizer: Synchronizer) -> None:
        self._synchronizer = synchronizer
        self._counts: deque[SynchronizerCounts] = deque(maxlen=WINDOW)
        self.share = 0.0  # of the slower stream without partner, when that could last be told; 0 where it is no problem

    def check(self) -> str:
        """One line for a person if a large share of the slower stream has found no partner in the last 10 s, with the cause and
        what to do; else ''. At twice the rate every second message of the faster stream has none: that is no problem."""
        now = replace(self._synchronizer.counts)
        self._counts.append(now)
        before = self._counts[0]
        images, clouds, pairs = now.images - before.images, now.clouds - before.clouds, now.pairs - before.pairs
        fewer = min(images, clouds)
        if fewer < MIN_MESSAGES or now.cleared > before.cleared:
            return ""
        self.share = 1 - pairs / fewer if pairs < (1 - UNPAIRED_SHARE) * fewer else 0.0
        of = "images" if images <= clouds else "clouds"
        return f"{self.share:.0%} of the {of} find no partner: {self.cause()}" if self.share else ""

    @property
    def waiting(self) -> bool:
        """True if an image and a cloud near enough for a pair wait for what comes next."""
        gap = self._synchronizer.nearest_gap_s()
        return gap is not None and gap <= self._synchronizer.tolerance / NANOSECONDS

    def describe(self) -> dict[str, str]:
        """By which rule messages are paired at present, for diagnostics: name -> value."""
        synchronizer = self._synchronizer
        offset, images, clouds = synchronizer.cloud_offset, *synchronizer.missing_shares()
        return {
            "largest difference of a pair, ms": f"{synchronizer.tolerance / 1e6:.0f}",
            "from a cloud's stamp to its sweep of the view, ms": "unknown" if offset is None else f"{offset / 1e6:.0f}",
            "missing between those that came": f"{images:.0%} of the images, {clouds:.0%} of the clouds",
        }

    def cause(self) -> str:
        """Why images and clouds do not belong together, and what to do."""
        synchronizer = self._synchronizer
        lead, gap, tolerance = synchronizer.lead_s(), synchronizer.nearest_gap_s(), synchronizer.tolerance / NANOSECONDS
        if lead is not None and abs(lead) >= OTHER_CLOCK_S:
            scale = time_scales(lead)
            cause = f"{scale[1]} are so far apart" if scale else "another clock, or that much delay"
            return (
                f"the newest image is stamped {_time(abs(lead))} {'after' if lead > 0 else 'before'} the newest cloud: {cause}; "
                "synchronise the clocks (PTP, chrony)"
            )
        alone, periods = synchronizer.alone_s(), synchronizer.periods
        stopped, period = ("clouds", periods[1]) if alone > 0 else ("images", periods[0])
        if abs(alone) >= max(OTHER_CLOCK_S, SILENT_PERIODS * period / NANOSECONDS):
            return f"no {stopped} have come for {_time(abs(alone))}; see that their driver runs and their messages get through"
        shares = dict(zip(("images", "clouds"), synchronizer.missing_shares(), strict=True))
        lost = [f"{share:.0%} of the {name}" for name, share in shares.items() if share >= MISSING_SHARE]
        if lost:
            return f"{' and '.join(lost)} are missing between those that came; see that the drivers send them and none get lost"
        if synchronizer.outruns_queue():
            return "one stream comes later than the queue of the other one holds; lower the rate of the faster one"
        every = " and ".join(f"{period / NANOSECONDS:.3g} s" if period else "an unknown time" for period in periods)
        if gap is None or gap <= tolerance:
            return f"images and clouds come every {every}, at irregular times; check both drivers' rates and stamps"
        widest = pair_tolerance(periods, bounds(OnlineConfig, "pair_tolerance_s")[1]) / NANOSECONDS
        cures = ["trigger the camera by the scanner", "synchronise the clocks"]
        cures += ["raise online.pair_tolerance_s"] if gap <= widest else []
        return (
            f"their stamps are {gap:.3f} s apart and more, {tolerance:.3g} s are allowed (images and clouds every {every}); "
            f"{', '.join(cures[:-1])} or {cures[-1]}"
        )


def _time(seconds: float) -> str:
    """A duration for people: 2.5 s, 3.0 h, 19700 days."""
    for unit, length, least in (("days", 86400.0, 2 * 86400.0), ("h", 3600.0, 7200.0)):
        if seconds >= least:
            return f"{seconds / length:.5g} {unit}"
    return f"{seconds:.2g} s" if seconds < 10 else f"{seconds:.0f} s"
