"""Is what is wrong with a recording named rightly? Every cause that a check knows, injected into recordings of many rigs.

    python -m benchmarks.check_study [SOURCE ...] [--frames 8] [--causes mirrored_image ...] [--csv FILE] [--cache FOLDER]

Sources are synthetic rigs by default, all of them, weaving. A row per cause: in how many recordings it was found and named, how
many had it as possible, had another cause named, failed without one, were inconclusive, or passed, and the CPU time of a check.
"""

from __future__ import annotations

import argparse
import pickle
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.contract_study import late
from benchmarks.records import append_records
from calib_ros import se3
from calib_ros.camera import Camera, Rectifier
from calib_ros.datasets import open_dataset
from calib_ros.datasets.positions import spread_positions
from calib_ros.frame import Frame
from calib_ros_check.causes import distorts
from calib_ros_check.checker import Checker
from calib_ros_check.outcome import Cause, CauseState, CheckResult, CheckVerdict
from calib_ros_synthetic.rigs import RIGS

Matrix = NDArray[np.float64]
Recording = tuple[list[Frame], Matrix]
BODY = se3.from_parts(se3.OPTICAL_FROM_BODY, np.zeros(3))
FORWARD_Y = se3.from_parts(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.zeros(3))
VEHICLE = se3.from_parts(se3.rotation_from_euler(0.0, np.deg2rad(1.0), 0.0), [1.2, 0.1, 1.7])
SCENES = ("street", "trees", "street", "car_park", "street")


@dataclass(frozen=True)
class Row:
    """What was said of a recording."""

    cause: str
    source: str
    said: str
    deg: float
    cm: float
    cpu_s: float


def with_camera(frames: Sequence[Frame], camera: Camera) -> list[Frame]:
    """The same with another CameraInfo."""
    return [replace(frame, camera=camera) for frame in frames]


def with_points(frames: Sequence[Frame], T: Matrix) -> list[Frame]:
    """The same with the points of every cloud, and what is known of its motion, moved by T (4, 4)."""
    out = []
    for frame in frames:
        xyz = se3.transform(T, frame.cloud.xyz).astype(np.float32)
        twist = None if frame.twist is None else se3.adjoint(T) @ frame.twist
        out.append(replace(frame, cloud=replace(frame.cloud, xyz=xyz), twist=twist))
    return out


def focal(frames: Sequence[Frame], T: Matrix, number: int) -> Recording:
    """A focal length 4 % wrong."""
    K = frames[0].camera.K.copy()
    K[0, 0], K[1, 1] = K[[0, 1], [0, 1]] * (1.04 if number % 2 else 0.96)
    return with_camera(frames, replace(frames[0].camera, K=K)), T


def principal_point(frames: Sequence[Frame], T: Matrix, number: int) -> Recording:
    """A principal point 5 % of the image width beside."""
    K = frames[0].camera.K.copy()
    K[number % 2, 2] += (0.05 if number % 4 < 2 else -0.05) * frames[0].camera.width
    return with_camera(frames, replace(frames[0].camera, K=K)), T


def other_camera(frames: Sequence[Frame], T: Matrix, number: int) -> Recording:
    """CameraInfo of another lens, or of another size of the same image."""
    camera = frames[0].camera
    if number % 2:
        K = camera.K * np.array([[0.5, 1, 0.5], [1, 0.5, 0.5], [1, 1, 1]])
    else:
        K = camera.K * np.array([[1.35, 1, 1.06], [1, 1.35, 0.95], [1, 1, 1]])
    return with_camera(frames, replace(camera, K=K)), T


def not_rectified(frames: Sequence[Frame], T: Matrix, number: int) -> Recording:
    """A distorted image that is called rectified."""
    camera = frames[0].camera
    if distorts(camera):
        return with_camera(frames, Camera(camera.K, camera.width, camera.height)), T
    lens = replace(camera, D=np.array([-0.25, 0.06, 0.0, 0.0, 0.0]))
    grid = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1).reshape(-1, 1, 2).astype(np.float64)
    at = cv2.undistortPoints(grid, lens.K, lens.D, P=lens.K).reshape(camera.height, camera.width, 2).astype(np.float32)
    return [replace(f, image=cv2.remap(f.image, at[..., 0], at[..., 1], cv2.INTER_LINEAR)) for f in frames], T


def already_rectified(frames: Sequence[Frame], T: Matrix, number: int) -> Recording:
    """A rectified image whose CameraInfo has the distortion of the one that was recorded."""
    camera = frames[0].camera
    if not distorts(camera):
        return with_camera(frames, replace(camera, D=np.array([-0.25, 0.06, 0.0, 0.0, 0.0]))), T
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
    """Points in a frame of the vehicle, or with y forward."""
    return with_points(frames, VEHICLE if number % 2 else FORWARD_Y), T


INJECTED: dict[str, tuple[Callable[[Sequence[Frame], Matrix, int], Recording], tuple[Cause, ...]]] = {
    "none": (lambda frames, T, number: (list(frames), T), ()),
    "time_offset": (
        lambda frames, T, number: ([late(f, (0.1, -0.08, 0.06, -0.05)[number % 4]) for f in frames], T),
        (Cause.TIME_OFFSET,),
    ),
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


def recordings(sources: Sequence[str], frames: int, cache: Path | None) -> dict[str, list[Frame]]:
    """Frames by source, kept in a folder between runs."""
    out = {}
    for source in sources:
        kept = None if cache is None else cache / f"{source.replace('/', '_')[-100:]}.pkl"
        if kept is not None and kept.exists():
            out[source] = pickle.loads(kept.read_bytes())
            continue
        opened = open_dataset(source)
        out[source] = [opened[k] for k in spread_positions(frames, len(opened))]
        if kept is not None:
            kept.parent.mkdir(parents=True, exist_ok=True)
            kept.write_bytes(pickle.dumps(out[source]))
        print(f"read {source}", file=sys.stderr, flush=True)
    return out


def default_sources(frames: int) -> list[str]:
    """Every rig, in scenes that differ."""
    return [
        f"synthetic:rig={rig},scene={'warehouse' if rig == 'vlp16_upside_down' else SCENES[k % 5]},seed={40 + k},"
        f"frames={frames},stride=13,ride=weaving" + (",width=1280" if rig == "pandar64_truck" else "")
        for k, rig in enumerate(RIGS)
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="*")
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--causes", nargs="+", choices=list(INJECTED), default=list(INJECTED))
    parser.add_argument("--csv", type=Path)
    parser.add_argument("--cache", type=Path)
    args = parser.parse_args()
    rows = []
    kept = recordings(args.sources or default_sources(args.frames), args.frames, args.cache)
    for name in args.causes:
        inject, right = INJECTED[name]
        counts: Counter[str] = Counter()
        cpu = []
        for number, (source, frames) in enumerate(kept.items()):
            truth = frames[0].reference
            assert truth is not None
            wrong, T = inject(frames, truth, number)
            result = Checker(wrong[0].camera).check(wrong, T)
            said = outcome(result, right)
            counts[said] += 1
            cpu.append(result.cpu_s)
            off = result.rotation.error, 100 * result.translation.error
            rows.append(Row(name, source, said, *off, result.cpu_s))
            size = f"{off[0]:6.2f} deg {off[1]:6.1f} cm {result.cpu_s:5.1f} s"
            print(f"{name:18s} {source[:60]:60s} {said:24s} {size}  {result.reason[:130]}")
            sys.stdout.flush()
        print(f"| {name} | {', '.join(f'{what} {n}' for what, n in counts.most_common())} | {np.median(cpu):.1f} s |", flush=True)
    append_records(args.csv, rows)


if __name__ == "__main__":
    main()
