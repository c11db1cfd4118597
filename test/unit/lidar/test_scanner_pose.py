"""Clouds in another frame than the scanner's: its centre and axis are found from the rays, or given."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import GROUND, HEIGHT, Box, Plane, Rosette, Spinner
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from calib_ros.config import LidarConfig, MotionConfig
from calib_ros.datasets import open_dataset
from calib_ros.frame import PointCloud
from calib_ros.lidar.deskew import scan_times
from calib_ros.lidar.edges import edge_points
from calib_ros.lidar.range_image import range_image
from calib_ros.lidar.rings import _cut
from calib_ros.lidar.scanner_pose import CLOUD_FRAME, ScannerPose, fitted_pose, upright

CONFIG = LidarConfig()
ROOM = [
    Box((9.5, -1.03, -HEIGHT), (10.5, 1.21, 0.3)),
    Box((-6, 3, -HEIGHT), (-5, 4, 2)),
    GROUND,
    *(Plane(n, d) for n, d in (((1, 0, 0), 20), ((-1, 0, 0), 15), ((0, 1, 0), 12), ((0, -1, 0), 9))),
]
SCANNER = Spinner(rings=32, low=-24, high=8, step=0.25)
MOUNTS = {  # position in m, and roll, pitch, yaw in deg, of the scanner in the frame of the cloud
    "on a roof": ((1.5, 0.2, 1.9), (0.0, 0.0, 0.0)),
    "tilted": ((0.0, 0.0, 0.0), (20.0, 0.0, 0.0)),
    "tilted on a bumper": ((3.6, -0.4, 0.6), (3.0, 25.0, -40.0)),
    "a little off": ((0.3, 0.1, 0.1), (1.0, -2.0, 0.0)),
    "on its side": ((1.0, -2.0, 2.0), (90.0, 0.0, 0.0)),
    "upside down": ((0.0, 0.0, 0.0), (180.0, 0.0, 0.0)),
}


def mounted(cloud: PointCloud, position: tuple[float, ...], rpy: tuple[float, ...]) -> tuple[PointCloud, ScannerPose]:
    """The cloud as a driver gives it in another frame; and the pose of the scanner there."""
    pose = ScannerPose.given(position, rpy)
    return replace(cloud, xyz=pose.to_cloud(cloud.xyz.astype(float)).astype(np.float32)), pose


def axes_apart_deg(a: ScannerPose, b: ScannerPose) -> float:
    return float(np.rad2deg(np.arccos(min(abs(float(a.axis @ b.axis)), 1.0))))


@pytest.fixture(scope="module")
def scan() -> PointCloud:
    return SCANNER.scan(ROOM)


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("known", ["ring field", "order", "nothing"])
def test_a_cloud_in_another_frame_gives_the_same_edges(scan, mount, known):
    position, rpy = MOUNTS[mount]
    cloud = scan if known == "ring field" else replace(scan, ring=None)
    if known == "nothing":
        cloud = cloud.select(np.random.default_rng(0).permutation(len(cloud)))
    moved, pose = mounted(cloud, position, rpy)
    image = range_image(moved, CONFIG)
    assert image.layout == "rings"
    assert len(image.elevation) == SCANNER.rings
    assert np.abs(image.pose.centre - pose.centre).max() < 0.01
    assert axes_apart_deg(image.pose, pose) < 0.02
    assert image.pose.tilt_deg == pytest.approx(pose.tilt_deg, abs=0.05)
    own, other = edge_points(range_image(scan, CONFIG), CONFIG), edge_points(image, CONFIG)
    distance, _ = KDTree(own.xyz).query(pose.to_scanner(other.xyz.astype(float)))
    assert len(other) == pytest.approx(len(own), rel=0.05)
    assert np.percentile(distance, 95) < 0.05


def test_the_own_vehicle_in_the_scan_does_not_mislead():
    """A scanner on the roof of a vehicle that it sees, in a cloud of base_link."""
    cloud = open_dataset("synthetic:rig=os1_128_windshield,scene=street,seed=47,frames=1,ride=weaving,width=320")[0].cloud
    moved, pose = mounted(cloud, (1.2, 0.1, 1.7), (0.0, 1.0, 0.0))
    assert moved.ring is not None
    fit = fitted_pose(moved.xyz, moved.ring)
    assert fit.apart
    assert np.abs(fit.pose.centre - pose.centre).max() < 0.01
    assert axes_apart_deg(fit.pose, pose) < 0.02


def test_a_scanner_in_its_own_frame_stays_there(scan):
    rng = np.random.default_rng(0)
    heights = np.where(scan.ring < 16, 0.21, 0.12)[:, None] * [0, 0, 1]  # of an HDL-64E's lasers above its origin
    moved = [replace(scan, xyz=(scan.xyz + by).astype("f4")) for by in (rng.normal(0, 0.02, scan.xyz.shape), heights)]
    ceiling = [GROUND, Plane((0, 0, 1), 1.5), *(Plane(n, 14) for n in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)))]
    for cloud in (scan, replace(scan, ring=None), *moved, Spinner(rings=32, low=-20, high=20).scan(ceiling)):
        assert range_image(cloud, CONFIG).pose is CLOUD_FRAME


def test_the_fit_survives_motion_and_stray_points(scan):
    rng = np.random.default_rng(0)
    xyz = scan.xyz.astype(float)
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    xyz += azimuth[:, None] / (2 * np.pi) * [1.0, 0, 0]  # compensated at 10 m/s
    stray = rng.random(len(xyz)) < 0.05
    xyz[stray] *= rng.uniform(0.3, 0.8, (int(stray.sum()), 1))
    pose = ScannerPose.given((1.2, 0.0, 1.8), (5.0, 8.0, 0.0))
    fit = fitted_pose(pose.to_cloud(xyz), scan.ring)
    assert fit.apart
    assert axes_apart_deg(fit.pose, pose) < 0.15
    assert np.linalg.norm(fit.pose.centre - pose.centre) < 0.15


@pytest.mark.parametrize("rings", [True, False])
def test_a_given_pose_is_taken(scan, rings):
    cloud = scan if rings else Rosette().scan(ROOM)
    position, rpy = (1.5, 0.2, 1.9), (3.0, 25.0, -40.0)
    given = replace(CONFIG, scanner_pose="given", scanner_position_m=position, scanner_rpy_deg=rpy)
    moved, pose = mounted(cloud, position, rpy)
    image, own = range_image(moved, given), range_image(cloud, CONFIG)
    assert np.allclose(image.pose.rotation, pose.rotation)
    assert image.range.shape == own.range.shape
    assert np.nanmax(np.abs(image.range - own.range)) < 1e-3
    edges, expected = edge_points(image, given).xyz, edge_points(own, CONFIG).xyz
    assert np.abs(pose.to_scanner(edges.astype(float)) - expected).max() < 1e-3


def test_roll_pitch_and_yaw_are_those_of_urdf_and_axes_are_reached_by_the_smallest_rotation():
    roll, pitch, yaw = 0.3, -0.2, 1.1
    pose = ScannerPose.given((0, 0, 0), np.rad2deg([roll, pitch, yaw]))
    one_by_one = [Rotation.from_rotvec(v).as_matrix() for v in ([0, 0, yaw], [0, pitch, 0], [roll, 0, 0])]
    assert np.allclose(pose.rotation, one_by_one[0] @ one_by_one[1] @ one_by_one[2])
    assert pose.tilt_deg == pytest.approx(np.rad2deg(np.arccos(np.cos(roll) * np.cos(pitch))))
    rng = np.random.default_rng(0)
    for axis in [*rng.normal(size=(20, 3)), np.array([0.0, 0, 1]), np.array([0.0, 0, -1])]:
        axis = axis / np.linalg.norm(axis)
        R = upright(axis)
        assert np.allclose(R @ R.T, np.eye(3))
        assert np.linalg.det(R) == pytest.approx(1)
        assert np.allclose(R[:, 2], axis)
        assert np.trace(R) == pytest.approx(1 + 2 * axis[2], abs=1e-9)  # turned by no more than the angle between the axes


@pytest.mark.parametrize("shift", [(0.0, 0.0, 0.0), (1.5, 0.2, 1.0)])
def test_times_by_azimuth_are_those_about_the_scanner(scan, shift):
    moved, pose = mounted(scan, shift, (0.0, 0.0, 0.0))
    expected = scan_times(scan.xyz, MotionConfig())
    inside = np.abs(expected) < 0.049  # where the turn begins, rounding decides between its two ends
    assert np.abs(scan_times(moved.xyz, MotionConfig(), pose) - expected)[inside].max() < 1e-6
    over, turned = mounted(scan, shift, (180.0, 0.0, 0.0))
    by_azimuth = scan_times(over.xyz, MotionConfig(), turned)
    assert np.abs(by_azimuth + expected)[inside].max() < 1e-6  # it turns the other way as seen from above


@pytest.mark.parametrize("others", [np.pi, 0.002 - np.pi])
def test_rings_may_end_half_a_turn_from_the_view(others):
    """Where the azimuth jumps: in the last cell of the histogram, and in the first."""
    azimuth = np.full(51, np.pi)
    azimuth[::2] = others
    assert np.cos(_cut(azimuth, np.ones(50), 0.0)) == pytest.approx(-1, abs=1e-5)
