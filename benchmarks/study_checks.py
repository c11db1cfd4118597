"""Is what is wrong with a recording named rightly? Every cause that a check knows, injected into recordings of many rigs."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.records import markdown
from benchmarks.sources import in_other_frame, late, with_intrinsics
from benchmarks.study_runner import Case, End, FeaturesOf, Record, Study, Variant
from calib_ros import se3
from calib_ros.camera import Camera, Rectifier
from calib_ros.datasets import open_dataset
from calib_ros.datasets.positions import spread_positions
from calib_ros.frame import Frame
from calib_ros.registration.calibrator import Calibrator
from calib_ros_check.causes import distorts
from calib_ros_check.checker import Checker
from calib_ros_check.outcome import Cause, CauseState, CheckResult, CheckVerdict
from calib_ros_synthetic.rigs import RIGS

Matrix = NDArray[np.float64]
Recording = tuple[list[Frame], Matrix]
BODY = se3.from_parts(se3.OPTICAL_FROM_BODY, np.zeros(3))
FORWARD_Y = se3.from_parts(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.zeros(3))
VEHICLE = se3.from_parts(se3.rotation_from_euler(0.0, np.deg2rad(1.0), 0.0), [1.2, 0.1, 1.7])
BARREL = np.array([-0.25, 0.06, 0.0, 0.0, 0.0])  # plumb_bob
FRAMES = 8
SCENES = ("street", "trees", "street", "car_park", "street")


def with_camera(frames: Sequence[Frame], camera: Camera) -> list[Frame]:
    """The same with another CameraInfo."""
    return [replace(frame, camera=camera) for frame in frames]


def focal(frames: Sequence[Frame], T: Matrix, number: int) -> Recording:
    """A focal length 4 % wrong."""
    return [with_intrinsics(frame, 0.04 if number % 2 else -0.04) for frame in frames], T


def principal_point(frames: Sequence[Frame], T: Matrix, number: int) -> Recording:
    """A principal point 5 % of the image width beside."""
    off = np.eye(2)[number % 2] * (0.05 if number % 4 < 2 else -0.05) * frames[0].camera.width
    return [with_intrinsics(frame, centre_px=off) for frame in frames], T


def other_camera(frames: Sequence[Frame], T: Matrix, number: int) -> Recording:
    """CameraInfo of another lens, or of another size of the same image."""
    camera = frames[0].camera
    other = [[0.5, 1, 0.5], [1, 0.5, 0.5], [1, 1, 1]] if number % 2 else [[1.35, 1, 1.06], [1, 1.35, 0.95], [1, 1, 1]]
    return with_camera(frames, replace(camera, K=camera.K * np.array(other))), T


def not_rectified(frames: Sequence[Frame], T: Matrix, number: int) -> Recording:
    """A distorted image that is called rectified."""
    camera = frames[0].camera
    if distorts(camera):
        return with_camera(frames, Camera(camera.K, camera.width, camera.height)), T
    grid = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1).reshape(-1, 1, 2).astype(np.float64)
    at = cv2.undistortPoints(grid, camera.K, BARREL, P=camera.K).reshape(camera.height, camera.width, 2).astype(np.float32)
    return [replace(f, image=cv2.remap(f.image, at[..., 0], at[..., 1], cv2.INTER_LINEAR)) for f in frames], T


def already_rectified(frames: Sequence[Frame], T: Matrix, number: int) -> Recording:
    """A rectified image whose CameraInfo has the distortion of the one that was recorded."""
    camera = frames[0].camera
    if not distorts(camera):
        return with_camera(frames, replace(camera, D=BARREL)), T
    rectify = Rectifier(camera)
    K = rectify.camera.K
    return with_camera([replace(f, image=rectify(f.image)) for f in frames], replace(camera, K=K)), T


def mirrored(frames: Sequence[Frame], T: Matrix, number: int) -> Recording:
    """Images mirrored left to right, or upside down."""
    flip = 0 if number % 4 == 3 else 1
    return [replace(f, image=np.ascontiguousarray(np.flip(f.image, flip))) for f in frames], T


def rotated(frames: Sequence[Frame], T: Matrix, number: int) -> Recording:
    """Images upside down."""
    return [replace(f, image=np.ascontiguousarray(f.image[::-1, ::-1])) for f in frames], T


def body_frame(frames: Sequence[Frame], T: Matrix, number: int) -> Recording:
    """The transform of camera_link, every other time given the wrong way round."""
    link = se3.inverse(BODY) @ T
    return list(frames), se3.inverse(link) if number % 2 else link


def cloud_frame(frames: Sequence[Frame], T: Matrix, number: int) -> Recording:
    """Points in a frame of the vehicle, or with y forward, while the extrinsic stays."""
    moved = (in_other_frame(frame, VEHICLE if number % 2 else FORWARD_Y) for frame in frames)
    return [replace(other, reference=frame.reference) for other, frame in zip(moved, frames, strict=True)], T


def times(frames: Sequence[Frame], T: Matrix, number: int) -> Recording:
    """Clocks that disagree."""
    return [late(frame, (0.1, -0.08, 0.06, -0.05)[number % 4]) for frame in frames], T


INJECTED: dict[str, tuple[Callable[[Sequence[Frame], Matrix, int], Recording], tuple[Cause, ...]]] = {
    "none": (lambda frames, T, number: (list(frames), T), ()),
    "time_offset": (times, (Cause.TIME_OFFSET,)),
    "focal_length": (focal, (Cause.FOCAL_LENGTH, Cause.OTHER_CAMERA)),
    "principal_point": (principal_point, (Cause.PRINCIPAL_POINT, Cause.OTHER_CAMERA)),
    "other_camera": (other_camera, (Cause.OTHER_CAMERA, Cause.FOCAL_LENGTH)),
    "not_rectified": (not_rectified, (Cause.NOT_RECTIFIED,)),
    "already_rectified": (already_rectified, (Cause.ALREADY_RECTIFIED, Cause.NOT_RECTIFIED)),
    "mirrored_image": (mirrored, (Cause.MIRRORED_IMAGE,)),
    "rotated_image": (rotated, (Cause.ROTATED_IMAGE,)),
    "inverse_transform": (lambda frames, T, number: (list(frames), se3.inverse(T)), (Cause.INVERSE_TRANSFORM,)),
    "body_frame": (body_frame, (Cause.BODY_FRAME,)),
    "cloud_frame": (cloud_frame, (Cause.CLOUD_FRAME,)),
}


def outcome(result: CheckResult, right: Sequence[Cause]) -> str:
    """One word about a check."""
    if result.verdict is CheckVerdict.FAIL:
        if result.cause is None:
            possible = any(finding.state is CauseState.POSSIBLE and finding.cause in right for finding in result.causes)
            return "possible" if possible else "fails without a cause"
        return "named" if result.cause in right else f"as {result.cause.value}"
    return "passes" if result.verdict is CheckVerdict.PASS else "inconclusive"


def recordings(args: argparse.Namespace) -> Iterator[Case]:
    """A case of each; by default every rig, in scenes that differ, weaving."""
    rigs = [
        f"synthetic:rig={rig},scene={'warehouse' if rig == 'vlp16_upside_down' else SCENES[k % 5]},seed={40 + k},"
        f"frames={FRAMES},stride=13,ride=weaving" + (",width=1280" if rig == "pandar64_truck" else "")
        for k, rig in enumerate(RIGS)
    ]
    for number, name in enumerate(args.sources or rigs):
        source = open_dataset(name)
        yield Case(name, [source[k] for k in spread_positions(FRAMES, len(source))], number)


def checked(calibrator: Calibrator, case: Case, features: FeaturesOf, trial: int) -> End:
    """status: what is said of it."""
    inject, right = INJECTED[case.variant]
    wrong, T = inject(case.frames, case.truth, case.number)
    result = Checker(wrong[0].camera).check(wrong, T)
    return End(result.rotation.error, 100 * result.translation.error, outcome(result, right), result.reason, cpu_s=result.cpu_s)


def table(records: Sequence[Record]) -> str:
    """A row per cause: in how many recordings it was found and named, how many had it as possible, had another cause named,
    failed without one, were inconclusive, or passed, and the CPU time of a check."""
    rows = []
    for cause in INJECTED:
        if own := [r for r in records if r.variant == cause]:
            said = Counter(r.status for r in own).most_common()
            rows.append([cause, ", ".join(f"{what} {n}" for what, n in said), f"{np.median([r.cpu_s for r in own]):.1f} s"])
    return markdown(["injected", "said", "CPU"], rows)


STUDY = Study(recordings, checked, dict.fromkeys(INJECTED, Variant()), table=table)
