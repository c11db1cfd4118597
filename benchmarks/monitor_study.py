"""Does the monitor notice a wrong extrinsic? Hits and false alarms over subsets of frames, with ROC curves.

    python -m benchmarks.monitor_study [SOURCE ...] [--kitti ROOT] [--frames 1 5 20] [--subsets 40] [--plot PNG]
    python -m benchmarks.monitor_study [SOURCE ...] --sets [--rigs] [--repeats 2]

The extrinsic under test is the reference itself (every finding is a false alarm), or turned or shifted by a given size in a
direction drawn at random. Hits are given at the threshold that 5 % of the right ones exceed, and, with their false alarms, at the
threshold that the parameter monitor.false_alarm_rate = 0.05 sets.

--sets: the monitor itself at its default settings, on every single frame, a line per source, which goes with the others of the
same rig (--rigs: the synthetic ones too). It has seen the other frames of the source before, at the right extrinsic, as it has on
a vehicle. Hits and false alarms = frames that speak against the extrinsic. The last two columns count the
frames that show nothing, and those that confirm an extrinsic 0.5 deg or 10 cm off.
"""

from __future__ import annotations

import argparse
import copy
import multiprocessing
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from matplotlib.figure import Figure

from benchmarks.study_registration import DRIVE, ODOMETRY, SCENES, SYNTHETIC, short
from benchmarks.study_runner import CLASSES_OFF
from calib_ros import se3
from calib_ros.config import Config, update
from calib_ros.datasets import open_dataset
from calib_ros.datasets.source import WithMotion
from calib_ros.online.monitor import Monitor, Verdict, measure_shift
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import FrameFeatures
from calib_ros_synthetic.rigs import RIGS

ERRORS = {"0.25 deg": (0.25, 0), "0.5 deg": (0.5, 0), "1 deg": (1, 0), "5 cm": (0, 0.05), "10 cm": (0, 0.1), "20 cm": (0, 0.2)}
RATE = 0.05
Answers = dict[tuple[int, str], list[float]]  # frames, error -> p values
SET_ERRORS = {"right": (0.0, 0.0), "0.5 deg": (0.5, 0.0), "10 cm": (0.0, 0.1), "1 deg": (1.0, 0.0), "20 cm": (0.0, 0.2)}
Verdicts = dict[str, list[Verdict]]  # error -> verdicts


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


def verdicts(source: str, repeats: int) -> tuple[str, Verdicts]:
    """What the monitor says of every frame of a source alone: of the right extrinsic, and of wrong ones in random directions."""
    cv2.setNumThreads(1)
    config = update(Config(), CLASSES_OFF)
    data = open_dataset(source)
    by_camera: list[tuple[Calibrator, np.ndarray, list[FrameFeatures]]] = []
    for k in range(len(data)):
        frame = data[k]
        if frame.reference is None:
            raise SystemExit(f"{source} knows no extrinsic to compare with")
        own = [b for b in by_camera if b[0].extract.source_camera == frame.camera]
        if not own:
            own = [(Calibrator(frame.camera, config), frame.reference, [])]
            by_camera += own
        own[0][2].append(own[0][0].extract(frame))
    rng = np.random.default_rng(4)
    out: Verdicts = {}
    for calibrator, truth, features in by_camera:
        for k, tested in enumerate(features):
            history = Monitor(config.monitor)
            for other in features[:k] + features[k + 1 :]:
                history.check(calibrator, [other], truth, np.zeros((6, 6)))
                history.reset()
            for name, (deg, m) in SET_ERRORS.items():
                for _ in range(repeats if name != "right" else 1):
                    T = se3.perturb(truth, deg * direction(rng), m * direction(rng))
                    answer = copy.deepcopy(history).check(calibrator, [tested], T, np.zeros((6, 6)))
                    out.setdefault(name, []).append(answer.verdict)
    return source, out


def set_table(rows: Sequence[tuple[str, Verdicts]]) -> None:
    """A line per set: share of single frames called suspect, and how many show nothing."""
    groups: dict[str, Verdicts] = {}
    for source, found in rows:
        name = source.split("rig=")[1].split(",")[0] if "rig=" in source else short(source)
        for group in (name, "all together"):
            for error, values in found.items():
                groups.setdefault(group, {}).setdefault(error, []).extend(values)
    names = list(SET_ERRORS)[1:]
    print(f"| set | frames | false alarms | {' | '.join(names)} | inconclusive: right, 0.5 deg and 10 cm | called consistent |")
    print("|---|---|---|---|---|---|---|---|")
    for group in [*(g for g in groups if g != "all together"), "all together"]:
        own = groups[group]
        small = own["0.5 deg"] + own["10 cm"]
        columns = [(own[n], Verdict.SUSPECT) for n in SET_ERRORS]
        columns += [(own["right"], Verdict.INCONCLUSIVE), (small, Verdict.INCONCLUSIVE), (small, Verdict.CONSISTENT)]
        shares = [f"{100 * sum(v is wanted for v in found) / len(found):.0f} %" for found, wanted in columns]
        print(f"| {group} | {len(own['right'])} | {' | '.join(shares[:-3])} | {', '.join(shares[-3:-1])} | {shares[-1]} |")


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
    figure = Figure(figsize=(4.6 * len(sizes), 4.4), layout="constrained")
    axes = figure.subplots(1, len(sizes), squeeze=False)
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
    parser.add_argument("--sets", action="store_true", help="the monitor on single frames, a line per source")
    parser.add_argument("--rigs", action="store_true", help="with --sets: the synthetic rigs as well")
    parser.add_argument("--repeats", type=int, default=2, help="with --sets: wrong extrinsics per frame and size")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    if args.sets:
        rigs = [f"synthetic:rig={rig},scene={scene},frames=5" for rig in RIGS for scene in SCENES] if args.rigs else []
        with multiprocessing.Pool(args.workers) as pool:
            set_table(pool.map(partial(verdicts, repeats=args.repeats), [*args.sources, *rigs], chunksize=1))
        return 0
    sources = args.sources or ([str(args.kitti / name) for name in (DRIVE, ODOMETRY)] if args.kitti else list(SYNTHETIC[:2]))
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
