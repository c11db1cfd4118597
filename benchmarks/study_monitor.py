"""Does the monitor notice a wrong extrinsic? Hits and false alarms, with ROC curves.

The extrinsic under test is the reference itself (every finding is a false alarm), or turned or shifted by a given size in a
direction drawn at random.
"""

from __future__ import annotations

import argparse
import copy
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.records import markdown
from benchmarks.sources import frames_of
from benchmarks.study_registration import DRIVE, ODOMETRY, SYNTHETIC, rigs_of, short, subset
from benchmarks.study_runner import CLASSES_OFF, Case, End, FeaturesOf, Record, Study, Variant
from calib_ros import se3
from calib_ros.config import Config
from calib_ros.online.monitor import TESTS_PER_HOUR, Monitor, Verdict, measure_shift
from calib_ros.registration.calibrator import Calibrator

Matrix = NDArray[np.float64]
RIGHT = "right"
# deg, m
ERRORS = {"0.25 deg": (0.25, 0), "0.5 deg": (0.5, 0), "1 deg": (1, 0), "5 cm": (0, 0.05), "10 cm": (0, 0.1), "20 cm": (0, 0.2)}
SET_ERRORS = {name: ERRORS[name] for name in ("0.5 deg", "10 cm", "1 deg", "20 cm")}
SIZES, SUBSETS = (1, 5, 20), 40  # keyframes, and sets of each number
RATE = 0.05
UNKNOWN = np.zeros((6, 6))


def off(truth: Matrix, size: tuple[float, float], rng: np.random.Generator) -> Matrix:
    """The extrinsic (4, 4), wrong by deg and m in random directions."""
    turn, shift = (v / np.linalg.norm(v) for v in (rng.normal(size=3), rng.normal(size=3)))
    return se3.perturb(truth, size[0] * turn, size[1] * shift)


def subsets(args: argparse.Namespace) -> Iterator[Case]:
    """Spread and consecutive keyframes in turn. Trials: right, and each of ERRORS."""
    kitti = [str(args.kitti / name) for name in (DRIVE, ODOMETRY)] if args.kitti else []
    for name in args.sources or kitti or SYNTHETIC[:2]:
        frames, rng = frames_of(name, Config().motion), np.random.default_rng(4)
        for size in (size for size in SIZES if size <= len(frames)):
            for t in range(SUBSETS):
                case = Case(short(name), subset(frames, size, t, rng), source=name)
                yield case.begun([case.truth, *(off(case.truth, error, rng) for error in ERRORS.values())])


def measured(calibrator: Calibrator, case: Case, features: FeaturesOf, trial: int) -> End:
    """said: the evidence against the extrinsic."""
    T = case.starts[trial]
    return End.at(T, case.truth, said=repr(measure_shift(calibrator, features(), T).evidence))


def evidence(records: Sequence[Record], size: int) -> dict[str, Matrix]:
    """For each error, sorted; without any where there are no such sets."""
    values = {
        name: [float(r.said) for r in records if (r.frames, r.trial) == (size, k)] for k, name in enumerate((RIGHT, *ERRORS))
    }
    return {name: np.sort(own) for name, own in values.items()}


def hits_table(records: Sequence[Record]) -> str:
    """Hits at the threshold that RATE of the right ones exceed, and at that which monitor.false_alarms_per_hour sets."""
    rows = []
    set_by_rate = float(np.log(TESTS_PER_HOUR / Config().monitor.false_alarms_per_hour))
    for size in SIZES:
        values = evidence(records, size)
        if not len(values[RIGHT]):
            continue
        of_rate = float(np.quantile(values[RIGHT], 1 - RATE))
        for label, threshold in ((f"of {100 * RATE:g} %", of_rate), ("nominal", set_by_rate)):
            false, *hits = (float(np.mean(own > threshold)) for own in values.values())
            rows.append([size, label, f"{100 * false:.0f} %", *(f"{share:.2f}" for share in hits)])
    return markdown(["frames", "threshold", "false alarms", *ERRORS], rows)


def roc_plot(records: Sequence[Record], path: Path) -> None:
    """ROC curves, one panel per number of keyframes."""
    sizes = [size for size in SIZES if any(r.frames == size for r in records)]
    figure = Figure(figsize=(4.6 * len(sizes), 4.4), layout="constrained")
    for panel, size in zip(figure.subplots(1, len(sizes), squeeze=False)[0], sizes, strict=True):
        values = evidence(records, size)
        for name in ERRORS:
            right, wrong = values[RIGHT], values[name]
            thresholds = np.concatenate([[np.inf], np.sort(np.concatenate([right, wrong]))[::-1], [-np.inf]])
            false, hits = (1 - np.searchsorted(v, thresholds, side="left") / len(v) for v in (right, wrong))
            area = float(np.sum(np.diff(false) * (hits[1:] + hits[:-1]) / 2))
            panel.step(false, hits, where="post", label=f"{name}, area {area:.3f}")
        panel.axvline(RATE, color="0.7", linestyle="--")
        panel.set(xlim=(0, 0.5), ylim=(0, 1.02), xlabel="false alarms", ylabel="hits", title=f"{size} keyframes")
        panel.legend(fontsize=8, loc="lower right")
    figure.savefig(path, dpi=120)


# ------------------------------------------------------------------------------------------------ single frames of vehicles


def set_trials(repeats: int) -> list[str]:
    """The error of each trial of a frame."""
    return [RIGHT, *(name for name in SET_ERRORS for _ in range(repeats))]


def single_frames(args: argparse.Namespace) -> Iterator[Case]:
    """A case for every frame: itself first, then the others of its camera, which the monitor has seen before."""
    for name in [*args.sources, *rigs_of(args)]:
        frames, rng = frames_of(name), np.random.default_rng(4)
        group = name.split("rig=")[1].split(",")[0] if "rig=" in name else short(name)
        for k, frame in enumerate(frames):
            others = [other for n, other in enumerate(frames) if n != k and other.camera == frame.camera]
            case = Case(group, [frame, *others], source=name)
            errors: Mapping[str, tuple[float, float]] = {RIGHT: (0.0, 0.0), **SET_ERRORS}
            yield case.begun([off(case.truth, errors[own], rng) for own in set_trials(args.trials or 2)])


class Judge:
    """The monitor itself at its default settings, on single frames, after it has seen others at the right extrinsic, as it has on
    a vehicle."""

    def __init__(self) -> None:
        self._of: Case | None = None
        self._seen = Monitor(Config().monitor)

    def __call__(self, calibrator: Calibrator, case: Case, features: FeaturesOf, trial: int) -> End:
        """status: the verdict."""
        tested, *others = features()
        if self._of is None or self._of.starts is not case.starts:
            self._of, self._seen = case, Monitor(calibrator.config.monitor)
            for other in others:
                self._seen.check(calibrator, [other], case.truth, UNKNOWN)
                self._seen.reset()
        T = case.starts[trial]
        verdict = copy.deepcopy(self._seen).check(calibrator, [tested], T, UNKNOWN).verdict
        return End.at(T, case.truth, verdict.name)


def set_table(records: Sequence[Record]) -> str:
    """A line per set: false alarms and hits, which speak against the extrinsic; frames that show nothing; and those that confirm
    an extrinsic 0.5 deg or 10 cm off."""
    repeats = max((r.trial for r in records), default=0) // len(SET_ERRORS)
    names, rows = set_trials(repeats), []
    groups = {name: [r for r in records if r.group == name] for name in dict.fromkeys(r.group for r in records)}
    for group, own in (groups | {"all together": list(records)}).items():
        said = {error: [r.status for r in own if names[r.trial] == error] for error in (RIGHT, *SET_ERRORS)}
        small = said["0.5 deg"] + said["10 cm"]
        alarms = [_share(found, Verdict.SUSPECT) for found in said.values()]
        nothing = ", ".join(_share(found, Verdict.INCONCLUSIVE) for found in (said[RIGHT], small))
        rows.append([group, len(said[RIGHT]), *alarms, nothing, _share(small, Verdict.CONSISTENT)])
    last = ("inconclusive: right, 0.5 deg and 10 cm", "called consistent")
    return markdown(["set", "frames", "false alarms", *SET_ERRORS, *last], rows)


def _share(said: Sequence[str], verdict: Verdict) -> str:
    return f"{100 * said.count(verdict.name) / max(len(said), 1):.0f} %"


STUDIES = {
    "monitor": Study(subsets, measured, {"": Variant(CLASSES_OFF)}, table=hits_table, plot=roc_plot),
    "monitor_vehicles": Study(single_frames, Judge(), {"": Variant(CLASSES_OFF)}, table=set_table),
}
