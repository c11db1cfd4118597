"""The first guess (thesis 3.5): hypotheses of the extrinsic from the classes of points and pixels, without any prior.

They come from pairs of objects, whose centroids give poses by PnP (figure 3.20), and from a sweep over all yaws.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.config import GuessConfig
from calib_ros.errors import BadInputError, TooFewFeaturesError
from calib_ros.frame import MAIN_CLASSES
from calib_ros.lidar.segmentation import cluster
from calib_ros.registration.classes import Hypothesis
from calib_ros.registration.initial_guess import allowed, poses, rotation_distance_deg
from calib_ros.registration.score.point_score import PointScore
from calib_ros.registration.search.optimizers import Sobol
from calib_ros_semantics.first_guess.score import (
    AROUND_DEG,
    distinct,
    label_score,
    local_optimum,
    refine_positions,
    select_views,
)
from calib_ros_semantics.first_guess.view import ClassView

Matrix = NDArray[np.float64]

# Hypotheses.
CANDIDATES = 5  # hypotheses kept, best first; the right one is hardly ever a later one
CENTROIDS, SWEEP = "centroids", "sweep"
SWEEP_POSES = 4096  # a power of two, as Sobol's sequence wants it
SWEEP_POINTS, COARSE_POINTS, FINE_POINTS = 1000, 2000, 12000
STARTS, FOLLOWED = 40, 15  # of all hypotheses, those optimised on the coarsest level, and of these those that go on
SAME_DEG = (6.0, 2.0, 1.0)  # hypotheses nearer than this are one: at first, after the coarsest level, at the end
OTHER_WAY_DEG = 2 * AROUND_DEG  # nearer hypotheses are places of one direction

# Objects: connected regions of pixels, clusters of points.
CLUSTER_EPS = 0.8  # m; points of an object are nearer to each other, parked cars are not
CLUSTER_MIN_POINTS = 4  # of a scan downsampled to 0.4 deg: a person at 30 m has about 10
MIN_AREA_DEG2 = 0.1  # smaller regions of the image are too far away to be clusters of the cloud
OFF_DEG = 3.0  # of the objects of an image, half meet a cluster so near at the true extrinsic, 65 % within 5 (12 drives)
PEAKS, DRAWS, KEPT = 8, 40, 3  # yaws tried, samples of each, and of their poses those that go on
SAMPLE = 4  # pairs solved at a time; three give up to four poses


def first_guess(views: Sequence[ClassView], config: GuessConfig | None = None, seed: int = 0) -> list[Hypothesis]:
    """Hypotheses of the extrinsic that all views have in common, best first; at least one. config limits tilt and distance.

    BadInputError for views of different cameras; TooFewFeaturesError if they show too little in common, or nothing of it meets.
    """
    config = config or GuessConfig()
    if not views:
        raise TooFewFeaturesError("a first guess needs at least one frame with classes of pixels and points; there is none")
    if any(view.camera != views[0].camera for view in views):
        raise BadInputError("the frames for a first guess are of different cameras; give only frames of one camera")
    views = select_views(views)
    score = label_score(views)
    pairs = possible_pairs(views, config)
    voted, swept = centroid_poses(pairs, views[0].camera.K, config, seed), _sweep(score, config, seed)
    starts = np.concatenate([voted, swept])
    kinds = np.array([CENTROIDS] * len(voted) + [SWEEP] * len(swept))
    T, kinds = _optimised(score, starts, kinds, config, seed)
    T, values, source = refine_positions(score, T, config, seed) if len(T) else (T, np.zeros(0), np.zeros(0, np.intp))
    kinds = kinds[source]
    if not len(T):
        raise TooFewFeaturesError(
            f"no extrinsic within {config.tilt_deg:g} deg of level and {config.distance_m:g} m of the LiDAR brings the classes "
            "of points and pixels together; check labels, topics and time stamps, or use more frames"
        )
    return [
        Hypothesis(T[k], float(values[k]), _margin(T[k:], values[k:]), str(kinds[k]), pairs.inliers(T[k]))
        for k in range(min(len(T), CANDIDATES))
    ]


def _margin(T: Matrix, values: Matrix) -> float:
    """Of the first over the next one of another viewing direction."""
    others = values[rotation_distance_deg(T, T[0]) > OTHER_WAY_DEG]
    return float(values[0] - (others[0] if len(others) else 0.0))


def _sweep(score: PointScore, config: GuessConfig, seed: int) -> Matrix:
    """The best of many allowed extrinsics, by the coarsest level (k, 4, 4)."""
    unit = Sobol(6, seed=seed).next(SWEEP_POSES)
    tilt, reach = np.deg2rad(config.tilt_deg), config.distance_m / np.sqrt(3)
    transforms = poses(np.pi * unit[:, 0], tilt * unit[:, 1], tilt * unit[:, 2], reach * unit[:, 3:])
    transforms = transforms[allowed(transforms, config)]
    values = score.subset(SWEEP_POINTS, np.random.default_rng(seed)).values(transforms, 0)
    return transforms[np.argsort(-values, kind="stable")[: 8 * STARTS]]


def _optimised(
    score: PointScore, starts: Matrix, kinds: NDArray[np.str_], config: GuessConfig, seed: int
) -> tuple[Matrix, NDArray[np.str_]]:
    """The optima that the starts (k, 4, 4) lead to, level by level, best first: extrinsics and kinds (k,)."""
    rng = np.random.default_rng(seed)
    parts = [score.subset(n, rng) for n in (COARSE_POINTS, COARSE_POINTS, FINE_POINTS)]
    T, kept = starts, distinct(starts, parts[0].values(starts, 0), SAME_DEG[0])[:STARTS]
    values = np.zeros(len(starts))
    for level, part in enumerate(parts):
        T, kinds = T[kept], kinds[kept]
        T = np.array([local_optimum(part.at(level), level, own, config) for own in T]).reshape(-1, 4, 4)
        inside = allowed(T, config)
        T, kinds = T[inside], kinds[inside]
        finer = min(level + 1, score.n_levels - 1)
        values = parts[finer].values(T, finer) if len(T) else np.zeros(0)
        kept = distinct(T, values, SAME_DEG[min(level + 1, 2)])[:FOLLOWED]
    kept = kept[values[kept] > 0]  # the others bring nothing together, or see nothing of the scene
    return T[kept], kinds[kept]


@dataclass(frozen=True, eq=False)
class Pairs:
    """Objects of image and cloud of the same frame and class that may be the same.

    image_object: (n,) number of the image's object, of `objects`. ray: (n, 3) unit vector to it in the camera frame. pixel:
    (n, 2) full size. point: (n, 3) m, centroid in the cloud. yaw: (n,) rad that a level camera at the LiDAR would have. parallax:
    (n,) rad that its distance from the LiDAR may change that.
    """

    image_object: NDArray[np.intp]
    objects: int
    ray: Matrix
    pixel: Matrix
    point: Matrix
    yaw: Matrix
    parallax: Matrix

    def angles(self, T: Matrix) -> Matrix:
        """Angle (n,) in rad between the pairs' directions at T (4, 4)."""
        p = se3.transform(T, self.point)
        cosine = np.einsum("ij,ij->i", p, self.ray) / np.maximum(np.linalg.norm(p, axis=1), 1e-6)
        return np.asarray(np.arccos(np.clip(cosine, -1, 1)))

    def inliers(self, T: Matrix) -> int:
        """How many objects of the image meet one of the cloud at T (4, 4)."""
        return len(np.unique(self.image_object[self.angles(T) < np.deg2rad(OFF_DEG)]))


def possible_pairs(views: Sequence[ClassView], config: GuessConfig) -> Pairs:
    """All pairs of a class that some allowed extrinsic brings together."""
    owners, rays, pixels, points = [], [np.empty((0, 3))], [np.empty((0, 2))], [np.empty((0, 3))]
    objects = 0
    for view in views:
        K, scale = view.camera.K, view.scale
        per_pixel = float(np.rad2deg(scale / K[0, 0])) ** 2
        of_image, middle = image_objects(view.classes, max(round(MIN_AREA_DEG2 / per_pixel), 4))
        of_cloud, centroid = cloud_objects(view.xyz, view.label)
        i, j = np.nonzero(of_image[:, None] == of_cloud[None])
        pixel = (middle + 0.5) * scale - 0.5
        ray = np.c_[(pixel - K[:2, 2]) / (K[0, 0], K[1, 1]), np.ones(len(pixel))]
        owners.append(objects + i)
        rays.append((ray / np.linalg.norm(ray, axis=1, keepdims=True))[i])
        pixels.append(pixel[i])
        points.append(centroid[j])
        objects += len(pixel)
    number, ray, pixel, point = np.concatenate(owners), np.concatenate(rays), np.concatenate(pixels), np.concatenate(points)
    distance = np.maximum(np.linalg.norm(point, axis=1), 1e-6)
    parallax = np.arcsin(np.minimum(config.distance_m / distance, 1.0))
    rise = np.abs(np.arcsin(point[:, 2] / distance) + np.arcsin(ray[:, 1]))
    keep = rise <= np.deg2rad(config.tilt_deg + OFF_DEG) + parallax
    yaw = np.arctan2(point[:, 1], point[:, 0]) + np.arctan2(ray[:, 0], ray[:, 2])
    return Pairs(number[keep], objects, ray[keep], pixel[keep], point[keep], yaw[keep], parallax[keep])


def image_objects(classes: NDArray[np.uint8], min_area: int) -> tuple[NDArray[np.uint8], Matrix]:
    """Class (k,) and centroid (k, 2) px of connected regions (8 neighbours) of the main classes in classes (h, w).

    Those smaller than min_area px or cut by the image's border are left out.
    """
    height, width = classes.shape
    cls, centroid = [], [np.empty((0, 2))]
    for c in MAIN_CLASSES:
        _, _, stats, middle = cv2.connectedComponentsWithStats((classes == c).astype(np.uint8), connectivity=8)
        left, top, wide, high, area = stats.T
        whole = (area >= min_area) & (left > 0) & (top > 0) & (left + wide < width) & (top + high < height)
        whole[0] = False  # the background
        cls += [c] * int(whole.sum())
        centroid.append(middle[whole])
    return np.array(cls, np.uint8), np.concatenate(centroid)


def cloud_objects(xyz: NDArray[np.float32], label: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], Matrix]:
    """Class (k,) and centroid (k, 3) m of the clusters of points (n, 3) of the main classes by DBSCAN. label: (n,).

    The points should be uniform in angle, like pixels: a mean of all points of a scan is biased to where its rings are dense.
    """
    cls, centroid = [], [np.empty((0, 3))]
    for c in MAIN_CLASSES:
        own = xyz[label == c]
        member = cluster(own, CLUSTER_EPS, CLUSTER_MIN_POINTS)
        count = np.bincount(member[member >= 0])
        sums = [np.bincount(member[member >= 0], own[member >= 0, k], len(count)) for k in range(3)]
        cls += [c] * len(count)
        centroid.append(np.stack(sums, axis=1) / count[:, None])
    return np.array(cls, np.uint8), np.concatenate(centroid)


def centroid_poses(pairs: Pairs, K: Matrix, config: GuessConfig, seed: int) -> Matrix:
    """Allowed extrinsics (k, 4, 4) that bring many pairs together, k = 0 if there are none. K: (3, 3) of the camera."""
    rng = np.random.default_rng(seed)
    out = []
    for yaw in _vote_yaws(pairs):
        level = poses(np.array([yaw]), np.zeros(1), np.zeros(1), np.zeros((1, 3)))
        agreeing = np.flatnonzero(_gap(pairs.yaw, yaw) <= np.deg2rad(2 * OFF_DEG) + pairs.parallax / 2)
        found = [T for T in (_solve_pnp(pairs, _draw(pairs, agreeing, rng), K) for _ in range(DRAWS)) if T is not None]
        solved = np.stack(found) if found else np.empty((0, 4, 4))
        solved = solved[allowed(solved, config)]
        order = np.argsort([-pairs.inliers(T) for T in solved], kind="stable")[:KEPT]
        out += [level, solved[order]]
    return np.concatenate(out) if out else np.empty((0, 4, 4))


def _vote_yaws(pairs: Pairs) -> list[float]:
    """Yaws in rad at which most objects of the image have a partner, best first; each object votes once."""
    grid = np.deg2rad(np.arange(-180.0, 180.0, 2.0))
    width = np.deg2rad(OFF_DEG) + pairs.parallax / 4
    vote = np.exp(-0.5 * (_gap(pairs.yaw[:, None], grid[None]) / width[:, None]) ** 2)
    best = np.zeros((pairs.objects, len(grid)))
    np.maximum.at(best, pairs.image_object, vote)
    votes = best.sum(axis=0)
    found: list[float] = []
    for k in np.argsort(-votes, kind="stable"):
        if votes[k] > 0 and all(_gap(grid[k], other) > np.deg2rad(3 * OFF_DEG) for other in found):
            found.append(float(grid[k]))
        if len(found) == PEAKS:
            break
    return found


def _gap(a: Matrix | float, b: Matrix | float) -> Matrix:
    """Angles between directions in rad, 0 to pi."""
    return np.asarray(np.abs((a - b + np.pi) % (2 * np.pi) - np.pi))


def _draw(pairs: Pairs, among: NDArray[np.intp], rng: np.random.Generator) -> NDArray[np.intp]:
    """A sample of pairs of different objects; fewer than SAMPLE where there are no more."""
    shuffled = rng.permutation(among)
    _, first = np.unique(pairs.image_object[shuffled], return_index=True)
    return np.asarray(shuffled[np.sort(first)[:SAMPLE]])


def _solve_pnp(pairs: Pairs, sample: NDArray[np.intp], K: Matrix) -> Matrix | None:
    """The extrinsic (4, 4) of a sample; None if it has none."""
    if len(sample) < SAMPLE:
        return None
    try:
        found, turn, shift = cv2.solvePnP(pairs.point[sample], pairs.pixel[sample], K, None, flags=cv2.SOLVEPNP_SQPNP)
    except cv2.error:  # points on one line
        return None
    if not found or not np.isfinite(shift).all():
        return None
    return se3.from_parts(cv2.Rodrigues(turn)[0], shift.ravel())
