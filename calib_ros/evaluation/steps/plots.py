"""Plots of the steps, as pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import MissingDependencyError
from calib_ros.evaluation.curves import AXES, Curves

Image = NDArray[np.uint8]
DPI = 110
COLORS = ("#0072b2", "#d55e00", "#009e73")  # Okabe and Ito: told apart by colour-blind eyes too


def empty_figure(width: float, height: float) -> Any:
    """Of width x height inches. Never pyplot, which keeps state of its own and asks for a display. MissingDependencyError without
    matplotlib."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingDependencyError(
            "the plots need matplotlib: pip install matplotlib, or apt install python3-matplotlib"
        ) from None
    figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def _picture(figure: Any) -> Image:
    figure.canvas.draw()
    return np.ascontiguousarray(np.asarray(figure.canvas.buffer_rgba(), np.uint8)[:, :, 2::-1])


def histograms(images: Mapping[str, Image]) -> Image:
    """Name -> grey image (h, w): histogram H of eq. 3.1 and distribution of eq. 3.2 and 3.3, side by side."""
    figure = empty_figure(13, 3.4)
    shares = {name: np.bincount(image.ravel(), minlength=256) / image.size for name, image in images.items()}
    # A few saturated levels may stand out of the picture; a covered lens has no others.
    top = max(1.1 * max(float(np.sort(share)[-4]) for share in shares.values()), 0.01)
    for k, (name, share) in enumerate(shares.items()):
        axes = figure.add_subplot(1, len(images), k + 1)
        axes.fill_between(np.arange(256), 100 * share, step="mid", color=COLORS[0], linewidth=0)
        axes.set(title=name, xlim=(0, 255), ylim=(0, 100 * top), xlabel="grey level", xticks=[0, 64, 128, 192, 255])
        axes.set_ylabel("pixels, %" if k == 0 else "")
        cumulated = axes.twinx()
        cumulated.plot(np.arange(256), np.cumsum(share), color=COLORS[1], linewidth=1.6)
        cumulated.set(ylim=(0, 1.02), yticks=[0, 0.5, 1] if k == len(images) - 1 else [])
        cumulated.set_ylabel("distribution" if k == len(images) - 1 else "", color=COLORS[1])
    return _picture(figure)


def loss_curves(all_curves: Mapping[str, Curves]) -> Image:
    """Name -> curves over the six axes, each from 0 to 1, with a dot at its peak."""
    figure = empty_figure(13, 6.6)
    lines: list[Any] = []
    for axis, name in enumerate(AXES):
        axes = figure.add_subplot(2, 3, axis + 1)
        axes.axvline(0, color="0.6", linewidth=1)
        for k, (label, curves) in enumerate(all_curves.items()):
            style: Sequence[str] = ("--", "-", "-")
            (line,) = axes.plot(
                curves.offsets[axis], curves.scaled()[axis], style[k], color=COLORS[k], linewidth=1.8, label=label
            )
            axes.plot(curves.peaks[axis], 1, "o", color=COLORS[k], markersize=7 - k)
            if axis == 0:
                lines.append(line)
        unit = "deg" if axis < 3 else "cm"
        axes.set(title=f"${name}$", xlabel=f"offset, {unit}", ylim=(-0.03, 1.08), yticks=[0, 0.5, 1])
        axes.margins(x=0)
        axes.grid(color="0.9")
    figure.legend(handles=lines, loc="outside upper center", ncols=len(lines), frameon=False, fontsize=11)
    return _picture(figure)
