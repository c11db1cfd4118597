"""How methods get nearer with time (their own best so far), trial by trial."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.evaluation.report.plots import Plot, Style, finished, method_legend
from calib_ros.evaluation.report.plots_trials import LIMITS, decimal
from calib_ros.evaluation.report.selection import OURS
from calib_ros.evaluation.results import Trial
from calib_ros.evaluation.steps.plots import empty_figure

Matrix = NDArray[np.float64]
SHORTEST_S = 1e-3  # CPU time is not known better, and zero has no logarithm
SMALLEST = (1e-2, 1e-1)  # deg, cm; nearer the reference itself is not known
GRID = 300  # places where the median is taken


def traces(name: str, trials: Mapping[str, Sequence[Trial]], looks: Mapping[str, Style]) -> Plot:
    """Errors of the best so far against CPU time and evaluations: a thin line per trial, a thick one for the median."""
    from matplotlib.collections import LineCollection

    made = empty_figure(13, 8.4)
    grid = made.subplots(2, 2, sharex="col", sharey="row")
    for row, (kind, limit) in enumerate(zip(("rotation error, deg", "translation error, cm"), LIMITS, strict=True)):
        for column, label in enumerate(("CPU s of the optimisation", "evaluations")):
            axes = grid[row, column]
            for method, own in trials.items():
                steps = [_steps(t, column, row) for t in own]
                look = looks[method]
                # An even amount of ink per method, however many trials it has.
                alpha = float(np.clip(4 / len(steps), 0.06, 0.35))
                lines = [np.column_stack([np.repeat(x, 2)[1:], np.repeat(y, 2)[:-1]]) for x, y in steps]
                axes.add_collection(LineCollection(lines, colors=look.color, alpha=alpha, linewidths=0.7, zorder=2))
                x, y = _median(steps)
                axes.plot(x, y, **(look.line | {"linewidth": look.width + (0.9 if method == OURS else 0.7)}))
            axes.axhline(limit, color="0.5", linewidth=1, linestyle=(0, (2, 3)), zorder=1)
            axes.set(xscale="log", yscale="log")
            axes.autoscale_view()
            axes.grid(color="0.92")
            axes.set(xlabel=f"{label} (logarithmic)" if row else "", ylabel="" if column else f"{kind} (logarithmic)")
        decimal(grid[row, 0].yaxis)  # after the scale of all that share it is set
    method_legend(made, {method: looks[method] for method in trials})
    caption = (
        "Thin: single trials, each held at its last value once it has ended; thick: the median of all trials of a method, to the "
        "end of its longest. Dotted: the limit of success. Features are not in this time."
    )
    return finished(made, name, "Errors of the best so far", caption)


def _steps(trial: Trial, column: int, row: int) -> tuple[Matrix, Matrix]:
    """Where the error changes, and to what; column: CPU time or evaluations, row: rotation or translation."""
    table = np.array(trial.trace, float).reshape(-1, 4)
    x, y = table[:, 1 - column], table[:, 2 + row] * (1, 100)[row]
    x = np.append(x, max((trial.cpu_s, trial.evaluations)[column], x[-1]))
    y = np.append(y, y[-1])
    return np.maximum(x, (SHORTEST_S, 1)[column]), np.maximum(y, SMALLEST[row])


def _median(steps: Sequence[tuple[Matrix, Matrix]]) -> tuple[Matrix, Matrix]:
    """Median over trials at places from the first step of the last to begin to the end of the longest."""
    x = np.geomspace(max(x[0] for x, _ in steps), max(x[-1] for x, _ in steps), GRID)
    values: list[Any] = [y[np.clip(np.searchsorted(own, x, side="right") - 1, 0, None)] for own, y in steps]
    return x, np.asarray(np.median(values, axis=0))
