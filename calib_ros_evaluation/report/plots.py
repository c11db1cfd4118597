"""Plots of the report: style of each method, plots of scores, drives and cost."""

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
from calib_ros_evaluation.report.statistics import OURS
from calib_ros_evaluation.results import Averaging, HeatMap, Similarity

Matrix = NDArray[np.float64]
# Okabe and Ito: distinct for colour-blind eyes too. Their yellow cannot be seen on white, brown stands for it.
OUR_COLOR, BAD, GOOD = COLORS
OTHERS = ("#e69f00", "#56b4e9", GOOD, "#cc79a7", BAD, "#333333", "#8c510a")
DASHES: tuple[Any, ...] = ("--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 1)), (0, (7, 2)), (0, (3, 1, 1, 1)))
MARKERS = ("s", "^", "D", "v", "P", "X", "*")
SINGLE = (OTHERS[0], OTHERS[2], "#9467bd")  # orange, green, purple, as figure 4.16 has them
MOST_NUMBERS = 16  # frames; more figures could not be read
COLUMNS = 4  # histograms side by side
BGR = {"blue": "#0072b2", "green": "#009e73", "red": "#d55e00"}
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


def finished(figure: Any, name: str, title: str, caption: str, wide: bool = True) -> Plot:
    """The figure as a file; the same figure gives the same bytes."""
    from PIL import Image  # comes with matplotlib, which writes its own files by it

    figure.canvas.draw()
    picture = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())).convert("RGB")
    stream = io.BytesIO()
    # 256 colours are enough to the eye, and the file is a third as large.
    picture.quantize(256, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE).save(stream, "PNG", optimize=True)
    return Plot(name, title, caption, stream.getvalue(), picture.size, wide)


def plain(text: str) -> str:
    """A name as it is: without formulas, and not too long."""
    text = text if len(text) <= LONGEST else text[: LONGEST - 1] + "…"
    return text.replace("$", r"\$")


def legend(figure: Any, handles: Iterable[Any], columns: int = 8) -> None:
    """Above all axes."""
    handles = list(handles)
    if handles:
        figure.legend(handles=handles, loc="outside upper center", ncols=min(len(handles), columns), frameon=False, fontsize=11)


def method_legend(figure: Any, own: dict[str, LineStyle], markers: bool = False) -> None:
    """Names and lines of methods above all axes."""
    from matplotlib.lines import Line2D

    lines = [
        Line2D([], [], label=plain(name), marker=style.marker if markers else "", markersize=6, **style.line)
        for name, style in own.items()
    ]
    legend(figure, lines)


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
    method_legend(figure, own, markers=True)
    return finished(figure, name, title, caption)


def mean_curves(curves: Sequence[Curves]) -> Curves:
    """Mean of curves scaled to 0..1 each, at the first one's offsets; those without a finite score are left out."""
    kept = [c for c in curves if np.isfinite(c.values).all()] or list(curves[:1])
    offsets = kept[0].offsets
    values = [[np.interp(x, *pair) for x, *pair in zip(offsets, c.offsets, c.scaled(), strict=True)] for c in kept]
    return Curves(offsets, np.mean(values, axis=0))


def averaging(name: str, one: Averaging) -> Plot:
    """Figure 4.16: thin lines are single frames."""
    figure = empty_figure(13, 6.8)
    handles: list[Any] = []
    for axis, axes in enumerate(six_axes(figure, "score, scaled")):
        lines = []
        for k, (label, weight, curves) in enumerate(zip(one.labels, one.weights, one.single, strict=True)):
            text = plain(f"{label} (w = {weight:.2f})")
            lines += axes.plot(curves.offsets[axis], curves.scaled()[axis], color=SINGLE[k % 3], linewidth=1.2, label=text)
        for text, curves, dash in (("weighted", one.weighted, "-"), ("unweighted", one.unweighted, (0, (4, 2)))):
            lines += axes.plot(
                curves.offsets[axis], curves.scaled()[axis], color=OUR_COLOR, linewidth=2.4, linestyle=dash, label=text
            )
        handles = handles or lines
    legend(figure, handles, columns=3)
    caption = (
        f"{one.method} on {one.scene}. Thin: single frames; thick: their averages. Every curve is scaled to 0..1. "
        f"Weights: {one.classes}."
    )
    return finished(figure, name, f"Weighted and unweighted averages, {one.scene}", caption)


def heat_maps(name: str, label: str, maps: Mapping[str, Sequence[HeatMap]]) -> Plot:
    """Method -> its maps: a row of planes, rotations first."""
    figure = empty_figure(7.6, 0.3 + 3.05 * len(maps))
    figure.set_layout_engine("compressed")  # panels keep their shape and move together
    grid = figure.subplots(len(maps), 2, squeeze=False)
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
        bar = figure.colorbar(shown, ax=grid, location="right", aspect=40, shrink=min(2 / len(maps), 1), ticks=[0, 0.5, 1])
        bar.set_label("score, each map scaled to 0..1")
    caption = f"{label}. White cross: the reference; black dot: the highest score."
    return finished(figure, name, f"Heat maps, {label}", caption, wide=False)


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


def histograms(name: str, one: Similarity) -> Plot:
    """Figure 3.22: brightness of a few frames, per channel."""
    shown = list(one.histograms.items())
    rows, columns = math.ceil(len(shown) / COLUMNS), min(len(shown), COLUMNS)
    figure = empty_figure(13 if columns > 1 else 6.5, 0.8 + 2.7 * rows)
    grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
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
    legend(figure, grid[0].get_lines())
    figure.supxlabel("brightness", fontsize=10)
    return finished(figure, name, f"Histograms, {one.scene}", "Share of pixels per four levels of brightness, by channel.")


def matrix(name: str, one: Similarity) -> Plot:
    """Figure 3.23: similarity of every frame with every other."""
    n = len(one.names)
    figure = empty_figure(6.8, 6)
    axes = figure.add_subplot()
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
    figure.colorbar(shown, ax=axes, shrink=0.85, label="similarity ρ, 1 = the same")
    caption = f"ρ of eq. 3.15, mean of the channels. The scale begins at {low:.1f}."
    return finished(figure, name, f"Histogram similarity, {one.scene}", caption, wide=False)


def keyframes(name: str, one: Similarity) -> Plot:
    """Similarity to the last keyframe over the drive, for each rule by which keyframes are selected."""
    rules = {f"algorithm 6, threshold {th:g}": (th, chosen) for th, chosen in one.keyframes.items()}
    rules["the node"] = (one.online_threshold, one.online)
    figure = empty_figure(7.6, 0.6 + 1.9 * len(rules))
    grid = figure.subplots(len(rules), 1, squeeze=False, sharex=True, sharey=True).ravel()
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
    return finished(figure, name, f"Keyframes over the drive, {one.scene}", caption, wide=False)


def to_last_keyframe(matrix: Matrix, chosen: Sequence[int]) -> Matrix:
    """(n,) similarity of each frame to the last keyframe before it, 1 for the first; matrix: (n, n)."""
    n = len(matrix)
    before = np.searchsorted(np.asarray(chosen, int), np.arange(n), side="left") - 1
    last = np.array([0, *chosen], int)[before + 1]
    return np.asarray(matrix[last, np.arange(n)])


def cost(name: str, panels: dict[str, dict[str, float]], styles: dict[str, LineStyle]) -> Plot:
    """Panel -> method -> figure, as horizontal bars on a logarithmic axis."""
    most = max(len(values) for values in panels.values())
    figure = empty_figure(13, 1.3 + 0.36 * most)
    grid = figure.subplots(1, len(panels), squeeze=False).ravel()
    for axes, (title, values) in zip(grid, panels.items(), strict=True):
        shown = {method: value for method, value in values.items() if math.isfinite(value) and value > 0}
        for k, (method, value) in enumerate(shown.items()):
            axes.barh(k, value, color=styles[method].color, height=0.65)
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
    return finished(figure, name, "Cost of the methods", caption)
