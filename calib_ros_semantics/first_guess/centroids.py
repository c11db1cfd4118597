"""The first guess from centroids (thesis 3.5, figure 3.20): objects of image and cloud, pairs, and what many of them agree on.

The camera is near the LiDAR against the distance of most objects: the angle between two objects is about the same from both,
whatever the extrinsic. Two pairs of a frame for which it is give a rotation, one pair gives that of a camera that is upright;
those on which most pairs of all frames agree start the PnP problem of all of their centroids together.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import TooFewFeaturesError
from calib_ros.frame import MAIN_CLASSES
from calib_ros.frame import SemanticClass as C
from calib_ros.lidar.segmentation import cluster
from calib_ros.registration.initial_guess import MAX_DISTANCE_M, MAX_TILT_DEG, allowed, near_lidar, poses
from calib_ros.registration.search.constraints import Prior
from calib_ros.registration.search.optimizers import levenberg_marquardt
from calib_ros_semantics.first_guess.score import distinct
from calib_ros_semantics.first_guess.view import CELL_DEG, ClassView
from calib_ros_semantics.models.cluster_shapes import split_by_group

Matrix = NDArray[np.float64]

# Objects: what is connected as seen from the sensor, whatever its distance; cars in a row are one to image and cloud alike.
LINK_DEG = (3 * CELL_DEG, 2.1)  # sideways and upward; scanners of 16 rings have gaps of 2 deg
SURFACE_LINK_DEG = (3.0, 4.2)  # of surfaces, of which views keep fewer points
LINKS = {**dict.fromkeys(MAIN_CLASSES, LINK_DEG), **dict.fromkeys((C.BUILDING, C.VEGETATION), SURFACE_LINK_DEG)}
WHOLE, LEFT, RIGHT = 0, len(C), 2 * len(C)  # kinds, added to classes: an object, or that end of it
END_DEG = 3.0  # of an object's width; wider than links, so that gaps of the scan do not hide it
MIN_POINTS = 4  # a person at 30 m has about 10
MIN_AREA_DEG2 = 0.2  # of the image; smaller ones are too far away to be objects of the cloud
MIN_INLIERS = 3  # objects, as in the thesis
# Pairs.
SIZE_RATIO = 2.5  # of widths; heights differ, since the LiDAR's field of view is low
RESOLUTION_DEG = 0.5  # of centroids; about a cell of the view
PART = (0.1, 0.2)  # of extents, and of what they differ by: how much centroids move where an object is seen in part
STRAY = 0.4  # share of the pairs that are off by more: about half of the object, where something hides it
BASELINE_M = 0.6  # what the parallax of pairs is taken for while the translation is unknown
# Hypotheses.
DRAWS = 40_000  # of two pairs of a frame, of which few can be right
NEAREST_DEG = 5.0  # between two objects; nearer ones hardly fix a rotation
EVALUATED, BATCH = 4_000_000, 100_000  # pairs at hypotheses, altogether and at a time
STARTS, FURTHER = 10, 200  # hypotheses of which the PnP problem is solved, and those that only maps of classes judge
SAME_DEG = (3.0, 2.0)  # nearer hypotheses are one, before and after the PnP problem
PARALLAX_LEVELS = (1.0, 0.4, 0.0)  # of BASELINE_M, as the translation is found
ROUND_DEG2 = 360 * 10.0  # of all directions, where objects may be: near the horizon
OBJECT_WEIGHT = 0.3  # of an object beside a point: frames show the same one again, so that what repeats itself agrees by chance
HIT_RATES = np.array([0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 0.9])  # tried for every class; what networks find differs much


# Objects of frames and their ends. cls: class plus kind. position: unit vector to one of an image in the camera frame, or the
# middle of one of a cloud, m. extent: deg, sideways and upward. width: deg, of the whole object, as far as it is seen.
OBJECT = np.dtype([("frame", np.intp), ("cls", np.intp), ("position", float, 3), ("extent", float, 2), ("width", float)])
Objects = np.recarray[Any, np.dtype[Any]]


def _objects(found: Sequence[tuple[int, int, Matrix, Matrix, float]]) -> Objects:
    return np.array(found, OBJECT).view(np.recarray)


def image_objects(views: Sequence[ClassView]) -> Objects:
    """Regions of a class whose parts are nearer than its link, without small ones; of those that the image's left or right border
    cuts, the end that is in view."""
    found = []
    for number, view in enumerate(views):
        K, width = view.camera.K, view.classes.shape[1]
        per_pixel = float(np.rad2deg(view.scale / K[0, 0]))
        for c, link in LINKS.items():
            mask = (view.classes == c).astype(np.uint8)
            if not mask.any():
                continue
            size = [max(round(own / per_pixel), 1) | 1 for own in link]
            kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, size)
            _, region = cv2.connectedComponents(cv2.dilate(mask, kernel), connectivity=8)
            rows, columns = np.nonzero(mask)
            for own in split_by_group(np.arange(len(rows)), region[rows, columns] - 1):
                u, v = columns[own], rows[own]
                low, high = int(u.min()), int(u.max())
                cut = low == 0, high == width - 1
                if len(own) * per_pixel**2 < MIN_AREA_DEG2 or all(cut):
                    continue
                kind, wide = (RIGHT if cut[0] else LEFT if cut[1] else WHOLE), per_pixel * (high - low + 1)
                if kind != WHOLE:
                    end = (u > high - END_DEG / per_pixel) if kind == RIGHT else (u < low + END_DEG / per_pixel)
                    u, v = u[end], v[end]
                pixel = (np.array([u.mean(), v.mean()]) + 0.5) * view.scale - 0.5
                ray = np.append((pixel - K[:2, 2]) / (K[0, 0], K[1, 1]), 1.0)
                extent = per_pixel * np.array([np.ptp(u) + 1.0, np.ptp(v) + 1.0])
                found.append((number, kind + int(c), ray / np.linalg.norm(ray), extent, wide))
    return _objects(found)


def cloud_objects(views: Sequence[ClassView]) -> Objects:
    """Points of a class whose directions are nearer than its link, and both their ends; all points of a direction count the same,
    as pixels do."""
    found = []
    for number, view in enumerate(views):
        distance = np.maximum(np.linalg.norm(view.xyz, axis=1), 1e-3)
        azimuth = np.rad2deg(np.arctan2(view.xyz[:, 1], view.xyz[:, 0]))
        elevation = np.rad2deg(np.arcsin(view.xyz[:, 2] / distance))
        for c, link in LINKS.items():
            own = np.flatnonzero(view.label == c)
            around = np.exp(1j * np.deg2rad(azimuth[own])) * np.rad2deg(1) / link[0]
            member = cluster(np.c_[around.real, around.imag, elevation[own] / link[1]].astype(np.float32), 1.0, 2)
            for part in split_by_group(own[member >= 0], member[member >= 0]):
                if len(part) < MIN_POINTS:
                    continue
                turned = np.sort(azimuth[part])
                gaps = np.diff(turned, append=turned[0] + 360)
                first = turned[(gaps.argmax() + 1) % len(turned)]  # the right end; what is all around ends at its widest gap
                left = (azimuth[part] - first) % 360
                wide = float(left.max())
                for kind, end in (WHOLE, left >= 0), (LEFT, left > wide - END_DEG), (RIGHT, left < END_DEG):
                    few = part[end]
                    direction = (view.xyz[few] / distance[few, None]).mean(axis=0, dtype=np.float64)
                    middle = direction / np.linalg.norm(direction) / (1 / distance[few]).mean()
                    extent = np.array([np.ptp(left[end]), np.ptp(elevation[few])])
                    found.append((number, kind + int(c), middle, extent, wide))
    return _objects(found)


@dataclass(frozen=True, eq=False)
class Consensus:
    """The evidence of pairs for an extrinsic, a SmoothScore: the log likelihood ratio of every image's object meeting an object
    of its class, or anything. How often objects of a class are met is estimated with the extrinsic.

    of_image: (n,) number of the image's object, ascending. frame: (n,). ray: (n, 3) to it. point: (n, 3) m. core, stray: (2, n)
    deg, how far pairs are off. chance: (n,) objects of the cloud per square degree. counts: objects of the images, by class.
    parallax: of BASELINE_M.
    """

    of_image: NDArray[np.intp]
    frame: NDArray[np.intp]
    cls: NDArray[np.intp]
    ray: Matrix
    point: Matrix
    core: Matrix
    stray: Matrix
    chance: Matrix
    counts: NDArray[np.intp]
    parallax: float = 0.0

    def __len__(self) -> int:
        return len(self.ray)

    def values(self, transforms: Matrix) -> Matrix:
        """The evidence (k,) at each of (k, 4, 4)."""
        step = max(BATCH // max(len(self), 1), 1)
        parts = [transforms[k : k + step] for k in range(0, len(transforms), step)] if len(self) else []
        return np.concatenate([self._evidence(self._ratio(part)[0])[0] for part in parts] or [np.zeros(len(transforms))])

    def per_object(self, transforms: Matrix) -> Matrix:
        """What the evidence at each of (k, 4, 4) counts beside scores of maps (k,), which are means of such ratios as well."""
        return OBJECT_WEIGHT / max(int(self.counts.sum()), 1) * replace(self, parallax=PARALLAX_LEVELS[1]).values(transforms)

    def value(self, T: Matrix) -> float:
        """The evidence at T (4, 4)."""
        return float(self._evidence(self._ratio(T[None])[0])[0][0])

    def linearise(self, T: Matrix) -> tuple[Matrix, Matrix]:
        """Gradient (6,) and Gauss-Newton scale (6, 6), every object kept with its best pair."""
        ratio, off, precision = self._ratio(T[None])
        _, rates = self._evidence(ratio)
        order = np.lexsort((-ratio[0], self.of_image))
        best = order[np.unique(self.of_image[order], return_index=True)[1]]  # pair of every image's object
        ratio, rate = ratio[0, best], rates[0, self.cls[best]]
        weight = rate * ratio / (1 - rate + rate * ratio)
        p = self.point[best] @ T[:3, :3].T + T[:3, 3]
        distance = np.linalg.norm(p, axis=1)[:, None]
        gradient, scale = np.zeros(6), np.zeros((6, 6))
        for axis, own, w in zip(self._axes, off, precision, strict=True):
            sine = np.deg2rad(own[0, best])[:, None]
            slope = (axis[best] - sine * p / distance) / distance
            J = np.c_[np.cross(p, slope), slope]
            Jw = J * (weight * w[0, best] * np.rad2deg(1) ** 2)[:, None]
            gradient -= (Jw * sine).sum(axis=0)
            scale += Jw.T @ J
        return gradient, scale + 1e-6 * np.eye(6)

    def inliers(self, T: Matrix) -> int:
        """How many objects of the images meet one of the cloud at T (4, 4)."""
        _, off, _ = self._ratio(T[None])
        return len(np.unique(self.of_image[(np.abs(np.stack(off)[:, 0]) < 2 * self.core + 1).all(axis=0)]))

    @cached_property
    def _axes(self) -> tuple[Matrix, Matrix]:
        """Sideways and upward at every ray, (n, 3) each."""
        x = np.cross([0.0, 1.0, 0.0], self.ray)
        x /= np.linalg.norm(x, axis=1, keepdims=True)
        return x, np.cross(self.ray, x)

    @cached_property
    def _first(self) -> NDArray[np.intp]:
        """The first pair of every image's object."""
        return np.unique(self.of_image, return_index=True)[1]

    @cached_property
    def _noise(self) -> tuple[Matrix, Matrix]:
        """core and stray (2, n), with the parallax."""
        moved = np.rad2deg(self.parallax * BASELINE_M / np.linalg.norm(self.point, axis=1))
        return np.hypot(self.core, moved), np.hypot(self.stray, moved)

    def _ratio(self, transforms: Matrix) -> tuple[Matrix, list[Matrix], list[Matrix]]:
        """Likelihood ratios (k, n), and for both axes how far off pairs are, deg, and their precision, 1/deg^2, (k, n) each."""
        p = np.einsum("kab,nb->kna", transforms[:, :3, :3], self.point) + transforms[:, None, :3, 3]
        p /= np.maximum(np.linalg.norm(p, axis=2, keepdims=True), 1e-6)
        ratio, off, precision = 1 / (2 * np.pi * self.chance) * (np.einsum("kna,na->kn", p, self.ray) > 0.5), [], []
        for axis, core, stray in zip(self._axes, *self._noise, strict=True):
            own = np.rad2deg(np.einsum("kna,na->kn", p, axis))
            parts = [
                (share / sigma * np.exp(-0.5 * np.minimum((own / sigma) ** 2, 200)), sigma)
                for share, sigma in ((1 - STRAY, core), (STRAY, stray))
            ]
            density = sum(part for part, _ in parts)
            off.append(own)
            precision.append(sum(part / sigma**2 for part, sigma in parts) / np.maximum(density, 1e-30))
            ratio = ratio * density
        return ratio, off, precision

    def _evidence(self, ratio: Matrix) -> tuple[Matrix, Matrix]:
        """Of the likelihood ratios (k, n) of all pairs the evidence (k,), and how often objects of each class are met
        (k, classes)."""
        best, cls = np.maximum.reduceat(ratio, self._first, axis=1), self.cls[self._first]
        total, rates = np.zeros(len(ratio)), np.zeros((len(ratio), len(self.counts)))
        for c in np.unique(cls):
            own = best[:, cls == c]
            missed = self.counts[c] - own.shape[1]
            tried = np.stack([np.log(1 + h * (own - 1)).sum(axis=1) + missed * np.log(1 - h) for h in HIT_RATES])
            total += np.maximum(tried.max(axis=0), 0.0)
            rates[:, c] = HIT_RATES[tried.argmax(axis=0)]
        return total, rates


def find_pairs(views: Sequence[ClassView]) -> Consensus:
    """Objects of image and cloud of a frame, class and size that some allowed extrinsic brings together."""
    a, b = image_objects(views), cloud_objects(views)
    i, j = np.nonzero((a.frame[:, None] == b.frame) & (a.cls[:, None] == b.cls))
    ray, point, of_image, of_cloud = a.position[i], b.position[j], a.extent[i], b.extent[j]
    distance = np.linalg.norm(point, axis=1)
    rise = np.abs(np.arcsin(point[:, 2] / distance) + np.arcsin(ray[:, 1]))
    core = np.sqrt(RESOLUTION_DEG**2 + (PART[0] * np.minimum(of_image, of_cloud)) ** 2 + (PART[1] * (of_image - of_cloud)) ** 2)
    keep = rise <= np.deg2rad(MAX_TILT_DEG + 2) + np.arcsin(np.minimum(MAX_DISTANCE_M / distance, 1.0))
    keep &= a.width[i] <= SIZE_RATIO * b.width[j] + LINK_DEG[0]
    keep &= (b.width[j] <= SIZE_RATIO * a.width[i] + LINK_DEG[0]) | (a.cls[i] >= LEFT)
    similar = np.zeros((len(views), 3 * len(C)))
    np.add.at(similar, (b.frame, b.cls), 1 / ROUND_DEG2)
    i, j = i[keep], j[keep]
    return Consensus(
        i, a.frame[i], a.cls[i], ray[keep], point[keep], core[keep].T,
        np.hypot(core, np.maximum(of_image, of_cloud) / 2)[keep].T,
        similar[a.frame[i], a.cls[i]], np.bincount(a.cls, minlength=len(similar[0])),
    )  # fmt: skip


def agreed_poses(pairs: Consensus, seed: int) -> Matrix:
    """Allowed extrinsics (k, 4, 4) on which pairs of all frames agree, best first, after those of which the PnP problem is solved
    the rotations that fewer agree on. TooFewFeaturesError where there are none."""
    coarse = replace(pairs, parallax=PARALLAX_LEVELS[0])
    met = len(np.unique(pairs.of_image))
    if met >= MIN_INLIERS:
        rng, most = np.random.default_rng(seed), EVALUATED // len(pairs)
        # The rotation of every pair, if the camera does not roll; then those of two pairs.
        x, y, z = pairs.point.T
        yaw = np.arctan2(y, x) + np.arctan2(pairs.ray[:, 0], pairs.ray[:, 2])
        pitch = np.arcsin(z / np.linalg.norm(pairs.point, axis=1)) + np.arcsin(pairs.ray[:, 1])
        upright = poses(yaw, pitch, np.zeros(len(pairs)), np.zeros((len(pairs), 3)))
        T = np.concatenate([upright, *_rotations(coarse, rng)])
        T = T[allowed(T)]
        T = T if len(T) <= most else T[np.sort(rng.choice(len(T), most, replace=False))]
    if met < MIN_INLIERS or not len(T):
        raise TooFewFeaturesError(
            f"a first guess from centroids needs {MIN_INLIERS} objects (vehicles, persons, cyclists, poles, signs, buildings, "
            f"trees) that image and cloud both show; of {int(pairs.counts.sum())} in the images {met} may be in the clouds; "
            "give more frames, scenes with more objects, or another first guess (semantic, motion)"
        )
    T = T[distinct(T, coarse.values(T), SAME_DEG[0])]
    solved = np.array([_solved(pairs, own) for own in T[:STARTS]])
    solved = solved[allowed(solved)]
    if len(solved):
        solved = solved[distinct(solved, pairs.values(solved), SAME_DEG[1])]
    return np.concatenate([solved, T[STARTS : STARTS + FURTHER]])


def _rotations(pairs: Consensus, rng: np.random.Generator) -> Iterator[Matrix]:
    """Of two pairs of different objects of a frame that are as far apart in the image as in the cloud (k, 4, 4)."""
    distance = np.linalg.norm(pairs.point, axis=1)
    direction = pairs.point / distance[:, None]
    tolerance = np.linalg.norm(pairs.core, axis=0) + np.rad2deg(pairs.parallax * BASELINE_M / distance)
    frames = np.unique(pairs.frame)
    for frame in frames:
        own = np.flatnonzero(pairs.frame == frame)
        i, j = own[rng.integers(len(own), size=(2, DRAWS // len(frames)))]
        in_image, in_cloud = (
            np.rad2deg(np.arccos(np.clip(np.einsum("na,na->n", u[i], u[j]), -1, 1))) for u in (pairs.ray, direction)
        )
        fits = np.abs(in_image - in_cloud) < np.hypot(tolerance[i], tolerance[j])
        fits &= (in_image > NEAREST_DEG) & (in_cloud > NEAREST_DEG)
        i, j = np.unique(np.sort(np.stack([i[fits], j[fits]]), axis=0), axis=1)
        T = np.tile(np.eye(4), (len(i), 1, 1))
        T[:, :3, :3] = _frames(pairs.ray[i], pairs.ray[j]) @ _frames(direction[i], direction[j]).transpose(0, 2, 1)
        yield T


def _frames(u: Matrix, v: Matrix) -> Matrix:
    """Axes (n, 3, 3), as columns, of pairs of directions (n, 3): between them, across, and normal to both."""
    x, z = u + v, np.cross(u, v)
    x, z = (w / np.linalg.norm(w, axis=1, keepdims=True) for w in (x, z))
    return np.stack([x, np.cross(z, x), z], axis=2)


def _solved(pairs: Consensus, T: Matrix) -> Matrix:
    """The PnP problem of all pairs from T (4, 4), by Levenberg-Marquardt; what does not fit counts little."""
    limits = near_lidar(T)
    prior = Prior(limits.T, np.array([0.0] * 3 + [(MAX_DISTANCE_M / 2) ** -2] * 3))
    for parallax in PARALLAX_LEVELS:
        T = levenberg_marquardt(replace(pairs, parallax=parallax), T, 12, prior, limits, tolerance_deg=0.02)[0]
    return T
