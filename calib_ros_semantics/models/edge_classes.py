"""What the classes of points and pixels mean for edges and frames: weights by class, and which image edges an edge may meet
(thesis 3.6, eq. 3.16, outlook 5.3)."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.config import SemanticsConfig
from calib_ros.frame import MAIN_CLASSES, UNLABELLED
from calib_ros.frame import SemanticClass as C
from calib_ros.image.edges import EdgeLevel

Map = NDArray[np.float32]
Classes = NDArray[np.uint8]
GROUPS = ((C.VEHICLE,), (C.PERSON, C.CYCLIST, C.POLE, C.SIGN))  # of classes whose edges are matched among themselves
GATE_PX = 6.0  # px at 1242 px image width; borders of class maps are off by as much
FEW_FRAMES_SHARE = 0.05  # added to the share of main classes, so that frames without any keep a part of their weight


def gates(classes: Classes) -> list[Map]:
    """Classes of pixels (H, W) -> for each of GROUPS where its edges may lie, (H, W) float32 0..1: on it, close around, and where
    nobody knows the class."""
    size = 2 * max(round(GATE_PX * classes.shape[1] / 1242), 1) + 1
    out = []
    for group in GROUPS:
        own = np.isin(classes, (*group, UNLABELLED)).astype(np.uint8)
        wide = cv2.dilate(own, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))
        out.append(np.asarray(cv2.GaussianBlur(wide.astype(np.float32), (0, 0), size / 6), np.float32))
    return out


def gated(levels: Sequence[EdgeLevel], classes: Classes, local_contrast: bool = False) -> list[EdgeLevel]:
    """Levels with two maps, of an image whose pixels have classes (H, W) -> the same with two more maps for each of GROUPS.

    These have mean 0, too, but keep the unit of the ungated maps. Standardised by themselves they would count the more the less
    their gates let through: on a KITTI scene vehicles then outvoted all else five times over, and the optimum lay 1 deg off.
    local_contrast: the maps are relative to their local mean (see image.edges).
    """
    open_for = gates(classes)
    return [
        EdgeLevel.of(np.concatenate([level.maps, *_behind(open_for, level, local_contrast)]), level.scale, level.sigma)
        for level in levels
    ]


def _behind(open_for: Sequence[Map], level: EdgeLevel, local_contrast: bool) -> list[Map]:
    """The level's maps (2, h, w) behind each of the gates (H, W)."""
    height, width = level.packed.shape[1:]
    # A map stands for whole cells of pixels only; 0 is its mean, and the least value in it stands for no edge, unless it is
    # relative to its local mean: then that is 0.
    strength = level.maps
    if not local_contrast:
        strength = strength - strength.min(axis=(1, 2), keepdims=True)
    out = []
    for gate in open_for:
        own = cv2.resize(gate[: height * level.scale, : width * level.scale], (width, height), interpolation=cv2.INTER_AREA)
        let_through = strength * own
        out.append(np.asarray(let_through - let_through.mean(axis=(1, 2), keepdims=True), np.float32))
    return out


def channels(label: Classes) -> NDArray[np.intp]:
    """Classes of edge points (n,) -> number of the pair of maps that each is matched with: 0 = edges of anything."""
    table = np.zeros(256, np.intp)
    for k, group in enumerate(GROUPS):
        table[list(group)] = k + 1
    return np.asarray(table[label])


def edge_weights(label: Classes, config: SemanticsConfig) -> Map:
    """Classes of edge points (n,) -> their weights (n,)."""
    table = np.full(256, config.weight_other, np.float32)
    for cls, weight in (
        (C.VEHICLE, config.weight_vehicle),
        (C.PERSON, config.weight_person),
        (C.CYCLIST, config.weight_person),
        (C.POLE, config.weight_pole),
        (C.SIGN, config.weight_pole),
        (C.BUILDING, config.weight_building),
        (C.VEGETATION, config.weight_vegetation),
        (C.GROUND, config.weight_ground),
    ):
        table[cls] = weight
    return np.asarray(table[label])


def importance(classes: Classes) -> float | None:
    """w_j of eq. 3.16: the share of the main classes among the pixels (H, W) whose class is known; None if none is."""
    count = np.bincount(classes.ravel(), minlength=256)
    known = count.sum() - count[UNLABELLED]
    return None if known == 0 else float(count[list(MAIN_CLASSES)].sum() / known)


def frame_weights(shares: Sequence[float | None]) -> NDArray[np.float64]:
    """w_j of several frames (n,), of mean 1. One whose classes are not known, as they come later than the frame, weighs 1."""
    known = np.array([s for s in shares if s is not None])
    if not len(known):
        return np.ones(len(shares))
    mean = float(known.mean()) + FEW_FRAMES_SHARE
    return np.array([1.0 if s is None else (s + FEW_FRAMES_SHARE) / mean for s in shares])
