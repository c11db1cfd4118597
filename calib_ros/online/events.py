"""What the pipeline tells its owner, and what it asks it for; and what people are told of it, few enough lines to be read."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from calib_ros.arrays import Transform
from calib_ros.camera import Camera
from calib_ros.errors import CalibrationError, TooFewFeaturesError, defect, raised_at
from calib_ros.frame import Frame, PointCloud
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.online.sensor_health import SensorFault, SensorProblem
from calib_ros.result import Extrinsic, Result

REPEAT_S, LONGEST_S = 10.0, 60.0  # of lines of a kind, whatever their figures, one is written in so long, then in twice as long


@dataclass(frozen=True, eq=False)
class FrameIngested:
    """A pair was decoded and ingested. is_keyframe: it is one of the keyframes now. image, cloud: its messages."""

    frame: Frame
    is_keyframe: bool
    image: Any
    cloud: Any


@dataclass(frozen=True, eq=False)
class ExtrinsicUpdated:
    """The current extrinsic or its status has changed. stamp: ns, of the newest data it was tested with; 0 before any."""

    extrinsic: Extrinsic
    stamp: int


@dataclass(frozen=True)
class Problem:
    """Something that a person should know, in one line. kind: what counts as the same, whatever figures the message gives.
    solved: it is well again."""

    message: str
    kind: str
    solved: bool = False


@dataclass(frozen=True)
class IntakeIdle:
    """All pairs so far are worked off."""


Event = FrameIngested | ExtrinsicUpdated | Problem | IntakeIdle


@dataclass(frozen=True)
class Inputs:
    """What the pipeline asks its owner for, on worker threads.

    decode: image message, cloud message and camera -> frame. frame_ids: image and cloud message -> names of the camera frame and
    the LiDAR frame. initial: camera, camera frame and LiDAR frame -> extrinsic to start from; None = not known yet, to be asked
    again with the next pair. decode_cloud: cloud message -> its points, for scans whose pair was dropped, and to find when scans
    sweep the view; without it they belong to their stamps at first. vehicle_frames: names of camera frame and LiDAR frame ->
    T_camera_F (4, 4) of other frames F of the vehicle, by name.
    """

    decode: Callable[[Any, Any, Camera], Frame]
    frame_ids: Callable[[Any, Any], tuple[str, str]]
    initial: Callable[[Camera, str, str], Result | None]
    decode_cloud: Callable[[Any], PointCloud] | None = None
    vehicle_frames: Callable[[str, str], Mapping[str, Transform]] = lambda camera_frame, lidar_frame: {}


class Remarks:
    """What a person is told of the inputs and the threads: when something begins, and when it is over. Not thread-safe."""

    def __init__(self, tell: Callable[[Event], None]) -> None:
        self._tell = tell
        self._missing: set[str] = set()  # kinds of what the newest keyframe lacked
        self._fault: SensorProblem | None = None

    def note_what_is_missing(self, recalibrator: Recalibrator, keyframe: Frame) -> None:
        """Tell what the estimates have to do without, once it begins to be missing."""
        newest, times = recalibrator.newest(), keyframe.cloud.time_problem
        notes = {
            "motion": recalibrator.motion.missing,
            "times of points": times and f"{times}; until then the clouds count as without point times",
        }
        if newest is not None and not newest.has_reflectivity:
            notes["intensity"] = "the cloud has no intensity: reflectivity edges are off, everything else works"
        missing = {kind for kind, note in notes.items() if note}
        for kind in sorted(missing - self._missing):
            self._tell(Problem(notes[kind], kind))
        self._missing = missing

    def note_sensors(self, recalibrator: Recalibrator) -> None:
        """Tell when a sensor begins to show nothing, when it is for another reason, and when both work again."""
        fault = recalibrator.tracker.sensor_problem
        if fault == self._fault or (fault is None and recalibrator.sensors.faulty_frames):  # in doubt after a restart
            return
        self._fault = fault
        well = Problem("camera and LiDAR work again", "sensors", solved=True)
        self._tell(well if fault is None else Problem(fault.message, fault.fault.value))

    def report(self, error: Exception) -> None:
        """Of a worker, its kind being where it was raised: a defect of ours says what it is, and the node goes on."""
        if isinstance(error, TooFewFeaturesError) and self._fault is not None and self._fault.fault is SensorFault.LIDAR_BLIND:
            return  # which is told once, and not with every frame
        self._tell(Problem(str(error) if isinstance(error, CalibrationError) else defect(error), raised_at(error)))


class QuietLog:
    """Counts what comes soon after the last line of its kind, see REPEAT_S; the newest is written afterwards. Thread-safe.

    now: s, by a steady clock.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now, self._lock = now, threading.Lock()
        # Of each kind when its last line was written, for how long, how many have come since, and what writes the newest of them.
        self._told: dict[str, tuple[float, float, int, Callable[[str], object]]] = {}

    def add(self, kind: str, text: str, write: Callable[[str], object]) -> None:
        """A line. kind: what counts as the same, whatever the text. write: takes the text when its time has come."""
        with self._lock:
            now = self._now()
            at, wait, left_out, _ = self._told.get(kind, (-math.inf, 0.5 * REPEAT_S, 0, write))
            if now - at >= wait:
                self._told[kind] = now, min(2 * wait, LONGEST_S), 0, write
                write(text + _more(left_out, wait))
            else:
                self._told[kind] = at, wait, left_out + 1, lambda more: write(text + more)

    def catch_up(self) -> None:
        """Write what has been left out long enough; to be called about once a second."""
        with self._lock:
            now = self._now()
            for kind, (at, wait, left_out, write) in list(self._told.items()):
                if now - at >= wait:
                    del self._told[kind]
                    if left_out:
                        self._told[kind] = now, min(2 * wait, LONGEST_S), 0, write
                        write(_more(left_out - 1, wait))


def _more(count: int, seconds: float) -> str:
    return f" ({count} more in {seconds:g} s)" if count else ""
