"""The diagnostic picture: LiDAR points and edges over the image, so that one look tells whether an extrinsic is right."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib_ros import se3
from calib_ros.camera import MIN_DEPTH, Camera
from calib_ros.config import ImageConfig
from calib_ros.errors import BadInputError
from calib_ros.files import write_atomically
from calib_ros.frame import Frame
from calib_ros.image.enhance import equalize, to_gray
from calib_ros.overlay_bars import (
    BAR,
    EDGE_LEVEL,
    PALETTE,
    Image,
    depth_levels,
    draw_header,
    draw_legend,
    layout,
    put,
    text_width,
)

if TYPE_CHECKING:  # the tracker lives on a floor above: only its name is needed here
    from calib_ros.online.extrinsic import Extrinsic

Matrix = NDArray[np.float64]
Points = NDArray[np.float32]
NO_POINTS = "no LiDAR point falls into the image"


class HasXyz(Protocol):
    """Points of any kind."""

    @property
    def xyz(self) -> Points:
        """(n, 3) float32 m, LiDAR frame."""
        ...


def render(
    frame: Frame,
    T: ArrayLike,
    *,
    T_before: ArrayLike | None = None,
    edges: HasXyz | None = None,
    lines: Sequence[str] = (),
    status: str = "",
    max_range: float = 60.0,
) -> Image:
    """Picture (h, w, 3) BGR of a frame under T_camera_lidar (4, 4); with T_before, panels "before" and "after".

    Points nearer than max_range (m, along the optical axis) are coloured by depth; edges (LiDAR frame) are magenta. The
    size is layout(...).size. BadInputError for a transform that is not (4, 4); anything else odd still gives a picture.
    """
    views = {"": T} if T_before is None else {"before": T_before, "after": T}
    transforms = [np.asarray(t, float) for t in views.values()]
    if any(t.shape != (4, 4) for t in transforms):
        raise BadInputError(f"an overlay needs T_camera_lidar of shape (4, 4), got {[t.shape for t in transforms]}")
    max_range = float(np.clip(np.nan_to_num(max_range, nan=60.0), 1, 1e4))
    height, width = frame.image.shape[:2]
    plan = layout(width, height, len(views))
    canvas = np.full((plan.size[1], plan.size[0], 3), BAR, np.uint8)
    backdrop = _backdrop(frame.image)
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


def _backdrop(image: Image) -> Image:
    """Nearly grey and dimmed, so that bright colours belong to the LiDAR; equalised, so that edges in the shade show."""
    gray = cv2.cvtColor(equalize(to_gray(image), ImageConfig()), cv2.COLOR_GRAY2BGR)
    return np.asarray(cv2.addWeighted(image if image.ndim == 3 else gray, 0.2, gray, 0.45, 0), np.uint8)


def _draw_points(panel: Image, camera: Camera, T: Matrix, xyz: Points, edges: HasXyz | None, max_range: float) -> bool:
    """Dots and edge marks into a panel (H, W, 3); False if no point of xyz (n, 3) falls into it."""
    size = max(1, round(math.sqrt(camera.width * camera.height) / 350))  # px
    where, depth = _pixels(camera, T, xyz, max_range)
    level = depth_levels(depth, max_range)
    order = np.argsort(level, kind="stable")
    dots = np.zeros((camera.height, camera.width), np.uint8)
    dots.ravel()[where[order]] = level[order]  # the last write to a pixel stays: the nearest
    dots = np.asarray(cv2.dilate(dots, np.ones((size, size), np.uint8)), np.uint8)  # a maximum: again the nearest
    if edges is not None:
        marks = np.zeros_like(dots)
        marks.ravel()[_pixels(camera, T, edges.xyz, max_range)[0]] = EDGE_LEVEL
        shape = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size + 1, size + 1))
        dots = np.maximum(dots, cv2.dilate(marks, shape))
    cv2.copyTo(cv2.applyColorMap(dots, PALETTE[:, None]), dots, panel)
    return len(where) > 0


def _pixels(camera: Camera, T: Matrix, xyz: Points, max_range: float) -> tuple[NDArray[np.intp], Points]:
    """Points (n, 3) in the LiDAR frame -> flat pixel index and depth in m of those in the picture.

    A rough projection in float32 leaves few points to project exactly. Lenses bend points from outside the pinhole's
    field into the picture, so for them only what lies behind is left out. NaN compares false and goes with the rest.
    """
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


def caption(extrinsic: Extrinsic, keyframes: int, initial: Matrix | None = None) -> list[str]:
    """Lines for render(): what the estimate rests on, how far it moved, how sure it is, and why it was turned away.

    keyframes: in the buffer. initial: where all began (4, 4); without it, where the last estimate began.
    """
    result = extrinsic.result
    start = result.initial if initial is None else initial
    lines = [f"frames {result.frames_used}/{keyframes}"]
    if math.isfinite(result.score):
        lines.append(f"score {result.score:.2f}")
    if start is not None:
        deg, m = se3.rotation_error_deg(start, result.T_camera_lidar), se3.translation_error_m(start, result.T_camera_lidar)
        lines.append(f"moved {deg:.2f} deg / {100 * m:.1f} cm")
    if result.covariance is not None:
        sigma = np.sqrt(np.maximum(np.diag(result.covariance), 0))  # the largest of three axes
        lines.append(f"1 sigma {np.rad2deg(sigma[:3].max()):.2f} deg / {100 * sigma[3:].max():.1f} cm")
    if extrinsic.accepted or extrinsic.drift:
        lines.append(f"drift {extrinsic.drift:.1f}")
    if result.reason and not result.converged:
        lines.append(textwrap.shorten(result.reason, 90, placeholder=" ..."))
    return lines


def write_png(path: str | Path, image: Image) -> None:
    """Write a picture (H, W[, 3]) as a whole PNG or not at all. BadInputError if the folder cannot be written."""
    write_atomically(path, cv2.imencode(".png", image)[1].tobytes())
