"""What stands around the pictures of an overlay: where everything goes, the header, the depth scale.

Text has bars of its own, so it hides nothing of a picture; and as the bars follow from the image size alone, a stream of
overlays keeps one size whatever they say.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib_ros.result import CONVERGED, INSUFFICIENT, REFUSED

Image = NDArray[np.uint8]
Color = tuple[int, int, int]

# Status -> BGR of its badge; any other status ("initial") gets BADGE_OTHER. Text is white, on amber black.
BADGES: dict[str, Color] = {CONVERGED: (60, 130, 20), REFUSED: (45, 35, 200), INSUFFICIENT: (30, 170, 245)}
BADGE_OTHER, TEXT = (110, 110, 110), (240, 240, 240)
BAR = 30  # grey level behind text
EDGE = (255, 0, 255)  # magenta is not in the depth scale, nor in a grey picture
EDGE_LEVEL = 255
NEAR_SHARE = 0.05  # depths below this share of the largest have one colour; above, the scale is logarithmic
SCREEN = 16 / 9
GAP = 4  # px between panels side by side
FONT = cv2.FONT_HERSHEY_SIMPLEX


def _palette() -> Image:
    """Level -> BGR (256, 3). Turbo without its dark ends, warm = near = high; the last level is that of edges."""
    ramp = np.linspace(24, 236, 256).astype(np.uint8)
    colors = np.array(cv2.applyColorMap(ramp[:, None], cv2.COLORMAP_TURBO), np.uint8)[:, 0]
    colors[EDGE_LEVEL] = EDGE
    return colors


PALETTE = _palette()


def depth_levels(depth: ArrayLike, max_range: float) -> Image:
    """Depths (n,) in m -> rows of PALETTE (n,), from 254 (near) down to 1 (max_range)."""
    near = NEAR_SHARE * max_range
    share = np.log(np.maximum(depth, near) / near) / math.log(1 / NEAR_SHARE)
    return np.asarray(np.rint(254 - 253 * np.minimum(share, 1)), np.uint8)


@dataclass(frozen=True)
class Layout:
    """Where things go, px. size: (width, height) of all. panels: their left upper corners (x, y). rows: of the header."""

    size: tuple[int, int]
    panels: tuple[tuple[int, int], ...]
    font: float
    line: int
    rows: int

    @property
    def margin(self) -> int:
        """Distance of text from the border, px."""
        return self.line // 3


def layout(width: int, height: int, panels: int) -> Layout:
    """For one or two images of width x height px: two stand the way that fills a screen better, stacked when wide."""
    beside = panels == 2 and width < SCREEN * height
    canvas = 2 * width + GAP if beside else width
    font = float(np.clip(canvas / 2200, 0.4, 1.5))
    line = round(36 * font)
    rows = int(np.clip(math.ceil(2800 * font / canvas), 2, 5))  # room for all that a caption says
    top, title = rows * line + line // 2, line if panels == 2 else 0
    step = (width + GAP, 0) if beside else (0, height + title)
    corners = tuple((i * step[0], top + title + i * step[1]) for i in range(panels))
    return Layout((canvas, corners[-1][1] + height + 2 * line), corners, font, line, rows)


def text_width(text: str, font: float) -> int:
    """Width of a text in px."""
    return int(cv2.getTextSize(text, FONT, font, 1)[0][0])


def put(canvas: Image, text: str, at: tuple[int, int], font: float, color: Color = TEXT) -> None:
    """Write a text, its left end of the baseline at (x, y)."""
    cv2.putText(canvas, text, at, FONT, font, color, 1, cv2.LINE_AA)


def fitting(text: str, width: int, font: float, end: str = "...") -> str:
    """The text if it is at most `width` px wide, else as much of its beginning as fits with `end` after it."""
    if text_width(text[: max(width, 0) + 1], font) <= width:  # no letter is narrower than a pixel
        return text
    text = text[: max(width, 0)]
    while text and text_width(text + end, font) > width:
        text = text[:-1]
    return text + end if text else ""


def draw_header(canvas: Image, plan: Layout, status: str, lines: Sequence[str]) -> None:
    """Badge and lines, left to right and on to the next row; what goes beyond the last row ends in dots."""
    margin, y, font = plan.margin, plan.line, plan.font
    x, right, last = margin, plan.size[0] - margin, plan.line * plan.rows
    if status:
        text = fitting(status, right - 3 * margin, font)
        end, black = x + text_width(text, font) + 2 * margin, status == INSUFFICIENT
        canvas[y - round(0.7 * plan.line) : y + plan.line // 4, x:end] = BADGES.get(status, BADGE_OTHER)
        put(canvas, text, (x + margin, y), font, (0, 0, 0) if black else (255, 255, 255))
        x = end + 2 * margin
    for line in lines:
        rest = " ".join(line.splitlines())
        if x > margin and y < last and text_width(rest, font) > right - x:  # rather a whole row than the end of one
            x, y = margin, y + plan.line
        while y < last and text_width(rest, font) > right - x:
            cut = fitting(rest, right - x, font, "")
            cut = cut.rpartition(" ")[0] or cut
            put(canvas, cut, (x, y), font)
            rest, y = rest[len(cut) :].lstrip(), y + plan.line
        rest = fitting(rest, right - x, font)
        put(canvas, rest, (x, y), font)
        x += text_width(rest, font) + 3 * margin


def draw_legend(canvas: Image, plan: Layout, max_range: float, edges: bool) -> None:
    """Colour bar with metres, and what the magenta marks are, on the bar below the panels."""
    margin, length, font = plan.margin, max(plan.size[0] // 2 - plan.margin, 0), plan.font
    top, baseline, thick = plan.size[1] - 2 * plan.line + margin, plan.size[1] - margin, plan.line // 2
    near = NEAR_SHARE * max_range
    bar = np.geomspace(near, max_range, length)
    canvas[top : top + thick, margin : margin + length] = PALETTE[depth_levels(bar, max_range)]
    full = f"{max_range:g} m"
    free, end = margin, margin + length - text_width(full, font)
    put(canvas, full, (end, baseline), font)
    for depth in [near, *(d for b in range(-2, 5) for a in (1, 2, 5) if near < (d := a * 10.0**b) < max_range)]:
        text, share = f"{depth:g}", math.log(depth / near) / math.log(1 / NEAR_SHARE)
        width = text_width(text, font)
        x = margin + round(length * share) - (width // 2 if share else 0)
        if x >= free and x + width + margin < end:
            put(canvas, text, (x, baseline), font)
            free = x + width + margin
    if edges:
        x = 3 * margin + length
        canvas[top : top + thick, x : x + thick] = EDGE
        put(canvas, fitting("LiDAR edges", canvas.shape[1] - x - plan.line, font), (x + plan.line, top + thick), font)
