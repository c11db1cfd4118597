"""Extrinsics from centroids of objects: which object of the image is which of the cloud, tried out (thesis 3.5, figure 3.20).

A centroid in the image and one in the cloud, if they are the same object, tell the yaw alone, since the camera stands upright
near the LiDAR. So pairs vote for a yaw first; among those that agree on one, a few at a time are solved for the pose (RANSAC,
Fischler and Bolles 1981; SQPnP, Terzakis and Lourakis 2020). Centroids are off by some degrees: what is hidden or beyond the
scan's field differs between the two sensors, parked cars run into one in the image. Most pairs are wrong, therefore.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.config import GuessConfig
from calib_ros.registration.first_guess.class_view import ClassView
from calib_ros.registration.first_guess.poses import allowed, poses
from calib_ros.semantics.instances import cloud_instances, image_instances

Matrix = NDArray[np.float64]
MIN_AREA_DEG2 = 0.1  # smaller regions of the image are too far away to be clusters of the cloud
OFF_DEG = 3.0  # of the objects of an image, half meet a cluster so near at the true extrinsic, 65 % within 5 (12 drives)
PEAKS, DRAWS, KEPT = 8, 40, 3  # yaws tried, samples of each, and of their poses those that go on
SAMPLE = 4  # pairs solved at a time; three give up to four poses


@dataclass(frozen=True, eq=False)
class Pairs:
    """Objects of image and cloud of the same frame and class that may be the same.

    seen: (n,) number of the image's object, of `objects`. ray: (n, 3) unit vector to it in the camera frame. pixel: (n, 2) full
    size. point: (n, 3) m, centroid in the cloud. yaw: (n,) rad that a level camera at the LiDAR would have. parallax: (n,) rad
    that its distance from the LiDAR may change that.
    """

    seen: NDArray[np.intp]
    objects: int
    ray: Matrix
    pixel: Matrix
    point: Matrix
    yaw: Matrix
    parallax: Matrix

    def agreement(self, T: Matrix) -> Matrix:
        """Angle (n,) in rad between the pairs' directions at T (4, 4)."""
        p = se3.transform(T, self.point)
        cosine = np.einsum("ij,ij->i", p, self.ray) / np.maximum(np.linalg.norm(p, axis=1), 1e-6)
        return np.asarray(np.arccos(np.clip(cosine, -1, 1)))

    def inliers(self, T: Matrix) -> int:
        """How many objects of the image meet one of the cloud at T (4, 4)."""
        return len(np.unique(self.seen[self.agreement(T) < np.deg2rad(OFF_DEG)]))


def possible_pairs(views: Sequence[ClassView], config: GuessConfig) -> Pairs:
    """All pairs of a class that some allowed extrinsic brings together; objects cut by the image's border are left out."""
    seen, rays, pixels, points = [], [np.empty((0, 3))], [np.empty((0, 2))], [np.empty((0, 3))]
    objects = 0
    for view in views:
        K, scale = view.camera.K, view.scale
        per_pixel = float(np.rad2deg(scale / K[0, 0])) ** 2
        image = image_instances(view.classes, max(round(MIN_AREA_DEG2 / per_pixel), 4))
        cloud = cloud_instances(view.xyz, view.label)
        whole = np.flatnonzero(~image.cut)
        i, j = np.nonzero(image.cls[whole, None] == cloud.cls[None])
        pixel = (image.centroid[whole] + 0.5) * scale - 0.5
        ray = np.c_[(pixel - K[:2, 2]) / (K[0, 0], K[1, 1]), np.ones(len(pixel))]
        seen.append(objects + i)
        rays.append((ray / np.linalg.norm(ray, axis=1, keepdims=True))[i])
        pixels.append(pixel[i])
        points.append(cloud.centroid[j])
        objects += len(whole)
    number, ray, pixel, point = np.concatenate(seen), np.concatenate(rays), np.concatenate(pixels), np.concatenate(points)
    distance = np.maximum(np.linalg.norm(point, axis=1), 1e-6)
    parallax = np.arcsin(np.minimum(config.distance_m / distance, 1.0))
    rise = np.abs(np.arcsin(point[:, 2] / distance) + np.arcsin(ray[:, 1]))
    keep = rise <= np.deg2rad(config.tilt_deg + OFF_DEG) + parallax
    yaw = np.arctan2(point[:, 1], point[:, 0]) + np.arctan2(ray[:, 0], ray[:, 2])
    return Pairs(number[keep], objects, ray[keep], pixel[keep], point[keep], yaw[keep], parallax[keep])


def centroid_poses(pairs: Pairs, K: Matrix, config: GuessConfig, seed: int) -> Matrix:
    """Allowed extrinsics (k, 4, 4) that bring many pairs together, k = 0 if there are none. K: (3, 3) of the camera."""
    rng = np.random.default_rng(seed)
    out = []
    for yaw in _voted_yaws(pairs):
        level = poses(np.array([yaw]), np.zeros(1), np.zeros(1), np.zeros((1, 3)))
        agreeing = np.flatnonzero(_gap(pairs.yaw, yaw) <= np.deg2rad(2 * OFF_DEG) + pairs.parallax / 2)
        found = [T for T in (_solved(pairs, _drawn(pairs, agreeing, rng), K) for _ in range(DRAWS)) if T is not None]
        solved = np.stack(found) if found else np.empty((0, 4, 4))
        solved = solved[allowed(solved, config)]
        order = np.argsort([-pairs.inliers(T) for T in solved], kind="stable")[:KEPT]
        out += [level, solved[order]]
    return np.concatenate(out) if out else np.empty((0, 4, 4))


def _voted_yaws(pairs: Pairs) -> list[float]:
    """Yaws in rad at which most objects of the image have a partner, best first; each object votes once."""
    grid = np.deg2rad(np.arange(-180.0, 180.0, 2.0))
    width = np.deg2rad(OFF_DEG) + pairs.parallax / 4
    vote = np.exp(-0.5 * (_gap(pairs.yaw[:, None], grid[None]) / width[:, None]) ** 2)
    best = np.zeros((pairs.objects, len(grid)))
    np.maximum.at(best, pairs.seen, vote)
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


def _drawn(pairs: Pairs, among: NDArray[np.intp], rng: np.random.Generator) -> NDArray[np.intp]:
    """A sample of pairs of different objects; fewer than SAMPLE where there are no more."""
    shuffled = rng.permutation(among)
    _, first = np.unique(pairs.seen[shuffled], return_index=True)
    return np.asarray(shuffled[np.sort(first)[:SAMPLE]])


def _solved(pairs: Pairs, chosen: NDArray[np.intp], K: Matrix) -> Matrix | None:
    """The extrinsic (4, 4) of a sample; None if it has none."""
    if len(chosen) < SAMPLE:
        return None
    try:
        found, turn, shift = cv2.solvePnP(pairs.point[chosen], pairs.pixel[chosen], K, None, flags=cv2.SOLVEPNP_SQPNP)
    except cv2.error:  # points on one line
        return None
    if not found or not np.isfinite(shift).all():
        return None
    return se3.from_parts(cv2.Rodrigues(turn)[0], shift.ravel())
