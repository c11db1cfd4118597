"""Dense maps and their edges (thesis 3.4.3, eq. 3.11): by hand, against scipy, and the fast form against the readable one."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from scipy import ndimage
from thesis_constants import thesis_with

from calib_ros.camera import Camera
from calib_ros.registration.score.point_score import nearest_per_pixel, project
from calib_ros_thesis.cloud import PointAttributes
from calib_ros_thesis.config import ThesisConfig
from calib_ros_thesis.image import OPERATORS
from calib_ros_thesis.maps import (
    EMPTY,
    FAR_LEVEL,
    REACH,
    EdgeMaps,
    FastEdgeMaps,
    PointLevels,
    close_gaps,
    complete,
    complete_depth,
    complete_fast,
    edge_maps,
    far_level,
    low_level,
)

CONFIG = ThesisConfig()
FAR = 6000


def sparse_map(shape: tuple[int, int], share: float, seed: int, low: int = 1, high: int = FAR) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.where(rng.random(shape) < share, rng.integers(low, high + 1, shape), 0).astype(np.int16)


def single(shape: tuple[int, int], *entries: tuple[int, int, int]) -> np.ndarray:
    sparse = np.zeros(shape, np.int16)
    for y, x, level in entries:
        sparse[y, x] = level
    return sparse


def offsets(shape: tuple[int, int], y: int, x: int) -> tuple[np.ndarray, np.ndarray]:
    """Distances (h, w) of all pixels from (y, x), down and across."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    return np.abs(rows - y), np.abs(columns - x)


# Density completion, eq. 3.11 and figure 3.13


def test_completion_agrees_with_the_same_steps_of_scipy():
    for share, shape in itertools.product((0.003, 0.03, 0.3), ((40, 50), (120, 90), (7, 64))):
        sparse = sparse_map(shape, share, seed=1)
        diamond = ndimage.iterate_structure(ndimage.generate_binary_structure(2, 1), 2)

        def dilated(a: np.ndarray, footprint: np.ndarray) -> np.ndarray:
            return ndimage.grey_dilation(a, footprint=footprint, mode="constant", cval=0)

        dense = dilated(dilated(sparse, diamond), np.ones((5, 5)))
        dense = ndimage.grey_erosion(dense, size=(5, 5), mode="constant", cval=32767)
        for size in (7, 31):
            dense = np.where(dense == 0, dilated(dense, np.ones((size, size))), dense)
        dense = ndimage.median_filter(dense, size=5, mode="nearest")
        assert dense.any()
        assert np.array_equal(complete(sparse), dense)
    assert not complete(np.zeros((61, 61), np.int16)).any()


def test_a_point_acts_on_nothing_beyond_the_reach():
    """What FastEdgeMaps crops by; its edges at the points alone would hardly tell a crop too small."""
    farthest = 0
    for share, seed in itertools.product((0.002, 0.05, 0.5), range(6)):
        sparse = sparse_map((90, 90), share, seed)
        y, x = np.random.default_rng(seed).integers(20, 70, 2)
        changed = sparse.copy()
        changed[y, x] = 6001
        difference = complete(sparse) != complete(changed)
        farthest = max(farthest, np.maximum(*offsets(sparse.shape, y, x))[difference].max())
    assert 0 < farthest <= REACH


def test_the_larger_level_grows_by_two_pixels_and_the_smaller_one_keeps_the_rest():
    """Depth is inverted first: at the border of two surfaces it is the near one that grows."""
    columns = np.tile(np.arange(40), (30, 1))
    halves, grown = (np.where(columns < border, 100, 200).astype(np.int16) for border in (20, 18))
    assert np.array_equal(complete(halves), grown)
    assert np.array_equal(complete_depth(300 - halves, FAR), 300 - grown)


def test_the_compiled_completion_gives_the_same_to_the_bit_for_whatever_shape():
    shapes = [(120, 160), (30, 40), (160, 120), (1, 1), (4, 1), (1, 4), (2, 2), (3, 200), (199, 7), (120, 160), (61, 61)]
    for (seed, shape), share in itertools.product(enumerate(shapes), (0.0, 0.01, 0.2, 1.0)):
        sparse = sparse_map(shape, share, seed)
        before = sparse.copy()
        dense = complete_fast(sparse)
        assert (dense.shape, dense.dtype) == (shape, np.int16)
        assert np.array_equal(dense, complete(sparse))
        inverted = np.where(sparse != 0, FAR + 1 - sparse, 0).astype(np.int16)
        assert np.array_equal(complete_fast(inverted, FAR + 1), complete_depth(sparse, FAR))
        assert np.array_equal(sparse, before)


# Closing of the object map


def test_closing_of_odd_and_even_sizes_stays_in_place():
    """No label sinks, what is closed stays closed, and turning the map turns the result; odd sizes are scipy's."""
    for size in (1, 2, 3, 4, 9, 10, 31):
        labels = (sparse_map((60, 80), 0.1, 5) % 200).astype(np.uint8)
        closed = close_gaps(labels, size)
        assert (closed >= labels).all()
        assert np.array_equal(close_gaps(closed, size), closed)
        wide = np.pad(labels, size)
        turned = close_gaps(np.ascontiguousarray(wide[::-1, ::-1]), size)
        assert np.array_equal(turned[::-1, ::-1], close_gaps(wide, size))
        if size % 2:
            assert np.array_equal(close_gaps(wide, size), ndimage.grey_closing(wide, size=(size, size), mode="constant"))
        out = np.empty_like(labels)
        assert np.shares_memory(close_gaps(labels, size, out), out)
        assert np.array_equal(out, closed)


def attributes_of(depth, reflectivity, ground, label) -> PointAttributes:
    n = len(depth)
    return PointAttributes(
        np.zeros((n, 3), np.float32),
        np.array(depth, np.float32),
        np.array(reflectivity, np.float32),
        np.zeros(n, np.float32),
        np.array(ground, bool),
        np.array(label, np.uint8),
    )


def test_levels_are_centimetres_and_thousandths():
    """Ground has no depth, but its reflectivity."""
    ground = [0, 0, 0, 0, 0, 1]
    points = attributes_of([2, 12.346, 60, 0.001, 200, 10], [0, 0.25, 1, 0.5, 0.1, 0.5], ground, [0, 1, 2, 3, 254, 0])
    levels = PointLevels.of(points)
    assert levels.depth.tolist() == [200, 1235, 6000, 1, FAR_LEVEL, EMPTY]
    assert levels.reflectivity.tolist() == [1, 251, 1001, 501, 101, 501]
    assert levels.label.tolist() == [0, 1, 2, 3, 254, 0]
    assert levels.depth.dtype == levels.reflectivity.dtype == np.int16
    some = levels.select(np.array([2, 0]))
    assert (some.depth.tolist(), some.reflectivity.tolist(), some.label.tolist()) == ([6000, 200], [1001, 1], [2, 0])


def test_depth_is_inverted_about_the_farthest_that_passes():
    for max_depth, level in ((60.0, 6000), (5.0, 500), (300.0, FAR_LEVEL)):
        assert far_level(thesis_with(max_depth=max_depth)) == level
    assert low_level(CONFIG) == 300
    for level in (1, 2, 5999, FAR):  # and inverted back at both ends
        assert set(np.unique(complete_depth(single((61, 61), (30, 30, level)), FAR))) == {0, level}


def wall_and_box(share: float = 0.25, seed: int = 7) -> tuple[np.ndarray, np.ndarray, PointAttributes]:
    """(u, v, attributes): a wall at 20 m, object 1; in columns 80 to 139 a bright box at 10 m, object 2; ground below."""
    rng = np.random.default_rng(seed)
    v, u = np.nonzero(rng.random((120, 220)) < share)
    box = (u >= 80) & (u < 140) & (v < 90)
    ground = v >= 90
    depth = np.where(ground, 8.0, np.where(box, 10.0, 20.0))
    label = np.where(ground, 0, np.where(box, 2, 1))
    return u, v, attributes_of(depth, np.where(box, 0.8, 0.1), ground, label)


def maps_of(u: np.ndarray, v: np.ndarray, points: PointAttributes, config: ThesisConfig = CONFIG) -> EdgeMaps:
    return edge_maps(v * 220 + u, PointLevels.of(points), (120, 220), config)


def columns(edges: np.ndarray, rows: slice = slice(20, 80)) -> set[int]:
    return set(np.nonzero(edges[rows].any(axis=0))[0].tolist())


def test_sparse_maps_hold_the_points_and_nothing_else():
    """Ground points are no part of the depth maps."""
    u, v, points = wall_and_box()
    maps = maps_of(u, v, points)
    assert maps.occupied.sum() == len(u)
    assert maps.occupied[v, u].all()
    assert maps.sparse_depth[v, u] == pytest.approx(np.where(points.ground, 0, 100 * points.depth))
    assert np.count_nonzero(maps.sparse_depth) == np.count_nonzero(~points.ground)
    assert maps.sparse_reflectivity[v, u] == pytest.approx(1 + 1000 * points.reflectivity)
    assert np.array_equal(maps.sparse_object[v, u], points.label)
    assert not maps.sparse_object[~maps.occupied].any()
    assert set(np.unique(maps.dense_depth)) == {0, 1000, 2000}  # 800 is the ground's
    assert not maps.dense_depth[112:].any()


def test_depth_edges_are_the_outline_of_the_near_object(monkeypatch):
    u, v, points = wall_and_box()
    for operator in OPERATORS:
        found = columns(maps_of(u, v, points, ThesisConfig(operator=operator)).depth_edges)
        assert found
        assert all(min(abs(c - 79.5), abs(c - 139.5)) < 6 for c in found)
    monkeypatch.setattr("calib_ros_thesis.maps.DEPTH_STEP", 5.0)
    full = maps_of(u, v, points, ThesisConfig(operator="sobel")).depth_edges[20:80].max(axis=1)
    assert full == pytest.approx(np.ones(60))  # 10 m are more than a full step of 5 m
    monkeypatch.setattr("calib_ros_thesis.maps.DEPTH_STEP", 40.0)
    half = maps_of(u, v, points, ThesisConfig(operator="sobel")).depth_edges[20:80, 60:160]
    assert np.median(half.max(axis=1)) == pytest.approx(0.25, abs=0.02)


def test_object_edges_are_only_where_the_object_changes():
    u, v, points = wall_and_box(share=0.4)
    maps = maps_of(u, v, points, ThesisConfig(operator="sobel"))
    assert set(np.unique(maps.dense_object[:85])) == {1, 2}
    change = np.zeros((120, 220), bool)
    change[:, 1:] |= maps.dense_object[:, 1:] != maps.dense_object[:, :-1]
    change[1:] |= maps.dense_object[1:] != maps.dense_object[:-1]
    assert not maps.object_edges[~ndimage.binary_dilation(change, np.ones((5, 5)))].any()
    found = columns(maps.object_edges)
    assert found
    assert all(min(abs(c - 79.5), abs(c - 139.5)) < 8 for c in found)
    # Labels are names: the step from 1 to 2 is as full an edge as that from 1 to 200.
    other = dataclasses.replace(points, label=np.where(points.label == 2, 200, points.label).astype(np.uint8))
    assert np.array_equal(maps_of(u, v, other, ThesisConfig(operator="sobel")).object_edges > 0, maps.object_edges > 0)
    assert maps.object_edges[20:80].max(axis=1) == pytest.approx(np.ones(60))
    one = maps_of(u, v, dataclasses.replace(points, label=np.ones(len(points), np.uint8)))  # whatever its depth
    assert columns(one.object_edges) == set()
    assert columns(one.depth_edges)


def test_low_reflectivity_is_removed_from_the_dense_map():
    u, v, points = wall_and_box()
    maps = maps_of(u, v, points)  # 0.1 and 0.8, limit 0.3
    assert set(np.unique(maps.dense_reflectivity)) == {0, 801}
    assert set(np.unique(maps_of(u, v, points, thesis_with(low_reflectivity=0.0)).dense_reflectivity)) >= {101, 801}
    removed = maps_of(u, v, points, thesis_with(low_reflectivity=0.9))
    assert not removed.dense_reflectivity.any()
    assert not removed.reflectivity_edges.any()
    # Differences of low reflectivity are no edges; without the limit they are.
    dull = dataclasses.replace(points, reflectivity=np.where(points.label == 2, 0.25, 0.02).astype(np.float32))
    assert not maps_of(u, v, dull).reflectivity_edges.any()
    assert columns(maps_of(u, v, dull, thesis_with(low_reflectivity=0.0)).reflectivity_edges)


def test_the_scan_s_edges_are_the_mean_of_three_where_points_are():
    u, v, points = wall_and_box()
    maps = maps_of(u, v, points)
    total = maps.lidar_edges
    assert total.dtype == np.float32
    assert not total[~maps.occupied].any()
    mean = (maps.depth_edges.astype(float) + maps.reflectivity_edges + maps.object_edges) / 3
    assert total[v, u] == pytest.approx(mean[v, u], abs=1e-6)
    assert 0.5 < total.max() <= 1
    assert (mean[~maps.occupied] > 0.3).any()  # the operator alone finds edges between the points too


def scattered(seed: int, shape: tuple[int, int], share: float, region: tuple[slice, slice]):
    """(u, v, levels): patches of a few depths, reflectivities and objects, sampled in a region, in any order."""
    rng = np.random.default_rng(seed)
    mask = np.zeros(shape, bool)
    mask[region] = rng.random(mask[region].shape) < share
    v, u = np.nonzero(mask)
    order = rng.permutation(len(u))
    u, v = u[order], v[order]
    patch = (v // 13) * 31 + u // 17
    depth = rng.uniform(2, 60, 2000)[patch % 2000] + rng.normal(0, 0.1, len(u))
    reflectivity = np.clip(rng.random(2000)[patch % 2000] + rng.normal(0, 0.05, len(u)), 0, 1)
    label = rng.integers(0, 255, 2000)[patch % 2000]
    return u, v, PointLevels.of(attributes_of(np.clip(depth, 2, 60), reflectivity, rng.random(len(u)) < 0.3, label))


def edges_of(fast: FastEdgeMaps, u: np.ndarray, v: np.ndarray, levels: PointLevels) -> np.ndarray:
    return fast(u.astype(np.int32), v.astype(np.int32), np.arange(len(u)), levels)


def same(fast: FastEdgeMaps, u: np.ndarray, v: np.ndarray, levels: PointLevels) -> np.ndarray:
    shape = (fast.height, fast.width)
    expected = edge_maps(v * shape[1] + u, levels, shape, fast.config).lidar_edges[v, u]
    found = edges_of(fast, u, v, levels)
    assert found.dtype == np.float32
    assert np.array_equal(found, expected)
    return found


ALL, CORNER, ONE = (slice(None), slice(None)), (slice(5, 40), slice(150, 200)), (slice(60, 61), slice(100, 101))


OTHERS = ({"low_reflectivity": 0.0}, {"low_reflectivity": 1.0}, {"max_depth": 300.0})
SETTINGS = [*(ThesisConfig(operator=name) for name in OPERATORS), *(thesis_with(**constants) for constants in OTHERS)]


@pytest.mark.parametrize("config", SETTINGS)
def test_the_fast_form_gives_the_same_edges_to_the_bit(config):
    """However often, in any order of the points, and at the border of the picture."""
    fast = FastEdgeMaps(130, 240, config)
    u, v, levels = scattered(0, (130, 240), 0.1, ALL)
    before = same(fast, u, v, levels).copy()
    for seed, (share, region) in itertools.product(range(2), ((0.1, ALL), (0.02, CORNER), (0.4, CORNER), (0.001, ALL))):
        found = same(fast, *scattered(seed, (130, 240), share, region))
        assert len(found) == 0 or share < 0.1 or found.max() > 0
    whole, first, last = slice(None), slice(0, 1), slice(-1, None)
    regions = [(first, whole), (last, whole), (whole, slice(0, 2)), (whole, last), (slice(0, 20), slice(0, 20))]
    for region in (*regions, (slice(-20, None), slice(-20, None)), ONE):
        assert len(same(fast, *scattered(5, (130, 240), 1.0, region)))
    order = np.random.default_rng(9).permutation(len(u))
    assert np.array_equal(edges_of(fast, u[order], v[order], levels.select(order)), before[order])


def test_the_fast_form_is_exact_for_pictures_of_any_size():
    for shape in ((1, 1), (4, 1), (1, 4), (3, 50), (50, 3), (375, 1242)):
        same(FastEdgeMaps(*shape, CONFIG), *scattered(6, shape, 0.05 if shape[0] > 50 else 0.9, ALL))
    none, nothing = PointLevels.of(attributes_of([], [], [], [])), np.empty(0, np.intp)
    maps = edge_maps(nothing, none, (30, 40), CONFIG)
    assert maps.lidar_edges.shape == (30, 40)
    assert not maps.lidar_edges.any()
    assert edges_of(FastEdgeMaps(30, 40, CONFIG), nothing, nothing, none).tolist() == []


def test_of_the_points_on_a_pixel_the_nearest_is_visible():
    """The same as by project and nearest_per_pixel of point_score."""
    rng = np.random.default_rng(2)
    fast = FastEdgeMaps(20, 30, CONFIG)
    depth = np.linspace(30, -2, 5000).astype(np.float32)
    u, v = rng.uniform(-8, 38, 5000), rng.uniform(-8, 28, 5000)
    xyz = np.array([u * depth, v * depth, depth], np.float32)
    columns, rows, points = fast.visible(xyz)
    u, v, inside = project(xyz.T, np.eye(4), Camera(np.eye(3), 30, 20))
    pixels, expected = nearest_per_pixel(v * 30 + u, inside, 600)
    assert np.array_equal(rows * 30 + columns, pixels)
    assert np.array_equal(points, expected)
    assert 500 < len(points) < len(inside)
