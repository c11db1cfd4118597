"""What all plots of the report share: the figure, the file it becomes, and how a method looks."""

from __future__ import annotations

import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros_evaluation.curves import AXES, Curves
from calib_ros_evaluation.rendering import COLORS, empty_figure, six_axes
from calib_ros_evaluation.report.statistics import OURS, axis_errors, errors, quantile, start_sizes, wilson
from calib_ros_evaluation.results import SUCCESS_DEG, SUCCESS_M, Averaging, HeatMap, Similarity, Trial

# Okabe and Ito: told apart by colour-blind eyes too. Their yellow cannot be seen on white, brown stands for it.
OUR_COLOR, BAD, GOOD = COLORS
OTHERS = ("#e69f00", "#56b4e9", GOOD, "#cc79a7", BAD, "#333333", "#8c510a")
DASHES: tuple[Any, ...] = ("--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 1)), (0, (7, 2)), (0, (3, 1, 1, 1)))
MARKERS = ("s", "^", "D", "v", "P", "X", "*")
LONGEST = 70  # letters of a name in a plot


@dataclass(frozen=True)
class Plot:
    """name: of its file, without suffix. png: the file. size: its width and height, px. wide: needs the page's width."""

    name: str
    title: str
    caption: str
    png: bytes
    size: tuple[int, int]
    wide: bool = True


@dataclass(frozen=True)
class Style:
    """How lines of a method are drawn. layer: higher ones cover lower ones."""

    color: str
    dash: Any
    marker: str
    width: float
    layer: float

    @property
    def line(self) -> dict[str, Any]:
        """Options of matplotlib for a line without markers."""
        return {"color": self.color, "linestyle": self.dash, "linewidth": self.width, "zorder": self.layer}


def styles(names: Sequence[str]) -> dict[str, Style]:
    """By the order of all methods, so that a method looks alike in every plot; this project's own is thick and in front."""
    out, k = {}, 0
    for name in names:
        if name == OURS:
            out[name] = Style(OUR_COLOR, "-", "o", 2.8, 5)
        else:
            out[name] = Style(OTHERS[k % len(OTHERS)], DASHES[k % len(DASHES)], MARKERS[k % len(MARKERS)], 1.6, 3)
            k += 1
    return out


def finished(made: Any, name: str, title: str, caption: str, wide: bool = True) -> Plot:
    """The figure as a file; the same figure gives the same bytes."""
    from PIL import Image  # comes with matplotlib, which writes its own files by it

    made.canvas.draw()
    picture = Image.fromarray(np.asarray(made.canvas.buffer_rgba())).convert("RGB")
    stream = io.BytesIO()
    # 256 colours are enough to the eye, and the file is a third as large.
    picture.quantize(256, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE).save(stream, "PNG", optimize=True)
    return Plot(name, title, caption, stream.getvalue(), picture.size, wide)


def plain(text: str) -> str:
    """A name as it is: without formulas, and not too long."""
    text = text if len(text) <= LONGEST else text[: LONGEST - 1] + "…"
    return text.replace("$", r"\$")


def legend(made: Any, handles: Iterable[Any], columns: int = 8) -> None:
    """Above all axes."""
    handles = list(handles)
    if handles:
        made.legend(handles=handles, loc="outside upper center", ncols=min(len(handles), columns), frameon=False, fontsize=11)


def method_legend(made: Any, own: dict[str, Style], markers: bool = False) -> None:
    """Names and lines of methods above all axes."""
    from matplotlib.lines import Line2D

    lines = [
        Line2D([], [], label=plain(name), marker=look.marker if markers else "", markersize=6, **look.line)
        for name, look in own.items()
    ]
    legend(made, lines)


# Plots of scores around the reference.
SINGLE = (OTHERS[0], OTHERS[2], "#9467bd")  # orange, green, purple, as figure 4.16 has them


def loss_curves(name: str, title: str, caption: str, curves: Mapping[str, Curves], looks: Mapping[str, Style]) -> Plot:
    """Method -> curves, each from 0 to 1, with a mark at its peak."""
    made = empty_figure(13, 6.8)
    own = {method: looks[method] for method in curves}
    for axis, axes in enumerate(six_axes(made, "score, scaled")):
        for method, found in curves.items():
            look = own[method]
            axes.plot(found.offsets[axis], found.scaled()[axis], **look.line)
            if np.isfinite(found.values[axis]).all():
                axes.plot(found.peaks[axis], 1, look.marker, color=look.color, markersize=7, zorder=look.layer, clip_on=False)
    method_legend(made, own, markers=True)
    return finished(made, name, title, caption)


def mean_curves(curves: Sequence[Curves]) -> Curves:
    """Mean of curves scaled to 0..1 each, at the first one's offsets; those without a finite score are left out."""
    kept = [c for c in curves if np.isfinite(c.values).all()] or list(curves[:1])
    offsets = kept[0].offsets
    values = [[np.interp(x, *pair) for x, *pair in zip(offsets, c.offsets, c.scaled(), strict=True)] for c in kept]
    return Curves(offsets, np.mean(values, axis=0))


def averaging(name: str, one: Averaging) -> Plot:
    """Figure 4.16: thin lines are single frames."""
    made = empty_figure(13, 6.8)
    handles: list[Any] = []
    for axis, axes in enumerate(six_axes(made, "score, scaled")):
        lines = []
        for k, (label, weight, curves) in enumerate(zip(one.labels, one.weights, one.single, strict=True)):
            text = plain(f"{label} (w = {weight:.2f})")
            lines += axes.plot(curves.offsets[axis], curves.scaled()[axis], color=SINGLE[k % 3], linewidth=1.2, label=text)
        for text, curves, dash in (("weighted", one.weighted, "-"), ("unweighted", one.unweighted, (0, (4, 2)))):
            lines += axes.plot(
                curves.offsets[axis], curves.scaled()[axis], color=OUR_COLOR, linewidth=2.4, linestyle=dash, label=text
            )
        handles = handles or lines
    legend(made, handles, columns=3)
    caption = (
        f"{one.method} on {one.scene}. Thin: single frames; thick: their averages. Every curve is scaled to 0..1. "
        f"Weights: {one.classes}."
    )
    return finished(made, name, f"Weighted and unweighted averages, {one.scene}", caption)


def heat_maps(name: str, label: str, maps: Mapping[str, Sequence[HeatMap]]) -> Plot:
    """Method -> its maps: a row of planes, rotations first."""
    made = empty_figure(7.6, 0.3 + 3.05 * len(maps))
    made.set_layout_engine("compressed")  # panels keep their shape and move together
    grid = made.subplots(len(maps), 2, squeeze=False)
    shown: Any = None
    for row, (method, own) in zip(grid, maps.items(), strict=True):
        for column, axes in enumerate(row):
            found = next((m for m in own if (max(m.axes) >= 3) == bool(column)), None)
            if found is None:
                axes.set_axis_off()
                continue
            shown = _heat_map(axes, found)
            unit = "cm" if column else "deg"
            axes.set(xlabel=f"${AXES[found.axes[0]]}$, {unit}", ylabel=f"${AXES[found.axes[1]]}$, {unit}", aspect="equal")
            axes.set_title(plain(method), fontsize=11)
    if shown is not None:
        bar = made.colorbar(shown, ax=grid, location="right", aspect=40, shrink=min(2 / len(maps), 1), ticks=[0, 0.5, 1])
        bar.set_label("score, each map scaled to 0..1")
    caption = f"{label}. White cross: the reference; black dot: the highest score."
    return finished(made, name, f"Heat maps, {label}", caption, wide=False)


def _heat_map(axes: Any, found: HeatMap) -> Any:
    values = np.asarray(found.values, float)
    finite = np.isfinite(values)
    low, high = (values[finite].min(), values[finite].max()) if finite.any() else (0.0, 1.0)
    scaled = (values - low) / max(high - low, 1e-12)
    mesh = axes.pcolormesh(found.x, found.y, scaled, shading="nearest", cmap="viridis", vmin=0, vmax=1, rasterized=True)
    for width, color in ((5, "black"), (2, "white")):
        axes.plot(0, 0, "+", color=color, markersize=14 if width == 2 else 16, markeredgewidth=width)
    if finite.any():
        y, x = np.unravel_index(np.nanargmax(values), values.shape)
        axes.plot(found.x[x], found.y[y], "o", color="black", markeredgecolor="white", markersize=7, clip_on=False)
    return mesh


# Plots of a drive's frames (figures 3.22, 3.23, algorithm 6), and of cost.
Matrix = NDArray[np.float64]
MOST_NUMBERS = 16  # frames; more figures could not be read
COLUMNS = 4  # histograms side by side
BGR = {"blue": "#0072b2", "green": "#009e73", "red": "#d55e00"}


def histograms(name: str, one: Similarity) -> Plot:
    """Figure 3.22: brightness of a few frames, per channel."""
    shown = list(one.histograms.items())
    rows, columns = math.ceil(len(shown) / COLUMNS), min(len(shown), COLUMNS)
    made = empty_figure(13 if columns > 1 else 6.5, 0.8 + 2.7 * rows)
    grid = made.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    # A few saturated levels may stand out of the picture; else they would flatten all others.
    top = 130 * max(float(np.sort(share, axis=1)[:, -3].max()) for _, share in shown)
    for axes, (frame, shares) in zip(grid, shown, strict=False):
        x = np.linspace(0, 255, shares.shape[1])
        channels = BGR if len(shares) == 3 else {"grey": "0.3"}
        for share, (label, color) in zip(shares, channels.items(), strict=True):
            axes.fill_between(x, 100 * share, color=color, alpha=0.12, linewidth=0)
            axes.plot(x, 100 * share, color=color, linewidth=1.5, label=label)
        axes.set(title=plain(frame), xlim=(0, 255), ylim=(0, max(top, 1.0)), xticks=[0, 64, 128, 192, 255])
        axes.grid(color="0.92")
    for axes in grid[len(shown) :]:
        axes.set_axis_off()
    for axes in grid[::columns]:
        axes.set_ylabel("pixels, %")
    legend(made, grid[0].get_lines())
    made.supxlabel("brightness", fontsize=10)
    return finished(made, name, f"Histograms, {one.scene}", "Share of pixels per four levels of brightness, by channel.")


def matrix(name: str, one: Similarity) -> Plot:
    """Figure 3.23: similarity of every frame with every other."""
    n = len(one.names)
    made = empty_figure(6.8, 6)
    axes = made.add_subplot()
    # Similarities of one drive fill the upper part only: the scale begins below the lowest.
    low = math.floor(10 * float(np.min(one.matrix))) / 10
    shown = axes.imshow(one.matrix, cmap="viridis", vmin=low, vmax=1)
    if n <= MOST_NUMBERS:
        for (y, x), value in np.ndenumerate(one.matrix):
            dark = value < low + 0.6 * (1 - low)
            axes.text(
                x, y, f"{value:.2f}", ha="center", va="center", fontsize=8 if n > 10 else 9, color="white" if dark else "black"
            )
        names = [name if len(name) <= 12 else f"…{name[-11:]}" for name in one.names]
        axes.set_xticks(range(n), map(plain, names), rotation=60, ha="right", fontsize=8)
        axes.set_yticks(range(n), map(plain, names), fontsize=8)
    else:
        axes.set(xlabel="position of the frame", ylabel="position of the frame")
    made.colorbar(shown, ax=axes, shrink=0.85, label="similarity ρ, 1 = the same")
    caption = f"ρ of eq. 3.15, mean of the channels. The scale begins at {low:.1f}."
    return finished(made, name, f"Histogram similarity, {one.scene}", caption, wide=False)


def keyframes(name: str, one: Similarity) -> Plot:
    """Similarity to the last keyframe over the drive, for each rule by which keyframes are selected."""
    rules = {f"algorithm 6, threshold {th:g}": (th, chosen) for th, chosen in one.keyframes.items()}
    rules["the node"] = (one.online_threshold, one.online)
    made = empty_figure(7.6, 0.6 + 1.9 * len(rules))
    grid = made.subplots(len(rules), 1, squeeze=False, sharex=True, sharey=True).ravel()
    for axes, (rule, (threshold, chosen)) in zip(grid, rules.items(), strict=True):
        rho = to_last_keyframe(one.matrix, chosen)
        at = np.array(chosen, int)
        axes.plot(one.stamps, rho, color=OUR_COLOR, linewidth=1.4, marker=".", markersize=4)
        axes.axhline(threshold, color="0.4", linewidth=1, linestyle="--")
        axes.plot(one.stamps[at], rho[at], "D", color=BAD, markersize=6, clip_on=False, zorder=4)
        axes.set_title(plain(f"{rule}: {len(chosen)} of {len(one.names)} frames"), fontsize=10)
        axes.set_ylabel("ρ")
        axes.grid(color="0.92")
    grid[-1].set_xlabel("time, s")
    caption = "Similarity of each frame to the keyframe before it. Diamonds: keyframes; dashed: the threshold."
    return finished(made, name, f"Keyframes over the drive, {one.scene}", caption, wide=False)


def to_last_keyframe(matrix: Matrix, chosen: Sequence[int]) -> Matrix:
    """(n,) similarity of each frame to the last keyframe before it, 1 for the first; matrix: (n, n)."""
    n = len(matrix)
    before = np.searchsorted(np.asarray(chosen, int), np.arange(n), side="left") - 1
    last = np.array([0, *chosen], int)[before + 1]
    return np.asarray(matrix[last, np.arange(n)])


def cost(name: str, panels: dict[str, dict[str, float]], looks: dict[str, Style]) -> Plot:
    """Panel -> method -> figure, as horizontal bars on a logarithmic axis."""
    most = max(len(values) for values in panels.values())
    made = empty_figure(13, 1.3 + 0.36 * most)
    grid = made.subplots(1, len(panels), squeeze=False).ravel()
    for axes, (title, values) in zip(grid, panels.items(), strict=True):
        shown = {method: value for method, value in values.items() if math.isfinite(value) and value > 0}
        for k, (method, value) in enumerate(shown.items()):
            axes.barh(k, value, color=looks[method].color, height=0.65)
            axes.text(value, k, f" {value:.3g}", va="center", ha="left", fontsize=9)
        axes.set_yticks(range(len(shown)), [plain(method) for method in shown])
        axes.set_xscale("log")
        if shown:
            # Room for the shortest bar and, at the right, for the figure beside the longest.
            low, high = min(shown.values()), max(shown.values())
            axes.set_xlim(low / 4, high * max(4.0, (high / low) ** 0.35))
        axes.invert_yaxis()
        axes.set_title(title, fontsize=10)
        axes.spines[["top", "right"]].set_visible(False)
    caption = "Logarithmic axes: compare the figures, not the lengths."
    return finished(made, name, "Cost of the methods", caption)


# Plots of trials.
LIMITS = (SUCCESS_DEG, 100 * SUCCESS_M)  # deg, cm
DODGE = 0.62  # of the narrowest gap between two positions, shared by the methods that stand side by side


def boxes(name: str, trials: Mapping[str, Sequence[Trial]], looks: Mapping[str, Style]) -> Plot:
    """Errors per axis as figures 4.14 and 4.15 have them; what lies outside the drawn range is counted. Each method needs a trial
    with a finite end."""
    made = empty_figure(13, 7.2)
    own = {method: axis_errors(found) for method, found in trials.items()}
    for axis, label in enumerate(AXES):
        axes = made.add_subplot(2, 3, axis + 1)
        columns = [E[:, axis] for E in own.values()]
        half = _half_range(columns, LIMITS[axis // 3])
        drawn = axes.boxplot(columns, patch_artist=True, widths=0.6, flierprops={"marker": ".", "markersize": 4, "alpha": 0.5})
        for part, median, method in zip(drawn["boxes"], drawn["medians"], own, strict=True):
            part.set(facecolor=looks[method].color, alpha=0.75, linewidth=1.6 if method == OURS else 0.9)
            median.set(color="black", linewidth=1.6)
        for k, values in enumerate(columns, start=1):
            outside = int((np.abs(values) > half).sum())
            if outside:
                axes.text(k, 0.96 * half, f"{outside} out", ha="center", va="top", fontsize=8, color="0.25", bbox=_PAPER)
        axes.axhspan(-LIMITS[axis // 3], LIMITS[axis // 3], color="0.93", zorder=0)
        axes.axhline(0, color="0.6", linewidth=1, zorder=0.5)
        axes.set(title=f"${label}$", ylim=(-half, half), ylabel="error, deg" if axis < 3 else "error, cm")
        axes.set_xticks(range(1, len(own) + 1), [plain(method) for method in own], rotation=30, ha="right")
    caption = (
        "Signed error at the end of all trials. Box: quartiles, line: median, whiskers: up to 1.5 box lengths, dots: trials "
        "beyond. "
        '"out": so many trials lie outside the drawn range. Grey band: the limit of success.'
    )
    return finished(made, name, "Errors of single frames per axis", caption)


_PAPER = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 1}


def _half_range(columns: Sequence[Matrix], limit: float) -> float:
    """Half the drawn range: where the whiskers of half of the methods end, so that one that is far off does not flatten all the
    others; at least twice the limit of success."""
    ends = []
    for values in columns:
        low, high = np.quantile(values, [0.25, 0.75])
        inside = values[(values >= low - 1.5 * (high - low)) & (values <= high + 1.5 * (high - low))]
        ends.append(float(np.abs(inside).max()))
    return max(1.15 * float(np.median(ends)), 2 * limit)


def starts(name: str, trials: Mapping[str, Sequence[Trial]], looks: Mapping[str, Style]) -> Plot:
    """Success against the size of the start error."""
    made = empty_figure(13, 5.2)
    axes = made.add_subplot()
    sizes = start_sizes(t for own in trials.values() for t in own)
    places, note = _places([deg for deg, _ in sizes])
    for place, (method, own) in zip(_dodged(places, len(trials)), trials.items(), strict=True):
        found = [[t.success for t in own if (t.start_deg, t.start_m) == size] for size in sizes]
        kept = [k for k, good in enumerate(found) if good]
        share = np.array([np.mean(found[k]) for k in kept])
        ends = np.array([wilson(sum(found[k]), len(found[k])) for k in kept]).reshape(-1, 2)
        _with_bars(axes, place[kept], 100 * share, 100 * ends.T, looks[method])
    axes.set_xticks(places, [f"±{deg:g} deg\n±{100 * m:g} cm" for deg, m in sizes])
    axes.set(xlabel=f"start error per axis{note}", ylabel="success, %", ylim=(-3, 103), yticks=range(0, 101, 20))
    axes.grid(axis="y", color="0.9")
    method_legend(made, {method: looks[method] for method in trials}, markers=True)
    caption = "Bars: 95 % intervals (Wilson). Methods stand side by side only so that their bars can be seen."
    return finished(made, name, "Success by size of the start error", caption)


def frames(name: str, trials: Mapping[str, Sequence[Trial]], looks: Mapping[str, Style]) -> Plot:
    """Errors against the number of frames."""
    made = empty_figure(13, 5.2)
    numbers = sorted({len(t.frames) for own in trials.values() for t in own})
    places, note = _places(numbers)
    for k, (label, limit) in enumerate(zip(("rotation error, deg", "translation error, cm"), LIMITS, strict=True)):
        axes = made.add_subplot(1, 2, k + 1)
        drawn = []
        for place, (method, own) in zip(_dodged(places, len(trials)), trials.items(), strict=True):
            groups = [errors([t for t in own if len(t.frames) == n])[k] for n in numbers]
            found = np.array([[quantile(g, share) for share in (0.25, 0.5, 0.75)] for g in groups])
            kept = np.isfinite(found[:, 1])
            drawn.append(found)
            # A quartile of infinity, more than a quarter without an end, is drawn beyond the axis.
            _with_bars(axes, place[kept], found[kept, 1], np.nan_to_num(found[kept][:, [0, 2]].T, posinf=1e6), looks[method])
        axes.axhline(limit, color="0.5", linewidth=1, linestyle=(0, (2, 3)), zorder=1)
        axes.set_yscale("log")
        decimal(axes.yaxis)
        axes.set_ylim(*_seen(drawn, limit))
        axes.set_xticks(places, [str(n) for n in numbers])
        axes.set(xlabel=f"frames{note}", ylabel=f"{label} (logarithmic)")
        axes.grid(axis="y", color="0.9")
    method_legend(made, {method: looks[method] for method in trials}, markers=True)
    caption = "Median over all trials, bars from quartile to quartile; dotted: the limit of success."
    return finished(made, name, "Errors by number of frames", caption)


def _with_bars(axes: Any, x: Matrix, y: Matrix, ends: Matrix, look: Style) -> None:
    """Line through (x, y), bars between ends (2, n)."""
    off = np.maximum(np.stack([y - ends[0], ends[1] - y]), 0)
    axes.errorbar(x, y, off, marker=look.marker, markersize=6, elinewidth=1, capsize=2.5, **look.line)


def _places(values: Sequence[float]) -> tuple[Matrix, str]:
    """Where values stand on the axis, and what its label says of it: logarithmic where they allow it."""
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


# How methods get nearer with time (their own best so far), trial by trial.
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
