"""Tables of scores around the reference, of keyframes and of cost."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib_ros.evaluation.report.selection import curves_of_methods, in_order, trials_of
from calib_ros.evaluation.report.statistics import basins, mean, median, peak_distances
from calib_ros.evaluation.report.table import Rows, Table, figures, table
from calib_ros.evaluation.report.tables import AXIS_HEADER, axis_cells
from calib_ros.evaluation.results import Averaging, Cost, Results, Similarity

COLUMNS = range(3, 9)  # of the six axes


def peaks(results: Results) -> Table:
    """How far the loss curves' peaks lie from the reference."""
    rows: Rows = []
    groups: list[str] = []
    for name, own in curves_of_methods(results).items():
        D = np.array([peak_distances(curves) for curves in own])
        rows.append([name, "mean", str(len(own)), *axis_cells(mean(column) for column in D.T)])
        rows.append([name, "median", str(len(own)), *axis_cells(median(column[np.isfinite(column)]) for column in D.T)])
        groups += ["mean", "median"]
    notes = [
        "Distance of each curve's peak from the reference, without sign; bold: the best mean and the best median of each axis."
    ]
    header = ["method", "statistic", "scenes", *AXIS_HEADER]
    return table("How far the peaks lie from the reference", header, rows, dict.fromkeys(COLUMNS, "low"), groups, notes)


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
    return table("From how far away the curves rise", header, rows, dict.fromkeys(COLUMNS, "high"), notes=notes)


def averaging(one: Averaging) -> Table:
    """Peaks of the weighted and of the unweighted average beside those of the frames; and over many sets of frames."""
    kinds = {"weighted": one.weighted, "unweighted": one.unweighted}
    rows: Rows = [[name, *axis_cells(peak_distances(curves))] for name, curves in kinds.items()]
    groups = ["drawn"] * len(rows)
    for label, weight, curves in zip(one.labels, one.weights, one.single, strict=True):
        rows.append([f"{label}, weight {weight:.3f}", *axis_cells(peak_distances(curves))])
        groups.append("")
    for k, name in enumerate(kinds if len(one.distances) else ()):
        rows.append([f"{name}, mean of {len(one.distances)} sets", *axis_cells(mean(d) for d in one.distances[:, k].T)])
        groups.append("sets")
    notes = [
        f"Weights: {one.classes}. Bold compares weighted with unweighted only.",
        "The frames that are drawn may be lucky or not: the last rows are means over many sets of as many frames of the scene.",
    ]
    title = f"How far the peaks lie from the reference: {one.method}, {one.scene}"
    return table(title, ["curves", *AXIS_HEADER], rows, dict.fromkeys(range(1, 7), "low"), groups, notes)


def keyframes(similarities: Sequence[Similarity]) -> Table:
    """Which frames are selected, by threshold."""
    rows: Rows = []
    for one in similarities:
        chosen = {f"algorithm 6, below {threshold:g}": own for threshold, own in one.keyframes.items()}
        chosen[f"the node, below {one.online_threshold:g}"] = one.online
        rows += [[one.scene, rule, f"{len(own)} of {len(one.names)}", _positions(own)] for rule, own in chosen.items()]
    notes = [
        "Positions count from 0. The node also takes a frame where too few images differ for too long, and never two at once."
    ]
    return table("Keyframes", ["scene", "rule", "keyframes", "positions"], rows, notes=notes)


def cost(results: Results) -> Table:
    """CPU time and memory of a method: means over scenes; the whole estimate from the trials."""
    single = trials_of(results, "single")
    measured: dict[tuple[str, int], list[Cost]] = {}
    for one in results.costs:
        measured.setdefault((one.method, one.frames), []).append(one)
    rows: Rows = []
    groups: list[str] = []
    for name, frames in [key for name in in_order(results, (m for m, _ in measured)) for key in measured if key[0] == name]:
        found, own = measured[name, frames], single.get(name, [])
        values = zip(*((c.features_ms_per_frame, c.evaluation_ms, c.memory_mb) for c in found), strict=True)
        whole = [[t.cpu_s + t.features_cpu_s for t in own], [float(t.evaluations) for t in own]]
        rows.append([name, str(frames), *(figures(mean(v)) for v in values), *(figures(median(v)) for v in whole)])
        groups.append(str(frames))
    header = ["method", "frames", "features ms per frame", "evaluation ms", "memory MB", "CPU s of an estimate", "evaluations"]
    notes = [
        "CPU time of one core. Features are made once per frame, an evaluation is one value of the score over so many frames; "
        "memory is the most that arrays took meanwhile. Means over scenes.",
        'CPU s and evaluations of an estimate: medians of the experiment "single", features included.',
    ]
    return table("Cost", header, rows, dict.fromkeys(range(2, 6), "low"), groups, notes)


def _positions(chosen: Sequence[int], most: int = 24) -> str:
    shown = " ".join(map(str, chosen[:most]))
    return f"{shown} ..." if len(chosen) > most else shown
