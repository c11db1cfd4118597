"""What the pipelines of a rig have in common, so that its cost is not that of so many nodes: a budget, turns, and what is found
out of a scan, once whatever the number of cameras."""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import LidarConfig, MotionConfig, OnlineConfig, SemanticsConfig
from calib_ros.datasets.recent import Recent
from calib_ros.frame import PointCloud
from calib_ros.lidar.edges import EdgePoints
from calib_ros.lidar.ego_motion import Motion, estimate_motion
from calib_ros.online.pacing import Purse
from calib_ros.online.worker import Worker
from calib_ros.registration.classes import Segmentation
from calib_ros.registration.classes import segmentation as models_of
from calib_ros.registration.features import ScanEdges, ScanKey

PICTURES_KEPT = 4  # of a camera, whose edge maps take as much memory as all the rest of a keyframe: the newest
SCANS_KEPT = 8  # of a LiDAR: the newest, and those before them that cameras out of step look at
ROUND_NS = 60_000_000  # between scans of several LiDARs at 10 Hz that were taken at the same time
POLL_S = 0.1  # between two looks whether who waits for a turn is to stop


class Turns:
    """One at a time, in the order in which they asked: a lock alone would serve the same one again and again."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._queue: deque[object] = deque()

    @contextmanager
    def mine(self, check: Callable[[], object] = lambda: None) -> Iterator[None]:
        """Context of one's own turn. check: asked now and then while waiting; may raise to give up."""
        ticket = object()
        with self._changed:
            self._queue.append(ticket)
        try:
            with self._changed:
                while self._queue[0] is not ticket:
                    self._changed.wait(POLL_S)
                    check()
            yield
        finally:
            with self._changed:
                self._queue.remove(ticket)
                self._changed.notify_all()


class _Bounded(OrderedDict[ScanKey, tuple[bool, EdgePoints]]):
    def __setitem__(self, key: ScanKey, value: tuple[bool, EdgePoints]) -> None:
        super().__setitem__(key, value)
        while len(self) > SCANS_KEPT:
            self.popitem(last=False)


class SharedScans:
    """What is found out of the scans of one LiDAR: their edges, and how it moved from one to another."""

    def __init__(self) -> None:
        self._motions = Recent(SCANS_KEPT)
        self._edges: tuple[LidarConfig, ScanEdges] | None = None

    def edges(self, config: LidarConfig) -> ScanEdges | None:
        """None where those of several scans are put together, which each camera does at its own times."""
        if config.accumulate_s > 0:
            return None
        if self._edges is None or self._edges[0] != config:
            self._edges = config, _Bounded()
        return self._edges[1]

    def motion(
        self, before: PointCloud, cloud: PointCloud, seconds: float, config: MotionConfig, start: NDArray[np.float64] | None
    ) -> Motion:
        """See `estimate_motion`. What cameras differ in, their clocks, does not change it."""
        config = replace(config, time_offset_s=0.0, time_offset_sigma_s=MotionConfig.time_offset_sigma_s)
        key = (before, cloud, seconds, config)
        return self._motions(key, lambda: estimate_motion(before, cloud, seconds, config, start))


class Common:
    """Of all pipelines of a rig."""

    def __init__(self, config: OnlineConfig) -> None:
        self.purse = Purse(config)
        self.intake, self.estimates, self.classes = Turns(), Turns(), Turns()
        self.ingesters: list[Worker[Any]] = []
        self._round = 0  # stamp, ns
        self._models = Recent(1)
        self._scans: dict[str, SharedScans] = {}
        self._pictures: dict[str, Recent] = {}

    def scans(self, lidar: str) -> SharedScans:
        """Of a LiDAR by its name."""
        return self._scans.setdefault(lidar, SharedScans())

    def pictures(self, camera: str) -> Recent:
        """Edge maps of a camera's pictures, see `FeatureExtractor`."""
        return self._pictures.setdefault(camera, Recent(PICTURES_KEPT))

    def joins(self, stamp: int) -> bool:
        """Whether a pair may be taken in by the stamp of its scan, ns: all take in the same scans, one after the other, and only
        when all are done with one is the next chosen, by whoever comes first."""
        if not any(worker.busy for worker in self.ingesters):
            self._round = stamp
        return abs(stamp - self._round) <= ROUND_NS

    def models(self, config: SemanticsConfig) -> Segmentation:
        """Loaded once; for one at a time."""
        return self._models(config, lambda: models_of(config))
