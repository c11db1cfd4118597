"""Semantics of keyframes: looked at once each, after the keyframe is in use already."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from calib_ros.frame import Frame
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import Features
from calib_ros.semantics.segmentation import ALL, Segmentation


@dataclass(frozen=True, eq=False)
class Looked:
    """What became of a keyframe: its features as they were and with semantics, None if no model saw anything. problems: a line
    for each model that failed."""

    plain: Features
    features: Features | None
    problems: tuple[str, ...]


class Looker:
    """Keeps the newest keyframe until somebody has time for it: raw frames are large, and models slower than a drive."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: tuple[Frame, Features] | None = None
        self.done = 0  # keyframes with semantics so far
        self.seconds: dict[str, float] = {}  # that the models took for the last one, by their kind

    def offer(self, frame: Frame, features: Features) -> None:
        """A new keyframe; one that waits is given up."""
        with self._lock:
            self._waiting = (frame, features)

    def forget(self) -> None:
        """The one that waits is of no use any more."""
        with self._lock:
            self._waiting = None

    def describe(self, segmentation: Segmentation) -> str:
        """How it goes, for people."""
        if not segmentation.models:
            return "none: no models are configured"
        off = [f"{model.kind} is off" for model in segmentation.models if model.off]
        took = [f"{kind} {seconds:.1f} s" for kind, seconds in self.seconds.items()]
        return "; ".join([f"{self.done} keyframes", *took, *off])

    def look(self, calibrator: Calibrator, cancelled: Callable[[], bool], kinds: Sequence[str] = ALL) -> Looked | None:
        """Look at the one that waits; None if there is none. cancelled, kinds: see Segmentation."""
        with self._lock:
            waiting, self._waiting = self._waiting, None
        if waiting is None:
            return None
        frame, plain = waiting
        seen = calibrator.segmentation(frame, cancelled, kinds)
        self.seconds = dict(seen.seconds)
        if cancelled() or all(part is None for part in (seen.edges, seen.classes, seen.labels)):
            return Looked(plain, None, seen.problems)
        features = calibrator.extract(frame, seen, plain)
        self.done += 1
        return Looked(plain, features, seen.problems)
