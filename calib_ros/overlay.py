"""The diagnostic picture: LiDAR points and edges over the image, to judge an extrinsic at a glance."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib_ros import se3
from calib_ros.arrays import Transform
from calib_ros.camera import MIN_DEPTH, Camera
from calib_ros.errors import BadInputError
from calib_ros.frame import Frame
from calib_ros.image.enhance import equalize, to_gray
from calib_ros.io import write_atomically
from calib_ros.lidar.edges import EdgePoints
from calib_ros.result import CONVERGED, INSUFFICIENT, REFUSED, TENTATIVE, Extrinsic

Image = NDArray[np.uint8]
Color = tuple[int, int, int]
Points = NDArray[np.float32]

# Status -> BGR of its badge; any other status ("initial") gets BADGE_OTHER. Text is white, on amber black.
BADGES: dict[str, Color] = {
    CONVERGED: (60, 130, 20),
    TENTATIVE: (150, 110, 20),
    REFUSED: (45, 35, 200),
    INSUFFICIENT: (30, 170, 245),
}
BADGE_OTHER, TEXT = (110, 110, 110), (240, 240, 240)
BAR = 30  # grey level behind text
EDGE = (255, 0, 255)  # magenta is not in the depth scale, nor in a grey picture
EDGE_LEVEL = 255
NEAR_SHARE = 0.05  # depths below this share of the largest have one colour; above, the scale is logarithmic
SCREEN = 16 / 9
GAP = 4  # px between panels side by side
NO_POINTS = "no LiDAR point falls into the image"
FONT = cv2.FONT_HERSHEY_SIMPLEX


# Colour table BGR (256, 3): turbo without its dark ends, warm = near = high level; the last level is that of edges.
_RAMP = np.linspace(24, 236, 256).astype(np.uint8)
PALETTE: Image = np.array(cv2.applyColorMap(_RAMP[:, None], cv2.COLORMAP_TURBO), np.uint8)[:, 0]
PALETTE[EDGE_LEVEL] = EDGE


def depth_levels(depth: ArrayLike, max_range: float) -> Image:
    """Depths (n,) in m -> rows of PALETTE (n,), from 254 (near) down to 1 (max_range)."""
    near = NEAR_SHARE * max_range
    share = np.log(np.maximum(depth, near) / near) / math.log(1 / NEAR_SHARE)
    return np.asarray(np.rint(254 - 253 * np.minimum(share, 1)), np.uint8)


@dataclass(frozen=True)
class OverlayLayout:
    """Layout in px. size: (width, height) of the whole. panels: upper left corners (x, y). margin: of text from
    the border. rows: of the header."""

    size: tuple[int, int]
    panels: tuple[tuple[int, int], ...]
    font: float
    line: int
    margin: int
    rows: int


def layout(width: int, height: int, panels: int) -> OverlayLayout:
    """Layout of one or two images of width x height px: side by side or stacked, whichever fills a screen better."""
    beside = panels == 2 and width < SCREEN * height
    canvas = 2 * width + GAP if beside else width
    font = float(np.clip(canvas / 2200, 0.4, 1.5))
    line = round(36 * font)
    rows = int(np.clip(math.ceil(2800 * font / canvas), 2, 5))  # room for a whole caption
    top, title = rows * line + line // 2, line if panels == 2 else 0
    step = (width + GAP, 0) if beside else (0, height + title)
    corners = tuple((i * step[0], top + title + i * step[1]) for i in range(panels))
    return OverlayLayout((canvas, corners[-1][1] + height + 2 * line), corners, font, line, line // 3, rows)


def text_width(text: str, font: float) -> int:
    """Width of a text in px."""
    return int(cv2.getTextSize(text, FONT, font, 1)[0][0])


def put(canvas: Image, text: str, at: tuple[int, int], font: float, color: Color = TEXT) -> None:
    """Write a text, its left end of the baseline at (x, y)."""
    cv2.putText(canvas, text, at, FONT, font, color, 1, cv2.LINE_AA)


def fitting(text: str, width: int, font: float, end: str = "...") -> str:
    """The text if it is at most `width` px wide, else the part that fits, with `end` after it."""
    if text_width(text[: max(width, 0) + 1], font) <= width:  # no letter is narrower than a pixel
        return text
    text = text[: max(width, 0)]
    while text and text_width(text + end, font) > width:
        text = text[:-1]
    return text + end if text else ""


def draw_header(canvas: Image, plan: OverlayLayout, status: str, lines: Sequence[str]) -> None:
    """Draw badge and lines, left to right, wrapped into rows; text beyond the last row is cut with an ellipsis."""
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
        if x > margin and y < last and text_width(rest, font) > right - x:  # start a new row rather than wrap
            x, y = margin, y + plan.line
        while y < last and text_width(rest, font) > right - x:
            cut = fitting(rest, right - x, font, "")
            cut = cut.rpartition(" ")[0] or cut
            put(canvas, cut, (x, y), font)
            rest, y = rest[len(cut) :].lstrip(), y + plan.line
        rest = fitting(rest, right - x, font)
        put(canvas, rest, (x, y), font)
        x += text_width(rest, font) + 3 * margin


def draw_legend(canvas: Image, plan: OverlayLayout, max_range: float, edges: bool) -> None:
    """Draw the colour bar with depths in m, and the legend of the edges, below the panels."""
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


def render(
    frame: Frame,
    T: ArrayLike,
    *,
    T_before: ArrayLike | None = None,
    names: tuple[str, str] = ("before", "after"),
    edges: EdgePoints | None = None,
    lines: Sequence[str] = (),
    status: str = "",
    max_range: float = 60.0,
) -> Image:
    """Picture (h, w, 3) BGR of a frame under T_camera_lidar (4, 4); with T_before, two panels of these names.

    Points nearer than max_range (m, along the optical axis) are coloured by depth; edges (LiDAR frame) are magenta. The size is
    that of `layout`. Raises BadInputError only for a transform that is not (4, 4).
    """
    views = {"": T} if T_before is None else dict(zip(names, (T_before, T), strict=True))
    transforms = [np.asarray(t, float) for t in views.values()]
    if any(t.shape != (4, 4) for t in transforms):
        raise BadInputError(f"an overlay needs T_camera_lidar of shape (4, 4), got {[t.shape for t in transforms]}")
    max_range = float(np.clip(np.nan_to_num(max_range, nan=60.0), 1, 1e4))
    height, width = frame.image.shape[:2]
    plan = layout(width, height, len(views))
    canvas = np.full((plan.size[1], plan.size[0], 3), BAR, np.uint8)
    # The image nearly grey and dimmed, so that bright colours are the LiDAR's; equalised, so that edges in the shade show.
    gray = cv2.cvtColor(equalize(to_gray(frame.image)), cv2.COLOR_GRAY2BGR)
    backdrop = cv2.addWeighted(frame.image if frame.image.ndim == 3 else gray, 0.2, gray, 0.45, 0)
    for name, T_view, (x, y) in zip(views, transforms, plan.panels, strict=True):
        panel = canvas[y : y + height, x : x + width]
        panel[:] = backdrop
        put(canvas, name, (x + plan.margin, y - plan.margin), plan.font)
        if not _draw_points(panel, frame.camera, T_view, frame.cloud.xyz, edges, max_range):
            left, middle = max((width - text_width(NO_POINTS, plan.font)) // 2, 0), height // 2
            panel[max(middle - plan.line, 0) : middle + plan.line // 2] //= 3
            put(panel, NO_POINTS, (left, middle), plan.font)
    draw_header(canvas, plan, status, lines)
    draw_legend(canvas, plan, max_range, edges is not None)
    return canvas


def _draw_points(panel: Image, camera: Camera, T: Transform, xyz: Points, edges: EdgePoints | None, max_range: float) -> bool:
    """Draw points and edges into a panel (H, W, 3); False if no point of xyz (n, 3) falls into it."""
    size = max(1, round(math.sqrt(camera.width * camera.height) / 350))  # px
    where, depth = _pixels(camera, T, xyz, max_range)
    level = depth_levels(depth, max_range)
    order = np.argsort(level, kind="stable")
    dots = np.zeros((camera.height, camera.width), np.uint8)
    dots.ravel()[where[order]] = level[order]  # the last write to a pixel is the nearest point
    dots = np.asarray(cv2.dilate(dots, np.ones((size, size), np.uint8)), np.uint8)  # the maximum is the nearest point
    if edges is not None:
        marks = np.zeros_like(dots)
        marks.ravel()[_pixels(camera, T, edges.xyz, max_range)[0]] = EDGE_LEVEL
        shape = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size + 1, size + 1))
        dots = np.maximum(dots, cv2.dilate(marks, shape))
    cv2.copyTo(cv2.applyColorMap(dots, PALETTE[:, None]), dots, panel)
    return len(where) > 0


def _pixels(camera: Camera, T: Transform, xyz: Points, max_range: float) -> tuple[NDArray[np.intp], Points]:
    """Points (n, 3) in the LiDAR frame -> flat pixel index and depth in m of those in the image."""
    # A rough projection leaves few to project exactly; a lens also shows points outside the pinhole's field. NaN compares false.
    with np.errstate(all="ignore"):
        P = np.vstack([camera.K[:2] @ T[:3], T[2]]).astype(np.float32)
        depth = xyz @ P[2, :3] + P[2, 3]
        keep = (depth > MIN_DEPTH) & (depth < max_range)
        for row, size in zip(P, (camera.width, camera.height) if camera.is_pinhole else (), strict=False):
            pixel = xyz @ row[:3] + row[3]  # times depth
            keep &= (pixel > -depth) & (pixel < size * depth)
        kept = np.flatnonzero(keep)
        kept = kept[(np.abs(xyz[kept]) > 1e-6).any(axis=1)]  # drivers mark a lost return with 0, 0, 0
        uv, inside = camera.project(se3.transform(T, xyz[kept]))
    u, v = np.rint(uv[inside]).astype(np.intp).T
    return v * camera.width + u, np.asarray(depth[kept[inside]], np.float32)


def caption(extrinsic: Extrinsic, keyframes: int, initial: Transform | None = None) -> list[str]:
    """Lines for `render`: frames used, score, motion from the start, standard deviation, and the reason of a refusal. keyframes:
    in the buffer. initial: start (4, 4); None = that of the last estimate."""
    result = extrinsic.result
    start = result.initial if initial is None else initial
    lines = [f"frames {result.frames_used}/{keyframes}"]
    if math.isfinite(result.score):
        lines.append(f"score {result.score:.2f}")
    if start is not None:
        deg, m = se3.error(start, result.T_camera_lidar)
        lines.append(f"moved {deg:.2f} deg / {100 * m:.1f} cm")
    if result.covariance is not None:
        sigma = np.sqrt(np.maximum(np.diag(result.covariance), 0))  # the largest of three axes
        lines.append(f"1 sigma {np.rad2deg(sigma[:3].max()):.2f} deg / {100 * sigma[3:].max():.1f} cm")
    if extrinsic.accepted or extrinsic.normalised_innovation:
        lines.append(f"drift {extrinsic.normalised_innovation:.1f}")
    if result.reason and not result.converged:
        lines.append(textwrap.shorten(result.reason, 90, placeholder=" ..."))
    return lines


def write_png(path: str | Path, image: Image) -> None:
    """Write an image (H, W[, 3]) as PNG, completely or not at all. Raises BadInputError if the folder cannot be written."""
    write_atomically(path, cv2.imencode(".png", image)[1].tobytes())
