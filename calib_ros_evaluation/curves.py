"""Scores over the six axes around an extrinsic (thesis figures 4.7, 4.10, 4.13), and the figures that show them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.errors import MissingDependencyError
from calib_ros.registration.score.point_score import Score

Matrix = NDArray[np.float64]
FLAT = 1e-9  # of a score's size; less is rounding
AXES = ("r_x", "r_y", "r_z", "t_x", "t_y", "t_z")
DPI = 110
COLORS = ("#0072b2", "#d55e00", "#009e73")  # Okabe and Ito: distinct for colour-blind eyes too
Style = dict[str, Any]  # options of matplotlib for a line


@dataclass(frozen=True, eq=False)
class Curves:
    """offsets: (6, n) along each axis, deg for rotations and cm for translations. values: (6, n) scores there."""

    offsets: Matrix
    values: Matrix

    @property
    def peaks(self) -> Matrix:
        """Where each curve is highest (6,), deg and cm: by a parabola through the highest sample and its neighbours; NaN for one
        that is flat."""
        out = np.full(6, np.nan)
        for axis, (x, y) in enumerate(zip(self.offsets, self.values, strict=True)):
            if np.ptp(y) <= FLAT * max(float(np.abs(y).max()), 1.0):
                continue
            k = int(np.argmax(y))
            out[axis] = x[k]
            if 0 < k < len(x) - 1:
                before, here, after = y[k - 1 : k + 2]
                bend = before - 2 * here + after
                if bend < 0:
                    out[axis] += 0.5 * (before - after) / bend * (x[1] - x[0])
        return out

    def scaled(self) -> Matrix:
        """Values (6, n) with every curve from 0 to 1, to compare scores of different units."""
        low, high = self.values.min(axis=1, keepdims=True), self.values.max(axis=1, keepdims=True)
        return np.asarray((self.values - low) / np.maximum(high - low, 1e-12))


def curves(score: Score, T: Matrix, rotation_deg: float = 2.0, translation_m: float = 0.3, samples: int = 41) -> Curves:
    """Score along each axis of a left twist at T (4, 4), the others at rest, `samples` values over +- the half widths."""
    unit = np.linspace(-1, 1, samples)
    half = np.repeat([np.deg2rad(rotation_deg), translation_m], 3)
    values = [[score.value(se3.exp(x * h * axis) @ T) for x in unit] for h, axis in zip(half, np.eye(6), strict=True)]
    return Curves(np.repeat([rotation_deg, 100 * translation_m], 3)[:, None] * unit, np.array(values))


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
