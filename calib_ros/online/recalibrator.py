"""What happens over time, without ROS: frames in, the current extrinsic out."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera
from calib_ros.config import Config
from calib_ros.frame import Frame
from calib_ros.lidar.scan import require_returns
from calib_ros.online.ego_motion import EgoMotion
from calib_ros.online.keyframes import KeyframeSelector
from calib_ros.online.tracker import Extrinsic, Tracker
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import Features
from calib_ros.registration.search_box import SearchBox
from calib_ros.result import INITIAL, INSUFFICIENT, Result

Progress = Callable[[str, float], None]


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
    ) -> None:
        """current: an estimate in force already, where it is another than the initial extrinsic that reset() goes back to."""
        self.config = config or Config()
        self.camera = camera
        start = initial if isinstance(initial, Result) else Result(initial, INITIAL, "no estimate yet")
        self.tracker = Tracker(replace(start, camera_frame=camera_frame, lidar_frame=lidar_frame), current)
        self.calibrator = Calibrator(camera, self.config)
        self.selector = KeyframeSelector(self.config.online)
        self.motion = EgoMotion(self.config.motion)
        self.buffer: deque[Features] = deque(maxlen=self.config.online.buffer_size)
        self.keyframes_seen = 0
        self._new_keyframes = 0
        self._generation = 0
        self._lock = threading.Lock()

    @property
    def current(self) -> Extrinsic:
        """The extrinsic in force."""
        return self.tracker.current

    def ingest(self, frame: Frame) -> bool:
        """Offer a frame; True if it became a keyframe. Raises CalibrationError for a frame that cannot be used.

        The cloud is looked at in every frame: a LiDAR that dies beside a parked car must not go unnoticed.
        """
        require_returns(frame.cloud)
        self.motion.offer(frame)
        if not self.selector.offer(frame.image, frame.stamp):
            return False
        with self._lock:
            generation = self._generation
        try:
            features = self.calibrator.extract(self.motion.completed(frame))
        except Exception:
            self.selector.reset()  # the scene is still wanted: the next frame may show it with a good scan
            raise
        with self._lock:
            if generation == self._generation:  # else: reset or configured meanwhile
                self.buffer.append(features)
                self._new_keyframes += 1
                self.keyframes_seen += 1
        return True

    def newest(self) -> Features | None:
        """The newest keyframe."""
        with self._lock:
            return self.buffer[-1] if self.buffer else None

    def ready(self) -> bool:
        """True if there are new keyframes since the last estimate, and enough of them."""
        with self._lock:
            return self._new_keyframes > 0 and len(self.buffer) >= self.config.online.min_keyframes

    def estimate(self, progress: Progress | None = None, force_search: bool = False) -> Extrinsic:
        """Joint estimate over the buffer (thesis eq. 3.16, equal weights) and its way through the tracker's gate.

        Until two successive estimates agree, and on demand, the whole search box around the extrinsic is searched; then the
        current extrinsic is refined. A failure keeps the extrinsic in force and says why in its status.
        """
        with self._lock:
            features, generation, self._new_keyframes = list(self.buffer), self._generation, 0
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
        return self._accept(replace(result, camera_frame=names.camera_frame, lidar_frame=names.lidar_frame), generation)

    def _accept(self, result: Result, generation: int) -> Extrinsic:
        with self._lock:
            if generation != self._generation:  # reset or configured while estimating: the estimate is void
                return self.tracker.current
            return self.tracker.offer(result)

    def reset(self) -> None:
        """Forget all keyframes and go back to the initial extrinsic."""
        with self._lock:
            self._forget_keyframes()
            self.tracker.reset()

    def configure(self, config: Config) -> None:
        """Use other constants from now on. Keyframes stay unless their features would now look different."""
        features_changed = _what_features_rest_on(config) != _what_features_rest_on(self.config)
        with self._lock:
            self.config = config
            self.calibrator = Calibrator(self.camera, config)
            self.selector.config = config.online
            self.motion.config = config.motion
            self.buffer = deque(self.buffer, maxlen=config.online.buffer_size)
            if features_changed:
                self._forget_keyframes()

    def _forget_keyframes(self) -> None:
        """With the lock held. What is extracted or estimated right now from the old ones is void."""
        self._generation += 1
        self.buffer.clear()
        self._new_keyframes = 0
        self.selector.reset()


def _what_features_rest_on(config: Config) -> tuple[object, ...]:
    return config.image, config.lidar, config.motion, config.score, config.thesis, config.refine.objective
