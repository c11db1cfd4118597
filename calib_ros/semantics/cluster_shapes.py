"""How surfaces and clusters are shaped: scatter around every point, boxes around clusters."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from calib_ros.lidar.segmentation import cluster

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


# Poles and the plates on them: thin slices above each other with nothing around (stacked hollow cylinders, Brenner 2009).
Numbers = NDArray[np.intp]
SLICE = 0.3  # m; the visible part of a pole has six or more, a traffic sign two or three
POLE_CELL = 0.1  # m; what is nearer in a slice counts once
JOINED = 0.3  # m; parts of a slice that are nearer are one; a pole in front of something stands farther off
APART = 100.0  # m by which slices are kept apart where neighbours are sought within them
THIN = 0.4  # m; lamp posts and masts, with the noise of ranges and the smear of beams at their edges
PLATE = (0.3, 1.3)  # m; width of signs: from a plate of 0.4 m seen obliquely to one with a town's name
FLAT = 0.22  # m; depth of a plate with the noise of ranges; a head above shoulders is deeper
PLATE_FROM = 1.2  # m; lower ones are boards, bins and people
HOLLOW, HOLLOW_SHARE = 0.4, 0.015  # m and share of the range around it that must be empty: scanned at a slant, walls have gaps
LEAN = 0.25  # m; by which a slice may lie beside the next
GAP, GAP_SHARE = 0.65, 0.04  # m and share of the range between slices: rings that are 2 deg apart
TALL = 1.8  # m from the lowest to the highest slice; stems of bushes and parts of people end below
LOW = 1.5  # m; poles that begin higher hang from trees
STEMS = 3  # slices at least; fewer show no line
STOUT = 0.26  # m; half of a pole's slices are thinner, those of old trees and of people are not
# A wall seen at a slant shows columns one or two beams apart (m and share of the range), this far one behind the other (m).
BESIDE, BESIDE_SHARE, BEHIND = 0.1, 0.008, (0.4, 5.0)
ALIKE = 2  # slices in which they show; a pole has a single one by chance
CROWN, CROWN_UP = 1.2, 1.6  # m around and above the top where a tree has its crown
CROWN_SIZE = (1.2, 0.7)  # m; length and width of a crown at least; traffic lights are smaller, arms thinner


@dataclass(frozen=True, eq=False)
class Slabs:
    """Connected parts of slices: middle (m, 2) and its distance (m,) m, number of the slice (m,), length and width (m, 2)."""

    middle: Floats
    distance: Floats
    slice: Numbers
    size: Floats


@dataclass(frozen=True, eq=False)
class Poles:
    """Masks (n,) of points on poles, on the plates they carry, and on trunks under a crown."""

    pole: NDArray[np.bool_]
    plate: NDArray[np.bool_]
    trunk: NDArray[np.bool_]


def find_poles(xyz: Floats) -> Poles:
    """Points (n, 3) above the ground, z = height (m) -> which of them stand on poles."""
    nothing = np.zeros(len(xyz), bool)
    if len(xyz) < STEMS:
        return Poles(nothing, nothing, nothing)
    cell, n = cells_of(xyz, (POLE_CELL, POLE_CELL, SLICE))
    at = means(xyz, cell, n)
    layer = np.floor(at[:, 2] / SLICE).astype(np.intp)
    sliced = np.column_stack([at[:, :2], layer * APART])
    tree = KDTree(sliced)
    part = _joined(tree.query_pairs(JOINED, output_type="ndarray"), n)
    slabs = _measure(xyz, part[cell], layer, part)
    thin = slabs.size[:, 0] <= THIN
    plate = ~thin & (slabs.size[:, 0] >= PLATE[0]) & (slabs.size[:, 0] <= PLATE[1]) & (slabs.size[:, 1] <= FLAT)
    plate &= slabs.slice * SLICE >= PLATE_FROM
    alone = np.nonzero(thin | plate)[0]
    alone = alone[_stands_alone(slabs, alone, tree, np.bincount(part))]
    stack = _stacks(slabs, alone)
    good, trunk = _judge(slabs, alone, thin, stack, at, part)
    good &= ~_in_line(slabs, alone[thin[alone]], alone, stack, good)
    kind = np.zeros(len(slabs.slice), np.uint8)
    kind[alone[good[stack]]] = 1
    kind[alone[trunk[stack]]] = 2
    of_point = kind[part[cell]]
    on_plate = (of_point == 1) & plate[part[cell]]
    return Poles((of_point == 1) & ~on_plate, on_plate, of_point == 2)


def _joined(pairs: NDArray[np.intp], n: int) -> Numbers:
    """Number of the connected component of each of n nodes."""
    graph = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    return np.asarray(connected_components(graph, directed=False)[1], np.intp)


def _measure(xyz: Floats, part: Numbers, layer: Numbers, part_of_cell: Numbers) -> Slabs:
    n = int(part_of_cell.max()) + 1
    middle = means(xyz[:, :2], part, n)
    off = xyz[:, :2] - middle[part]
    xx, xy, yy = means(np.column_stack([off[:, 0] ** 2, off[:, 0] * off[:, 1], off[:, 1] ** 2]), part, n).T
    turn = 0.5 * np.arctan2(2 * xy, xx - yy)  # of the longer principal axis
    c, s = np.cos(turn)[part], np.sin(turn)[part]
    sides = []
    for along in (c * off[:, 0] + s * off[:, 1], c * off[:, 1] - s * off[:, 0]):
        low, high = spans(along, part, n)
        sides.append(high - low)
    slices = np.zeros(n, np.intp)
    slices[part_of_cell] = layer
    return Slabs(middle, np.hypot(middle[:, 0], middle[:, 1]), slices, np.sort(np.stack(sides, 1), axis=1)[:, ::-1])


def _stands_alone(slabs: Slabs, chosen: Numbers, tree: KDTree, cells: Numbers) -> NDArray[np.bool_]:
    """Whether nothing else lies around each of the chosen slabs in its slice."""
    around = 0.5 * slabs.size[chosen, 0] + HOLLOW + HOLLOW_SHARE * slabs.distance[chosen]
    centre = np.column_stack([slabs.middle[chosen], slabs.slice[chosen] * APART])
    return np.asarray(tree.query_ball_point(centre, around, return_length=True) <= cells[chosen])


def _stacks(slabs: Slabs, chosen: Numbers) -> Numbers:
    """Number of the stack of each of the chosen slabs."""
    if len(chosen) == 0:
        return chosen
    pairs = KDTree(slabs.middle[chosen]).query_pairs(LEAN, output_type="ndarray")
    a, b = chosen[pairs].T
    apart = np.abs(slabs.slice[a] - slabs.slice[b]) * SLICE
    return _joined(pairs[apart <= GAP + GAP_SHARE * slabs.distance[a]], len(chosen))


def _judge(
    slabs: Slabs, chosen: Numbers, thin: NDArray[np.bool_], stack: Numbers, at: Floats, part: Numbers
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which stacks are poles, and which trunks."""
    n = int(stack.max()) + 1 if len(stack) else 0
    low, high = spans(slabs.slice[chosen].astype(np.float32) * np.float32(SLICE), stack, n)
    stems = np.bincount(stack, thin[chosen], n)
    upright = (high - low + SLICE >= TALL) & (low <= LOW) & (stems >= STEMS)
    slender = np.bincount(stack, slabs.size[chosen, 0] <= STOUT, n)
    upright &= slender >= 0.5 * np.bincount(stack, minlength=n)
    wide = ~thin[part]
    crown = np.zeros(n, bool)
    if upright.any() and wide.any():
        foot = means(slabs.middle[chosen], stack, n)
        xy, z = at[wide, :2], at[wide, 2]
        tree = KDTree(xy)
        for k in np.nonzero(upright)[0]:
            near = np.array(tree.query_ball_point(foot[k], CROWN), np.intp)
            above = near[(z[near] > high[k]) & (z[near] < high[k] + SLICE + CROWN_UP)]
            crown[k] = len(above) >= 3 and bool(np.all(np.array(box(xy[above])) >= CROWN_SIZE))
    return upright & ~crown, upright & crown


def _in_line(slabs: Slabs, thin: Numbers, chosen: Numbers, stack: Numbers, asked: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which of the stacks asked for have other thin slabs before or behind them on nearly the same beam."""
    line = np.zeros(len(asked), bool)
    for k in np.nonzero(asked)[0]:
        own = chosen[stack == k]
        foot = slabs.middle[own].mean(axis=0)
        distance = max(float(np.hypot(*foot)), 1e-6)
        off = slabs.middle[thin] - foot
        along = np.abs(off @ foot) / distance
        across = np.abs(off[:, 0] * foot[1] - off[:, 1] * foot[0]) / distance
        near = (along > BEHIND[0]) & (along < BEHIND[1]) & (across < BESIDE + BESIDE_SHARE * distance)
        level = slabs.slice[thin][near]
        line[k] = np.isin(slabs.slice[own], level).sum() >= ALIKE
    return line


# Traffic signs by their light: small upright plates that throw it back as nothing else of their size and height does.
BRIGHT = 0.8  # reflectivity; retro-reflective foil fills the scale, white paint comes to 0.75
FROM = 1.5  # m; number plates, lamps and the stripes on clothes are lower
NEAREST = 4.0  # m; nearer, everything is bright
SIGN_JOINED, SIGN_CELL = 0.4, 0.05  # m between the points of a plate, and what counts once
SIGN_FEWEST = 4  # points
LENGTH, DEPTH, HEIGHT = (0.2, 1.8), 0.3, 0.1  # m; of a plate, the noise of ranges included. A single ring shows no plate
SHARE = 0.4  # of what is there and beside it that must be bright: a wall has bright spots
SIGN_BESIDE = 0.4  # m


def find_signs(xyz: Floats, light: Floats | None) -> NDArray[np.bool_]:
    """Which of the points (n, 3), z = height above the ground (m), lie on signs.

    light: (n,) reflectivity 0..1, None = unknown. Raises MissingDependencyError without scikit-learn.
    """
    found = np.zeros(len(xyz), bool)
    if light is None:
        return found
    high = np.nonzero((xyz[:, 2] > FROM) & (np.hypot(xyz[:, 0], xyz[:, 1]) > NEAREST))[0]
    bright = high[light[high] >= BRIGHT]
    for part in grouped(bright, cluster(xyz[bright], SIGN_JOINED, 1, SIGN_CELL)):
        if len(part) < SIGN_FEWEST:
            continue
        length, depth = box(xyz[part, :2])
        low, top = xyz[part].min(axis=0), xyz[part].max(axis=0)
        near = high[((xyz[high] >= low - SIGN_BESIDE) & (xyz[high] <= top + SIGN_BESIDE)).all(axis=1)]
        if LENGTH[0] <= length <= LENGTH[1] and depth <= DEPTH and top[2] - low[2] >= HEIGHT and len(part) >= SHARE * len(near):
            found[near[(xyz[near, 2] >= low[2]) & (xyz[near, 2] <= top[2])]] = True
    return found
