"""Plots of trials: errors per axis, success against the start, errors against frames and time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros_evaluation.curves import AXES
from calib_ros_evaluation.rendering import empty_figure
from calib_ros_evaluation.report.plots import LineStyle, Plot, finished, method_legend, plain
from calib_ros_evaluation.report.statistics import OURS, axis_errors, errors, quantile, start_sizes, wilson
from calib_ros_evaluation.results import SUCCESS_DEG, SUCCESS_M, Trial

Matrix = NDArray[np.float64]
LIMITS = (SUCCESS_DEG, 100 * SUCCESS_M)  # deg, cm
DODGE = 0.62  # of the narrowest gap between two positions, shared by the methods that stand side by side
PAPER = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 1}  # behind text
SHORTEST_S = 1e-3  # CPU time is not known better, and zero has no logarithm
SMALLEST = (1e-2, 1e-1)  # deg, cm; nearer the reference itself is not known
GRID = 300  # places where the median is taken


def boxes(name: str, trials: Mapping[str, Sequence[Trial]], styles: Mapping[str, LineStyle]) -> Plot:
    """Errors per axis as figures 4.14 and 4.15 have them; what lies outside the drawn range is counted. Each method needs a trial
    with a finite end."""
    figure = empty_figure(13, 7.2)
    own = {method: axis_errors(found) for method, found in trials.items()}
    for axis, label in enumerate(AXES):
        axes = figure.add_subplot(2, 3, axis + 1)
        columns = [E[:, axis] for E in own.values()]
        half = _half_range(columns, LIMITS[axis // 3])
        drawn = axes.boxplot(columns, patch_artist=True, widths=0.6, flierprops={"marker": ".", "markersize": 4, "alpha": 0.5})
        for part, median, method in zip(drawn["boxes"], drawn["medians"], own, strict=True):
            part.set(facecolor=styles[method].color, alpha=0.75, linewidth=1.6 if method == OURS else 0.9)
            median.set(color="black", linewidth=1.6)
        for k, values in enumerate(columns, start=1):
            outside = int((np.abs(values) > half).sum())
            if outside:
                axes.text(k, 0.96 * half, f"{outside} out", ha="center", va="top", fontsize=8, color="0.25", bbox=PAPER)
        axes.axhspan(-LIMITS[axis // 3], LIMITS[axis // 3], color="0.93", zorder=0)
        axes.axhline(0, color="0.6", linewidth=1, zorder=0.5)
        axes.set(title=f"${label}$", ylim=(-half, half), ylabel="error, deg" if axis < 3 else "error, cm")
        axes.set_xticks(range(1, len(own) + 1), [plain(method) for method in own], rotation=30, ha="right")
    caption = (
        "Signed error at the end of all trials. Box: quartiles, line: median, whiskers: up to 1.5 box lengths, dots: trials "
        "beyond. "
        '"out": so many trials lie outside the drawn range. Grey band: the limit of success.'
    )
    return finished(figure, name, "Errors of single frames per axis", caption)


def _half_range(columns: Sequence[Matrix], limit: float) -> float:
    """Half the drawn range: where the whiskers of half of the methods end, so that one that is far off does not flatten all the
    others; at least twice the limit of success."""
    ends = []
    for values in columns:
        low, high = np.quantile(values, [0.25, 0.75])
        inside = values[(values >= low - 1.5 * (high - low)) & (values <= high + 1.5 * (high - low))]
        ends.append(float(np.abs(inside).max()))
    return max(1.15 * float(np.median(ends)), 2 * limit)


def starts(name: str, trials: Mapping[str, Sequence[Trial]], styles: Mapping[str, LineStyle]) -> Plot:
    """Success against the size of the start error."""
    figure = empty_figure(13, 5.2)
    axes = figure.add_subplot()
    sizes = start_sizes(t for own in trials.values() for t in own)
    places, note = _places([deg for deg, _ in sizes])
    for place, (method, own) in zip(_dodged(places, len(trials)), trials.items(), strict=True):
        found = [[t.success for t in own if (t.start_deg, t.start_m) == size] for size in sizes]
        kept = [k for k, good in enumerate(found) if good]
        share = np.array([np.mean(found[k]) for k in kept])
        ends = np.array([wilson(sum(found[k]), len(found[k])) for k in kept]).reshape(-1, 2)
        _with_bars(axes, place[kept], 100 * share, 100 * ends.T, styles[method])
    axes.set_xticks(places, [f"±{deg:g} deg\n±{100 * m:g} cm" for deg, m in sizes])
    axes.set(xlabel=f"start error per axis{note}", ylabel="success, %", ylim=(-3, 103), yticks=range(0, 101, 20))
    axes.grid(axis="y", color="0.9")
    method_legend(figure, {method: styles[method] for method in trials}, markers=True)
    caption = "Bars: 95 % intervals (Wilson). Methods stand side by side only so that their bars can be seen."
    return finished(figure, name, "Success by size of the start error", caption)


def frames(name: str, trials: Mapping[str, Sequence[Trial]], styles: Mapping[str, LineStyle]) -> Plot:
    """Errors against the number of frames."""
    figure = empty_figure(13, 5.2)
    numbers = sorted({len(t.frames) for own in trials.values() for t in own})
    places, note = _places(numbers)
    for k, (label, limit) in enumerate(zip(("rotation error, deg", "translation error, cm"), LIMITS, strict=True)):
        axes = figure.add_subplot(1, 2, k + 1)
        drawn = []
        for place, (method, own) in zip(_dodged(places, len(trials)), trials.items(), strict=True):
            groups = [errors([t for t in own if len(t.frames) == n])[k] for n in numbers]
            found = np.array([[quantile(g, share) for share in (0.25, 0.5, 0.75)] for g in groups])
            kept = np.isfinite(found[:, 1])
            drawn.append(found)
            # A quartile of infinity, more than a quarter without an end, is drawn beyond the axis.
            _with_bars(axes, place[kept], found[kept, 1], np.nan_to_num(found[kept][:, [0, 2]].T, posinf=1e6), styles[method])
        axes.axhline(limit, color="0.5", linewidth=1, linestyle=(0, (2, 3)), zorder=1)
        axes.set_yscale("log")
        decimal(axes.yaxis)
        axes.set_ylim(*_seen(drawn, limit))
        axes.set_xticks(places, [str(n) for n in numbers])
        axes.set(xlabel=f"frames{note}", ylabel=f"{label} (logarithmic)")
        axes.grid(axis="y", color="0.9")
    method_legend(figure, {method: styles[method] for method in trials}, markers=True)
    caption = "Median over all trials, bars from quartile to quartile; dotted: the limit of success."
    return finished(figure, name, "Errors by number of frames", caption)


def _with_bars(axes: Any, x: Matrix, y: Matrix, ends: Matrix, style: LineStyle) -> None:
    """Line through (x, y), bars between ends (2, n)."""
    off = np.maximum(np.stack([y - ends[0], ends[1] - y]), 0)
    axes.errorbar(x, y, off, marker=style.marker, markersize=6, elinewidth=1, capsize=2.5, **style.line)


def _places(values: Sequence[float]) -> tuple[Matrix, str]:
    """Positions of values on the axis, logarithmic where possible, and what the label adds."""
    if len(set(values)) == len(values) and values and min(values) > 0:
        return np.log2(np.array(values, float)), " (logarithmic)" if len(values) > 1 else ""
    return np.arange(len(values), dtype=float), " (equally spaced)"


def _dodged(places: Matrix, n: int) -> list[Matrix]:
    """Places of n methods side by side."""
    gap = float(np.diff(places).min()) if len(places) > 1 else 1.0
    return [places + DODGE * gap * ((k + 0.5) / n - 0.5) for k in range(n)]


def _seen(drawn: Sequence[Matrix], limit: float) -> tuple[float, float]:
    """Range of a logarithmic axis that shows all that is drawn, and the limit of success."""
    kept = np.concatenate([limit * np.ones(1), *(values.ravel() for values in drawn)])
    kept = kept[np.isfinite(kept) & (kept > 0)]
    return float(max(kept.min() / 1.3, 1e-4)), float(1.3 * kept.max())


def decimal(axis: Any) -> None:
    """Ticks at 1, 2 and 5, written out."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1, 2, 5), numticks=30))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def traces(name: str, trials: Mapping[str, Sequence[Trial]], styles: Mapping[str, LineStyle]) -> Plot:
    """Errors of the best so far against CPU time and evaluations: a thin line per trial, a thick one for the median."""
    from matplotlib.collections import LineCollection

    figure = empty_figure(13, 8.4)
    grid = figure.subplots(2, 2, sharex="col", sharey="row")
    for row, (kind, limit) in enumerate(zip(("rotation error, deg", "translation error, cm"), LIMITS, strict=True)):
        for column, label in enumerate(("CPU s of the optimisation", "evaluations")):
            axes = grid[row, column]
            for method, own in trials.items():
                steps = [_steps(t, column, row) for t in own]
                style = styles[method]
                # An even amount of ink per method, however many trials it has.
                alpha = float(np.clip(4 / len(steps), 0.06, 0.35))
                lines = [np.column_stack([np.repeat(x, 2)[1:], np.repeat(y, 2)[:-1]]) for x, y in steps]
                axes.add_collection(LineCollection(lines, colors=style.color, alpha=alpha, linewidths=0.7, zorder=2))
                x, y = _median(steps)
                axes.plot(x, y, **(style.line | {"linewidth": style.width + (0.9 if method == OURS else 0.7)}))
            axes.axhline(limit, color="0.5", linewidth=1, linestyle=(0, (2, 3)), zorder=1)
            axes.set(xscale="log", yscale="log")
            axes.autoscale_view()
            axes.grid(color="0.92")
            axes.set(xlabel=f"{label} (logarithmic)" if row else "", ylabel="" if column else f"{kind} (logarithmic)")
        decimal(grid[row, 0].yaxis)  # after the scale of all that share it is set
    method_legend(figure, {method: styles[method] for method in trials})
    caption = (
        "Thin: single trials, each held at its last value once it has ended; thick: the median of all trials of a method, to the "
        "end of its longest. Dotted: the limit of success. Features are not in this time."
    )
    return finished(figure, name, "Errors of the best so far", caption)


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
