"""Of masks of the same thing only the best."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib_ros.semantics.segment_anything.masks import Mask

HALF = 0.5  # IoU of masks whose boxes agree; below it they are something and what is behind or within it


def without_duplicates(masks: Sequence[Mask], most: float) -> list[Mask]:
    """Masks without those that a better one has made needless, best first; of equal scores the earlier one is better.

    Two are the same if their IoU is above `most`, or that of their boxes is and they share half of their pixels. Boxes alone,
    as Segment Anything compares them, would take a window for its frame.
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
        least = np.where(of_boxes > most, min(HALF, most), most)  # IoU that makes the two the same
        smaller, larger = np.minimum(areas[kept], areas[k]), np.maximum(areas[kept], areas[k])
        possible = np.minimum(smaller, shared) > least * larger
        if not any(_iou(mask, ordered[kept[n]]) > least[n] for n in np.flatnonzero(possible)):
            kept.append(k)
    return [ordered[k] for k in kept]


def _iou(one: Mask, other: Mask) -> float:
    common = one.common(other)
    return common / (one.area + other.area - common)
