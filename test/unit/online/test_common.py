"""What the pipelines of a rig share: turns in order, one computation for all, one budget."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from waiting import until

from calib_ros.config import LidarConfig, MotionConfig, OnlineConfig, SemanticsConfig
from calib_ros.frame import PointCloud
from calib_ros.online import common
from calib_ros.online.common import Common, SharedScans, Turns
from calib_ros.online.pacing import SAVED_S, LoadBudget, Purse, Work
from calib_ros.online.worker import Cancelled


def test_turns_come_in_the_order_of_asking_and_a_wait_can_be_given_up() -> None:
    turns, done = Turns(), []

    def work(name: str) -> None:
        with turns.mine() as waited:
            assert waited
            done.append(name)

    def stop() -> None:
        raise Cancelled

    with turns.mine() as waited:
        assert not waited
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


def test_a_motion_is_found_once_whatever_is_known_of_the_cameras_clocks(monkeypatch) -> None:
    made = []
    monkeypatch.setattr(common, "estimate_motion", lambda *given: made.append(given) or object())
    scans, (a, b) = SharedScans(), (PointCloud(np.ones((3, 3), np.float32)) for _ in range(2))
    found = {scans.motion(a, b, 0.1, MotionConfig(time_offset_s=ms / 1000), None) for ms in (0, 5, -20)}
    assert len(found) == len(made) == 1
    assert scans.motion(b, a, 0.1, MotionConfig(), None) not in found


def test_edges_are_kept_of_the_newest_scans_and_of_one_configuration() -> None:
    scans, config = SharedScans(), LidarConfig()
    edges = scans.edges(config)
    keys = [(stamp, 1, b"") for stamp in range(common.SCANS_KEPT + 3)]
    for key in keys:
        edges[key] = (True, None)
    assert list(edges) == keys[3:]
    assert scans.edges(LidarConfig()) is edges
    assert not scans.edges(LidarConfig(min_range=3.0))
    assert scans.edges(LidarConfig(accumulate_s=0.5)) is None


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


def test_models_are_those_of_all() -> None:
    own = Common(OnlineConfig())
    config = SemanticsConfig()
    assert own.models(config) is own.models(config)
    assert own.scans("top") is own.scans("top") is not own.scans("rear")
