"""A step and the frame that all steps show; colour scales, dots, tiles and plots that their pictures are made of."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib_ros import se3
from calib_ros.config import Config
from calib_ros.frame import Frame
from calib_ros.image.enhance import prepare, to_gray
from calib_ros.overlay import BAR, put, text_width
from calib_ros.registration.classes import OF_CLASSES, OF_MASKS, FrameSemantics
from calib_ros.registration.features import FeatureExtractor
from calib_ros_evaluation.curves import COLORS, Curves, above, draw_curves, empty_figure, pixels
from calib_ros_semantics.class_pictures import BACKGROUND, sizes
from calib_ros_thesis.config import thesis_of
from calib_ros_thesis.features import ThesisFeatures, semantic_share
from calib_ros_thesis.image import blend, gradient_edges
from calib_ros_thesis.score import registration_maps

Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Matrix = NDArray[np.float64]
WRONG_DEG, WRONG_M = 1.5, 0.15  # how far the deliberately wrong extrinsic is off
SEMANTIC_EDGES = {OF_MASKS: "boundaries of masks", OF_CLASSES: "borders of classes"}
DOT = 3  # px at 1242 px image width
OUTLINE = 4.0  # px; leaves and gravel are finer


@dataclass(frozen=True, eq=False)
class Step:
    """section: its heading's number in the thesis. caption: what it is and what to look for.

    picture: (h, w[, 3]) BGR or grey. table: rows of text, the first one the heads. Either, both or none. wide: it takes a
    whole row of the page.
    """

    section: str
    name: str
    caption: str
    picture: Image | None = None
    table: tuple[tuple[str, ...], ...] = ()
    wide: bool = False


class RegisteredFrame:
    """A frame as the registration sees it. source: as recorded. frame: rectified, at working size. gray, prepared: its image
    (h, w), and as the edge operators get it.

    T: T_camera_lidar (4, 4) of the pictures. wrong: T turned and moved to the side, both the same way in the picture. thesis:
    what eq. 3.12 keeps of the frame. maps: of eq. 3.12 at T, at the last smoothing. semantics: of the source, None without
    models. semantic: its edges (2, h, w) in 0..1 at working size, to 1/255; semantic_edges: what they are called; semantic_share:
    theirs in E^I. unsmoothed: E^I (h, w) before its smoothing, gradient edges with semantic ones where there are any (figure
    3.10).

    Raises TooFewFeaturesError if the scan is empty.
    """

    def __init__(self, source: Frame, T: Matrix, config: Config, semantics: FrameSemantics | None = None) -> None:
        self.source, self.T, self.config, self.semantics = source, T, config, semantics
        thesis = thesis_of(config)
        # The optimiser goes back to auto: pictures need none, and not every one goes with the thesis's objective.
        refine = dataclasses.replace(config.refine, objective="thesis", optimizer="auto")
        extract = FeatureExtractor(source.camera, dataclasses.replace(config, refine=refine))
        self.features = extract(source, semantics)
        self.thesis: ThesisFeatures = self.features.own
        image = extract.working_image(source.image)
        self.frame = dataclasses.replace(source, image=image, camera=extract.camera, classes=None)
        self.gray, self.prepared = to_gray(image), prepare(image)
        self.wrong = np.asarray(se3.exp([0, np.deg2rad(WRONG_DEG), 0, 0, 0, 0]) @ se3.exp([0, 0, 0, WRONG_M, 0, 0]) @ T)
        self.maps = registration_maps(self.thesis, T, thesis)
        self.semantic, self.semantic_edges, strength = None, "no semantic edges", None
        edges_of = OF_MASKS if semantics is None else semantics.edges_of
        if semantics is not None and semantics.edges is not None:
            levels = np.asarray(np.rint(255 * semantics.edges), np.uint8)
            self.semantic = np.stack([extract.working_image(part) for part in levels]) / np.float32(255)
            self.semantic_edges = SEMANTIC_EDGES[edges_of]
            strength = np.asarray(np.minimum(self.semantic.sum(axis=0), 1), np.float32)
        self.semantic_share = semantic_share(thesis, edges_of)
        self.unsmoothed = blend(gradient_edges(self.prepared, thesis), strength, self.semantic_share)


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

    def over(self, image: Image, values: ArrayLike, shown: Mask) -> Image:
        """As dots, over an image (h, w[, 3])."""
        return self.below(over(image, enlarged(np.where(shown, self.levels(values), 0)), self.palette))

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


def _picture(figure: Any) -> Image:
    return np.ascontiguousarray(pixels(figure)[:, :, 2::-1])


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


def class_histogram(pixels: Mapping[str, int], main: Collection[str]) -> Image:
    """Name of a class -> its number of pixels, as bars on a logarithmic axis; those of `main` in another colour."""
    figure = empty_figure(13, 3.4)
    axes = figure.add_subplot()
    bars = axes.bar(list(pixels), list(pixels.values()), color=[COLORS[name in main] for name in pixels])
    axes.bar_label(bars, fmt="{:,.0f}")
    axes.set(ylabel="pixels", yscale="log", ylim=(1, 10 * max(*pixels.values(), 1)))
    return _picture(figure)


def loss_curves(all_curves: Mapping[str, Curves]) -> Image:
    """Name -> curves over the six axes, each from 0 to 1, with a dot at its peak."""
    figure, curves = empty_figure(13, 6.6), []
    for k, ((label, found), dash, color) in enumerate(zip(all_curves.items(), ("--", "-", "-"), COLORS, strict=False)):
        line = {"linestyle": dash, "color": color, "linewidth": 1.8, "label": label}
        curves.append((found, line, {"marker": "o", "color": color, "markersize": 7 - k}))
    above(figure, draw_curves(figure, curves), len(curves))
    return _picture(figure)
