"""Synchronisation of image and cloud streams: each message used once, with its nearest partner."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from calib_ros.frame import NANOSECONDS
from calib_ros.online.pairing.synchronizer import Synchronizer

MS = 10**6
T0 = 1_700_000_000 * NANOSECONDS


class Streams:
    """Feeds a Pairer with (arrival, stamp) in ms and checks what must hold at any time."""

    def __init__(self, tolerance_s: float = 0.05, capacity: int = 8) -> None:
        self.synchronizer: Synchronizer[float, float] = Synchronizer(tolerance_s, capacity)
        self.pairs: list[tuple[float, float]] = []

    def image(self, ms: float) -> list[tuple[float, float]]:
        return self._took(self.synchronizer.add_image(T0 + round(ms * MS), ms))

    def cloud(self, ms: float) -> list[tuple[float, float]]:
        return self._took(self.synchronizer.add_cloud(T0 + round(ms * MS), ms))

    def run(
        self, images: np.ndarray, clouds: np.ndarray, image_delay: np.ndarray | float = 0, cloud_delay: np.ndarray | float = 0
    ):
        arrivals = [(a, "image", s) for a, s in zip(images + image_delay, images, strict=True)]
        arrivals += [(a, "cloud", s) for a, s in zip(clouds + cloud_delay, clouds, strict=True)]
        for _, kind, stamp in sorted(arrivals):
            getattr(self, kind)(float(stamp))
        return self.pairs

    def _took(self, pairs: list[tuple[float, float]]) -> list[tuple[float, float]]:
        self.pairs += pairs
        c, p = self.synchronizer.counts, self.synchronizer
        assert c.pairs == len(self.pairs)
        assert c.images == c.pairs + c.unpaired_images + len(p._images.waiting)
        assert c.clouds == c.pairs + c.unpaired_clouds + len(p._clouds.waiting)
        return pairs


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


def test_hardware_synchronised_stamps_pair_at_once():
    s = Streams()
    assert s.image(0) == []
    assert s.cloud(0) == [(0, 0)]
    assert s.cloud(100) == []
    assert s.image(100) == [(100, 100)]


def test_a_pair_waits_while_a_nearer_partner_may_come():
    s = Streams()
    s.image(0)
    assert s.cloud(20) == []  # nothing is known of the images' rate
    assert s.image(33) == []  # nor of the clouds'
    assert s.cloud(120) == [(33, 20)]
    s = Streams()
    for ms in (-200, -100, 0):
        s.image(ms)
    assert s.cloud(20) == [(0, 20)]  # the next image is due at 100


@pytest.mark.parametrize("tolerance_s", [0.02, 0.05])
def test_the_tolerance_is_a_limit(tolerance_s):
    limit = tolerance_s * 1000
    s = Streams(tolerance_s)
    for k in range(4):
        s.image(1000 * k)
        s.cloud(1000 * k + limit)
    assert len(s.pairs) >= 3
    s = Streams(tolerance_s)
    for k in range(4):
        s.image(1000 * k)
        s.cloud(1000 * k + limit + 0.001)
    assert s.pairs == []


REGIMES = {
    "10 and 10 Hz": {"period": 100},
    "clouds 80 ms late": {"period": 100, "cloud_delay": 80},
    "images late": {"period": 100, "image_delay": 90},
    "lost on both sides": {"period": 100, "lost": 0.2, "cloud_delay": 80},
    "30 Hz images": {"period": 33.3, "cloud_delay": 80},
    "30 Hz images, lost": {"period": 33.3, "lost": 0.2, "cloud_delay": 80},
    "12 Hz images": {"period": 83, "lost": 0.1, "cloud_delay": 50},
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
        s = Streams()
        pairs = s.run(images, clouds, *late)
        for side in zip(*pairs, strict=True):
            assert len(set(side)) == len(side)  # nothing is used twice
            assert list(side) == sorted(side)  # and nothing is given out of order
        assert max(abs(i - c) for i, c in pairs) <= 50
        n, gap = most_pairs(images, clouds)
        made, possible, gaps, least = made + len(pairs), possible + n, gaps + sum(abs(i - c) for i, c in pairs), least + gap
    assert made > 0.97 * possible  # the last ones of a stream may still wait
    assert gaps / made < 1.03 * least / possible


def test_no_offset_between_the_sensors_loses_pairs():
    for delay, offset in itertools.product((0, 80, 180), (0, 10, 20, 30, 40, 60, 70, 80, 90)):
        rng = np.random.default_rng(offset)
        images, clouds = stream(rng, 100), stream(rng, 100, offset)
        pairs = Streams().run(images, clouds, 15, 15 + delay)
        assert len(pairs) >= len(images) - 2
        for image, cloud in pairs:
            assert abs(image - cloud) == np.abs(images - cloud).min()


def test_each_cloud_of_faster_images_gets_its_nearest():
    rng = np.random.default_rng(1)
    images, clouds = stream(rng, 33.3), stream(rng, 100, 41)
    pairs = Streams().run(images, clouds, 5, 85)
    assert len(pairs) >= 38
    for image, cloud in pairs:
        assert abs(image - cloud) == np.abs(images - cloud).min()


def test_pairs_never_cross():
    """The nearest two pair up; the image after them and the cloud before them do not, though within the tolerance."""
    s = Streams()
    for ms in (0, 30, 100):
        s.cloud(ms)
    for ms in (25, 45):
        s.image(ms)
    assert s.pairs == [(25, 30)]


def test_messages_out_of_order_are_put_in_order():
    s = Streams()
    for ms in (0, 200, 100, 300):
        s.image(ms)
    assert s.cloud(103) == [(100, 103)]
    assert s.cloud(301) == [(300, 301)]
    assert s.cloud(198) == []  # what is older than a pair is gone
    assert (s.synchronizer.counts.unpaired_images, s.synchronizer.counts.pairs, s.synchronizer.counts.jumps_back) == (2, 2, 0)


def test_a_doubled_message_is_used_once():
    s = Streams()
    for _ in range(2):
        s.image(0)
    assert s.cloud(0) == [(0, 0)]
    assert s.cloud(0) == [(0, 0)]
    s = Streams()
    s.image(0)
    s.cloud(1)
    s.cloud(1)
    s.image(100)
    assert s.pairs == [(0, 1)]
    assert s.cloud(101) == [(100, 101)]


def test_a_jump_back_starts_anew():
    """A looping bag: both streams go back by a minute, one a little after the other."""
    s = Streams()
    for start in (60_000, 0, -60_000):
        before = len(s.pairs)
        for k in range(10):
            s.image(start + 100 * k)
            s.cloud(start + 100 * k + 7 - 80 * (k == 0))
        assert len(s.pairs) >= before + 8
        assert all(abs(i - c) <= 50 for i, c in s.pairs)
    assert 2 <= s.synchronizer.counts.jumps_back <= 4


def test_a_late_cloud_of_the_time_before_the_jump_does_not_stop_the_pairing():
    s = Streams()
    for k in range(5):
        s.image(60_000 + 100 * k)
        s.cloud(60_000 + 100 * k)
    s.image(0)
    s.cloud(60_500)  # still under way when the bag looped
    for k in range(1, 8):
        s.image(100 * k)
        s.cloud(100 * k)
    assert [p for p in s.pairs if p[0] < 1000][-6:] == [(100.0 * k, 100.0 * k) for k in range(2, 8)]


def test_small_steps_back_are_late_messages_not_jumps():
    s = Streams()
    s.image(1000)
    s.image(100)  # 0.9 s
    assert s.synchronizer.counts.jumps_back == 0
    s.image(-1)
    assert s.synchronizer.counts.jumps_back == 1


def test_a_stamp_far_in_the_future_costs_little():
    s = Streams()
    for k in range(10):
        s.image(100 * k + (10**8 if k == 4 else 0))
        s.cloud(100 * k)
    assert len(s.pairs) >= 7


def test_the_queues_are_bounded_and_forget_the_oldest():
    s = Streams(capacity=3)
    for k in range(20):
        s.image(100 * k)
    assert s.synchronizer.counts.unpaired_images == 17
    assert s.cloud(1700) == [(1700, 1700)]
    assert s.cloud(1600) == []
    s.synchronizer.configure(0.05, 1)
    for k in range(20, 24):
        s.image(100 * k)
    assert len(s.synchronizer._images.waiting) == 1


def test_a_message_older_than_a_full_queue_is_dropped_itself():
    s = Streams(capacity=2)
    for ms in (1000, 1100, 900):
        s.image(ms)
    assert s.cloud(900) == []
    assert s.cloud(1100) == [(1100, 1100)]


def test_a_wider_tolerance_counts_from_now_on():
    s = Streams(0.01)
    for k in range(3):
        s.image(200 * k)
        s.cloud(200 * k + 30)
    assert s.pairs == []
    s.synchronizer.configure(0.04, 8)
    s.image(600)
    assert s.pairs[0] == (0, 30)


def test_gap_explains_missing_pairs():
    s = Streams(0.01)
    assert s.synchronizer.nearest_gap_s() is None
    s.image(0)
    assert s.synchronizer.nearest_gap_s() is None
    s.cloud(70)
    s.cloud(150)
    s.image(200)
    assert s.synchronizer.nearest_gap_s() == pytest.approx(0.05)
    s.synchronizer.clear()
    assert s.synchronizer.nearest_gap_s() is None
    assert s.synchronizer.counts.images == 2


def test_single_stream_pairs_nothing_and_keeps_running():
    s = Streams()
    for k in range(1000):
        s.cloud(100 * k)
    c = s.synchronizer.counts
    assert (c.images, c.clouds, c.pairs, c.unpaired_clouds) == (0, 1000, 0, 992)
