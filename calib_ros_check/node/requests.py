"""Checks of an extrinsic over the keyframes that are there: who asks for one, when it is made, and what came of it.

A check is made of the keyframes' features alone. Mirrored and turned pictures, and other lenses, are tried on the edge maps;
other cameras of pictures with a distortion are not, since those have to be rectified anew. Classes, which a check asks for in
doubt, are those that keyframes have already.
"""

from __future__ import annotations

import time
from collections.abc import Hashable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field, replace

from calib_ros import se3
from calib_ros.arrays import Matrix, Transform
from calib_ros.datasets.source import spread_positions
from calib_ros.errors import BadInputError, CalibrationError
from calib_ros.online.pipeline import Pipeline
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.online.worker import Pending
from calib_ros.registration.judgement.hypotheses import distorts
from calib_ros.registration.progress import Callback
from calib_ros.registration.search.parallel import cpu_time
from calib_ros_check.checker import Checker, CheckInputs
from calib_ros_check.outcome import CheckResult, CheckVerdict, Tolerance

NO_PAIR = "no pair of image and cloud arrived yet; check the topics with 'ros2 topic hz'"
NO_KEYFRAME = "no keyframe to check by yet: wait for images and clouds, or drive on"
NO_VEHICLE_FRAMES = "whether the points are in another frame of the vehicle was not tried: /tf_static is not read, or has none"
NO_PICTURES = "whether {} was not tried: keyframes have no pictures; check a recording with 'calib-ros check'"
NO_CAMERA = NO_PICTURES.format("the image is rectified already, or CameraInfo is of another image size,")
NO_FISHEYE = NO_PICTURES.format("the image is an unrectified fisheye's")
NO_CLASSES = "classes were not used: no keyframe has any yet"


@dataclass(frozen=True, eq=False)
class CheckRequest:
    """What is to be checked.

    T_camera_lidar: (4, 4), None = the current extrinsic when the check begins. max_keyframes: how many are used at most, evenly
    spread over the buffer; 0 = all. Raises BadInputError for what is no rigid transform, or a negative number.
    """

    tolerance: Tolerance = field(default_factory=Tolerance)
    T_camera_lidar: Transform | None = None
    max_keyframes: int = 0

    def __post_init__(self) -> None:
        if self.T_camera_lidar is not None:
            object.__setattr__(self, "T_camera_lidar", se3.as_transform(self.T_camera_lidar, "the extrinsic to be checked"))
        if self.max_keyframes < 0:
            raise BadInputError(f"a check by at most {self.max_keyframes} keyframes is not possible; give 0 for all of them")

    @property
    def key(self) -> Hashable:
        """One check answers all requests with the same."""
        return self.tolerance, None if self.T_camera_lidar is None else self.T_camera_lidar.tobytes(), self.max_keyframes


@dataclass(frozen=True, eq=False)
class CheckOutcome:
    """What a check has found. of_current: it was asked for the current extrinsic. made_at: s, by time.monotonic()."""

    result: CheckResult
    of_current: bool
    made_at: float


def request_check(pipeline: Pipeline, request: CheckRequest) -> Future[CheckOutcome]:
    """Check an extrinsic by the keyframes, after estimates and checks under way; it changes nothing.

    The future holds the outcome, or an exception: a CalibrationError where nothing can be checked.
    """

    def work(progress: Callback) -> CheckOutcome:
        if pipeline.recalibrator is None:  # dropped since it was asked for
            raise CalibrationError(NO_PAIR)
        return check_keyframes(pipeline.recalibrator, request, progress, pipeline.vehicle_frames())

    recalibrator = pipeline.recalibrator
    obstacle = NO_PAIR if recalibrator is None else "" if len(recalibrator.keyframes) else NO_KEYFRAME
    return pipeline.defer(Pending("check", request.key, work), obstacle)


def check_keyframes(
    recalibrator: Recalibrator,
    request: CheckRequest,
    progress: Callback | None = None,
    vehicle_frames: Mapping[str, Matrix] | None = None,
) -> CheckOutcome:
    """Check an extrinsic by the keyframes; of the recalibrator nothing changes.

    progress, vehicle_frames: as of `Checker.check`; None = no clouds in other frames are tried. CalibrationError: no keyframe.
    """
    started, cpu = time.perf_counter(), cpu_time()
    kept, config, current = recalibrator.snapshot()
    if not kept:
        raise CalibrationError(NO_KEYFRAME)
    chosen = [kept[k].edges_only for k in spread_positions(request.max_keyframes or len(kept), len(kept))]
    of_current = request.T_camera_lidar is None
    T = current.T_camera_lidar if request.T_camera_lidar is None else request.T_camera_lidar
    has_classes = any(features.plain is not None for features in chosen)
    checker = Checker(recalibrator.camera, config, recalibrator.segmentation)
    classified = (lambda numbers: [chosen[k] for k in numbers]) if has_classes else None
    inputs = CheckInputs(T, request.tolerance, classified, None, vehicle_frames or {}, progress)
    result = checker.check_features([features.plain or features for features in chosen], inputs)
    untried = [] if vehicle_frames else [NO_VEHICLE_FRAMES]
    untried += [NO_CAMERA] if distorts(recalibrator.camera) else []
    untried += [NO_FISHEYE] if recalibrator.camera.is_pinhole and result.cause is None else []
    notes = [] if result.verdict is CheckVerdict.PASS else untried
    notes += [NO_CLASSES] if result.T_estimated is None and recalibrator.segmentation.active and not has_classes else []
    result = replace(
        result,
        notes=(*result.notes, *notes),
        camera_frame=current.camera_frame,
        lidar_frame=current.lidar_frame,
        elapsed_s=time.perf_counter() - started,
        cpu_s=cpu_time() - cpu,  # of this thread: others of the process work meanwhile
    )
    return CheckOutcome(result, of_current, time.monotonic())
