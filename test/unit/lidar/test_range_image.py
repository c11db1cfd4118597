"""Range images of ideal scans: rings, rows, columns, isolated returns."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from helpers import GROUND, Box, Plane, Spinner

from calib_ros.arrays import quantile
from calib_ros.config import LidarConfig
from calib_ros.errors import TooFewFeaturesError
from calib_ros.frame import PointCloud
from calib_ros.lidar.range_image import BRIGHT, _rows_from_top, cell_size, range_image
from calib_ros.lidar.rings import ring_of_points

WALLS = [Plane((1, 0, 0), 25), Plane((-1, 0, 0), 12), Plane((0, 1, 0), 9), Plane((0, -1, 0), 15)]
BOXES = [Box((6, -1, -1.7), (7, 1, 0.2)), Box((-5, 3, -1.7), (-4, 4, 2))]
ROOM = [GROUND, *WALLS, *BOXES]
MODELS = {
    "16 rings": {"rings": 16, "low": -15, "high": 15, "step": 0.2},
    "32 rings": {"rings": 32, "low": -30, "high": 10, "step": 0.25},
    "64 rings": {"rings": 64, "low": -24.8, "high": 2, "step": 0.35},
}
CONFIG = LidarConfig()


def rings_of(cloud: PointCloud) -> np.ndarray:
    azimuth = np.arctan2(cloud.xyz[:, 1], cloud.xyz[:, 0])
    return ring_of_points(cloud, azimuth, np.arcsin(cloud.xyz[:, 2] / np.linalg.norm(cloud.xyz, axis=1)))


def same_partition(a: np.ndarray, b: np.ndarray) -> bool:
    return len(np.unique(a)) == len(np.unique(b)) == len(np.unique(np.c_[a, b], axis=0))


def without_ring(cloud: PointCloud) -> PointCloud:
    return PointCloud(cloud.xyz, cloud.intensity)


@pytest.mark.parametrize("starts", [(37.3,), pytest.param((0, 180, -180, -91.1), marks=pytest.mark.slow)])
def test_rings_are_found_whatever_the_order_of_points(starts):
    for model, start, clockwise, order in itertools.product(MODELS, starts, (False, True), ("ring", "column", "shuffled")):
        cloud = Spinner(start=start, clockwise=clockwise, **MODELS[model]).scan(ROOM, order)
        assert same_partition(rings_of(without_ring(cloud)), cloud.ring)


@pytest.mark.parametrize("model", MODELS)
def test_rings_are_found_in_part_of_a_turn_and_with_lost_returns(model):
    rng = np.random.default_rng(0)
    for start, field in ((0, None), (180, None), (0, (-60, 60)), (180, (-60, 60)), (0, (100, 170))):
        cloud = Spinner(start=start, field=field, **MODELS[model]).scan(ROOM)
        cloud = cloud.select(rng.random(len(cloud)) > 0.1)
        assert same_partition(rings_of(without_ring(cloud)), cloud.ring)


@pytest.mark.parametrize(("start", "clockwise"), [(0, True), (180, False)])
def test_rings_that_see_mostly_sky_do_not_mix_into_others(start, clockwise):
    cloud = Spinner(start=start, clockwise=clockwise, **MODELS["64 rings"]).scan([GROUND, *BOXES])
    found = rings_of(without_ring(cloud))
    for ring in np.unique(cloud.ring):  # sparse ones may be joined, none may be torn apart
        assert len(np.unique(found[cloud.ring == ring])) == 1
    full = np.bincount(cloud.ring) > 500
    assert same_partition(found[full[cloud.ring]], cloud.ring[full[cloud.ring]])


@pytest.mark.parametrize("clockwise", [False, True])
def test_rings_keep_apart_when_motion_compensation_tilts_them(clockwise):
    cloud = Spinner(clockwise=clockwise, **MODELS["64 rings"]).scan(ROOM)
    azimuth = np.arctan2(cloud.xyz[:, 1], cloud.xyz[:, 0])
    time = np.mod((-1 if clockwise else 1) * azimuth + 1e-6, 2 * np.pi)[:, None] / (2 * np.pi)
    moved = PointCloud((cloud.xyz + time * [1.5, 0, 0.02]).astype(np.float32))  # 15 m/s, ring by ring
    assert same_partition(rings_of(moved), cloud.ring)


def test_the_rings_of_the_source_are_taken_first():
    cloud = Spinner(**MODELS["16 rings"]).scan(ROOM, "shuffled")
    names = (cloud.ring * 7 + 100).astype(np.int32)
    assert rings_of(PointCloud(cloud.xyz, ring=names)) is names
    constant = PointCloud(cloud.xyz, ring=np.zeros(len(cloud), np.int32))  # a field that is there but not filled in
    assert same_partition(rings_of(constant), cloud.ring)


def test_the_range_image_is_the_scan():
    for names, order in itertools.product(("from the top", "from the bottom", "any"), ("ring", "column", "shuffled")):
        spinner = Spinner(start=10.03, **MODELS["32 rings"])
        cloud = spinner.scan(ROOM, order)
        renamed = {
            "from the top": np.arange(32),
            "from the bottom": np.arange(32)[::-1],
            "any": np.random.default_rng(0).permutation(32) + 5,
        }
        scan = range_image(PointCloud(cloud.xyz, cloud.intensity, renamed[names][cloud.ring].astype(np.int32)), CONFIG)
        assert scan.range.shape == (32, 1440)
        assert np.rad2deg(scan.azimuth_step) == pytest.approx(0.25, rel=1e-4)
        assert np.allclose(scan.elevation, spinner.elevations, atol=1e-5)  # row 0 is the highest
        assert (scan.index >= 0).all()
        points = scan.cloud.xyz[scan.index]
        assert np.allclose(np.linalg.norm(points, axis=2), scan.range, rtol=1e-5)
        assert np.allclose(np.arcsin(points[..., 2] / scan.range), spinner.elevations[:, None], atol=1e-5)
        azimuth = np.unwrap(np.arctan2(points[..., 1], points[..., 0]), axis=1)
        assert np.allclose(np.diff(azimuth, axis=1), np.deg2rad(0.25), atol=1e-5)  # counter-clockwise, step by step
        assert np.abs(azimuth[:, 0] + np.pi).max() < np.deg2rad(0.3)


def test_every_firing_has_its_own_cell():
    """Also where firings lie exactly on the borders of cells counted from -180 deg, as simulators' do."""
    for start, step in itertools.product((0, 180, 0.05, 0.1, 0.03, 77.777), (0.1, 0.1728, 0.2, 0.25, 0.4)):
        cloud = Spinner(rings=8, low=-10, high=-3, step=step, start=start).scan(ROOM)
        scan = range_image(cloud, CONFIG)
        assert scan.range.shape[1] == round(360 / step)
        assert (scan.index >= 0).sum() >= len(cloud) - 8  # 0.1728 does not divide a turn: there one cell per ring may be shared
        assert len(np.unique(scan.index[scan.index >= 0])) == (scan.index >= 0).sum()


@pytest.mark.parametrize("start", [0, 0.0625, 0.125, 0.1875])
def test_rings_that_fire_together_share_columns(start):
    """Whatever the azimuth, and with the jitter of a motor: tops are sought above, not one column aside."""
    cloud = Spinner(rings=16, low=-14, high=-3, start=start).scan(ROOM)
    c, s = np.cos(turn := np.random.default_rng(0).normal(0, np.deg2rad(0.005), len(cloud))), np.sin(turn)
    x, y, z = cloud.xyz.T
    scan = range_image(PointCloud(np.c_[c * x - s * y, s * x + c * y, z].astype(np.float32), ring=cloud.ring), CONFIG)
    assert (scan.index >= 0).all()
    points = scan.cloud.xyz[scan.index]
    azimuth = np.arctan2(points[..., 1], points[..., 0])
    assert np.ptp(np.angle(np.exp(1j * (azimuth - azimuth[:1]))), axis=0).max() < np.deg2rad(0.1)


def test_single_lost_returns_are_filled_and_marked():
    spinner = Spinner(rings=8, low=-10, high=-3, start=0.1)
    cloud = spinner.scan(ROOM)
    whole = range_image(cloud, CONFIG)
    ranges = np.linalg.norm(cloud.xyz, axis=1)
    middle = int(whole.index[4, 700])
    beside = int(whole.index[2, 701]), int(whole.index[2, 702])
    row, column = np.argwhere(np.abs(np.roll(whole.range, -1, 1) - np.roll(whole.range, 1, 1)) > 1)[0]
    lost = [middle, *beside, whole.index[row, column]]
    scan = range_image(cloud.select(~np.isin(np.arange(len(cloud)), lost)), CONFIG)
    assert scan.index[4, 700] == -1
    assert scan.range[4, 700] == pytest.approx(ranges[middle], abs=0.02)
    assert np.isnan(scan.range[2, 701:703]).all()  # two in a row may be a gap
    assert np.isnan(scan.range[row, column])  # what jumps has no range between


def test_useless_points_are_dropped():
    cloud = Spinner(**MODELS["16 rings"]).scan([*ROOM, Box((4, -5, -1.7), (5, -4, 1), 0.9)])
    rng = np.random.default_rng(0)
    xyz, ring = cloud.xyz.copy(), cloud.ring
    lost = rng.choice(len(cloud), 900, replace=False)
    xyz[lost[:300]], xyz[lost[300:600]], xyz[lost[600:]] = np.nan, 0, rng.uniform(-0.4, 0.4, (300, 3))
    scan = range_image(PointCloud(xyz, cloud.intensity, ring), CONFIG)
    keep = np.setdiff1d(np.arange(len(cloud)), lost)
    assert np.array_equal(scan.cloud.xyz, cloud.xyz[keep])
    assert np.allclose(scan.reflectivity, cloud.intensity[keep])
    assert np.nanmin(scan.range) >= CONFIG.min_range


def test_clouds_without_rings_or_sense_still_give_rows_but_not_those_without_points():
    for xyz in (np.zeros((0, 3)), np.zeros((5000, 3)), np.full((5000, 3), np.nan), np.full((5000, 3), 0.1), np.ones((99, 3)) * 5):
        with pytest.raises(TooFewFeaturesError, match="usable points"):
            range_image(PointCloud(xyz.astype(np.float32)), CONFIG)
    some = np.random.default_rng(0).uniform(-1, 1, (5000, 3)) * [20, 20, 3] + [30, 0, 0]
    scan = range_image(PointCloud(some.astype(np.float32)), CONFIG)
    assert 16 <= len(scan.elevation) <= 64
    assert (np.diff(scan.elevation) < 0).all()
    for xyz in (
        np.ones((200, 3)),
        np.c_[np.linspace(2, 9, 200), np.zeros(200), np.zeros(200)],
        np.c_[np.zeros((200, 2)), np.linspace(2, 9, 200)],
    ):
        scan = range_image(PointCloud(xyz.astype(np.float32)), CONFIG)
        assert np.nanmin(scan.range) >= CONFIG.min_range


STRIPES = np.where(np.arange(4000) % 7 < 2, 0.8, 0.2)


def reflectivity(intensity: np.ndarray | None) -> np.ndarray | None:
    xyz = np.random.default_rng(0).uniform(2, 20, (4000, 3)).astype(np.float32)
    return range_image(PointCloud(xyz, None if intensity is None else intensity.astype(np.float32)), CONFIG).reflectivity


def test_intensity_in_any_unit_becomes_a_share_and_constant_or_invalid_ones_are_dropped():
    for scale, full in ((1.0, 1), (255.0, 255), (200.0, 255), (3000.0, 0.8 * 3000)):
        assert np.allclose(reflectivity(STRIPES * scale), STRIPES * scale / full, atol=1e-5)
    one_odd = np.where(np.arange(4000) == 5, 200.0, 7)
    for intensity in (None, np.zeros(4000), np.full(4000, 100.0), np.full(4000, np.nan), one_odd):
        assert reflectivity(intensity) is None
    # Gaps, bright outliers, and many retroreflectors do not darken the rest.
    for bright, highest in ((2, 1.0), (80, 1 / BRIGHT)):
        counts = STRIPES * 1000
        counts[:bright], counts[bright : bright + 3] = 65535, np.nan
        values = reflectivity(counts)
        assert values[bright:].max() == pytest.approx(highest, abs=0.01)
        assert (values.min(), values.max()) == (0, 1)


def test_a_dense_scan_of_a_narrow_field_has_the_cells_of_its_density() -> None:
    """Too few sectors to judge by some of them, wherever the scanner looks."""
    rng = np.random.default_rng(0)
    sizes = []
    for middle in np.deg2rad([0.0, 10.0, 20.0, 95.0]):
        azimuth = middle + np.deg2rad(rng.uniform(-7, 7, 130_000))
        sizes.append(cell_size(azimuth, np.deg2rad(rng.uniform(-7, 7, 130_000))))
    assert max(sizes) <= 1.15 * min(sizes)
    few = cell_size(np.deg2rad(rng.uniform(-7, 7, 30_000)), np.deg2rad(rng.uniform(-7, 7, 30_000)))
    assert few > 1.3 * max(sizes)


def test_ring_numbers_of_any_size_are_sorted_from_the_top():
    ring = np.array([-(2**31), 5, 5, 2**31 - 1, -(2**31)], np.int32)
    rows, elevation = _rows_from_top(ring, np.array([0.1, 0.3, 0.3, -0.2, 0.1]))
    assert rows.tolist() == [1, 0, 0, 2, 1]
    assert elevation == pytest.approx([0.3, 0.1, -0.2])


def test_quantiles_are_those_of_numpy():
    rng = np.random.default_rng(0)
    for n, dtype in itertools.product((1, 2, 7, 1000), (np.float32, np.float64)):
        values = rng.normal(size=n).astype(dtype)
        for share in (0.0, 0.25, 0.5, 0.95, 1.0):
            assert quantile(values, share) == pytest.approx(np.quantile(values, share), rel=1e-6)
