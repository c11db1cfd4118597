"""Numbers as colours: scales with a bar that tells them, dots, tiles and labels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib_ros.image.enhance import to_gray
from calib_ros.overlay_bars import BAR, put, text_width

Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]
BACKGROUND = 24  # grey level where nothing was measured
DOT = 3  # px at 1242 px image width
OUTLINE = 4.0  # px; leaves and gravel are finer


def _ramp(colormap: int, low: int, high: int) -> Image:
    """Level -> BGR (256, 3) of a part of an OpenCV colour map; level 0 is the background."""
    colors = np.array(cv2.applyColorMap(np.linspace(low, high, 256).astype(np.uint8)[:, None], colormap), np.uint8)[:, 0]
    colors[0] = BACKGROUND
    return colors


def _names() -> Image:
    """Label -> BGR (256, 3): hues a golden angle apart, so that clusters of neighbouring numbers differ."""
    k = np.arange(256)
    hsv = np.stack([k * 0.618034 % 1 * 180, 150 + 35 * (k % 4), 255 - 45 * (k // 4 % 3)], axis=1).astype(np.uint8)
    colors = np.array(cv2.cvtColor(hsv[:, None], cv2.COLOR_HSV2BGR), np.uint8)[:, 0]
    colors[0] = BACKGROUND
    return colors


# Perceptual maps without their dark ends, so that the least value differs from the background.
VIRIDIS, PLASMA, INFERNO = (
    _ramp(colormap, low, 255)
    for colormap, low in ((cv2.COLORMAP_VIRIDIS, 45), (cv2.COLORMAP_PLASMA, 30), (cv2.COLORMAP_INFERNO, 50))
)
GREYS = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)
NAMES = _names()
HIDDEN = (70, 70, 70)  # BGR of points that a filter took away


@dataclass(frozen=True, eq=False)
class Scale:
    """Which number has which colour. falling: the lowest number is the brightest and, where dots overlap, on top."""

    label: str
    low: float
    high: float
    palette: Image
    log: bool = False
    falling: bool = False

    def levels(self, values: ArrayLike) -> Image:
        """Numbers of any shape -> rows of the palette, 1 to 255."""
        v = np.clip(np.asarray(values, np.float64), self.low, self.high)
        low, high = self.low, self.high
        share = np.log(v / low) / math.log(high / low) if self.log else (v - low) / (high - low)
        return np.asarray(np.rint(1 + 254 * (1 - share if self.falling else share)), np.uint8)

    def dense(self, values: ArrayLike, shown: Mask | None = None) -> Image:
        """Map (h, w) -> picture (h', w, 3) with the scale below; background where not `shown`."""
        levels = self.levels(values)
        return self.below(self.palette[levels if shown is None else np.where(shown, levels, 0)])

    def dots(self, values: ArrayLike, shown: Mask) -> Image:
        """As dense, but what is shown are single pixels, drawn larger."""
        return self.below(self.palette[enlarged(np.where(shown, self.levels(values), 0))])

    def below(self, picture: Image) -> Image:
        """The picture with the scale's bar under it."""
        width = picture.shape[1]
        font, line, margin = sizes(width)
        bar = np.full((round(1.55 * line) + margin, width, 3), BAR, np.uint8)
        left, length = margin, round(0.6 * width)
        if self.log:
            steps = np.geomspace(self.low, self.high, length)
            ticks = [self.low, *(d for b in range(-3, 5) for a in (1, 2, 5) if self.low < (d := a * 10.0**b) < self.high)]
        else:
            steps = np.linspace(self.low, self.high, length)
            ticks = [self.low + (self.high - self.low) * k / 4 for k in range(4)]
        bar[margin : margin + line // 2, left : left + length] = self.palette[self.levels(steps)]
        free, base = left, margin + line // 2 + round(0.85 * line)
        end = left + length - text_width(f"{self.high:g}", font)
        put(bar, f"{self.high:g}", (end, base), font)
        for tick in ticks:
            x = left + int(np.searchsorted(steps, tick * (1 - 1e-9)))
            x -= text_width(f"{tick:g}", font) // 2 if x > left else 0
            if x >= free and x + text_width(f"{tick:g}", font) + margin < end:
                put(bar, f"{tick:g}", (x, base), font)
                free = x + text_width(f"{tick:g}", font) + margin
        put(bar, self.label, (left + length + 2 * margin, margin + round(0.6 * line)), font)
        return np.vstack([as_color(picture), bar])


def sizes(width: int) -> tuple[float, int, int]:
    """Font, height of a line and margin in px for a picture of this width, readable at half the size."""
    font = float(np.clip(width / 1500, 0.4, 1.6))
    return font, round(36 * font), max(round(9 * font), 3)


def as_color(picture: Image) -> Image:
    """Grey (h, w) or BGR (h, w, 3) -> BGR (h, w, 3)."""
    return picture if picture.ndim == 3 else np.asarray(cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR), np.uint8)


def enlarged(levels: ArrayLike) -> Image:
    """Dots of a level map (h, w), 0 = none, drawn larger; where they overlap the higher level is seen."""
    dots = np.asarray(levels, np.uint8)
    size = max(2, round(DOT * dots.shape[1] / 1242))
    return np.asarray(cv2.dilate(dots, np.ones((size, size), np.uint8)), np.uint8)


def over(image: Image, dots: Image, palette: Image) -> Image:
    """Dots (h, w) of levels, 0 = none, over the image, which is dimmed so that colours belong to the dots."""
    dimmed = as_color(np.asarray(0.45 * to_gray(image), np.uint8))
    return np.asarray(np.where((dots > 0)[..., None], palette[dots], dimmed), np.uint8)


def edge_picture(edges: NDArray[np.float32], label: str = "edge strength", high: float = 1.0) -> Image:
    """Edge map (h, w), white = strong, with its scale."""
    return Scale(label, 0, high, GREYS).dense(edges)


def tiles(pictures: Sequence[Image], names: Sequence[str], columns: int, width: int) -> Image:
    """Pictures of one shape (h, w[, 3]) side by side, magnified to `width` px together, each with its name above."""
    gap = 6
    h, w = pictures[0].shape[:2]
    tile = (width - gap * (columns - 1)) // columns
    size = (tile, round(tile * h / w))
    font, line, margin = sizes(width)
    cells = []
    for picture, name in zip(pictures, names, strict=True):
        title = np.full((line + margin, tile, 3), BAR, np.uint8)
        put(title, name, (margin, line - margin // 2), font)
        cells.append(np.vstack([title, cv2.resize(as_color(picture), size, interpolation=cv2.INTER_NEAREST)]))
    cells += [np.full_like(cells[0], BAR)] * (-len(cells) % columns)
    space = np.full((cells[0].shape[0], gap, 3), BAR, np.uint8)
    rows = []
    for k in range(0, len(cells), columns):
        row = [part for cell in cells[k : k + columns] for part in (space, cell)][1:]
        rows.append(np.hstack(row))
    return np.asarray(np.vstack(rows), np.uint8)


def outlines(gray: Image) -> NDArray[np.float32]:
    """How much of an outline every pixel of a grey image (h, w) has: slopes that stay when texture is blurred away."""
    soft = cv2.GaussianBlur(np.asarray(gray, np.float32), (0, 0), OUTLINE)
    return np.asarray(np.hypot(cv2.Sobel(soft, cv2.CV_32F, 1, 0), cv2.Sobel(soft, cv2.CV_32F, 0, 1)), np.float32)


def busiest(interest: NDArray[np.float32], height: int, width: int) -> tuple[slice, slice]:
    """The window of height x width px in which a map (h, w) sums up highest."""
    h, w = interest.shape
    height, width = min(height, h), min(width, w)
    total = cv2.integral(np.asarray(interest, np.float64))
    sums = total[height:, width:] - total[:-height, width:] - total[height:, :-width] + total[:-height, :-width]
    y, x = divmod(int(np.argmax(sums)), sums.shape[1])
    return slice(y, y + height), slice(x, x + width)
