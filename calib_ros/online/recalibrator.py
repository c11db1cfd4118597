"""What happens over time, without ROS: frames in, the current extrinsic out."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera
from calib_ros.config import Config, OnlineConfig
from calib_ros.config.online import CONTINUOUS, PERIODIC
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.lidar.range_image import require_returns
from calib_ros.online.keyframes import EgoMotion, KeyframeBuffer, KeyframeSelector, SpeedGate
from calib_ros.online.monitor import MOVED_AWAY, Monitor
from calib_ros.online.sensor_health import SensorHealth
from calib_ros.online.tracker import Tracker
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.constraints import SearchBox
from calib_ros.registration.features import Features
from calib_ros.result import INITIAL, INSUFFICIENT, Extrinsic, InitialSource, Result
from calib_ros.semantics.segmentation import ALL, CLASSES, CLOUD, IMAGE, Segmentation


# Semantics of keyframes: looked at once each, after the keyframe is in use already.
@dataclass(frozen=True, eq=False)
class SegmentedKeyframe:
    """What became of a keyframe: its features as they were and with semantics, None if no model saw anything. problems: a line
    for each model that failed."""

    plain: Features
    features: Features | None
    problems: tuple[str, ...]


class KeyframeSegmenter:
    """Keeps the newest keyframe until somebody has time for it: raw frames are large, and models slower than a drive."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: tuple[Frame, Features] | None = None
        self.done = 0  # keyframes with semantics so far
        self.seconds: dict[str, float] = {}  # that the models took for the last one, by their kind

    def put(self, frame: Frame, features: Features) -> None:
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

    def segment(
        self, calibrator: Calibrator, cancelled: Callable[[], bool], kinds: Sequence[str] = ALL
    ) -> SegmentedKeyframe | None:
        """Look at the one that waits; None if there is none. cancelled, kinds: see Segmentation."""
        with self._lock:
            waiting, self._waiting = self._waiting, None
        if waiting is None:
            return None
        frame, plain = waiting
        semantics = calibrator.segmentation(frame, cancelled, kinds)
        self.seconds = dict(semantics.seconds)
        if cancelled() or all(part is None for part in (semantics.edges, semantics.classes, semantics.labels)):
            return SegmentedKeyframe(plain, None, semantics.problems)
        features = calibrator.extract(frame, semantics, plain)
        self.done += 1
        return SegmentedKeyframe(plain, features, semantics.problems)


# The first extrinsic, where nothing but the classes of the scenes tells where the camera looks (thesis 3.5).
Progress = Callable[[str, float], None]


def first_extrinsic(
    calibrator: Calibrator, features: Sequence[Features], initial: Result, needed: int, progress: Progress | None
) -> Result:
    """Estimate from the classes of at least `needed` of the keyframes, or why there is none yet.

    initial: gives the names of the frames, and the extrinsic until there is a better one.
    """
    known, missing = len(calibrator.views(features)), calibrator.segmentation.missing(IMAGE, CLOUD)
    if known < needed:
        reason = missing if missing else f"waiting for the classes of keyframes, {known} of {needed}"
        reason = f"nothing is known of the extrinsic: {reason}"
        return replace(initial, status=INSUFFICIENT, reason=reason, frames_used=0)
    result = calibrator.guess(features, progress=progress)
    if not result.converged:
        result = replace(result, T_camera_lidar=initial.T_camera_lidar)
    return replace(result, camera_frame=initial.camera_frame, lidar_frame=initial.lidar_frame)


# When an estimate is made without anybody asking.


class Schedule:
    """online.mode over the data's own time stamps: the same recording gives the same estimates at any speed.

    config may be replaced at any time. Stamps are in ns.
    """

    def __init__(self, config: OnlineConfig) -> None:
        self.config = config
        self._newest: int | None = None
        self._estimated: int | None = None

    def saw(self, stamp: int) -> None:
        """A frame, keyframe or not, with its stamp."""
        self._newest = stamp

    def estimating(self) -> None:
        """An estimate begins, whoever asked for it: the next period counts from the newest frame."""
        self._estimated = self._newest

    @property
    def due(self) -> bool:
        """True if new keyframes are to be estimated now. Periodic: the first ones at once, as after a clock was set back."""
        if self.config.mode != PERIODIC:
            return self.config.mode == CONTINUOUS
        if self._newest is None or self._estimated is None:
            return True
        elapsed = (self._newest - self._estimated) / NANOSECONDS
        return elapsed < 0 or elapsed >= self.config.period_s


class LoadLimit:
    """online.max_load over the clock on the wall: how much of one core estimates made of their own accord may take.

    Times are in s of a clock that never runs back.
    """

    def __init__(self, config: OnlineConfig) -> None:
        self.config = config
        self._began = self._took = 0.0

    def worked(self, began: float, ended: float) -> None:
        """An estimate, on request or not, was made from `began` to `ended`."""
        self._began, self._took = began, max(ended - began, 0.0)

    def allows(self, now: float) -> bool:
        """True if the next one may begin; what a request asks for never waits."""
        return self._took == 0.0 or now - self._began >= self._took / self.config.max_load


BLIND_FRAMES = 2  # so many frames in a row that show nothing are told


class Recalibrator:
    """Keeps keyframe features in a ring buffer and the current extrinsic.

    ingest() and estimate() may be called from two threads: an estimate works on a copy of the buffer's references.
    """

    def __init__(
        self,
        camera: Camera,
        initial: NDArray[np.float64] | Result,
        config: Config | None = None,
        camera_frame: str = "camera",
        lidar_frame: str = "lidar",
        current: Result | None = None,
        speed_gate: SpeedGate | None = None,
        segmentation: Segmentation | None = None,
    ) -> None:
        """current: an estimate that is current already, where it is another than the initial extrinsic that reset() goes back to.
        speed_gate: one that somebody feeds with odometry. segmentation: the models, where they are loaded already."""
        self.config = config or Config()
        self.camera = camera
        start = initial if isinstance(initial, Result) else Result(initial, INITIAL, "no estimate yet")
        self.tracker = Tracker(replace(start, camera_frame=camera_frame, lidar_frame=lidar_frame), current, self.config)
        self.monitor, self.sensors = Monitor(self.config.monitor), SensorHealth(self.config.monitor)
        self.segmentation = segmentation or Segmentation(self.config.semantics)
        self._calibrator = Calibrator(camera, self.config, self.segmentation)
        self._making = threading.Lock()
        self.selector = KeyframeSelector(self.config.online)
        self.motion = EgoMotion(self.config.motion)
        self.speed_gate = speed_gate or SpeedGate(self.config.online)
        self.schedule = Schedule(self.config.online)
        self.keyframes = KeyframeBuffer(self.config.online.buffer_size)
        self._replaced = False  # the extrinsic by another than one near it, or the keyframes: what the monitor suspects is void
        self._blind_frames = 0
        self.segmenter = KeyframeSegmenter()
        # The extrinsic that stands in for one that nobody knows, and whether still nobody does.
        self._nominal = self.tracker.initial if start.origin is InitialSource.NOMINAL else None
        self._unknown = self._nominal is not None and self.config.semantics.first_guess
        self._estimated_at: int | None = None  # stamp of the newest keyframe in the last estimate
        self._lock = threading.Lock()

    @property
    def calibrator(self) -> Calibrator:
        """Of the current configuration. Made when it is needed: its look-up tables for the lens take up to 50 ms."""
        with self._making:
            config = self.config
            last = self._calibrator
            if replace(config, online=last.config.online) != last.config:
                self._calibrator = Calibrator(self.camera, config, self.segmentation)
            return self._calibrator

    @property
    def buffer(self) -> deque[Features]:
        """The keyframes, oldest first."""
        return self.keyframes.features

    @property
    def keyframes_seen(self) -> int:
        """How many there have been so far."""
        return self.keyframes.seen

    @property
    def current(self) -> Extrinsic:
        """The current extrinsic."""
        return self.tracker.current

    def ingest(self, frame: Frame) -> bool:
        """Offer a frame; True if it became a keyframe. Raises CalibrationError for a frame that cannot be used.

        The cloud is looked at in every frame: a LiDAR that dies beside a parked car must not go unnoticed.
        """
        sees = self._sees(frame)
        require_returns(frame.cloud)
        self.motion.add(frame)
        self.schedule.saw(frame.stamp)
        if not sees or not self.speed_gate.allows(frame) or not self.selector.select(frame.image, frame.stamp):
            return False
        with self._lock:
            generation = self.keyframes.generation
        try:
            moving = self.motion.completed(frame)
            if moving is not frame and not self.speed_gate.allows(moving):
                return False  # the selector goes on from this frame: scans in a turn are not aligned one by one
            features = self.calibrator.extract(moving)
        except Exception:
            self.selector.reset()  # the scene is still wanted: the next frame may show it with a good scan
            raise
        with self._lock:
            if generation == self.keyframes.generation:  # else: reset or configured meanwhile
                if self._unknown:  # classes may come for one keyframe in many, and a first guess needs several
                    self.keyframes.add(features, lambda f: bool(Calibrator.views([f])))
                else:
                    self.keyframes.add(features)
                if self.segments_keyframes:
                    self.segmenter.put(moving, features)
        self._guard()
        return True

    @property
    def segments_keyframes(self) -> bool:
        """True if there are models that look at keyframes."""
        return self.segmentation.active

    def segment_keyframe(self, cancelled: Callable[[], bool] = lambda: False) -> tuple[str, ...]:
        """Semantics of the newest keyframe, if nobody has looked at it yet; returns what went wrong, a line each.

        Takes seconds: to be called beside ingest() and estimate(), from a thread of its own. Estimates use a keyframe as it is
        until then. cancelled: see Segmentation.
        """
        looked = self.segmenter.segment(self.calibrator, cancelled, CLASSES if self._unknown else ALL)
        if looked is None:
            return ()
        if looked.features is not None:
            with self._lock:
                self.keyframes.exchange(looked.plain, looked.features)
                self.keyframes.new += self._unknown  # the classes are what the guess waits for
        return looked.problems

    def _sees(self, frame: Frame) -> bool:
        """Whether both sensors show something. One bad frame is passed over, more of them are told."""
        problem = self.sensors.check(frame)
        self._blind_frames = self._blind_frames + 1 if problem else 0
        if not problem or self._blind_frames >= BLIND_FRAMES:
            with self._lock:
                self.tracker.blinded(problem)
        return not problem

    def _guard(self) -> None:
        """Is the current extrinsic still right? If it has moved, keyframes from before say nothing any more."""
        if not self.config.monitor.enabled:
            return
        with self._lock:
            generation, tracker, keyframes = self.keyframes.generation, self.tracker, list(self.buffer)
            if self._replaced or not tracker.monitored or not keyframes:
                self.monitor.reset()
                self._replaced = False
            if not tracker.monitored or not keyframes:
                return
            T, spread, anchor = tracker.T, tracker.spread, tracker.initial.T_camera_lidar
        finding = self.monitor.check(self.calibrator, keyframes, T, spread, anchor)
        with self._lock:
            if generation != self.keyframes.generation or self._replaced:
                return
            if finding.verdict == MOVED_AWAY:
                self.keyframes.keep_newest(finding.since)
            elif finding.spoilt:
                self.keyframes.cut_out(finding.since, finding.spoilt)
            tracker.apply(finding)

    def newest(self) -> Features | None:
        """The newest keyframe."""
        with self._lock:
            return self.buffer[-1] if self.buffer else None

    def ready(self) -> bool:
        """True if there are new keyframes since the last estimate, enough of them, and online.mode says that it is time.

        Mode periodic does not wait while the calibration has moved: the current extrinsic is wrong.
        """
        with self._lock:
            config = self.config.online
            enough = self.keyframes.new > 0 and len(self.keyframes) >= config.min_keyframes
            due = self.schedule.due or (self.tracker.lost and config.mode == PERIODIC)
            return due and enough and not self.tracker.suspect

    def estimate(self, progress: Progress | None = None, force_search: bool = False) -> Extrinsic:
        """Joint estimate over the buffer (thesis eq. 3.16) and its way through the tracker's gate.

        Until two successive estimates agree, and on demand, the whole search box around the extrinsic is searched; then the
        current extrinsic is refined. A failure keeps the current extrinsic and says why in its status.
        """
        with self._lock:
            features, generation, fresh = list(self.buffer), self.keyframes.generation, self.keyframes.fresh
            self.keyframes.new = 0
            self.schedule.estimating()
        tracker, config = self.tracker, self.config.search
        if not features:
            return self._accept(Result(tracker.T, INSUFFICIENT, "no keyframe yet: wait for images and clouds"), generation)
        if self._unknown:
            result = first_extrinsic(*(self.calibrator, features, tracker.initial, self.config.online.min_keyframes, progress))
            with self._lock:
                if result.converged and generation == self.keyframes.generation:
                    self.tracker = Tracker(replace(result, status=INITIAL, covariance=None), None, self.config)
                    self._unknown = False
            return self._accept(result, generation, features, fresh)
        box = None
        if force_search or not tracker.settled:
            # Who asks may have to wait; else the next keyframe gives another chance, and a better one.
            rounds = None if force_search else self.config.online.search_rounds
            box = SearchBox(config.rotation_deg, config.translation_m, rounds)
        start = tracker.search_center if box is not None and not force_search else tracker.T
        names = tracker.initial
        # What is known beforehand counts from the initial extrinsic: from the current one it would creep along.
        result = self.calibrator.estimate(features, start, box, progress, anchor=names.T_camera_lidar)
        result = replace(result, camera_frame=names.camera_frame, lidar_frame=names.lidar_frame)
        return self._accept(result, generation, features, fresh, force_search)

    def _accept(
        self, result: Result, generation: int, features: Sequence[Features] = (), fresh: int = 0, asked: bool = False
    ) -> Extrinsic:
        """fresh: of the features, how many no estimate taken in rests on yet."""
        with self._lock:
            if generation != self.keyframes.generation:  # reset, configured or moved while estimating: the estimate is void
                return self.tracker.current
            seconds = 0.0
            if features:
                newest = features[-1].stamp
                seconds = 0.0 if self._estimated_at is None else (newest - self._estimated_at) / NANOSECONDS
                self._estimated_at = newest
            accepted = self.tracker.current.accepted
            extrinsic = self.tracker.update(
                result, min(fresh / max(len(features), 1), 1.0), seconds, asked, whole=not self.keyframes.gone
            )
            if extrinsic.accepted > accepted:
                self.keyframes.fresh -= fresh
                self._replaced = self._replaced or asked
            return extrinsic

    def reset(self) -> None:
        """Forget all keyframes, and what the sensors usually show, and go back to the initial extrinsic."""
        with self._lock:
            self._forget_keyframes()
            self.sensors = SensorHealth(self.config.monitor)
            self.tracker.reset()
            if self._nominal is not None and self.config.semantics.first_guess:
                self.tracker, self._unknown = Tracker(self._nominal, None, self.config), True

    def configure(self, config: Config) -> None:
        """Use other constants from now on. Keyframes stay unless their features would now look different."""
        features_changed = _what_features_rest_on(config) != _what_features_rest_on(self.config)
        with self._lock:
            if config.semantics != self.config.semantics:  # else the models stay loaded
                self.segmentation = Segmentation(config.semantics)
            self.config = config
            untouched = self._nominal is not None and not self.tracker.current.accepted
            self._unknown = config.semantics.first_guess and (self._unknown or untouched)
            self.selector.config = self.schedule.config = self.speed_gate.config = config.online
            self.motion.config = config.motion
            self.monitor.config = self.sensors.config = config.monitor
            self.tracker.config = config
            self.keyframes.resize(config.online.buffer_size)
            if not config.monitor.enabled:
                self._replaced = True
                self.tracker.stop_monitoring()
            if features_changed:
                self._forget_keyframes()

    def _forget_keyframes(self) -> None:
        """With the lock held. What is extracted or estimated right now from the old ones is void."""
        self.keyframes.forget()
        self._replaced = True  # what the monitor suspects rests on them
        self.segmenter.forget()
        self.selector.reset()


def _what_features_rest_on(config: Config) -> tuple[object, ...]:
    # How fast models run, and where, does not change what they see.
    semantics = replace(config.semantics, threads=1, budget_s=1.0, provider="cpu", first_guess=False)
    return config.image, config.lidar, config.motion, config.score, config.thesis, semantics, config.refine.objective
