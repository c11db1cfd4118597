"""Pictures of the semantics of a frame."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.frame import UNLABELLED, Frame, SemanticClass
from calib_ros.image.enhance import to_gray
from calib_ros.overlay import BAR, Color, put, text_width

Image = NDArray[np.uint8]
C = SemanticClass
COLORS: dict[int, Color] = {  # BGR, close to the usual colours of road scenes
    C.OTHER: (150, 150, 150),
    C.VEHICLE: (210, 60, 40),
    C.PERSON: (60, 20, 230),
    C.CYCLIST: (140, 60, 255),
    C.POLE: (0, 220, 255),
    C.SIGN: (0, 140, 255),
    C.BUILDING: (90, 90, 160),
    C.VEGETATION: (50, 160, 60),
    C.GROUND: (140, 70, 130),
    C.SKY: (230, 180, 90),
}
VERTICAL, LEVEL = (255, 128, 0), (0, 128, 255)  # BGR of semantic edges
LINE, FONT = 26, 0.5  # px, and font scale
RADIUS, SIDE = 40.0, 900  # of the plan view: m around the LiDAR, and px
BACKGROUND = 24  # grey level where nothing was measured
UNKNOWN = (80, 80, 80)  # visible on the background of points, and darker than OTHER


def palette() -> Image:
    """Colour table BGR (256, 3) of SemanticClass."""
    out = np.full((256, 3), UNKNOWN, np.uint8)
    for own, color in COLORS.items():
        out[own] = color
    return out


def classes_on_image(frame: Frame, classes: NDArray[np.uint8]) -> Image:
    """Classes of pixels (H, W) over the image, with their names."""
    gray = cv2.cvtColor(to_gray(frame.image), cv2.COLOR_GRAY2BGR)
    picture = np.asarray(cv2.addWeighted(gray, 0.45, palette()[classes], 0.55, 0), np.uint8)
    return with_legend(picture, np.unique(classes))


def cloud_from_above(frame: Frame, labels: NDArray[np.uint8]) -> Image:
    """Classes of points (n,) in plan view, with their names; rare classes are drawn last."""
    known = np.isfinite(frame.cloud.xyz).all(axis=1)
    xyz, own = frame.cloud.xyz[known], labels[known]
    order = np.argsort(-np.bincount(own, minlength=256)[own], kind="stable")
    return with_legend(from_above(xyz[order], palette()[own[order]]), np.unique(own))


def edges_on_image(frame: Frame, edges: NDArray[np.float32]) -> Image:
    """Oriented edges (2, H, W) in 0..1 over the darkened image: vertical lines blue, horizontal ones orange, white in between."""
    picture = cv2.cvtColor(to_gray(frame.image), cv2.COLOR_GRAY2BGR) * 0.4
    picture += np.tensordot(edges, np.array([VERTICAL, LEVEL], np.float32), (0, 0))
    line = {"vertical boundaries": VERTICAL, "level boundaries": LEVEL}
    return above_names(np.asarray(np.clip(picture, 0, 255), np.uint8), line)


def with_legend(picture: Image, classes: NDArray[np.generic]) -> Image:
    """The picture (H, W, 3) above a line with the names of the classes in it."""
    names = {c: "unknown" if c == UNLABELLED else C(c).name.lower() for c in classes.tolist()}
    return above_names(picture, {name: COLORS.get(c, UNKNOWN) for c, name in names.items()})


def above_names(picture: Image, colors: dict[str, Color]) -> Image:
    """The picture (H, W, 3) above a line with names and their colours; those that do not fit are left out."""
    width = picture.shape[1]
    line, u = np.full((LINE, width, 3), BAR, np.uint8), 8
    for name, color in colors.items():
        if u + 22 + text_width(name, FONT) > width:
            break
        line[7 : LINE - 7, u : u + 14] = color
        put(line, name, (u + 18, LINE - 9), FONT)
        u += 34 + text_width(name, FONT)
    return np.vstack([picture, line])


def from_above(xyz: NDArray[np.float32], colors: Image) -> Image:
    """Plan view of points (n, 3) with colours (n, 3), ahead is up; later points are drawn last. Circles every 10 m."""
    picture = np.full((SIDE, SIDE, 3), BACKGROUND, np.uint8)
    half = SIDE // 2
    font, line, margin = sizes(SIDE)
    circles = {f"{r} m": round(r / RADIUS * half) for r in range(10, int(RADIUS) + 1, 10)}
    for radius in circles.values():
        cv2.circle(picture, (half, half), radius, (70, 70, 70), 1, cv2.LINE_AA)
    pixel = np.rint(half - xyz[:, [1, 0]].astype(np.float64) / RADIUS * half)
    inside = ((pixel >= 1) & (pixel < SIDE - 1)).all(axis=1)
    u, v = pixel[inside].astype(np.intp).T
    for du, dv in ((0, 0), (1, 0), (0, 1), (1, 1)):
        picture[v + dv, u + du] = colors[inside]
    for name, radius in circles.items():
        y = half - radius + line - margin
        picture[y - line + margin : y + margin, half : half + text_width(name, font) + 2 * margin] = BAR
        put(picture, name, (half + margin, y), font)
    cv2.drawMarker(picture, (half, half), (255, 255, 255), cv2.MARKER_TRIANGLE_UP, 16, 2)
    return picture


def sizes(width: int) -> tuple[float, int, int]:
    """Font scale, line height and margin in px for a picture of this width, readable at half the size."""
    font = float(np.clip(width / 1500, 0.4, 1.6))
    return font, round(36 * font), max(round(9 * font), 3)
