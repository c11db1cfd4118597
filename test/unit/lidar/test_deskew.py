"""Deskewing: where points of a moving scan lie at the moment of the image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import RenderedDrive
from scipy.spatial import KDTree

from calib_ros import se3
from calib_ros.config import Config, MotionConfig
from calib_ros.errors import BadInputError
from calib_ros.frame import Frame
from calib_ros.lidar.deskew import deskewed_edges, deskewed_frame, deskewed_points, has_times, image_times, moved, scan_times
from calib_ros.lidar.edges import EdgePoints, edge_points
from calib_ros.lidar.range_image import range_image
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.registration.features import FeatureExtractor
from calib_ros_synthetic.drive import SyntheticDrive

AUTO, OFF = MotionConfig(), MotionConfig(deskew="off")
MS = 1_000_000  # ns
SPEED = 10.0


def config(**motion: object) -> Config:
    return Config(motion=MotionConfig(**motion))


@pytest.fixture(scope="module")
def fast() -> SyntheticDrive:
    return RenderedDrive(seed=4, frames=6, rings=64, speed=SPEED, stride=10, noise=0, width=620, height=188)


@pytest.fixture(scope="module")
def still() -> SyntheticDrive:
    """At the same places of the same street, standing."""
    return RenderedDrive(seed=4, frames=6, rings=64, speed=0, stride=20, noise=0, width=620, height=188)


@pytest.fixture(scope="module")
def frame(fast: SyntheticDrive) -> Frame:
    return fast[2]


def edges_of(frame: Frame) -> EdgePoints:
    return edge_points(range_image(frame.cloud, Config().lidar), Config().lidar)


def distance(points: EdgePoints, others: EdgePoints) -> float:
    """Median distance of edge points to the nearest of the others, m."""
    return float(np.median(KDTree(others.xyz).query(points.xyz)[0]))


# ---- where a point goes ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "twist",
    [
        (0, 0, 0, 10, -1, 0.2),
        (0, 0, 1.0, 10, 0, 0),
        (0.9, -1.2, 2.5, 20, 3, -1),
        (1e-9, 2e-9, -1e-9, 5, 5, 5),
        (0.04, 0.03, 0.0, 5, 0, 0),  # on both sides of where series and closed form meet
        (0, 0, 6.0, 0, 0, 0),
    ],
)
def test_a_point_moves_by_the_exponential_of_its_time(twist):
    rng = np.random.default_rng(0)
    p, tau = rng.normal(0, 30, (300, 3)), np.r_[0.0, rng.uniform(-1, 1, 298), 1.0]
    one_by_one = np.array([se3.transform(se3.exp(np.array(twist) * t), q[None])[0] for q, t in zip(p, tau, strict=True)])
    assert np.abs(moved(p, twist, tau) - one_by_one).max() < 1e-10
    assert moved(p[:0], twist, tau[:0]).shape == (0, 3)
    assert np.isfinite(moved(np.r_[[[np.nan, 1, 2]], p], twist, np.r_[0.1, tau])[1:]).all()


# ---- when a point was measured -----------------------------------------------------------------------------------------


def test_azimuth_times_equal_times_per_point(frame):
    by_azimuth = scan_times(frame.cloud.xyz, AUTO)
    assert np.abs(by_azimuth - frame.cloud.time).max() < 1e-6
    without = replace(frame, cloud=replace(frame.cloud, time=None))
    assert np.abs(deskewed_points(without, AUTO) - deskewed_points(frame, AUTO)).max() < 1e-4
    constant = replace(frame.cloud, time=np.full(len(frame.cloud), 0.25, np.float32))  # as drivers without times fill it in
    assert [has_times(cloud) for cloud in (constant, without.cloud, frame.cloud)] == [False, False, True]
    assert np.abs(deskewed_points(replace(frame, cloud=constant), AUTO) - deskewed_points(frame, AUTO)).max() < 1e-4
    same = deskewed_edges(edges_of(without), without, AUTO)
    assert np.abs(same.xyz - deskewed_edges(edges_of(frame), frame, AUTO).xyz).max() < 1e-3  # they stand half a firing aside


def test_time_of_an_azimuth():
    for options, at, seconds in (
        ({}, 0, 0.0),
        ({}, 90, -0.025),  # left: clockwise, the scanner has passed it
        ({}, -90, 0.025),
        ({}, 179, -0.0497222),
        ({"spin": "counterclockwise"}, 90, 0.025),
        ({"spin": "none"}, 90, 0.0),
        ({"scan_period_s": 0.05}, -90, 0.0125),
        ({"stamp_azimuth_deg": 90.0}, 90, 0.0),
        ({"stamp_azimuth_deg": 90.0}, 0, 0.025),
        ({"stamp_azimuth_deg": 90.0}, -80, 0.0472222),
        ({"stamp_azimuth_deg": 90.0}, -100, -0.0472222),
        ({"stamp_azimuth_deg": 180.0, "stamp_at": "start"}, 179, 0.1 / 360),
        ({"stamp_azimuth_deg": 180.0, "stamp_at": "start"}, 0, 0.05),
        ({"stamp_azimuth_deg": -180.0, "stamp_at": "start"}, -179, 0.1 * 359 / 360),
        ({"stamp_azimuth_deg": 180.0, "stamp_at": "end"}, 0, -0.05),
        ({"stamp_azimuth_deg": 180.0, "stamp_at": "end"}, 179, -0.1 * 359 / 360),
    ):
        angle = np.deg2rad(at)
        point = np.array([[7 * np.cos(angle), 7 * np.sin(angle), -1]])
        assert scan_times(point, MotionConfig(**options))[0] == pytest.approx(seconds, abs=1e-6)


def test_the_image_moment_counts(frame):
    def tau(frame: Frame, motion: MotionConfig = AUTO) -> float:
        times = image_times(frame, frame.cloud.xyz, frame.cloud.time, motion) - frame.cloud.time
        assert np.ptp(times) < 1e-6
        return float(times.mean())

    assert tau(frame) == pytest.approx(0, abs=1e-9)
    assert tau(replace(frame, cloud_stamp=None)) == pytest.approx(0, abs=1e-9)
    assert tau(replace(frame, cloud_stamp=frame.stamp + 20 * MS)) == pytest.approx(0.02, abs=1e-7)
    assert tau(replace(frame, stamp=frame.stamp + 20 * MS)) == pytest.approx(-0.02, abs=1e-7)
    assert tau(frame, MotionConfig(time_offset_s=0.03)) == pytest.approx(0.03, abs=1e-7)


# ---- what comes of it --------------------------------------------------------------------------------------------------


def test_edges_lie_where_a_standing_vehicle_sees_them(fast, still):
    frame, there = fast[2], edges_of(still[2])
    skewed = edges_of(frame)
    moved_back = distance(deskewed_edges(skewed, frame, AUTO), there)
    assert distance(skewed, there) > 2 * moved_back
    assert distance(deskewed_edges(skewed, replace(frame, twist=-frame.twist), AUTO), there) > 3 * moved_back


def test_features_report_the_deskewing(frame):
    features = FeatureExtractor(frame.camera, Config())(frame)
    assert np.array_equal(features.twist, frame.twist)
    assert features.points.time.dtype == np.float32
    assert 0.04 < np.abs(features.points.time).max() < 0.051
    some = np.array([3, 1])
    assert np.array_equal(features.points.select(some).time, features.points.time[some])
    for motion, changed in ((OFF, frame), (AUTO, replace(frame, twist=None))):
        features = FeatureExtractor(frame.camera, Config(motion=motion))(changed)
        assert features.twist is None
        assert np.array_equal(features.points.xyz, edges_of(frame).xyz)
    untimed = replace(frame, twist=None, cloud=replace(frame.cloud, time=None))
    points = FeatureExtractor(frame.camera, Config())(untimed).points
    assert points.time is None
    assert points.select(some).time is None


def test_the_thesis_objective_gets_moved_points(frame):
    whole = Config.from_dict({"refine": {"objective": "thesis"}})
    features = FeatureExtractor(frame.camera, whole)(frame)
    assert np.array_equal(features.twist, frame.twist)
    moved_cloud = KDTree(deskewed_points(frame, AUTO))
    assert moved_cloud.query(features.own.points.xyz)[0].max() < 1e-6
    assert np.allclose(features.own.points.depth, np.linalg.norm(features.own.points.xyz[:, :2], axis=1), atol=1e-4)
    assert (np.diff(features.own.points.depth) <= 0).all()  # far ones first, by where they stand now


def test_compensated_points_move_as_one(frame):
    done = deskewed_frame(frame, AUTO)
    assert done.compensated
    assert done.twist is None
    assert deskewed_frame(done, AUTO) is done
    assert deskewed_frame(frame, OFF) is frame
    later = replace(done, twist=frame.twist, cloud_stamp=frame.stamp + 10 * MS)
    expected = se3.transform(se3.exp(frame.twist * 0.01), done.cloud.xyz)
    assert np.abs(deskewed_points(later, AUTO) - expected).max() < 1e-4


def test_another_motion_stage_makes_features_anew(frame):
    recalibrator = Recalibrator(frame.camera, frame.reference)
    assert recalibrator.ingest(frame)
    recalibrator.configure(config())
    assert recalibrator.newest() is not None
    recalibrator.configure(config(time_offset_s=0.01))
    assert recalibrator.newest() is None


# ---- bad input ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("twist", [[0, 0, 0, np.inf, 0, 0], np.zeros(5), np.zeros((6, 1)), "fast", [None] * 6])
def test_a_twist_is_six_finite_numbers(frame, twist):
    assert replace(frame, twist=[0, 0, 0, 1, 0, 0]).twist.dtype == np.float64
    with pytest.raises(BadInputError, match="a twist must be 6 finite numbers"):
        replace(frame, twist=twist)


def test_absurd_times_and_stamps_of_two_clocks_are_refused(frame):
    with pytest.raises(BadInputError, match="away from the image's moment"):
        deskewed_points(replace(frame, cloud_stamp=frame.stamp + 3000 * MS), AUTO)
    for seconds in (np.nan, np.inf, 5.0, -1e9):
        time = np.where(np.arange(len(frame.cloud)) % 2, frame.cloud.time, np.float32(seconds))
        odd = replace(frame, cloud=replace(frame.cloud, time=time))
        with pytest.raises(BadInputError, match="both sensors' stamps, or set motion"):
            FeatureExtractor(frame.camera, Config())(odd)
        FeatureExtractor(frame.camera, config(deskew="off"))(odd)
        FeatureExtractor(frame.camera, Config())(replace(odd, twist=None))
