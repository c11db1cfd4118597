"""Are the covariances consistent with the errors? Normalised estimation errors squared of estimates from many subsets of frames.

    python -m benchmarks.covariance_study [--kitti ROOT] [--workers N] [--csv FILE] [--plot PNG]

Every estimate starts up to 0.3 deg / 3 cm per axis beside the reference. Its error e, as a left twist, and its covariance C give
e' C^-1 e: 6 on average and 14.4 in 2.5 % of the cases if C is right. Subsets are spread or consecutive, of 1 to 20 frames.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from matplotlib.figure import Figure
from scipy.stats import chi2

from benchmarks.records import append_records
from calib_ros import se3
from calib_ros.config import Config
from calib_ros.datasets import open_dataset
from calib_ros.datasets.source import WithMotion
from calib_ros.registration.calibrator import Calibrator

SYNTHETIC = ("synthetic:seed=3,frames=20,stride=8", "synthetic:seed=5,frames=20,stride=8", "synthetic:seed=8,frames=20,rings=32")
KITTI = ("raw/2011_09_26/2011_09_26_drive_0005_sync", "odometry/sequences/00")
SIZES = {1: 10, 2: 6, 3: 8, 5: 10, 8: 8, 12: 6, 20: 4}  # frames of a subset: how many subsets of a source
QUANTILE = float(chi2.ppf(0.975, 6))


@dataclass(frozen=True)
class Row:
    """One estimate. normalised: its error squared; NaN if it was not called converged."""

    source: str
    frames: int
    deg: float
    cm: float
    normalised: float


def subsets(n_frames: int, seed: int = 1) -> list[np.ndarray]:
    """Positions of frames; every second one consecutive."""
    rng, out = np.random.default_rng(seed), []
    for size, count in SIZES.items():
        for t in range(count if size <= n_frames else 0):
            first = int(rng.integers(0, n_frames - size + 1))
            together = np.arange(first, first + size)
            out.append(together if t % 2 else np.sort(rng.choice(n_frames, size, replace=False)))
    return out


def study(source: str) -> list[Row]:
    """All estimates of one source."""
    cv2.setNumThreads(1)
    frames = WithMotion(open_dataset(source), Config().motion)
    truth = frames.reference
    if truth is None:
        raise SystemExit(f"{source} knows no extrinsic to compare with; give a KITTI folder or a synthetic drive")
    calibrator = Calibrator(frames.camera)
    features = [calibrator.extract(frames[k]) for k in range(len(frames))]
    rng, rows = np.random.default_rng(2), []
    for chosen in subsets(len(features)):
        off = rng.uniform(-1, 1, 6)
        start = se3.perturb(truth, 0.3 * off[:3], 0.03 * off[3:])
        result = calibrator.estimate([features[k] for k in chosen], start)
        error = se3.log(truth @ se3.inverse(result.T_camera_lidar))
        squared = float(error @ np.linalg.solve(result.covariance, error)) if result.covariance is not None else np.nan
        deg, cm = np.rad2deg(np.linalg.norm(error[:3])), 100 * np.linalg.norm(error[3:])
        rows.append(Row(source, len(chosen), float(deg), float(cm), squared))
    return rows


def short(source: str) -> str:
    """A source's name without the folders that differ between machines."""
    return source if source.startswith("synthetic") else "/".join(Path(source).parts[-2:])


def line(label: str, rows: list[Row]) -> str:
    """A row of the table."""
    values = np.array([r.normalised for r in rows])
    values = values[np.isfinite(values)]
    if not len(values):
        return f"| {label} | 0 of {len(rows)} | - | - | - |"
    above = f"{100 * np.mean(values > QUANTILE):.0f} %"
    return f"| {label} | {len(values)} of {len(rows)} | {values.mean():.1f} | {np.median(values):.1f} | {above} |"


def plot(rows: list[Row], path: Path) -> None:
    """How the normalised errors are spread, against what they should be."""
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    for source in dict.fromkeys(r.source for r in rows):
        values = np.sort([r.normalised for r in rows if r.source == source and np.isfinite(r.normalised)])
        axes.step(values, np.arange(1, len(values) + 1) / len(values), where="post", label=short(source))
    x = np.linspace(0, 30, 300)
    axes.plot(x, chi2.cdf(x, 6), "k--", label="chi squared, 6 degrees of freedom")
    axes.axvline(QUANTILE, color="0.7")
    axes.set(xlim=(0, 30), ylim=(0, 1), xlabel="normalised error squared", ylabel="share of estimates")
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=120)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="*", help="as for calib-ros; default: three synthetic drives, and KITTI with --kitti")
    parser.add_argument("--kitti", type=Path, help="folder with raw/ and odometry/")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--csv", type=Path)
    parser.add_argument("--plot", type=Path)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    sources = args.sources or [*SYNTHETIC, *(str(args.kitti / name) for name in KITTI if args.kitti)]
    with multiprocessing.Pool(args.workers) as pool:
        rows = [row for part in pool.imap(study, sources) for row in part]
    print("| source | estimates | mean | median | above 97.5 % |\n|---|---|---|---|---|")
    for source in sources:
        print(line(short(source), [r for r in rows if r.source == source]))
    for size in SIZES:
        print(line(f"{size} frames", [r for r in rows if r.frames == size]))
    print(line("2 and more frames", [r for r in rows if r.frames > 1]))
    print(line("all", rows))
    append_records(args.csv, [replace(r, source=short(r.source)) for r in rows])
    if args.plot:
        plot(rows, args.plot)
    return 0


if __name__ == "__main__":
    sys.exit(main())
