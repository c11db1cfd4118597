"""Tables of the report; every function needs the results only."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from itertools import combinations

import numpy as np

from calib_ros_evaluation.report.statistics import (
    accepted,
    all_methods,
    area,
    axis_errors,
    basins,
    called_right,
    curves_of_methods,
    errors,
    hits,
    mean,
    median,
    peak_distances,
    quantile,
    start_sizes,
    trials_of,
    wilson,
)
from calib_ros_evaluation.report.table import NONE, Rows, Table, centimetres, degrees, figures, number, percent, table
from calib_ros_evaluation.results import SET, SUCCESS_DEG, SUCCESS_M, THESIS_THRESHOLD, Results, Trial, Trust

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


def summary(results: Results) -> Table:
    """One row per method: the experiment "single", and the peaks of the loss curves."""
    trials, curves = trials_of(results, "single"), curves_of_methods(results)
    rows: Rows = []
    for name in all_methods(results):
        own = trials.get(name, [])
        rotation, translation = errors(own)
        n = len(own) or math.nan
        peaks = np.array([peak_distances(c) for c in curves.get(name, [])]).reshape(-1, 6)
        if own or len(peaks):
            rows.append(
                [
                    name,
                    percent(sum(t.success for t in own) / n),
                    degrees(median(rotation)),
                    centimetres(median(translation)),
                    percent(sum(t.status == "refused" for t in own) / n),
                    figures(median([t.cpu_s + t.features_cpu_s for t in own])),
                    degrees(mean(peaks[:, :3].ravel())),
                    centimetres(mean(peaks[:, 3:].ravel())),
                ]
            )
    header = ("success", "rotation, median deg", "translation, median cm", "refused", "CPU s", "peaks off, deg", "peaks off, cm")
    return table("All methods", ["method", *header], rows, SUMMARY_NOTES)


def axis_cells(values: Iterable[float]) -> list[str]:
    """Six values, deg and cm."""
    return [degrees(v) if k < 3 else number(v, 2) for k, v in enumerate(values)]


def axes(results: Results) -> Table:
    """Table 4.4: errors per axis of the experiment "single", beside the printed ones."""
    scale = np.array([np.rad2deg(1)] * 3 + [100] * 3)
    rows: Rows = [[PRINTED_NAME, name, "100", *axis_cells(scale * values)] for name, values in PRINTED.items()]
    for name, own in trials_of(results, "single").items():
        kinds = {name: own} | ({f"{name}, accepted": accepted(own)} if len(accepted(own)) < len(own) else {})
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
    return table("Errors per axis", ["method", "statistic", "trials", *AXIS_HEADER], rows, notes)


def single(results: Results) -> Table:
    """How often, and how nearly, the experiment "single" finds the reference."""
    header = ("method", "trials", "success", "95 % interval", "rotation median deg", "90 %", "translation median cm", "90 %")
    rows: Rows = []
    for name, own in trials_of(results, "single").items():
        trusted = accepted(own)
        wrong = sum(not t.success for t in trusted)
        shares = [sum(t.status == status for t in own) / len(own) for status in ("refused", "failed")]
        rows.append([name, *_quality(own), *(percent(s) for s in shares), percent(wrong / len(own))])
        if 0 < len(trusted) < len(own):
            rows.append([f"{name}, accepted", *_quality(trusted), "", "", percent(wrong / len(trusted))])
    notes = (
        f"Success: nearer than {SUCCESS_DEG:g} deg and {100 * SUCCESS_M:g} cm to the reference. Accepted but wrong: the method "
        f"trusts its end, and is not that near; the worst that can happen.",
        'Rows "accepted" leave refused and failed trials out: a method that refuses chooses its trials.',
    )
    return table("Success and errors", [*header, "refused", "failed", "accepted but wrong"], rows, notes)


def scenes(results: Results) -> Table | None:
    """Success per scene; None if there is one only."""
    trials = trials_of(results, "single")
    labels = list(dict.fromkeys(t.scene for own in trials.values() for t in own))
    if len(labels) < 2:
        return None
    rows: Rows = [[name, *(_success([t for t in own if t.scene == label]) for label in labels)] for name, own in trials.items()]
    return table("Success per scene", ["method", *labels], rows, [SHARES])


def starts(results: Results) -> Table:
    """Success against the size of the start error, of which there are trials."""
    trials = trials_of(results, "starts")
    sizes = start_sizes(t for own in trials.values() for t in own)
    rows: Rows = [
        [name, *(_success([t for t in own if (t.start_deg, t.start_m) == s]) for s in sizes)] for name, own in trials.items()
    ]
    one = next(iter(trials.values()))  # all methods have the same starts
    near = [[t.start_success for t in one if (t.start_deg, t.start_m) == s] for s in sizes]
    rows.append(["doing nothing", *(percent(sum(x) / len(x)) if x else NONE for x in near)])
    counts = Counter((t.method, t.start_deg, t.start_m) for own in trials.values() for t in own)
    notes = (
        f"{SHARES} Trials per cell: {_range(counts.values())}.",
        '"Doing nothing": the share of starts that are near enough already.',
    )
    header = ["method", *(f"±{deg:g} deg, ±{100 * m:g} cm" for deg, m in sizes)]
    return table("Success by size of the start error", header, rows, notes)


def frames(results: Results) -> list[Table]:
    """Errors and success against the number of frames."""
    quartiles = "Median, and quartiles in brackets, over all trials."
    kinds: dict[str, tuple[str, Callable[[Sequence[Trial]], str]]] = {
        "Rotation error by number of frames, deg": (quartiles, lambda own: _spread(errors(own)[0], degrees)),
        "Translation error by number of frames, cm": (quartiles, lambda own: _spread(errors(own)[1], centimetres)),
        "Success by number of frames": (SHARES, _success),
    }
    trials = trials_of(results, "frames")
    numbers = sorted({len(t.frames) for own in trials.values() for t in own})
    counts = _range(Counter((t.method, len(t.frames)) for own in trials.values() for t in own).values())
    header = ["method", *(f"{n} frame{'s' if n > 1 else ''}" for n in numbers)]
    out = []
    for title, (note, cell) in kinds.items():
        rows: Rows = [[name, *(cell([t for t in own if len(t.frames) == n]) for n in numbers)] for name, own in trials.items()]
        out.append(table(title, header, rows, [f"{note} Trials per cell: {counts}."]))
    return out


def troubles(results: Results) -> list[Table]:
    """Why trials were refused or failed, and which other work failed."""
    wrong = [t for t in results.trials if t.status != "done"]
    # Reasons that differ in their figures only count as one; the first of them is shown.
    kinds_of = [(t.experiment, t.method, t.status, NUMBER.sub("#", t.reason)) for t in wrong]
    first = dict(zip(reversed(kinds_of), (t.reason for t in reversed(wrong)), strict=True))
    counted: Rows = [[str(n), *kind[:3], first[kind]] for kind, n in Counter(kinds_of).most_common()]
    failures: Rows = [list(failure) for failure in results.failures]
    kinds = {
        "Trials refused or failed": (("trials", "experiment", "method", "status", "reason"), counted),
        "Other work that failed": (("what", "why"), failures),
    }
    out = []
    for title, (header, rows) in kinds.items():
        left = len(rows) - MOST_REASONS
        notes = ["Of reasons that differ in their figures only, one is shown."] if rows is counted else []
        notes += [f"{left} more are not shown."] if left > 0 else []
        if rows:
            out.append(table(title, header, rows[:MOST_REASONS], notes))
    return out


def _quality(own: Sequence[Trial]) -> list[str]:
    """Cells of single() from the number of trials to the errors."""
    good = sum(t.success for t in own)
    low, high = wilson(good, len(own))
    r, t = errors(own)
    return [
        str(len(own)),
        percent(good / len(own)),
        f"{100 * low:.0f} to {100 * high:.0f} %",
        *(degrees(quantile(r, share)) for share in (0.5, 0.9)),
        *(centimetres(quantile(t, share)) for share in (0.5, 0.9)),
    ]


def _success(own: Sequence[Trial]) -> str:
    if not own:
        return NONE
    good = sum(t.success for t in own)
    low, high = wilson(good, len(own))
    return f"{percent(good / len(own))} ({100 * low:.0f} to {100 * high:.0f})"


def _spread(values: np.ndarray, form: Callable[[float], str]) -> str:
    middle = median(values)
    if math.isnan(middle):
        return NONE
    return f"{form(middle)} ({form(quantile(values, 0.25))} to {form(quantile(values, 0.75))})"


def _range(counts: Iterable[int]) -> str:
    low, high = min(counts := list(counts)), max(counts)
    return str(low) if low == high else f"{low} to {high}"


def peaks(results: Results) -> Table:
    """How far the loss curves' peaks lie from the reference."""
    rows: Rows = []
    for name, own in curves_of_methods(results).items():
        D = np.array([peak_distances(curves) for curves in own])
        rows.append([name, "mean", str(len(own)), *axis_cells(mean(column) for column in D.T)])
        rows.append([name, "median", str(len(own)), *axis_cells(median(column[np.isfinite(column)]) for column in D.T)])
    header = ["method", "statistic", "scenes", *AXIS_HEADER]
    notes = ["Distance of each curve's peak from the reference, without sign."]
    return table("How far the peaks lie from the reference", header, rows, notes)


def basin(results: Results) -> Table:
    """From how far away each curve rises towards its peak."""
    rows: Rows = []
    for name, own in curves_of_methods(results).items():
        B = np.array([basins(curves) for curves in own])
        rows.append([name, "mean", str(len(own)), *axis_cells(mean(column) for column in B.T)])
    reach = [curves.offsets.max(axis=1) for own in curves_of_methods(results).values() for curves in own]
    notes = [
        "Mean distance from the reference, over both sides and all scenes, up to which a curve rises towards its peak, where "
        "steps back of 1 % of its span do not count. A peak beyond the reference leaves that side 0.",
        f"The curves reach {max(r[0] for r in reach):g} deg and {max(r[3] for r in reach):g} cm to either side: more cannot "
        f"stand here.",
    ]
    header = ["method", "statistic", "scenes", *AXIS_HEADER]
    return table("From how far away the curves rise", header, rows, notes)


def averaging(results: Results) -> tuple[Table, ...]:
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
    return (table("How far the peaks of averages lie from the reference", header, rows, notes),) if rows else ()


def keyframes(results: Results) -> tuple[Table, ...]:
    """Which frames algorithm 6 selects, by threshold."""
    rows: Rows = []
    for one in results.similarities:
        for threshold, own in one.keyframes.items():
            which = "frames " + ", ".join(str(one.frames[k]) for k in own)
            rows.append([one.scene, f"{threshold:g}", f"{len(own)} of {len(one.frames)}", which])
    notes = [f"The thesis's threshold is {THESIS_THRESHOLD:g}; the node uses the configured one, and limits of time besides."]
    return (table("Keyframes of algorithm 6", ["scene", "threshold", "keyframes", "which"], rows, notes),) if rows else ()


def cost(results: Results) -> Table:
    """CPU time and memory of a method; the whole estimate from the trials."""
    single = trials_of(results, "single")
    rows: Rows = []
    for one in results.costs:
        own = single.get(one.method, [])
        values = one.features_ms_per_frame, one.evaluation_ms, one.memory_mb
        whole = [t.cpu_s + t.features_cpu_s for t in own], [float(t.evaluations) for t in own]
        rows.append([one.method, str(one.frames), *map(figures, values), *(figures(median(v)) for v in whole)])
    header = ["method", "frames", "features ms per frame", "evaluation ms", "memory MB", "CPU s of an estimate", "evaluations"]
    notes = [
        "CPU time of one core. Features are made once per frame, an evaluation is one value of the score over so many frames; "
        "memory is the most that arrays took meanwhile.",
        'CPU s and evaluations of an estimate: medians of the experiment "single", features included.',
    ]
    return table("Cost", header, rows, notes)


def detection(trusts: Sequence[Trust]) -> Table:
    """For each size of error: how well F_C of one frame, and its mean over several, separate it from no error."""
    right = np.array([t.right for t in trusts])
    sizes = list(dict.fromkeys((deg, m) for t in trusts for deg, m, _ in t.wrong))
    rows: Rows = []
    for deg, m in sizes:
        wrong = np.array([[share for d, x, share in t.wrong if (d, x) == (deg, m)] for t in trusts])
        one = area(right, wrong.ravel()), hits(right, wrong.ravel())
        rng = np.random.default_rng(0)
        sets = [rng.choice(len(trusts), min(TOGETHER, len(trusts)), replace=False) for _ in range(DRAWS)]
        ways = rng.integers(wrong.shape[1], size=DRAWS)
        of_right = np.array([right[s].mean() for s in sets])
        of_wrong = np.array([wrong[s, way].mean() for s, way in zip(sets, ways, strict=True)])
        several = area(of_right, of_wrong), hits(of_right, of_wrong)
        size = f"{deg:g} deg" if deg else f"{100 * m:g} cm"
        cells = [size, number(float(wrong.mean()), 3)]
        cells += [f(x) for x, f in zip((*one, *several), (_auc, percent, _auc, percent), strict=True)]
        rows.append([*cells, percent(called_right(trusts, (deg, m)))])
    never = percent(called_right(trusts, None))
    rows.insert(0, ["none", number(float(right.mean()), 3), *["–"] * 4, never])
    title = f"Detection by the share of worse neighbours, {len(trusts)} frames"
    header = ["error", "mean F_C", "AUC, 1 frame", "hits", f"AUC, {TOGETHER} frames", "hits", "called right"]
    notes = [
        "AUC: area under the ROC curve of F_C against no error; 0.5 is chance. Hits: share of wrong ones found at 5 % false "
        "alarms.",
        f"With {TOGETHER} frames: mean of F_C, {DRAWS} sets of frames of any scene, all off by the same error.",
        "Called right: share of frames whose probability to be right exceeds one half, both distributions learned from all other "
        "frames and all errors together.",
    ]
    return table(title, header, rows, notes)


def _auc(value: float) -> str:
    return number(value, 2)
