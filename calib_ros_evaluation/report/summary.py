"""The report's first table, one row per method, and its findings in words."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib_ros_evaluation.report.statistics import (
    OURS,
    all_methods,
    curves_of_methods,
    errors,
    mean,
    median,
    peak_distances,
    trials_of,
    wilson,
)
from calib_ros_evaluation.report.table import Cell, Rows, Table, centimetres, degrees, figures, percent, table, winners
from calib_ros_evaluation.results import SUCCESS_DEG, SUCCESS_M, Results


@dataclass(frozen=True)
class _Column:
    """said: its name in a sentence. better: "low", "high", or empty where neither is better in itself."""

    header: str
    said: str
    better: str
    unit: str = ""


COLUMNS = (
    _Column("success", "Success", "high"),
    _Column("rotation, median deg", "Median rotation error", "low", " deg"),
    _Column("translation, median cm", "Median translation error", "low", " cm"),
    _Column("refused", "Refused", ""),
    _Column("CPU s", "CPU time of an estimate", "low", " s"),
    _Column("peaks off, deg", "Distance of the curves' peaks, rotations", "low", " deg"),
    _Column("peaks off, cm", "Distance of the curves' peaks, translations", "low", " cm"),
)
NOTES = (
    f"Success: ended within {SUCCESS_DEG:g} deg and {100 * SUCCESS_M:g} cm of the reference. A refused or failed trial is "
    f"none, and its errors are those of its start.",
    "Constants of all methods, this project's too, were chosen on KITTI drive 0005, odometry 00 and synthetic drives, where "
    "their authors published none: on these, none of the methods is held out.",
    "CPU s: median of features and optimisation together. Peaks off: mean distance of the loss curves' peaks from the reference "
    "over scenes and axes.",
    "Refusing is not ranked: it is right where the optimum is wrong, and wrong where it is right.",
)


def summary(results: Results) -> Table:
    """One row per method: the experiment "single", and the peaks of the loss curves."""
    cells = _cells(results)
    rows: Rows = [[name, *row] for name, row in cells.items()]
    better = {k + 1: column.better for k, column in enumerate(COLUMNS) if column.better}
    return table("All methods", ["method", *(column.header for column in COLUMNS)], rows, better, notes=NOTES)


def sentences(results: Results) -> list[str]:
    """Who is best in each column, and by how much; says so where a baseline is better than this project's method."""
    cells = _cells(results)
    names, said = list(cells), []
    for k, column in enumerate(COLUMNS):
        own = [row[k] for row in cells.values()]
        best = winners(own, column.better) if column.better else []
        if best:
            said.append(_sentence(column, names, own, best) + (_doubt(results, names, best) if k == 0 else "") + ".")
    return said


def _cells(results: Results) -> dict[str, list[Cell]]:
    trials, curves = trials_of(results, "single"), curves_of_methods(results)
    out = {}
    for name in all_methods(results):
        own = trials.get(name, [])
        rotation, translation = errors(own)
        n = len(own) or math.nan
        peaks = np.array([peak_distances(c) for c in curves.get(name, [])]).reshape(-1, 6)
        if own or len(peaks):
            out[name] = [
                percent(sum(t.success for t in own) / n),
                degrees(median(rotation)),
                centimetres(median(translation)),
                percent(sum(t.status == "refused" for t in own) / n),
                figures(median([t.cpu_s + t.features_cpu_s for t in own])),
                degrees(mean(peaks[:, :3].ravel())),
                centimetres(mean(peaks[:, 3:].ravel())),
            ]
    return out


def _sentence(column: _Column, names: list[str], own: list[Cell], best: list[int]) -> str:
    figure = own[best[0]].text + column.unit
    if OURS not in names or math.isnan((mine := own[names.index(OURS)]).value):
        return f"{column.said}: {_are([names[k] for k in best])} best with {figure}"
    if names.index(OURS) not in best:
        sign = 1 if column.better == "low" else -1
        ahead = sum(sign * cell.value < sign * mine.value and cell.text != mine.text for cell in own)
        others = f"; {ahead} baselines are better than {OURS}" if ahead > 1 else ""
        baselines, behind = _are([names[k] for k in best]), f"{OURS} has {mine.text}{column.unit}{others}"
        return f"{column.said}: a baseline is better than {OURS}. {baselines} best with {figure}, {behind}"
    equal = [names[k] for k in best if names[k] != OURS]
    if equal:
        return f"{column.said}: {_are([OURS, *equal])} equally good with {figure}"
    rest = [k for k, cell in enumerate(own) if k not in best and not math.isnan(cell.value)]
    second = (min if column.better == "low" else max)(rest, key=lambda k: own[k].value)
    return f"{column.said}: {OURS} is best with {figure}, next {names[second]} with {own[second].text}{column.unit}"


def _doubt(results: Results, names: list[str], best: list[int]) -> str:
    """Methods whose success does not differ significantly from the best one's."""
    trials = trials_of(results, "single")
    found = {name: wilson(sum(t.success for t in own), len(own)) for name, own in trials.items()}
    low = found[names[best[0]]][0]
    near = [name for name, interval in found.items() if names.index(name) not in best and interval[1] >= low]
    return f"; the 95 % intervals of {_joined(near)} reach into that of the best" if near else ""


def _are(names: list[str]) -> str:
    return f"{_joined(names)} {'are' if len(names) > 1 else 'is'}"


def _joined(names: list[str]) -> str:
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
