"""Is a change better or worse? Two versions estimate from the same frames and starts, and every measure is compared in pairs.

    make compare BASE=COMMIT [TIP=COMMIT] [SETS="rigs kitti"] [TRIALS=2]
    python -m benchmarks.compare BASE [--tip COMMIT] [--sets NAME ...] [--trials N]

BASE is A; B is --tip, by default the working tree. Each commit is unpacked into build/compare, and its kernels are built there.
Both run side by side, so that their CPU times compare. Exit code: 0 if nothing has become significantly worse, else 1; 2 for bad
input.

Sets (all that have data):"""

from __future__ import annotations

import argparse
import io
import json
import math
import os
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.stats import chi2, false_discovery_control, permutation_test
from tqdm import tqdm

from benchmarks.compare_sets import ROOT, SETS, PairedTrial, Recording, prepared, spent_sets
from benchmarks.records import markdown
from benchmarks.study_runner import NEAR
from calib_ros import se3
from calib_ros.errors import BadInputError, CalibrationError
from calib_ros.result import CONVERGED
from calib_ros_evaluation.compare import BETTER, SAME, WORSE, Measure, PairedChange, paired_change

BUILT = ROOT / "build" / "compare"
WORKING_TREE = ""
NOTICED_S = 5.0  # after a displacement, in which it is to be told
ERROR_RATE = 0.05  # of runs of the same version, in which something is called worse by chance
CPU_RESOLUTION = 1.05  # two runs of one version differ by less
USUAL_NEES = float(chi2.median(6))
IDENTICAL = "identical"
NAN = math.nan


class Outcome(NamedTuple):
    """What is compared of a trial. NaN: does not apply. rotation, translation: errors as multiples of their bound. nees_off:
    factor by which the error squared, normalised by its covariance, is off its median."""

    success: float = NAN
    accepted_wrong: float = NAN
    rotation: float = NAN
    translation: float = NAN
    nees_off: float = NAN
    cpu_s: float = NAN


MEASURES = (
    Measure("success, %", "success", "mean", 1, "{:.1f}", "{:+.1f}", 100.0),
    Measure("accepted wrong, %", "accepted_wrong", "mean", -1, "{:.1f}", "{:+.1f}", 100.0),
    Measure("rotation error / bound", "rotation", "ratio", -1, "{:.2f}", "x {:.3f}", 1.0),
    Measure("translation error / bound", "translation", "ratio", -1, "{:.2f}", "x {:.3f}", 1.0),
    Measure("NEES, factor off its median", "nees_off", "ratio", -1, "{:.2f}", "x {:.3f}", 1.0),
    Measure("CPU, s", "cpu_s", "ratio", -1, "{:.2f}", "x {:.3f}", 1.0),
)


def outcome(trial: PairedTrial, answer: dict[str, Any]) -> Outcome:
    """answer: as `compare_side` gives it; an error is no success, and nothing accepted."""
    kind, drive = SETS[trial.set], trial.length > 0
    if "error" in answer:
        return Outcome(NAN if kind.nothing_right else 0.0, 0.0)
    truth = np.array(trial.knock) @ np.array(trial.truth)
    T, accepted = np.array(answer["T"]), answer["status"] == CONVERGED
    deg, m = se3.rotation_error_deg(truth, T), se3.translation_error_m(truth, T)
    right = deg < NEAR[0] and 100 * m < NEAR[1] and not kind.nothing_right
    success = NAN if kind.nothing_right else float(accepted and right)
    if drive:
        noticed_s = answer["noticed_s"]
        success = float(answer["settled"] and not answer["alarm"] and noticed_s is not None and noticed_s <= NOTICED_S)
    rotation = translation = nees = NAN
    if right and trial.bound is not None:
        rotation, translation = np.deg2rad(deg) / trial.bound[0], m / trial.bound[1]
    if right and kind.exact and answer["covariance"] is not None:
        off = se3.log(T @ se3.inverse(truth))
        nees = float(off @ np.linalg.solve(np.array(answer["covariance"]), off))
    off_by = math.exp(abs(math.log(nees / USUAL_NEES))) if nees > 0 else NAN
    return Outcome(success, float(accepted and not right), rotation, translation, off_by, answer["cpu_s"])


# ------------------------------------------------------------------------------------------------ the two sides


def side(commit: str) -> Path:
    """A tree with built kernels: of a commit, or the working tree. BadInputError for an unknown commit, CalibrationError where it
    does not build."""
    if commit == WORKING_TREE:
        return ROOT
    done = subprocess.run(["git", "rev-parse", "--verify", f"{commit}^{{commit}}"], cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        raise BadInputError(f"{commit} is no commit of this repository; give a hash, a branch or a tag")
    tree = BUILT / done.stdout.strip()[:12]
    if not (tree / "built").exists():
        tree.mkdir(parents=True, exist_ok=True)
        archive = subprocess.run(["git", "archive", done.stdout.strip()], cwd=ROOT, capture_output=True, check=True)
        with tarfile.open(fileobj=io.BytesIO(archive.stdout)) as tar:
            tar.extractall(tree, filter="data")
        # egg_info: the entry points of this tree, found before those of the installed package.
        command = [sys.executable, "setup.py", "-q", "egg_info", "build_ext", "--inplace"]
        built = subprocess.run(command, cwd=tree, env=environment(tree), capture_output=True, text=True)
        if built.returncode:
            raise CalibrationError(f"{commit} does not build in {tree}:\n{built.stderr.strip()[-2000:]}")
        (tree / "built").touch()
    return tree


def environment(tree: Path) -> dict[str, str]:
    """For a process of its own with the packages of a tree, and one thread."""
    threads = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    return {**os.environ, **threads, "PYTHONPATH": str(tree)}


def imported_from(tree: Path) -> None:
    """CalibrationError unless a process of this side has the packages, kernels and entry points of its tree."""
    code = (
        "import calib_ros, importlib.metadata as m, pathlib; from calib_ros.registration.score import sampler;"
        "print(pathlib.Path(calib_ros.__file__).parents[1], pathlib.Path(m.distribution('calib_ros')._path).parent, sep='\\n')"
    )
    told = subprocess.run([sys.executable, "-c", code], cwd="/", env=environment(tree), capture_output=True, text=True)
    found = told.stdout.split("\n")[:2]
    expected = [str(tree)] * 2 if tree != ROOT else [str(tree), found[-1]]
    if told.returncode or found != expected:
        raise CalibrationError(f"{tree} is not what would be compared, but {' '.join(found)} {told.stderr.strip()[-500:]}")


def answers_of(tree: Path, store: Path, part: int, of: int, log: Path) -> Iterator[dict[str, Any]]:
    """As they come, of every trial whose number is `part` modulo `of`. CalibrationError if the process ends before the last."""
    command = [sys.executable, str(ROOT / "benchmarks" / "compare_side.py"), str(store), str(part), str(of)]
    with log.open("w") as errors:
        process = subprocess.Popen(command, cwd=store, env=environment(tree), stdout=subprocess.PIPE, stderr=errors, text=True)
        try:
            assert process.stdout is not None
            for line in process.stdout:
                yield json.loads(line)
        finally:
            process.kill()
            process.wait()
    if process.returncode:
        raise CalibrationError(f"the side {tree.name} ended with {process.returncode}: {log.read_text().strip()[-500:]}")


def both_sides(trees: Sequence[Path], trials: Sequence[PairedTrial], store: Path, workers: int) -> list[list[dict[str, Any]]]:
    """Answers of A and B, in the order of the trials. As many processes run for either side, at the same time."""
    (store / "trials.json").write_text(json.dumps([asdict(trial) for trial in trials]))
    found: list[list[dict[str, Any]]] = [[{}] * len(trials) for _ in trees]
    with tqdm(total=2 * len(trials), disable=not sys.stderr.isatty(), unit=" trials") as progress:

        def work(which: int, part: int) -> None:
            for answer in answers_of(trees[which], store, part, workers, store / f"{which}_{part}.log"):
                found[which][answer["number"]] = answer
                progress.update()

        with ThreadPoolExecutor(2 * workers) as pool:
            for future in [pool.submit(work, which, part) for part in range(workers) for which in (0, 1)]:
                future.result()
    return found


def trials_of(names: Sequence[str], numbers: int, store: Path) -> list[PairedTrial]:
    """The trials of sets, whose frames are put into the store. BadInputError where none has any data."""
    uses: dict[str, list[tuple[Recording, Recording | None]]] = {}
    for name in names:
        before = None
        for recording in SETS[name].recordings(name):
            uses.setdefault(recording.text, []).append((recording, before))
            before = recording
    if not uses:
        raise BadInputError(f"no data for {', '.join(names)}; set KITTI_ROOT or VEHICLES_ROOT to their folders")
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as pool:
        jobs = [pool.submit(prepared, text, own, numbers, store) for text, own in uses.items()]
        return [trial for job in tqdm(jobs, "frames", disable=not sys.stderr.isatty()) for trial in job.result()]


# ------------------------------------------------------------------------------------------------ the table


@dataclass(frozen=True, eq=False)
class Line:
    """A measure of a set. change: over `pairs` trials where both have it. p: of as large a difference by chance, both ways."""

    set: str
    measure: Measure
    pairs: int
    change: PairedChange
    p: float
    verdict: str = SAME


def lines_of(trials: Sequence[PairedTrial], a: Sequence[Outcome], b: Sequence[Outcome]) -> list[Line]:
    """A line for each measure of each set, with its verdict: of all of them together, in ERROR_RATE of comparisons of equal
    versions one is called better or worse (Benjamini and Hochberg 1995)."""
    lines = []
    for name in dict.fromkeys(trial.set for trial in trials):
        chosen = [k for k, trial in enumerate(trials) if trial.set == name]
        for measure in MEASURES:
            values = np.array([(getattr(a[k], measure.column), getattr(b[k], measure.column)) for k in chosen], float)
            both = np.isfinite(values).all(axis=1)
            if both.any():
                clusters = [trials[k].cluster for k, known in zip(chosen, both, strict=True) if known]
                change = paired_change(values[both], clusters, measure.kind, measure.sign)
                lines.append(Line(name, measure, int(both.sum()), change, chance(values[both], clusters, measure.kind)))
    shown = false_discovery_control([line.p for line in lines]) if lines else []
    return [judged(line, bool(p < ERROR_RATE)) for line, p in zip(lines, shown, strict=True)]


def chance(values: np.ndarray[Any, Any], clusters: Sequence[object], kind: str) -> float:
    """Exact, or by 9999 draws: which side is A and which is B is exchanged for whole clusters. For shares and trials on frames of
    their own this is McNemar's test."""
    values = np.log(values) if kind == "ratio" else values
    if np.array_equal(values[:, 0], values[:, 1]):
        return 1.0
    sums = np.zeros((2, len(set(clusters))))
    numbers = {cluster: k for k, cluster in enumerate(dict.fromkeys(clusters))}
    np.add.at(sums.T, [numbers[cluster] for cluster in clusters], values)
    found = permutation_test(
        sums,
        lambda x, y, axis: np.sum(x - y, axis=axis),
        permutation_type="samples",
        vectorized=True,
        n_resamples=9999,
        random_state=0,
    )
    return float(found.pvalue)


def judged(line: Line, is_shown: bool) -> Line:
    """CPU times of one version differ a little from run to run, whatever their intervals say."""
    change, measure = line.change, line.measure
    beside = 1.0 if measure.kind == "ratio" else 0.0
    if change.change == beside and change.low == change.high:
        verdict = IDENTICAL
    elif not is_shown or (measure.column == "cpu_s" and change.low <= CPU_RESOLUTION and change.high >= 1 / CPU_RESOLUTION):
        verdict = SAME
    else:
        verdict = BETTER if (change.change > beside) == (measure.sign > 0) else WORSE
    return Line(line.set, measure, line.pairs, change, line.p, verdict)


def as_table(lines: Sequence[Line], spent: dict[str, list[str]]) -> str:
    """Markdown."""
    rows = []
    for line in lines:
        change, measure = line.change, line.measure
        a, b = (measure.form.format(value * measure.unit) for value in (change.a, change.b))
        difference, low, high = (measure.change.format(v * measure.unit) for v in (change.change, change.low, change.high))
        between = f"{low} to {high}" if math.isfinite(change.low) else "-"
        verdict = f"**{line.verdict}**" if line.verdict in (BETTER, WORSE) else line.verdict
        name = f"{line.set}{' (spent)' if line.set in spent else ''}"
        rows.append([name, line.pairs, measure.name, a, b, difference, between, f"{line.p:.3g}", verdict])
    return markdown(["set", "pairs", "measure", "A", "B", "B - A, B / A", "95 %", "p", "verdict"], rows)


def verdict_of(lines: Sequence[Line]) -> str:
    """One line in plain words."""
    said = []
    for kind in (WORSE, BETTER):
        found = [f"{line.measure.name.partition(',')[0]} of {line.set}" for line in lines if line.verdict == kind]
        said += [f"{kind}: {', '.join(found)}"] if found else []
    same = [line for line in lines if line.measure.column != "cpu_s"]
    if not said and all(line.verdict == IDENTICAL for line in same):
        return "B gives the same results as A."
    return f"B against A is {'; '.join(said)}." if said else "No difference between A and B is shown."


def main() -> int:
    """See the module."""
    about = __doc__ + "; ".join(f"{name}: {one.about}" for name, one in SETS.items())
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("base", help="commit that is A")
    parser.add_argument("--tip", default=WORKING_TREE, help="commit that is B (default: the working tree)")
    parser.add_argument("--sets", nargs="+", choices=SETS, default=list(SETS))
    parser.add_argument("--trials", type=int, default=1, metavar="N", help="starts of every case")
    parser.add_argument("--workers", type=int, default=max((os.cpu_count() or 1) // 2, 1), metavar="N", help="processes a side")
    args = parser.parse_args()
    if args.trials < 1 or args.workers < 1:
        parser.error("--trials and --workers must be at least 1")
    cv2.setNumThreads(1)
    try:
        trees = [side(args.base), side(args.tip)]
        for tree in trees:
            imported_from(tree)
        with tempfile.TemporaryDirectory(prefix="calib_ros_compare_") as folder:
            trials = trials_of(args.sets, args.trials, Path(folder))
            answers = both_sides(trees, trials, Path(folder), args.workers)
    except CalibrationError as error:
        parser.error(str(error))
    a, b = ([outcome(*pair) for pair in zip(trials, own, strict=True)] for own in answers)
    lines, spent = lines_of(trials, a, b), spent_sets()
    print(f"A: {args.base}, B: {args.tip or 'working tree'}\n\n{as_table(lines, spent)}\n")
    errors = [sum("error" in answer for answer in own) for own in answers]
    if any(errors):
        print(f"Trials that ended with an error: {errors[0]} of A, {errors[1]} of B.")
    print(f"Spent: chosen by them were constants of docs/figures/constants.csv ({', '.join(spent)}).")
    print(verdict_of(lines))
    return int(any(line.verdict == WORSE for line in lines))


if __name__ == "__main__":
    sys.exit(main())
