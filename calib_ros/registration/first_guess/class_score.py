"""How well labelled points meet pixels of their class: the score that judges first guesses."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.classes import SemanticClass
from calib_ros.errors import TooFewFeaturesError
from calib_ros.image.edges import EdgeLevel
from calib_ros.registration.atlas import Atlas
from calib_ros.registration.first_guess.class_view import MATCHED, ClassView
from calib_ros.registration.first_guess.confusions import taken_for
from calib_ros.registration.point_score import PointScore, ScoredPoints

Map = NDArray[np.float32]
BLUR_DEG = (
    3.0,
    1.2,
    0.65,
)  # blur of the class maps per level, coarse to fine; 0.5 is no better, and maps take 4 times the memory
MIN_CLASSES = 2  # one class alone is met by many extrinsics
MIN_POINTS = 100
MAX_VIEWS = 12  # more of them cost memory and time, and ten are sure already
CONFUSED = 0.35  # share of the labels that are taken to say nothing
RAREST = 0.02  # share of the image below which a class does not count as rarer: a few pixels of it are soon wrong


def spread(views: Sequence[ClassView]) -> list[ClassView]:
    """At most MAX_VIEWS of the views, from the first to the last."""
    chosen = np.linspace(0, len(views) - 1, min(len(views), MAX_VIEWS)).round().astype(int)
    return [views[k] for k in chosen]


def judged(views: Sequence[ClassView]) -> PointScore:
    """The score of all classes that some view shows on both sides. TooFewFeaturesError if they are too few, or hardly any point
    is of them."""
    common = sorted(set[int]().union(*(view.matched for view in views)))
    n_points = sum(int(np.isin(view.label, common).sum()) for view in views)
    if len(common) >= MIN_CLASSES and n_points >= MIN_POINTS:
        return class_score(views, common)
    names = ", ".join(SemanticClass(c).name.lower() for c in common) or "none"
    raise TooFewFeaturesError(
        f"a first guess needs {MIN_CLASSES} classes and {MIN_POINTS} points that images and clouds have in common; "
        f"{len(views)} frames have {n_points} points of {names} (of {', '.join(c.name.lower() for c in MATCHED)})"
    )


def class_score(views: Sequence[ClassView], classes: Sequence[int]) -> PointScore:
    """The score of the views' points of these classes, levels as of BLUR_DEG; 0 = as good as chance.

    A point of class c on a pixel around which the classes d have the shares p_d counts log((1 - e) sum_d m_cd p_d / q_d + e),
    q_d being the share of d in its image, m_cd how often c is taken for d, and e = CONFUSED: the log likelihood ratio of the
    pixel being a view of the point, or of anything. The image's mean is subtracted, so that what looks past the scene gains
    nothing by it. Points outside the image and pixels of unknown class count 0. Every frame weighs the same, and in it every
    class by the root of its points.
    """
    points = [_points(view, classes, j) for j, view in enumerate(views)]
    weight = np.concatenate([p.weight for p in points])
    joined = ScoredPoints(
        np.ascontiguousarray(np.concatenate([p.xyz for p in points], axis=1)),
        np.asarray(weight / weight.sum(), np.float32),
        np.concatenate([p.frame for p in points]),
        np.concatenate([p.channel for p in points]),
    )
    return PointScore(joined, Atlas([_levels(view, classes) for view in views], views[0].camera))


def _points(view: ClassView, classes: Sequence[int], frame: int) -> ScoredPoints:
    """The points of a view; their weights sum up to 1, if there are any."""
    number = np.full(256, -1)
    number[list(classes)] = np.arange(len(classes))
    used = np.flatnonzero(number[view.label] >= 0)
    channel = number[view.label[used]]
    weight = 1 / np.sqrt(np.bincount(channel, minlength=len(classes))[channel])
    weight = np.asarray(weight / max(weight.sum(), 1e-9), np.float32)
    return ScoredPoints(view.xyz[used].T, weight, np.full(len(used), frame, np.int32), channel)


def _levels(view: ClassView, classes: Sequence[int]) -> list[EdgeLevel]:
    """Maps of a view, one per class, on every level."""
    known = view.classes < len(SemanticClass)
    share = np.bincount(view.classes[known], minlength=len(SemanticClass)) / max(int(known.sum()), 1)
    seen = np.flatnonzero(share)
    evidence = (taken_for()[:, seen] / np.maximum(share[seen], RAREST))[list(classes)].astype(np.float32)
    height, width = known.shape
    levels = []
    for blur_deg in BLUR_DEG:
        blur = np.deg2rad(blur_deg) * float(view.camera.K[0, 0]) / view.scale
        shrink = 1 << int(np.log2(min(max(blur / 2, 1), height, width)))
        told = _blurred(known, blur, shrink)
        parts = [_blurred(view.classes == d, blur, shrink) / np.maximum(told, 1e-3) for d in seen]
        p = np.stack(parts) if parts else np.zeros((0, *told.shape), np.float32)
        ratio = np.log((1 - CONFUSED) * np.tensordot(evidence, p, axes=1) + CONFUSED)
        mean = (ratio * (told + 1e-6)).sum(axis=(1, 2)) / float((told + 1e-6).sum())
        levels.append(
            EdgeLevel((told * (ratio - mean[:, None, None])).astype(np.float32), view.scale * shrink, blur * view.scale)
        )
    return levels


def _blurred(mask: NDArray[np.bool_], blur: float, shrink: int) -> Map:
    """Shares (h // shrink, w // shrink) of a mask (h, w) around every pixel; blur: px of the mask."""
    height, width = mask.shape[0] // shrink, mask.shape[1] // shrink
    part = mask[: height * shrink, : width * shrink].astype(np.float32)
    small = cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(small, (0, 0), max(blur / shrink, 0.5), borderType=cv2.BORDER_REPLICATE), np.float32)
