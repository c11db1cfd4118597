"""The report's first table, one row per method."""

from __future__ import annotations

import math

import numpy as np

from calib_ros_evaluation.report.statistics import (
    all_methods,
    curves_of_methods,
    errors,
    mean,
    median,
    peak_distances,
    trials_of,
)
from calib_ros_evaluation.report.table import Rows, Table, centimetres, degrees, figures, percent, table
from calib_ros_evaluation.results import SUCCESS_DEG, SUCCESS_M, Results

# Header -> which values are better; empty where neither is better in itself.
COLUMNS = {
    "success": "high",
    "rotation, median deg": "low",
    "translation, median cm": "low",
    "refused": "",
    "CPU s": "low",
    "peaks off, deg": "low",
    "peaks off, cm": "low",
}
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
    better = {k + 1: way for k, way in enumerate(COLUMNS.values()) if way}
    return table("All methods", ["method", *COLUMNS], _rows(results), better, notes=NOTES)


def _rows(results: Results) -> Rows:
    trials, curves = trials_of(results, "single"), curves_of_methods(results)
    out: Rows = []
    for name in all_methods(results):
        own = trials.get(name, [])
        rotation, translation = errors(own)
        n = len(own) or math.nan
        peaks = np.array([peak_distances(c) for c in curves.get(name, [])]).reshape(-1, 6)
        if own or len(peaks):
            out.append(
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
    return out
