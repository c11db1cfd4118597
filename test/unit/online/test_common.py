"""What the pipelines of a rig share: turns in order, one computation for all, one budget."""

from __future__ import annotations

import threading

import pytest
from waiting import until

from calib_ros.config import OnlineConfig
from calib_ros.online.common import Turns
from calib_ros.online.pacing import SAVED_S, LoadBudget, Purse, Work
from calib_ros.online.worker import Cancelled


def test_turns_come_in_the_order_of_asking_and_a_wait_can_be_given_up() -> None:
    turns, done = Turns(), []

    def work(name: str) -> None:
        with turns.mine():
            done.append(name)

    def stop() -> None:
        raise Cancelled

    with turns.mine():
        threads = []
        for name in "abc":
            threads.append(threading.Thread(target=work, args=name))
            threads[-1].start()
            until(lambda: len(turns._queue) == len(threads) + 1)
        with pytest.raises(Cancelled), turns.mine(stop):
            pass
    for thread in threads:
        thread.join()
    assert done == ["a", "b", "c"]


def test_pairs_spend_one_budget_and_have_their_least_of_keyframes_each() -> None:
    now = [0.0]
    config = OnlineConfig(max_load=0.5)
    purse = Purse(config, lambda: now[0])
    first, second = (LoadBudget(config, purse=purse) for _ in range(2))
    first.add(Work.KEYFRAMES, 2 * SAVED_S * config.max_load)
    assert second.allows_keyframe()  # the first one in so many seconds, beyond the budget
    assert not second.allows_keyframe()
    assert second.counts().forced == 1
    now[0] += 2 * SAVED_S
    assert second.allows_keyframe()
    assert second.counts().forced == 1
