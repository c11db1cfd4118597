"""Shapes in a scan: surfaces around points, poles, and traffic signs."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.lidar.segmentation import cluster, connected_parts, neighbours_of

Floats = NDArray[np.float32]
Numbers = NDArray[np.intp]
# Surfaces.
SURFACE_CELL = 0.2  # m; cubes that count once, so that near surfaces are as dense as far ones
NEIGHBOURS, MAX_NEIGHBOUR_DISTANCE = 24, 1.5  # points that define the shape of a surface, and how far off they may be, m
MIN_NEIGHBOURS = 5  # for a shape
# Poles and the plates on them.
SLICE = 0.3  # m; the visible part of a pole has six or more, a traffic sign two or three
POLE_CELL = 0.1  # m; points nearer in a slice count once
SLICE_GAP = 0.3  # m; parts of a slice nearer than this are one; a pole in front of something stands farther off
SLICE_SEPARATION = 100.0  # m between slices in a KD-tree of all, so that neighbours are those of the same slice
MAX_POLE_WIDTH = 0.4  # m; lamp posts and masts, with range noise and the smear of beams at edges
PLATE_WIDTH = (0.3, 1.3)  # m; signs: from a plate of 0.4 m seen obliquely to a place-name sign
MAX_PLATE_DEPTH = 0.22  # m; with range noise; a head above shoulders is deeper
MIN_PLATE_HEIGHT = 1.2  # m; lower plates are boards, bins and people
CLEARANCE, CLEARANCE_SHARE = 0.4, 0.015  # m and share of the range that must be empty around: walls scanned at a slant have gaps
MAX_SLICE_OFFSET = 0.25  # m; between the centres of stacked slices
MAX_STACK_GAP, MAX_STACK_GAP_SHARE = 0.65, 0.04  # m and share of the range between stacked slices: rings that are 2 deg apart
MIN_POLE_HEIGHT = 1.8  # m from the lowest to the highest slice; stems of bushes and parts of people are shorter
MAX_FOOT_HEIGHT = 1.5  # m; what begins higher hangs from trees
MIN_SLICES = 3
MAX_MEDIAN_WIDTH = 0.26  # m; half of a pole's slices are thinner, those of old trees and of people are not
# A wall at a slant shows columns one or two beams apart (m and share of the range), this far one behind the other (m).
COLUMN_OFFSET, COLUMN_OFFSET_SHARE, COLUMN_DISTANCE = 0.1, 0.008, (0.4, 5.0)
WALL_SLICES = 2  # slices with such columns; a pole has a single one by chance
CROWN_RADIUS, CROWN_HEIGHT = 1.2, 1.6  # m around and above the top of a trunk
MIN_CROWN_SIZE = (1.2, 0.7)  # m; length and width; traffic lights are smaller, arms thinner
# Traffic signs by their reflectivity.
MIN_SIGN_REFLECTIVITY = 0.8  # retro-reflective foil saturates, white paint comes to 0.75
MIN_SIGN_HEIGHT = 1.5  # m; number plates, lamps and the stripes on clothes are lower
MIN_SIGN_DISTANCE = 4.0  # m; nearer, everything is bright
SIGN_EPS, SIGN_CELL = 0.4, 0.05  # m; between points of a plate, and within which points count once
MIN_SIGN_POINTS = 4
SIGN_LENGTH, MAX_SIGN_DEPTH, MIN_SIGN_EXTENT = (0.2, 1.8), 0.3, 0.1  # m; with range noise. A single ring shows no plate
MIN_BRIGHT_SHARE = 0.4  # of the points on and around a plate: a wall has bright spots
SIGN_SURROUNDINGS = 0.4  # m


class Surfaces(NamedTuple):
    """Surface shape around each point. scatter: (n,) surface variation, 0 = flat or straight, up to 1/3 = isotropic; NaN with too
    few neighbours. level: (n,) 0 = vertical surface, 1 = horizontal."""

    scatter: Floats
    level: Floats


def surface_shape(xyz: Floats) -> Surfaces:
    """Surface shape around points (n, 3), by the covariance of their neighbours (surface variation, Pauly et al. 2002).

    The scatter is averaged over the neighbours: foliage is flat in places, but not all around.
    """
    member, n = cell_numbers(xyz, (SURFACE_CELL, SURFACE_CELL, SURFACE_CELL))
    middle = group_means(xyz, member, n)
    far, near = neighbours_of(middle).query(middle, NEIGHBOURS, distance_upper_bound=MAX_NEIGHBOUR_DISTANCE)
    there = np.isfinite(far)
    near = np.where(there, near, 0)
    weight = (there / there.sum(axis=1, keepdims=True)).astype(np.float32)
    spread = (middle[near] - np.einsum("nk,nki->ni", weight, middle[near])[:, None]) * np.sqrt(weight)[..., None]
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread))
    scatter = values[:, 0].clip(0) / values.sum(axis=1).clip(1e-9)
    scatter = np.einsum("nk,nk->n", weight, scatter[near])
    scatter[there.sum(axis=1) < MIN_NEIGHBOURS] = np.nan
    return Surfaces(scatter[member].astype(np.float32), np.abs(vectors[:, 2, 0])[member].astype(np.float32))


def find_poles(xyz: Floats) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
    """Poles among points (n, 3) above the ground, z = height (m): thin slices above each other with nothing around them.
    Masks (n,) of points on poles, on plates of poles, and on trunks below a crown.

    Source: stacked hollow cylinders (Brenner 2009).
    """
    nothing = np.zeros(len(xyz), bool)
    if len(xyz) < MIN_SLICES:
        return nothing, nothing, nothing
    cell, n = cell_numbers(xyz, (POLE_CELL, POLE_CELL, SLICE))
    at = group_means(xyz, cell, n)
    layer = np.floor(at[:, 2] / SLICE).astype(np.intp)
    sliced = np.column_stack([at[:, :2], layer * SLICE_SEPARATION])
    tree = neighbours_of(sliced)
    part = connected_parts(tree.query_pairs(SLICE_GAP, output_type="ndarray"), n)
    slabs = _slabs(xyz, part[cell], layer, part)
    thin = slabs.size[:, 0] <= MAX_POLE_WIDTH
    width, depth = slabs.size.T
    plate = ~thin & (width >= PLATE_WIDTH[0]) & (width <= PLATE_WIDTH[1]) & (depth <= MAX_PLATE_DEPTH)
    plate &= slabs.slice * SLICE >= MIN_PLATE_HEIGHT
    alone = np.nonzero(thin | plate)[0]
    around = 0.5 * slabs.size[alone, 0] + CLEARANCE + CLEARANCE_SHARE * slabs.distance[alone]
    centre = np.column_stack([slabs.middle[alone], slabs.slice[alone] * SLICE_SEPARATION])
    alone = alone[np.asarray(tree.query_ball_point(centre, around, return_length=True) <= np.bincount(part)[alone])]
    stack = _stack_numbers(slabs, alone)
    good, trunk = _poles_and_trunks(slabs, alone, thin, stack, at, part)
    good &= ~_is_wall_column(slabs, alone[thin[alone]], alone, stack, good)
    kind = np.zeros(len(slabs.slice), np.uint8)
    kind[alone[good[stack]]] = 1
    kind[alone[trunk[stack]]] = 2
    of_point = kind[part[cell]]
    on_plate = (of_point == 1) & plate[part[cell]]
    return (of_point == 1) & ~on_plate, on_plate, of_point == 2


class Slabs(NamedTuple):
    """Connected parts of horizontal slices: centre (m, 2) m, distance (m,) m, slice number (m,), length and width (m, 2)."""

    middle: Floats
    distance: Floats
    slice: Numbers
    size: Floats


def _slabs(xyz: Floats, part: Numbers, layer: Numbers, part_of_cell: Numbers) -> Slabs:
    n = int(part_of_cell.max()) + 1
    middle = group_means(xyz[:, :2], part, n)
    off = xyz[:, :2] - middle[part]
    xx, xy, yy = group_means(np.column_stack([off[:, 0] ** 2, off[:, 0] * off[:, 1], off[:, 1] ** 2]), part, n).T
    turn = 0.5 * np.arctan2(2 * xy, xx - yy)  # of the longer principal axis
    c, s = np.cos(turn)[part], np.sin(turn)[part]
    sides = []
    for along in (c * off[:, 0] + s * off[:, 1], c * off[:, 1] - s * off[:, 0]):
        low, high = extents(along, part, n)
        sides.append(high - low)
    slices = np.zeros(n, np.intp)
    slices[part_of_cell] = layer
    return Slabs(middle, np.hypot(middle[:, 0], middle[:, 1]), slices, np.sort(np.stack(sides, 1), axis=1)[:, ::-1])


def _stack_numbers(slabs: Slabs, chosen: Numbers) -> Numbers:
    """Number of the stack of slabs above each other that each of the chosen slabs belongs to."""
    if len(chosen) == 0:
        return chosen
    pairs = neighbours_of(slabs.middle[chosen]).query_pairs(MAX_SLICE_OFFSET, output_type="ndarray")
    a, b = chosen[pairs].T
    apart = np.abs(slabs.slice[a] - slabs.slice[b]) * SLICE
    return connected_parts(pairs[apart <= MAX_STACK_GAP + MAX_STACK_GAP_SHARE * slabs.distance[a]], len(chosen))


def _poles_and_trunks(
    slabs: Slabs, chosen: Numbers, thin: NDArray[np.bool_], stack: Numbers, at: Floats, part: Numbers
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Masks of the stacks that are poles, and of those that are trunks."""
    n = int(stack.max()) + 1 if len(stack) else 0
    low, high = extents(slabs.slice[chosen].astype(np.float32) * np.float32(SLICE), stack, n)
    stems = np.bincount(stack, thin[chosen], n)
    upright = (high - low + SLICE >= MIN_POLE_HEIGHT) & (low <= MAX_FOOT_HEIGHT) & (stems >= MIN_SLICES)
    slender = np.bincount(stack, slabs.size[chosen, 0] <= MAX_MEDIAN_WIDTH, n)
    upright &= slender >= 0.5 * np.bincount(stack, minlength=n)
    wide = ~thin[part]
    crown = np.zeros(n, bool)
    if upright.any() and wide.any():
        foot = group_means(slabs.middle[chosen], stack, n)
        xy, z = at[wide, :2], at[wide, 2]
        tree = neighbours_of(xy)
        for k in np.nonzero(upright)[0]:
            near = np.array(tree.query_ball_point(foot[k], CROWN_RADIUS), np.intp)
            above = near[(z[near] > high[k]) & (z[near] < high[k] + SLICE + CROWN_HEIGHT)]
            crown[k] = len(above) >= 3 and bool(np.all(np.array(bounding_rectangle(xy[above])) >= MIN_CROWN_SIZE))
    return upright & ~crown, upright & crown


def _is_wall_column(
    slabs: Slabs, thin: Numbers, chosen: Numbers, stack: Numbers, candidates: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Which candidate stacks have other thin slabs in front or behind on nearly the same beam, as walls at a slant have."""
    line = np.zeros(len(candidates), bool)
    for k in np.nonzero(candidates)[0]:
        own = chosen[stack == k]
        foot = slabs.middle[own].mean(axis=0)
        distance = max(float(np.hypot(*foot)), 1e-6)
        off = slabs.middle[thin] - foot
        along = np.abs(off @ foot) / distance
        across = np.abs(off[:, 0] * foot[1] - off[:, 1] * foot[0]) / distance
        near = (along > COLUMN_DISTANCE[0]) & (along < COLUMN_DISTANCE[1])
        near &= across < COLUMN_OFFSET + COLUMN_OFFSET_SHARE * distance
        level = slabs.slice[thin][near]
        line[k] = np.isin(slabs.slice[own], level).sum() >= WALL_SLICES
    return line


def find_signs(xyz: Floats, light: Floats | None) -> NDArray[np.bool_]:
    """Mask (n,) of points (n, 3), z = height above the ground (m), on traffic signs: small retro-reflective upright plates.

    light: (n,) reflectivity 0..1, None = unknown.
    """
    found = np.zeros(len(xyz), bool)
    if light is None:
        return found
    high = np.nonzero((xyz[:, 2] > MIN_SIGN_HEIGHT) & (np.hypot(xyz[:, 0], xyz[:, 1]) > MIN_SIGN_DISTANCE))[0]
    bright = high[light[high] >= MIN_SIGN_REFLECTIVITY]
    for part in split_by_group(bright, cluster(xyz[bright], SIGN_EPS, 1, SIGN_CELL)):
        if len(part) < MIN_SIGN_POINTS:
            continue
        length, depth = bounding_rectangle(xyz[part, :2])
        low, top = xyz[part].min(axis=0), xyz[part].max(axis=0)
        near = high[((xyz[high] >= low - SIGN_SURROUNDINGS) & (xyz[high] <= top + SIGN_SURROUNDINGS)).all(axis=1)]
        if (
            SIGN_LENGTH[0] <= length <= SIGN_LENGTH[1]
            and depth <= MAX_SIGN_DEPTH
            and top[2] - low[2] >= MIN_SIGN_EXTENT
            and len(part) >= MIN_BRIGHT_SHARE * len(near)
        ):
            found[near[(xyz[near, 2] >= low[2]) & (xyz[near, 2] <= top[2])]] = True
    return found


def bounding_rectangle(xy: Floats) -> tuple[float, float]:
    """Length and width (m) of the smallest rectangle around points (n, 2)."""
    _, (a, b), _ = cv2.minAreaRect(np.ascontiguousarray(xy, np.float32))
    return max(a, b), min(a, b)


def cell_numbers(xyz: Floats, size: tuple[float, float, float]) -> tuple[NDArray[np.intp], int]:
    """Number (n,) of the cell with edges `size` (m) of each point (n, 3), and the number of cells with points."""
    cell = np.floor(xyz / np.array(size, np.float32)).astype(np.int64)
    cell -= cell.min(axis=0)
    span = cell.max(axis=0) + 1
    found, member = np.unique((cell[:, 0] * span[1] + cell[:, 1]) * span[2] + cell[:, 2], return_inverse=True)
    return member, len(found)


def group_means(values: Floats, member: NDArray[np.intp], n: int) -> Floats:
    """Mean (n, k) of the values (m, k) of each of n groups. member: (m,) group of each value."""
    count = np.maximum(np.bincount(member, minlength=n), 1)
    return np.stack([np.bincount(member, column, n) / count for column in values.T], axis=1).astype(np.float32)


def extents(values: Floats, member: NDArray[np.intp], n: int) -> tuple[Floats, Floats]:
    """Minimum and maximum (n,) of the values (m,) of each of n groups; inf, -inf for empty groups."""
    low, high = np.full(n, np.inf, np.float32), np.full(n, -np.inf, np.float32)
    np.minimum.at(low, member, values)
    np.maximum.at(high, member, values)
    return low, high


def split_by_group(items: NDArray[np.intp], number: NDArray[np.integer]) -> list[NDArray[np.intp]]:
    """The items (n,) of each group, in order. number: (n,) group of each item, from 0 without gaps."""
    if len(items) == 0:
        return []
    return np.split(items[np.argsort(number, kind="stable")], np.cumsum(np.bincount(number))[:-1])
