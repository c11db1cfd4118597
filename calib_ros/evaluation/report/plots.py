"""What all plots of the report share: the figure, the file it becomes, and how a method looks."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib_ros.evaluation.report.selection import OURS
from calib_ros.evaluation.steps.plots import COLORS

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
