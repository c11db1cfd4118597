"""Masks of objects in an image, from networks or files, and the edges of their boundaries."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.frame import Frame
from calib_ros_semantics.models.class_borders import clear_border
from calib_ros_semantics.models.onnx_model import Deadline, SegmentationModel

Pixels = NDArray[np.bool_]
Floats = NDArray[np.float32]
Size = tuple[int, int]
# As the authors of Segment Anything set them: predicted IoU, stability, and IoU of boxes above which only the best mask is kept.
MIN_IOU, MIN_STABILITY, NMS_IOU = 0.88, 0.95, 0.7
STABILITY_SHIFT = 1.0  # of the threshold of logits
SPECK_PARTS = 128  # specks are smaller than a square of the longer side / 128: two by two cells of the logits of most models
MIN_SHARED = 0.5  # IoU of duplicates whose boxes agree; below it they are an object and what is behind or within it
BLUR = 1.0  # px; of a mask before its gradient is taken. A stronger blur loses poles that are three pixels wide
# px; over which directions are averaged. Masks come from grids of up to 5 pixels, whose boundaries are stairs: without averaging,
# the shares of the two directions are off by 0.3, with 2 px by 0.2, with 3 px by 0.08.
DIRECTION_BLUR = 3.0
BLUR_MARGIN = 5  # px; reach of a blurred boundary
FULL_STEP = 0.31  # gradient beside a straight boundary between two pixels after BLUR
RIDGE_TOLERANCE = np.float32(0.95)  # the two pixels beside a boundary are one ridge, however their gradients are rounded


@dataclass(frozen=True, eq=False)
class Mask:
    """The pixels of an object within its box: a hundred masks of a large image would not fit in memory otherwise.

    left, top: first pixel of the box. inside: (h, w) bool, not empty. score: 0..1, quality predicted by the model.
    """

    left: int
    top: int
    inside: Pixels
    score: float = 1.0

    @staticmethod
    def of(picture: Pixels, corner: tuple[int, int] = (0, 0)) -> Mask | None:
        """From pixels (h, w) bool, the first of which is at column and row `corner` of the image; None if none is set."""
        rows, columns = np.flatnonzero(picture.any(axis=1)), np.flatnonzero(picture.any(axis=0))
        if len(rows) == 0:
            return None
        top, left = int(rows[0]), int(columns[0])
        inside = picture[top : rows[-1] + 1, left : columns[-1] + 1]
        return Mask(corner[0] + left, corner[1] + top, inside.copy())

    @property
    def box(self) -> tuple[int, int, int, int]:
        """Left, top, right, bottom; the last two are exclusive."""
        return self.left, self.top, self.left + self.inside.shape[1], self.top + self.inside.shape[0]

    @cached_property
    def area(self) -> int:
        """Number of pixels."""
        return int(np.count_nonzero(self.inside))

    def covers(self, u: float, v: float) -> bool:
        """Whether the pixel at (u, v), column and row, is inside."""
        x, y = int(u) - self.left, int(v) - self.top
        height, width = self.inside.shape
        return 0 <= x < width and 0 <= y < height and bool(self.inside[y, x])

    def iou(self, other: Mask) -> float:
        """Pixels in both as a share of those in any."""
        left, top, right, bottom = self.box
        left2, top2, right2, bottom2 = other.box
        x, y, x2, y2 = max(left, left2), max(top, top2), min(right, right2), min(bottom, bottom2)
        if x >= x2 or y >= y2:
            return 0.0
        own = self.inside[y - top : y2 - top, x - left : x2 - left]
        common = int(np.count_nonzero(own & other.inside[y - top2 : y2 - top2, x - left2 : x2 - left2]))
        return common / (self.area + other.area - common)


class Proposals(NamedTuple):
    """Masks proposed by a network. logits: (m, h, w) float32, inside above 0. score: (m,) predicted IoU, 0..1.

    size: (H, W) of the image. content: (h, w) of the logits, from the upper left corner, that covers the image. soft: False if
    the logits are binary.
    """

    logits: Floats
    score: Floats
    size: Size
    content: tuple[float, float]
    soft: bool = True


def accepted_masks(proposals: Proposals) -> list[Mask]:
    """Masks of sufficient score and stability (Kirillov et al. 2023, appendix B), at the size of the image, without specks."""
    rows, columns = (math.ceil(n - 1e-6) for n in proposals.content)
    size, out = proposals.size, []
    fy, fx = (inner / whole for inner, whole in zip(proposals.content, size, strict=True))
    to_logits = np.array([[fx, 0, 0.5 * fx - 0.5], [0, fy, 0.5 * fy - 0.5]])
    for k in np.flatnonzero(proposals.score >= MIN_IOU):
        logits = proposals.logits[k]
        candidate = logits[:rows, :columns] > (-STABILITY_SHIFT if proposals.soft else 0)
        if not candidate.any():
            continue
        down, across = np.flatnonzero(candidate.any(axis=1)), np.flatnonzero(candidate.any(axis=0))
        # Between pixels of the logits a mask reaches at most to the next pixel.
        box = (across[0] - 0.5) / fx, (down[0] - 0.5) / fy, (across[-1] + 1.5) / fx, (down[-1] + 1.5) / fy
        sampled, corner = sample_logits(logits, to_logits, box, size)
        if proposals.soft:
            larger = max(int(np.count_nonzero(sampled > -STABILITY_SHIFT)), 1)
            if np.count_nonzero(sampled > STABILITY_SHIFT) / larger < MIN_STABILITY:
                continue
        out += found_mask(sampled > 0, size, corner, float(proposals.score[k]))
    return out


def found_mask(inside: Pixels, size: Size, corner: tuple[int, int], score: float = 1.0) -> list[Mask]:
    """The mask of pixels (h, w) from a corner of an image (H, W) on, without specks; none if nothing is left."""
    mask = Mask.of(without_specks(inside, max(size) / SPECK_PARTS), corner)
    return [] if mask is None else [replace(mask, score=min(score, 1.0))]


def sample_logits(
    logits: Floats, to_logits: NDArray[np.float64], box: Sequence[float], size: Size
) -> tuple[Floats, tuple[int, int]]:
    """Logits (h, w) sampled bilinearly at the pixels of an image (H, W) within a box, and column and row of the first pixel.

    to_logits: (2, 3) affine map from pixels of the image to those of the logits. box: left, top, right, bottom in the image.
    """
    left, top = (max(min(round(float(edge)), end - 1), 0) for edge, end in zip(box[:2], size[::-1], strict=True))
    right, bottom = (min(round(float(edge)), end) for edge, end in zip(box[2:], size[::-1], strict=True))
    shape = max(right - left, 1), max(bottom - top, 1)
    to_logits = to_logits + np.pad(to_logits[:, :2] @ [[left], [top]], ((0, 0), (2, 0)))
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    sampled = cv2.warpAffine(logits, to_logits, shape, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(sampled, np.float32), (left, top)


def without_specks(inside: Pixels, side: float) -> Pixels:
    """A mask (h, w) without islands and holes smaller than a square of this side, px."""
    kept = _large_regions(inside, side * side)
    margin = math.ceil(side)  # a hole that reaches the border joins it, which is large enough to be kept
    return ~_large_regions(~np.pad(kept, margin), side * side)[margin:-margin, margin:-margin]


def _large_regions(inside: Pixels, area: float) -> Pixels:
    _, member, stats, _ = cv2.connectedComponentsWithStats(inside.view(np.uint8), connectivity=8)
    keep = stats[:, cv2.CC_STAT_AREA] >= area
    keep[0] = False
    return np.asarray(keep[member])


def without_duplicates(masks: Sequence[Mask], max_iou: float) -> list[Mask]:
    """Non-maximum suppression: masks without duplicates of better ones, best first, the earlier first of equal scores.

    Two masks are duplicates if their IoU is above max_iou, or if that of their boxes is and their IoU above MIN_SHARED. Comparing
    boxes only, as Segment Anything does, would confuse a window with its frame.
    """
    ordered = sorted(masks, key=lambda mask: -mask.score)
    boxes = np.array([mask.box for mask in ordered], float).reshape(-1, 4)
    areas = np.array([mask.area for mask in ordered], float)
    sizes = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    kept: list[int] = []
    for k, mask in enumerate(ordered):
        low, high = np.maximum(boxes[kept, :2], boxes[k, :2]), np.minimum(boxes[kept, 2:], boxes[k, 2:])
        shared = np.clip(high - low, 0, None).prod(axis=1)
        of_boxes = shared / (sizes[kept] + sizes[k] - shared)
        least = np.where(of_boxes > max_iou, min(MIN_SHARED, max_iou), max_iou)  # IoU of duplicates
        smaller, larger = np.minimum(areas[kept], areas[k]), np.maximum(areas[kept], areas[k])
        possible = np.minimum(smaller, shared) > least * larger
        if not any(mask.iou(ordered[kept[n]]) > least[n] for n in np.flatnonzero(possible)):
            kept.append(k)
    return [ordered[k] for k in kept]


class MaskModel(SegmentationModel):
    """Frame -> semantic edges (2, H, W) as of `mask_edges`, from masks of whatever is in its image."""

    def __call__(self, frame: Frame, deadline: Deadline, borders: bool = True) -> Floats:
        return mask_edges(self.masks(frame, deadline), (frame.image.shape[0], frame.image.shape[1]))

    @abstractmethod
    def masks(self, frame: Frame, deadline: Deadline) -> list[Mask]:
        """Masks of a frame's image. Raises ModelError, BudgetError."""


def mask_edges(masks: Sequence[Mask], size: Size) -> Floats:
    """Boundaries of masks (2, H, W) float32 in 0..1: [0] horizontal gradients (vertical lines), [1] vertical ones.

    size: (H, W) of the image. Masks may overlap, nest, and leave pixels uncovered.

    Their sum is the strength: the score of the mask, at most 1 where several masks meet; gradients are summed before ridges are
    extracted, so that a common boundary is thin. It is split into E cos^2 and E sin^2 of the direction of the normal, averaged by
    the structure tensor (Bigun and Granlund 1987). The end of a mask at the border of the image is not an edge.
    """
    total, xx, yy, xy = (np.zeros(size, np.float32) for _ in range(4))
    for mask in masks:
        left, top, right, bottom = mask.box
        x, y = max(left - BLUR_MARGIN, 0), max(top - BLUR_MARGIN, 0)
        place = slice(y, min(bottom + BLUR_MARGIN, size[0])), slice(x, min(right + BLUR_MARGIN, size[1]))
        soft = np.zeros(total[place].shape, np.float32)
        soft[top - y : bottom - y, left - x : right - x] = mask.inside
        # A mask that touches the border of the image continues beyond it.
        soft = np.asarray(cv2.GaussianBlur(soft, (0, 0), BLUR, borderType=cv2.BORDER_REPLICATE), np.float32)
        sobel = partial(cv2.Sobel, soft, cv2.CV_32F, ksize=1, scale=0.5, borderType=cv2.BORDER_REPLICATE)
        gx, gy = (np.asarray(sobel(dx=dx, dy=1 - dx), np.float32) * np.float32(mask.score) for dx in (1, 0))
        squares = gx * gx, gy * gy
        total[place] += np.sqrt(squares[0] + squares[1])
        xx[place] += squares[0]
        yy[place] += squares[1]
        xy[place] += gx * gy
    xx, yy, xy = (np.asarray(cv2.GaussianBlur(part, (0, 0), DIRECTION_BLUR), np.float32) for part in (xx, yy, xy))
    difference = xx - yy
    cosine = difference / (np.sqrt(difference * difference + 4 * xy * xy) + np.float32(1e-12))  # of twice the normal's angle
    strength = np.where(_is_ridge(total, cosine, xy), np.minimum(total / np.float32(FULL_STEP), 1), np.float32(0))
    clear_border(strength)
    horizontal = strength * (1 + cosine) / 2
    return np.stack([horizontal, strength - horizontal]).astype(np.float32, copy=False)


def _is_ridge(strength: Floats, cosine: Floats, xy: Floats) -> NDArray[np.bool_]:
    """Where (H, W) the strength is not lower than that of both neighbours along the normal, given by cosine and xy."""
    padded = cv2.copyMakeBorder(strength, 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    height, width = strength.shape

    def beside(dx: int, dy: int) -> Floats:
        ahead, behind = (padded[1 + k * dy :, 1 + k * dx :][:height, :width] for k in (1, -1))
        return np.asarray(np.maximum(ahead, behind))

    upright = np.abs(cosine) > np.sqrt(0.5)
    straight = np.where(cosine > 0, beside(1, 0), beside(0, 1))
    slanted = np.where(xy > 0, beside(1, 1), beside(1, -1))
    return np.asarray(strength >= RIDGE_TOLERANCE * np.where(upright, straight, slanted))
