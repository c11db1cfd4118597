"""From messages to the extrinsic, on threads, without ROS: what the node and its tests share.

Callbacks hand messages over and return at once. One thread decodes pairs and extracts keyframe features, another estimates,
a third asks the models of ``semantics`` what is in the keyframes; each works on the newest item only, so that nothing slow ever
holds up the intake.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
import traceback
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from calib_ros.camera import Camera
from calib_ros.config import Config
from calib_ros.errors import CalibrationError
from calib_ros.frame import Frame
from calib_ros.online.keyframes import SpeedGate
from calib_ros.online.recalibrator import LoadLimit, Recalibrator
from calib_ros.online.synchronizer import Synchronizer
from calib_ros.result import Extrinsic, Result
from calib_ros.semantics.segmentation import Segmentation

# A thread that works on the newest item and nothing else.
Item = TypeVar("Item")


class Cancelled(Exception):
    """Raised inside long work when its worker is asked to stop."""


class LatestWorker(Generic[Item]):
    """Runs `work(item)` on a thread; an item that waits is replaced by a newer one, so the thread never lags behind.

    on_error: called on the worker thread with whatever `work` raises; the thread goes on. nice: by how much it steps back where
    all cores are busy, 0 to 19.
    """

    def __init__(self, name: str, work: Callable[[Item], None], on_error: Callable[[Exception], None], nice: int = 0) -> None:
        self._work, self._on_error, self._nice = work, on_error, nice
        self._changed = threading.Condition()
        self._waiting: list[Item] = []
        self._busy = self._stopping = False
        self._busy_since = 0.0
        self.done = self.dropped = 0
        self.busy_s = 0.0
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, item: Item) -> None:
        """Hand over an item; never blocks. After stop() nothing is taken."""
        with self._changed:
            if self._stopping:
                return
            self.dropped += len(self._waiting)
            self._waiting = [item]
            self._changed.notify_all()

    @property
    def stopping(self) -> bool:
        """True once stop() was called."""
        return self._stopping

    @property
    def busy(self) -> bool:
        """True while an item is worked on or waits."""
        with self._changed:
            return self._busy or bool(self._waiting)

    def check_cancelled(self, *_: object) -> None:
        """To be called now and then from within long work: raises Cancelled after stop()."""
        if self._stopping:
            raise Cancelled

    def busy_seconds(self) -> float:
        """Time spent working so far, the item under way included."""
        with self._changed:
            return self.busy_s + (time.monotonic() - self._busy_since if self._busy else 0.0)

    def wait_idle(self, timeout: float | None = None) -> bool:
        """Wait until nothing is worked on or waits; False when the time is up first."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._busy and not self._waiting, timeout)

    def stop(self, timeout: float = 1.5) -> bool:
        """Ask the thread to end and wait for it; True if it did."""
        with self._changed:
            self._stopping = True
            self._waiting = []
            self._changed.notify_all()
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def _run(self) -> None:
        if self._nice and hasattr(os, "setpriority"):
            with contextlib.suppress(OSError):  # some sandboxes do not allow even that
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), self._nice)
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._stopping)
                if self._stopping:
                    return
                item = self._waiting.pop()
                self._busy, self._busy_since = True, time.monotonic()
            try:
                self._work(item)
            except Cancelled:
                pass
            except Exception as error:  # the thread must outlive any bad frame; on_error reports it
                self._report(error)
            finally:
                with self._changed:
                    self._busy = False
                    self.busy_s += time.monotonic() - self._busy_since
                    self.done += 1
                    self._changed.notify_all()

    def _report(self, error: Exception) -> None:
        try:
            self._on_error(error)
        except Exception:  # nor may a reporter that fails, as a log does at shutdown, end the thread
            traceback.print_exc()


# What joins the pipeline to the world: ROS in the node, plain functions in tests.
def _nothing(image: Any, cloud: Any) -> None:
    return


@dataclass(frozen=True)
class PipelineHooks:
    """What the pipeline asks of, and tells, its owner, on worker threads; after reset() on the thread that called it.

    decode: image and cloud message and camera -> frame. frame_ids: image and cloud message -> (camera frame, LiDAR frame).
    initial: camera, camera frame, LiDAR frame -> extrinsic to start from, None = not known yet, ask again with the next pair.
    on_extrinsic: a new state of the extrinsic and the stamp of the newest data in it. on_frame: a frame, and whether it
    became a keyframe. on_error: one line for a person. on_keyframe: image and cloud message of a new keyframe.
    """

    decode: Callable[[Any, Any, Camera], Frame]
    frame_ids: Callable[[Any, Any], tuple[str, str]]
    initial: Callable[[Camera, str, str], Result | None]
    on_extrinsic: Callable[[Extrinsic, int], None]
    on_frame: Callable[[Frame, bool], None]
    on_error: Callable[[str], None]
    on_keyframe: Callable[[Any, Any], None] = _nothing


# What the pipeline says to its owner, each thing once and in the right order.
class Teller:
    """Publishes through the hooks from any thread: what is published last is current.

    in_force: gives the recalibrator in use, None before the first. stamp: of the newest data, ns; to be set by the pipeline.
    """

    def __init__(self, hooks: PipelineHooks, in_force: Callable[[], Recalibrator | None]) -> None:
        self.stamp = 0
        self._hooks, self._in_force = hooks, in_force
        self._lock = threading.Lock()
        self._last: Result | None = None
        self._said: set[str] = set()

    def extrinsic(self, recalibrator: Recalibrator, again: bool = False) -> None:
        """The current extrinsic, if it or its status is another than told last; nothing of a recalibrator that was replaced.

        What the monitor says of one that is right goes to the diagnostics alone.
        """
        with self._lock:
            extrinsic = recalibrator.current
            if recalibrator is self._in_force() and (again or extrinsic.result is not self._last):
                self._last = extrinsic.result
                self._hooks.on_extrinsic(extrinsic, self.stamp)

    def to(self, listener: Callable[[Extrinsic, int], None]) -> None:
        """Call `listener` with the current extrinsic and its stamp, if there is one; nothing newer is told meanwhile."""
        with self._lock:
            recalibrator = self._in_force()
            if recalibrator is not None:
                listener(recalibrator.current, self.stamp)

    def what_is_missing(self, recalibrator: Recalibrator) -> None:
        """What the estimates have to do without, a line each, once."""
        newest, lines = recalibrator.newest(), [recalibrator.motion.missing]
        if newest is not None and not newest.has_reflectivity:
            lines.append("the cloud has no intensity: reflectivity edges are off, everything else works")
        for line in lines:
            if line and line not in self._said:
                self._said.add(line)
                self._hooks.on_error(line)


__all__ = ["Pair", "Pipeline", "PipelineHooks"]

Pair = tuple[Any, Any]
LOOKER_NICE = 15  # on two busy cores callbacks then wait half as long for the models' thread, and keyframes come as without it


class Pipeline:
    """Pairing, and the threads for intake, estimates and semantics. May be called from any thread; nothing waits for either."""

    def __init__(self, config: Config, hooks: PipelineHooks) -> None:
        self.config, self.hooks = config, hooks
        self.camera: Camera | None = None
        self.recalibrator: Recalibrator | None = None
        self.synchronizer: Synchronizer[Any, Any] = Synchronizer(config.online.pair_tolerance_s, config.online.pair_queue)
        self.speed_gate = SpeedGate(config.online)
        self._segmentation = Segmentation(config.semantics)
        self.last_keyframe: Frame | None = None
        self._load = LoadLimit(config.online)
        self.telling = Teller(hooks, lambda: self.recalibrator)
        self._requests: list[Future[Extrinsic]] = []
        self._lock = threading.Lock()
        self._intake: LatestWorker[Pair] = LatestWorker("calib_intake", self._take_in, self._report)
        self._estimator: LatestWorker[None] = LatestWorker("calib_estimate", self._estimate, self._report)
        self._looker: LatestWorker[None] = LatestWorker("calib_semantics", self._look, self._report, LOOKER_NICE)

    # ---- what arrives -------------------------------------------------------------------------------------------------

    def set_camera(self, camera: Camera) -> None:
        """The intrinsics of the images from now on. A change starts the keyframes anew and keeps the extrinsic."""
        with self._lock:
            if self.camera is not None and camera == self.camera:
                return
            changed, self.camera = self.camera is not None, camera
            if self.recalibrator is not None:
                tracker = self.recalibrator.tracker
                names = tracker.initial
                self.recalibrator = Recalibrator(
                    *(camera, names, self.config, names.camera_frame, names.lidar_frame, tracker.carry_over),
                    speed_gate=self.speed_gate,
                    segmentation=self._loaded(),
                )
        if changed:
            self.hooks.on_error("the camera's intrinsics changed: collecting keyframes anew, the extrinsic stays")

    def add_image(self, stamp: int, message: Any) -> None:
        """An image message, stamp in ns."""
        with self._lock:
            jumps = self.synchronizer.counts.jumps_back
            pairs = self.synchronizer.add_image(stamp, message)
            jumped = self.synchronizer.counts.jumps_back > jumps
        self._pass_on(pairs, jumped)

    def add_cloud(self, stamp: int, message: Any) -> None:
        """A cloud message, stamp in ns."""
        with self._lock:
            jumps = self.synchronizer.counts.jumps_back
            pairs = self.synchronizer.add_cloud(stamp, message)
            jumped = self.synchronizer.counts.jumps_back > jumps
        self._pass_on(pairs, jumped)

    def _pass_on(self, pairs: list[Pair], jumped: bool) -> None:
        if jumped:
            self.hooks.on_error(
                "time stamps jumped back (a looping bag, or a clock was set back): "
                "messages that waited for a partner were dropped"
            )
        for pair in pairs:
            self._intake.put(pair)

    # ---- what is asked ------------------------------------------------------------------------------------------------

    def request_estimate(self) -> Future[Extrinsic]:
        """Search and estimate now over the buffer; the future holds the extrinsic current afterwards, or an exception."""
        future: Future[Extrinsic] = Future()
        with self._lock:
            self._requests.append(future)
        self._estimator.put(None)
        return future

    def reset(self) -> None:
        """Forget the keyframes, go back to the initial extrinsic and publish it."""
        recalibrator = self.recalibrator
        if recalibrator is not None:
            recalibrator.reset()
            self.telling.extrinsic(recalibrator, again=True)

    def restart(self) -> None:
        """Forget keyframes and extrinsic: the next pair asks for the initial one again."""
        with self._lock:
            self._loaded()
            self.recalibrator = None

    def configure(self, config: Config) -> None:
        """Other constants from now on; the same ones again cost nothing."""
        with self._lock:
            if config == self.config:
                return
            self.config = config
            self._load.config = self.speed_gate.config = config.online
            self.synchronizer.configure(config.online.pair_tolerance_s, config.online.pair_queue)
            if self.recalibrator is not None:
                self.recalibrator.configure(config)

    def stop(self) -> bool:
        """End all threads, an estimate under way included; True if they ended."""
        self._estimator.stop(timeout=0)
        self._looker.stop(timeout=0)
        self._intake.stop(timeout=1.0)
        return self._estimator.stop(timeout=1.5) and self._looker.stop(timeout=1.0)

    def wait_idle(self, timeout: float) -> bool:
        """Wait until everything handed over so far is worked off."""
        return all(worker.wait_idle(timeout) for worker in (self._intake, self._looker, self._estimator))

    @property
    def dropped_pairs(self) -> int:
        """Pairs that a newer one replaced before the intake came to them."""
        return self._intake.dropped

    @property
    def estimating(self) -> bool:
        """True while an estimate is under way or waits."""
        return self._estimator.busy

    def busy_seconds(self) -> tuple[float, float]:
        """Seconds that intake and estimate threads have worked so far."""
        return self._intake.busy_seconds(), self._estimator.busy_seconds()

    # ---- threads ------------------------------------------------------------------------------------------------------

    def _take_in(self, pair: Pair) -> None:
        with self._lock:
            camera = self.camera
        if camera is None:
            self.hooks.on_error("images and clouds arrive, but no usable CameraInfo yet; publish it on the topic 'camera_info'")
            return
        recalibrator = self._started(camera, pair)
        if recalibrator is None:
            return
        frame = self.hooks.decode(*pair, camera)
        try:
            is_keyframe = recalibrator.ingest(frame)
        finally:
            self.telling.extrinsic(recalibrator)  # a frame alone may tell that the extrinsic has moved, or that a sensor is blind
        self.last_keyframe = frame if is_keyframe else self.last_keyframe
        if is_keyframe:
            self.hooks.on_keyframe(*pair)
            self.telling.stamp = frame.stamp  # no maximum: a looping bag or a clock set back begins anew
            self.telling.what_is_missing(recalibrator)
            if recalibrator.segments_keyframes:
                self._looker.put(None)
        if self._due(recalibrator):
            self._estimator.put(None)
        self.hooks.on_frame(frame, is_keyframe)

    def _due(self, recalibrator: Recalibrator) -> bool:
        return recalibrator.ready() and self._load.allows(time.monotonic())

    def _started(self, camera: Camera, pair: Pair) -> Recalibrator | None:
        camera_frame, lidar_frame = self.hooks.frame_ids(*pair)
        recalibrator = self.recalibrator
        if recalibrator is not None:
            names = recalibrator.tracker.initial
            if (names.camera_frame, names.lidar_frame) != (camera_frame, lidar_frame):
                self.hooks.on_error(
                    f"a pair of {lidar_frame} and {camera_frame} arrived, but this node estimates {names.lidar_frame} to "
                    f"{names.camera_frame}; give every camera-LiDAR pair its own node"
                )
                return None
            return recalibrator
        initial = self.hooks.initial(camera, camera_frame, lidar_frame)
        if initial is None:
            return None
        with self._lock:
            # The camera as it is now: it may have changed while the initial extrinsic was looked up.
            recalibrator = Recalibrator(
                self.camera or camera, initial, self.config, camera_frame, lidar_frame, None, self.speed_gate, self._loaded()
            )
            self.recalibrator = recalibrator
        self.telling.extrinsic(recalibrator)
        return recalibrator

    def _loaded(self) -> Segmentation:
        """The models, loaded ones where there are some: that takes seconds."""
        last = self._segmentation if self.recalibrator is None else self.recalibrator.segmentation
        self._segmentation = last if last.config == self.config.semantics else Segmentation(self.config.semantics)
        return self._segmentation

    def _estimate(self, _: None) -> None:
        with self._lock:
            requests, self._requests = self._requests, []
        recalibrator, began = self.recalibrator, time.monotonic()
        if not requests and (recalibrator is None or not self._due(recalibrator)):
            return  # it was when it was put, but an estimate has been made since
        try:
            if recalibrator is None:
                raise CalibrationError("no pair of image and cloud arrived yet; check the topics with 'ros2 topic hz'")
            extrinsic = recalibrator.estimate(self._estimator.check_cancelled, force_search=bool(requests))
        except BaseException as error:
            for request in requests:
                request.set_exception(error)
            raise
        finally:
            self._load.worked(began, time.monotonic())
        for request in requests:  # first of all: whatever goes wrong in telling the world, who asked must not wait for ever
            request.set_result(extrinsic)
        self.telling.extrinsic(recalibrator)
        if self._due(recalibrator):
            self._estimator.put(None)

    def _look(self, _: None) -> None:
        recalibrator = self.recalibrator
        if recalibrator is not None:
            for problem in recalibrator.segment_keyframe(lambda: self._looker.stopping):
                self.hooks.on_error(problem)
            if self._due(recalibrator):
                self._estimator.put(None)

    def _report(self, error: Exception) -> None:
        if isinstance(error, CalibrationError):
            self.hooks.on_error(str(error))
        else:  # a defect of ours: say where, keep the node alive
            self.hooks.on_error(f"unexpected {type(error).__name__}: {error}; please report it with the data that led to it")
