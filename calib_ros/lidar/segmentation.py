"""Ground and objects of a scan: a plane by RANSAC, clusters by DBSCAN."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
BATCH = 32  # planes tested at a time; their distances to all points of a scan take some 15 MB
SCORED_POINTS = 5000  # that planes are compared on; the best one is fitted to all: its share is known to 0.7 %
NOISE = -1
MIN_VOXEL = 1e-3  # m; points nearer than this are one to any LiDAR, and much smaller cubes could not be numbered
MAX_NEIGHBOURS = 1e8  # pairs are kept all at once: about 1.5 GB
NEIGHBOUR_SAMPLE = 256  # points from which the number of neighbours is estimated


@dataclass(frozen=True)
class Plane:
    """normal: unit vector (3,), upward. offset: normal @ p for points p of the plane, m."""

    normal: NDArray[np.float64]
    offset: float

    def distance(self, xyz: NDArray[np.float32]) -> NDArray[np.float32]:
        """Signed distance (n,) of points (n, 3) in m, positive above."""
        return np.asarray(xyz @ self.normal.astype(np.float32) - np.float32(self.offset), np.float32)


def fit_ground(
    xyz: NDArray[np.float32],
    threshold: float,
    iterations: int,
    max_tilt_deg: float,
    min_share: float,
    seed: int,
    compared: int = SCORED_POINTS,
) -> Plane | None:
    """The plane with the most points of xyz (n, 3) within `threshold` m, of `iterations` planes through three of them that are
    tilted by at most max_tilt_deg, refitted to its inliers; None if it holds less than min_share. Deterministic for a seed.
    compared: about so many of the points decide.

    RANSAC (thesis 3.3.2, algorithm 1; Fischler and Bolles 1981).
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
    few = xyz[:: (n // compared) | 1]  # odd: a power of two would take the same lasers of every firing
    points = np.ascontiguousarray(few.T)
    memory = np.empty((BATCH, points.shape[1]), np.float32)  # which takes longer to come by than to fill
    for k in range(0, len(normals), BATCH):
        own = normals[k : k + BATCH].astype(np.float32)
        distance = np.matmul(own, points, out=memory[: len(own)])
        distance -= offsets[k : k + BATCH, None].astype(np.float32)
        count = np.array([np.count_nonzero(row) for row in np.abs(distance, out=distance) < threshold])
        if count.max() > most:
            most = int(count.max())
            best = Plane(normals[k + int(count.argmax())], float(offsets[k + int(count.argmax())]))
    if best is None or most / len(few) < min_share:
        return None
    inliers = np.abs(best.distance(xyz)) < threshold
    center = xyz[inliers].mean(axis=0, dtype=np.float64)
    offset_points = xyz[inliers] - center
    normal = np.linalg.eigh(offset_points.T @ offset_points)[1][:, 0]
    normal = normal * (-1.0 if normal[2] < 0 else 1.0)
    fitted = Plane(normal, float(normal @ center))
    return fitted if np.count_nonzero(np.abs(fitted.distance(xyz)) < threshold) > np.count_nonzero(inliers) else best


def cluster(xyz: NDArray[np.float32], eps: float, min_points: int, voxel: float = 0.0) -> NDArray[np.int32]:
    """DBSCAN (thesis 3.3.3, algorithm 2; Ester et al. 1996): cluster (n,) int32 of points (n, 3), largest first; NOISE = -1.

    eps: radius of the neighbourhood, m. min_points: points in it, itself included, of a core point. voxel: points of a cube of
    this edge length (m) are merged into one of their weight, so that near, dense surfaces do not cost more than far ones; 0 =
    none, algorithm 2 as printed. Larger cubes are used where the neighbourhoods would take more than about 1.5 GB of memory.
    """
    if len(xyz) == 0:
        return np.empty(0, np.int32)
    points, weight, member = _downsampled(xyz, voxel)
    while _neighbours(points, eps) > MAX_NEIGHBOURS:
        voxel = max(2 * voxel, eps / 32)
        points, weight, member = _downsampled(xyz, voxel)
    labels = _dbscan(points, weight, eps, min_points)[member]
    count = np.bincount(labels[labels >= 0])
    rank = np.empty(len(count) + 1, np.int32)
    rank[np.argsort(-count, kind="stable")] = np.arange(len(count), dtype=np.int32)  # of equally large ones by the earlier point
    rank[-1] = NOISE
    return rank[labels]


def neighbours_of(points: NDArray[Any], **options: bool) -> Any:
    """A KD-tree of points (n, k), imported where it is used: of scipy, most processes need its special functions alone."""
    from scipy.spatial import KDTree

    return KDTree(points, **options)


def connected_parts(pairs: NDArray[np.intp], n: int) -> NDArray[np.intp]:
    """Number of the connected component of each of n nodes. pairs: (m, 2) of connected ones."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    return np.asarray(connected_components(graph, directed=False)[1], np.intp)


def _dbscan(points: Floats, weight: NDArray[np.float64], eps: float, min_points: int) -> NDArray[np.intp]:
    """Cluster (n,) of points (n, 3) that stand for so many each, numbered by their first core points; NOISE."""
    n, pairs = len(points), neighbours_of(points).query_pairs(eps, output_type="ndarray")
    first, second = np.ascontiguousarray(pairs.T)
    core = weight + np.bincount(first, weight[second], n) + np.bincount(second, weight[first], n) >= min_points
    found = np.full(n, NOISE, np.intp)
    both = pairs[core[first] & core[second]]
    found[core] = np.unique(connected_parts(both, n)[core], return_inverse=True)[1]
    joined = np.full(n, n, np.intp)  # beyond any; neighbours of core points join the first cluster that has one
    for own, other in ((first, second), (second, first)):
        beside = core[own] & ~core[other]
        np.minimum.at(joined, other[beside], found[own[beside]])
    return np.where(joined < n, joined, found)


def _downsampled(xyz: Floats, voxel: float) -> tuple[Floats, NDArray[np.float64], NDArray[np.intp]]:
    """Mean (m, 3) and number (m,) of the points (n, 3) in each cube, and the cube (n,) of each point."""
    if voxel < MIN_VOXEL:
        return xyz, np.ones(len(xyz)), np.arange(len(xyz))
    cell = np.floor(xyz / np.float32(voxel)).astype(np.int64)
    cell -= cell.min(axis=0)
    span = cell.max(axis=0) + 1
    key = (cell[:, 0] * span[1] + cell[:, 1]) * span[2] + cell[:, 2]
    _, member, count = np.unique(key, return_inverse=True, return_counts=True)
    weight = count.astype(float)
    sums = np.stack([np.bincount(member, xyz[:, k]) for k in range(3)], axis=1)
    return np.asarray(sums / weight[:, None], np.float32), weight, member


def _neighbours(points: Floats, eps: float) -> float:
    """Number of neighbours within eps of all points (n, 3), estimated from a sample of them."""
    if len(points) <= MAX_NEIGHBOURS**0.5:
        return 0.0
    sample = points[:: len(points) // NEIGHBOUR_SAMPLE + 1]
    return float(np.mean(neighbours_of(points).query_ball_point(sample, eps, return_length=True)) * len(points))
