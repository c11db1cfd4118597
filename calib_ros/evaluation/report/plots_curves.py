"""Plots of scores around the reference."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from calib_ros.evaluation.curves import AXES, Curves
from calib_ros.evaluation.report.plots import OTHERS, OUR_COLOR, Plot, Style, finished, legend, method_legend, plain
from calib_ros.evaluation.results import Averaging, HeatMap
from calib_ros.evaluation.steps.plots import empty_figure

SINGLE = (OTHERS[0], OTHERS[2], "#9467bd")  # orange, green, purple, as figure 4.16 has them


def six_axes(made: Any) -> list[Any]:
    """Axes of figures 4.7, 4.10, 4.13 and 4.16: rotations above, translations below."""
    out = []
    for axis, name in enumerate(AXES):
        axes = made.add_subplot(2, 3, axis + 1)
        axes.axvline(0, color="0.6", linewidth=1)
        axes.set(title=f"${name}$", xlabel=f"offset, {'deg' if axis < 3 else 'cm'}", ylim=(-0.03, 1.08), yticks=[0, 0.5, 1])
        axes.set_ylabel("score, scaled" if axis % 3 == 0 else "")
        axes.margins(x=0)
        axes.grid(color="0.9")
        out.append(axes)
    return out


def loss_curves(name: str, title: str, caption: str, curves: Mapping[str, Curves], looks: Mapping[str, Style]) -> Plot:
    """Method -> curves, each from 0 to 1, with a mark at its peak."""
    made = empty_figure(13, 6.8)
    own = {method: looks[method] for method in curves}
    for axis, axes in enumerate(six_axes(made)):
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
    for axis, axes in enumerate(six_axes(made)):
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
