"""How surfaces and clusters are shaped: scatter around every point, boxes around clusters."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

Floats = NDArray[np.float32]
CELL = 0.2  # m; cubes that count once, so that near surfaces look like far ones
NEIGHBOURS, REACH = 24, 1.5  # points that tell the shape of a surface, and how far off they may lie, m
FEWEST = 5  # with fewer neighbours nothing can be said


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Shape around each point. scatter: (n,) 0 = flat or straight, up to 1/3 = alike in all directions; NaN where too few points
    are near. level: (n,) 0 = upright surface, 1 = level one.
    """

    scatter: Floats
    level: Floats

    def select(self, chosen: NDArray[np.intp]) -> Surfaces:
        """Those of some points."""
        return Surfaces(self.scatter[chosen], self.level[chosen])


def cells_of(xyz: Floats, size: tuple[float, float, float]) -> tuple[NDArray[np.intp], int]:
    """Number of the cell of the given edges (m) that each point (n, 3) lies in -> (n,), and how many cells have points."""
    cell = np.floor(xyz / np.array(size, np.float32)).astype(np.int64)
    cell -= cell.min(axis=0)
    span = cell.max(axis=0) + 1
    found, member = np.unique((cell[:, 0] * span[1] + cell[:, 1]) * span[2] + cell[:, 2], return_inverse=True)
    return member, len(found)


def grouped(items: NDArray[np.intp], number: NDArray[np.integer]) -> list[NDArray[np.intp]]:
    """The items (n,) of each group, in their order; number: (n,) of each item's group, from 0 without gaps."""
    if len(items) == 0:
        return []
    return np.split(items[np.argsort(number, kind="stable")], np.cumsum(np.bincount(number))[:-1])


def means(values: Floats, member: NDArray[np.intp], n: int) -> Floats:
    """Mean (n, k) of the values (m, k) that belong to each of n groups."""
    count = np.maximum(np.bincount(member, minlength=n), 1)
    return np.stack([np.bincount(member, column, n) / count for column in values.T], axis=1).astype(np.float32)


def surfaces(xyz: Floats) -> Surfaces:
    """Shape around points (n, 3), by the eigenvalues of their neighbours' spread (surface variation, Pauly et al. 2002).

    The scatter is averaged over the neighbours: leaves look flat here and there, but not all around.
    """
    if len(xyz) == 0:
        return Surfaces(np.empty(0, np.float32), np.empty(0, np.float32))
    member, n = cells_of(xyz, (CELL, CELL, CELL))
    middle = means(xyz, member, n)
    far, near = KDTree(middle).query(middle, NEIGHBOURS, distance_upper_bound=REACH)
    there = np.isfinite(far)
    near = np.where(there, near, 0)
    weight = (there / there.sum(axis=1, keepdims=True)).astype(np.float32)
    spread = (middle[near] - np.einsum("nk,nki->ni", weight, middle[near])[:, None]) * np.sqrt(weight)[..., None]
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread))
    scatter = values[:, 0].clip(0) / values.sum(axis=1).clip(1e-9)
    scatter = np.einsum("nk,nk->n", weight, scatter[near])
    scatter[there.sum(axis=1) < FEWEST] = np.nan
    return Surfaces(scatter[member].astype(np.float32), np.abs(vectors[:, 2, 0])[member].astype(np.float32))


def box(xy: Floats) -> tuple[float, float]:
    """Length and width (m) of the smallest rectangle around points (n, 2)."""
    _, (a, b), _ = cv2.minAreaRect(np.ascontiguousarray(xy, np.float32))
    return max(a, b), min(a, b)


def spans(values: Floats, member: NDArray[np.intp], n: int) -> tuple[Floats, Floats]:
    """Lowest and highest (n,) of the values (m,) of each of n groups; inf, -inf for empty ones."""
    low, high = np.full(n, np.inf, np.float32), np.full(n, -np.inf, np.float32)
    np.minimum.at(low, member, values)
    np.maximum.at(high, member, values)
    return low, high
