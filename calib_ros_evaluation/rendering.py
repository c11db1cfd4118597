"""What the report and the page of the steps share: the figures of matplotlib."""

from __future__ import annotations

from typing import Any

from calib_ros.errors import MissingDependencyError
from calib_ros_evaluation.curves import AXES

DPI = 110
COLORS = ("#0072b2", "#d55e00", "#009e73")  # Okabe and Ito: distinct for colour-blind eyes too


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


def six_axes(figure: Any, ylabel: str = "") -> list[Any]:
    """Axes of figures 4.7, 4.10, 4.13 and 4.16 for scaled scores: rotations above, translations below."""
    out = []
    for axis, name in enumerate(AXES):
        axes = figure.add_subplot(2, 3, axis + 1)
        axes.axvline(0, color="0.6", linewidth=1)
        axes.set(title=f"${name}$", xlabel=f"offset, {'deg' if axis < 3 else 'cm'}", ylim=(-0.03, 1.08), yticks=[0, 0.5, 1])
        axes.set_ylabel(ylabel if axis % 3 == 0 else "")
        axes.margins(x=0)
        axes.grid(color="0.9")
        out.append(axes)
    return out
