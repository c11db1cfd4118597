"""From messages to the current extrinsic, on threads, without ROS.

    add -> Pairing -> [ingest worker: decode, Recalibrator.ingest] -> [estimate worker:
    Recalibrator.estimate] -> events

Callers hand messages over and return at once. One thread decodes pairs and extracts keyframe features, another estimates, a third
runs the models of ``semantics`` on keyframes; each has a queue of one item, so that nothing slow ever holds up the others. What
happens goes out as typed events through one sink.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera
from calib_ros.config import Config
from calib_ros.errors import CalibrationError
from calib_ros.frame import Frame, PointCloud
from calib_ros.online.common import Common
from calib_ros.online.events import Event, ExtrinsicUpdated, FrameIngested, Inputs, IntakeIdle, Problem, Remarks
from calib_ros.online.keyframes import SpeedGate
from calib_ros.online.pacing import LoadBudget, Work
from calib_ros.online.pairing import Intake, Pairing
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.online.worker import ESTIMATE, Pending, Requests, Worker
from calib_ros.registration.classes import Segmentation
from calib_ros.registration.progress import Callback
from calib_ros.result import Extrinsic, Result

# Of the thread that runs the models: on two busy cores callbacks then wait half as long for it, and keyframes come as without it.
SEMANTICS_NICE = 15
FIRST_PAIRS = 10  # without a CameraInfo, which may come just after its image, and late where it is kept for those who join
LONGEST_ROUND_S = 3.0  # that a pair waits for those of the same scan to be done


class Pipeline:
    """Pairing, recalibrator, and the threads for ingest, estimates and semantics. Thread-safe; no call waits for a worker.

    sink: called with every event, on the worker threads, and after reset() on the thread that called it. Extrinsics come in
    order: the last one is the current one. camera: intrinsics of the images, None before any. recalibrator: None before the
    first pair. pairing: of the messages. last_keyframe: the newest keyframe's frame. load: the CPU time of the threads' work, and
    what it allows for.
    common: shared with the pipelines of other pairs of a rig. sensors: names of camera and LiDAR in there.
    """

    def __init__(
        self,
        config: Config,
        inputs: Inputs,
        sink: Callable[[Event], None],
        common: Common | None = None,
        sensors: tuple[str, str] = ("", ""),
    ) -> None:
        self.config = config
        self.camera: Camera | None = None
        self.recalibrator: Recalibrator | None = None
        self.last_keyframe: Frame | None = None
        self.pairing = Pairing(config, inputs.decode_cloud is not None)
        self.speed_gate = SpeedGate(config.online)
        self._common = common or Common(config.online)
        self._scans = None if common is None else common.scans(sensors[1])
        self._pictures = None if common is None else common.pictures(sensors[0])
        self.load = LoadBudget(config.online, purse=self._common.purse)
        self._inputs = inputs
        self._requests = Requests()
        self.dropped_pairs = 0  # that a newer one replaced before they were ingested
        self.rested_pairs = 0  # that were left out, since there was no need to look at them
        self._lock = threading.Lock()
        self._tell, self._remarks, self._publishing = sink, Remarks(sink), threading.Lock()
        self._published: Result | None = None
        self._stamp = 0  # of the newest keyframe, ns
        self._received: float | None = None  # when the newest pair was ingested, by time.monotonic()
        self._handed = -float("inf")  # when the newest pair was handed over to be ingested
        report = self._remarks.report
        self._ingester: Worker[Intake] = Worker("calib_intake", self._ingest, report, on_idle=lambda: sink(IntakeIdle()))
        self._common.ingesters.append(self._ingester)
        self._estimator: Worker[None] = Worker("calib_estimate", self._do_what_is_due, report)
        self._segmenter: Worker[None] = Worker("calib_semantics", self._segment, report, SEMANTICS_NICE)

    # ---- input --------------------------------------------------------------------------------------------------------

    def set_camera(self, camera: Camera) -> None:
        """The intrinsics of the images from now on. A change starts the keyframes anew and keeps the extrinsic."""
        with self._lock:
            if self.camera is not None and camera == self.camera:
                return
            changed, self.camera = self.camera is not None, camera
            self._requests.close()
            if self.recalibrator is not None:
                tracker = self.recalibrator.tracker
                self.recalibrator = self._recalibrator_at(camera, tracker.initial, tracker.carry_over)
        if self.recalibrator is not None:
            self._follow_clocks(self.recalibrator)
        if changed:
            message = "the camera's intrinsics changed: collecting keyframes anew, the extrinsic stays"
            self._tell(Problem(message, "intrinsics"))

    def _recalibrator_at(self, camera: Camera, initial: Result, current: Result | None = None) -> Recalibrator:
        """A new one; its frames are those of the initial extrinsic."""
        names, gate, models = (initial.camera_frame, initial.lidar_frame), self.speed_gate, self._common.models
        return Recalibrator(camera, initial, self.config, *names, current, gate, self._scans, self._pictures, models)

    def _hand_over(self, found: list[Intake], stamp: int | None = None) -> None:
        """With the lock held: to the ingest worker, unless it needs none of this stamp, ns, or of that of the scan in a rig."""
        if found and self._scans is not None and stamp is not None:
            stamp = found[-1].cloud_stamp or stamp
        if found and stamp is not None and self.recalibrator is not None:
            if not self.recalibrator.wants(stamp):
                self.rested_pairs += len(found)
                return
            late = time.monotonic() - self._handed > LONGEST_ROUND_S  # others must not come first for ever
            if self._scans is not None and not (late or self._common.joins(stamp)):
                self.dropped_pairs += sum(intake.paired for intake in found)
                return
        if found:
            self._handed = time.monotonic()
        for intake in found:
            self.dropped_pairs += sum(replaced.paired for replaced in self._ingester.put(intake))

    def add(self, is_image: bool, stamp: int, message: Any) -> None:
        """An image or a cloud message, stamp in ns."""
        with self._lock:
            counts, clocks_of = self.pairing.synchronizer.counts, self.pairing.clocks
            jumps, ahead = counts.jumps_back, clocks_of.ahead
            self._hand_over(self.pairing.add(is_image, stamp, message), stamp)
            jumped = counts.jumps_back > jumps
            clocks = clocks_of.describe() if clocks_of.ahead != ahead else ""
        if jumped:
            jump = "time stamps jumped back (a looping bag, or a clock was set back)"
            self._tell(Problem(f"{jump}: messages that waited for a partner were dropped", "stamps"))
        if clocks:
            self._tell(Problem(clocks, "clocks"))

    # ---- requests -----------------------------------------------------------------------------------------------------

    def request_estimate(self, progress: Callback | None = None) -> Future[Extrinsic]:
        """Search and estimate now over the buffer; the future holds the current extrinsic afterwards, or an exception.

        Requests over the same keyframes share one estimate. cancel() ends the request, and the estimate if it was the last one
        that waited for it; the extrinsic stays. progress: called on the thread of estimates; must not raise.
        """
        with self._lock:
            future = self._requests.add(Pending(ESTIMATE), self._keyframes_seen(), progress)
        self._estimator.put(None)
        return future

    def defer(self, job: Pending, obstacle: str = "") -> Future[Any]:
        """A job for the thread of estimates, after those under way; its CPU time is not charged to online.max_load. The future
        holds what it returns, or an exception: a CalibrationError where it is not taken, for an obstacle among other reasons."""
        future = self._requests.add(job, obstacle=obstacle)
        self._estimator.put(None)
        return future

    def vehicle_frames(self) -> Mapping[str, NDArray[np.float64]]:
        """T_camera_F (4, 4) of other frames F of the vehicle, by name, as far as they are known."""
        recalibrator = self.recalibrator
        names = None if recalibrator is None else recalibrator.tracker.initial
        return {} if names is None else self._inputs.vehicle_frames(names.camera_frame, names.lidar_frame)

    def pause(self, reason: str) -> None:
        """Take in no pairs, make no estimates and do no jobs; those under way end, requests fail with the reason, and the models
        leave out the keyframe that they are at. Keyframes and extrinsic stay."""
        self._requests.refuse(reason)

    def resume(self) -> None:
        """Go on after pause(). The data are as old as before the first pair: nobody has seen how the sensors stand meanwhile."""
        self._received = None
        self._requests.accept()

    @property
    def paused(self) -> bool:
        """True between pause() and resume()."""
        return self._requests.refused

    def reset(self) -> None:
        """Drop the keyframes, go back to the initial extrinsic and publish it."""
        recalibrator = self.recalibrator
        self._requests.close()
        if recalibrator is not None:
            recalibrator.reset()
            self._follow_clocks(recalibrator)
            self._publish(recalibrator, again=True)

    def restart(self) -> None:
        """Drop keyframes and extrinsic: the next pair asks for the initial one again."""
        with self._lock:
            self._requests.close()
            self.recalibrator = None

    def configure(self, config: Config) -> None:
        """Use other constants from now on; the same ones again cost nothing."""
        with self._lock:
            if config == self.config:
                return
            self.config = config
            self._requests.close()
            self.load.config = self.speed_gate.config = config.online
            if self.recalibrator is not None:
                self.recalibrator.configure(config)
                config = replace(config, motion=self.recalibrator.config.motion)
            self._hand_over(self.pairing.configure(config))

    def read_current(self, reader: Callable[[Extrinsic, int], None], wait: bool = True) -> None:
        """Call `reader` with the current extrinsic and its stamp, if there is one; no newer one is published meanwhile. wait:
        until a newer one that is being published is out; else nothing is done then."""
        if not self._publishing.acquire(blocking=wait):
            return
        try:
            recalibrator = self.recalibrator
            if recalibrator is not None:
                reader(recalibrator.current, self._stamp or recalibrator.current.estimated_at)
        finally:
            self._publishing.release()

    def stop(self) -> bool:
        """End all threads, an estimate or job under way included; True if they ended."""
        self._estimator.stop(timeout=0)
        self._requests.refuse()
        self._segmenter.stop(timeout=0)
        ended = [self._ingester.stop(timeout=1.0), self._estimator.stop(timeout=1.5), self._segmenter.stop(timeout=1.0)]
        return all(ended)

    def wait_idle(self, timeout: float) -> bool:
        """Wait until everything added so far is worked off."""
        return all(worker.wait_idle(timeout) for worker in (self._ingester, self._segmenter, self._estimator))

    # ---- diagnostics --------------------------------------------------------------------------------------------------

    @property
    def segmentation(self) -> Segmentation:
        """The models."""
        return self._common.models(self.config.semantics)

    @property
    def taking_in(self) -> bool:
        """True while a pair is being ingested or waits for it."""
        return self._ingester.busy

    @property
    def data_age_s(self) -> float:
        """Seconds since the newest pair that could be used was ingested; inf before the first."""
        return float("inf") if self._received is None else time.monotonic() - self._received

    def starved(self, within_s: float) -> bool:
        """True if pairs have come within so many seconds, but wait: too little CPU time is left to look at them."""
        return self.taking_in and time.monotonic() - self._handed <= within_s

    def busy_seconds(self) -> tuple[float, float]:
        """Seconds that the threads for ingest and estimates have worked so far, or waited for a core or each other meanwhile."""
        return self._ingester.busy_seconds(), self._estimator.busy_seconds()

    # ---- work on threads ----------------------------------------------------------------------------------------------

    def _ingest(self, intake: Intake) -> None:
        with self._common.intake.mine(self._ingester.check_cancelled), self.load.counting(Work.INTAKE) as begin:
            self._take_in(intake, begin)

    def _take_in(self, intake: Intake, begin: Callable[[Work], None]) -> None:
        if self.paused:
            return
        try:
            recalibrator = self._prepare(intake)
        finally:
            with self._lock:
                self._hand_over(self.pairing.use_stamps())
        if recalibrator is None:
            return
        pair = intake.image, intake.cloud
        frame_ids = self._inputs.frame_ids(*pair)
        names = recalibrator.tracker.initial
        if (names.camera_frame, names.lidar_frame) != frame_ids:
            what = f"a pair of {frame_ids[1]} and {frame_ids[0]} arrived, but this node estimates {names.lidar_frame} to"
            message = f"{what} {names.camera_frame}; give every camera-LiDAR pair its own node"
            self._tell(Problem(message, "other sensors"))
            return

        def permit() -> bool:
            """What comes from now on is the work of a keyframe, if the budget allows for one."""
            allowed = self.load.allows_keyframe()
            if allowed:
                begin(Work.KEYFRAMES)
            return allowed

        frame = self._inputs.decode(*pair, recalibrator.camera)
        if (ahead := self.pairing.clocks.ahead) and frame.cloud_stamp is not None:
            frame = replace(frame, cloud_stamp=frame.cloud_stamp - ahead)
        try:
            is_keyframe = recalibrator.ingest(frame, lambda since: self._scan_before(intake, since), permit)
            self._received = time.monotonic()
        finally:
            self._publish(recalibrator)  # a frame alone may show that the extrinsic has moved, or that a sensor is blind
            self._remarks.note_sensors(recalibrator)
        self._learn_sweep(frame.cloud, recalibrator)
        if is_keyframe:
            self.last_keyframe = frame
            self._stamp = frame.stamp  # no maximum: a looping bag or a clock set back begins anew
            self._remarks.note_what_is_missing(recalibrator, frame)
        begin(Work.INTAKE)
        if is_keyframe and recalibrator.segments_keyframes and self.load.allows_classes(recalibrator.first_guess.needs_classes):
            self._segmenter.put(None)
        if self._is_due(recalibrator):
            self._estimator.put(None)
        newest = recalibrator.newest()  # one that speaks against the extrinsic becomes a keyframe, too
        is_kept = is_keyframe or (newest is not None and newest.stamp == frame.stamp)
        self._tell(FrameIngested(frame, is_kept, *pair))

    def _prepare(self, intake: Intake) -> Recalibrator | None:
        """The recalibrator to ingest a pair; None while camera or start are unknown, and for messages that do not belong together
        by what this cloud tells of the sweep."""
        camera = self.camera
        if camera is None:
            message = "images and clouds arrive, but no usable CameraInfo yet; publish it on the topic 'camera_info'"
            if self.pairing.synchronizer.counts.pairs > FIRST_PAIRS:
                self._tell(Problem(message, "camera"))
            return None
        recalibrator = self.recalibrator or self._start(camera, *self._inputs.frame_ids(intake.image, intake.cloud))
        if recalibrator is None:
            return None
        paired_by = self.pairing.synchronizer.cloud_offset
        if self.pairing.sweep.ns is None and self._inputs.decode_cloud is not None:
            self._learn_sweep(self._inputs.decode_cloud(intake.cloud), recalibrator)
        return recalibrator if intake.paired and self.pairing.synchronizer.cloud_offset == paired_by else None

    def _learn_sweep(self, cloud: PointCloud, recalibrator: Recalibrator) -> None:
        """From a decoded cloud, in a millisecond: when scans sweep the view of the camera where it is by now."""
        self.pairing.sweep.add(cloud, recalibrator.camera, recalibrator.tracker.T)
        with self._lock:
            self._hand_over(self.pairing.use_sweep())

    def _scan_before(self, intake: Intake, since: int) -> tuple[int, PointCloud] | None:
        """The newest scan before a pair's, after `since` (ns), that no pair was taken in with, with its stamp."""
        earlier = intake.before
        if self._inputs.decode_cloud is None or earlier is None or earlier[0] <= since:
            return None
        try:
            return earlier[0], self._inputs.decode_cloud(earlier[1])
        except CalibrationError:  # a damaged neighbour does not make the frame unusable
            return None

    def _start(self, camera: Camera, camera_frame: str, lidar_frame: str) -> Recalibrator | None:
        """A recalibrator at the initial extrinsic; None while that is not known yet."""
        initial = self._inputs.initial(camera, camera_frame, lidar_frame)
        if initial is None:
            return None
        with self._lock:
            camera = self.camera or camera  # it may have changed while the initial extrinsic was looked up
            named = replace(initial, camera_frame=camera_frame, lidar_frame=lidar_frame)
            recalibrator = self.recalibrator = self._recalibrator_at(camera, named)
        self._follow_clocks(recalibrator)
        self._publish(recalibrator)
        return recalibrator

    def _do_what_is_due(self, _: None) -> None:
        """An estimate if one is asked for or due, then a job if one waits, so that each has its turn."""
        with self._common.estimates.mine(self._estimator.check_cancelled):
            try:
                self._estimate()
            finally:
                job = self._requests.begin(estimate=False)
                if job is not None and job.work is not None:
                    with suppress(Exception), self.load.counting(Work.CHECKS, charged=False):  # who has asked is told
                        self._requests.run(job, job.work, self._estimator.check_cancelled)
                if self._requests.waiting:
                    self._estimator.put(None)

    def _estimate(self) -> None:
        recalibrator = self.recalibrator
        is_due = recalibrator is not None and self._is_due(recalibrator)  # or else an estimate has been made since it was put
        job = self._requests.begin(True, self._keyframes_seen(), is_due)
        if job is None:
            return
        asked_for = bool(job.asked)

        def work(progress: Callback) -> Extrinsic:
            if recalibrator is None:
                raise CalibrationError("no pair of image and cloud arrived yet; check the topics with 'ros2 topic hz'")
            self.load.start_estimate()
            with self.load.counting(Work.ESTIMATES, charged=not asked_for):
                extrinsic = recalibrator.estimate(progress, force_search=asked_for)
            self._follow_clocks(recalibrator)
            return extrinsic

        # Who asked is answered first: whatever goes wrong in publishing, they must not wait for ever.
        self._requests.run(job, work, self._estimator.check_cancelled)
        if recalibrator is not None:
            self._publish(recalibrator)
            if self._is_due(recalibrator):
                self._estimator.put(None)

    def _follow_clocks(self, recalibrator: Recalibrator) -> None:
        """Pair by the time offset that the recalibrator has found."""
        with self._lock:
            motion = recalibrator.config.motion
            if motion != self.pairing.sweep.config and recalibrator is self.recalibrator:
                self._hand_over(self.pairing.configure(replace(self.config, motion=motion)))

    def _keyframes_seen(self) -> int:
        return 0 if self.recalibrator is None else self.recalibrator.keyframes.seen

    def _segment(self, _: None) -> None:
        recalibrator = self.recalibrator
        if recalibrator is not None:
            with self._common.classes.mine(self._segmenter.check_cancelled), self.load.counting(Work.CLASSES):
                problems = recalibrator.segment_keyframe(lambda: self._segmenter.stopping or self.paused)
            for k, problem in enumerate(problems):
                self._tell(Problem(problem, f"model {k}"))
            if self._is_due(recalibrator):
                self._estimator.put(None)

    def _is_due(self, recalibrator: Recalibrator) -> bool:
        return not self.paused and self.load.allows_estimate(recalibrator.ready())

    def _publish(self, recalibrator: Recalibrator, again: bool = False) -> None:
        """The current extrinsic, if it or its status differs from the one published last; none of a replaced recalibrator.

        The monitor's assessment of an extrinsic that is right goes to the diagnostics alone.
        """
        with self._publishing:
            extrinsic = recalibrator.current
            if recalibrator is self.recalibrator and (again or extrinsic.result is not self._published):
                self._published = extrinsic.result
                self._tell(ExtrinsicUpdated(extrinsic, self._stamp or extrinsic.estimated_at))
