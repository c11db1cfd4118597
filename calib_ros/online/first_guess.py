"""What is done while nothing is known of the extrinsic: guesses from the vehicle's motion, and from the classes of keyframes; and
where nothing matches: is something mixed up?"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import reduce

import cv2
import numpy as np

from calib_ros.arrays import Transform
from calib_ros.config import Config
from calib_ros.errors import BadInputError, MissingDependencyError, TooFewFeaturesError
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.registration.calibrator import NO_MATCH, Calibrator
from calib_ros.registration.classes import ALL, CLASSES, CLOUD, IMAGE, FrameSemantics, PoseHypothesis
from calib_ros.registration.features import FrameFeatures, points_in_reach, views_of
from calib_ros.registration.initial_guess import AUTO, BY_CLASSES, MOTION
from calib_ros.registration.judgement.refusal import joined
from calib_ros.registration.motion_guess.guess import best_registration, better, motion_guess
from calib_ros.registration.progress import Callback
from calib_ros.registration.search.constraints import NOMINAL_BOX, SearchBox
from calib_ros.result import INSUFFICIENT, InitialSource, Result

NOMINAL = "nominal"  # of initial.method
RUN_S, SPACING_S = 5.0, 0.15  # s of frames whose motion is used, and between them; at 10 Hz every second one
ENOUGH_S = 0.8 * RUN_S
NEW_S = 0.5 * RUN_S  # s of further frames after a guess that failed, before the next
JUDGED_AFTER = 3  # estimates where nothing matches: then the judge is asked once what may be mixed up


class FirstGuess:
    """Finds the first extrinsic, and asks what is mixed up where estimates match nothing. `add` may be called from another thread
    than `estimate`.

    start: what stands in until something is known, if it is nominal. pending: nothing is known.
    """

    def __init__(self, config: Config, start: Result | None = None) -> None:
        self.config = config
        self._placeholder = start if start is not None and start.origin is InitialSource.NOMINAL else None
        self.pending = self._placeholder is not None and self._wanted
        self._lock = threading.Lock()
        self._run: deque[Frame] = deque()
        self._tried_at: int | None = None  # stamp of the newest frame of the last guess from motion that failed
        self._failure = ""  # why it did
        self.forget_unmatched()

    @property
    def _wanted(self) -> bool:
        """Is nominal no start, but what stands in until something is known?"""
        return self.config.initial.method != NOMINAL

    @property
    def needs_classes(self) -> bool:
        """True while the classes of keyframes are waited for."""
        return self.pending and self.config.initial.method in (*BY_CLASSES, AUTO)

    def add(self, frame: Frame) -> None:
        """A frame of the drive, in grey, if it is one of those whose motion is used."""
        if self.config.initial.method not in (MOTION, AUTO):
            return
        with self._lock:
            if self._run:
                gap = (frame.moment_of_cloud - self._run[-1].moment_of_cloud) / NANOSECONDS
                if 0 <= gap < SPACING_S:
                    return
                if not 0 < gap <= RUN_S:  # a pause, or the clock was set back
                    self._run.clear()
                    self._tried_at = None
            grey = frame.image if frame.image.ndim == 2 else np.asarray(cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY), np.uint8)
            self._run.append(replace(frame, image=grey, classes=None))
            while self._lasted(self._run) > RUN_S:
                self._run.popleft()

    def configure(self, config: Config, is_estimated: bool) -> bool:
        """Use another configuration; True if from now on nothing is known. is_estimated: an estimate has been accepted."""
        before, self.config = self.pending, config
        self.pending = self._wanted and (before or (self._placeholder is not None and not is_estimated))
        if not self._wanted:
            self._clear()
        return self.pending and not before

    def begin_anew(self) -> Result | None:
        """Nothing is known again: what stands in, None where the start was given."""
        self._clear()
        self.pending = self._placeholder is not None and self._wanted
        return self._placeholder if self.pending else None

    def end(self) -> None:
        """An extrinsic is known."""
        self.pending = False
        self._clear()

    def _clear(self) -> None:
        with self._lock:
            self._run.clear()
            self._tried_at, self._failure = None, ""

    def estimate(
        self, calibrator: Calibrator, features: Sequence[FrameFeatures], initial: Result, progress: Callback | None = None
    ) -> Result:
        """The first extrinsic, or why there is none yet: `initial` with a reason.

        features: of the keyframes.
        """
        method, tried = self.config.initial.method, list[Result]()
        if method in (MOTION, AUTO):
            tried.append(self._from_motion(calibrator, features, initial, progress))
        if method in (*BY_CLASSES, AUTO) and not any(r.converged for r in tried):
            tried.append(self._from_classes(calibrator, features, initial, progress))
        failed = method == AUTO and self._tried_at is not None and not any(r.converged for r in tried)
        # No classes may come any more that the guess would wait for.
        if failed and (
            calibrator.segmentation.missing(IMAGE, CLOUD) or len(views_of(features)) >= self.config.online.min_keyframes
        ):
            nominal = calibrator.estimate(features, initial.T_camera_lidar, NOMINAL_BOX, progress)
            tried.append(replace(nominal, origin=InitialSource.NOMINAL))
        best = better(tried)
        if best.converged:
            return best
        reason = joined(list(dict.fromkeys(r.reason for r in tried)))
        return replace(best, T_camera_lidar=initial.T_camera_lidar, reason=reason)

    def _from_motion(
        self, calibrator: Calibrator, features: Sequence[FrameFeatures], initial: Result, progress: Callback | None
    ) -> Result:
        with self._lock:
            run = list(self._run)
            newest = run[-1].moment_of_cloud if run else 0
            waits = self._tried_at is not None and (newest - self._tried_at) / NANOSECONDS < NEW_S
        lasted = self._lasted(run)
        if waits:
            return self._insufficient(initial, self._failure)
        if lasted < ENOUGH_S:
            so_far = f", {lasted:.1f} s so far" if lasted else ""
            return self._insufficient(initial, f"waiting for {ENOUGH_S:g} s of driving{so_far}")
        if progress is not None:
            progress("first guess", 0.0)  # where the estimate may be cancelled
        try:
            guess = motion_guess(run, calibrator.extract, self.config.search.seed)
        except (BadInputError, TooFewFeaturesError, MissingDependencyError) as error:
            self._tried_at, self._failure = newest, str(error)
            return self._insufficient(initial, str(error))

        def register(T: Transform, box: SearchBox) -> Result:
            return calibrator.estimate(features, T, box, progress)

        hypotheses = [PoseHypothesis(T, 1.0, 0.0, MOTION, 0) for T in guess.hypotheses]
        result, _ = best_registration(hypotheses, register, guess.box)
        self._tried_at, self._failure = newest, result.reason
        return replace(result, reason=joined([result.reason, guess.note]), origin=InitialSource.MOTION)

    def _from_classes(
        self, calibrator: Calibrator, features: Sequence[FrameFeatures], initial: Result, progress: Callback | None
    ) -> Result:
        known, needed = len(views_of(features)), self.config.online.min_keyframes
        if known < needed:
            missing = calibrator.segmentation.missing(IMAGE, CLOUD)
            so_far = f", {known} so far" if known else ""
            return self._insufficient(initial, missing or f"waiting for the classes of {needed} keyframes{so_far}")
        return calibrator.guess(features, progress=progress, method=self.config.initial.method)

    def forget_unmatched(self) -> None:
        """Other keyframes come."""
        self._unmatched = 0  # estimates since the last one that converged
        self._mixed_up: Result | None = None  # what was found of these

    def explained(
        self,
        result: Result,
        calibrator: Calibrator,
        given: tuple[Sequence[FrameFeatures], SearchBox | None, Callback | None],
        start: Result,
    ) -> Result:
        """The result of an estimate; where nothing has matched several times, with the cause that was found then, if any. given:
        what it was estimated from, see `Calibrator.explained`. start: the initial extrinsic."""
        if result.converged:
            self.forget_unmatched()
        if result.refusal not in NO_MATCH:
            return result
        if self._unmatched + 1 == JUDGED_AFTER:
            guessed = start.origin in (InitialSource.NOMINAL, InitialSource.SEMANTIC, InitialSource.MOTION)
            self._mixed_up = calibrator.explained(result, *given, stated=not guessed)
        self._unmatched += 1
        found = self._mixed_up
        return result if found is None or found.cause is None else replace(result, cause=found.cause, reason=found.reason)

    @staticmethod
    def _insufficient(initial: Result, why: str) -> Result:
        reason = f"nothing is known of the extrinsic: {why}" if why else "nothing is known of the extrinsic"
        return replace(initial, status=INSUFFICIENT, reason=reason, frames_used=0)

    @staticmethod
    def _lasted(run: Sequence[Frame] | deque[Frame]) -> float:
        """s from the first to the last frame."""
        return (run[-1].moment_of_cloud - run[0].moment_of_cloud) / NANOSECONDS if run else 0.0


def classes_of(
    frame: Frame,
    calibrator: Calibrator,
    reach: tuple[Sequence[Transform], SearchBox] | None,
    in_doubt: bool,
    cancelled: Callable[[], bool],
) -> FrameSemantics:
    """Semantics of a keyframe, which takes seconds: for a first guess, or for estimates.

    reach: (4, 4) extrinsics at which the box of a search begins, outside of which points need no classes; None = first guess.
    in_doubt: the last estimate was. cancelled: see Segmentation.
    """
    if reach is None:
        return calibrator.segmentation(frame, cancelled, CLASSES, None)
    points = reduce(np.union1d, [points_in_reach(frame, calibrator.extract, T, reach[1]) for T in reach[0]])
    return calibrator.segmentation(frame, cancelled, ALL if in_doubt else calibrator.kinds_without_doubt or ALL, points)
