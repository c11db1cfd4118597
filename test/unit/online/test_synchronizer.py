"""Synchronisation of image and cloud streams: each message used once, with its nearest partner."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from calib_ros.frame import NANOSECONDS
from calib_ros.online.pairing import Synchronizer

MS = 10**6
T0 = 1_700_000_000 * NANOSECONDS
Pairs = list[tuple[float, float]]


class Streams:
    """Feeds a synchronizer with stamps in ms and checks what must hold at any time."""

    def __init__(self, tolerance_s: float = 0.05, capacity: int = 8) -> None:
        self.synchronizer = Synchronizer(tolerance_s, capacity)
        self.pairs: Pairs = []

    def add(self, kind: str, ms: float) -> Pairs:
        pairs = self.synchronizer.add(kind == "i", T0 + round(ms * MS), ms)
        self.pairs += pairs
        c, p = self.synchronizer.counts, self.synchronizer
        assert c.pairs == len(self.pairs)
        assert c.images == c.pairs + c.unpaired_images + len(p._images.waiting)
        assert c.clouds == c.pairs + c.unpaired_clouds + len(p._clouds.waiting)
        return pairs

    def __call__(self, script: str) -> Pairs:
        """The pairs that an "i100" for an image or "c100" for a cloud, of 100 ms, or several of them make."""
        return [pair for word in script.split() for pair in self.add(word[0], float(word[1:]))]

    def run(
        self, images: np.ndarray, clouds: np.ndarray, image_delay: np.ndarray | float = 0, cloud_delay: np.ndarray | float = 0
    ) -> Pairs:
        arrivals = [(a, "i", s) for a, s in zip(images + image_delay, images, strict=True)]
        arrivals += [(a, "c", s) for a, s in zip(clouds + cloud_delay, clouds, strict=True)]
        for _, kind, stamp in sorted(arrivals):
            self.add(kind, float(stamp))
        return self.pairs


def most_pairs(images: np.ndarray, clouds: np.ndarray, tolerance: float = 50) -> tuple[int, float]:
    """The largest number of pairs that any choice could make, and the least sum of gaps with it (brute force)."""
    best = np.zeros((len(images) + 1, len(clouds) + 1, 2))
    for i, c in itertools.product(reversed(range(len(images))), reversed(range(len(clouds)))):
        options = [tuple(best[i + 1, c]), tuple(best[i, c + 1])]
        if abs(images[i] - clouds[c]) <= tolerance:
            options.append((best[i + 1, c + 1, 0] - 1, best[i + 1, c + 1, 1] + abs(images[i] - clouds[c])))
        best[i, c] = min(options)
    return -int(best[0, 0, 0]), float(best[0, 0, 1])


def stream(
    rng: np.random.Generator, period: float, offset: float = 0, jitter: float = 3, lost: float = 0, length: float = 4000
) -> np.ndarray:
    t = np.arange(int(length / period)) * period
    return np.sort(t + offset + rng.uniform(-jitter, jitter, len(t)))[rng.random(len(t)) >= lost]


@pytest.mark.parametrize(
    "steps",
    [
        [("i0", []), ("c0", [(0, 0)]), ("c100", []), ("i100", [(100, 100)])],
        # A pair waits while a nearer partner may come: nothing is known of the images' rate, nor of the clouds'.
        [("i0 c20", []), ("i33", []), ("c120", [(33, 20)])],
        [("i-200 i-100 i0", []), ("c20", [(0, 20)])],  # the next image is due at 100
        # The nearest two pair up; the image after them and the cloud before them do not, though within the tolerance.
        [("c0 c30 c100 i25 i45", [(25, 30)])],
        [("i0 i200 i100 i300", []), ("c103", [(100, 103)]), ("c301", [(300, 301)]), ("c198", [])],  # that is older than a pair
        # A doubled message is used once.
        [("i0 i0", []), ("c0", [(0, 0)]), ("c0", [(0, 0)])],
        [("i0 c1 c1 i100", [(0, 1)]), ("c101", [(100, 101)])],
        # A late cloud of the time before a jump back, still under way when the bag looped.
        [("i60000 c60000 i0 c60500", [(60000, 60000)]), ("i100 c100 i200 c200 i300 c300", [(200, 200), (300, 300)])],
    ],
    ids=["hardware", "nearer may come", "none nearer", "no crossing", "out of order", "doubled", "doubled cloud", "late"],
)
def test_pairs_are_made_as_soon_as_they_are_final(steps):
    s = Streams()
    for script, pairs in steps:
        assert s(script) == pairs


@pytest.mark.parametrize("tolerance_s", [0.02, 0.05])
@pytest.mark.parametrize("beyond", [0.0, 0.001])
def test_the_tolerance_is_a_limit(tolerance_s, beyond):
    s = Streams(tolerance_s)
    for k in range(4):
        s(f"i{1000 * k} c{1000 * k + tolerance_s * 1000 + beyond}")
    assert len(s.pairs) == 0 if beyond else len(s.pairs) >= 3


REGIMES = {
    "images late": {"period": 100, "image_delay": 90},
    "lost on both sides": {"period": 100, "lost": 0.2, "cloud_delay": 80},
    "30 Hz images, lost": {"period": 33.3, "lost": 0.2, "cloud_delay": 80},
    "5 Hz images": {"period": 200, "lost": 0.1, "cloud_delay": 80},
    "much jitter": {"period": 100, "jitter": 20, "lost": 0.1, "cloud_delay": 30},
}


@pytest.mark.parametrize("name", REGIMES)
def test_random_streams_pair_nearly_as_well_as_in_hindsight(name):
    regime = {"jitter": 3, "lost": 0, "image_delay": 0, "cloud_delay": 0, **REGIMES[name]}
    made = possible = 0
    gaps, least = 0.0, 0.0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        images = stream(rng, regime["period"], 0, regime["jitter"], regime["lost"])
        clouds = stream(rng, 100, 100 * seed / 12, regime["jitter"], regime["lost"])
        # Messages arrive in order, some of them later than others.
        late = [
            np.maximum.accumulate(t + regime[d] + rng.uniform(10, 25, len(t))) - t
            for t, d in ((images, "image_delay"), (clouds, "cloud_delay"))
        ]
        pairs = Streams().run(images, clouds, *late)
        for side in zip(*pairs, strict=True):
            assert list(side) == sorted(set(side))  # nothing is used twice or given out of order
        assert max(abs(i - c) for i, c in pairs) <= 50
        n, gap = most_pairs(images, clouds)
        made, possible, gaps, least = made + len(pairs), possible + n, gaps + sum(abs(i - c) for i, c in pairs), least + gap
    assert made > 0.97 * possible  # the last ones of a stream may still wait
    assert gaps / made < 1.03 * least / possible


def test_the_queues_are_bounded_and_forget_the_oldest():
    s = Streams(capacity=3)
    for k in range(20):
        s(f"i{100 * k}")
    assert s.synchronizer.counts.unpaired_images == 17
    assert s("c1700") == [(1700, 1700)]
    assert s("c1600") == []
    s = Streams(capacity=2)  # a message older than a full queue is dropped itself
    assert s("i1000 i1100 i900 c900") == []
    assert s("c1100") == [(1100, 1100)]
