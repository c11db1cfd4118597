"""Is the offset between the clocks found, and does the extrinsic stay right? A recording with its image stamps altered.

    python -m benchmarks.time_offset_study SOURCE ... [--frames 0:16] [--offsets-ms -100 -60 ...] [--starts 3] [--csv FILE]

Every run searches 5 deg / 0.5 m around a start up to 2 deg / 0.2 m per axis beside the extrinsic, without classes. A row per
source and offset: the median and the largest error of the estimated offset, its standard deviation, the share of errors within
two of them, how many were accepted, their errors, how far they are from the extrinsic without an altered stamp, and the CPU time
beside that with motion.time_offset: fixed and the true offset. `standing:` in front of a source takes the same frames as if the
vehicle stood: nothing is to be found then.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.contract_study import CLASSES_OFF, late
from calib_ros import se3
from calib_ros.config import Config, update
from calib_ros.datasets import open_dataset
from calib_ros.datasets.positions import frame_positions
from calib_ros.frame import Frame
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.search.constraints import SearchBox

Matrix = NDArray[np.float64]
OFFSETS_MS = (-100.0, -60.0, -30.0, 0.0, 30.0, 60.0, 100.0)
BOX, START_DEG, START_M = SearchBox(5.0, 0.5), 2.0, 0.2
HEAD = """\
| source | offset, ms | estimated: median error, largest, ms | 1 sigma, ms | within 2 sigma | accepted | error, median | \
largest | against no offset, largest | CPU, ratio to fixed |
|---|---|---|---|---|---|---|---|---|---|"""


@dataclass(frozen=True)
class Run:
    """estimated_ms, sigma_ms: NaN = not observable. deg, cm: error. moved_deg, moved_cm: from the run at offset 0."""

    source: str
    offset_ms: float
    start: int
    status: str
    estimated_ms: float
    sigma_ms: float
    deg: float
    cm: float
    moved_deg: float
    moved_cm: float
    cpu_s: float
    cpu_fixed_s: float


def standing(frame: Frame) -> Frame:
    """The frame as if the vehicle stood: its points where they are at the image's moment."""
    return replace(frame, twist=np.zeros(6), compensated=True)


def start_of(truth: Matrix, number: int) -> Matrix:
    """(4, 4)."""
    off = np.random.default_rng([number, 7]).uniform(-1, 1, 6) * ([np.deg2rad(START_DEG)] * 3 + [START_M] * 3)
    return np.asarray(se3.exp(off) @ truth)


def measure(source: str, frames: Sequence[Frame], offsets_ms: Sequence[float], starts: int) -> list[Run]:
    """All runs of a source."""
    truth = frames[0].reference
    assert truth is not None
    runs: list[Run] = []
    at_zero: dict[int, Matrix] = {}
    for offset in sorted(offsets_ms, key=abs):  # 0 first, which the others are compared with
        altered = [late(frame, offset / 1000) for frame in frames]
        known = update(Config(), {**CLASSES_OFF, "motion": {"time_offset": "fixed", "time_offset_s": offset / 1000}})
        estimating, fixed = (Calibrator(frames[0].camera, c) for c in (update(Config(), CLASSES_OFF), known))
        features, features_fixed = [[c.extract(f) for f in altered] for c in (estimating, fixed)]
        for number in range(starts):
            start = start_of(truth, number)
            began = time.process_time()
            result = estimating.estimate(features, start, BOX)
            between = time.process_time()
            fixed.estimate(features_fixed, start, BOX)
            T = result.T_camera_lidar
            reference = at_zero.setdefault(number, T)
            seconds, sigma = result.time_offset_s, result.time_offset_sigma_s
            runs.append(
                Run(
                    *(source, offset, number, result.status),
                    np.nan if seconds is None else 1000 * seconds,
                    np.nan if sigma is None else 1000 * sigma,
                    *(se3.rotation_error_deg(truth, T), 100 * se3.translation_error_m(truth, T)),
                    *(se3.rotation_error_deg(reference, T), 100 * se3.translation_error_m(reference, T)),
                    *(between - began, time.process_time() - between),
                )
            )
    return runs


def row(runs: Sequence[Run]) -> str:
    """Of the table."""
    accepted = [r for r in runs if r.status == "converged"]
    error = np.array([abs(r.estimated_ms - r.offset_ms) for r in accepted])
    sigma = np.array([r.sigma_ms for r in accepted])
    told = np.isfinite(error)
    offset = f"{np.median(error[told]):.1f}, {error[told].max():.1f}" if told.any() else "not observable"
    spread = f"{np.median(sigma[told]):.1f}" if told.any() else "-"
    within = f"{(error[told] <= 2 * sigma[told]).sum()} of {told.sum()}" if told.any() else "-"
    deg, cm, moved_deg, moved_cm = (
        np.array([getattr(r, name) for r in accepted] or [np.nan]) for name in ("deg", "cm", "moved_deg", "moved_cm")
    )
    ratio = np.median([r.cpu_s / max(r.cpu_fixed_s, 1e-3) for r in runs])
    return (
        f"| {runs[0].source} | {runs[0].offset_ms:+.0f} | {offset} | {spread} | {within} | {len(accepted)} of {len(runs)} | "
        f"{np.median(deg):.2f}° / {np.median(cm):.1f} cm | {deg.max():.2f}° / {cm.max():.1f} cm | "
        f"{moved_deg.max():.2f}° / {moved_cm.max():.1f} cm | {ratio:.2f} |"
    )


def main() -> int:
    """Measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="+", help="as for calib-ros; `standing:SOURCE`: as if the vehicle stood")
    parser.add_argument("--frames", default="all", help="as for calib-ros calibrate (default all)")
    parser.add_argument("--offsets-ms", type=float, nargs="+", default=OFFSETS_MS, help="by which images are stamped late")
    parser.add_argument("--starts", type=int, default=3, help="per offset (default 3)")
    parser.add_argument("--csv", metavar="FILE", help="a line per run")
    args = parser.parse_args()
    runs: list[Run] = []
    print(HEAD, flush=True)
    for source in args.sources:
        stands, _, name = source.rpartition("standing:")
        data = open_dataset(name)
        positions = frame_positions(args.frames, len(data)) if len(args.sources) == 1 else range(len(data))
        frames = [standing(data[k]) if stands or source != name else data[k] for k in positions]
        own = measure(source if len(source) < 60 else f"...{source[-40:]}", frames, args.offsets_ms, args.starts)
        for offset in args.offsets_ms:
            print(row([r for r in own if r.offset_ms == offset]), flush=True)
        runs += own
        if args.csv:
            with Path(args.csv).open("w", newline="") as file:
                table = csv.DictWriter(file, [f.name for f in fields(Run)])
                table.writeheader()
                table.writerows(asdict(r) for r in runs)
    return 0


if __name__ == "__main__":
    sys.exit(main())
