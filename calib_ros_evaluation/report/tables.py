"""Tables of the report, and the selections and statistics of trials and curves that they share with the plots; every function
needs the results only."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.stats import mannwhitneyu

from calib_ros_evaluation.curves import Curves
from calib_ros_evaluation.methods.edges import fitted, probability_right
from calib_ros_evaluation.report.table import NONE, Rows, Table, centimetres, degrees, figures, interval, number, percent, plural
from calib_ros_evaluation.results import END, SET, SUCCESS_DEG, SUCCESS_M, THESIS_THRESHOLD, Results, Trust

Matrix = NDArray[np.float64]
OURS = "ours"  # name of this project's method
FALSE_ALARMS = 0.05  # of detections by the share of worse neighbours
RISE = 0.01  # of a curve's span; what falls less between two samples still counts as rising
AXIS_HEADER = ("r_x deg", "r_y deg", "r_z deg", "t_x cm", "t_y cm", "t_z cm")
# Table 4.4 of the thesis, rad and m, as printed.
PRINTED = {
    "mean": (-0.008057, 0.006812, 0.012980, -0.001834, -0.014615, -0.014337),
    "median": (-0.002031, 0.006373, 0.011941, -0.001834, -0.14786, -0.014435),
}
PRINTED_NAME = "printed in the thesis"
NUMBER = re.compile(r"-?\d+(\.\d+)?")
MOST_REASONS = 30  # rows; a page is no log
TOGETHER = 5  # frames whose shares of worse neighbours are averaged
DRAWS = 200  # sets of as many frames
SHARES = "Share of all trials, and its 95 % interval (Wilson)."
SUMMARY_NOTES = (
    f"Success: ended within {SUCCESS_DEG:g} deg and {100 * SUCCESS_M:g} cm of the reference. A refused or failed trial is "
    f"none, and its errors are those of its start.",
    "Constants of all methods, this project's too, were chosen on KITTI drive 0005, odometry 00 and synthetic drives, where "
    "their authors published none: on these, none of the methods is held out.",
    "CPU s: median of features and optimisation together. Peaks off: mean distance of the loss curves' peaks from the reference "
    "over scenes and axes.",
)


def quantile(values: ArrayLike, share: float) -> float:
    """Of values (n,), between samples by a straight line. What is not a number counts as infinitely large, not as absent: a
    method must not look better by failing. NaN without values."""
    ordered = np.sort(np.where(np.isnan(v := np.asarray(values, float).ravel()), np.inf, v))
    if not len(ordered):
        return math.nan
    at = share * (len(ordered) - 1)
    low, high = ordered[math.floor(at)], ordered[math.ceil(at)]
    return float(low if low == high else low + (at - math.floor(at)) * (high - low))


def median(values: ArrayLike) -> float:
    """As quantile()."""
    return quantile(values, 0.5)


def mean(values: Iterable[float]) -> float:
    """Of what is finite; NaN if nothing is."""
    kept = [v for v in values if math.isfinite(v)]
    return float(np.mean(kept)) if kept else math.nan


def axis_errors(trials: pd.DataFrame) -> Matrix:
    """(n, 6) signed errors at the end, deg and cm; trials without a finite end are left out."""
    ends = trials[END].to_numpy(float)
    return np.asarray(ends[np.isfinite(ends).all(axis=1)] * ([1] * 3 + [100] * 3))


def peak_distances(curves: Curves) -> Matrix:
    """(6,) distance of each peak from the truth, deg and cm; NaN where a score is not finite. A flat curve
    counts as if its peak were at its end."""
    distance = np.where(np.isnan(curves.peaks), np.abs(curves.offsets).max(axis=1), np.abs(curves.peaks))
    return np.asarray(np.where(np.isfinite(curves.values).all(axis=1), distance, np.nan))


def basins(curves: Curves) -> Matrix:
    """(6,) how far from the truth, mean of both sides in deg and cm, each curve still rises towards its peak.

    It ends where a sample farther out is higher than the lowest one nearer the peak by RISE of the span. A side whose rise ends
    beyond the truth counts as 0, a curve without a span as well.
    """
    out = np.full(6, np.nan)
    for k, (x, y) in enumerate(zip(curves.offsets, curves.values, strict=True)):
        if np.isfinite(y).all():
            span, peak = float(np.ptp(y)), int(np.argmax(y))
            right = peak + _falling(y[peak:], RISE * span)
            left = peak - _falling(y[peak::-1], RISE * span)
            out[k] = 0.5 * (max(float(x[right]), 0.0) + max(-float(x[left]), 0.0)) if span > 1e-12 else 0.0
    return out


def _falling(y: Matrix, tolerance: float) -> int:
    """Position up to which y (n,) falls from its first value."""
    rises = np.flatnonzero(y[1:] > np.minimum.accumulate(y)[:-1] + tolerance)
    return int(rises[0]) if len(rises) else len(y) - 1


def area(right: Matrix, wrong: Matrix) -> float:
    """Probability that a wrong one has the lower share, ties counted half."""
    return float(mannwhitneyu(right, wrong, method="asymptotic").statistic / (len(right) * len(wrong)))


def hits(right: Matrix, wrong: Matrix) -> float:
    """Share of wrong ones below the threshold that FALSE_ALARMS of the right ones are below."""
    return float(np.mean(np.sort(right)[int(FALSE_ALARMS * len(right))] > wrong))


def called_right(trusts: Sequence[Trust], size: tuple[float, float] | None) -> float:
    """Share of frames, at an error of this size (None = no error), that are classified as right; each by distributions fitted to
    all others. NaN for fewer than three frames."""
    if len(trusts) < 3:
        return math.nan
    said: list[bool] = []
    for k, own in enumerate(trusts):
        others = [*trusts[:k], *trusts[k + 1 :]]
        R, W = fitted([t.right for t in others]), fitted([share for t in others for _, _, share in t.wrong])
        shares = [own.right] if size is None else [share for deg, m, share in own.wrong if (deg, m) == size]
        said += [probability_right([share], R, W) > 0.5 for share in shares]
    return float(np.mean(said))


def trials_of(results: Results, experiment: str) -> dict[str, pd.DataFrame]:
    """Method -> its trials of an experiment; methods without any are left out."""
    own = extended(results.trials[results.trials.experiment == experiment])
    found = {name: own[own.method == name] for name in results.titles}
    return {name: trials for name, trials in found.items() if len(trials)}


def extended(trials: pd.DataFrame) -> pd.DataFrame:
    """With size: (start_deg, start_m), n: number of frames, cm: translation_m in cm, start_success: the start is within the
    limits of success already."""
    near = (trials.start_rotation_deg < SUCCESS_DEG) & (trials.start_translation_m < SUCCESS_M)
    n = trials.frames.map(lambda text: len(text.split()))
    sizes = pd.Series(list(zip(trials.start_deg, trials.start_m, strict=True)), trials.index, object)
    return trials.assign(size=sizes, n=n, cm=100 * trials.translation_m, start_success=near)


def groups(trials: dict[str, pd.DataFrame], key: str) -> tuple[list[Any], dict[str, dict[Any, pd.DataFrame]]]:
    """The values of a column, numbers ascending, and for each method its trials by each of them, which may be none."""
    values = list(dict.fromkeys(value for own in trials.values() for value in own[key]))
    values = values if key == "scene" else sorted(values)
    return values, {
        name: {value: own[[own_value == value for own_value in own[key]]] for value in values} for name, own in trials.items()
    }


def curves_of_scenes(results: Results) -> dict[str, dict[str, Curves]]:
    """Label of a scene -> method -> curves."""
    found: dict[str, dict[str, Curves]] = {}
    for one in results.curves:
        found.setdefault(one.label, {})[one.method] = one.curves
    return found


def curves_of_methods(results: Results) -> dict[str, list[Curves]]:
    """Method -> curves of all its scenes; methods without any are left out."""
    found = {name: [one.curves for one in results.curves if one.method == name] for name in results.titles}
    return {name: curves for name, curves in found.items() if curves}


def summary(results: Results) -> Table:
    """One row per method: the experiment "single", and the peaks of the loss curves."""
    trials, curves = trials_of(results, "single"), curves_of_methods(results)
    rows: Rows = []
    for name in results.titles:
        own = trials.get(name, results.trials.iloc[:0].assign(cm=0.0))
        peaks = np.array([peak_distances(c) for c in curves.get(name, [])]).reshape(-1, 6)
        if len(own) or len(peaks):
            trial_cells = [percent(own.success.mean()), degrees(median(own.rotation_deg)), centimetres(median(own.cm))]
            trial_cells += [percent((own.status == "refused").mean()), figures(median(own.cpu_s + own.features_cpu_s))]
            rows.append([name, *trial_cells, degrees(mean(peaks[:, :3].ravel())), centimetres(mean(peaks[:, 3:].ravel()))])
    header = ("success", "rotation, median deg", "translation, median cm", "refused", "CPU s", "peaks off, deg", "peaks off, cm")
    return Table("All methods", ["method", *header], rows, SUMMARY_NOTES)


def axis_cells(values: Iterable[float]) -> list[str]:
    """Six values, deg and cm."""
    return [degrees(v) if k < 3 else number(v, 2) for k, v in enumerate(values)]


def axes(results: Results) -> Table:
    """Table 4.4: errors per axis of the experiment "single", beside the printed ones."""
    scale = np.array([np.rad2deg(1)] * 3 + [100] * 3)
    rows: Rows = [[PRINTED_NAME, name, "100", *axis_cells(scale * values)] for name, values in PRINTED.items()]
    for name, own in trials_of(results, "single").items():
        done = own[own.status == "done"]
        kinds = {name: own} | ({f"{name}, accepted": done} if len(done) < len(own) else {})
        for label, kind in kinds.items():
            E = axis_errors(kind)
            some = E if len(E) else np.full((1, 6), np.nan)
            whole = {"mean": some.mean(axis=0), "median": np.median(some, axis=0), "mean of sizes": np.abs(some).mean(axis=0)}
            rows += [[label, statistic, str(len(E)), *axis_cells(values)] for statistic, values in whole.items()]
    notes = (
        "Axes are those of the camera: x right, y down, z ahead. The thesis does not state its axes' order, nor how far off it "
        "began; its median of t_y (-0.14786 m) is printed so, -0.014786 may be meant.",
        "Mean and median have signs, so errors of both signs cancel out; the mean of sizes does not. A refused or failed trial "
        'ends where it began; "accepted" leaves it out.',
    )
    return Table("Errors per axis", ["method", "statistic", "trials", *AXIS_HEADER], rows, notes)


def single(results: Results) -> Table:
    """How often, and how nearly, the experiment "single" finds the reference."""
    header = ("method", "trials", "success", "95 % interval", "rotation median deg", "90 %", "translation median cm", "90 %")
    rows: Rows = []
    for name, own in trials_of(results, "single").items():
        done = own[own.status == "done"]
        wrong = int((done.success == 0).sum())
        shares = [percent((own.status == status).mean()) for status in ("refused", "failed")]
        rows.append([name, *_quality(own), *shares, percent(wrong / len(own))])
        if 0 < len(done) < len(own):
            rows.append([f"{name}, accepted", *_quality(done), "", "", percent(wrong / len(done))])
    notes = (
        f"Success: nearer than {SUCCESS_DEG:g} deg and {100 * SUCCESS_M:g} cm to the reference. Accepted but wrong: the method "
        f"trusts its end, and is not that near; the worst that can happen.",
        'Rows "accepted" leave refused and failed trials out: a method that refuses chooses its trials.',
    )
    return Table("Success and errors", [*header, "refused", "failed", "accepted but wrong"], rows, notes)


def scenes(results: Results) -> list[Table]:
    """Success per scene; none if there is one only."""
    labels, by_scene = groups(trials_of(results, "single"), "scene")
    rows = [[name, *map(_success, own.values())] for name, own in by_scene.items()]
    return [Table("Success per scene", ["method", *labels], rows, [SHARES])] if len(labels) > 1 else []


def starts(results: Results) -> Table:
    """Success against the size of the start error, of which there are trials."""
    sizes, by_size = groups(trials_of(results, "starts"), "size")
    rows = [[name, *map(_success, own.values())] for name, own in by_size.items()]
    near = [own.start_success.mean() for own in next(iter(by_size.values())).values()]  # all methods have the same starts
    rows.append(["doing nothing", *map(percent, near)])
    notes = (
        f"{SHARES} Trials per cell: {_counts(by_size)}.",
        '"Doing nothing": the share of starts that are near enough already.',
    )
    header = ["method", *(f"±{deg:g} deg, ±{100 * m:g} cm" for deg, m in sizes)]
    return Table("Success by size of the start error", header, rows, notes)


def frames(results: Results) -> list[Table]:
    """Errors and success against the number of frames."""
    quartiles = "Median, and quartiles in brackets, over all trials."
    kinds: dict[str, tuple[str, Callable[[pd.DataFrame], str]]] = {
        "Rotation error by number of frames, deg": (quartiles, lambda own: _spread(own.rotation_deg, degrees)),
        "Translation error by number of frames, cm": (quartiles, lambda own: _spread(own.cm, centimetres)),
        "Success by number of frames": (SHARES, _success),
    }
    numbers, by_number = groups(trials_of(results, "frames"), "n")
    header = ["method", *map(plural, numbers)]
    out = []
    for title, (note, cell) in kinds.items():
        rows = [[name, *map(cell, own.values())] for name, own in by_number.items()]
        out.append(Table(title, header, rows, [f"{note} Trials per cell: {_counts(by_number)}."]))
    return out


def troubles(results: Results) -> list[Table]:
    """Why trials were refused or failed, and which other work failed."""
    wrong = results.trials[results.trials.status != "done"]
    # Reasons that differ in their figures only count as one; the first of them is shown.
    kind = [wrong.experiment, wrong.method, wrong.status, wrong.reason.map(lambda text: NUMBER.sub("#", text))]
    found = [(len(own), *own.iloc[0][["experiment", "method", "status", "reason"]]) for _, own in wrong.groupby(kind, sort=False)]
    counted = [[str(n), *said] for n, *said in sorted(found, key=lambda own: -own[0])]
    kinds = {
        "Trials refused or failed": (("trials", "experiment", "method", "status", "reason"), counted),
        "Other work that failed": (("what", "why"), results.failures),
    }
    out = []
    for title, (header, rows) in kinds.items():
        left = len(rows) - MOST_REASONS
        notes = ["Of reasons that differ in their figures only, one is shown."] if rows is counted else []
        notes += [f"{left} more are not shown."] if left > 0 else []
        if rows:
            out.append(Table(title, header, rows[:MOST_REASONS], notes))
    return out


def _quality(own: pd.DataFrame) -> list[str]:
    """Cells of single() from the number of trials to the errors."""
    errors = [degrees(quantile(own.rotation_deg, share)) for share in (0.5, 0.9)]
    errors += [centimetres(quantile(own.cm, share)) for share in (0.5, 0.9)]
    return [str(len(own)), percent(own.success.mean()), f"{interval(own.success.sum(), len(own))} %", *errors]


def _success(own: pd.DataFrame) -> str:
    return f"{percent(own.success.mean())} ({interval(own.success.sum(), len(own))})" if len(own) else NONE


def _spread(values: pd.Series, form: Callable[[float], str]) -> str:
    low, middle, high = (quantile(values, share) for share in (0.25, 0.5, 0.75))
    return NONE if math.isnan(middle) else f"{form(middle)} ({form(low)} to {form(high)})"


def _counts(grouped: dict[str, dict[object, pd.DataFrame]]) -> str:
    """How many trials a cell has."""
    counts = [len(own) for groups in grouped.values() for own in groups.values() if len(own)]
    return " to ".join(map(str, sorted({min(counts), max(counts)})))


def _of_curves(results: Results, measure: Callable[[Curves], Matrix], statistics: Sequence[str]) -> tuple[list[str], Rows]:
    """Header, and rows of a measure per axis (6,) over the curves of each method."""
    rows: Rows = []
    for name, own in curves_of_methods(results).items():
        columns = np.array([measure(curves) for curves in own]).T
        cells = {"mean": map(mean, columns), "median": (median(column[np.isfinite(column)]) for column in columns)}
        rows += [[name, statistic, str(len(own)), *axis_cells(cells[statistic])] for statistic in statistics]
    return ["method", "statistic", "scenes", *AXIS_HEADER], rows


def peaks(results: Results) -> Table:
    """How far the loss curves' peaks lie from the reference."""
    notes = ["Distance of each curve's peak from the reference, without sign."]
    title = "How far the peaks lie from the reference"
    return Table(title, *_of_curves(results, peak_distances, ("mean", "median")), notes)


def basin(results: Results) -> Table:
    """From how far away each curve rises towards its peak."""
    reach = [one.curves.offsets.max(axis=1) for one in results.curves]
    notes = [
        "Mean distance from the reference, over both sides and all scenes, up to which a curve rises towards its peak, where "
        "steps back of 1 % of its span do not count. A peak beyond the reference leaves that side 0.",
        f"The curves reach {max(r[0] for r in reach):g} deg and {max(r[3] for r in reach):g} cm to either side: more cannot "
        f"stand here.",
    ]
    return Table("From how far away the curves rise", *_of_curves(results, basins, ("mean",)), notes)


def averaging(results: Results) -> list[Table]:
    """How far the peaks of single frames and of their averages lie from the reference."""
    rows: Rows = []
    for one in results.averagings:
        sets = list(combinations(range(len(one.names)), SET))
        kinds = {f"{len(one.names)} single frames": list(one.single)}
        for name, weighted in (("unweighted", False), ("weighted", True)):
            kinds[f"{name}, {len(sets)} averages of {SET}"] = [one.average(own, weighted) for own in sets]
        for name, found in kinds.items():
            rows.append([one.scene, one.method, name, *axis_cells(map(mean, np.transpose([peak_distances(c) for c in found])))])
    notes = [f"Mean distance of the peaks from the reference, without sign, over frames and over all sets of {SET} of them."]
    header = ["scene", "method", "curves", *AXIS_HEADER]
    return [Table("How far the peaks of averages lie from the reference", header, rows, notes)] if rows else []


def keyframes(results: Results) -> list[Table]:
    """Which frames algorithm 6 selects, by threshold."""
    rows: Rows = []
    for one in results.similarities:
        for threshold, own in one.keyframes.items():
            which = "frames " + ", ".join(str(one.frames[k]) for k in own)
            rows.append([one.scene, f"{threshold:g}", f"{len(own)} of {len(one.frames)}", which])
    notes = [f"The thesis's threshold is {THESIS_THRESHOLD:g}; the node uses the configured one, and limits of time besides."]
    return [Table("Keyframes of algorithm 6", ["scene", "threshold", "keyframes", "which"], rows, notes)] if rows else []


def cost(results: Results) -> Table:
    """CPU time and memory of a method; the whole estimate from the trials."""
    single = trials_of(results, "single")
    rows: Rows = []
    for method, count, *values in results.costs:
        own = single.get(method, results.trials.iloc[:0])
        whole = median(own.cpu_s + own.features_cpu_s), median(own.evaluations)
        rows.append([method, str(count), *map(figures, (*values, *whole))])
    header = ["method", "frames", "features ms per frame", "evaluation ms", "memory MB", "CPU s of an estimate", "evaluations"]
    notes = [
        "CPU time of one core. Features are made once per frame, an evaluation is one value of the score over so many frames; "
        "memory is the most that arrays took meanwhile.",
        'CPU s and evaluations of an estimate: medians of the experiment "single", features included.',
    ]
    return Table("Cost", header, rows, notes)


def detection(trusts: Sequence[Trust]) -> Table:
    """For each size of error: how well F_C of one frame, and its mean over several, separate it from no error."""
    right = np.array([t.right for t in trusts])
    sizes = list(dict.fromkeys((deg, m) for t in trusts for deg, m, _ in t.wrong))
    rows: Rows = [["none", number(float(right.mean()), 3), *["–"] * 4, percent(called_right(trusts, None))]]
    for deg, m in sizes:
        wrong = np.array([[share for d, x, share in t.wrong if (d, x) == (deg, m)] for t in trusts])
        rng = np.random.default_rng(0)
        sets = [rng.choice(len(trusts), min(TOGETHER, len(trusts)), replace=False) for _ in range(DRAWS)]
        ways = rng.integers(wrong.shape[1], size=DRAWS)
        of_right = np.array([right[s].mean() for s in sets])
        of_wrong = np.array([wrong[s, way].mean() for s, way in zip(sets, ways, strict=True)])
        cells = [f"{deg:g} deg" if deg else f"{100 * m:g} cm", number(float(wrong.mean()), 3)]
        for pair in ((right, wrong.ravel()), (of_right, of_wrong)):
            cells += [number(area(*pair), 2), percent(hits(*pair))]
        rows.append([*cells, percent(called_right(trusts, (deg, m)))])
    title = f"Detection by the share of worse neighbours, {len(trusts)} frames"
    header = ["error", "mean F_C", "AUC, 1 frame", "hits", f"AUC, {TOGETHER} frames", "hits", "called right"]
    notes = [
        "AUC: area under the ROC curve of F_C against no error; 0.5 is chance. Hits: share of wrong ones found at 5 % false "
        "alarms.",
        f"With {TOGETHER} frames: mean of F_C, {DRAWS} sets of frames of any scene, all off by the same error.",
        "Called right: share of frames whose probability to be right exceeds one half, both distributions learned from all other "
        "frames and all errors together.",
    ]
    return Table(title, header, rows, notes)
