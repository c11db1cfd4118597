"""The baselines by hand: those that match edges (Levinson and Thrun 2013, Castorena et al. 2016), those that compare reflectivity
with grey values (mutual information of Pandey, normalised distance), and MulFEAT."""

from __future__ import annotations

import dataclasses
import itertools
from math import e, log, pi, sqrt

import numpy as np
import pytest
from bowl import Bowl
from helpers import GROUND, Box, Plane, Spinner

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.config import Config
from calib_ros.errors import BadInputError
from calib_ros.frame import PointCloud
from calib_ros.lidar.range_image import reflectivity
from calib_ros.registration.search.constraints import SearchBox
from calib_ros_evaluation.methods import information as jh
from calib_ros_evaluation.methods.edges import (
    Levinson,
    edge_image,
    edge_weights,
    edginess,
    fista,
    grid_search,
    misfit,
    probability_right,
    slopes,
    slopes_at_points,
    spread,
    worse_share,
)
from calib_ros_evaluation.methods.information import InformationScore, Nid, Pandey, likeness, unhidden
from calib_ros_evaluation.methods.method import MeanScore, PointFeatures, search_limits, typical_step_deg
from calib_ros_evaluation.methods.mulfeat import Mulfeat, edge_probability


class Top(Bowl):
    """Highest, 1, at an extrinsic."""

    def __init__(self, top):
        super().__init__(top, np.diag([2.0, 4, 6, 0.02, 0.04, 0.06]), 1.0)

    def values(self, transforms):
        return np.array([self.value(T) for T in transforms])


def pinhole(width: int, height: int, focal: float = 1.0) -> Camera:
    """Principal point at pixel (0, 0): a point (x, y, z) lies on pixel (focal x / z, focal y / z)."""
    return Camera(np.diag([focal, focal, 1.0]), width, height)


# --- Levinson and Thrun: eq. 4.2 ---


def test_edginess_of_a_picture():
    gray = np.full((5, 5), 10, np.uint8)
    gray[2, 2], gray[0, 0] = 60, 200
    E = edge_image(gray)
    assert E[:2, :2].tolist() == [[190, 190], [190, 190]]  # brighter than all around: 200 - 10 there, and at its 3 neighbours
    assert (E[2, 2], E[3, 1], E[4, 4]) == (50, 50, 0)  # a neighbour sees |10 - 60|, as it is seen; beyond, all is level
    E = np.zeros((5, 5), np.uint8)
    E[0, 0], E[4, 3] = 100, 40
    D = edginess(E, alpha=0.25, gamma=0.5)
    assert D[0, 0] == pytest.approx(100)  # 0.25 * 100 + 0.75 * 100 * 0.5^0
    assert D[1, 1] == pytest.approx(37.5)  # diagonal neighbours are at distance 1: 0.75 * 100 * 0.5
    assert D[4, 0] == pytest.approx(4.6875)  # from (0, 0), distance 4: 100 * 0.0625 = 6.25; from (4, 3), distance 3: only 5


def test_spread_is_the_maximum_over_all_pixels():
    for gamma, shape in itertools.product((0.3, 0.9, 0.98, 0.999), ((1, 1), (1, 9), (23, 17), (12, 40))):
        rng = np.random.default_rng(shape[0])
        for share in (0.01, 0.2, 1.0):
            E = np.where(rng.random(shape) < share, rng.integers(1, 256, shape), 0).astype(np.uint8)
            y, x = np.indices(shape).reshape(2, -1)
            distance = np.maximum(np.abs(x[:, None] - x), np.abs(y[:, None] - y))
            brute = (E.ravel() * gamma**distance).max(axis=1).reshape(shape)
            assert np.allclose(spread(E, gamma), brute, rtol=1e-5, atol=1e-6)


# --- Levinson and Thrun: eq. 4.3 ---


def test_score_of_three_points():
    D = np.arange(12, dtype=np.float32).reshape(3, 4)  # D[v, u] = 4 v + u
    xyz = np.array([[1, 0, 1], [6, 4, 2], [-1, 0, 1], [1, 1, -1]], np.float32)  # pixels (1, 0), (3, 2), left of it, behind it
    camera, xi = pinhole(4, 3), np.array([2.0, 3.0, 5.0, 7.0], np.float32)
    score = Levinson(min_points=1, margin=1.0).score([PointFeatures(camera, D, xyz, xi)], np.eye(4))
    assert score.value(np.eye(4)) == pytest.approx(2 * 1 + 3 * 11)  # D[0, 1] = 1, D[2, 3] = 11; the others add nothing
    # A pixel to the right at depth 1, half a pixel at depth 2: (2, 0), (3.5 -> 4, 2), which is outside, and (0, 0).
    right = se3.from_parts(np.eye(3), [1, 0, 0])
    assert score.value(right) == pytest.approx(2 * 2 + 5 * 0)
    assert score.values(np.stack([np.eye(4), right])).tolist() == [35.0, 4.0]


# --- both searches, and the test of a calibration ---


@pytest.mark.parametrize(
    ("search", "near"),
    [
        (lambda *args: grid_search(*args, np.repeat([np.deg2rad(0.02), 0.003], 3))[0], 0.03),
        (lambda *args: fista(*args, 0.01, 600)[0], 0.02),
    ],
    ids=["grid search", "fista"],
)
def test_the_top_of_a_bowl_is_found_within_the_box(search, near):
    T, width = np.eye(4), SearchBox(1.0, 0.1).half_width()
    score = Top(se3.exp(width * [0.5, -0.6, 0.3, -0.4, 0.5, 0.2]))
    found = search(score, T, width)
    assert np.abs(se3.log(found @ se3.inverse(score.optimum)) / width).max() < near
    found = search(Top(se3.exp(width * [4, 0, 0, 0, 0, 0])), T, width)
    assert np.allclose(se3.log(found) / width, [1, 0, 0, 0, 0, 0], atol=near)
    found = search(score, T, width * [1, 1, 1, 0, 0, 0])
    assert np.allclose(se3.log(found)[3:], 0, atol=1e-12)


def test_share_of_worse_neighbours():
    top = Top(np.eye(4))
    assert worse_share(top, np.eye(4)) == 1
    # Far off along one axis: of 728 neighbours the 243 towards the top are better, the 243 away from it worse, and the 242 in
    # between, off to the side, a little worse.
    assert worse_share(top, se3.exp([0.3, 0, 0, 0, 0, 0])) == pytest.approx(485 / 728, abs=0.01)


def test_probability_that_a_calibration_is_right():
    right, wrong = (0.9, 0.1), (0.5, 0.2)
    # At 0.7 both are off by 2 and 1 deviations: exp(-2) / 0.1 = 1.3534 and exp(-0.5) / 0.2 = 3.0327; 1.3534 / 4.3860 = 0.3086.
    assert probability_right([0.7], right, wrong) == pytest.approx(0.3086, abs=1e-4)
    # Two frames: the densities multiply; 1.3534^2 / (1.3534^2 + 3.0327^2) = 1.8316 / 11.0286 = 0.1661.
    assert probability_right([0.7, 0.7], right, wrong) == pytest.approx(0.1661, abs=1e-4)
    assert probability_right([0.95, 0.9, 1.0], right, wrong) > 0.99
    assert probability_right([], right, wrong) == 0.5


# --- Castorena et al.: eq. 4.4 and 4.5 ---


def test_misfit_of_a_picture_of_4_by_4():
    """Depth 2 m to the left and 6 m to the right of a line, which the picture shows, or shows one pixel off."""
    phi = np.tile(np.float32([2, 2, 6, 6]), (4, 1))
    right_place = np.tile(np.uint8([0, 0, 255, 255]), (4, 1))
    wrong_place = np.tile(np.uint8([0, 255, 255, 255]), (4, 1))
    omega = np.array([4, 5, 6])  # pixels (0, 1), (1, 1), (2, 1): |grad_x phi| there is 0, 4, 0, |grad_y phi| is 0
    steep = tuple(s.ravel()[omega] for s in slopes(phi))
    assert steep[0].tolist() == [0, 4, 0]
    assert steep[1].tolist() == [0, 0, 0]

    def F(gray):
        w = edge_weights(gray, gamma=2.0, sigma=0).reshape(2, -1)[:, omega]
        return misfit((w[0], w[1]), steep)

    # w_x is exp(-2) = 0.1353 where the picture has its step of 1, else 1. Direction y: no depth edge counts as 1, unrelated.
    # Right place: A = 0.1353 * 4 = 0.5413, N = (1 + 0.1353 + 1) * 4 = 8.5413; 3 A / N = 0.1901.
    assert F(right_place) == pytest.approx(1 + 3 * 0.541341 / 8.541341, abs=1e-5)
    # Wrong place: the depth step meets w = 1: A = 4, N = 8.5413; 3 A / N = 1.4049.
    assert F(wrong_place) == pytest.approx(1 + 3 * 4 / 8.541341, abs=1e-5)


def test_completed_depth_is_the_weighed_mean_of_the_points_around():
    """Two points at 2 m and 6 m, two pixels apart; the nearer of two in one pixel hides the other."""
    u, v, depth = np.array([5, 5, 7]), np.array([4, 4, 4]), np.float32([9, 2, 6])
    pixels, x, y = slopes_at_points((10, 12), 1.0, u, v, depth)
    g1, g2 = np.exp(-0.5), np.exp(-2.0)  # the Gaussian 1 and 2 px away
    at_5, at_6 = (2 + 6 * g2) / (1 + g2), (2 * g1 + 6 * g1) / (2 * g1)
    at_7, at_8 = (2 * g2 + 6) / (1 + g2), (2 * np.exp(-4.5) + 6 * g1) / (np.exp(-4.5) + g1)
    assert pixels.tolist() == [4 * 12 + 5, 4 * 12 + 7]
    assert np.allclose(x, [abs(at_6 - at_5), abs(at_8 - at_7)], rtol=1e-5)
    assert np.allclose(y, 0, atol=1e-5)  # one row below the points lie as far from it


# --- reflectivity and grey values: mutual information (Pandey) and normalised distance (NID) ------------------------------


METHODS = [Pandey(), Nid()]
both = pytest.mark.parametrize("method", METHODS, ids=lambda m: m.name)

SAME = np.array([[0.5, 0], [0, 0.5]])  # each tells the other: H(x) = H(y) = H(x, y) = ln 2
APART = np.full((2, 2), 0.25)  # independent: H(x) = H(y) = ln 2, H(x, y) = ln 4
# Marginals 1/2, 1/2 and 3/4, 1/4. H(x) = ln 2; H(y) = 3/4 ln 4/3 + 1/4 ln 4 = ln 4 - 3/4 ln 3;
# H(x, y) = 1/2 ln 2 + 2 * 1/4 ln 4 = 3/2 ln 2. MI = ln 2 + 2 ln 2 - 3/4 ln 3 - 3/2 ln 2 = 3/2 ln 2 - 3/4 ln 3.
MIXED = np.array([[0.5, 0], [0.25, 0.25]])


@pytest.mark.parametrize(
    ("joint", "information", "distance"),  # 1 - MI / H(x, y)
    [
        (SAME, log(2), 0),
        (APART, 0, 1),
        (MIXED, 1.5 * log(2) - 0.75 * log(3), log(3) / (2 * log(2))),
        (MIXED.T, 1.5 * log(2) - 0.75 * log(3), log(3) / (2 * log(2))),
        (np.array([[1.0, 0], [0, 0]]), 0, 1),  # nothing varies: nothing can be told
    ],
)
def test_information_by_hand(joint: np.ndarray, information: float, distance: float) -> None:
    assert jh.mutual_information(joint) == pytest.approx(information)
    assert jh.normalised_information_distance(joint) == pytest.approx(distance)


def test_bandwidth_is_the_standard_deviation_by_the_sixth_root_of_n() -> None:
    counts = np.zeros((5, 5))
    counts[0, 1] = counts[4, 3] = 32  # rows 0 and 4: deviation 2; columns 1 and 3: deviation 1; 64^(-1/6) = 1/2
    assert jh.silverman_bandwidth(counts) == pytest.approx((1, 0.5))


def test_density_is_the_histogram_convolved_with_a_gaussian() -> None:
    counts = np.zeros((41, 41))
    counts[20, 20] = 7
    p = jh.density(counts, (2, 1))
    # One sample becomes the product of two Gaussians, of standard deviation 2 along the rows and 1 along the columns:
    # 1 / (2 pi 2 1) on top, e^(-1/2) of that two rows or one column beside it.
    top = 1 / (4 * pi)
    assert p[20, 20] == pytest.approx(top, rel=1e-4)
    assert p[22, 20] == pytest.approx(top / sqrt(e), rel=1e-4)
    assert p[20, 19] == pytest.approx(top / sqrt(e), rel=1e-4)
    assert p[22, 19] == pytest.approx(top / e, rel=1e-4)
    assert p.sum() == pytest.approx(1)


# A camera of focal length 10 px that looks along z from the origin: (x, y, 10) is seen at pixel (8 + x, 6 + y).
CAMERA = Camera(np.array([[10, 0, 8], [0, 10, 6], [0, 0, 1.0]]), 17, 13)


def at_pixels(*uv: tuple[float, float], depth: float = 10) -> np.ndarray:
    return np.array([((u - 8) * depth / 10, (v - 6) * depth / 10, depth) for u, v in uv], np.float32)


def test_the_distance_counts_pairs_of_bins_at_the_nearest_pixel() -> None:
    light = np.zeros((13, 17), np.uint8)
    light[3, 5] = light[3, 6] = 9
    # The four points are seen at grey bins 9, 9, 0, 0 and reflect levels 2, 2, 2, 7: the table MIXED, turned.
    xyz = at_pixels((5, 3), (6.4, 2.6), (10, 10), (0, 12), (30, 3), (5, -2))  # the last two fall beside the image
    frame = PointFeatures(CAMERA, light, xyz, np.array([2, 2, 2, 7, 1, 1]))
    assert MeanScore([frame], likeness).value(np.eye(4)) == pytest.approx(-log(3) / (2 * log(2)))
    # Two frames: the mean. The other's levels follow its grey values: distance 0.
    other = dataclasses.replace(frame, value=np.array([2, 2, 7, 7, 1, 1]))
    assert MeanScore([frame, other], likeness).value(np.eye(4)) == pytest.approx(-log(3) / (4 * log(2)))
    away = se3.perturb(np.eye(4), [0, 0, 0], [0, 0, -100])  # all points behind the camera
    assert MeanScore([frame, other], likeness).value(away) == -1


def test_information_takes_the_grey_value_between_pixels_and_pools_frames() -> None:
    light = np.tile(np.arange(17, dtype=np.uint8) * 10, (13, 1))  # grey = 10 u
    frame = PointFeatures(CAMERA, light, at_pixels((5, 3), (6.3, 4.5), (16, 12), (16.2, 3)), np.array([200, 100, 100, 100]))
    counts = InformationScore([frame]).counts(np.eye(4))
    found = {(int(r), int(c)): int(counts[r, c]) for r, c in np.argwhere(counts)}
    assert found == {(200, 50): 1, (100, 63): 1, (100, 160): 1}  # 10 * 6.3 = 63; the last lies beyond the middle of column 16
    # One table for all frames, its rows reflectivity: the second frame's only point adds to it.
    second = PointFeatures(CAMERA, light, at_pixels((5, 3)), np.array([200]))
    score = InformationScore([frame, second])
    pooled = score.counts(np.eye(4))
    assert (pooled - counts).sum() == pooled[200, 50] - counts[200, 50] == 1
    value = score.value(np.eye(4))
    assert value == pytest.approx(jh.mutual_information(jh.density(pooled, jh.silverman_bandwidth(pooled))))
    assert value > 0.1
    assert score.value(se3.perturb(np.eye(4), [0, 0, 0], [0, 0, -100])) == 0


def test_hidden_points_do_not_count() -> None:
    # In the middle at 10 m, and 5 cm and 20 cm behind; beside it 20 m, alone in its pixel; outside the image.
    middle = [at_pixels((8, 6), depth=d) for d in (10.2, 10, 10.05)]
    xyz = np.concatenate([*middle, at_pixels((9, 6), depth=20), at_pixels((40, 6))])
    frame = PointFeatures(CAMERA, np.zeros((13, 17), np.uint8), xyz, np.zeros(5, np.intp))
    assert unhidden(frame, np.eye(4), 0.1).tolist() == [1, 2, 3]
    assert unhidden(frame, np.eye(4), 0.3).tolist() == [0, 1, 2, 3]
    # One behind the other at 10 and 20 m; 2 m to the side they are seen 2 px and 1 px off the middle.
    apart = PointFeatures(CAMERA, frame.image, at_pixels((8, 6), (8, 6)) * np.array([[1], [2]], np.float32), np.zeros(2, np.intp))
    assert unhidden(apart, np.eye(4), 0.1).tolist() == [0]
    assert unhidden(apart, se3.perturb(np.eye(4), [0] * 3, [2, 0, 0]), 0.1).tolist() == [0, 1]


@both
def test_a_cloud_without_reflectivity_is_refused(method, scene) -> None:
    frame = scene.frames[0]
    xyz = frame.cloud.xyz
    for intensity in (None, np.full(len(xyz), 7, np.float32)):  # drivers without it fill in a constant
        with pytest.raises(BadInputError, match="no reflectivity"):
            method.features(dataclasses.replace(frame, cloud=PointCloud(xyz, intensity)))


# --- MulFEAT: eq. 4.6 by hand, P(E^L) on the cylinder, and the whole on a synthetic street --------------------------------


BROAD = Camera(np.array([[50.0, 0, 19.5], [0, 50.0, 11.5], [0, 0, 1]]), 40, 24)
CONFIG = Config()
METHOD = Mulfeat()


def on_pixels(u: list[float], v: list[float], z: float = 10.0) -> np.ndarray:
    """Points that project onto pixels (u, v) at depth z m."""
    rays = np.stack([(np.array(u) - 19.5) / 50, (np.array(v) - 11.5) / 50, np.ones(len(u))], axis=1)
    return np.asarray(rays * z, np.float32)


@pytest.fixture(scope="module")
def three() -> PointFeatures:
    """P = 0.5, 0.25, 0.1 on pixels (3, 2), (10, 5), (20, 8), where E^C = 0.8, 0.2, 0.6; and one of P = 0.9 beside the image."""
    E = np.zeros((24, 40), np.float32)
    E[2, 3], E[5, 10], E[8, 20], E[5, 11] = 0.8, 0.2, 0.6, 0.4
    xyz = on_pixels([3, 10, 20, 45], [2, 5, 8, 5])
    return PointFeatures(BROAD, E, xyz, np.array([0.5, 0.25, 0.1, 0.9], np.float32))


def test_the_score_by_hand(three):
    """LiDAR edges are those of P >= 1/6: the first two, N_e = 2. Of them the first meets E^C >= 0.3: N_m = 1. The third is no
    edge, but adds to the sum; the fourth is not in the image, and counts nowhere.

    J = 1/2 (0.5 * 0.8 + 0.25 * 0.2 + 0.1 * 0.6) = 1/2 (0.40 + 0.05 + 0.06) = 0.255
    """
    score = MeanScore([three], Mulfeat(lidar_edge=1 / 6, image_edge=0.3).matched)
    assert score.value(np.eye(4)) == pytest.approx(0.255, rel=1e-6)
    # With E^C >= 0.2 an edge, both match: 2/2 * 0.51. With P >= 0.05, three are edges, and two match: 2/3 * 0.51.
    assert Mulfeat(lidar_edge=1 / 6, image_edge=0.2).matched(three, np.eye(4)) == pytest.approx(0.51, rel=1e-6)
    assert Mulfeat(lidar_edge=0.05, image_edge=0.3).matched(three, np.eye(4)) == pytest.approx(0.34, rel=1e-6)
    # 0.2 m to the right at 10 m is one pixel: (4, 2), (11, 5), (21, 8) hold E^C = 0, 0.4, 0. J = 1/2 (0.25 * 0.4) = 0.05.
    assert score.value(se3.from_parts(np.eye(3), [0.2, 0, 0])) == pytest.approx(0.05, rel=1e-6)


# ---- the cylinder ---


BEHIND = Plane((1, 0, 0), 15.0)
OBJECT = Box((7.0, -1.0, -1.7), (8.0, 1.0, 1.0))


@pytest.fixture(scope="module")
def box_scan() -> PointCloud:
    return Spinner(rings=48, low=-16, high=8, field=(-60, 60)).scan([GROUND, BEHIND, OBJECT])


def probability(cloud: PointCloud) -> np.ndarray:
    P = np.zeros(len(cloud))
    index, values = edge_probability(cloud, reflectivity(cloud.intensity), CONFIG, METHOD.rows_per_ring, METHOD.columns_per_step)
    P[index] = values
    return P


def of_rings(cloud: PointCloud, P: np.ndarray, where: np.ndarray) -> np.ndarray:
    """The highest P of each ring that has points there."""
    rings = np.unique(cloud.ring[where])
    return np.array([P[where & (cloud.ring == ring)].max() for ring in rings])


def test_edges_are_where_an_object_ends(box_scan):
    """In front, 7 m ahead, from y = -1 to 1 and z = -1.7 to 1: the wall 15 m ahead is another object 8 m farther away.

    It ends at azimuths of atan(1 / 7) = 8.13 deg; completion widens it by two cells, 0.25 deg."""
    x, y, z = box_scan.xyz.T
    off, level = np.abs(np.rad2deg(np.arctan2(y, x))) - 8.13, np.abs(z / x) < 0.08
    P = probability(box_scan)
    # Depth and object are full edges of the mixed operator, or half ones; reflectivity shows none: up to 2/3.
    rim = of_rings(box_scan, P, level & (off > -0.2) & (off < 0.6))
    assert len(rim) > 10
    assert np.median(rim) > 1 / 3
    assert P.max() <= 2 / 3 + 1e-6
    assert of_rings(box_scan, P, level & (off < -2)).max() < 0.02  # on the object
    assert of_rings(box_scan, P, level & (off > 4) & (off < 30)).max() < 0.1  # on the wall, which recedes


def test_reflectivity_alone_makes_edges():
    """A wall that is bright on its left half: of the three maps one shows an edge, so that P is up to 1/3."""
    wall = Plane((1, 0, 0), 12.0, lambda p: np.where(p[:, 1] > 0, 0.9, 0.5))
    cloud = Spinner(rings=32, low=-6, high=6, field=(-40, 40)).scan([wall])
    P, (_, y, z) = probability(cloud), cloud.xyz.T
    # The bright half is widened by two cells, 0.25 deg or 5 cm.
    level, border = np.abs(z) < 0.8, (y > -0.15) & (y < 0.06)
    at_border = of_rings(cloud, P, level & border)
    assert len(at_border) > 10
    assert np.median(at_border) > 1 / 6
    assert at_border.max() <= 1 / 3 + 1e-6
    assert of_rings(cloud, P, level & (np.abs(y) > 0.5) & (np.abs(y) < 3)).max() < 0.02
    index, _ = edge_probability(cloud, None, CONFIG, METHOD.rows_per_ring, METHOD.columns_per_step)
    assert not np.isin(np.flatnonzero(level & border), index).any()


def test_steps_and_limits_of_a_reach():
    """0.2 m is 0.02 rad at 10 m, 1.1459 deg; the geometric mean with 2 deg is sqrt(2.2918) = 1.5139 deg."""
    assert typical_step_deg(SearchBox(2.0, 0.2)) == pytest.approx(1.5139, abs=1e-4)
    assert typical_step_deg(SearchBox((1.0, 3.0, 0.0), 0.0)) == 3.0
    assert typical_step_deg(SearchBox(0.0, 0.2)) == pytest.approx(1.1459, abs=1e-4)
    assert 0 < typical_step_deg(SearchBox(0.0, 0.0)) < 1
    assert np.isinf(search_limits(np.eye(4), SearchBox(0.0, 0.0)).half).all()
    assert search_limits(np.eye(4), SearchBox(0.0, 0.2)).half.tolist() == [0, 0, 0, 0.2, 0.2, 0.2]
