"""Scans of every kind of scanner: their layout and where their edges lie."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from helpers import GROUND, HEIGHT, Box, Plane, Rosette, Spinner, cast, directions

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.config import LidarConfig
from calib_ros.frame import Frame, PointCloud
from calib_ros.lidar.edges import EdgeKind, EdgePoints, edge_points
from calib_ros.lidar.range_image import RangeImage, range_image
from calib_ros.registration.features import FeatureExtractor, FrameFeatures

CONFIG = LidarConfig()
WALLS = [Plane((1, 0, 0), 20), Plane((-1, 0, 0), 15), Plane((0, 1, 0), 12), Plane((0, -1, 0), 9)]
BOX = Box((9.5, -1.03, -HEIGHT), (10.5, 1.21, 0.3))
ROOM = [BOX, GROUND, *WALLS]
LEFT, RIGHT = np.rad2deg(np.arctan2(1.21, 9.5)), np.rad2deg(np.arctan2(-1.03, 9.5))


def seen(D: np.ndarray, shapes=ROOM) -> np.ndarray:
    """Points (n, 3) that rays (n, 3) hit; NaN where they hit nothing."""
    r, _ = cast(D, shapes)
    return D * np.where(np.isfinite(r) & (r < 100), r, np.nan)[:, None]


def cloud_of(xyz: np.ndarray, ring: np.ndarray | None = None) -> PointCloud:
    return PointCloud(xyz.astype(np.float32), None, None if ring is None else ring.astype(np.int32))


def azimuth(P: np.ndarray) -> np.ndarray:
    return np.rad2deg(np.arctan2(P[:, 1], P[:, 0]))


def side_errors(edges: EdgePoints) -> np.ndarray:
    """How far outside of the box's two corners its sideways edges lie, deg."""
    P = edges.xyz[edges.kind == EdgeKind.SIDE].astype(float)
    P = P[(np.abs(P[:, 0] - 10) < 1) & (np.abs(P[:, 1]) < 2) & (P[:, 2] > -1.2) & (P[:, 2] < 0.2)]
    return (azimuth(P) - np.where(P[:, 1] > 0, LEFT, RIGHT)) * np.sign(P[:, 1])


def elsewhere(edges: EdgePoints) -> int:
    """Sideways and upward edges that are not at the box: in a closed room with one box there are none."""
    P = edges.xyz[np.isin(edges.kind, (EdgeKind.SIDE, EdgeKind.TOP))]
    return int(np.sum((np.abs(P[:, 0] - 10) > 1.2) | (np.abs(P[:, 1]) > 1.7)))


# --- spinning scanners ----------------------------------------------------------------------------------------------------

HZ = {5: (0.1, 3600), 10: (0.2, 1800), 20: (0.4, 900)}


def test_the_azimuth_step_follows_the_speed_of_the_motor():
    for lost, hz in itertools.product((0.0, 0.3, 0.6), HZ):
        step, columns = HZ[hz]
        cloud = Spinner(rings=16, low=-15, high=15, step=step, start=0.037).scan(ROOM)
        cloud = cloud.select(np.random.default_rng(0).random(len(cloud)) >= lost)
        scan = range_image(cloud, CONFIG)
        assert scan.layout == "rings"
        assert np.rad2deg(scan.azimuth_step) == pytest.approx(step, rel=1e-3)
        assert scan.range.shape == (16, columns)
        assert (scan.index >= 0).sum() > (0.98 if lost < 0.5 else 0.94) * len(cloud)  # what has no neighbour left counts as stray


@pytest.mark.parametrize(("order", "jitter"), [("firing", 0.0), ("firing", 0.004), ("echo", 0.004), ("shuffled", 0.004)])
def test_two_returns_of_each_ray(order, jitter):
    """Strongest and last: of every third ray they differ, and the first is then the nearer one; of the others they are equal."""
    spinner = Spinner(rings=16, low=-15, high=3, step=0.2, start=0.03)
    single = spinner.scan(ROOM)
    rng = np.random.default_rng(0)
    second = single.xyz.copy()
    glass = rng.random(len(second)) < 0.02
    second[glass] *= rng.uniform(1.15, 1.4, (int(glass.sum()), 1)).astype(np.float32)
    second *= 1 + rng.normal(0, jitter / 10, (len(second), 1)).astype(np.float32)
    xyz, ring = np.concatenate([single.xyz, second]), np.concatenate([single.ring, single.ring])
    n = len(single)
    in_order = np.arange(2 * n)
    place = {"firing": in_order.reshape(2, n).T.ravel(), "echo": in_order, "shuffled": rng.permutation(2 * n)}[order]
    expected = range_image(single, CONFIG)
    scan = range_image(PointCloud(xyz[place], None, ring[place]), CONFIG)
    assert scan.layout == "rings"
    assert np.rad2deg(scan.azimuth_step) == pytest.approx(0.2, rel=1e-3)
    assert scan.range.shape == expected.range.shape
    # The nearer one of the two wins.
    assert np.nanpercentile(np.abs(scan.range - expected.range), 99.9) < 0.05
    both, one = edge_points(scan, CONFIG), edge_points(expected, CONFIG)
    assert len(side_errors(both)) == pytest.approx(len(side_errors(one)), abs=2)
    assert np.abs(side_errors(both)).max() < 0.11
    assert elsewhere(both) < 5


def test_two_returns_without_ring_numbers_keep_their_rings():
    single = Spinner(rings=32, low=-20, high=4, step=0.2, start=0.03).scan(ROOM)
    second = single.xyz * np.where(np.arange(len(single)) % 3 == 0, 1.0, 1.0003)[:, None].astype(np.float32)
    xyz = np.stack([single.xyz, second], axis=1).reshape(-1, 3)
    scan = range_image(PointCloud(xyz), CONFIG)
    assert scan.layout == "rings"
    assert scan.range.shape == (32, 1800)


def organised(columns: int = 1024, rings: int = 64, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """As an Ouster's driver gives it: row by row, all cells there, zeros where nothing returned; lasers of four bearings,
    3.1 deg apart, fire at once, so that a column of the cloud is no direction."""
    rng = np.random.default_rng(seed)
    elevation = np.deg2rad(np.linspace(22.5, -22.5, rings))[:, None]
    bearing = np.deg2rad(np.array([4.2, 1.4, -1.4, -4.2]))[np.arange(rings) % 4][:, None]
    turn = -2 * np.pi * np.arange(columns)[None] / columns + bearing
    xyz = seen(directions(turn, elevation).reshape(-1, 3))
    xyz[rng.random(len(xyz)) < 0.03] = np.nan
    return np.nan_to_num(xyz), np.repeat(np.arange(rings), columns)


def test_a_staggered_organised_cloud_with_zeros():
    xyz, ring = organised()
    assert (xyz == 0).all(axis=1).mean() > 0.02
    scan = range_image(cloud_of(xyz, ring), CONFIG)
    assert scan.layout == "rings"
    assert scan.range.shape == (64, 1024)
    # What is above each other in the range image is above each other in the world.
    P = scan.cloud.xyz[np.maximum(scan.index, 0)]
    a = np.where(scan.index >= 0, np.arctan2(P[..., 1], P[..., 0]), np.nan)
    off = np.angle(np.exp(1j * (a[1:] - a[:-1])))
    assert np.nanmax(np.abs(off)) < 1.01 * 2 * np.pi / 1024
    edges = edge_points(scan, CONFIG)
    errors = side_errors(edges)
    assert len(errors) > 15
    assert np.abs(errors).max() < 0.6 * 360 / 1024
    assert elsewhere(edges) <= 3


# --- scanners without rings -----------------------------------------------------------------------------------------------


def raster(lines: int = 125, columns: int = 480, seed: int = 0, wobble: float = 0.15) -> np.ndarray:
    """A MEMS mirror: lines that bend and slant, to and fro, 120 x 25 deg ahead of it; no firing hits the same place twice."""
    rng = np.random.default_rng(seed)
    k, c = np.meshgrid(np.arange(lines), np.linspace(-1, 1, columns), indexing="ij")
    to_and_fro = np.where(k % 2 == 0, c, -c)
    bent = 12.5 - 25 * (k + 0.5 * (to_and_fro + 1) * (np.where(k % 2 == 0, 1, -1))) / lines + 2.0 * to_and_fro**2
    angle = np.stack([60 * to_and_fro, bent], axis=-1).reshape(-1, 2) + rng.normal(0, wobble * 0.2, (lines * columns, 2))
    return directions(*np.deg2rad(angle.T))


def dome(number: int, points: int = 24000) -> np.ndarray:
    """All around and never the same, as four beams behind a prism that nods as it turns: 360 deg x -7 to 52 deg."""
    t, beam = 0.1 * (np.arange(points) / points + number), np.arange(points) % 4
    turn = 2 * np.pi * (37.313 * t + beam * 0.2371)
    return directions(turn, np.deg2rad(22.5 + 29.5 * np.sin(2 * np.pi * (443.77 * t + beam * 0.317))))


@pytest.mark.parametrize("lines", [None, "as rings"])
def test_a_mems_raster_is_a_projection_and_its_edges_are_right(lines):
    """Also where the driver numbers the lines that are no rings."""
    errors: list[float] = []
    for seed in range(4):
        D = raster(seed=seed)
        xyz = seen(D)
        hit = np.isfinite(xyz[:, 0])
        ring = None if lines is None else (np.arange(len(D)) % 480 // 4)[hit]
        scan = range_image(cloud_of(xyz[hit], ring), CONFIG)
        assert scan.layout == "projection"
        assert 0.15 < np.rad2deg(scan.azimuth_step) < 0.6
        edges = edge_points(scan, CONFIG)
        errors += list(side_errors(edges))
        assert elsewhere(edges) < 0.003 * len(xyz)
    cell = np.rad2deg(scan.azimuth_step)
    assert len(errors) > 60
    assert abs(np.median(errors)) < 0.15 * cell
    assert np.percentile(np.abs(errors), 90) < 0.7 * cell


def test_a_pattern_that_never_repeats_all_around():
    block = Box((6, -2.03, -2), (7, 1.71, 1.5))
    shapes = [block, *WALLS, Plane((0, 0, 1), 8), GROUND]
    left, right = np.rad2deg(np.arctan2(1.71, 6)), np.rad2deg(np.arctan2(-2.03, 6))
    errors: list[float] = []
    wrong: list[np.ndarray] = []
    clouds = [cloud_of(xyz[np.isfinite(xyz[:, 0])]) for xyz in (seen(dome(k), shapes) for k in range(4))]
    assert np.abs(clouds[0].xyz[:5000] - clouds[1].xyz[:5000]).max() > 1
    for cloud in clouds:
        scan = range_image(cloud, CONFIG)
        assert scan.layout == "projection"
        a = azimuth(cloud.xyz)
        assert np.ptp(a) > 359
        edges = edge_points(scan, CONFIG)
        P = edges.xyz[edges.kind == EdgeKind.SIDE].astype(float)
        beside = (np.abs(P[:, 0] - 6.5) < 0.8) & (np.abs(P[:, 1]) < 2.6) & (P[:, 2] < 1.2)
        errors += list((azimuth(P[beside]) - np.where(P[beside, 1] > 0, left, right)) * np.sign(P[beside, 1]))
        wrong.append(azimuth(P[~beside]))
        assert len(wrong[-1]) < 0.01 * len(cloud)
    cell = np.rad2deg(scan.azimuth_step)
    assert len(errors) > 20
    assert abs(np.median(errors)) < 0.25 * cell
    assert np.percentile(np.abs(errors), 80) < 0.8 * cell
    # The cut of the picture at 180 deg is no edge: there are no more of the wrong ones than elsewhere.
    astray = np.concatenate(wrong)
    assert np.mean(np.abs(astray) > 170) < 2 * 20 / 360


def moving_rosette(number: int, twist: np.ndarray) -> tuple[PointCloud, np.ndarray]:
    """What a rosette sees that moves, point by point in its own frame at the time of each, and these times (n,) in s."""
    still = Rosette(number)
    t = 0.1 * (np.arange(still.points) / still.points - 0.5)
    whole = 0.1 * (np.arange(still.points) / still.points + number)
    a, b = 2 * np.pi * 121.567 * whole, -2 * np.pi * 77.731 * whole
    half = np.deg2rad(still.reach) / 2
    D = directions(half * (np.cos(a) + np.cos(b)), half * (np.sin(a) + np.sin(b)))
    poses = se3.exp_many(t[::40, None] * twist)
    pose = np.repeat(np.arange(len(poses)), 40)[: len(t)]
    xyz = np.full((len(t), 3), np.nan)
    for k, T in enumerate(poses):
        own = pose == k
        world, lens = D[own] @ T[:3, :3].T, T[:3, 3]
        box = Box(tuple(np.array(BOX.low) - lens), tuple(np.array(BOX.high) - lens))
        xyz[own] = seen(world, [box, Plane((1, 0, 0), 20 - lens[0]), Plane((0, 0, 1), -HEIGHT - lens[2])]) @ T[:3, :3]
    hit = np.isfinite(xyz[:, 0])
    return cloud_of(xyz[hit]), t[hit]


@pytest.mark.slow
def test_a_rosette_that_moves_keeps_its_edges():
    """It comes back to a direction when what stands there is nearer by decimetres, which is no edge."""
    camera = Camera(np.array([[100.0, 0, 80], [0, 100, 60], [0, 0, 1]]), 160, 120)
    extract, image = FeatureExtractor(camera), np.zeros((120, 160, 3), np.uint8)
    twist = np.array([0, 0, 0.35, 8.0, 0, 0])
    errors: list[float] = []
    still: list[float] = []
    for number in range(2):
        cloud, times = moving_rosette(number, twist)
        features = extract(Frame(image, replace(cloud, time=times.astype(np.float32)), camera, 10**9, 10**9, twist=twist))
        assert isinstance(features, FrameFeatures)
        errors += list(side_errors(features.points))
        still += list(side_errors(edge_points(range_image(moving_rosette(number, 0 * twist)[0], CONFIG), CONFIG)))
        assert elsewhere(features.points) <= 6
    cell = np.rad2deg(range_image(Rosette().scan(ROOM), CONFIG).azimuth_step)
    assert len(still) > 10
    assert len(errors) == pytest.approx(len(still), rel=0.3)
    assert abs(np.mean(errors)) < 0.3 * cell
    assert np.median(np.abs(errors)) < 0.6 * cell


def test_layout_is_configurable():
    spinner, rosette = Spinner(rings=16, low=-15, high=15).scan(ROOM), Rosette().scan(ROOM)

    def layout(cloud: PointCloud, name: str) -> RangeImage:
        return range_image(cloud, replace(CONFIG, layout=name))

    assert layout(spinner, "auto").layout == layout(spinner, "rings").layout == "rings"
    assert layout(rosette, "auto").layout == layout(rosette, "projection").layout == "projection"
    told = layout(spinner, "projection")
    assert told.layout == "projection"
    assert len(side_errors(edge_points(told, CONFIG))) > 5
    rows = layout(rosette, "rings")
    assert rows.layout == "rings"
    assert len(rows.elevation) <= 64
