"""Plots of a drive's frames (figures 3.22, 3.23, algorithm 6), and of cost."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calib_ros.evaluation.report.plots import BAD, OUR_COLOR, Plot, Style, finished, legend, plain
from calib_ros.evaluation.results import Similarity
from calib_ros.evaluation.steps.plots import empty_figure

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
