"""Does the monitor notice a wrong extrinsic? Hits and false alarms over subsets of frames, with ROC curves.

    python -m benchmarks.monitor_study [SOURCE ...] [--kitti ROOT] [--frames 1 5 20] [--subsets 40] [--plot PNG]

The extrinsic under test is the reference itself (every finding is a false alarm), or turned or shifted by a given size in a
direction drawn at random. Hits are given at the threshold that 5 % of the right ones exceed, and, with their false alarms, at the
threshold that the parameter monitor.false_alarm_rate = 0.05 sets.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from benchmarks.covariance_study import KITTI, SYNTHETIC
from calib_ros import se3
from calib_ros.config import Config
from calib_ros.datasets import open_dataset
from calib_ros.datasets.source import WithMotion
from calib_ros.online.monitor import measure_shift
from calib_ros.registration.calibrator import Calibrator

ERRORS = {"0.25 deg": (0.25, 0), "0.5 deg": (0.5, 0), "1 deg": (1, 0), "5 cm": (0, 0.05), "10 cm": (0, 0.1), "20 cm": (0, 0.2)}
RATE = 0.05
Answers = dict[tuple[int, str], list[float]]  # frames, error -> p values


def direction(rng: np.random.Generator) -> np.ndarray:
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))


def study(source: str, sizes: list[int], subsets: int) -> Answers:
    """p values of one source."""
    cv2.setNumThreads(1)
    frames = WithMotion(open_dataset(source), Config().motion)
    truth = frames.reference
    if truth is None:
        raise SystemExit(f"{source} knows no extrinsic to compare with; give a KITTI folder or a synthetic drive")
    calibrator = Calibrator(frames.camera)
    features = [calibrator.extract(frames[k]) for k in range(len(frames))]
    rng = np.random.default_rng(4)
    out: Answers = {}
    for size in (s for s in sizes if s <= len(features)):
        for t in range(subsets):
            first = int(rng.integers(0, len(features) - size + 1))
            together = np.arange(first, first + size)
            chosen = together if t % 2 else np.sort(rng.choice(len(features), size, replace=False))
            keyframes = [features[k] for k in chosen]
            out.setdefault((size, "right"), []).append(measure_shift(calibrator, keyframes, truth).p_value)
            for name, (deg, m) in ERRORS.items():
                T = se3.perturb(truth, deg * direction(rng), m * direction(rng))
                out.setdefault((size, name), []).append(measure_shift(calibrator, keyframes, T).p_value)
    return out


def table(answers: Answers, sizes: list[int]) -> None:
    """Hits at RATE false alarms, and at the nominal rate."""
    print(f"| frames | threshold | false alarms | {' | '.join(ERRORS)} |\n|---|---|---|{'---|' * len(ERRORS)}")
    for size in sizes:
        right = np.array(answers.get((size, "right"), []))
        if not len(right):
            continue
        for label, threshold in ((f"of {100 * RATE:g} %", float(np.quantile(right, RATE))), ("nominal", RATE)):
            hits = [np.mean(np.array(answers[size, name]) < threshold) for name in ERRORS]
            false = f"{100 * np.mean(right < threshold):.0f} %"
            print(f"| {size} | {label} | {false} | {' | '.join(f'{h:.2f}' for h in hits)} |")


def plot(answers: Answers, sizes: list[int], path: Path) -> None:
    """ROC curves, one panel per number of frames."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, len(sizes), figsize=(4.6 * len(sizes), 4.4), layout="constrained", squeeze=False)
    for panel, size in zip(axes[0], sizes, strict=True):
        right = np.sort(answers.get((size, "right"), [1.0]))
        for name in ERRORS:
            wrong = np.sort(answers.get((size, name), [1.0]))
            thresholds = np.concatenate([[0], np.sort(np.concatenate([right, wrong])), [1]])
            false, hits = (np.searchsorted(v, thresholds, side="right") / len(v) for v in (right, wrong))
            area = float(np.sum(np.diff(false) * (hits[1:] + hits[:-1]) / 2))
            panel.step(false, hits, where="post", label=f"{name}, area {area:.3f}")
        panel.axvline(RATE, color="0.7", linestyle="--")
        panel.set(xlim=(0, 0.5), ylim=(0, 1.02), xlabel="false alarms", ylabel="hits", title=f"{size} keyframes")
        panel.legend(fontsize=8, loc="lower right")
    figure.savefig(path, dpi=120)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="*", help="as for calib-ros; default: KITTI with --kitti, else two synthetic drives")
    parser.add_argument("--kitti", type=Path, help="folder with raw/ and odometry/")
    parser.add_argument("--frames", type=int, nargs="+", default=[1, 5, 20])
    parser.add_argument("--subsets", type=int, default=40)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--plot", type=Path)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    sources = args.sources or ([str(args.kitti / name) for name in KITTI] if args.kitti else list(SYNTHETIC[:2]))
    with multiprocessing.Pool(args.workers) as pool:
        parts = pool.map(partial(study, sizes=args.frames, subsets=args.subsets), sources, chunksize=1)
    answers: Answers = {}
    for part in parts:
        for key, values in part.items():
            answers.setdefault(key, []).extend(values)
    table(answers, args.frames)
    if args.plot:
        plot(answers, args.frames, args.plot)
    return 0


if __name__ == "__main__":
    sys.exit(main())
