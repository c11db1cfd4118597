"""The two baselines that match edges: Levinson and Thrun (2013), and Castorena et al. (2016)."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from bowl import Bowl

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.registration.search.constraints import SearchBox
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
from calib_ros_evaluation.methods.method import PointFeatures


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
