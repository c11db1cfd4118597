"""Is anything that is wrong ever called usable? A recording played to the recalibrator with one fault of a vehicle at a time.

    python -m benchmarks.contract_study SOURCE ... [--faults NAME ...] [--runs 10] [--csv FILE] [--workers N]

Every run begins up to 2 deg / 0.2 m per axis beside the extrinsic, as a TF tree may, and estimates whenever the node would.
Faults are those of the recording (intrinsics) or of the start; clocks that disagree, and clouds in another frame, tilted or
upside down are none, but have to be understood. A table per source and fault: the runs in which the extrinsic ever was `usable`
or `converged` more than 0.5 deg or 10 cm off; the status at the end; and the data's own time to the first verdict, which is a
usable extrinsic where nothing is wrong, and a refusal where something is. A study that was interrupted goes on where its --csv
ends.
"""

from __future__ import annotations

import argparse
import itertools
import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from benchmarks.records import append_records, read_records
from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.config import Config, update
from calib_ros.datasets import open_dataset
from calib_ros.errors import CalibrationError
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.registration.classes import FrameSemantics
from calib_ros.registration.features import FeatureExtractor, FrameFeatures
from calib_ros.result import CONVERGED, INITIAL, Result

Matrix = NDArray[np.float64]
RIGHT_DEG, RIGHT_M = 0.5, 0.1
START_DEG, START_M = 2.0, 0.2
CLASSES_OFF = {"semantics": {"image_classes": "", "cloud_classes": ""}}


def with_intrinsics(frame: Frame, focal: float = 0.0, centre_px: float = 0.0) -> Frame:
    """The same picture with a CameraInfo that is wrong."""
    K = frame.camera.K.copy()
    K[[0, 1], [0, 1]] *= 1 + focal
    K[0, 2] += centre_px
    camera: Camera = replace(frame.camera, K=K)
    return replace(frame, camera=camera)


def late(frame: Frame, seconds: float) -> Frame:
    """An image stamped late against the scan."""
    return replace(frame, cloud_stamp=frame.moment_of_cloud, stamp=frame.stamp + round(seconds * NANOSECONDS))


def in_other_frame(frame: Frame, T_other_cloud: Matrix) -> Frame:
    """The cloud, the twist and the extrinsic in another frame."""
    R, t = T_other_cloud[:3, :3], T_other_cloud[:3, 3]
    assert frame.reference is not None
    twist = None
    if frame.twist is not None:
        turn = R @ frame.twist[:3]
        twist = np.concatenate([turn, R @ frame.twist[3:] - np.cross(turn, t)])
    xyz = (frame.cloud.xyz @ R.T + t).astype(np.float32)
    reference = frame.reference @ se3.inverse(T_other_cloud)
    return replace(frame, cloud=replace(frame.cloud, xyz=xyz), twist=twist, reference=reference)


def turned(axis: Sequence[float], deg: float, shift: Sequence[float] = (0, 0, 0)) -> Matrix:
    """A transform (4, 4)."""
    T = se3.exp(np.concatenate([np.deg2rad(deg) * np.asarray(axis, float), np.zeros(3)]))
    T[:3, 3] = shift
    return T


@dataclass(frozen=True)
class Fault:
    """wrong: nothing may be accepted. of_start: (4, 4) by which the start is wrong, on the LiDAR's side."""

    changed: Callable[[Frame], Frame]
    wrong: bool = True
    of_start: Matrix | None = None


FAULTS = {
    "none": Fault(lambda frame: frame, wrong=False),
    "focal +5 %": Fault(partial(with_intrinsics, focal=0.05)),
    "focal -5 %": Fault(partial(with_intrinsics, focal=-0.05)),
    "principal point 20 px": Fault(partial(with_intrinsics, centre_px=20.0)),
    "images 80 ms late": Fault(partial(late, seconds=0.08), wrong=False),
    "images 50 ms early": Fault(partial(late, seconds=-0.05), wrong=False),
    "images a scan late": Fault(partial(late, seconds=0.1), wrong=False),
    "cloud tilted 20 deg": Fault(partial(in_other_frame, T_other_cloud=turned((0, 1, 0), 20.0)), wrong=False),
    "cloud upside down": Fault(partial(in_other_frame, T_other_cloud=turned((1, 0, 0), 180.0)), wrong=False),
    "cloud in base_link": Fault(partial(in_other_frame, T_other_cloud=turned((0, 0, 1), 3.0, (1.2, 0.1, 1.6))), wrong=False),
    "start upside down": Fault(lambda frame: frame, of_start=turned((1, 0, 0), 180.0)),
    "start yaw 180 deg": Fault(lambda frame: frame, of_start=turned((0, 0, 1), 180.0)),
}


@dataclass(frozen=True)
class Run:
    """ever_wrong: usable or converged beyond the limits. seconds: of data until the first verdict, NaN if there was none."""

    source: str
    fault: str
    run: int
    ever_wrong: bool
    usable_at_end: bool
    status: str
    refusal: str
    seconds: float
    deg: float
    cm: float
    reason: str


def beside(truth: Matrix, fault: Fault, seed: int) -> Matrix:
    """The start (4, 4) of a run."""
    off = np.random.default_rng([seed, 7]).uniform(-1, 1, 6)
    start = se3.exp(off * ([np.deg2rad(START_DEG)] * 3 + [START_M] * 3)) @ truth
    return start if fault.of_start is None else start @ fault.of_start


class Remembering(FeatureExtractor):
    """Features of a frame, extracted once for all runs."""

    def __init__(self, camera: Camera, config: Config, features: dict[bytes, FrameFeatures]) -> None:
        super().__init__(camera, config)
        self._features = features

    def __call__(
        self, frame: Frame, semantics: FrameSemantics | None = None, plain: FrameFeatures | None = None
    ) -> FrameFeatures:
        key = frame.name.encode() + (b"" if frame.twist is None else frame.twist.tobytes())
        if key not in self._features:
            self._features[key] = super().__call__(frame, semantics, plain)
        return self._features[key]


def play(
    frames: Sequence[Frame], fault: Fault, seed: int, features: dict[bytes, FrameFeatures]
) -> Iterator[tuple[Frame, Recalibrator]]:
    """The recalibrator after every frame. features: of frames of the same fault, which all runs share."""
    truth = frames[0].reference
    assert truth is not None
    recalibrator = Recalibrator(frames[0].camera, Result(beside(truth, fault, seed), INITIAL), update(Config(), CLASSES_OFF))
    recalibrator.calibrator.extract = Remembering(recalibrator.camera, recalibrator.config, features)
    for frame in frames:
        try:
            recalibrator.ingest(frame)
        except CalibrationError:
            continue
        if recalibrator.ready():
            recalibrator.estimate()
        yield frame, recalibrator


def measure(source: str, name: str, runs: int) -> list[Run]:
    """All runs of a fault on one source."""
    cv2.setNumThreads(1)
    fault, data = FAULTS[name], open_dataset(source)
    frames = [fault.changed(data[k]) for k in range(len(data))]
    features: dict[bytes, FrameFeatures] = {}
    out = []
    for seed in range(runs):
        began, seconds, ever_wrong = frames[0].stamp, float("nan"), False
        extrinsic, error = None, (float("nan"), float("nan"))
        for frame, recalibrator in play(frames, fault, seed, features):
            extrinsic, reference = recalibrator.current, frame.reference
            assert reference is not None
            T, status = extrinsic.result.T_camera_lidar, extrinsic.result.status
            error = se3.rotation_error_deg(reference, T), se3.translation_error_m(reference, T)
            claimed = extrinsic.usable or status == CONVERGED
            ever_wrong |= claimed and (error[0] > RIGHT_DEG or error[1] > RIGHT_M)
            verdict = extrinsic.result.refusal is not None if fault.wrong else extrinsic.usable
            if verdict and not np.isfinite(seconds):
                seconds = (frame.stamp - began) / NANOSECONDS
        if extrinsic is None:
            continue
        result = extrinsic.result
        refusal = result.refusal.value if result.refusal else ""
        out.append(
            Run(
                source,
                name,
                seed,
                ever_wrong,
                extrinsic.usable,
                result.status,
                refusal,
                seconds,
                error[0],
                100 * error[1],
                result.reason,
            )
        )
    return out


def table(runs: Sequence[Run]) -> None:
    """A line per fault and source."""
    columns = "source, fault, runs, ever wrong, usable at the end, status and refusal at the end, s to the verdict (median; most)"
    print(f"| {columns.replace(', ', ' | ')} |")
    print("|---|---|---|---|---|---|---|")
    groups: dict[tuple[str, str], list[Run]] = {}
    for run in runs:
        groups.setdefault((run.source, run.fault), []).append(run)
    for (source, fault), own in groups.items():
        ends = Counter(" ".join(filter(None, (r.status, r.refusal))) for r in own)
        found = [r.seconds for r in own if np.isfinite(r.seconds)]
        times = f"{np.median(found):.1f}; {max(found):.1f}" if found else "–"
        times += f" ({len(own) - len(found)} without)" if len(found) < len(own) else ""
        print(
            f"| {source if source.startswith('synthetic') else Path(source).name} | {fault} | {len(own)} | "
            f"{sum(r.ever_wrong for r in own)} | {sum(r.usable_at_end for r in own)} | "
            f"{', '.join(f'{n} {end}' for end, n in ends.most_common())} | {times} |"
        )


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="+")
    parser.add_argument("--faults", nargs="+", default=list(FAULTS), choices=list(FAULTS), metavar="NAME")
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--csv", type=Path)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    args = parser.parse_args()
    asked = list(itertools.product(args.sources, args.faults))
    runs = [run for run in read_records(args.csv, Run) if (run.source, run.fault) in asked and run.run < args.runs]
    counts = Counter((run.source, run.fault) for run in runs)
    if any(0 < counts[job] < args.runs for job in asked):
        parser.error(f"{args.csv} holds a study of fewer runs; give another --csv, or --runs {min(counts.values())}")
    jobs = [job for job in asked if job not in counts]
    with ProcessPoolExecutor(args.workers) as pool:
        waiting = [pool.submit(measure, source, fault, args.runs) for source, fault in jobs]
        for job in tqdm(as_completed(waiting), total=len(waiting), unit="fault", disable=None):
            runs += job.result()
            if args.csv:
                append_records(args.csv, job.result())
    table(sorted(runs, key=lambda run: (args.sources.index(run.source), args.faults.index(run.fault), run.run)))


if __name__ == "__main__":
    main()
