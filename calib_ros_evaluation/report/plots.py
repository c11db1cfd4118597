"""Plots of the report: loss curves and their averages, similarity of frames, errors per axis, success, errors by frames."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.frame import SemanticClass
from calib_ros_evaluation.curves import AXES, Curves
from calib_ros_evaluation.rendering import COLORS, empty_figure, six_axes
from calib_ros_evaluation.report.statistics import OURS, axis_errors, errors, quantile, start_sizes, wilson
from calib_ros_evaluation.results import SUCCESS_DEG, SUCCESS_M, Averaging, Similarity, Trial

Matrix = NDArray[np.float64]
# Okabe and Ito: distinct for colour-blind eyes too. Their yellow cannot be seen on white, brown stands for it.
OUR_COLOR, BAD, GOOD = COLORS
OTHERS = ("#e69f00", "#56b4e9", GOOD, "#cc79a7", BAD, "#333333", "#8c510a")
DASHES: tuple[Any, ...] = ("--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 1)), (0, (7, 2)), (0, (3, 1, 1, 1)))
SCENES = (OTHERS[0], GOOD, "#9467bd")  # orange, green and purple, as figure 4.16 has them
CHANNELS = (OUR_COLOR, GOOD, BAD)  # blue, green, red
KEYFRAME_MARKS = ({"marker": "D", "color": BAD, "markersize": 8}, {"marker": "o", "color": "white", "markersize": 4})
MARKERS = ("s", "^", "D", "v", "P", "X", "*")
LONGEST = 70  # letters of a name in a plot
LIMITS = (SUCCESS_DEG, 100 * SUCCESS_M)  # deg, cm
DODGE = 0.62  # of the gap between two positions, shared by the methods that stand side by side
PAPER = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 1}  # behind text


@dataclass(frozen=True)
class Plot:
    """name: of its file, without suffix. png: the file. size: its width and height, px."""

    name: str
    title: str
    caption: str
    png: bytes
    size: tuple[int, int]


@dataclass(frozen=True)
class LineStyle:
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


def method_styles(names: Sequence[str]) -> dict[str, LineStyle]:
    """By the order of all methods, so that a method has one style in every plot; this project's own is thick and in front."""
    out, k = {}, 0
    for name in names:
        if name == OURS:
            out[name] = LineStyle(OUR_COLOR, "-", "o", 2.8, 5)
        else:
            out[name] = LineStyle(OTHERS[k % len(OTHERS)], DASHES[k % len(DASHES)], MARKERS[k % len(MARKERS)], 1.6, 3)
            k += 1
    return out


def finished(figure: Any, name: str, title: str, caption: str) -> Plot:
    """The figure as a file; the same figure gives the same bytes."""
    from PIL import Image  # comes with matplotlib, which writes its own files by it

    figure.canvas.draw()
    picture = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())).convert("RGB")
    stream = io.BytesIO()
    # 256 colours are enough to the eye, and the file is a third as large.
    picture.quantize(256, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE).save(stream, "PNG", optimize=True)
    return Plot(name, title, caption, stream.getvalue(), picture.size)


def plain(text: str) -> str:
    """A name as it is: without formulas, and not too long."""
    text = text if len(text) <= LONGEST else text[: LONGEST - 1] + "…"
    return text.replace("$", r"\$")


def method_legend(figure: Any, own: Mapping[str, LineStyle]) -> None:
    """Names, lines and marks of methods above all axes."""
    from matplotlib.lines import Line2D

    lines = [Line2D([], [], label=plain(name), marker=style.marker, markersize=6, **style.line) for name, style in own.items()]
    figure.legend(handles=lines, loc="outside upper center", ncols=min(len(lines), 8), frameon=False, fontsize=11)


def loss_curves(name: str, title: str, caption: str, curves: Mapping[str, Curves], styles: Mapping[str, LineStyle]) -> Plot:
    """Method -> curves, each from 0 to 1, with a mark at its peak."""
    figure = empty_figure(13, 6.8)
    own = {method: styles[method] for method in curves}
    for axis, axes in enumerate(six_axes(figure, "score, scaled")):
        for method, found in curves.items():
            style = own[method]
            axes.plot(found.offsets[axis], found.scaled()[axis], **style.line)
            if np.isfinite(found.values[axis]).all():
                axes.plot(found.peaks[axis], 1, style.marker, color=style.color, markersize=7, zorder=style.layer, clip_on=False)
    method_legend(figure, own)
    return finished(figure, name, title, caption)


def mean_curves(curves: Sequence[Curves]) -> Curves:
    """Mean of curves scaled to 0..1 each, at the first one's offsets; those without a finite score are left out."""
    kept = [c for c in curves if np.isfinite(c.values).all()] or list(curves[:1])
    offsets = kept[0].offsets
    values = [[np.interp(x, *pair) for x, *pair in zip(offsets, c.offsets, c.scaled(), strict=True)] for c in kept]
    return Curves(offsets, np.mean(values, axis=0))


def averaging(name: str, one: Averaging) -> Plot:
    """Three frames: their curves and averages (figure 4.16), and how many of their pixels are of each class (4.5, 4.8, 4.11)."""
    figure = empty_figure(13, 9.8)
    above, below = figure.subfigures(2, 1, height_ratios=(2.3, 1))
    places, bars = np.arange(len(SemanticClass)), below.add_subplot()
    lines = list[tuple[Curves, dict[str, Any]]]()
    for n, (k, color) in enumerate(zip(one.shown, SCENES, strict=True)):
        label = plain(f"{one.names[k]}, w = {one.weights[k]:.3f}")
        lines.append((one.single[k], {"color": color, "linewidth": 1.3, "label": label}))
        bars.bar(places + 0.27 * (n - 1), 100 * one.shares[k], 0.25, color=color)
    for label, weighted, dash in (("weighted average", True, "-"), ("unweighted average", False, DASHES[0])):
        style = {"color": OUR_COLOR, "linewidth": 2.4, "linestyle": dash, "label": label}
        lines.append((one.average(one.shown, weighted), style))
    for axis, axes in enumerate(six_axes(above, "score, scaled")):
        for found, style in lines:
            axes.plot(found.offsets[axis], found.scaled()[axis], **style)
    above.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=5, frameon=False, fontsize=11)
    bars.set_xticks(places, [own.name.lower() for own in SemanticClass])
    bars.set(title="classes", ylabel="pixels, %")
    caption = f"w: share of main classes among pixels with a class, {one.classes_of}. Every curve is scaled to 0..1."
    return finished(figure, name, f"Weighted and unweighted averages: {one.method}, {one.scene}", caption)


def similarity(name: str, one: Similarity) -> Plot:
    """Figures 3.23 and 3.22: similarity of every frame with every other, keyframes, and histograms of some frames."""
    figure = empty_figure(13, 5.2)
    grid = figure.add_gridspec(2, 4)
    axes = figure.add_subplot(grid[:, :2])
    figure.colorbar(axes.imshow(one.matrix, cmap="viridis", vmax=1), ax=axes, label="similarity ρ, 1 = the same")
    for (threshold, chosen), style in zip(one.keyframes.items(), KEYFRAME_MARKS, strict=False):
        label = f"{len(chosen)} keyframes, threshold {threshold:g}"
        axes.plot(chosen, chosen, linestyle="none", markeredgecolor="black", clip_on=False, label=label, **style)
    ticks = np.linspace(0, len(one.frames) - 1, min(len(one.frames), 8), dtype=int)
    texts = [str(one.frames[k]) for k in ticks]
    axes.set(xlabel="frame", ylabel="frame", xticks=ticks, yticks=ticks, xticklabels=texts, yticklabels=texts)
    axes.legend(loc="lower left", fontsize=10)
    for k, (position, shares) in enumerate(one.histograms.items()):
        axes = figure.add_subplot(grid[k // 2, 2 + k % 2])
        for share, color in zip(shares, CHANNELS if len(shares) == len(CHANNELS) else ("0.3",), strict=True):
            axes.plot(np.linspace(0, 255, len(share)), 100 * share, color=color)
        # A few saturated levels may stand out of the picture; else they would flatten all others.
        top = max(130 * float(np.sort(shares, axis=1)[:, -3].max()), 1.0)
        axes.set(title=f"frame {position}", xlim=(0, 255), ylim=(0, top), xlabel="brightness", ylabel="pixels, %")
    caption = "Left: ρ of eq. 3.15, and keyframes of algorithm 6 on the diagonal. Right: pixels by brightness and channel."
    return finished(figure, name, f"Histogram similarity and keyframes, {one.scene}", caption)


def boxes(trials: Mapping[str, Sequence[Trial]], styles: Mapping[str, LineStyle]) -> Plot:
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
    return finished(figure, "single_boxes", "Errors of single frames per axis", caption)


def _half_range(columns: Sequence[Matrix], limit: float) -> float:
    """Half the drawn range: where the whiskers of half of the methods end, so that one that is far off does not flatten all the
    others; at least twice the limit of success."""
    ends = []
    for values in columns:
        low, high = np.quantile(values, [0.25, 0.75])
        inside = values[(values >= low - 1.5 * (high - low)) & (values <= high + 1.5 * (high - low))]
        ends.append(float(np.abs(inside).max()))
    return max(1.15 * float(np.median(ends)), 2 * limit)


def starts(trials: Mapping[str, Sequence[Trial]], styles: Mapping[str, LineStyle]) -> Plot:
    """Success against the size of the start error."""
    figure = empty_figure(13, 5.2)
    axes = figure.add_subplot()
    sizes = start_sizes(t for own in trials.values() for t in own)
    places = np.arange(len(sizes), dtype=float)
    for place, (method, own) in zip(_dodged(places, len(trials)), trials.items(), strict=True):
        found = [[t.success for t in own if (t.start_deg, t.start_m) == size] for size in sizes]
        kept = [k for k, good in enumerate(found) if good]
        share = np.array([np.mean(found[k]) for k in kept])
        ends = np.array([wilson(sum(found[k]), len(found[k])) for k in kept]).reshape(-1, 2)
        _with_bars(axes, place[kept], 100 * share, 100 * ends.T, styles[method])
    axes.set_xticks(places, [f"±{deg:g} deg\n±{100 * m:g} cm" for deg, m in sizes])
    axes.set(xlabel="start error per axis", ylabel="success, %", ylim=(-3, 103), yticks=range(0, 101, 20))
    axes.grid(axis="y", color="0.9")
    method_legend(figure, {method: styles[method] for method in trials})
    caption = "Bars: 95 % intervals (Wilson). Methods stand side by side only so that their bars can be seen."
    return finished(figure, "starts", "Success by size of the start error", caption)


def frames(trials: Mapping[str, Sequence[Trial]], styles: Mapping[str, LineStyle]) -> Plot:
    """Errors against the number of frames."""
    figure = empty_figure(13, 5.2)
    numbers = sorted({len(t.frames) for own in trials.values() for t in own})
    places = np.arange(len(numbers), dtype=float)
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
        axes.set(xlabel="frames", ylabel=f"{label} (logarithmic)")
        axes.grid(axis="y", color="0.9")
    method_legend(figure, {method: styles[method] for method in trials})
    caption = "Median over all trials, bars from quartile to quartile; dotted: the limit of success."
    return finished(figure, "frames", "Errors by number of frames", caption)


def _with_bars(axes: Any, x: Matrix, y: Matrix, ends: Matrix, style: LineStyle) -> None:
    """Line through (x, y), bars between ends (2, n)."""
    off = np.maximum(np.stack([y - ends[0], ends[1] - y]), 0)
    axes.errorbar(x, y, off, marker=style.marker, markersize=6, elinewidth=1, capsize=2.5, **style.line)


def _dodged(places: Matrix, n: int) -> list[Matrix]:
    """Places of n methods side by side."""
    return [places + DODGE * ((k + 0.5) / n - 0.5) for k in range(n)]


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
