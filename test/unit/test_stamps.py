"""Periods, missing messages and pairs of time stamps."""

from __future__ import annotations

import numpy as np
import pytest

from calib_ros.stamps import FIRST_TOLERANCE, WIDEST_TOLERANCE, WINDOW, Rhythm, nearest_pairs, pair_tolerance, usual_period

MS = 10**6


def rhythm(ms: np.ndarray) -> Rhythm:
    made = Rhythm()
    for stamp in ms:
        made.add(round(stamp * MS))
    return made


def regular(period: float, count: int, jitter: float = 0.0, lost: float = 0.0, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    stamps = period * np.arange(count) + rng.uniform(-jitter, jitter, count)
    return stamps[rng.random(count) >= lost]


@pytest.mark.parametrize("period", [33.3, 50.0, 100.0, 200.0])
@pytest.mark.parametrize("lost", [0.0, 0.3, 0.75])
def test_the_period_is_found_whatever_is_missing(period, lost):
    for seed in range(10):
        found = rhythm(regular(period, 400, 0.05 * period, lost, seed)).period / MS
        assert found == pytest.approx(period, rel=0.06)


def test_doubled_late_and_standing_stamps():
    stamps = regular(100.0, 64, 2.0)
    stamps = np.r_[stamps[:20], stamps[10:15], stamps[20:30], stamps[30:] + 0.0, stamps[-3] + 1.0]
    assert rhythm(stamps).period / MS == pytest.approx(100.0, abs=4.0)
    assert rhythm(np.array([5.0, 5.0, 5.0])).period == 0
    assert usual_period(np.zeros(0, np.int64)) == 0


@pytest.mark.parametrize("lost", [0.15, 0.3, 0.5, 0.77])
def test_the_share_of_missing_messages_is_told(lost):
    shares = [rhythm(regular(50.0, 800, 3.0, lost, seed)).missing_share() for seed in range(20)]
    # The lower of two halves of 32 messages, so less than the truth, but enough to be named.
    assert lost - 0.2 < np.median(shares) <= lost + 0.02
    assert np.mean(np.array(shares) > 0.1) >= (0.4 if lost < 0.2 else 0.9)


@pytest.mark.parametrize(
    "stamps",
    [
        regular(33.3, 200, 3.0),
        np.r_[regular(33.3, 100), 3330 + regular(66.6, 15)],
        np.r_[regular(100.0, 60), 9000 + regular(100.0, 30)],  # an interruption
        regular(33.3, WINDOW - 2, lost=0.5),  # too few to tell
    ],
    ids=["camera", "slower", "interruption", "few"],
)
def test_a_slow_or_interrupted_stream_loses_nothing(stamps):
    assert rhythm(stamps).missing_share() < 0.02


def test_the_tolerance_follows_the_longer_period():
    for periods_ms, limit_s, tolerance in (
        *(((33, 100), 0.0, 60 * MS), ((100, 50), 0.0, 60 * MS), ((50, 50), 0.0, 30 * MS)),
        *(((0, 100), 0.0, FIRST_TOLERANCE), ((1000, 100), 0.0, WIDEST_TOLERANCE)),
        # That of the user is an upper limit.
        *(((100, 100), 0.02, 20 * MS), ((100, 100), 0.5, 60 * MS), ((1000, 1000), 0.5, 500 * MS), ((0, 0), 0.5, 500 * MS)),
    ):
        assert pair_tolerance((periods_ms[0] * MS, periods_ms[1] * MS), limit_s) == tolerance


def test_nearest_pairs_equal_a_greedy_choice():
    rng = np.random.default_rng(5)
    compared = 0
    for _ in range(100):
        a, b = (np.sort(rng.choice(10_000, rng.integers(0, 30), replace=False)) for _ in range(2))
        gaps = sorted((abs(x - y), i, j) for i, x in enumerate(a) for j, y in enumerate(b) if abs(x - y) <= 300)
        if len({g for g, *_ in gaps}) < len(gaps):
            continue  # equal gaps leave a choice
        greedy: list[tuple[int, int]] = []
        for _, i, j in gaps:
            if all((i - k) * (j - m) > 0 for k, m in greedy):
                greedy.append((i, j))
        ia, ib = nearest_pairs(a, b, 300)
        assert list(zip(ia.tolist(), ib.tolist(), strict=True)) == sorted(greedy)
        compared += 1
    assert compared > 20
