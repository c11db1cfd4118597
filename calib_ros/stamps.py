"""Stamps, ns, of two streams of messages: the period of each, what is missing in it, and which message belongs to which."""

from __future__ import annotations

from bisect import insort
from statistics import median_low

import numpy as np
from numpy.typing import NDArray

from calib_ros.frame import NANOSECONDS

Stamps = NDArray[np.int64]
WINDOW = 64  # newest stamps that a period is found from: 6 s of a scanner at 10 Hz
# The period is the median of differences up to 1.5 times this quantile: the lowest may be doubled, and most be several periods.
LOW_QUANTILE = 0.1
REGULAR_WITHIN, REGULAR_SHARE = 0.25, 0.9  # of a period, and of the differences: by chance, half of them lie that near
LONGEST_GAP = 20  # periods; what lasts longer is an interruption, and no loss of single messages
# Before the periods are known, and their limit: half a revolution of the slowest scanners, 5 Hz, with their jitter.
FIRST_TOLERANCE, WIDEST_TOLERANCE = 50_000_000, 120_000_000
JITTER = 0.1  # of a period, by which stamps may lie beside their time; cameras and scanners have up to 5 ms
TIME_SCALES = {37: "TAI and UTC", 18: "GPS time and UTC", 19: "TAI and GPS time"}  # s, since 2017
SAME_DIFFERENCE = 0.3  # s, by which latencies may blur one of these
LONGEST_QUEUE_S = 60.0  # that messages wait in; stamps of the same moment that differ by more are of other clocks
LONG_AGO_S = 1e7


def cause_of_difference(seconds: float) -> str:
    """The likely cause of clocks that are so far apart."""
    scale = time_scales(seconds)
    if scale is not None:
        return f"the difference of {scale[1]}, of which one sensor is synchronised to each"
    if abs(seconds) > LONG_AGO_S:
        return "one of them counts from another epoch, such as when it was switched on"
    return "their clocks are not synchronised"


def time_scales(seconds: float) -> tuple[int, str] | None:
    """The two time scales that are so far apart, with their exact difference, s; None if no two are."""
    return next((own for own in TIME_SCALES.items() if abs(abs(seconds) - own[0]) <= SAME_DIFFERENCE), None)


class Rhythm:
    """The newest stamps of a stream: its period, and the share of messages that is missing."""

    def __init__(self) -> None:
        self.period = 0  # ns; 0 = not known yet
        self._stamps: list[int] = []

    def add(self, stamp: int) -> None:
        """Add a stamp, in any order; each counts once."""
        if stamp in self._stamps[-WINDOW:]:
            return
        insort(self._stamps, stamp)
        if len(self._stamps) > WINDOW:
            del self._stamps[0]
        self.period = usual_period(self._steps())

    def missing_share(self) -> float:
        """Share of the messages, 0 to 1, that are missing between those that came; 0 where that cannot be told."""
        if len(self._stamps) < WINDOW:
            return 0.0
        steps = self._steps()
        # The lower of two halves: a camera that changes its rate for longer exposures, or pauses once, loses nothing.
        return min(_missing(half, self.period) for half in (steps[: WINDOW // 2], steps[WINDOW // 2 :]))

    def _steps(self) -> Stamps:
        stamps = np.array(self._stamps, np.int64)
        return stamps[1:] - stamps[:-1]


def usual_period(steps: Stamps) -> int:
    """Period, ns, of a stream by the differences (n,) >= 0 of neighbouring stamps, however many are missing; 0 without any."""
    steps = np.sort(steps[steps > 0])
    if not len(steps):
        return 0
    low = steps[int(LOW_QUANTILE * (len(steps) - 1))]
    return int(median_low(steps[: np.searchsorted(steps, 1.5 * low, side="right")].tolist()))


def _missing(steps: Stamps, period: int) -> float:
    """Share of the messages missing between stamps with these differences; 0 if they are no multiples of a period."""
    # Their own, or, where so few remain that hardly any two are neighbours, that of a longer time.
    for candidate in (usual_period(steps), period):
        near = steps[steps <= LONGEST_GAP * candidate]
        multiples = near / max(candidate, 1)
        expected = np.maximum(np.round(multiples), 1.0)
        if len(near) and (np.abs(multiples - expected) <= REGULAR_WITHIN).mean() >= REGULAR_SHARE:
            return float(1 - len(near) / expected.sum())
    return 0.0


def pair_tolerance(periods: tuple[int, int], limit_s: float) -> int:
    """Largest difference, ns, between a message and its partner, from the periods (0 = unknown) of both streams. limit_s: upper
    limit from the user; 0 = none, then sensors slower than 5 Hz have that of 5 Hz."""
    limit = round(limit_s * NANOSECONDS) or WIDEST_TOLERANCE
    if not all(periods):
        return limit if limit_s else FIRST_TOLERANCE
    return min(round((0.5 + JITTER) * max(periods)), limit)


def nearest_index(stamps: Stamps, wanted: Stamps) -> NDArray[np.intp]:
    """Index (m,) of the nearest of stamps (n >= 1, sorted) for each of wanted (m,); of two equally near, the earlier."""
    after = np.searchsorted(stamps, wanted)
    right = np.minimum(after, len(stamps) - 1)
    left = np.maximum(after - 1, 0)
    return np.where(np.abs(wanted - stamps[left]) <= np.abs(stamps[right] - wanted), left, right)


def nearest_pairs(a: Stamps, b: Stamps, tolerance: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pairs of two sorted arrays of stamps at most `tolerance` apart, nearest first, each stamp used once, in the same order in
    both: indices (k,) into a and into b."""
    # Mutually nearest ones, then again among the rest between two pairs: a greedy choice by distance, without its loop.
    pairs: list[tuple[int, int]] = []
    rest_a, rest_b = np.arange(len(a)), np.arange(len(b))
    apart_a, apart_b = a, b  # what lies on different sides of a pair is moved apart, beyond the tolerance
    while len(rest_a) and len(rest_b):
        to_b, to_a = nearest_index(apart_b, apart_a), nearest_index(apart_a, apart_b)
        mutual = (to_a[to_b] == np.arange(len(apart_a))) & (np.abs(apart_a - apart_b[to_b]) <= tolerance)
        if not mutual.any():
            break
        pairs += zip(rest_a[mutual].tolist(), rest_b[to_b[mutual]].tolist(), strict=True)
        pairs.sort()
        rest_a, rest_b = (np.delete(rest, place) for rest, place in ((rest_a, mutual), (rest_b, to_b[mutual])))
        used_a, used_b = np.array(pairs, np.intp).T
        apart_a = a[rest_a] + np.searchsorted(used_a, rest_a) * (2 * tolerance + 1)
        apart_b = b[rest_b] + np.searchsorted(used_b, rest_b) * (2 * tolerance + 1)
    ia, ib = np.array(pairs, np.intp).reshape(-1, 2).T
    return ia, ib
