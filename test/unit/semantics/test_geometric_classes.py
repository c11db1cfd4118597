"""Classes of points by cluster shape: exact small worlds, synthetic streets, real scans, degenerate input."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers import GROUND, HEIGHT, Box, Plane, Spinner
from masks_of_pictures import frame_of, later

from calib_ros.datasets.kitti import KittiSource
from calib_ros.frame import UNLABELLED, PointCloud, SemanticClass
from calib_ros.registration.classes import CLOUD
from calib_ros_semantics.models.geometric_classes import ClusterClasses, cluster_classes, heights
from calib_ros_semantics.models.ready import ReadyClasses
from calib_ros_synthetic.drive import SyntheticDrive

C = SemanticClass
SCANNER = Spinner(rings=64, low=-24.0, high=12.0, step=0.2)
HOUSE = Box((-30, 20, -HEIGHT), (30, 25, 6))  # a wall along the street, so that the field of view has an upper edge


def box(x: float, y: float, length: float, width: float, low: float, high: float, reflectivity: float = 0.3) -> Box:
    """A box around (x, y), from `low` to `high` above the ground, m."""
    half = np.array([length, width]) / 2
    return Box((x - half[0], y - half[1], low - HEIGHT), (x + half[0], y + half[1], high - HEIGHT), reflectivity)


def within(xyz: np.ndarray, shape: Box, margin: float = 0.02) -> np.ndarray:
    """Points on a box, but for its lowest 0.25 m, which are ground to a scanner."""
    low = np.array(shape.low)
    low[2] = max(low[2], 0.25 - HEIGHT)
    return np.all((xyz > low - margin) & (xyz < np.array(shape.high) + margin), axis=1)


def classes_on(shapes: list[Plane | Box], asked: Box, scanner: Spinner = SCANNER) -> dict[int, float]:
    """Shares of the classes that the points on one of the shapes get, noise of 1 cm included."""
    cloud = scanner.scan([GROUND, *shapes])
    on = within(cloud.xyz, asked)
    noise = np.random.default_rng(1).normal(0, 0.01, len(cloud))
    distance = np.linalg.norm(cloud.xyz, axis=1)
    xyz = (cloud.xyz * (1 + noise / distance)[:, None]).astype(np.float32)
    labels = cluster_classes(PointCloud(xyz, cloud.intensity))
    assert on.sum() >= 20
    found, count = np.unique(labels[on], return_counts=True)
    return dict(zip(found.tolist(), (count / on.sum()).tolist(), strict=True))


CAR = [box(9, 4, 4.2, 1.8, 0.25, 0.9), box(8.7, 4, 2.2, 1.6, 0.9, 1.5)]
WALL = box(8, 6.0, 30, 0.3, 0, 5)
VAN, POST, PLATE_POST = box(10, -4, 4.8, 1.9, 0.2, 2.1), box(8, -3, 0.12, 0.12, 0, 4), box(12, -3, 0.08, 0.08, 0, 2.9)
PLATE, BACK = box(11.9, -3, 0.03, 0.7, 2.1, 2.8, reflectivity=1.0), box(7.9, -3, 0.03, 0.7, 2.1, 2.6)
BODY, HEAD = box(7, 2, 0.3, 0.5, 0, 1.45), box(7, 2, 0.2, 0.18, 1.45, 1.75)
HEDGE, BEHIND = box(9, -3.5, 12, 0.6, 0, 1.1), box(9.0, -4.1, 0.12, 0.12, 0, 4.5)
# What is there, what of it is looked at, and its class.
THINGS = {
    "a car": ([HOUSE, *CAR], CAR[0], C.VEHICLE),
    "the roof of a car": ([HOUSE, *CAR], CAR[1], C.VEHICLE),
    "a van": ([HOUSE, VAN], VAN, C.VEHICLE),
    "a car in front of a wall": ([WALL, *CAR], CAR[0], C.VEHICLE),
    "a post": ([HOUSE, POST], POST, C.POLE),
    "a post behind a hedge": ([HOUSE, HEDGE, BEHIND], box(9.0, -4.1, 0.12, 0.12, 1.5, 3.0), C.POLE),
    "a bright plate on a post": ([HOUSE, PLATE_POST, PLATE], PLATE, C.SIGN),
    "the post of a plate": ([HOUSE, PLATE_POST, PLATE], box(12, -3, 0.08, 0.08, 0, 1.9), C.POLE),
    "the back of a plate": ([HOUSE, box(8, -3, 0.08, 0.08, 0, 3.6), BACK], BACK, C.SIGN),
    "someone who stands": ([HOUSE, BODY, HEAD], BODY, C.PERSON),
    "a head": ([HOUSE, BODY, HEAD], HEAD, C.PERSON),
}


@pytest.mark.parametrize("name", THINGS)
def test_things_are_told_by_their_shape(name: str) -> None:
    shapes, looked_at, cls = THINGS[name]
    assert classes_on(shapes, looked_at)[cls] > 0.9


def test_what_is_no_such_thing_is_not_taken_for_it() -> None:
    on_wall = classes_on([WALL, *CAR], WALL)  # behind a car
    assert on_wall[C.BUILDING] > 0.8
    assert on_wall.get(C.VEHICLE, 0) == 0
    for shape in ((9, 4, 9.0, 0.8, 0, 1.3), (7, 3, 0.8, 0.6, 0, 1.1), (8, 4, 4.0, 0.1, 0, 1.2)):  # too long or too small
        assert C.VEHICLE not in classes_on([HOUSE, box(*shape)], box(*shape))
    slanted = box(25, 1.6, 40, 0.3, 0, 4)
    assert classes_on([slanted], slanted, Spinner(rings=64, low=-24.0, high=6.0, step=0.4)).get(C.POLE, 0) < 0.01
    wall, bright = box(10, 6, 20, 0.3, 0, 4), box(9, 5.83, 0.5, 0.03, 2.0, 2.5, reflectivity=1.0)
    assert C.SIGN not in classes_on([wall, bright], wall)


def test_an_empty_road_is_ground_only() -> None:
    cloud = SCANNER.scan([GROUND])
    labels = cluster_classes(cloud)
    near = np.hypot(*cloud.xyz[:, :2].T) < 60
    assert set(labels[near]) == {C.GROUND}
    assert set(labels[~near]) <= {UNLABELLED}
    few = np.random.default_rng(0).uniform([-8, -8, -1.72], [8, 8, -1.68], (150, 3)).astype(np.float32)
    assert set(cluster_classes(PointCloud(few))) == {C.GROUND}


def test_heights_follow_a_road_that_climbs_and_a_scanner_that_leans() -> None:
    # Uphill by 4 % from 15 m on, a pavement of 12 cm at one side, the scanner tilted by 3 deg.
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-40, 40, (2, 60_000))
    ground = 0.04 * np.maximum(x - 15, 0) + 0.12 * (y > 6)
    up = np.where(rng.random(60_000) < 0.1, rng.uniform(0.5, 2, 60_000), 0)
    tilt = np.deg2rad(3)
    R = np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]])
    found = heights((np.column_stack([x, y, ground + up - HEIGHT]) @ R.T).astype(np.float32))
    assert found is not None
    error = found[:, 2] - up
    assert np.quantile(np.abs(error), 0.99) < 0.15
    assert abs(np.median(error)) < 0.03


# Precision and recall, measured less a margin: seeds that no threshold was chosen by.
STREETS = {
    64: {C.VEHICLE: (0.93, 0.50), C.POLE: (0.60, 0.25), C.BUILDING: (0.65, 0.75), C.VEGETATION: (0.40, 0.45)},
    32: {C.VEHICLE: (0.93, 0.60), C.POLE: (0.75, 0.60), C.BUILDING: (0.75, 0.75), C.VEGETATION: (0.60, 0.60)},
    16: {C.VEHICLE: (0.93, 0.55), C.POLE: (0.65, 0.55), C.BUILDING: (0.80, 0.70), C.VEGETATION: (0.60, 0.60)},
}


@pytest.mark.parametrize("rings", [pytest.param(n, marks=pytest.mark.slow) if n != 32 else n for n in STREETS])
def test_synthetic_streets(rings: int) -> None:
    clouds = [SyntheticDrive(seed=seed, frames=1, rings=rings, width=64, height=48)[0].cloud for seed in (21, 22, 23, 24)]
    found, truth = np.concatenate([cluster_classes(c) for c in clouds]), np.concatenate([c.label for c in clouds])
    assert_floors(found, truth, {**STREETS[rings], C.GROUND: (0.8, 0.99), C.PERSON: (0.8, 0)})


def assert_floors(found: np.ndarray, truth: np.ndarray, floors: dict[SemanticClass, tuple[float, float]]) -> None:
    """Precision and recall of classes are at least so high."""
    known = truth != UNLABELLED
    for cls, (precision, recall) in floors.items():
        masks = (found == cls) & (truth == cls), found == cls, truth == cls
        right, called, there = (np.count_nonzero(m & known) for m in masks)
        assert right >= precision * called, cls.name
        assert right >= recall * there, cls.name


@pytest.fixture(scope="module")
def cloud() -> PointCloud:
    return SyntheticDrive(seed=21, frames=1, rings=32, width=64, height=48)[0].cloud


def test_classes_are_repeatable_and_do_not_depend_on_lost_returns(cloud: PointCloud) -> None:
    labels, look = cluster_classes(cloud), ClusterClasses()
    assert np.array_equal(look(frame_of(np.zeros((8, 8), np.uint8), cloud=cloud), later()), labels)
    assert "vehicles" in look.describe()
    lost = np.zeros(len(cloud) + 200, bool)
    lost[::100][:200] = True
    xyz, light = np.full((len(lost), 3), np.nan, np.float32), np.zeros(len(lost), np.float32)
    xyz[~lost], light[~lost] = cloud.xyz[: (~lost).sum()], cloud.intensity[: (~lost).sum()]
    with_lost = cluster_classes(PointCloud(xyz, light))
    assert set(with_lost[lost]) == {UNLABELLED}
    assert np.mean(with_lost[~lost] == labels) > 0.98


def test_missing_intensity_loses_only_bright_signs(cloud: PointCloud) -> None:
    with_light, without = cluster_classes(cloud), cluster_classes(PointCloud(cloud.xyz))
    changed = with_light != without
    assert np.mean(changed) < 0.01
    assert set(with_light[changed]) >= {C.SIGN}


@pytest.mark.parametrize(
    "xyz",
    [
        np.empty((0, 3)),
        np.full((500, 3), np.nan),
        np.zeros((500, 3)),
        np.tile([5.0, 1.0, 0.5], (5000, 1)),
        np.random.default_rng(0).normal(0, 1e4, (500, 3)),
        np.column_stack([np.full(4000, 6.0), *np.random.default_rng(0).uniform(-3, 3, (2, 4000))]),  # a wall, and no ground
        np.random.default_rng(0).uniform(-5, 5, (99, 3)),
    ],
    ids=["empty", "nan", "origin", "one place", "far", "wall only", "99 points"],
)
def test_degenerate_clouds_have_no_classes(xyz: np.ndarray) -> None:
    labels = cluster_classes(PointCloud(xyz.astype(np.float32)))
    assert labels.dtype == np.uint8
    assert labels.shape == (len(xyz),)
    assert set(labels) <= {UNLABELLED}


@pytest.mark.kitti
def test_a_labelled_scan(kitti_root: Path) -> None:
    sequence = kitti_root / "odometry" / "sequences" / "00"
    if not (sequence / "labels").is_dir():
        pytest.skip("no labels beside the scans")
    frame = KittiSource(sequence)[0]
    found, truth = cluster_classes(frame.cloud), ReadyClasses(CLOUD, str(sequence / "labels"))(frame, later())
    floors = {C.VEHICLE: (0.95, 0.7), C.POLE: (0.8, 0.5), C.BUILDING: (0.75, 0.6), C.VEGETATION: (0.75, 0.65)}
    assert_floors(found, truth, {**floors, C.GROUND: (0.9, 0.98)})
    assert np.count_nonzero(found == C.PERSON) < 100, "there is nobody in this scan"
