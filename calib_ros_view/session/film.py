"""A replay as an animated GIF: frames with the points at the extrinsic of their moment, and below them status and errors."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from io import BytesIO
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from calib_ros import se3
from calib_ros.config import Config
from calib_ros.datasets.source import Source, WithMotion
from calib_ros.errors import BadInputError, MissingDependencyError
from calib_ros.io import check_output, write_atomically
from calib_ros.lidar.deskew import deskewed_frame
from calib_ros.overlay import BADGE_OTHER, BADGES, BAR, PALETTE, TEXT, put, text_width
from calib_ros.result import INSUFFICIENT, Extrinsic
from calib_ros_view.session.picture import FramePicture, Image, Look

MOST_BYTES = 2_000_000
WIDTH, FOOT, LABEL = 800, 104, 62  # px: of the whole, the height below the picture, the width beside the plot
# Frames of the source, greys and px across, the best first.
FORMS = [(n, 16, WIDTH) for n in (60, 48, 38, 30, 26, 23, 20, 18, 16, 14, 12)]
FORMS += [(n, 12, 640) for n in (18, 16, 14, 12, 10)] + [(n, 8, 480) for n in (12, 8, 4)] + [(3, 4, 320)]
SWINGS, SWING_DEG, STEPS = 3, 0.2, 10  # of so many changes of the extrinsic, those beyond so many deg, steps are shown
DRIVE_MS, STEP_MS, HOLD_MS, END_MS = 7000, 80, 1000, 4000  # all frames together; a step; before and after a swing; at the end
LOW, HIGH = -2, 1  # decades of the plot, deg
RIGHT, WRONG, SOFT = (130, 220, 120), (80, 80, 255), (150, 150, 150)  # BGR
RIGHT_DEG, RIGHT_M = 0.25, 0.05  # beyond which an error is shown as wrong
LOOK = Look(background="grey", far=60.0, opacity=1.0, width=3 * WIDTH // 2)  # made smaller: thin points of vivid colours
Moments = Sequence[tuple[int, Extrinsic]]  # positions in a source, and what was known after each


def film(path: str | Path) -> Callable[[Moments, Source, Config], str]:
    """What writes the GIF of a replay to `path`, see `write_film`. BadInputError for one that cannot be written,
    MissingDependencyError without Pillow."""
    check_output(str(path), "--gif")
    try:
        import PIL.Image  # noqa: F401
    except ImportError:
        raise MissingDependencyError("--gif needs Pillow: pip install pillow, or apt install python3-pil") from None
    return lambda *given: write_film(path, *given)


def write_film(path: str | Path, moments: Moments, source: Source, config: Config) -> str:
    """Write a GIF of at most MOST_BYTES, of frames that are read again; what it holds, in words. Errors are told where the source
    has a reference, else how far the extrinsic has moved. BadInputError without moments."""
    if not moments:
        raise BadInputError("--gif: there is nothing to show, no frame was usable")
    poses, last = [extrinsic.result.T_camera_lidar for _, extrinsic in moments], len(moments) - 1
    origin, drawn = poses[0] if source.reference is None else source.reference, dict[int, FramePicture]()
    errors = [se3.error(origin, T) for T in poses]
    turns = [se3.rotation_error_deg(a, b) for a, b in pairwise(poses)]
    swings = {int(k) + 1 for k in np.argsort(turns, kind="stable")[::-1][:SWINGS] if turns[k] > SWING_DEG}
    read = WithMotion(source, config.motion, accumulate_s=config.lidar.accumulate_s)
    for count, greys, width in FORMS:
        images, times = [], []
        chosen = {*np.rint(np.linspace(0, last, min(count, last + 1))).astype(int).tolist(), *swings}
        for k in sorted(chosen):
            if k not in drawn:
                drawn[k] = FramePicture(deskewed_frame(read[moments[k][0]], config.motion))
            way = se3.log(poses[k] @ se3.inverse(poses[k - 1])) if k in swings else np.zeros(6)
            for step in range(0 if k in swings else STEPS, STEPS + 1):
                left = 0.5 + 0.5 * math.cos(math.pi * step / STEPS)
                T, status = se3.exp(-left * way) @ poses[k], moments[k if step else k - 1][1].result.status
                told = [*errors[:k], se3.error(origin, T)]
                where = f"frame {moments[k][0] + 1} of {moments[last][0] + 1}"
                picture = _drawn(drawn[k].draw(T, None, LOOK), status, where, told, last + 1, source.reference is not None)
                images.append(cv2.resize(picture, (width, round(len(picture) * width / WIDTH)), interpolation=cv2.INTER_AREA))
                rests = HOLD_MS if k in swings else DRIVE_MS // len(chosen)
                times.append(STEP_MS if 0 < step < STEPS else rests)
        times[-1] = END_MS
        data = _encoded(images, times, greys)
        if len(data) <= MOST_BYTES:
            break
    write_atomically(path, data)
    return f"{path}: {len(images)} pictures of {len(chosen)} frames, {len(data) / 1e6:.2f} MB"


def _drawn(large: Image, status: str, where: str, sizes: Sequence[tuple[float, float]], total: int, are_errors: bool) -> Image:
    """A picture with what there is to know below it (h, WIDTH, 3), BGR. sizes: deg and m, of all moments so far, of a total."""
    canvas = np.full((round(len(large) * WIDTH / large.shape[1]) + FOOT, WIDTH, 3), BAR, np.uint8)
    canvas[:-FOOT] = cv2.resize(large, (WIDTH, len(canvas) - FOOT), interpolation=cv2.INTER_AREA)
    foot, end = canvas[-FOOT:], 28 + text_width(status, 0.6)
    foot[10:38, 10:end] = BADGES.get(status, BADGE_OTHER)
    put(foot, status, (19, 30), 0.6, (0, 0, 0) if status == INSUFFICIENT else (255, 255, 255))
    put(foot, where, (end + 14, 30), 0.55, SOFT)
    now, first = (f"{deg:.2f} deg  {100 * m:.1f} cm" for deg, m in (sizes[-1], sizes[0]))
    is_right = sizes[-1][0] <= RIGHT_DEG and sizes[-1][1] <= RIGHT_M
    color = TEXT if not are_errors else RIGHT if is_right else WRONG
    put(foot, f"{'error' if are_errors else 'moved'} {now}", (12, 66), 0.8, color)
    put(foot, f"at the start {first}" if are_errors else "from the start", (12, 92), 0.55, SOFT)
    plot, level = foot[8:-8, 440:-12], np.clip(np.log10(np.maximum([deg for deg, _ in sizes], 1e-9)), LOW, HIGH)
    scale = (len(plot) - 12) / (HIGH - LOW)
    for decade in range(LOW, HIGH + 1):
        y = round(6 + scale * (HIGH - decade))
        plot[y, LABEL:] = 70
        put(plot, f"{10.0**decade:g} deg", (0, y + 4), 0.4, SOFT)
    x = LABEL + (plot.shape[1] - LABEL - 6) * np.arange(len(level)) / max(total - 1, 1)
    line = np.rint(np.stack([x, 6 + scale * (HIGH - level)], axis=1)).astype(np.int32)
    cv2.polylines(plot, [line], False, TEXT, 2, cv2.LINE_AA)
    cv2.circle(plot, line[-1].tolist(), 5, color, -1, cv2.LINE_AA)
    return canvas


def _encoded(images: Sequence[Image], times: Sequence[int], greys: int) -> bytes:
    """One palette for all, without dithering: what does not change from picture to picture takes no room."""
    from PIL import Image as pillow

    ramp = PALETTE[8:255:10].astype(float)
    parts = np.linspace(0, 160, greys)[:, None].repeat(3, axis=1), ramp, 0.6 * ramp
    colors = np.vstack([*parts, (BAR,) * 3, (255,) * 3, BADGE_OTHER, TEXT, RIGHT, WRONG, SOFT, *BADGES.values()])
    palette = pillow.new("P", (1, 1))
    palette.putpalette(np.rint(colors[:, ::-1]).astype(np.uint8).tobytes())
    rgb = (pillow.fromarray(np.ascontiguousarray(image[:, :, ::-1])) for image in images)
    first, *others = [image.quantize(palette=palette, dither=pillow.Dither.NONE) for image in rgb]
    file = BytesIO()
    first.save(file, "GIF", save_all=True, append_images=others, duration=list(times), loop=0)
    return file.getvalue()
