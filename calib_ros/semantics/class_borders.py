"""Semantic edges without masks: the borders of classes, as strong as the classes on both sides are sure (thesis 3.4.2).

They are split by their direction as the boundaries of masks are, see segment_anything/mask_edges.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.frame import UNLABELLED, SemanticClass
from calib_ros.semantics.labels import Classes

Map = NDArray[np.float32]
C = SemanticClass
# What a border of each class counts; of two classes that meet the higher one does. With 1 for all of them, one fewer of 26 hard
# trials with single frames of KITTI (drive 0005, odometry 00) succeeds. OTHER has no weight of its own, but what it meets has.
WEIGHTS = {
    **dict.fromkeys((C.VEHICLE, C.PERSON, C.CYCLIST, C.POLE, C.SIGN, C.SKY), 1.0),
    **dict.fromkeys((C.BUILDING, C.VEGETATION, C.GROUND), 0.4),
}
# Cells along the longer side of the planes, half of KITTI's width: finer ones take time, and few networks give them.
CELLS = 640
FIT = (0.75, 1.25)  # planes that have so many of these cells stay as they are
# Sobel's kernels of 7 cells are those of 3 cells after a binomial blur of 1 cell, which takes the stairs from a border.
APERTURE, SUMS = 7, 64 * 32  # SUMS: of the smoothing kernel, and what makes the slope of x itself 1
STEP = 5 / 16  # slope beside a step from 0 to 1 between two cells, blurred so
FRAME = 4  # px; at the border of the image networks see half of everything, and it is no border of anything
SURE = 0.01  # by which the sum of probabilities may differ from 1
TINY = np.float32(1e-6)


def borders_of_scores(scores: NDArray[Any], meaning: Classes, size: tuple[int, int]) -> Map:
    """Borders (2, H, W) in a size (height, width) of the scores (C, h, w) of a network, before or after its softmax.

    meaning: SemanticClass (C,) of each of its classes. Cells cover equal parts of the image, as in label_output.best. Where a
    score is no number there is no border.
    """
    found = np.stack([_fitted(np.ascontiguousarray(plane, np.float32), size) for plane in scores])
    if not _are_probabilities(scores):
        with np.errstate(invalid="ignore"):  # an infinite score leaves NaN
            found -= found.max(axis=0)
        np.exp(found, out=found)
        found /= found.sum(axis=0)
    return class_borders({int(c): found[meaning == c].sum(axis=0) for c in np.unique(meaning)}, size)


def borders_of_classes(classes: Classes) -> Map:
    """Borders (2, H, W) of SemanticClass (H, W), all of which are sure."""
    present = np.flatnonzero(np.bincount(classes.ravel(), minlength=256)).tolist()
    return class_borders({c: _fitted(np.asarray(classes == c, np.float32), classes.shape) for c in present}, classes.shape)


def class_borders(planes: Mapping[int, Map], size: tuple[int, int]) -> Map:
    """Borders (2, H, W) float32 in 0..1 of probabilities (h, w) by SemanticClass, in a size (height, width).

    [0] horizontal gradients (vertical lines), [1] vertical ones: for the slope m of a class's probability, as a share of that of
    a full step, and its weight w, w m cos^2 and w m sin^2 of its direction; of all classes the highest counts. What slopes
    towards UNLABELLED is no border: nobody knows where anything ends there.
    """
    shape = next(iter(planes.values())).shape
    borders = np.zeros((2, *shape), np.float32)
    unknown = planes.get(UNLABELLED)
    lost = None if unknown is None else np.sqrt(sum(_squares(unknown)))
    for number, weight in WEIGHTS.items():
        if number not in planes:
            continue
        squares = _squares(planes[number])
        slope = np.sqrt(squares[0] + squares[1])
        if lost is None:
            share = np.float32(weight) / (slope + TINY)
        else:
            share = np.float32(weight) * np.maximum(slope - lost, 0) / (slope * slope + TINY)
        for border, square in zip(borders, squares, strict=True):
            square *= share
            np.fmax(border, square, out=border)  # which passes over NaN
    np.minimum(borders, 1, out=borders)
    if shape != size:
        resized = [cv2.resize(border, size[::-1], interpolation=cv2.INTER_LINEAR) for border in borders]
        borders = np.asarray(resized, np.float32)
    for edge in (borders[:, :FRAME], borders[:, -FRAME:], borders[:, :, :FRAME], borders[:, :, -FRAME:]):
        edge[:] = 0
    return borders


def _squares(plane: Map) -> list[Map]:
    """Squares of the slopes (h, w) to the right and downwards, as shares of that of a full step."""
    slopes = [
        cv2.Sobel(plane, cv2.CV_32F, dx, 1 - dx, ksize=APERTURE, scale=1 / (SUMS * STEP), borderType=cv2.BORDER_REPLICATE)
        for dx in (1, 0)
    ]
    return [np.asarray(slope * slope, np.float32) for slope in slopes]


def _fitted(plane: Map, size: tuple[int, int]) -> Map:
    """A plane (h, w) of an image of a size in as many cells as the slopes are taken from."""
    scale = min(1.0, CELLS / max(size))
    rows, columns = (max(round(n * scale), 1) for n in size)
    if FIT[0] <= plane.shape[1] / columns <= FIT[1]:
        return plane
    how = cv2.INTER_AREA if plane.shape[1] > columns else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(plane, (columns, rows), interpolation=how), np.float32)


def _are_probabilities(scores: NDArray[Any]) -> bool:
    """Whether a sample of scores (C, h, w) has been through a softmax already."""
    sample = scores[:, ::8, ::8].astype(np.float32)
    return bool(sample.min() >= 0 and np.abs(sample.sum(axis=0) - 1).max() < SURE)
