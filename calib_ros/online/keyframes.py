"""Which frames become keyframes, and the ring buffer that holds their features.

Scene selection by histogram similarity (thesis 3.6, eq. 3.15, algorithm 6), a gate on the vehicle's speed, and the LiDAR's motion
from scan to scan for keyframes that come without odometry.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.config import Config, MotionConfig, OnlineConfig, TrackerConfig
from calib_ros.errors import BadTimesError, MissingDependencyError
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.lidar.accumulation import Accumulator, Stamped
from calib_ros.lidar.ego_motion import MAX_GAP_S, ROAD_SPEED, Motion, estimate_motion, unknown_motion_s, without_motion
from calib_ros.online.pacing import is_due
from calib_ros.registration.features import FrameFeatures

INTERVAL_S = 1.0  # without a keyframe, after which any image that has changed becomes one
STATIC_SIMILARITY = 0.995  # images more similar show the same scene and never become a keyframe
REMEMBERED_S = 3.0  # a vehicle that moved so long ago may still move
MAX_MEASUREMENT_AGE_S = 0.5  # a measurement farther than this from a frame's stamp says nothing about the frame

Histogram = NDArray[np.float32]

ScanBefore = Callable[[int], Stamped | None]
Permit = Callable[[], bool]


class KeyframeSelector:
    """Algorithm 6, one image at a time, with a minimum rate of keyframes where too few images differ enough.

    config may be replaced at any time. last_similarity: of the newest image with the last keyframe, eq. 3.15. in_step: with other
    cameras, so that keyframes come of the same scans where pictures allow it, see `is_due`.
    """

    def __init__(self, config: OnlineConfig, in_step: bool = False) -> None:
        self.config, self._in_step = config, in_step
        self.last_similarity = 0.0
        self._histogram: Histogram | None = None
        self._stamp = 0

    def reset(self) -> None:
        """Start a new series: the next image is a keyframe."""
        self._histogram = None

    def select(self, image: NDArray[np.uint8], stamp: int, permit: Permit = lambda: True, spacing_s: float = 0.0) -> bool:
        """True if the image (stamp in ns) is a keyframe; the next images are then compared with it.

        permit: asked only about an image that is to be a keyframe; where it refuses, the next image is as good. spacing_s:
        smallest time between keyframes, where that is longer than the configured one.
        """
        last = self._histogram  # reset() may come from another thread
        spacing_s = max(self.config.keyframe_spacing_s, spacing_s)
        if last is not None and not is_due(self._stamp, stamp, spacing_s, self._in_step):
            return False  # nobody needs to look at it
        new = histogram(image)
        if last is not None:
            self.last_similarity = similarity(last, new)
            overdue = is_due(self._stamp, stamp, INTERVAL_S, self._in_step)
            changed = self.last_similarity < STATIC_SIMILARITY
            if not (changed and (overdue or self.last_similarity < self.config.similarity_threshold)):
                return False
        if not permit():
            return False
        self._histogram, self._stamp = new, stamp
        return True


class Batch(NamedTuple):
    """Keyframes of an estimate, oldest first. new: keyframes since the one before. unfused: how many of the buffer are in no
    accepted estimate yet. share_new: how many of the estimate's own."""

    features: Sequence[FrameFeatures]
    generation: int
    new: int
    unfused: int
    share_new: float


class KeyframeBuffer:
    """Features of the newest keyframes, and which estimates rest on which of them. Not thread-safe: its owner holds a lock.

    features: oldest first. seen: keyframes so far. new: keyframes since the last estimate. unfused: keyframes that no accepted
    estimate rests on. generation: rises when the keyframes start anew, which voids whatever was computed from the old ones.
    incomplete: keyframes that the current extrinsic rests on have left the buffer.
    """

    def __init__(self, size: int) -> None:
        self.features: deque[FrameFeatures] = deque(maxlen=size)
        self.seen = self.new = self.unfused = self.generation = 0
        self.incomplete = False
        self._enough: tuple[tuple[object, ...], bool] | None = None  # the last answer, and of what

    def __len__(self) -> int:
        return len(self.features)

    def add(self, features: FrameFeatures, keep: Callable[[FrameFeatures], bool] = lambda features: False) -> None:
        """Append a keyframe. A full buffer drops its oldest one that is not to be kept, or its oldest if all are."""
        if len(self.features) == self.features.maxlen:
            self.incomplete = True
            dropped = next((k for k, f in enumerate(self.features) if not keep(f)), 0)
            del self.features[dropped]
        self.features.append(features)
        self.new += 1
        self.unfused += 1
        self.seen += 1

    def newest_among(self, chosen: Sequence[FrameFeatures], count: int) -> int:
        """How many of the newest `count` keyframes are among the chosen ones."""
        ids = set(map(id, chosen))
        return sum(id(own) in ids for own in list(self.features)[-count:]) if count > 0 else 0

    def enough(self, least: int, extrinsic: object, informative: Callable[[], list[FrameFeatures]]) -> bool:
        """Whether there are at least so many informative keyframes, new ones among them. extrinsic: that they are informative at.
        What is the same as before is not counted anew: an estimate that waits for the budget asks at every frame."""
        state = self.generation, self.seen, self.new, least, extrinsic
        if self._enough is None or self._enough[0] != state:
            chosen = informative()
            self._enough = state, len(chosen) >= least and self.newest_among(chosen, self.new) > 0
        return self._enough[1]

    def per_s(self, now: int | None) -> float:
        """New keyframes per second from the oldest one kept until now, ns; 0 = unknown."""
        elapsed = (now - self.features[0].stamp) / NANOSECONDS if now is not None and len(self.features) > 1 else 0.0
        return (len(self.features) - 1) / elapsed if elapsed > 0 else 0.0

    def batch(self, chosen: Sequence[FrameFeatures]) -> Batch:
        """The chosen keyframes, for an estimate that begins now."""
        new, self.new = self.new, 0
        share_new = min(self.newest_among(chosen, self.unfused) / max(len(chosen), 1), 1.0)
        return Batch(chosen, self.generation, new, self.unfused, share_new)

    def replace(self, before: FrameFeatures, after: FrameFeatures) -> None:
        """Put other features in the place of a keyframe's, if it is still there."""
        self.features = deque((after if f is before else f for f in self.features), self.features.maxlen)

    def change(self, change: Callable[[FrameFeatures], FrameFeatures]) -> None:
        """Put other features in the place of every keyframe's. What is being computed from the old ones becomes void."""
        self.generation += 1
        self.features = deque(map(change, self.features), self.features.maxlen)

    def keep_newest(self, count: int) -> None:
        """Drop all but the newest keyframes: the extrinsic has changed, and the older ones belong to the one before."""
        self.generation += 1
        self.features = deque(list(self.features)[-count:], self.features.maxlen)
        self.new = self.unfused = len(self.features)
        self.incomplete = False

    def remove(self, since: int, count: int) -> None:
        """Remove `count` keyframes, the first of which is the since-th newest; the oldest of them may have left the buffer."""
        kept = list(self.features)
        first = len(kept) - since
        del kept[max(first, 0) : max(first + count, 0)]
        self.features = deque(kept, self.features.maxlen)

    def drop(self, unwanted: Callable[[FrameFeatures], bool]) -> None:
        """Remove keyframes that should not have been taken. What is being computed from them becomes void."""
        kept = [not unwanted(f) for f in self.features]
        if all(kept):
            return
        self.generation += 1
        first_new, first_unfused = len(kept) - self.new, len(kept) - self.unfused
        self.new -= kept[max(first_new, 0) :].count(False)
        self.unfused -= kept[max(first_unfused, 0) :].count(False)
        self.features = deque((f for f, keep in zip(self.features, kept, strict=True) if keep), self.features.maxlen)

    def resize(self, size: int) -> None:
        """Change the capacity; the oldest keyframes leave if there are more."""
        self.features, self._enough = deque(self.features, size), None

    def clear(self) -> None:
        """Drop all keyframes."""
        self.generation += 1
        self.features.clear()
        self.new = self.unfused = 0
        self.incomplete = True


class SpeedGate:
    """Rejects frames taken while the vehicle drives or turns too fast for a keyframe.

    Uses the newest measurement if it is of the frame's time, else the twist that the frame carries. Measurements may come on
    another thread than frames. config may be replaced at any time. newest: stamp, ns, speed, m/s, and turn rate, deg/s, of
    odometry or an IMU, None if the source lacks it. rejected: frames rejected so far. last_rejection: why the newest of them was,
    for a person.
    """

    def __init__(self, config: OnlineConfig) -> None:
        self.config = config
        self.newest: tuple[int, float | None, float | None] | None = None
        self.rejected = 0
        self.last_rejection = ""

    def add_measurement(self, stamp: int, speed: float | None, turn_rate: float | None) -> None:
        """A measurement: stamp in ns, m/s and deg/s; None and values that are not finite are unknown."""
        known = [None if value is None or not math.isfinite(value) else abs(value) for value in (speed, turn_rate)]
        self.newest = stamp, known[0], known[1]

    def allows(self, frame: Frame) -> bool:
        """True if the frame is slow enough for a keyframe, or its speed is unknown."""
        speed, turn_rate = self.motion_at(frame)
        problem = ""
        if speed is not None and speed > ROAD_SPEED:
            problem = f"{speed:.1f} m/s are too fast for a keyframe, at most {ROAD_SPEED:g} are allowed"
        elif turn_rate is not None and turn_rate > self.config.max_turn_deg_s:
            problem = f"{turn_rate:.1f} deg/s are above online.max_turn_deg_s = {self.config.max_turn_deg_s:g}"
        if problem:
            self.rejected, self.last_rejection = self.rejected + 1, problem
        return not problem

    def motion_at(self, frame: Frame) -> tuple[float | None, float | None]:
        """Speed, m/s, and turn rate, deg/s, at a frame; None where unknown."""
        measured, speed, turn_rate = self.newest, None, None
        if measured is not None and abs(measured[0] - frame.stamp) <= MAX_MEASUREMENT_AGE_S * NANOSECONDS:
            _, speed, turn_rate = measured
        if frame.twist is not None:
            speed = float(np.linalg.norm(frame.twist[3:])) if speed is None else speed
            turn_rate = float(np.rad2deg(np.linalg.norm(frame.twist[:3]))) if turn_rate is None else turn_rate
        return speed, turn_rate


class EgoMotion:
    """Twist of the LiDAR from scan to scan, for keyframes that come without odometry. Not thread-safe.

    config may be replaced at any time. last: the last estimate, None before the first. missing: a line for a person if
    small_gicp is not installed, else "". left_out: keyframes that were given up, see `unknown_s`. estimate: that of
    `estimate_motion`, or one that remembers.
    """

    def __init__(
        self, config: MotionConfig, accumulate_s: float = 0.0, estimate: Callable[..., Motion] = estimate_motion
    ) -> None:
        self.config, self.accumulate_s, self._estimate = config, accumulate_s, estimate
        self._scans: deque[Stamped] = deque()  # of the last accumulate_s, oldest first
        self._accumulator = Accumulator()
        self.last: Motion | None = None
        self.left_out = 0
        self._known: tuple[int, NDArray[np.float64]] | None = None  # stamp and twist, the newest
        self.missing = ""
        self._before: Stamped | None = None
        self._newest: Stamped | None = None

    def add(self, frame: Frame) -> None:
        """Every frame, in the order of time. Keeps references to two clouds and those of accumulate_s, and costs nothing."""
        own = frame.cloud_stamp or 0, frame.cloud
        usable = frame.cloud_stamp is not None and not frame.compensated
        self._before, self._newest = self._newest, own if usable else None
        oldest = own[0] - round(self.accumulate_s * NANOSECONDS)
        while self._scans and not oldest < self._scans[0][0] < own[0]:  # also where time goes back
            self._scans.popleft()
        if self.accumulate_s > 0 and frame.cloud_stamp is not None:
            self._scans.append(own)

    def accumulated(self, frame: Frame) -> Frame:
        """The newest frame with the scans of the last accumulate_s, see `Accumulator`."""
        if self.missing or not self._scans:
            return frame
        try:
            return self._accumulator(frame, list(self._scans)[-2::-1], self.accumulate_s, self.config)
        except MissingDependencyError as error:
            self.missing = f"scans are not put together: {error}"
            return frame

    def with_twist(self, frame: Frame, scan_before: ScanBefore = lambda since: None) -> Frame:
        """The newest frame with its twist, if it has none and the cloud before allows an estimate; 50 ms for 130 000 points.

        scan_before: gives the scan before the frame's if it is newer than a stamp, where frames between have been dropped.
        """
        stamp = frame.cloud_stamp
        if self.missing or stamp is None or without_motion(frame, self.config):
            return frame
        since = round(stamp - MAX_GAP_S * NANOSECONDS)
        if self._before is not None and self._before[0] < stamp:
            since = max(since, self._before[0])
        before = scan_before(since) or self._before
        if before is None:
            return frame
        start = None if self.last is None else self.last.twist
        try:
            self.last = self._estimate(before[1], frame.cloud, (stamp - before[0]) / NANOSECONDS, self.config, start)
        except MissingDependencyError as error:
            self.missing = f"scans are not corrected for the vehicle's motion: {error}"
            return frame
        if self.last.twist is None:
            return frame
        self._known = (stamp, self.last.twist)
        return replace(frame, twist=self.last.twist)

    def moves_in(self, seconds: float, limits: TrackerConfig) -> bool:
        """Whether the vehicle, by what is known of it, moves by more in `seconds` than a converged extrinsic may be off."""
        if self._known is None:
            return False
        turn, way = (seconds * float(np.linalg.norm(part)) for part in (self._known[1][:3], self._known[1][3:]))
        return turn > np.deg2rad(limits.max_sigma_deg) or way > limits.max_sigma_m

    def moved_unknown(self, keyframe: FrameFeatures, limits: TrackerConfig) -> bool:
        """Whether a keyframe of unknown motion was taken shortly before it became known that the vehicle moves."""
        if self._known is None or not self.moves_in(keyframe.unknown_motion_s, limits):
            return False
        return 0 <= self._known[0] - keyframe.stamp <= REMEMBERED_S * NANOSECONDS

    def unknown_s(self, frame: Frame, T: NDArray[np.float64], limits: TrackerConfig) -> float:
        """For how long the motion of a frame seen at T (4, 4) is unknown, see `unknown_motion_s`. BadTimesError if it is although
        the vehicle moved shortly before, meanwhile by more than a converged extrinsic may be off: nobody knows how the scan is
        bent."""
        stamp, seconds = frame.cloud_stamp, unknown_motion_s(frame, T, self.config)
        if stamp is None or self._known is None or not self.moves_in(seconds, limits):
            return seconds
        since, twist = (stamp - self._known[0]) / NANOSECONDS, self._known[1]
        if 0 <= since <= REMEMBERED_S:
            self.left_out += 1
            speed, rate = np.linalg.norm(twist[3:]), np.rad2deg(np.linalg.norm(twist[:3]))
            reason = self.last.reason if self.last is not None and self.last.twist is None else "the scan before is missing"
            raise BadTimesError(
                f"keyframe left out: the vehicle moved at {speed:.1f} m/s and {rate:.1f} deg/s {since:.1f} s ago, and its motion "
                f"now is unknown ({reason}); if this lasts, the LiDAR's messages get lost"
            )
        return seconds


def feature_config(config: Config) -> tuple[object, ...]:
    """What features depend on; how fast models run, and where, does not change what they recognise."""
    semantics = replace(config.semantics, threads=1, budget_s=1.0, provider="cpu")
    return config.image, config.lidar, config.motion, config.score, config.others, semantics, config.refine.objective


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
