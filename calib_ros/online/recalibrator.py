"""What happens over time, without ROS: frames in, the current extrinsic out."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera
from calib_ros.config import Config
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.lidar.scan import require_returns
from calib_ros.online.ego_motion import EgoMotion
from calib_ros.online.extrinsic import Extrinsic
from calib_ros.online.keyframes import KeyframeSelector
from calib_ros.online.monitor import MOVED_AWAY, Monitor
from calib_ros.online.schedule import PERIODIC, Schedule
from calib_ros.online.sensors import SensorWatch
from calib_ros.online.speed_gate import SpeedGate
from calib_ros.online.tracker import Tracker
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import Features
from calib_ros.registration.search_box import SearchBox
from calib_ros.result import INITIAL, INSUFFICIENT, Result

Progress = Callable[[str, float], None]
BLIND_FRAMES = 2  # so many frames in a row that show nothing are told


class Recalibrator:
    """Keeps keyframe features in a ring buffer and the extrinsic in force.

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
    ) -> None:
        """current: an estimate in force already, where it is another than the initial extrinsic that reset() goes back to.
        speed_gate: one that somebody feeds with odometry."""
        self.config = config or Config()
        self.camera = camera
        start = initial if isinstance(initial, Result) else Result(initial, INITIAL, "no estimate yet")
        self.tracker = Tracker(replace(start, camera_frame=camera_frame, lidar_frame=lidar_frame), current, self.config)
        self.monitor, self.sensors = Monitor(self.config.monitor), SensorWatch(self.config.monitor)
        self._calibrator = Calibrator(camera, self.config)
        self._making = threading.Lock()
        self.selector = KeyframeSelector(self.config.online)
        self.motion = EgoMotion(self.config.motion)
        self.speed_gate = speed_gate or SpeedGate(self.config.online)
        self.schedule = Schedule(self.config.online)
        self.buffer: deque[Features] = deque(maxlen=self.config.online.buffer_size)
        self.keyframes_seen = 0
        self._new_keyframes = 0  # since the last estimate
        self._fresh = 0  # keyframes that no estimate rests on that was taken in
        self._generation = 0
        self._replaced = False  # the extrinsic by another than one near it, or the keyframes: what the monitor suspects is void
        self._blind_frames = 0
        self._gone = False  # keyframes that the extrinsic in force rests on have left the buffer
        self._estimated_at: int | None = None  # stamp of the newest keyframe in the last estimate
        self._lock = threading.Lock()

    @property
    def calibrator(self) -> Calibrator:
        """Of the configuration in force. Made when it is needed: its look-up tables for the lens take up to 50 ms."""
        with self._making:
            config = self.config
            if replace(config, online=self._calibrator.config.online) != self._calibrator.config:
                self._calibrator = Calibrator(self.camera, config)
            return self._calibrator

    @property
    def current(self) -> Extrinsic:
        """The extrinsic in force."""
        return self.tracker.current

    def ingest(self, frame: Frame) -> bool:
        """Offer a frame; True if it became a keyframe. Raises CalibrationError for a frame that cannot be used.

        The cloud is looked at in every frame: a LiDAR that dies beside a parked car must not go unnoticed.
        """
        sees = self._sees(frame)
        require_returns(frame.cloud)
        self.motion.offer(frame)
        self.schedule.saw(frame.stamp)
        if not sees or not self.speed_gate.allows(frame) or not self.selector.offer(frame.image, frame.stamp):
            return False
        with self._lock:
            generation = self._generation
        try:
            moving = self.motion.completed(frame)
            if moving is not frame and not self.speed_gate.allows(moving):
                return False  # the selector goes on from this frame: scans in a turn are not aligned one by one
            features = self.calibrator.extract(moving)
        except Exception:
            self.selector.reset()  # the scene is still wanted: the next frame may show it with a good scan
            raise
        with self._lock:
            if generation == self._generation:  # else: reset or configured meanwhile
                self._gone = self._gone or len(self.buffer) == self.buffer.maxlen
                self.buffer.append(features)
                self._new_keyframes += 1
                self._fresh += 1
                self.keyframes_seen += 1
        self._guard()
        return True

    def _sees(self, frame: Frame) -> bool:
        """Whether both sensors show something. One bad frame is passed over, more of them are told."""
        problem = self.sensors.look(frame)
        self._blind_frames = self._blind_frames + 1 if problem else 0
        if not problem or self._blind_frames >= BLIND_FRAMES:
            with self._lock:
                self.tracker.blinded(problem)
        return not problem

    def _guard(self) -> None:
        """Is the extrinsic in force still right? If it has moved, keyframes from before say nothing any more."""
        if not self.config.monitor.enabled:
            return
        with self._lock:
            generation, tracker, keyframes = self._generation, self.tracker, list(self.buffer)
            if self._replaced or not tracker.guarded or not keyframes:
                self.monitor.reset()
                self._replaced = False
            if not tracker.guarded or not keyframes:
                return
            T, spread, anchor = tracker.T, tracker.spread, tracker.initial.T_camera_lidar
        finding = self.monitor.look(self.calibrator, keyframes, T, spread, anchor)
        with self._lock:
            if generation != self._generation or self._replaced:
                return
            if finding.verdict == MOVED_AWAY:
                self._generation += 1  # an estimate under way rests on what was before
                self.buffer = deque(keyframes[-finding.since :], maxlen=self.buffer.maxlen)
                self._new_keyframes = self._fresh = len(self.buffer)
                self._gone = False
            elif finding.spoilt:
                kept = [*keyframes[: -finding.since], *keyframes[finding.spoilt - finding.since :]]
                self.buffer = deque(kept, maxlen=self.buffer.maxlen)
            tracker.judge(finding)

    def newest(self) -> Features | None:
        """The newest keyframe."""
        with self._lock:
            return self.buffer[-1] if self.buffer else None

    def ready(self) -> bool:
        """True if there are new keyframes since the last estimate, enough of them, and online.mode says that it is time.

        Mode periodic does not wait while the calibration has moved: the extrinsic in force is wrong.
        """
        with self._lock:
            config = self.config.online
            enough = self._new_keyframes > 0 and len(self.buffer) >= config.min_keyframes
            due = self.schedule.due or (self.tracker.lost and config.mode == PERIODIC)
            return due and enough and not self.tracker.suspect

    def estimate(self, progress: Progress | None = None, force_search: bool = False) -> Extrinsic:
        """Joint estimate over the buffer (thesis eq. 3.16, equal weights) and its way through the tracker's gate.

        Until two successive estimates agree, and on demand, the whole search box around the extrinsic is searched; then the
        current extrinsic is refined. A failure keeps the extrinsic in force and says why in its status.
        """
        with self._lock:
            features, generation, fresh = list(self.buffer), self._generation, self._fresh
            self._new_keyframes = 0
            self.schedule.estimating()
        tracker, config = self.tracker, self.config.search
        if not features:
            return self._accept(Result(tracker.T, INSUFFICIENT, "no keyframe yet: wait for images and clouds"), generation)
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
            if generation != self._generation:  # reset, configured or moved while estimating: the estimate is void
                return self.tracker.current
            seconds = 0.0
            if features:
                newest = features[-1].stamp
                seconds = 0.0 if self._estimated_at is None else (newest - self._estimated_at) / NANOSECONDS
                self._estimated_at = newest
            accepted = self.tracker.current.accepted
            extrinsic = self.tracker.offer(result, min(fresh / max(len(features), 1), 1.0), seconds, asked, whole=not self._gone)
            if extrinsic.accepted > accepted:
                self._fresh -= fresh
                self._replaced = self._replaced or asked
            return extrinsic

    def reset(self) -> None:
        """Forget all keyframes, and what the sensors usually show, and go back to the initial extrinsic."""
        with self._lock:
            self._forget_keyframes()
            self.sensors = SensorWatch(self.config.monitor)
            self.tracker.reset()

    def configure(self, config: Config) -> None:
        """Use other constants from now on. Keyframes stay unless their features would now look different."""
        features_changed = _what_features_rest_on(config) != _what_features_rest_on(self.config)
        with self._lock:
            self.config = config
            self.selector.config = self.schedule.config = self.speed_gate.config = config.online
            self.motion.config = config.motion
            self.monitor.config = self.sensors.config = config.monitor
            self.tracker.config = config
            self.buffer = deque(self.buffer, maxlen=config.online.buffer_size)
            if not config.monitor.enabled:
                self._replaced = True
                self.tracker.unguarded()
            if features_changed:
                self._forget_keyframes()

    def _forget_keyframes(self) -> None:
        """With the lock held. What is extracted or estimated right now from the old ones is void."""
        self._generation += 1
        self._replaced = True  # what the monitor suspects rests on them
        self.buffer.clear()
        self._new_keyframes = self._fresh = 0
        self._gone = True  # what was estimated rests on them
        self.selector.reset()


def _what_features_rest_on(config: Config) -> tuple[object, ...]:
    return config.image, config.lidar, config.motion, config.score, config.thesis, config.refine.objective
