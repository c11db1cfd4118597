"""Online recalibration without ROS: frames in, the current extrinsic out."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera
from calib_ros.config import Config, SemanticsConfig
from calib_ros.config.online import CONTINUOUS
from calib_ros.datasets.recent import Recent
from calib_ros.frame import Frame
from calib_ros.intrinsics import RefinedCamera
from calib_ros.lidar.ego_motion import estimate_motion
from calib_ros.lidar.range_image import require_returns
from calib_ros.online.clocks import SeenMotion, usable_clocks, with_clocks, with_clocks_kept, with_clocks_moved
from calib_ros.online.coach import Advice, Counted, advise
from calib_ros.online.common import SharedScans
from calib_ros.online.first_guess import FirstGuess, classes_of
from calib_ros.online.glance import Glance
from calib_ros.online.keyframes import Batch, EgoMotion, KeyframeBuffer, KeyframeSelector, ScanBefore, SpeedGate, feature_config
from calib_ros.online.monitor import Monitor, Verdict
from calib_ros.online.pacing import LONGEST_REST_S, REST_SPACING_S, Schedule
from calib_ros.online.sensor_health import SensorHealth
from calib_ros.online.tracker import Tracker
from calib_ros.online.worker import Cancelled
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.classes import Segmentation
from calib_ros.registration.classes import segmentation as models_of
from calib_ros.registration.estimate import leaves_doubt
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.progress import Callback
from calib_ros.registration.search.constraints import SEMANTIC_BOX, SearchBox
from calib_ros.result import INITIAL, INSUFFICIENT, Extrinsic, RefusalCode, Result

SEARCH_ROUNDS = 2  # of a search triggered by a keyframe: the next keyframe searches again
BLIND_FRAMES = 2  # a sensor is called blind after so many frames in a row that show nothing
# p value of a keyframe that asks for an estimate at rest: by chance, of the two tests at each, one rest in twenty ends early.
DOUBTFUL_P = 0.05 * REST_SPACING_S[1] / (2 * LONGEST_REST_S)


class Recalibrator:
    """Keeps the features of the newest keyframes, and the current extrinsic that they are tested against and estimated from.

    `ingest` takes frames, `segment_keyframe` adds semantics to a keyframe, `estimate` estimates from all keyframes. Each of them
    may run on a thread of its own: an estimate works on a copy of the buffer's references.

    Parameters
    ----------
    camera : intrinsics of all frames.
    initial : T_camera_lidar (4, 4), or a Result, to start from, which `reset` goes back to.
    config : replaced by `configure`.
    camera_frame, lidar_frame : names, for the results.
    current : the extrinsic to go on with, where it is another than the initial one.
    speed_gate : one that is fed with odometry from outside.
    scans, pictures : what is found out of those of the LiDAR and of the camera, shared with the recalibrators of other pairs.
    models : those of a configuration, which are loaded already where others use them.
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
        scans: SharedScans | None = None,
        pictures: Recent | None = None,
        models: Callable[[SemanticsConfig], Segmentation] = models_of,
    ) -> None:
        self.camera, self._configured = camera, config or Config()
        start = initial if isinstance(initial, Result) else Result(initial, INITIAL, "no estimate yet")
        start = usable_clocks(self._configured, start)
        current = None if current is None else usable_clocks(self._configured, current)
        self.config = with_clocks(self._configured, current or start)
        self.tracker = Tracker(replace(start, camera_frame=camera_frame, lidar_frame=lidar_frame), current, self.config)
        self.monitor, self.sensors = Monitor(self.config.monitor), SensorHealth()
        self._scans, self._pictures, self._models = scans, pictures, models
        in_step = scans is not None
        self.glance, self.selector = Glance(in_step), KeyframeSelector(self.config.online, in_step)
        self.segmentation = models(self.config.semantics)
        self._to_segment: tuple[Frame, FrameFeatures] | None = None  # the newest keyframe: models are slower than a drive
        self.segmented: tuple[int, dict[str, float]] = 0, {}  # keyframes, and s that the models took for the last one
        estimate = estimate_motion if scans is None else scans.motion
        self.motion = EgoMotion(self.config.motion, self.config.lidar.accumulate_s, estimate)
        self.speed_gate = speed_gate or SpeedGate(self.config.online)
        self.schedule, self.keyframes = Schedule(self.config.online, in_step), KeyframeBuffer(self.config.online.buffer_size)
        self._lock, self._calibrator_lock = threading.Lock(), threading.Lock()
        self._calibrator = self._calibrator_for(self.config)
        self._keyframes_fit = False  # the monitor has tested the keyframes since the last estimate, and found nothing
        self._in_doubt, self._seen_motion = True, SeenMotion()  # the last estimate was, or there was none; how it moved
        self._restart_monitor = False  # the extrinsic was replaced by one elsewhere, or the keyframes are gone
        self.refined_camera: RefinedCamera | None = None  # by the newest estimate that tells of it
        self.first_guess = FirstGuess(self.config, self.tracker.initial)

    # ---- state --------------------------------------------------------------------------------------------------------

    @property
    def calibrator(self) -> Calibrator:
        """Calibrator of the current configuration. Made on demand: its look-up tables for the lens take up to 50 ms."""
        with self._calibrator_lock:
            config, last = self.config, self._calibrator
            if replace(config, online=last.config.online) != last.config:
                self._calibrator = self._calibrator_for(config)
            return self._calibrator

    def _calibrator_for(self, config: Config) -> Calibrator:
        edges = None if self._scans is None else self._scans.edges(config.lidar)
        return Calibrator(self.camera, config, self.segmentation, scans=edges, pictures=self._pictures)

    @property
    def current(self) -> Extrinsic:
        """The current extrinsic."""
        return self.tracker.current

    @property
    def segments_keyframes(self) -> bool:
        """True if there are models to segment keyframes, and estimates that want it."""
        needed = self.first_guess.needs_classes or self._in_doubt
        return self.segmentation.active and (needed or not self.calibrator.classes_in_doubt_only)

    @property
    def at_rest(self) -> bool:
        """True while the extrinsic is steady and every keyframe since the last estimate fits it: less is done then."""
        return self.config.online.rest_period_s > 0 and self.tracker.steady and self._keyframes_fit

    @property
    def looks_seldom(self) -> bool:
        """True while looks may be seldom: at rest; and for a camera of a rig, beside which others want the time, while all
        keyframes that come move as those in the last estimate."""
        return self.at_rest or (self._scans is not None and self._waits_for_motion())

    def _waits_for_motion(self) -> bool:
        """Whether another estimate would tell nothing new, as long as all new keyframes move as those in the last one."""
        known = self.tracker.awaits_motion and self._keyframes_fit
        return known and self._seen_motion.covers(list(self.keyframes.features), self.keyframes.new)

    def newest(self) -> FrameFeatures | None:
        """Features of the newest keyframe, None before the first."""
        with self._lock:
            return self.keyframes.features[-1] if self.keyframes else None

    def snapshot(self) -> tuple[list[FrameFeatures], Config, Result]:
        """The keyframes that an estimate would use, oldest first, the configuration of their features, the current extrinsic."""
        with self._lock:
            return self._informative() or list(self.keyframes.features), self.config, self.current.result

    def advice(self, extrinsic: Extrinsic | None = None) -> Advice:
        """What an extrinsic of this recalibrator lacks, None = the current one, and what to do about it."""
        camera = self.calibrator.extract.camera
        with self._lock:
            tracker, keyframes = self.tracker, self.keyframes
            fault = None if tracker.sensor_problem is None else tracker.sensor_problem.fault
            seen = len(keyframes), keyframes.per_s(self.schedule.newest), tracker.filter.keyframes
            counted = Counted(*seen, tracker.missing, tracker.confirmations, fault)
            return advise((extrinsic or tracker.current).result, self.config, camera, counted)

    def ready(self) -> bool:
        """True if an estimate is due: enough keyframes, new ones among them, and online.mode allows it."""
        with self._lock:
            if self.tracker.suspect or not self.keyframes.new or len(self.keyframes) < self.config.online.min_keyframes:
                return False
            waits = self._waits_for_motion()
            urgent = self.tracker.lost or (self.tracker.tentative and not waits)
            least, current = self.config.online.min_keyframes, self.tracker.current
            return self.schedule.due(self.at_rest, waits, urgent) and self.keyframes.enough(least, current, self._informative)

    def _informative(self) -> list[FrameFeatures]:
        """With the lock held: the keyframes to estimate from. Where an extrinsic is known, those that show next to nothing are
        left out: an empty road would give a biased one."""
        keyframes = list(self.keyframes.features)
        return self.monitor.informative(keyframes, self.tracker.T) if self.tracker.monitored else keyframes

    # ---- frames -------------------------------------------------------------------------------------------------------

    def wants(self, stamp: int) -> bool:
        """False if a frame of this stamp, ns, need not even be decoded: between two looks, at rest and without any doubt.
        The cameras of a rig, for which it is that of the scan, look at the same scans, at rest or not."""
        if not (self.at_rest or self._scans is not None) or self.config.lidar.accumulate_s > 0:
            return True
        doubt = self.glance.struck or self.monitor.in_doubt or self.sensors.faulty_frames > 0
        return doubt or self.glance.is_due(stamp, self.looks_seldom)

    def ingest(
        self, frame: Frame, scan_before: ScanBefore = lambda since: None, permit: Callable[[], bool] = lambda: True
    ) -> bool:
        """Check a frame, and add it to the keyframes if it is one; True if it is. CalibrationError for an unusable frame.

        scan_before: see `EgoMotion.with_twist`. permit: see `KeyframeSelector.select`.
        """
        problem = self.sensors.check(frame)
        if problem is None or self.sensors.faulty_frames >= BLIND_FRAMES:
            with self._lock:
                self.tracker.set_sensor_problem(problem)
        require_returns(frame.cloud)  # of every frame: a LiDAR that dies beside a parked car must not go unnoticed
        self.motion.add(frame)
        if self.first_guess.pending:
            self.first_guess.add(frame)
        self.schedule.add_frame(frame.stamp, self.tracker.steady)
        spacing_s = self.schedule.keyframes_at_rest_s if self.at_rest else 0.0
        moment = frame.stamp if self._scans is None else frame.moment_of_cloud  # the cameras of a rig choose the same scans
        if problem is not None or not self.speed_gate.allows(frame):
            return False
        is_keyframe = self.selector.select(frame.image, moment, permit, spacing_s)
        if is_keyframe:
            self.glance.put_off(moment)
        elif not (self._worth_a_test(frame, moment) and permit()):
            return False
        generation = self.keyframes.generation
        try:
            frame_with_twist = self.motion.with_twist(frame, scan_before)
            unknown_s = self.motion.unknown_s(frame_with_twist, self.tracker.T, self.config.tracker)
            if frame_with_twist is not frame and not self.speed_gate.allows(frame_with_twist):
                return False  # the selector goes on from this frame: scans in a turn are not aligned one by one
            frame_with_twist = self.motion.accumulated(frame_with_twist)
            features = replace(self.calibrator.extract(frame_with_twist), unknown_motion_s=unknown_s)
        except Exception:
            if is_keyframe:
                self.selector.reset()  # the scene is still wanted: the next frame may show it with a good scan
            raise
        with self._lock:
            current = generation == self.keyframes.generation  # else: reset or configured meanwhile
            if features.twist is not None:  # those before it was known that the vehicle moves
                self.keyframes.drop(lambda f: self.motion.moved_unknown(f, self.config.tracker))
            if current and is_keyframe:
                # Classes may come for one keyframe in many, and a first guess needs several.
                self.keyframes.add(features, lambda f: self.first_guess.needs_classes and f.view is not None)
                if self.segments_keyframes:
                    self._to_segment = frame_with_twist, features
        if current or is_keyframe:
            self._monitor_extrinsic(None if is_keyframe else features)
        return is_keyframe

    def _worth_a_test(self, frame: Frame, moment: int) -> bool:
        """Whether a frame that is no keyframe is to be tested by the monitor: it matches worse than others, or there is doubt."""
        if not (self.config.monitor.enabled and self.tracker.monitored and self.glance.is_due(moment, self.looks_seldom)):
            return False
        self.glance.put_off(moment)
        # In doubt there is no need to look, nor to get used to what may be a knock.
        doubt = self.glance.struck or self.monitor.in_doubt or self.tracker.suspect
        return doubt or self.glance.strikes(frame, self.tracker.T, self.config)

    def segment_keyframe(self, cancelled: Callable[[], bool] = lambda: False) -> tuple[str, ...]:
        """Add semantics to the newest keyframe, if it has none yet, which takes seconds; returns a line for each model that
        failed. cancelled: see Segmentation."""
        with self._lock:
            waiting, self._to_segment = self._to_segment, None
        if waiting is None:
            return ()
        (frame, plain), calibrator, tracker = waiting, self.calibrator, self.tracker
        # Where searches begin that come by themselves, and those on request: other points need no classes.
        starts = [tracker.search_center] + ([] if tracker.search_center is tracker.T else [tracker.T])
        reach = None if self.first_guess.needs_classes else (starts, self._search_box())
        semantics = classes_of(frame, calibrator, reach, self._in_doubt and self._seen_motion.newest is not None, cancelled)
        self.segmented = self.segmented[0], dict(semantics.seconds)
        if cancelled() or all(part is None for part in (semantics.edges, semantics.classes, semantics.labels)):
            return semantics.problems
        features = calibrator.extract(frame, semantics, plain)
        with self._lock:
            self.segmented = self.segmented[0] + 1, self.segmented[1]
            self.keyframes.replace(plain, features)
            self.keyframes.new += self.first_guess.needs_classes  # the classes are what the guess waits for
        return semantics.problems

    def describe_semantics(self) -> str:
        """Progress, failures, and the weights in use, for people."""
        (count, times), models = self.segmented, self.segmentation.describe()
        took = [f"{kind} {seconds:.1f} s" for kind, seconds in times.items()]
        return "; ".join([f"{count} keyframes", *took, *models]) if models else "none: no models are configured"

    def _monitor_extrinsic(self, tested: FrameFeatures | None = None) -> None:
        """Test the current extrinsic with the newest keyframe, or with a frame that becomes one if it speaks against it. Where it
        has moved, keyframes from before are dropped."""
        if not self.config.monitor.enabled:
            return
        self.glance.struck = False
        with self._lock:
            generation, tracker, keyframes = self.keyframes.generation, self.tracker, list(self.keyframes.features)
            if self._restart_monitor or not tracker.monitored or not keyframes:
                self.monitor.reset()
                self._restart_monitor = False
            if not tracker.monitored or not keyframes:
                return
            if tested is not None:
                keyframes.append(tested)
            given = tracker.T, tracker.spread, tracker.initial.T_camera_lidar, tested is not None, tracker.clock_sigma_s
        assessment = self.monitor.check(self.calibrator, keyframes, *given)
        with self._lock:
            if generation != self.keyframes.generation or self._restart_monitor:
                return
            if assessment.verdict in (Verdict.SUSPECT, Verdict.MOVED):
                assessment = replace(assessment, since_stamp=keyframes[-min(assessment.since, len(keyframes))].stamp)
                if tested is not None:
                    self.keyframes.add(tested)
            if assessment.verdict is Verdict.MOVED:
                self._in_doubt = True
                self.keyframes.keep_newest(assessment.since)
            elif assessment.out_of_sync:
                self.keyframes.remove(assessment.since, assessment.out_of_sync)
            # A keyframe that contradicts the extrinsic is a reason for another estimate, as is one that would if a shift of its
            # size counted. What shows too little says nothing.
            consistent = assessment.verdict is Verdict.CONSISTENT and assessment.p_value >= DOUBTFUL_P
            self._keyframes_fit = self._keyframes_fit and (consistent or assessment.verdict is Verdict.INCONCLUSIVE)
            tracker.apply(assessment)

    # ---- estimates ----------------------------------------------------------------------------------------------------

    def estimate(self, progress: Callback | None = None, force_search: bool = False) -> Extrinsic:
        """Joint estimate over the keyframes (thesis eq. 3.16), passed to the tracker; returns the current extrinsic afterwards.

        Until two successive estimates agree, and on request (force_search), the whole search box is searched; then the current
        extrinsic is refined. A failure keeps the current extrinsic and says why in its status. progress: see
        `Calibrator.calibrate`. After a Cancelled that it raises, everything is as before the estimate.
        """
        with self._lock:
            batch = self.keyframes.batch(self._informative() or list(self.keyframes.features))
            self.schedule.start_estimate()
            fitted, self._keyframes_fit = self._keyframes_fit, self.config.monitor.enabled  # until one from now on does not
        names, force_search, box = self.tracker.initial, force_search and bool(batch.features), None
        try:
            if not batch.features:
                result = Result(self.tracker.T, INSUFFICIENT, "no keyframe yet: wait for images and clouds")
            elif self.first_guess.pending:
                force_search, box = False, SEMANTIC_BOX
                result = self.first_guess.estimate(self.calibrator, batch.features, names, progress)
            else:
                tracker, box, start = self.tracker, self._search_box() if force_search else None, self.tracker.T
                if not (force_search or tracker.settled):
                    # A search on request may use all rounds; automatic ones are limited, since the next keyframe tries again.
                    box, start = self._search_box(SEARCH_ROUNDS), tracker.search_center
                # Pose constraints count from the initial extrinsic: from the current one they would drift along with it.
                given = batch.features, start, box, progress
                result = self.calibrator.estimate(*given, anchor=tracker.initial.T_camera_lidar, near=box is None)
            result = self.first_guess.explained(result, self.calibrator, (batch.features, box, progress), names)
        except Cancelled:
            with self._lock:
                if batch.generation == self.keyframes.generation:  # what was new still is
                    self.keyframes.new += batch.new
                self.schedule.cancel_estimate()
                self._keyframes_fit = self._keyframes_fit and fitted
            raise
        result = replace(result, camera_frame=names.camera_frame, lidar_frame=names.lidar_frame)
        extrinsic = self._update_tracker(result, batch, force_search)
        # Beside others it is dear: as much as all keyframes take.
        if self.config.online.mode != CONTINUOUS or self.tracker.steady or self._scans is not None:
            self.calibrator.objectives.maps = None
        return extrinsic

    def _search_box(self, rounds: int | None = None) -> SearchBox:
        return SearchBox(self.config.search.rotation_deg, self.config.search.translation_m, rounds)

    def _update_tracker(self, result: Result, batch: Batch, on_request: bool) -> Extrinsic:
        with self._lock:
            if batch.generation != self.keyframes.generation:  # reset, configured or moved meanwhile: the estimate is void
                return self.tracker.current
            if self.first_guess.pending and result.converged:
                unknown = replace(result, status=INITIAL, covariance=None, covariance_with_intrinsics=None)
                self.tracker = Tracker(unknown, None, self.config)
                self.first_guess.end()
            self._in_doubt = leaves_doubt(replace(result, cause=None))
            seconds, accepted = self._seen_motion.learn(batch.features), self.tracker.current.accepted
            extrinsic = self.tracker.update(result, batch.share_new, seconds, on_request, not self.keyframes.incomplete)
            if result.converged or result.refusal is RefusalCode.WRONG_INTRINSICS:  # where they are wrong, it is wanted most
                self.refined_camera = result.refined_camera
            if extrinsic.accepted > accepted:
                self._use_clocks(extrinsic.result)
                self.keyframes.unfused -= batch.unfused
                self._restart_monitor = self._restart_monitor or on_request
            return extrinsic

    def _use_clocks(self, known: Result) -> None:
        """With the lock held: take over what is known of the clocks, so that the points of all keyframes move."""
        before, config = self.config.motion, with_clocks(self.config, known)
        if config.motion != before:
            self._use(config)
            self._restart_monitor = True
            self.keyframes.change(lambda f: with_clocks_moved(f, before, config.motion))

    # ---- changes ------------------------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Drop all keyframes and the baselines of the sensor check, and go back to the initial extrinsic."""
        with self._lock:
            self._clear_keyframes()
            self.sensors = SensorHealth()
            self.glance.reset()
            if (placeholder := self.first_guess.begin_anew()) is None:
                self.tracker.reset()
            else:
                self.tracker = Tracker(placeholder, None, self._configured)
            self._use(with_clocks(self._configured, self.tracker.initial))

    def configure(self, config: Config) -> None:
        """Use another configuration from now on. Keyframes are kept unless their features would change, and what was found of
        the clocks unless what the stage ``motion`` states of them changes."""
        with self._lock:
            before, self._configured = self._configured.motion, config
            config = with_clocks_kept(config, before, self.config.motion, self.tracker.current.result)
            features_changed = feature_config(config) != feature_config(self.config)
            if config.semantics != self.config.semantics:  # else the models stay loaded
                self.segmentation = self._models(config.semantics)
            self._use(config)
            # Where it begins to guess, only points near the nominal view have classes so far.
            features_changed = self.first_guess.configure(config, self.tracker.current.accepted > 0) or features_changed
            self.keyframes.resize(config.online.buffer_size)
            if not config.monitor.enabled:
                self._restart_monitor = True
                self.tracker.stop_monitoring()
            if features_changed:
                self._clear_keyframes()

    def _use(self, config: Config) -> None:
        """With the lock held: in all parts but the first guess."""
        self.config = config
        self.tracker.config, self.monitor.config = config, config.monitor
        self.selector.config = self.schedule.config = self.speed_gate.config = config.online
        self.motion.config, self.motion.accumulate_s = config.motion, config.lidar.accumulate_s

    def _clear_keyframes(self) -> None:
        """With the lock held. Features and estimates that are being computed from the old keyframes become void."""
        self.keyframes.clear()
        self._restart_monitor = self._in_doubt = True
        self._to_segment = None
        self.first_guess.forget_unmatched()
        self.selector.reset()
