"""Edge points of ideal scans lie on the analytic outlines, and nowhere else."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from helpers import GROUND, HEIGHT, Box, Plane, Rosette, Spinner, cast, directions

from calib_ros.config import Config, LidarConfig
from calib_ros.errors import ConfigError
from calib_ros.frame import PointCloud
from calib_ros.lidar.edges import JUMP_SATURATION, UPWARD, EdgeKind, EdgePoints, edge_points
from calib_ros.lidar.range_image import range_image

CONFIG = LidarConfig()
STEP = 0.25  # deg
WALL = Plane((1, 0, 0), 20)
BOX = Box((9.5, -1.03, -HEIGHT), (10.5, 1.21, 0.3))
LEFT, RIGHT = np.rad2deg(np.arctan2(1.21, 9.5)), np.rad2deg(np.arctan2(-1.03, 9.5))  # corners that the scanner sees
AROUND = [Plane((1, 0, 0), 18), Plane((-1, 0, 0), 15), Plane((0, 1, 0), 12), Plane((0, -1, 0), 9)]
# Where the first firing points to, as a share of a step: outlines fall anywhere between two firings.
PHASES = np.arange(8) * 0.618 % 1


def edges_of(shapes, config=CONFIG, intensity=True, keep=None, **spinner) -> EdgePoints:
    cloud = Spinner(**{"step": STEP, **spinner}).scan(shapes)
    if keep is not None:
        cloud = cloud.select(keep(cloud))
    if not intensity:
        cloud = PointCloud(cloud.xyz, None, cloud.ring)
    return edge_points(range_image(cloud, config), config)


def of_kind(edges: EdgePoints, kind: EdgeKind) -> np.ndarray:
    return edges.xyz[edges.kind == kind].astype(float)


def azimuth(P: np.ndarray) -> np.ndarray:
    return np.rad2deg(np.arctan2(P[:, 1], P[:, 0]))


def elevation(P: np.ndarray) -> np.ndarray:
    return np.rad2deg(np.arctan2(P[:, 2], np.hypot(P[:, 0], P[:, 1])))


@pytest.mark.parametrize("step", [0.1, 0.1728, 0.25, 0.4])
def test_side_edges_lie_on_the_outline(step):
    D = directions(0, Spinner(rings=24).elevations)
    behind = np.minimum(WALL.cast(D), GROUND.cast(D)) - BOX.cast(D)
    expected = np.sum(behind > 0.35)  # every ring that the box stands out in
    assert expected == 11
    errors = []
    for phase in PHASES:
        P = of_kind(edges_of([BOX, WALL, GROUND], step=step, start=phase * step, rings=24), EdgeKind.SIDE)
        assert np.abs(P[:, 0] - 9.5).max() < 0.04  # on the front, not on the wall behind
        assert np.abs(np.deg2rad(elevation(P))[:, None] - Spinner(rings=24).elevations).min(axis=1).max() < 1e-4
        left, right = azimuth(P[P[:, 1] > 0]) - LEFT, azimuth(P[P[:, 1] < 0]) - RIGHT
        assert len(left) == len(right) == expected
        assert np.ptp(left) < 1e-3
        errors += [left.mean() / step, right.mean() / step]
    # An outline may lie anywhere between the last hit and the next firing: at most half a step off, and on average nowhere.
    assert np.abs(errors).max() < 0.51
    assert abs(np.mean(errors)) < 0.1


def test_rays_tell_how_well_side_edges_are_placed_unless_they_lie_between_points() -> None:
    shapes = [BOX, WALL, GROUND]
    assert np.rad2deg(edges_of(shapes).azimuth_step) == pytest.approx(STEP, abs=1e-4)
    assert edges_of(shapes, LidarConfig(layout="projection")).azimuth_step == 0


@pytest.mark.parametrize("rings", [24, 48])
def test_top_edges_lie_on_the_top(rings):
    spacing = np.deg2rad(24 / (rings - 1))
    errors = []
    for top in np.linspace(-0.6, 0.4, 12):
        P = of_kind(edges_of([Box((9.5, -1.03, -HEIGHT), (10.5, 1.21, top)), WALL, GROUND], rings=rings), EdgeKind.TOP)
        assert np.abs(azimuth(P)).max() < LEFT + STEP
        assert len(P) >= (LEFT - RIGHT) / STEP - 2  # one per column of the box
        edge = np.arctan2(top, 9.5 / np.cos(np.deg2rad(azimuth(P))))
        front = P[:, 0] < 9.6
        # From above, the last hit lies on the lid: the edge is then its far side.
        edge[~front] = np.arctan2(top, 10.5 / np.cos(np.deg2rad(azimuth(P[~front]))))
        errors.append((np.deg2rad(elevation(P)) - edge).mean() / spacing)
    assert np.abs(errors).max() < 0.6
    assert abs(np.mean(errors)) < 0.15


def test_reflectivity_edges_lie_on_the_border_of_a_stripe():
    stripe = Plane((1, 0, 0), 12, lambda P: np.where((P[:, 1] > -0.8) & (P[:, 1] < 1.7), 0.7, 0.2))
    borders = np.rad2deg(np.arctan2([1.7, -0.8], 12))
    errors = []
    for phase in PHASES:
        edges = edges_of([stripe, GROUND], start=phase * STEP, low=-5, rings=16)
        of_stripe = (edges.kind == EdgeKind.REFLECTIVITY) & (np.abs(edges.xyz[:, 1]) < 3)  # others: where wall meets ground
        P = edges.xyz[of_stripe].astype(float)
        assert len(P) == 2 * 16
        error = (azimuth(P) - np.where(P[:, 1] > 0.5, *borders)) / STEP
        assert np.abs(error).max() < 0.51
        errors.append(error.mean())
        assert edges.strength[of_stripe] == pytest.approx(0.5)
    assert abs(np.mean(errors)) < 0.1


def test_weak_far_or_jump_reflectivity_steps_are_not_edges():
    def stripe(x: float, bright: float) -> Plane:
        return Plane((1, 0, 0), x, lambda P: np.where(np.abs(P[:, 1]) < 0.8, bright, 0.2))

    def count(shapes, **options) -> int:
        return len(of_kind(edges_of(shapes, low=-3, high=3, rings=8, **options), EdgeKind.REFLECTIVITY))

    # A bright patch elsewhere keeps the unit of the intensity the same in all.
    patch = Box((-8, -1, -1), (-7, 1, 1), 0.9)
    assert count([stripe(12, 0.5), patch]) == 16
    assert count([stripe(45, 0.5), patch]) == 0
    assert count([Box((9.5, -1, -2), (10, 1, 2), 0.9), stripe(12, 0.2), patch]) == 0
    assert count([stripe(12, 0.5), patch], intensity=False) == 0


@pytest.mark.parametrize("scale", [0.02, 1.0, 255.0, 70_000.0])
@pytest.mark.parametrize("reflector", [None, 30.0])
def test_reflectivity_edges_in_any_unit(scale, reflector):
    """Also where a few retro-reflectors are given their true brightness, beside which all else is dark."""
    stripe = Plane((1, 0, 0), 12, lambda P: np.where(np.abs(P[:, 1]) < 0.8, 0.5, 0.2))
    cloud = Spinner(step=STEP, rings=16, low=-3, high=3).scan([stripe, *AROUND[1:]])
    value = (cloud.intensity + np.random.default_rng(0).normal(0, 0.01, len(cloud))).clip(0)
    if reflector is not None:
        value[400:460] = reflector
    edges = edge_points(range_image(PointCloud(cloud.xyz, (scale * value).astype(np.float32), cloud.ring), CONFIG), CONFIG)
    P = of_kind(edges, EdgeKind.REFLECTIVITY)
    own = (np.abs(P[:, 0] - 12) < 0.1) & (np.abs(np.abs(P[:, 1]) - 0.8) < 0.1)
    assert own.sum() == 32
    assert len(P) < 200  # noise: some of 23,000 points


def test_borders_of_a_surface_make_no_reflectivity_edges():
    """Rays that graze what is round return less and less: the image shows its outline only."""
    fading = Box((9.5, -1.0, -2), (10, 1.0, 2), lambda P: 0.1 + 0.8 * np.sqrt(np.maximum(1 - P[:, 1] ** 2, 0)))
    stripe = Box((9.5, -1.0, -2), (10, 1.0, 2), lambda P: np.where(np.abs(P[:, 1]) < 0.4, 0.9, 0.2))
    for box, where in ((fading, np.array([])), (stripe, np.array([0.4]))):
        P = of_kind(edges_of([box, WALL], rings=8, low=-3, high=3), EdgeKind.REFLECTIVITY)
        on_box = np.abs(P[P[:, 0] < 11, 1])
        assert len(on_box) == 16 * len(where)
        assert (np.abs(on_box[:, None] - where) < 0.05).all()


def test_noise_of_the_raw_signal_makes_no_edges_near_and_hides_none_far_away():
    """The signal falls with the square of the range, and its noise is in proportion to it."""
    ground = Plane((0, 0, 1), -HEIGHT, 0.3)
    stripe = Plane((1, 0, 0), 25, lambda P: np.where(np.abs(P[:, 1]) < 2.0, 0.9, 0.2))
    cloud = Spinner(step=STEP, rings=32, low=-25, high=2).scan([stripe, ground])
    signal = cloud.intensity * (5 / np.linalg.norm(cloud.xyz, axis=1)) ** 2
    signal *= np.random.default_rng(0).normal(1, 0.1, len(cloud)).clip(0.1)
    edges = edge_points(range_image(PointCloud(cloud.xyz, signal.astype(np.float32), cloud.ring), CONFIG), CONFIG)
    P = of_kind(edges, EdgeKind.REFLECTIVITY)
    far = np.abs(P[:, 0] - 25) < 0.5
    assert (np.abs(np.abs(P[far, 1]) - 2.0) < 0.15).sum() >= 6
    assert (~far).sum() < 20  # of some 40,000 points on the ground


def test_edges_against_the_sky():
    """A block that stands out above the horizon, nothing behind it."""
    block = Box((9.5, -3.03, -HEIGHT), (10.5, 3.21, 5))
    left, right = np.rad2deg(np.arctan2(3.21, 9.5)), np.rad2deg(np.arctan2(-3.03, 9.5))
    errors = []
    for phase in PHASES:
        edges = edges_of([block, GROUND, Plane((-1, 0, 0), 30)], start=phase * STEP, rings=32, high=10)
        P = of_kind(edges, EdgeKind.SKY_SIDE)
        assert (elevation(P) > 0).all()
        assert len(P) == 2 * np.sum(Spinner(rings=32, high=10).elevations > 0)
        errors += list((azimuth(P) - np.where(P[:, 1] > 0, left, right)) / STEP)
    assert np.abs(errors).max() < 0.51
    assert abs(np.mean(errors)) < 0.1


def test_tops_against_the_sky(monkeypatch):
    block = Box((9.5, -3.03, -HEIGHT), (10.5, 3.21, 0.55))
    spinner = {"rings": 32, "high": 12, "low": -12}
    shapes = [block, GROUND, Plane((-1, 0, 0), 30)]  # the wall at the back: rings without any return are not in the scan
    monkeypatch.setattr("calib_ros.lidar.edges.TOP_SPREAD", 0.0)
    P = of_kind(edges_of(shapes, **spinner), EdgeKind.SKY_TOP)
    assert len(P) > 20
    assert (np.abs(P[:, 1]) < 3.3).all()
    spacing = 24 / 31
    error = elevation(P) - np.rad2deg(np.arctan2(0.55, np.hypot(P[:, 0], P[:, 1])))
    assert np.abs(error).max() < 0.51 * spacing
    monkeypatch.setattr("calib_ros.lidar.edges.OUTWARD_SHIFT", 0.0)
    highest = elevation(of_kind(edges_of(shapes, **spinner), EdgeKind.SKY_TOP))
    assert (elevation(P) - highest).mean() == pytest.approx(spacing / 2, rel=0.02)


@pytest.mark.parametrize("rings", [16, 32, 128])
@pytest.mark.parametrize("pitch", [0.0, 0.02], ids=["level", "downhill"])
def test_ground_that_returns_no_more_from_some_distance_on_is_no_edge(rings, pitch):
    """An open road: its asphalt returns up to 25 m to the left and up to 18 m to the right, where patches are dark, too."""
    road, block = Plane((pitch, 0, 1), -HEIGHT), Box((11.5, -1.03, -HEIGHT), (12.5, 1.21, 0.4))
    rng = np.random.default_rng(0)

    def returned(cloud: PointCloud) -> np.ndarray:
        xyz = cloud.xyz
        far, on_ground = np.hypot(xyz[:, 0], xyz[:, 1]), np.abs(xyz[:, 2] + pitch * xyz[:, 0] + HEIGHT) < 0.05
        dark = (xyz[:, 0] > 7) & (np.floor(xyz[:, 1] / 3) % 2 > 0)
        return ~on_ground | (far < np.where(xyz[:, 1] > 0, 25, 18) - 9 * dark + rng.uniform(0, 1, len(xyz)))

    spinner = {"rings": rings, "low": -18, "high": 8}
    found = edges_of([road, block, Plane((-1, 0, 0), 30)], keep=returned, **spinner)
    side, top = (of_kind(found, kind) for kind in (EdgeKind.SKY_SIDE, EdgeKind.SKY_TOP))

    def beside_block(P: np.ndarray) -> int:
        on_block = (np.abs(P[:, 0] - 12) < 0.7) & (np.abs(P[:, 1] - 0.1) < 1.3)
        assert on_block.sum() > 5
        return int(((P[:, 0] > 0) & ~on_block).sum())

    assert beside_block(top) == 0  # of a thousand columns
    # Beside a dark patch nothing below may return either, so that nothing tells how the ground lies: once per ring at most.
    assert beside_block(side) <= 0.6 * rings


SMOOTH = {
    "ground": [GROUND],
    "wall": [WALL],
    "ground and wall": [GROUND, WALL],
    "room": [GROUND, *AROUND],
    "hall": [*AROUND, Plane((0, 0, 1), 4), Plane((0, 0, 1), -3)],
    "street between walls": [GROUND, Plane((0, 1, 0), 4), Plane((0, -1, 0), 6)],
    "rising road": [Plane((-0.15, 0, 1), -HEIGHT), *AROUND],
    "falling road": [Plane((0.1, 0.05, 1), -HEIGHT)],
    "bank": [Plane((0, 0.3, 1), -HEIGHT)],
    "leaning wall": [Plane((1, 0.8, -0.3), 12), GROUND],
}


def test_smooth_surfaces_have_no_range_edges():
    for name, rings in itertools.product(SMOOTH, (16, 32, 64)):
        edges = edges_of(SMOOTH[name], rings=rings, low=-24, high=6, start=0.07)
        assert not np.isin(edges.kind, (EdgeKind.SIDE, EdgeKind.TOP)).any(), name
        assert len(edges) == 0 or name not in ("room", "hall")  # closed all around


def test_borders_of_the_field_of_view_and_lost_packets_are_no_edges():
    def keep(cloud: PointCloud) -> np.ndarray:
        a = azimuth(cloud.xyz)
        return ((a < 20) | (a > 50)) & ((a < -90) | (a > -88))

    assert len(edges_of([GROUND, *AROUND], keep=keep)) == 0
    for field in ((-60, 60), (-61.1, 33.3), (100, 170)):
        assert len(edges_of([GROUND, *AROUND], field=field)) == 0
    edges = edges_of([BOX, GROUND, *AROUND], field=(-60, 60))
    assert set(edges.kind) == {EdgeKind.SIDE, EdgeKind.TOP}
    assert np.abs(azimuth(edges.xyz)).max() < 10


def test_a_gap_of_one_ring_alone_is_an_edge_and_a_short_one_is_not():
    def with_gap(width: float, stray: float = 0.0) -> EdgePoints:
        def keep(cloud: PointCloud) -> np.ndarray:
            a = np.abs(azimuth(cloud.xyz))
            return (cloud.ring != 5) | (a > width / 2) | (a < stray)

        return edges_of([GROUND, *AROUND], keep=keep)

    for stray in (0.0, STEP / 2):  # a return alone in the gap is not an edge
        edges = with_gap(10, stray)
        assert set(edges.kind) == {EdgeKind.SKY_SIDE}
        assert np.sort(azimuth(edges.xyz)) == pytest.approx([-5, 5], abs=STEP)
    assert len(with_gap(1)) == 0


def test_strengths_grow_with_the_jump_up_to_a_limit():
    strengths = []
    for x in (10.9, 11.5, 12.2, 13.5, 20, 40):
        edges = edges_of([BOX, Plane((1, 0, 0), x), GROUND])
        side = edges.kind == EdgeKind.SIDE
        assert side.sum() >= 20
        strengths.append(edges.strength[side].max())
    assert (np.diff(strengths[:4]) > 0.05).all()
    assert np.allclose(strengths[-2:], np.sqrt(JUMP_SATURATION))


def test_few_rings_raise_no_error():
    for rings in (1, 2, 3):
        edges = edges_of([BOX, WALL, GROUND], rings=rings, low=-2, high=-1)
        assert len(of_kind(edges, EdgeKind.SIDE)) == 2 * rings
        assert not np.isin(edges.kind, UPWARD).any() or rings == 3


RINGS = {
    16: {"rings": 16, "low": -15, "high": 15, "step": 0.2},
    32: {"rings": 32, "low": -30, "high": 10, "step": 0.1659},
    64: {"rings": 64, "low": -24.8, "high": 2, "step": 0.1728},
    128: {"rings": 128, "low": -22.5, "high": 22.5, "step": 0.3516},
}


@pytest.mark.parametrize("rings", RINGS)
def test_upward_edges_are_spread_over_their_possible_heights(rings, monkeypatch):
    box = Box((9.5, -3.03, -HEIGHT), (10.5, 3.21, 0.3))
    spinner = Spinner(**RINGS[rings])
    P = of_kind(edges_of([box, WALL, GROUND], **RINGS[rings]), EdgeKind.TOP)
    P = P[(P[:, 0] < 9.6) & (np.abs(P[:, 1]) < 1)]
    height = np.tan(np.deg2rad(elevation(P)))
    rays = np.tan(spinner.elevations[::-1])
    above = np.searchsorted(rays, height)
    share = (height - rays[above - 1]) / (rays[above] - rays[above - 1])
    assert np.histogram(share, 4, (0, 1))[0] == pytest.approx(len(share) / 4, rel=0.35)
    all_parts = edges_of([box, WALL, GROUND], **RINGS[rings])
    monkeypatch.setattr("calib_ros.lidar.edges.TOP_SPREAD", 0.0)
    one = edges_of([box, WALL, GROUND], **RINGS[rings])
    for kind in EdgeKind:
        assert all_parts.strength[all_parts.kind == kind].sum() == pytest.approx(one.strength[one.kind == kind].sum(), rel=1e-4)


def test_rings_whose_rays_start_at_different_heights_keep_their_edges(monkeypatch):
    """As an HDL-64E's: seen from the origin of the cloud, near points of a ring are higher than far ones."""
    tips, slopes = np.r_[np.full(16, 0.21), np.full(16, 0.12)], np.tan(np.deg2rad(np.linspace(2, -24, 32)))
    angle = np.deg2rad(np.arange(0, 360, 0.25))
    errors = []
    monkeypatch.setattr("calib_ros.lidar.edges.TOP_SPREAD", 0.0)
    for top in np.linspace(-0.9, -0.2, 15):
        parts = []
        for tip, slope in zip(tips, slopes, strict=True):
            D = np.c_[np.cos(angle), np.sin(angle), np.full(len(angle), slope)]
            sides = [WALL, Plane((0, 1, 0), 4), Plane((0, -1, 0), 5)]
            r, _ = cast(D, [Box((9.5, -1, -HEIGHT - tip), (9.6, 1, top - tip)), Plane((0, 0, 1), -HEIGHT - tip), *sides])
            hit = np.isfinite(r) & (r < 80)
            parts.append(D[hit] * r[hit, None] + [0, 0, tip])
        ring = np.repeat(np.arange(32), [len(p) for p in parts]).astype(np.int32)
        cloud = PointCloud(np.concatenate(parts).astype(np.float32), ring=ring)
        P = of_kind(edge_points(range_image(cloud, CONFIG), CONFIG), EdgeKind.TOP)
        rays = np.sort(tips + 9.5 * slopes)
        k = np.searchsorted(rays, top)
        P = P[(np.abs(P[:, 0] - 9.5) < 0.05) & (np.abs(P[:, 1]) < 0.9)]
        assert P[:, 2] == pytest.approx((rays[k - 1] + rays[k]) / 2, abs=0.01)
        errors.append(P[:, 2].mean() - top)
    assert abs(np.mean(errors)) < 0.015


@pytest.mark.parametrize("turn", [90.0, 180.0, -173.5])
def test_edges_turn_with_the_scanner(turn, monkeypatch):
    """Also across the cut of the range image at 180 deg."""
    monkeypatch.setattr("calib_ros.lidar.edges.TOP_SPREAD", 0.0)  # the spread depends on the number of the column
    cloud = Spinner(step=STEP).scan([BOX, WALL, GROUND])
    c, s = np.cos(np.deg2rad(turn)), np.sin(np.deg2rad(turn))
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    expected = edge_points(range_image(PointCloud(cloud.xyz, None, cloud.ring), CONFIG), CONFIG)
    edges = edge_points(range_image(PointCloud((cloud.xyz @ R.T).astype(np.float32), None, cloud.ring), CONFIG), CONFIG)
    assert len(expected) > 50
    assert np.array_equal(np.bincount(edges.kind), np.bincount(expected.kind))
    assert np.abs(np.sort(edges.xyz @ R, axis=0) - np.sort(expected.xyz, axis=0)).max() < 1e-3


def test_edges_do_not_depend_on_the_order_of_points():
    shapes = [BOX, GROUND, *AROUND]
    for spinner in (Spinner(**own) for own in RINGS.values()):
        expected = edge_points(range_image(spinner.scan(shapes), CONFIG), CONFIG)
        for order in ("ring", "column", "shuffled"):
            edges = edge_points(range_image(spinner.scan(shapes, order, with_ring=False), CONFIG), CONFIG)
            assert np.array_equal(np.sort(edges.kind), np.sort(expected.kind))
            by = [np.lexsort(np.round(e.xyz.T, 3)) for e in (edges, expected)]
            assert np.abs(edges.xyz[by[0]] - expected.xyz[by[1]]).max() < 0.02


@pytest.mark.parametrize("rings", RINGS)
def test_rain_makes_no_edges(rings):
    cloud = Spinner(**RINGS[rings]).scan([*AROUND, Plane((0, 0, 1), 4), Plane((0, 0, 1), -3)])
    rng = np.random.default_rng(0)
    factor = np.where(rng.random(len(cloud)) < 0.01, rng.uniform(0.2, 0.8, len(cloud)), 1)  # of drops in front of surfaces
    wet = PointCloud((cloud.xyz * factor[:, None]).astype(np.float32), None, cloud.ring)
    drops = int(np.sum(np.abs(wet.xyz - cloud.xyz).max(axis=1) > 0.3))
    assert drops > 200
    # Two drops side by side are rare, and look like a thing.
    assert len(edge_points(range_image(wet, CONFIG), CONFIG)) < 0.15 * drops


def test_mixed_pixels_make_no_edges():
    """Beams that meet box and wall at once return something between; the edge is on the box."""
    spinner = Spinner(step=STEP)
    scan = range_image(spinner.scan([BOX, WALL, GROUND]), CONFIG)
    cloud = scan.cloud  # whose points the scan's index means
    before = edge_points(scan, CONFIG)
    rng = np.random.default_rng(0)
    row, column = np.nonzero((scan.range < 10.8) & (np.roll(scan.range, -1, 1) > 15) & (scan.range > 9.4))
    behind = scan.index[row, (column + 1) % scan.range.shape[1]]
    assert len(row) >= 10
    xyz = cloud.xyz.copy()
    xyz[behind] *= (rng.uniform(11, 17, len(behind)) / np.linalg.norm(xyz[behind], axis=1))[:, None].astype(np.float32)
    edges = edge_points(range_image(PointCloud(xyz, None, cloud.ring), CONFIG), CONFIG)
    side = of_kind(edges, EdgeKind.SIDE)
    assert np.mean(np.hypot(side[:, 0], side[:, 1]) < 10.7) > 0.85
    assert len(side) == pytest.approx(np.sum(before.kind == EdgeKind.SIDE), abs=4)


@pytest.mark.parametrize("height", [0.1, 0.15, 0.2])
def test_a_kerb_is_no_edge_on_the_pavement_behind_it(height):
    """The pavement goes on behind the kerb: higher than the road foretold, it would be called an edge a ring above the kerb."""
    kerb = Box((-300, 4, -HEIGHT - 1), (300, 300, -HEIGHT + height))
    edges = edges_of([kerb, GROUND])
    assert len(of_kind(edges, EdgeKind.TOP)) <= 12
    # A wall instead of the kerb still has its top.
    assert len(of_kind(edges_of([Box((-80, 4, -HEIGHT - 1), (80, 4.5, -HEIGHT + 1.2)), GROUND]), EdgeKind.TOP)) > 100


@pytest.mark.parametrize("name", ["ground and wall", "hall", "rising road"])
def test_smooth_surfaces_have_hardly_any_edges_in_a_rosette(name):
    cloud = Rosette().scan([*SMOOTH[name], Plane((1, 0, 0), 40)])
    scan = range_image(cloud, CONFIG)
    assert scan.layout == "projection"
    edges = edge_points(scan, CONFIG)
    assert len(edges) < 0.005 * len(cloud)


def test_the_edges_of_a_rosette_lie_on_the_outline():
    box = Box((9.5, -1.03, -HEIGHT), (10.5, 1.21, 0.3))
    side_errors, top_errors, cells = [], [], []
    for number in range(4):
        scan = range_image(Rosette(number).scan([box, WALL, GROUND]), CONFIG)
        assert scan.layout == "projection"
        edges = edge_points(scan, CONFIG)
        side, top = of_kind(edges, EdgeKind.SIDE), of_kind(edges, EdgeKind.TOP)
        side = side[(side[:, 2] < 0.2) & (side[:, 2] > -1.0)]
        assert np.mean(np.hypot(side[:, 0], side[:, 1]) < 10.8) > 0.95
        side = side[side[:, 0] < 10.8]
        side_errors += list((azimuth(side) - np.where(side[:, 1] > 0, LEFT, RIGHT)) * np.sign(side[:, 1]))
        top = top[(np.abs(top[:, 0] - 9.5) < 0.3) & (np.abs(top[:, 1]) < 0.9)]
        top_errors += list(elevation(top) - np.rad2deg(np.arctan2(0.3, np.hypot(top[:, 0], top[:, 1]))))
        cells.append(np.rad2deg(scan.azimuth_step))
    cell = np.median(cells)
    assert len(side_errors) > 25
    assert len(top_errors) > 25
    for errors in (side_errors, top_errors):
        assert abs(np.mean(errors)) < 0.15 * cell
        assert np.median(np.abs(errors)) < 0.4 * cell


def test_the_vehicle_itself_makes_no_edges_and_hides_what_is_behind_it():
    """Without its points, the wall beside them would be an edge against the sky."""
    mirror = Box((1.5, 1.0, -0.4), (1.8, 1.6, 0.2))
    own = LidarConfig(ego_box=(1.4, 1.9, 0.9, 1.7, -0.5, 0.3))
    bearing = np.rad2deg(np.arctan2([1.0, 1.6], [1.8, 1.5]))  # of its outline
    shapes = [*AROUND, mirror, BOX, GROUND]

    def near_outline(edges: EdgePoints) -> int:
        return int(np.sum((azimuth(edges.xyz) > bearing[0] - 3) & (azimuth(edges.xyz) < bearing[1] + 3)))

    def cut_out(cloud: PointCloud) -> np.ndarray:
        return np.flatnonzero(~((cloud.xyz > [1.4, 0.9, -0.5]) & (cloud.xyz < [1.9, 1.7, 0.3])).all(axis=1))

    with_mirror, masked = edges_of(shapes), edges_of(shapes, own)
    assert near_outline(with_mirror) > 30
    assert near_outline(masked) == 0
    assert near_outline(edges_of(shapes, keep=cut_out)) > 10
    elsewhere = azimuth(with_mirror.xyz) < bearing[0] - 3
    assert np.array_equal(masked.xyz[azimuth(masked.xyz) < bearing[0] - 3], with_mirror.xyz[elsewhere])
    for box, says in (((1.0, 1.0, -1.0, 1.0, -1.0, 1.0), "is empty"), ((1.0, 2.0), "must have 6 elements")):
        with pytest.raises(ConfigError, match=says):
            Config(lidar=LidarConfig(ego_box=box))
