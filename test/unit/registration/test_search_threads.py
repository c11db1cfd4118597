"""A search on several threads: the result of one thread, and nothing that goes on behind it."""

from __future__ import annotations

import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from numpy_sampler import NumpySampler
from scenes import FAR, Scene

from calib_ros.config import Config, ScoreConfig, SearchConfig
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.progress import Progress
from calib_ros.registration.score import point_score
from calib_ros.registration.score.point_score import FastScore
from calib_ros.registration.search.constraints import SearchBox, unlimited
from calib_ros.registration.search.parallel import Workers, cpu_time
from calib_ros.registration.search.search import SearchResult, search

SMALL = SearchConfig(starts=1024, rounds=2)
BOX = SearchBox(6, 0.4)  # so large that starts are ranked first
ACCEPTED = 0.01  # largest p value


class Ended(Exception):
    """What a callback raises."""


class Watcher:
    """An observer that notes its calls and where they come from."""

    def __init__(self) -> None:
        self.calls: list[int] = []
        self.threads: set[str] = set()

    def evaluated(self, count: int) -> None:
        self._called(count)

    def linearised(self) -> None:
        self._called(0)

    def reached(self, T: np.ndarray) -> None:
        self._called(-1)

    def _called(self, what: int) -> None:
        self.calls.append(what)
        self.threads.add(threading.current_thread().name)


def found(
    scene: Scene, threads: int, progress: Progress | None = None, observer: Watcher | None = None, max_p_value: float = ACCEPTED
) -> SearchResult:
    start, config = scene.off(FAR), replace(SMALL, threads=threads)
    score = FastScore(scene.features[:2], start, ScoreConfig(), 0.9, observer=observer)
    return search(score, start, BOX, config, unlimited(start), max_p_value, progress=progress or Progress())


def bits(result: SearchResult) -> tuple[object, ...]:
    nearby = tuple(T.tobytes() for T in result.nearby)
    return result.T.tobytes(), result.agreed, result.optimised, result.rounds, result.decoy_z, nearby


def pool_threads() -> list[str]:
    return [t.name for t in threading.enumerate() if t.name.startswith("calib_search")]


def test_any_number_of_threads_finds_the_same_to_the_last_bit(scene):
    reports: dict[int, list[float]] = {}
    results = {}
    for threads in (1, 2, 5):
        own = reports.setdefault(threads, [])
        results[threads] = bits(found(scene, threads, Progress(lambda stage, share, own=own: own.append(share)), max_p_value=0.0))
    assert results[1][3] == 2
    assert results[2] == results[1]
    assert results[5] == results[1]
    assert reports[2] == reports[1]
    assert reports[5] == reports[1]
    assert np.diff(reports[1]).min() > -1e-9


def test_an_estimate_is_the_same_with_the_kernel_and_its_reference(scene, monkeypatch):
    calibrator = Calibrator(scene.camera, Config(search=replace(SMALL, threads=2)))
    compiled = calibrator.estimate(scene.features, scene.off(FAR), BOX)
    scene.assert_found(compiled)
    monkeypatch.setattr(point_score, "Sampler", NumpySampler)
    by_numpy = calibrator.estimate(scene.features, scene.off(FAR), BOX)
    assert by_numpy.T_camera_lidar == pytest.approx(compiled.T_camera_lidar, abs=1e-6)
    one = Calibrator(scene.camera, Config(search=SMALL)).estimate(scene.features, scene.off(FAR), BOX)
    assert one.T_camera_lidar.tobytes() == by_numpy.T_camera_lidar.tobytes()
    assert one.covariance.tobytes() == by_numpy.covariance.tobytes()


@pytest.mark.parametrize(("threads", "after"), [(1, 0.2), (2, 0.0), (2, 0.4)])
def test_a_callback_that_raises_ends_the_search(scene, threads, after):
    shares: list[float] = []

    def callback(stage: str, share: float) -> None:
        shares.append(share)
        if share >= after:
            raise Ended

    with pytest.raises(Ended):
        found(scene, threads, Progress(callback))
    assert all(share < after for share in shares[:-1])
    assert not pool_threads()
    calls = len(shares)
    assert bits(found(scene, threads)) == bits(found(scene, 1))  # nothing of it is left
    assert len(shares) == calls


def test_an_observer_is_told_in_order_by_one_thread(scene):
    one, two = Watcher(), Watcher()
    assert bits(found(scene, 1, observer=one)) == bits(found(scene, 2, observer=two))
    assert one.calls == two.calls
    assert len(one.calls) > 100
    assert two.threads == {threading.current_thread().name}


# --- the pool -------------------------------------------------------------------------------------------------------------


def test_the_cpu_time_of_the_pool_is_that_of_its_owner():
    def busy(seconds: float) -> None:
        began = time.thread_time()
        while time.thread_time() - began < seconds:
            pass

    for threads in (1, 2):
        before, own = cpu_time(), time.thread_time()
        with Workers(threads) as workers:
            list(workers.map(busy, [0.02, 0.03]))
        counted, own = cpu_time() - before, time.thread_time() - own
        assert counted >= 0.05
        assert counted - own == pytest.approx(0.0 if threads == 1 else 0.05, abs=0.02)
