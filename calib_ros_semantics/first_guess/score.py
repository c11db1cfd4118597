"""How well labelled points meet pixels of their class: the score of first guesses and of semantic consistency."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.errors import TooFewFeaturesError
from calib_ros.frame import SemanticClass as C
from calib_ros.image.edges import EdgeLevel
from calib_ros.registration.initial_guess import MAX_DISTANCE_M, allowed, near_lidar, rotation_distance_deg
from calib_ros.registration.score.atlas import Atlas
from calib_ros.registration.score.chance import EvenPoints
from calib_ros.registration.score.point_score import PointScore, SmoothScore
from calib_ros.registration.score.sampler import MIN_DEPTH
from calib_ros.registration.search.constraints import Limits, Prior
from calib_ros.registration.search.optimizers import levenberg_marquardt
from calib_ros_semantics.first_guess.view import MATCHED, ClassView

Matrix = NDArray[np.float64]
Map = NDArray[np.float32]

# Class maps.
# Blur per level in deg, coarse to fine; 0.5 is no better, and maps take 4 times the memory.
BLUR_DEG = (3.0, 1.2, 0.65)
MIN_CLASSES = 2  # one class alone is met by many extrinsics
MIN_POINTS = 100
MAX_VIEWS = 12  # more of them cost memory and time, and ten are sure already
CONFUSED = 0.35  # share of the labels that are taken to say nothing
RAREST = 0.02  # share of the image below which a class does not count as rarer: a few pixels of it are soon wrong

# Share of the pixels of a class, in percent, that networks give to another: half of what the network trained on CamVid does with
# the validated places of CamVid, of which the frames that the guess is measured on are none; larger networks confuse less.
# With it one of the guesses is near the truth for 15 of 20 single KITTI frames, without for 13, with all of it for 15.
CONFUSION_PERCENT = {
    C.OTHER: {C.VEHICLE: 2, C.PERSON: 2, C.POLE: 2, C.BUILDING: 2, C.VEGETATION: 19},
    C.VEHICLE: {C.PERSON: 1, C.BUILDING: 3, C.VEGETATION: 1, C.GROUND: 1},
    C.PERSON: {C.OTHER: 2, C.VEHICLE: 3, C.CYCLIST: 3, C.POLE: 2, C.BUILDING: 4, C.VEGETATION: 1, C.GROUND: 2},
    C.CYCLIST: {C.OTHER: 1, C.VEHICLE: 20, C.PERSON: 14, C.BUILDING: 1, C.VEGETATION: 3, C.GROUND: 2},
    C.POLE: {C.OTHER: 2, C.VEHICLE: 1, C.PERSON: 2, C.SIGN: 1, C.BUILDING: 10, C.VEGETATION: 8, C.GROUND: 2, C.SKY: 1},
    C.SIGN: {C.OTHER: 3, C.VEHICLE: 1, C.PERSON: 1, C.POLE: 7, C.BUILDING: 22, C.VEGETATION: 11},
    C.BUILDING: {C.OTHER: 4, C.VEHICLE: 1, C.PERSON: 1, C.POLE: 1, C.SIGN: 1, C.VEGETATION: 2, C.GROUND: 1, C.SKY: 1},
    C.VEGETATION: {C.SIGN: 1, C.BUILDING: 1, C.SKY: 1},
    C.SKY: {C.VEGETATION: 4},
}

# Positions: a turn and a shift look alike on class maps.
AROUND, AROUND_DEG = 512, 4.0  # places and turns tried around a hypothesis: those of 5 to 10 frames were at most 3.3 deg off
PLACES = 6  # of these, those that are optimised
COARSE_POINTS, FINE_POINTS = 3000, 12000
SAME_DEG, SAME_M = 2.0, 0.5  # hypotheses that are nearer than both are one
LEAST_IN_VIEW = 0.5  # of what hypotheses have in view in the middle
BATCH = 1 << 18  # points of a batch of extrinsics
# Of the score per level, at a camera distance_m / 2 from the LiDAR. On coarse maps a shift hardly differs from a turn; on fine
# ones a strong prior drags: with damaged labels of 10 frames 4 of 12 guesses were nearer than 0.5 m with 0.03 on all levels, 9
# with 0.01, and 10 with these.
PRIOR_STRENGTH = (0.03, 0.01, 0.003)


def select_views(views: Sequence[ClassView]) -> list[ClassView]:
    """At most MAX_VIEWS of the views, from the first to the last."""
    picked = np.linspace(0, len(views) - 1, min(len(views), MAX_VIEWS)).round().astype(int)
    return [views[k] for k in picked]


def label_score(views: Sequence[ClassView]) -> PointScore:
    """The score of all classes that some view shows on both sides. TooFewFeaturesError if these or their points are too few."""
    common = sorted(set[int]().union(*(view.matched for view in views)))
    n_points = sum(int(np.isin(view.label, common).sum()) for view in views)
    if len(common) >= MIN_CLASSES and n_points >= MIN_POINTS:
        return class_score(views, common)
    names = ", ".join(C(c).name.lower() for c in common) or "none"
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
    xyz, weight, frame, channel = (np.concatenate(parts, axis=-1) for parts in zip(*points, strict=True))
    atlas = Atlas([_levels(view, classes) for view in views], views[0].camera)
    return PointScore(xyz, np.asarray(weight / weight.sum(), np.float32), frame, channel, atlas)


def refine_positions(score: PointScore, transforms: Matrix, seed: int) -> tuple[Matrix, Matrix, NDArray[np.intp]]:
    """Hypotheses (k, 4, 4) by the points in view, from those of (j, 4, 4) and places around each: best first, their scores (k,)
    and which of the given ones each is from (k,).

    Places of one direction are compared by the mean of what is in view, directions by that mean times the root of the share in
    view at their best place: the noise of a mean falls with the root of its points.
    """
    few, all_points = (score.subset(n, np.random.default_rng(seed)) for n in (COARSE_POINTS, FINE_POINTS))
    middle, fine = score.n_levels - 2, score.n_levels - 1
    least = LEAST_IN_VIEW * float(np.median(InViewScore(few, middle).share(transforms)))
    parts = {level: InViewScore(few, level, least) for level in (middle, fine)}
    found, origin = [], []
    for j, T in enumerate(transforms):
        tried = around(T, seed)
        order = np.argsort(-parts[middle].values(tried), kind="stable")[:PLACES]
        for own in tried[np.union1d(order, [0])]:
            for level, part in parts.items():
                own = local_optimum(part, level, own)
            found.append(own)
            origin.append(j)
    ends, source = np.array(found), np.array(origin)
    inside = allowed(ends)
    ends, source = ends[inside], source[inside]
    values = np.zeros(0)
    if len(ends):
        # Those of one direction, from wherever they started, are compared by their means.
        view = InViewScore(all_points, fine, least)
        values, share = view.values(ends), view.share(ends)
        left = np.argsort(-values, kind="stable")
        while len(left):
            near = rotation_distance_deg(ends[left], ends[left[0]]) <= AROUND_DEG
            values[left[near]] *= np.sqrt(share[left[0]])
            left = left[~near]
    kept = distinct(ends, values, SAME_DEG, SAME_M)
    kept = kept[values[kept] > 0]  # the others see nothing of the scene
    return ends[kept], values[kept], source[kept]


def local_optimum(score: SmoothScore, level: int, T: Matrix) -> Matrix:
    """The optimum that T (4, 4) leads to on a level, not far from the LiDAR."""
    limits: Limits = near_lidar(T)
    prior = Prior(limits.T, np.array([0.0] * 3 + [2 * PRIOR_STRENGTH[level] / (MAX_DISTANCE_M / 2) ** 2] * 3))
    return levenberg_marquardt(score, T, 12, prior, limits, tolerance_deg=0.02)[0]


class InViewScore:
    """The mean of a score's map values over those of its points that are in view; a SmoothScore.

    The sum over all points grows with what is in view, and a camera that is moved back has more of the road and of the cars
    beside it in view: on ten KITTI frames it is a tenth higher 1.3 m behind the truth, while the mean is highest at the truth.
    least: share of the weight that counts as in view at least, lest a few points be all that is looked at.
    """

    def __init__(self, score: PointScore, level: int, least: float = 0.02) -> None:
        self.score, self.level, self.least = score, level, least
        self._last: tuple[Matrix, float] | None = None  # an optimiser asks for the slope where it asked for the value before

    def share(self, transforms: Matrix) -> Matrix:
        """Share (k,) of the weight that is in view at each of (k, 4, 4)."""
        own, points = self.score.atlas.levels[self.level], self.score.points
        K, step, out = own.K.astype(np.float32), max(BATCH // points.shape[1], 1), []
        for k in range(0, len(transforms), step):
            T = transforms[k : k + step].astype(np.float32)
            y = ((K @ T[:, :3, :3]).reshape(-1, 3) @ points).reshape(len(T), 3, -1) + K @ T[:, :3, 3:]
            u, v, z = y[:, 0], y[:, 1], y[:, 2]
            inside = (z > MIN_DEPTH) & (u >= 0) & (v >= 0) & (u <= (own.width - 1) * z) & (v <= (own.height - 1) * z)
            out.append(inside @ self.score.weights)
        return np.maximum(np.concatenate(out), self.least)

    def values(self, transforms: Matrix) -> Matrix:
        """The mean (k,) at each of (k, 4, 4)."""
        return self.score.values(transforms, self.level) / self.share(transforms)

    def value(self, T: Matrix) -> float:
        """The mean at T (4, 4)."""
        return self.score.at(self.level).value(T) / self._share(T)

    def linearise(self, T: Matrix) -> tuple[Matrix, Matrix]:
        """Gradient (6,) and Gauss-Newton scale (6, 6), those in view taken to stay."""
        gradient, scale = self.score.at(self.level).linearise(T)
        return gradient / self._share(T), scale / self._share(T)

    def _share(self, T: Matrix) -> float:
        if self._last is None or not np.array_equal(self._last[0], T):
            self._last = T.copy(), float(self.share(T[None])[0])
        return self._last[1]


def around(T: Matrix, seed: int) -> Matrix:
    """T (4, 4), and extrinsics of about the same viewing direction from anywhere near the LiDAR (k, 4, 4)."""
    unit = EvenPoints(6, seed=seed).next(AROUND)
    out = se3.exp_many(np.pad(np.deg2rad(AROUND_DEG) * unit[:, :3], ((0, 0), (0, 3)))) @ se3.from_parts(T[:3, :3], np.zeros(3))
    out[:, :3, 3] = -np.einsum("kij,kj->ki", out[:, :3, :3], MAX_DISTANCE_M / np.sqrt(3) * unit[:, 3:])
    out[0] = T
    return out


def distinct(transforms: Matrix, values: Matrix, gap_deg: float, gap_m: float = np.inf) -> NDArray[np.intp]:
    """Indices of the extrinsics (k, 4, 4) best first, without those that a better one is nearer to than both gaps."""
    left, picked = np.argsort(-values, kind="stable"), []
    while len(left):
        best, left = left[0], left[1:]
        picked.append(best)
        apart = rotation_distance_deg(transforms[left], transforms[best]) > gap_deg
        apart |= np.linalg.norm(centres(transforms[left]) - centres(transforms[best][None]), axis=1) > gap_m
        left = left[apart]
    return np.array(picked, np.intp)


def centres(transforms: Matrix) -> Matrix:
    """Where the cameras of (k, 4, 4) stand in the LiDAR frame, (k, 3) m."""
    return np.asarray(-np.einsum("kji,kj->ki", transforms[:, :3, :3], transforms[:, :3, 3]))


def _points(view: ClassView, classes: Sequence[int], frame: int) -> tuple[NDArray[Any], ...]:
    """The points of a view as PointScore takes them; their weights sum up to 1, if there are any."""
    number = np.full(256, -1)
    number[list(classes)] = np.arange(len(classes))
    used = np.flatnonzero(number[view.label] >= 0)
    channel = number[view.label[used]]
    weight = 1 / np.sqrt(np.bincount(channel, minlength=len(classes))[channel])
    weight = np.asarray(weight / max(weight.sum(), 1e-9), np.float32)
    return view.xyz[used].T, weight, np.full(len(used), frame, np.int32), channel


def _levels(view: ClassView, classes: Sequence[int]) -> list[EdgeLevel]:
    """Maps of a view, one per class, on every level."""
    known = view.classes < len(C)
    share = np.bincount(view.classes[known], minlength=len(C)) / max(int(known.sum()), 1)
    present = np.flatnonzero(share)
    confusion = np.zeros((len(C), len(C)))  # share of the pixels of a class (row) that are labelled as another (column)
    for own, others in CONFUSION_PERCENT.items():
        confusion[own, list(others)] = np.array(list(others.values())) / 100
    np.fill_diagonal(confusion, 1 - confusion.sum(axis=1))
    evidence = (confusion[:, present] / np.maximum(share[present], RAREST))[list(classes)].astype(np.float32)
    height, width = known.shape
    levels = []
    for blur_deg in BLUR_DEG:
        blur = np.deg2rad(blur_deg) * float(view.camera.K[0, 0]) / view.scale
        shrink = 1 << int(np.log2(min(max(blur / 2, 1), height, width)))
        labelled = _blurred(known, blur, shrink)
        parts = [_blurred(view.classes == d, blur, shrink) / np.maximum(labelled, 1e-3) for d in present]
        p = np.stack(parts) if parts else np.zeros((0, *labelled.shape), np.float32)
        ratio = np.log((1 - CONFUSED) * np.tensordot(evidence, p, axes=1) + CONFUSED)
        mean = (ratio * (labelled + 1e-6)).sum(axis=(1, 2)) / float((labelled + 1e-6).sum())
        maps = (labelled * (ratio - mean[:, None, None])).astype(np.float32)
        levels.append(EdgeLevel.of(maps, view.scale * shrink, blur * view.scale))
    return levels


def _blurred(mask: NDArray[np.bool_], blur: float, shrink: int) -> Map:
    """Shares (h // shrink, w // shrink) of a mask (h, w) around every pixel; blur: px of the mask."""
    height, width = mask.shape[0] // shrink, mask.shape[1] // shrink
    part = mask[: height * shrink, : width * shrink].astype(np.float32)
    small = cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(small, (0, 0), max(blur / shrink, 0.5), borderType=cv2.BORDER_REPLICATE), np.float32)
