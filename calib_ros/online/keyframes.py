"""Which frames are worth keeping: scene selection by histogram similarity (thesis 3.6, eq. 3.15, algorithm 6)."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.config import MotionConfig, OnlineConfig
from calib_ros.errors import MissingDependencyError
from calib_ros.frame import NANOSECONDS, Frame, PointCloud
from calib_ros.lidar.ego_motion import Motion, estimate_motion, needs_ego_motion
from calib_ros.registration.features import Features

Histogram = NDArray[np.float32]


def histogram(image: NDArray[np.uint8]) -> Histogram:
    """Image (H, W) or (H, W, 3) uint8 -> share of pixels per brightness and channel, (channels, 256) float32.

    Every second pixel of every second row is counted: the shares do not change, the time does.
    """
    part = np.ascontiguousarray(image[::2, ::2])
    channels = 1 if part.ndim == 2 else part.shape[2]
    counts = [cv2.calcHist([part], [k], None, [256], [0, 256]).ravel() for k in range(channels)]
    return np.asarray(np.stack(counts) / (part.shape[0] * part.shape[1]), np.float32)


def similarity(first: Histogram, second: Histogram) -> float:
    """Intersection over union of two histograms, eq. 3.15, averaged over the channels.

    The thesis sums the channels and says the ratio lies in 0..1; only their mean does. A grey and a colour image (different
    numbers of channels) are entirely different: 0.
    """
    if first.shape != second.shape:
        return 0.0
    common = np.minimum(first, second).sum(axis=1)
    union = first.sum(axis=1) + second.sum(axis=1) - common
    return float(np.mean(common / np.maximum(union, 1e-12)))


class KeyframeSelector:
    """Algorithm 6, one image at a time, with a spread over time where too few images differ enough."""

    def __init__(self, config: OnlineConfig) -> None:
        self.config = config
        self.last_similarity = 0.0
        self._histogram: Histogram | None = None
        self._stamp = 0

    def reset(self) -> None:
        """The next image starts a new series."""
        self._histogram = None

    def select(self, image: NDArray[np.uint8], stamp: int) -> bool:
        """True if the image (stamp in ns) is a keyframe; it is then what the next ones are compared with."""
        return self.select_histogram(histogram(image), stamp)

    def select_histogram(self, new: Histogram, stamp: int) -> bool:
        """The same of an image's histogram."""
        last = self._histogram  # reset() may come from another thread
        if last is not None:
            self.last_similarity = similarity(last, new)
            elapsed = (stamp - self._stamp) / NANOSECONDS
            if 0 <= elapsed < self.config.keyframe_spacing_s:
                return False
            overdue = elapsed >= self.config.keyframe_interval_s or elapsed < 0  # the clock was set back
            changed = self.last_similarity < self.config.static_similarity
            if not (changed and (overdue or self.last_similarity < self.config.similarity_threshold)):
                return False
        self._histogram, self._stamp = new, stamp
        return True


# The ring buffer of keyframes, and what estimates rest on which of them.
class KeyframeBuffer:
    """Features of the newest keyframes. Not thread-safe: its owner holds a lock.

    features: oldest first. seen: keyframes so far. new: those since the last estimate. fresh: those that no estimate rests on
    that was taken in. generation: rises when the keyframes are of a new beginning, so that what was made of the old ones is
    void. gone: keyframes that the current extrinsic rests on have left.
    """

    def __init__(self, size: int) -> None:
        self.features: deque[Features] = deque(maxlen=size)
        self.seen = self.new = self.fresh = self.generation = 0
        self.gone = False

    def __len__(self) -> int:
        return len(self.features)

    def add(self, features: Features, keep: Callable[[Features], bool] = lambda features: False) -> None:
        """A new keyframe; if there is no room the oldest leaves, or the oldest that is not to be kept if there is one."""
        if len(self.features) == self.features.maxlen:
            self.gone = True
            given_up = next((k for k, f in enumerate(self.features) if not keep(f)), 0)
            del self.features[given_up]
        self.features.append(features)
        self.new += 1
        self.fresh += 1
        self.seen += 1

    def exchange(self, before: Features, after: Features) -> None:
        """Other features of the same keyframe, if it has not left meanwhile."""
        self.features = deque((after if f is before else f for f in self.features), self.features.maxlen)

    def keep_newest(self, count: int) -> None:
        """The extrinsic has changed: only the newest keyframes are of the one that holds now."""
        self.generation += 1
        self.features = deque(list(self.features)[-count:], self.features.maxlen)
        self.new = self.fresh = len(self.features)
        self.gone = False

    def cut_out(self, since: int, count: int) -> None:
        """Take `count` keyframes out, of which the first is the since-th newest."""
        kept = list(self.features)
        del kept[len(kept) - since : len(kept) - since + count]
        self.features = deque(kept, self.features.maxlen)

    def resize(self, size: int) -> None:
        """Room for so many; the oldest leave if there are more."""
        self.features = deque(self.features, size)

    def forget(self) -> None:
        """All of them, and what was estimated from them."""
        self.generation += 1
        self.features.clear()
        self.new = self.fresh = 0
        self.gone = True


# Frames taken while the vehicle drives or turns too fast to be keyframes.
MAX_AGE_S = 0.5  # a measurement farther than this from a frame's stamp says nothing about it


@dataclass(frozen=True)
class Measured:
    """What odometry or an IMU said last. stamp: ns. speed: m/s, turn_rate: deg/s, None = this source does not tell."""

    stamp: int
    speed: float | None
    turn_rate: float | None


class SpeedGate:
    """Judges each frame by the newest measurement if that is of its time, else by the twist that the frame carries.

    For several threads at once. config may be replaced at any time. refused: frames turned away so far. last_refusal: why the
    newest of them was, in words.
    """

    def __init__(self, config: OnlineConfig) -> None:
        self.config = config
        self.newest: Measured | None = None
        self.refused = 0
        self.last_refusal = ""
        self._lock = threading.Lock()

    def measured(self, stamp: int, speed: float | None, turn_rate: float | None) -> None:
        """A measurement: stamp in ns, m/s and deg/s; what is None or not finite is not known."""
        known = [None if value is None or not math.isfinite(value) else abs(value) for value in (speed, turn_rate)]
        self.newest = Measured(stamp, known[0], known[1])

    def allows(self, frame: Frame) -> bool:
        """True if the frame is slow enough for a keyframe, or nothing tells how fast it is."""
        speed, turn_rate = self.motion_at(frame)
        problem = ""
        if speed is not None and speed > self.config.max_speed:
            problem = f"{speed:.1f} m/s are above online.max_speed = {self.config.max_speed:g}"
        elif turn_rate is not None and turn_rate > self.config.max_turn_deg_s:
            problem = f"{turn_rate:.1f} deg/s are above online.max_turn_deg_s = {self.config.max_turn_deg_s:g}"
        if problem:
            with self._lock:
                self.refused += 1
                self.last_refusal = problem
        return not problem

    def motion_at(self, frame: Frame) -> tuple[float | None, float | None]:
        """Speed, m/s, and turn rate, deg/s, at a frame; None where nothing tells."""
        measured, speed, turn_rate = self.newest, None, None
        if measured is not None and abs(measured.stamp - frame.stamp) <= MAX_AGE_S * NANOSECONDS:
            speed, turn_rate = measured.speed, measured.turn_rate
        if frame.twist is not None:
            speed = float(np.linalg.norm(frame.twist[3:])) if speed is None else speed
            turn_rate = float(np.rad2deg(np.linalg.norm(frame.twist[:3]))) if turn_rate is None else turn_rate
        return speed, turn_rate


# The LiDAR's velocity over time: each cloud offered is kept until the next one, for a keyframe that no odometry comes with.
Stamped = tuple[int, PointCloud]


class EgoMotion:
    """Not for several threads at once. config may be replaced at any time.

    last: what the last estimate said, None before the first. missing: a line for a person if small_gicp is, else "".
    """

    def __init__(self, config: MotionConfig) -> None:
        self.config = config
        self.last: Motion | None = None
        self.missing = ""
        self._before: Stamped | None = None
        self._newest: Stamped | None = None

    def add(self, frame: Frame) -> None:
        """Every frame, in the order of time. Keeps references to two clouds, and costs nothing."""
        usable = frame.cloud_stamp is not None and not frame.compensated
        self._before, self._newest = self._newest, (frame.cloud_stamp or 0, frame.cloud) if usable else None

    def completed(self, frame: Frame) -> Frame:
        """The frame offered last, with its twist if it has none and the cloud before tells it; 50 ms for 130 000 points."""
        before, stamp = self._before, frame.cloud_stamp
        if self.missing or before is None or stamp is None or not needs_ego_motion(frame, self.config):
            return frame
        start = None if self.last is None else self.last.twist
        try:
            self.last = estimate_motion(before[1], frame.cloud, (stamp - before[0]) / NANOSECONDS, self.config, start)
        except MissingDependencyError as error:
            self.missing = f"scans are not corrected for the vehicle's motion: {error}"
            return frame
        return frame if self.last.twist is None else replace(frame, twist=self.last.twist)
