"""What the report and the page of the steps share: the figures of matplotlib, and loss curves."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import MissingDependencyError
from calib_ros_evaluation.curves import AXES, Curves

DPI = 110
COLORS = ("#0072b2", "#d55e00", "#009e73")  # Okabe and Ito: distinct for colour-blind eyes too
Style = dict[str, Any]  # options of matplotlib for a line


def empty_figure(width: float, height: float) -> Any:
    """A matplotlib figure of width x height inches; not by pyplot, which keeps global state and needs a display.

    MissingDependencyError without matplotlib.
    """
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


def pixels(figure: Any) -> NDArray[np.uint8]:
    """The figure as RGBA (h, w, 4)."""
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba(), np.uint8)


def above(figure: Any, lines: Sequence[Any], columns: int) -> None:
    """A legend of lines above all axes."""
    figure.legend(handles=lines, loc="outside upper center", ncols=columns, frameon=False, fontsize=11)


def draw_curves(figure: Any, curves: Sequence[tuple[Curves, Style, Style]], ylabel: str = "") -> list[Any]:
    """Curves with the styles of their lines and of the marks at their peaks (empty = no mark) over the six axes of figures 4.7,
    4.10, 4.13 and 4.16, rotations above, each from 0 to 1; the lines of the last axes."""
    for axis, name in enumerate(AXES):
        axes = figure.add_subplot(2, 3, axis + 1)
        axes.axvline(0, color="0.6", linewidth=1)
        axes.set(title=f"${name}$", xlabel=f"offset, {'deg' if axis < 3 else 'cm'}", ylim=(-0.03, 1.08), yticks=[0, 0.5, 1])
        axes.set_ylabel(ylabel if axis % 3 == 0 else "")
        axes.margins(x=0)
        axes.grid(color="0.9")
        lines = []
        for found, line, mark in curves:
            lines += axes.plot(found.offsets[axis], found.scaled()[axis], **line)
            if mark and np.isfinite(found.values[axis]).all():
                axes.plot(found.peaks[axis], 1, linestyle="none", **mark)
    return lines
