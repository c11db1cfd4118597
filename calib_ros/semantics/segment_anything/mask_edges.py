"""Semantic edges: the boundaries of masks, split by their direction as the image's edges are (thesis 3.4.2, figure 3.10)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.semantics.segment_anything.masks import Mask, Masks

Map = NDArray[np.float32]
SOFT = 1.0  # px; blur of a mask before its gradient is taken. More of it loses poles that are three pixels wide
# px; over it directions are averaged. Masks come from grids of up to 5 pixels, whose boundaries are stairs: without, the shares
# of the two directions are off by 0.3 there, with 2 px by 0.2, with 3 px by 0.08.
STEADY = 3.0
MARGIN = 5  # px; a blurred boundary reaches no farther
FRAME = 4  # px; where masks end so near to the border of the image, they mostly mean to go on behind it
STEP = 0.31  # gradient beside a straight boundary between two pixels, blurred so
TIE = np.float32(0.95)  # the two pixels beside a boundary are one ridge, however their gradients are rounded


def mask_edges(masks: Masks) -> Map:
    """Boundaries of masks (2, H, W) float32 in 0..1: [0] horizontal gradients (vertical lines), [1] vertical ones.

    Their sum is the strength: the score of the mask, 1 at most where several masks meet. A boundary that several masks have
    in common is as thin as that of one, though they disagree on it by a pixel or two: their gradients are added up
    before the ridge is looked for. The strength is shared out as E cos^2 and E sin^2 of the normal's direction, averaged over
    the neighbourhood by the structure tensor (Bigun and Granlund 1987). Where a mask ends at the border of the image is no edge.
    """
    height, width = masks.size
    total, xx, yy, xy = (np.zeros((height, width), np.float32) for _ in range(4))
    for mask in masks.masks:
        place, gx, gy = _gradients(mask, masks.size)
        gx, gy = gx * np.float32(mask.score), gy * np.float32(mask.score)
        squares = gx * gx, gy * gy
        total[place] += np.sqrt(squares[0] + squares[1])
        xx[place] += squares[0]
        yy[place] += squares[1]
        xy[place] += gx * gy
    xx, yy, xy = (np.asarray(cv2.GaussianBlur(part, (0, 0), STEADY), np.float32) for part in (xx, yy, xy))
    difference = xx - yy
    cosine = difference / (np.sqrt(difference * difference + 4 * xy * xy) + np.float32(1e-12))  # of twice the normal's angle
    strength = np.where(_is_ridge(total, cosine, xy), np.minimum(total / np.float32(STEP), 1), np.float32(0))
    for border in (strength[:FRAME], strength[-FRAME:], strength[:, :FRAME], strength[:, -FRAME:]):
        border[:] = 0
    horizontal = strength * (1 + cosine) / 2
    return np.stack([horizontal, strength - horizontal]).astype(np.float32, copy=False)


def _gradients(mask: Mask, size: tuple[int, int]) -> tuple[tuple[slice, slice], Map, Map]:
    """Rows and columns around a mask, and the gradients of the blurred mask there."""
    left, top, right, bottom = mask.box
    x, y, x2, y2 = max(left - MARGIN, 0), max(top - MARGIN, 0), min(right + MARGIN, size[1]), min(bottom + MARGIN, size[0])
    soft = np.zeros((y2 - y, x2 - x), np.float32)
    soft[top - y : bottom - y, left - x : right - x] = mask.inside
    # What touches the border of the image goes on behind it.
    soft = np.asarray(cv2.GaussianBlur(soft, (0, 0), SOFT, borderType=cv2.BORDER_REPLICATE), np.float32)
    gx, gy = (
        np.asarray(cv2.Sobel(soft, cv2.CV_32F, dx, 1 - dx, ksize=1, scale=0.5, borderType=cv2.BORDER_REPLICATE), np.float32)
        for dx in (1, 0)
    )
    return (slice(y, y2), slice(x, x2)), gx, gy


def _is_ridge(strength: Map, cosine: Map, xy: Map) -> NDArray[np.bool_]:
    """Where (H, W) a strength is no lower than that of both neighbours along the normal, whose direction the others tell."""
    padded = cv2.copyMakeBorder(strength, 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    height, width = strength.shape

    def beside(dx: int, dy: int) -> Map:
        ahead, behind = (padded[1 + k * dy :, 1 + k * dx :][:height, :width] for k in (1, -1))
        return np.asarray(np.maximum(ahead, behind))

    upright = np.abs(cosine) > np.sqrt(0.5)
    straight = np.where(cosine > 0, beside(1, 0), beside(0, 1))
    slanted = np.where(xy > 0, beside(1, 1), beside(1, -1))
    return np.asarray(strength >= TIE * np.where(upright, straight, slanted))
