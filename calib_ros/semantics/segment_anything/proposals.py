"""What a network proposes as masks, before they are judged, and what makes them masks of the image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.semantics.segment_anything.masks import Mask, Pixels

Floats = NDArray[np.float32]
SHIFT = 1.0  # of the threshold of logits, for the stability (Kirillov et al. 2023, Segment Anything, appendix B)
CELLS = 128  # what is smaller than a square of the longer side / 128 is a speck: two by two cells of the logits of most models


@dataclass(frozen=True, eq=False)
class Proposals:
    """Masks of some prompts. logits: (m, h, w) float32, above 0 is inside. score: (m,) predicted IoU, 0..1.

    size: (H, W) of the image. content: (h, w) pixels of the logits, from the upper left corner, that show the image.
    soft: whether the logits are more than yes and no.
    """

    logits: Floats
    score: Floats
    size: tuple[int, int]
    content: tuple[float, float]
    soft: bool = True


def judged(proposals: Proposals, min_score: float, min_stability: float) -> list[Mask]:
    """Masks that are sure enough and stable, in the size of the image, without specks.

    Stability: IoU of the masks with the threshold one higher and one lower, of which one lies within the other.
    """
    rows, columns = (math.ceil(n - 1e-6) for n in proposals.content)
    size, out = proposals.size, []
    fy, fx = (inner / whole for inner, whole in zip(proposals.content, size, strict=True))
    to_logits = np.array([[fx, 0, 0.5 * fx - 0.5], [0, fy, 0.5 * fy - 0.5]])
    for k in np.flatnonzero(proposals.score >= min_score):
        logits = proposals.logits[k]
        around = logits[:rows, :columns] > (-SHIFT if proposals.soft else 0)
        if not around.any():
            continue
        down, across = np.flatnonzero(around.any(axis=1)), np.flatnonzero(around.any(axis=0))
        # Between pixels of the logits a mask reaches at most to the next one.
        box = (across[0] - 0.5) / fx, (down[0] - 0.5) / fy, (across[-1] + 1.5) / fx, (down[-1] + 1.5) / fy
        sampled, corner = sample(logits, to_logits, box, size)
        stability = 1.0
        if proposals.soft:
            stability = np.count_nonzero(sampled > SHIFT) / max(int(np.count_nonzero(sampled > -SHIFT)), 1)
        mask = Mask.of(clean(sampled > 0, max(size) / CELLS), corner) if stability >= min_stability else None
        if mask is not None:
            out.append(replace(mask, score=min(float(proposals.score[k]), 1.0), stability=float(stability)))
    return out


def sample(
    logits: Floats, to_logits: NDArray[np.float64], box: Sequence[float], size: tuple[int, int]
) -> tuple[Floats, tuple[int, int]]:
    """Logits (h, w) at the pixels of an image of this size (H, W) within a box, bilinear, and the column and row of the first.

    to_logits: (2, 3) from the centres of the image's pixels to those of the logits. box: left, top, right, bottom in the image.
    """
    left, top = (max(min(round(float(edge)), end - 1), 0) for edge, end in zip(box[:2], size[::-1], strict=True))
    right, bottom = (min(round(float(edge)), end) for edge, end in zip(box[2:], size[::-1], strict=True))
    shape = max(right - left, 1), max(bottom - top, 1)
    to_logits = to_logits + np.pad(to_logits[:, :2] @ [[left], [top]], ((0, 0), (2, 0)))
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    sampled = cv2.warpAffine(logits, to_logits, shape, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(sampled, np.float32), (left, top)


def clean(inside: Pixels, side: float) -> Pixels:
    """Pixels (h, w) of a mask without islands and holes that are smaller than a square of this side, px."""
    kept = _without_specks(inside, side * side)
    margin = math.ceil(side)  # connects what reaches the border, which is no hole, and is itself large enough
    return ~_without_specks(~np.pad(kept, margin), side * side)[margin:-margin, margin:-margin]


def _without_specks(inside: Pixels, area: float) -> Pixels:
    _, member, stats, _ = cv2.connectedComponentsWithStats(inside.view(np.uint8), connectivity=8)
    keep = stats[:, cv2.CC_STAT_AREA] >= area
    keep[0] = False
    return np.asarray(keep[member])
