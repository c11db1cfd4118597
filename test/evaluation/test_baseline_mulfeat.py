"""MulFEAT: eq. 4.6 by hand, P(E^L) on the cylinder, and the whole on a synthetic street."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import GROUND, Box, Plane, Spinner

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.config import Config
from calib_ros.frame import PointCloud
from calib_ros.lidar.range_image import reflectivity
from calib_ros.registration.search.constraints import SearchBox
from calib_ros_evaluation.methods.method import MeanScore, PointFeatures, search_limits, typical_step_deg
from calib_ros_evaluation.methods.mulfeat import Mulfeat, edge_probability

IDENTITY = np.eye(4)  # the points are given in the camera's frame
CAMERA = Camera(np.array([[50.0, 0, 19.5], [0, 50.0, 11.5], [0, 0, 1]]), 40, 24)
CONFIG = Config()
METHOD = Mulfeat()


def at_pixels(u: list[float], v: list[float], z: float = 10.0) -> np.ndarray:
    """Points that project onto pixels (u, v) at depth z m."""
    rays = np.stack([(np.array(u) - 19.5) / 50, (np.array(v) - 11.5) / 50, np.ones(len(u))], axis=1)
    return np.asarray(rays * z, np.float32)


@pytest.fixture(scope="module")
def three() -> PointFeatures:
    """P = 0.5, 0.25, 0.1 on pixels (3, 2), (10, 5), (20, 8), where E^C = 0.8, 0.2, 0.6; and one of P = 0.9 beside the image."""
    E = np.zeros((24, 40), np.float32)
    E[2, 3], E[5, 10], E[8, 20], E[5, 11] = 0.8, 0.2, 0.6, 0.4
    xyz = at_pixels([3, 10, 20, 45], [2, 5, 8, 5])
    return PointFeatures(CAMERA, E, xyz, np.array([0.5, 0.25, 0.1, 0.9], np.float32))


def test_the_score_by_hand(three):
    """LiDAR edges are those of P >= 1/6: the first two, N_e = 2. Of them the first meets E^C >= 0.3: N_m = 1. The third is no
    edge, but adds to the sum; the fourth is not in the image, and counts nowhere.

    J = 1/2 (0.5 * 0.8 + 0.25 * 0.2 + 0.1 * 0.6) = 1/2 (0.40 + 0.05 + 0.06) = 0.255
    """
    score = MeanScore([three], Mulfeat(lidar_edge=1 / 6, image_edge=0.3).matched)
    assert score.value(IDENTITY) == pytest.approx(0.255, rel=1e-6)
    # With E^C >= 0.2 an edge, both match: 2/2 * 0.51. With P >= 0.05, three are edges, and two match: 2/3 * 0.51.
    assert Mulfeat(lidar_edge=1 / 6, image_edge=0.2).matched(three, IDENTITY) == pytest.approx(0.51, rel=1e-6)
    assert Mulfeat(lidar_edge=0.05, image_edge=0.3).matched(three, IDENTITY) == pytest.approx(0.34, rel=1e-6)
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
    assert np.isinf(search_limits(IDENTITY, SearchBox(0.0, 0.0)).half).all()
    assert search_limits(IDENTITY, SearchBox(0.0, 0.2)).half.tolist() == [0, 0, 0, 0.2, 0.2, 0.2]
