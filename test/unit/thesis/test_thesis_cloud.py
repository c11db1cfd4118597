"""Point attributes of the thesis (3.3, eq. 3.8 and 3.10, algorithms 1 and 2) in worlds whose answer is known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from helpers import GROUND, HEIGHT, Box, Plane, Spinner
from thesis_constants import thesis_with

from calib_ros.errors import TooFewFeaturesError
from calib_ros.frame import PointCloud
from calib_ros.lidar import segmentation
from calib_ros.lidar.segmentation import NOISE, _downsampled, cluster, fit_ground
from calib_ros_synthetic.drive import SyntheticDrive
from calib_ros_thesis.cloud import (
    NO_OBJECT,
    attributes,
    by_angle,
    by_height,
    by_range,
    by_reflectivity,
    depth,
    discontinuity,
    ground_plane,
    object_labels,
)
from calib_ros_thesis.config import ThesisConfig

CONFIG = ThesisConfig()
WALL = Plane((1, 0, 0), 20.0, 0.9)
BIG, SMALL = Box((10, 3, -HEIGHT), (12, 7, 1.5), 0.5), Box((9, -4, -HEIGHT), (10, -3, 0.5), 0.7)


def points(*rows: tuple[float, float, float]) -> np.ndarray:
    return np.array(rows, np.float32).reshape(-1, 3)


def at(azimuth_deg: float, r: float = 10.0) -> tuple[float, float, float]:
    return r * np.cos(np.deg2rad(azimuth_deg)), r * np.sin(np.deg2rad(azimuth_deg)), 0.0


def test_filters_include_their_limits():
    """Range is that of the depth; one reflectivity limit keeps what is above, two what is between."""
    d = depth(points((3, 4, 12), (-3, 4, -7), (0, 0, 5), (-8, 0, 0)))
    assert d.tolist() == [5, 5, 0, 8]
    assert d.dtype == np.float32
    xyz = points((1.99, 0, 50), (2, 0, 0), (3, 4, 100), (0, -5, 0), (0, 5.01, 0))
    assert by_range(xyz, 2.0, 5.0).tolist() == [False, True, True, True, False]
    xyz = points((9, 9, -1.01), (9, 9, -1), (9, 9, 0), (9, 9, 2), (9, 9, 2.01))
    assert by_height(xyz, -1.0, 2.0).tolist() == [False, True, True, True, False]
    r = np.array([0, 0.25, 0.5, 0.75, 1], np.float32)
    assert by_reflectivity(r, 0.5).tolist() == [False, False, True, True, True]
    assert by_reflectivity(r, 0.25, 0.5).tolist() == [False, True, True, False, False]
    empty = np.empty((0, 3), np.float32)
    assert len(depth(empty)) == len(by_angle(empty, 0, 10)) == len(by_range(empty, 0, 1)) == 0


@pytest.mark.parametrize(
    ("center", "half_width", "kept"),
    [
        (0, 45, [-44, 0, 44]),
        (90, 45.99, [46, 90, 134]),  # 44 and 136 lie at 46 deg: rounding, which differs between machines, must not decide
        (90, 46.01, [44, 46, 90, 134, 136]),
        (180, 45, [-179, -136, 136, 179, 180]),
        (-180, 45, [-179, -136, 136, 179, 180]),
        (-170, 36, [-179, -136, 179, 180]),
        (0, 179.5, [-179, -136, -90, -44, 0, 44, 46, 90, 134, 136, 179]),
        (77, 180, [-179, -136, -90, -44, 0, 44, 46, 90, 134, 136, 179, 180]),
    ],
)
def test_the_azimuth_window_may_run_across_the_rear(center, half_width, kept):
    azimuths = np.array([-179, -136, -90, -44, 0, 44, 46, 90, 134, 136, 179, 180])
    assert azimuths[by_angle(points(*map(at, azimuths)), center, half_width)].tolist() == kept


def slope(normal: tuple[float, float, float], offset: float, n: int = 2000, noise: float = 0.0, seed: int = 0) -> np.ndarray:
    """Points of a plane, within 30 m."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-30, 30, (n, 2))
    unit = np.array(normal) / np.linalg.norm(normal)
    z = (offset - xy @ unit[:2]) / unit[2] + rng.normal(0, noise, n)
    return np.column_stack([xy, z]).astype(np.float32)


def angle_deg(a: np.ndarray, b: tuple[float, ...]) -> float:
    unit = np.array(b) / np.linalg.norm(b)
    return float(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(a, unit)), a @ unit)))


def fit(xyz: np.ndarray, threshold: float = 0.2, iterations: int = 128, tilt: float = 15.0, share: float = 0.05, seed: int = 0):
    return fit_ground(xyz, threshold, iterations, tilt, share, seed)


@pytest.mark.parametrize("normal", [(0, 0, 1), (0.1, 0.05, 1), (-0.2, 0.1, 1), (0, 0, -1)])
def test_the_ground_is_found_among_walls_and_clutter(normal):
    up = np.array(normal) * np.sign(normal[2])
    rng = np.random.default_rng(1)
    clutter = rng.uniform((-30, -30, -1.2), (30, 30, 4), (1500, 3))
    clutter = clutter[clutter @ (up / np.linalg.norm(up)) > -1.2]
    wall = np.column_stack([rng.uniform(-30, 30, 3000), np.full(3000, 8.0), rng.uniform(-1.5, 6, 3000)])
    plane = fit(np.vstack([slope(up, -1.7, noise=0.01), wall, clutter]).astype(np.float32), threshold=0.1)
    assert angle_deg(plane.normal, tuple(up)) < 0.1
    assert plane.offset == pytest.approx(-1.7, abs=0.02)
    assert np.linalg.norm(plane.normal) == pytest.approx(1)
    assert plane.normal[2] > 0


def test_noise_is_averaged_out_by_the_fit_to_the_inliers():
    """A plane through three points with 5 cm of noise is off by about as much; one through 1000 is not."""
    planes = [fit(slope((0, 0, 1), -1.7, 2000, 0.05, seed), 0.15, iterations=3, seed=seed) for seed in range(10)]
    assert np.median([abs(plane.offset + 1.7) for plane in planes]) < 0.01


def test_planes_are_ground_up_to_the_tilt_allowed():
    rng = np.random.default_rng(2)
    wall = np.column_stack([rng.uniform(-30, 30, 500), np.full(500, 8.0), rng.uniform(-30, 30, 500)]).astype(np.float32)
    wall[:, 1] += 0.02 * wall[:, 2]  # not exactly upright
    assert fit(wall) is None
    assert angle_deg(fit(wall, tilt=90.0).normal, (0, -1, 0.02)) < 0.1
    ramp = slope((np.sin(np.deg2rad(10)), 0, np.cos(np.deg2rad(10))), -1.7)
    assert [fit(ramp, threshold=0.05, tilt=limit) is not None for limit in (9.5, 10.5)] == [False, True]


def test_the_larger_of_two_levels_is_the_ground_whatever_the_seed():
    street, roof = slope((0, 0, 1), -1.7, 600), slope((0, 0, 1), 3.0, 400)
    assert fit(np.vstack([street, roof])).offset == pytest.approx(-1.7, abs=1e-3)
    assert fit(np.vstack([street[:300], roof])).offset == pytest.approx(3.0, abs=1e-3)
    first, again, other = (fit(slope((0, 0, 1), -1.7, noise=0.1), iterations=2, seed=seed) for seed in (5, 5, 6))
    assert np.array_equal(first.normal, again.normal)
    assert first.offset == again.offset
    assert not np.array_equal(first.normal, other.normal)


@pytest.mark.parametrize(("share", "found"), [(0.19, True), (0.2, True), (0.21, False)])
def test_a_plane_with_too_small_a_share_of_the_points_is_no_ground(share, found):
    plane = slope((0, 0, 1), -1.7, 200)
    above = np.random.default_rng(3).uniform(5, 500, 800)
    scattered = np.column_stack([np.zeros(800), np.zeros(800), above]).astype(np.float32)  # on a line: in no level plane
    assert (fit(np.vstack([plane, scattered]), threshold=0.01, iterations=3000, share=share) is not None) == found


def test_three_points_are_a_plane_unless_they_lie_on_a_line():
    assert [fit(slope((0, 0, 1), -1.7, n), share=0.0) for n in range(3)] == [None] * 3
    assert fit(points((0, 0, -1), (1, 0, -1), (0, 1, -1)), share=0.0).offset == pytest.approx(-1)
    assert fit(points((0, 0, 0), (1, 1, 0), (2, 2, 0)), share=0.0) is None
    assert fit(points(*[(3, 4, 5)] * 50), share=0.0) is None


def blob(center: tuple[float, float, float], n: int, seed: int, spread: float = 0.3) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-spread, spread, (n, 3)).astype(np.float32) + np.float32(center)


BLOBS = np.vstack([blob((0, 0, 0), 40, 0), blob((5, 0, 0), 120, 1), blob((0, 6, 0), 70, 2), points((50, 0, 0), (0, 50, 0))])


def test_all_points_decide_which_plane_is_the_ground():
    """Of every third point, which is what a comparison on 5000 of them sees, all lie on the smaller plane."""
    rng = np.random.default_rng(5)
    xyz = np.c_[rng.uniform(-20, 20, (15000, 2)), np.full(15000, -1.0)].astype(np.float32)
    xyz[::3, 2] = -2.0
    plane = ground_plane(xyz, ThesisConfig())
    assert plane is not None
    assert plane.offset == pytest.approx(-1.0)
    few = fit_ground(xyz, 0.2, 128, 15.0, 0.05, 0)
    assert few is not None
    assert few.offset == pytest.approx(-2.0)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("voxel", [0.0, 0.05, 0.3, 1e-5, 1e-44])
def test_objects_are_numbered_by_size_and_loners_are_noise_with_any_voxels(voxel):
    """Those too small to index are not used."""
    expected = np.array(40 * [2] + 120 * [0] + 70 * [1] + 2 * [NOISE])
    assert cluster(points((1, 2, 3)), 0.7, 10, voxel).tolist() == [NOISE]
    assert cluster(np.empty((0, 3), np.float32), 0.7, 10, voxel).tolist() == []
    assert np.array_equal(cluster(BLOBS, 0.7, 10, voxel), expected)
    moved = BLOBS - np.float32((20.03, 7.01, 3.3))  # cubes on either side of the origin
    assert np.array_equal(cluster(moved, 0.7, 10, voxel), expected)
    order = np.random.default_rng(4).permutation(len(BLOBS))
    assert np.array_equal(cluster(BLOBS[order], 0.7, 10, voxel), expected[order])


def test_a_voxel_counts_for_all_its_points_and_lies_in_their_middle():
    """Nine points in one cube and one beside it: ten in reach, although only two cubes are."""
    xyz = np.vstack([np.full((9, 3), 0.05, np.float32), points((0.55, 0.05, 0.05), (9, 9, 9))])
    assert cluster(xyz, 0.6, 10, voxel=0.1).tolist() == 10 * [0] + [NOISE]
    assert cluster(xyz, 0.6, 11, voxel=0.1).tolist() == 11 * [NOISE]
    # Points at the two ends of a cube of 1 m have their middle at 0.5 m, 0.95 m from the third.
    ends = points((0.05, 0, 0), (0.95, 0, 0), (1.45, 0, 0))
    assert cluster(ends, 0.94, 3, voxel=1.0).tolist() == 3 * [NOISE]
    assert cluster(ends, 0.96, 3, voxel=1.0).tolist() == [0, 0, 0]


@pytest.mark.parametrize("min_points", [1, 4, 10, 25])
@pytest.mark.parametrize("voxel", [0.0, 0.15])
def test_clusters_are_those_of_dbscan(min_points, voxel):
    """Against scikit-learn, on scattered points: core points, points on borders between clusters, noise."""
    from sklearn.cluster import DBSCAN  # takes a second of every process that collects this file

    xyz = np.random.default_rng(min_points).uniform(0, 6, (1500, 3)).astype(np.float32)
    few, weight, member = _downsampled(xyz, voxel)
    expected = DBSCAN(eps=0.5, min_samples=min_points).fit(few, sample_weight=weight).labels_[member]
    found = cluster(xyz, 0.5, min_points, voxel)
    assert found.dtype == np.int32
    assert np.array_equal(found == NOISE, expected == NOISE)
    pairs = set(zip(found.tolist(), expected.tolist(), strict=True))
    assert len(pairs) == len(set(found.tolist())) == len(set(expected.tolist()))  # the same clusters, whatever their numbers
    assert (np.diff(np.bincount(found[found >= 0])) <= 0).all()  # by size
    assert min_points == 1 or (found == NOISE).any()


def test_more_objects_than_labels_start_again_at_one():
    # 300 objects of 10 points, 10 m apart, the first of them larger.
    n = ThesisConfig.cluster_min_points
    x = 10.0 * np.repeat(np.arange(300), n)
    xyz = np.column_stack([x, np.tile(0.05 * np.arange(n), 300), np.zeros(300 * n)]).astype(np.float32)
    xyz = np.vstack([xyz, points((0, 0.3, 0))])
    label = object_labels(xyz, np.full(len(xyz), 5.0, np.float32), np.zeros(len(xyz), bool), CONFIG)
    assert label[0] == label[-1] == 1
    assert label[n * 253] == 254
    assert label[n * 254] == 1
    assert label[n * 299] == 46
    assert label.min() == 1


def by_definition(cloud: PointCloud, ring: np.ndarray) -> np.ndarray:
    """Eq. 3.10, point after point."""
    q = [float(np.sqrt((p.astype(float) ** 2).sum())) for p in cloud.xyz]
    azimuth = np.arctan2(cloud.xyz[:, 1], cloud.xyz[:, 0])
    xi = np.zeros(len(q))
    for number in set(ring.tolist()):
        members = sorted(np.flatnonzero(ring == number), key=lambda i: azimuth[i])
        for k, i in enumerate(members):
            xi[i] = max(q[members[k - 1]] - q[i], q[members[(k + 1) % len(members)]] - q[i], 0)
    return xi


def ringed(*returns: tuple[float, float, int]) -> PointCloud:
    """Of azimuth, range and ring of each."""
    return PointCloud(points(*(at(a, r) for a, r, _ in returns)), None, np.array([ring for *_, ring in returns], np.int32))


# 180 and -90 deg are neighbours; of three each has both others beside it; the last one is alone in its ring.
RINGS = [(-90, 10, 0), (0, 5, 0), (90, 7, 0), (180, 4, 0), (-120, 8, 3), (10, 8.5, 3), (100, 6, 3), (30, 90, 1)]


def test_discontinuity_by_hand_on_rings_that_close_upon_themselves():
    """In any order of the points; one that is alone in its ring has none."""
    for seed in range(4):
        order = np.random.default_rng(seed).permutation(len(RINGS))
        xi = discontinuity(ringed(*RINGS).select(order))
        assert xi == pytest.approx(np.array([0, 5, 0, 6, 0.5, 0, 2.5, 0])[order], abs=1e-5)
        assert xi.dtype == np.float32
    for ring in (None, np.zeros(1, np.int32)):
        assert discontinuity(PointCloud(points((3, 4, 0)), None, ring)).tolist() == [0]
    assert discontinuity(PointCloud(np.empty((0, 3), np.float32))).tolist() == []
    # The range is that in space: 3-4-5 triangles of the same depth above each other, with ranges of 5 and 13.
    above = PointCloud(points((3, 0, 4), (0, 5, 12), (0, -1, 0)), None, np.array([0, 0, 1], np.int32))
    assert discontinuity(above) == pytest.approx([8, 0, 0], abs=1e-5)


def test_a_street_agrees_with_the_definition():
    cloud = SyntheticDrive(seed=2, frames=1, rings=32, width=64, height=48)[0].cloud.finite()
    xi = discontinuity(cloud)
    assert xi == pytest.approx(by_definition(cloud, cloud.ring), abs=1e-4)
    assert (xi > 1).mean() > 0.005  # there is something to see
    assert xi.min() == 0


@pytest.fixture(scope="module")
def scene() -> PointCloud:
    return Spinner(rings=64, low=-24.0, high=4.0).scan([GROUND, WALL, BIG, SMALL], "shuffled")


def test_ground_and_objects_are_separated(scene):
    found = attributes(scene, CONFIG)
    x, y, z = found.xyz.T
    limit = -HEIGHT + CONFIG.ground_distance
    assert found.ground[z < limit - 0.005].all()  # the fit to the inliers, feet of walls among them, is off by millimetres
    assert not found.ground[z > limit + 0.005].any()
    on_wall, on_big, on_small = (~found.ground & m for m in (x > 19.9, (x < 12.1) & (y > 2.9), (x < 10.1) & (y < -2.9)))
    assert (on_wall | on_big | on_small | found.ground).all()
    assert on_wall.sum() > on_big.sum() > on_small.sum() > 50
    # The big box hides the wall from y = 5 to 14 m, so that it is two objects; both end at the range limit of 40 m.
    for where, label in ((on_wall & (y < 4.9), 1), (on_wall & (y > 14.1), 3), (on_big, 2), (on_small, 4)):
        assert set(found.label[where]) - ({NO_OBJECT} if label % 2 else set()) == {label}
    assert (found.label[on_wall & (found.depth < 39)] > 0).mean() > 0.99
    assert found.reflectivity[on_big] == pytest.approx(np.full(on_big.sum(), 0.5))
    assert found.reflectivity[on_wall] == pytest.approx(np.full(on_wall.sum(), 0.9))
    assert not found.label[found.ground | (found.depth > 40)].any()
    assert found.depth[found.label > 0].max() > 39
    assert found.depth.max() > 41


def test_far_points_come_first_and_no_attribute_loses_its_point(scene):
    found = attributes(scene, CONFIG)
    assert (np.diff(found.depth) <= 0).all()
    assert np.array_equal(found.depth, np.hypot(found.xyz[:, 0], found.xyz[:, 1]))
    place = {tuple(p): k for k, p in enumerate(scene.xyz.tolist())}
    source = np.array([place[tuple(p)] for p in found.xyz.tolist()])
    assert len(set(source)) == len(found)
    assert np.array_equal(found.reflectivity, scene.intensity[source])
    assert np.array_equal(found.discontinuity, discontinuity(scene)[source])
    for some in (found.select(found.label == 2), found.select(np.flatnonzero(found.label == 2))):
        for f in dataclasses.fields(found):
            assert np.array_equal(getattr(some, f.name), getattr(found, f.name)[found.label == 2])
    w = found.weight(nearest=4.0)  # near and bright points weigh most
    assert w == pytest.approx((found.reflectivity + np.minimum(4 / found.depth, 1)) / 2)
    assert w.dtype == np.float32


def test_only_points_within_the_thresholds_are_left(scene):
    config = thesis_with(
        min_depth=5.0, max_depth=18.0, min_height=-1.0, max_height=0.5, azimuth_half_width_deg=30.0, min_reflectivity=0.4
    )
    found = attributes(scene, config)
    x, y, z = scene.xyz.T.astype(float)
    keep = (np.hypot(x, y) >= 5) & (np.hypot(x, y) <= 18) & (z >= -1) & (z <= 0.5)
    keep &= (np.abs(np.rad2deg(np.arctan2(y, x))) < 30) & (scene.intensity >= 0.4)
    assert {tuple(p) for p in found.xyz.tolist()} == {tuple(p) for p in scene.xyz[keep].tolist()}
    assert 100 < len(found) < len(scene) / 2
    # A filter that takes the background away leaves the discontinuity in front of it.
    near = attributes(scene, thesis_with(max_depth=15.0))
    assert near.discontinuity[~near.ground & (near.xyz[:, 1] > 2.9)].max() > 7
    dull = attributes(scene, thesis_with(max_reflectivity=0.3))
    assert 0 < len(dull) < len(attributes(scene, CONFIG))
    assert dull.reflectivity.max() <= 0.3
    none = attributes(scene, thesis_with(min_height=50.0, max_height=60.0))
    assert (len(none), none.label.dtype) == (0, np.uint8)


@pytest.mark.parametrize("filtered", [{"min_height": -1.0}, {"min_reflectivity": 0.4}])
def test_nothing_else_becomes_ground_when_the_ground_is_filtered_out(scene, filtered):
    """A level slice through walls and boxes holds more than ground_share of what is left."""
    found = attributes(scene, thesis_with(**filtered))
    upper = found.xyz[:, 2] > -1.4
    assert upper.sum() > 5000
    assert not found.ground[upper].any()
    assert set(found.label[upper]) - {NO_OBJECT} == {1, 2, 3, 4}


@pytest.mark.parametrize("intensity", [None, "constant", "nan"])
def test_without_intensity_reflectivity_is_zero_and_no_threshold_applies(scene, intensity):
    values = None if intensity is None else np.full(len(scene), 7 if intensity == "constant" else np.nan, np.float32)
    bare = PointCloud(scene.xyz, values, scene.ring)
    for config in (CONFIG, thesis_with(min_reflectivity=0.5)):
        found = attributes(bare, config)
        assert not found.reflectivity.any()
        assert len(found) == len(attributes(scene, CONFIG)) > 1000


@pytest.mark.parametrize("lost", [np.nan, np.inf, 0.0])
def test_lost_returns_change_nothing(scene, lost):
    n = len(scene)
    where = np.sort(np.random.default_rng(5).choice(2 * n, n, replace=False))
    xyz, intensity, ring = np.full((2 * n, 3), lost, np.float32), np.zeros(2 * n, np.float32), np.zeros(2 * n, np.int32)
    xyz[where], intensity[where], ring[where] = scene.xyz, scene.intensity, scene.ring
    found, plain = (attributes(cloud, CONFIG) for cloud in (PointCloud(xyz, intensity, ring), scene))
    for f in dataclasses.fields(plain):
        assert np.array_equal(getattr(found, f.name), getattr(plain, f.name)), f.name


@pytest.mark.parametrize(("n", "value", "usable"), [(0, 0.0, 0), (5000, np.nan, 0), (5000, 0.0, 0), (99, 5.0, 99)])
def test_a_covered_scanner_is_refused(n, value, usable):
    with pytest.raises(TooFewFeaturesError, match=f" {usable} usable points"):
        attributes(PointCloud(np.full((n, 3), value, np.float32)), CONFIG)


@pytest.mark.parametrize("facing", [0.0, 180.0])
def test_the_two_ends_of_a_limited_field_are_no_neighbours(facing):
    """A wall on the left of the field, nothing near on the right: only literally would the first and last return touch."""
    azimuth = np.deg2rad(facing + np.linspace(-50, 50, 101))
    q = np.where(np.arange(101) < 50, 5.0, 30.0)
    xyz = np.c_[q * np.cos(azimuth), q * np.sin(azimuth), np.zeros(101)].astype(np.float32)
    ring = np.repeat([0, 1], 101).astype(np.int32)
    both = np.concatenate([xyz, xyz - [0, 0, 1]]).astype(np.float32)
    xi = discontinuity(PointCloud(both, None, ring))
    assert np.flatnonzero(xi > 1).tolist() == [49, 150]


def test_large_neighbourhoods_use_larger_voxels(monkeypatch):
    """Two dense blobs: 4000 points with thousands of neighbours each."""
    rng = np.random.default_rng(0)
    xyz = np.concatenate([rng.normal(x, 0.2, (n, 3)) for x, n in ((0.0, 2500), (9.0, 1500))]).astype(np.float32)
    seen, real = [], segmentation._dbscan
    monkeypatch.setattr(segmentation, "_dbscan", lambda points, *others: seen.append(len(points)) or real(points, *others))
    expected = cluster(xyz, 2.0, 10)
    monkeypatch.setattr(segmentation, "MAX_NEIGHBOURS", 2e6)
    assert cluster(xyz, 2.0, 10).tolist() == expected.tolist() == 2500 * [0] + 1500 * [1]
    assert seen[0] == 4000
    assert seen[1] < 3000
