"""Checks of an extrinsic over the keyframes that are there: who asks for one, when it is made, and what came of it.

A check is made of the keyframes' features alone. Mirrored and turned pictures, and other lenses, are tried on the edge maps;
other cameras of pictures with a distortion are not, since those have to be rectified anew. Classes, which a check asks for in
doubt, are those that keyframes have already.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.datasets.positions import spread_positions
from calib_ros.errors import BadInputError, CalibrationError
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.online.worker import Cancelled
from calib_ros.registration.progress import Callback
from calib_ros.registration.search.parallel import cpu_time
from calib_ros_check.causes import distorts
from calib_ros_check.checker import Checker
from calib_ros_check.outcome import CheckResult, Tolerance, Verdict

Matrix = NDArray[np.float64]
# Different requests: a check takes seconds, and somebody who asks in a loop must not keep estimates away for long.
MAX_WAITING = 8
NO_PAIR = "no pair of image and cloud arrived yet; check the topics with 'ros2 topic hz'"
NO_KEYFRAME = "no keyframe to check by yet: wait for images and clouds, or drive on"
TOO_MANY = f"{MAX_WAITING} checks wait already; ask again when one of them is answered"
ENDED = "the check was ended: the node is stopping"
NO_VEHICLE_FRAMES = "whether the points are in another frame of the vehicle was not tried: /tf_static is not read, or has none"
NO_PICTURES = (
    "whether the image is rectified already, or CameraInfo is of another image size, was not tried: keyframes have no pictures; "
    "check a recording with 'calib-ros check'"
)
NO_FISHEYE = (
    "whether the image is an unrectified fisheye's was not tried: keyframes have no pictures; check a recording with 'calib-ros "
    "check'"
)
NO_CLASSES = "classes were not used: no keyframe has any yet"


@dataclass(frozen=True, eq=False)
class CheckRequest:
    """What is to be checked.

    T_camera_lidar: (4, 4), None = the current extrinsic when the check begins. max_keyframes: how many are used at most, evenly
    spread over the buffer; 0 = all. Raises BadInputError for what is no rigid transform, or a negative number.
    """

    tolerance: Tolerance = field(default_factory=Tolerance)
    T_camera_lidar: Matrix | None = None
    max_keyframes: int = 0

    def __post_init__(self) -> None:
        if self.T_camera_lidar is not None:
            object.__setattr__(self, "T_camera_lidar", se3.as_transform(self.T_camera_lidar, "the extrinsic to be checked"))
        if self.max_keyframes < 0:
            raise BadInputError(f"a check by at most {self.max_keyframes} keyframes is not possible; give 0 for all of them")

    def asks_the_same_as(self, other: CheckRequest) -> bool:
        """True if one check answers both."""
        mine, theirs = self.T_camera_lidar, other.T_camera_lidar
        same = mine is theirs if mine is None or theirs is None else np.array_equal(mine, theirs)
        return same and (self.tolerance, self.max_keyframes) == (other.tolerance, other.max_keyframes)


@dataclass(frozen=True, eq=False)
class CheckOutcome:
    """What a check has found. of_current: it was asked for the current extrinsic. made_at: s, by time.monotonic()."""

    result: CheckResult
    of_current: bool
    made_at: float


Check = Callable[[CheckRequest, Callback], CheckOutcome]


class Checks:
    """Requests for a check. One is made at a time, in the order of the requests; requests for the same share one that has not
    begun. Thread-safe.

    A request is a future; cancel() ends it while it waits, for all who share it.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: deque[tuple[CheckRequest, Future[CheckOutcome]]] = deque()
        self._running: Future[CheckOutcome] | None = None
        self._refusal = ""

    @property
    def waiting(self) -> bool:
        """True while a check is asked for that has not begun."""
        with self._lock:
            return bool(self._waiting)

    def add(self, request: CheckRequest, obstacle: str = "") -> Future[CheckOutcome]:
        """A new request. It fails at once with a CalibrationError if there is an obstacle, requests are refused, or too many
        wait."""
        future: Future[CheckOutcome] = Future()
        with self._lock:
            shared = next((own for asked, own in self._waiting if asked.asks_the_same_as(request) and not own.cancelled()), None)
            problem = self._refusal or obstacle or (TOO_MANY if shared is None and len(self._waiting) >= MAX_WAITING else "")
            if not problem and shared is not None:
                return shared
            if not problem:
                self._waiting.append((request, future))
                return future
        future.set_exception(CalibrationError(problem))
        return future

    def run_next(self, check: Check, check_cancelled: Callable[[], None]) -> CheckOutcome | None:
        """Make the check that has waited longest, on this thread; None if none waits, or it has no outcome. Raises nothing: what
        goes wrong is the future's.

        check_cancelled: raises Cancelled where the thread is to end.
        """
        begun = self._begin()
        if begun is None:
            return None
        request, future = begun

        def progress(stage: str, share: float) -> None:
            check_cancelled()
            if self._running is not future:  # refused meanwhile
                raise Cancelled

        outcome: CheckOutcome | None = None
        error: Exception | None = None
        try:
            progress("", 0.0)
            outcome = check(request, progress)
        except Cancelled:
            error = CalibrationError(ENDED)
        except Exception as caught:
            error = caught
        with self._lock:
            mine, self._running = self._running is future, None
        if not mine:
            return None  # answered already
        if outcome is not None:
            future.set_result(outcome)
        else:
            future.set_exception(error)
        return outcome

    def refuse(self, reason: str) -> None:
        """Fail all requests with a CalibrationError, new ones too, and end the check under way."""
        with self._lock:
            self._refusal = reason
            failed = [future for _, future in self._waiting if future.set_running_or_notify_cancel()]
            failed += [self._running] if self._running is not None else []
            self._running = None
            self._waiting.clear()
        for future in failed:
            future.set_exception(CalibrationError(reason))

    def accept(self) -> None:
        """Take requests again."""
        with self._lock:
            self._refusal = ""

    def _begin(self) -> tuple[CheckRequest, Future[CheckOutcome]] | None:
        with self._lock:
            while self._waiting:
                request, future = self._waiting.popleft()
                if future.set_running_or_notify_cancel():
                    self._running = future
                    return request, future
        return None


def obstacle_to_check(recalibrator: Recalibrator | None) -> str:
    """Why nothing can be checked now, for a person; "" if it can."""
    if recalibrator is None:
        return NO_PAIR
    return "" if len(recalibrator.buffer) else NO_KEYFRAME


def check_keyframes(
    recalibrator: Recalibrator,
    request: CheckRequest,
    progress: Callback | None = None,
    vehicle_frames: Mapping[str, Matrix] | None = None,
) -> CheckOutcome:
    """Check an extrinsic by the keyframes; of the recalibrator nothing changes.

    progress, vehicle_frames: as of `Checker.check`; without frames of the vehicle none are tried. CalibrationError if there is
    no keyframe.
    """
    started, cpu = time.perf_counter(), cpu_time()
    kept, config, current = recalibrator.evidence()
    if not kept:
        raise CalibrationError(NO_KEYFRAME)
    chosen = [kept[k] for k in spread_positions(request.max_keyframes or len(kept), len(kept))]
    of_current = request.T_camera_lidar is None
    T = current.T_camera_lidar if request.T_camera_lidar is None else request.T_camera_lidar
    has_classes = any(features.plain is not None for features in chosen)
    checker = Checker(recalibrator.camera, config, recalibrator.segmentation)
    result = checker.check_features(
        [features.plain or features for features in chosen],
        T,
        request.tolerance,
        (lambda: chosen) if has_classes else None,
        progress,
        vehicle_frames,
    )
    untried = [] if vehicle_frames else [NO_VEHICLE_FRAMES]
    untried += [NO_PICTURES] if distorts(recalibrator.camera) else []
    untried += [NO_FISHEYE] if recalibrator.camera.is_pinhole and result.cause is None else []
    notes = [] if result.verdict is Verdict.PASS else untried
    in_doubt = result.T_estimated is None
    notes += [NO_CLASSES] if in_doubt and recalibrator.segmentation.active and not has_classes else []
    result = replace(
        result,
        notes=(*result.notes, *notes),
        camera_frame=current.camera_frame,
        lidar_frame=current.lidar_frame,
        elapsed_s=time.perf_counter() - started,
        cpu_s=cpu_time() - cpu,  # of this thread: others of the process work meanwhile
    )
    return CheckOutcome(result, of_current, time.monotonic())
