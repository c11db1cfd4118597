"""Semantic edges without masks: the borders of classes, weighted by the probabilities on both sides (thesis 3.4.2)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.frame import UNLABELLED, SemanticClass
from calib_ros_semantics.models.labels import Classes
from calib_ros_semantics.models.tiles import enlarged, is_softmax, softmax

Map = NDArray[np.float32]
C = SemanticClass
# Weight of the borders of each class; of two classes the higher one counts. With 1 for all of them, one fewer of 26 hard trials
# with single frames of KITTI (drive 0005, odometry 00) succeeds. OTHER has no weight of its own, but its neighbours have.
WEIGHTS = {
    **dict.fromkeys((C.VEHICLE, C.PERSON, C.CYCLIST, C.POLE, C.SIGN, C.SKY), 1.0),
    **dict.fromkeys((C.BUILDING, C.VEGETATION, C.GROUND), 0.4),
}
# Cells along the longer side of the planes, half of KITTI's width: finer ones take time, and few networks provide them.
MAX_CELLS = 640
CELL_RATIO = (0.75, 1.25)  # planes with a number of cells in this range are not resized
# Sobel's kernels of 7 cells are those of 3 cells after a binomial blur of 1 cell, which smooths the stairs of a border.
APERTURE, KERNEL_GAIN = 7, 64 * 32  # KERNEL_GAIN makes the slope of a ramp of 1 per cell 1
STEP_SLOPE = 5 / 16  # slope beside a step from 0 to 1 between two cells, blurred so
IMAGE_BORDER = 4  # px; the border of the image is none of a class or a mask
EPSILON = np.float32(1e-6)


class PixelClasses(NamedTuple):
    """classes: (H, W) uint8 SemanticClass, UNLABELLED where unknown. borders: (2, H, W), if requested."""

    classes: Classes
    borders: Map | None


def borders_of_scores(scores: NDArray[Any], meaning: Classes, size: tuple[int, int]) -> Map:
    """Borders (2, H, W) at a size (height, width) from the scores (C, h, w) of a network, before or after its softmax.

    meaning: SemanticClass (C,) of each of its classes. NaN scores have no border.
    """
    found = np.stack([_fitted(np.ascontiguousarray(plane, np.float32), size) for plane in scores])
    if not is_softmax(scores):
        softmax(found)
    return class_borders({int(c): found[meaning == c].sum(axis=0) for c in np.unique(meaning)}, size)


def borders_of_classes(classes: Classes) -> Map:
    """Borders (2, H, W) of SemanticClass (H, W) without probabilities."""
    present = np.flatnonzero(np.bincount(classes.ravel(), minlength=256)).tolist()
    return class_borders({c: _fitted(np.asarray(classes == c, np.float32), classes.shape) for c in present}, classes.shape)


def class_borders(planes: Mapping[int, Map], size: tuple[int, int]) -> Map:
    """Borders (2, H, W) float32 in 0..1 of probabilities (h, w) by SemanticClass, at a size (height, width).

    [0] horizontal gradients (vertical lines), [1] vertical ones: w m cos^2 and w m sin^2 of the direction of a class's slope m,
    relative to a full step, by its weight w; the maximum over all classes. Slopes towards UNLABELLED are not borders.
    """
    shape = next(iter(planes.values())).shape
    borders = np.zeros((2, *shape), np.float32)
    unknown = planes.get(UNLABELLED)
    unknown_slope = None if unknown is None else np.sqrt(sum(_squares(unknown)))
    for number, weight in WEIGHTS.items():
        if number not in planes:
            continue
        squares = _squares(planes[number])
        slope = np.sqrt(squares[0] + squares[1])
        if unknown_slope is None:
            share = np.float32(weight) / (slope + EPSILON)
        else:
            share = np.float32(weight) * np.maximum(slope - unknown_slope, 0) / (slope * slope + EPSILON)
        for border, square in zip(borders, squares, strict=True):
            square *= share
            np.fmax(border, square, out=border)  # ignores NaN
    np.minimum(borders, 1, out=borders)
    if shape != size:
        borders = np.stack([enlarged(border, size) for border in borders])
    clear_border(borders)
    return borders


def clear_border(edges: Map) -> None:
    """Set edges (..., H, W) near the border of the image to 0: what ends there mostly goes on beyond it."""
    for ends in (np.s_[:IMAGE_BORDER], np.s_[-IMAGE_BORDER:]):
        edges[..., ends, :] = edges[..., ends] = 0


def _squares(plane: Map) -> list[Map]:
    """Squared slopes (h, w) to the right and downwards, relative to a full step."""
    scale, border = 1 / (KERNEL_GAIN * STEP_SLOPE), cv2.BORDER_REPLICATE
    slopes = (cv2.Sobel(plane, cv2.CV_32F, dx, 1 - dx, ksize=APERTURE, scale=scale, borderType=border) for dx in (1, 0))
    return [np.asarray(slope * slope, np.float32) for slope in slopes]


def _fitted(plane: Map, size: tuple[int, int]) -> Map:
    """A plane (h, w) of an image of a size, resized to the number of cells from which slopes are taken."""
    scale = min(1.0, MAX_CELLS / max(size))
    rows, columns = (max(round(n * scale), 1) for n in size)
    if CELL_RATIO[0] <= plane.shape[1] / columns <= CELL_RATIO[1]:
        return plane
    how = cv2.INTER_AREA if plane.shape[1] > columns else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(plane, (columns, rows), interpolation=how), np.float32)
