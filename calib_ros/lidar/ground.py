"""The ground by RANSAC (thesis 3.3.2, algorithm 1; Fischler and Bolles 1981)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

BATCH = 32  # planes tried at a time; their distances to all points of a scan take some 15 MB


@dataclass(frozen=True)
class Plane:
    """normal: unit vector (3,), upward. offset: normal @ p for points p of the plane, m."""

    normal: NDArray[np.float64]
    offset: float

    def distance(self, xyz: NDArray[np.float32]) -> NDArray[np.float32]:
        """Signed distance (n,) of points (n, 3) in m, positive above."""
        return np.asarray(xyz @ self.normal.astype(np.float32) - np.float32(self.offset), np.float32)


def fit_ground(
    xyz: NDArray[np.float32], threshold: float, iterations: int, max_tilt_deg: float, min_share: float, seed: int
) -> Plane | None:
    """The plane with the most points of xyz (n, 3) within `threshold` m, of `iterations` planes through three of them.

    Planes tilted more than max_tilt_deg from the LiDAR's horizontal are walls. None if no plane holds min_share of the points:
    there is no ground in sight. The winner is fitted to its inliers if that gains inliers. Deterministic for a seed.
    """
    n = len(xyz)
    if n < 3:
        return None
    P = xyz[np.random.default_rng(seed).integers(0, n, (iterations, 3))].astype(np.float64)
    normals = np.cross(P[:, 1] - P[:, 0], P[:, 2] - P[:, 0])
    length = np.linalg.norm(normals, axis=1)
    normals = normals / np.maximum(length, 1e-12)[:, None] * np.where(normals[:, 2:] < 0, -1.0, 1.0)
    level = (length > 1e-6) & (normals[:, 2] >= np.cos(np.deg2rad(max_tilt_deg)))
    normals, offsets = normals[level], np.einsum("ij,ij->i", normals[level], P[level, 0])
    best, most = None, 2
    points = np.ascontiguousarray(xyz.T)
    for k in range(0, len(normals), BATCH):
        distance = normals[k : k + BATCH].astype(np.float32) @ points - offsets[k : k + BATCH, None].astype(np.float32)
        count = np.count_nonzero(np.abs(distance) < threshold, axis=1)
        if count.max() > most:
            most = int(count.max())
            best = Plane(normals[k + int(count.argmax())], float(offsets[k + int(count.argmax())]))
    return None if best is None or most / n < min_share else _refitted(best, xyz, threshold)


def _refitted(plane: Plane, xyz: NDArray[np.float32], threshold: float) -> Plane:
    """Least squares through the inliers, if that plane has more of them."""
    inliers = np.abs(plane.distance(xyz)) < threshold
    center = xyz[inliers].mean(axis=0, dtype=np.float64)
    offset_points = xyz[inliers] - center
    normal = np.linalg.eigh(offset_points.T @ offset_points)[1][:, 0]
    normal = normal * (-1.0 if normal[2] < 0 else 1.0)
    better = Plane(normal, float(normal @ center))
    return better if np.count_nonzero(np.abs(better.distance(xyz)) < threshold) > np.count_nonzero(inliers) else plane
