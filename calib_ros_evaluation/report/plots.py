"""Plots of the report: loss curves and their averages, similarity of frames, errors per axis, success, errors by frames."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calib_ros.frame import SemanticClass
from calib_ros_evaluation.curves import AXES, COLORS, Curves, Style, above, draw_curves, empty_figure, pixels
from calib_ros_evaluation.report.table import wilson
from calib_ros_evaluation.report.tables import OURS, axis_errors, groups, quantile
from calib_ros_evaluation.results import SUCCESS_DEG, SUCCESS_M, Averaging, Similarity

Matrix = NDArray[np.float64]
Styles = Mapping[str, Style]
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


def method_styles(names: Sequence[str]) -> dict[str, Style]:
    """By the order of all methods, so that a method has one style in every plot; this project's own is thick and in front."""
    others = cycle(zip(OTHERS, DASHES, MARKERS, strict=True))
    out = {name: (1.6, 3, *next(others)) for name in names if name != OURS}
    out |= {OURS: (2.8, 5, OUR_COLOR, "-", "o")} if OURS in names else {}
    return {name: dict(zip(("linewidth", "zorder", "color", "linestyle", "marker"), out[name], strict=True)) for name in names}


def finished(figure: Any, name: str, title: str, caption: str) -> Plot:
    """The figure as a file; the same figure gives the same bytes."""
    from PIL import Image  # comes with matplotlib, which writes its own files by it

    picture = Image.fromarray(pixels(figure)).convert("RGB")
    stream = io.BytesIO()
    # 256 colours are enough to the eye, and the file is a third as large.
    picture.quantize(256, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE).save(stream, "PNG", optimize=True)
    return Plot(name, title, caption, stream.getvalue(), picture.size)


def plain(text: str) -> str:
    """A name as it is: without formulas, and not too long."""
    text = text if len(text) <= LONGEST else text[: LONGEST - 1] + "…"
    return text.replace("$", r"\$")


def method_legend(figure: Any, methods: Mapping[str, Any], styles: Styles) -> None:
    """Names, lines and marks of methods above all axes."""
    from matplotlib.lines import Line2D

    lines = [Line2D([], [], label=plain(name), markersize=6, **styles[name]) for name in methods]
    above(figure, lines, min(len(lines), 8))


def loss_curves(name: str, title: str, caption: str, curves: Mapping[str, Curves], styles: Styles) -> Plot:
    """Method -> curves, each from 0 to 1, with a mark at its peak."""
    figure, lines = empty_figure(13, 6.8), []
    for method, found in curves.items():
        style = styles[method]
        mark = {key: style[key] for key in ("marker", "color", "zorder")} | {"markersize": 7, "clip_on": False}
        lines.append((found, style | {"marker": ""}, mark))
    draw_curves(figure, lines, "score, scaled")
    method_legend(figure, curves, styles)
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
    top, below = figure.subfigures(2, 1, height_ratios=(2.3, 1))
    places, bars = np.arange(len(SemanticClass)), below.add_subplot()
    curves = list[tuple[Curves, Style, Style]]()
    for n, (k, color) in enumerate(zip(one.shown, SCENES, strict=True)):
        label = plain(f"{one.names[k]}, w = {one.weights[k]:.3f}")
        curves.append((one.single[k], {"color": color, "linewidth": 1.3, "label": label}, {}))
        bars.bar(places + 0.27 * (n - 1), 100 * one.shares[k], 0.25, color=color)
    for label, weighted, dash in (("weighted average", True, "-"), ("unweighted average", False, DASHES[0])):
        style = {"color": OUR_COLOR, "linewidth": 2.4, "linestyle": dash, "label": label}
        curves.append((one.average(one.shown, weighted), style, {}))
    above(top, draw_curves(top, curves, "score, scaled"), 5)
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


def boxes(trials: Mapping[str, pd.DataFrame], styles: Styles) -> Plot:
    """Errors per axis as figures 4.14 and 4.15 have them; what lies outside the drawn range is counted. Each method needs a trial
    with a finite end."""
    figure = empty_figure(13, 7.2)
    own = {method: axis_errors(found) for method, found in trials.items()}
    for axis, label in enumerate(AXES):
        axes = figure.add_subplot(2, 3, axis + 1)
        columns = [E[:, axis] for E in own.values()]
        # To where the whiskers of half of the methods end, so that one that is far off does not flatten all the others.
        ends = []
        for values in columns:
            low, high = np.quantile(values, [0.25, 0.75])
            beyond = 1.5 * (high - low)
            ends.append(np.abs(values[(values >= low - beyond) & (values <= high + beyond)]).max())
        half = max(1.15 * float(np.median(ends)), 2 * LIMITS[axis // 3])
        drawn = axes.boxplot(columns, patch_artist=True, widths=0.6, flierprops={"marker": ".", "markersize": 4, "alpha": 0.5})
        for part, median, method in zip(drawn["boxes"], drawn["medians"], own, strict=True):
            part.set(facecolor=styles[method]["color"], alpha=0.75, linewidth=1.6 if method == OURS else 0.9)
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


def starts(trials: dict[str, pd.DataFrame], styles: Styles) -> Plot:
    """Success against the size of the start error."""
    figure = empty_figure(13, 5.2)
    axes = figure.add_subplot()
    sizes, by_size = groups(trials, "size")
    found = {
        method: [_share(own.success) if len(own) else (np.nan,) * 3 for own in groups.values()]
        for method, groups in by_size.items()
    }
    _side_by_side(axes, found, styles, [f"±{deg:g} deg\n±{100 * m:g} cm" for deg, m in sizes])
    axes.set(xlabel="start error per axis", ylabel="success, %", ylim=(-3, 103), yticks=range(0, 101, 20))
    method_legend(figure, trials, styles)
    caption = "Bars: 95 % intervals (Wilson). Methods stand side by side only so that their bars can be seen."
    return finished(figure, "starts", "Success by size of the start error", caption)


def _share(success: pd.Series) -> tuple[float, float, float]:
    """In %, between the ends of its interval."""
    low, high = wilson(success.sum(), len(success))
    return 100 * low, 100 * success.mean(), 100 * high


def frames(trials: dict[str, pd.DataFrame], styles: Styles) -> Plot:
    """Errors against the number of frames."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    figure = empty_figure(13, 5.2)
    numbers, by_number = groups(trials, "n")
    labels = {"rotation_deg": "rotation error, deg", "cm": "translation error, cm"}
    for k, (column, limit) in enumerate(zip(labels, LIMITS, strict=True)):
        axes = figure.add_subplot(1, 2, k + 1)
        found = {
            method: [[quantile(own[column], share) for share in (0.25, 0.5, 0.75)] for own in groups.values()]
            for method, groups in by_number.items()
        }
        axes.axhline(limit, color="0.5", linewidth=1, linestyle=(0, (2, 3)), zorder=1)
        _side_by_side(axes, found, styles, [str(n) for n in numbers])
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5), numticks=30))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
        shown = np.concatenate([[limit], *(np.ravel(values) for values in found.values())])
        shown = shown[np.isfinite(shown) & (shown > 0)]
        axes.set_ylim(max(shown.min() / 1.3, 1e-4), 1.3 * shown.max())
        axes.set(xlabel="frames", ylabel=f"{labels[column]} (logarithmic)")
    method_legend(figure, trials, styles)
    caption = "Median over all trials, bars from quartile to quartile; dotted: the limit of success."
    return finished(figure, "frames", "Errors by number of frames", caption)


def _side_by_side(axes: Any, found: Mapping[str, Sequence[Sequence[float]]], styles: Styles, labels: Sequence[str]) -> None:
    """A line for each method through its middle values, bars from the low to the high ones: (low, middle, high) for every label,
    NaN where there is none."""
    places = np.arange(len(labels), dtype=float)
    for k, (method, own) in enumerate(found.items()):
        # A quartile of infinity, more than a quarter without an end, is drawn beyond the axis.
        low, y, high = np.nan_to_num(np.array(own), nan=np.nan, posinf=1e6).T
        kept = np.isfinite(np.array(own)[:, 1])
        off = np.maximum(np.stack([y - low, high - y]), 0)[:, kept]
        place = places + DODGE * ((k + 0.5) / len(found) - 0.5)
        axes.errorbar(place[kept], y[kept], off, markersize=6, elinewidth=1, capsize=2.5, **styles[method])
    axes.set_xticks(places, labels)
    axes.grid(axis="y", color="0.9")
