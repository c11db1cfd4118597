"""Semantics of keyframes: segmented once each by the configured models, after the keyframe is in use already."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from functools import reduce

import numpy as np

from calib_ros.arrays import Transform
from calib_ros.frame import Frame
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.classes import ALL, Segmentation
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.frames import points_in_reach
from calib_ros.registration.search.constraints import SearchBox


class KeyframeSegmenter:
    """A queue of one keyframe for the models: raw frames are large, and models slower than a drive. Thread-safe.

    done: keyframes with semantics so far. seconds: that the models took for the last one, by their kind.
    """

    def __init__(self) -> None:
        self.done = 0
        self.seconds: dict[str, float] = {}
        self._lock = threading.Lock()
        self._waiting: tuple[Frame, FrameFeatures] | None = None

    def put(self, frame: Frame, features: FrameFeatures) -> None:
        """Add a new keyframe; one that still waits is dropped."""
        with self._lock:
            self._waiting = (frame, features)

    def clear(self) -> None:
        """Drop the keyframe that waits."""
        with self._lock:
            self._waiting = None

    def segment(
        self,
        calibrator: Calibrator,
        cancelled: Callable[[], bool],
        kinds: Sequence[str] = ALL,
        around: Sequence[tuple[Transform, SearchBox]] = (),
    ) -> tuple[FrameFeatures, FrameFeatures | None, tuple[str, ...]] | None:
        """Segment the keyframe that waits: its features before, and with semantics if a model recognised something, and a line
        for each model that failed; None if none waits. cancelled, kinds: see Segmentation. around: extrinsics (4, 4) and how far
        off each may be; points that come into view nowhere there need no classes. Empty = nothing is known."""
        with self._lock:
            waiting, self._waiting = self._waiting, None
        if waiting is None:
            return None
        frame, plain = waiting
        reached = [points_in_reach(frame, calibrator.extract, T, box) for T, box in around]
        points = reduce(np.union1d, reached) if reached else None
        semantics = calibrator.segmentation(frame, cancelled, kinds, points)
        self.seconds = dict(semantics.seconds)
        if cancelled() or all(part is None for part in (semantics.edges, semantics.classes, semantics.labels)):
            return plain, None, semantics.problems
        features = calibrator.extract(frame, semantics, plain)
        self.done += 1
        return plain, features, semantics.problems

    def describe(self, segmentation: Segmentation) -> str:
        """Progress, failures, and the weights in use, for people."""
        models = segmentation.describe()
        if not models:
            return "none: no models are configured"
        took = [f"{kind} {seconds:.1f} s" for kind, seconds in self.seconds.items()]
        return "; ".join([f"{self.done} keyframes", *took, *models])
