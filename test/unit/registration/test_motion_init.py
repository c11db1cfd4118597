"""The first guess from motion: exact tracks of known motions, pictures that shift, frames of a drive, refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import QUICK, SIZE, RenderedDrive

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.config import Config
from calib_ros.errors import BadInputError, TooFewFeaturesError
from calib_ros.frame import NANOSECONDS, Frame, PointCloud
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import FeatureExtractor
from calib_ros.registration.initial_guess import nominal
from calib_ros.registration.motion_guess.guess import LEAST_DEG, guess_from_tracks, motion_guess
from calib_ros.registration.motion_guess.tracks import Run, Tracks, picture_pairs
from calib_ros.registration.search.constraints import SEMANTIC_BOX
from calib_ros.result import CONVERGED, INSUFFICIENT, InitialSource

CAMERA = Camera(np.array([[500.0, 0, 319.5], [0, 500, 119.5], [0, 0, 1]]), 640, 240)
PIXEL = 1 / 500
STRAIGHT = np.array([0, 0, 0, 5.0, 0, 0])
ON_THE_SPOT = np.array([0, 0, 0.5, 0, 0, 0])


def run_of(twists: np.ndarray, late_s: float = 0.0) -> Run:
    """A run at 10 Hz with these velocities (n, 6) between its scans; images are stamped late."""
    times = 0.1 * np.arange(len(twists) + 1)
    poses = [np.eye(4)]
    for twist in twists:
        poses.append(poses[-1] @ se3.exp(0.1 * twist))
    return Run(0, times, times + late_s, np.array(poses), twists)


def winding(n: int = 24) -> np.ndarray:
    """Velocities (n, 6) through bends, with some sway."""
    t = 0.1 * np.arange(n)
    zero = 0 * t
    return np.c_[0.02 * np.sin(5 * t), 0.03 * np.sin(4 * t), 0.3 * np.sin(2 * t), 6 + zero, zero, zero]


def tracks_of(run: Run, T: np.ndarray, late_s: float = 0.0, noise_px: float = 0.3, n: int = 15) -> Tracks:
    """What a camera at T sees of random points around the LiDAR, in pairs of pictures of the run."""
    rng = np.random.default_rng(5)
    pairs = picture_pairs(run)
    firsts, seconds, numbers = [], [], []
    for k, (a, b) in enumerate(pairs):
        direction = rng.normal(size=(20 * n, 3)) * [1, 1, 0.2]
        before, after = se3.inverse(run.pose([run.images[a] - late_s])[0]), se3.inverse(run.pose([run.images[b] - late_s])[0])
        world = se3.transform(
            se3.inverse(before), direction / np.linalg.norm(direction, axis=1)[:, None] * rng.uniform(4, 40, (20 * n, 1))
        )
        seen = [se3.transform(T @ move, world) for move in (before, after)]
        kept = np.flatnonzero(np.all([(p[:, 2] > 1) & (np.abs(p[:, 0]) < p[:, 2]) for p in seen], axis=0))[:n]
        for out, p in zip((firsts, seconds), seen, strict=True):
            noisy = p[kept] / np.linalg.norm(p[kept], axis=1)[:, None] + noise_px * PIXEL * rng.normal(size=(len(kept), 3))
            out.append(noisy / np.linalg.norm(noisy, axis=1)[:, None])
        numbers.append(np.full(len(kept), k))
    start, end = (np.array([run.images[pair[s]] for pair in pairs]) for s in (0, 1))
    return Tracks(
        np.concatenate(numbers), np.concatenate(firsts), np.concatenate(seconds), start, end, np.zeros(len(pairs), int), PIXEL
    )


def mounted(yaw_deg: float, tilt_deg: tuple[float, float, float] = (2.0, -1.5, 1.0)) -> np.ndarray:
    T = se3.perturb(nominal(yaw_deg), np.array(tilt_deg), np.zeros(3))
    T[:3, 3] = -T[:3, :3] @ [0.6, -0.3, -0.4]
    return T


@pytest.mark.parametrize(("yaw_deg", "roll_deg"), [(0.0, 1.0), (75.0, 1.0), (-170.0, 1.0), (0.0, 88.0)])
def test_bends_tell_the_rotation_of_a_camera_of_any_yaw(yaw_deg: float, roll_deg: float) -> None:
    """Also of one on its side."""
    T, run = mounted(yaw_deg, (2.0, -1.5, roll_deg)), run_of(winding())
    guess = guess_from_tracks(tracks_of(run, T), [run])
    assert se3.rotation_error_deg(T, guess.hypotheses[0]) < 0.5
    assert len(guess.hypotheses) == 1
    assert "hardly shown" not in guess.note
    assert guess.box.rotation_deg == (LEAST_DEG,) * 3
    assert guess.box.translation_m == SEMANTIC_BOX.translation_m
    assert "4" in guess.note


@pytest.mark.parametrize("yaw_deg", [0.0, 90.0, 180.0])
def test_driving_straight_hides_the_turn_about_the_direction_of_travel(yaw_deg: float) -> None:
    """Forward and backward are told apart, and the rest is taken as upright."""
    T, run = mounted(yaw_deg), run_of(np.tile(STRAIGHT, (16, 1)))
    guess = guess_from_tracks(tracks_of(run, T), [run])
    travel = T[:3, :3] @ [1, 0, 0]
    assert np.rad2deg(np.arccos(np.clip(guess.hypotheses[0][:3, 0] @ travel, -1, 1))) < 0.3
    assert se3.rotation_error_deg(T, guess.hypotheses[0]) < 4
    assert "direction of travel" in guess.note
    variances, axes = np.linalg.eigh(guess.covariance)
    assert abs(axes[:, -1] @ travel) > 0.99
    assert 2 < np.rad2deg(np.sqrt(variances[-1])) < 10


def test_turning_on_the_spot_leaves_the_yaw_open() -> None:
    T, run = mounted(20.0), run_of(np.tile(ON_THE_SPOT, (16, 1)))
    with pytest.raises(TooFewFeaturesError, match="drives some"):
        guess_from_tracks(tracks_of(run, T), [run])


@pytest.mark.parametrize("late_s", [0.0, 0.12])
def test_the_offset_of_the_clocks_where_turning_varies(late_s: float) -> None:
    T, run = mounted(0.0), run_of(winding(), late_s)
    guess = guess_from_tracks(tracks_of(run, T, late_s), [run])
    assert guess.time_offset_s is not None
    assert abs(guess.time_offset_s - late_s) < 0.02
    assert se3.rotation_error_deg(T, guess.hypotheses[0]) < 0.5


def test_a_steady_speed_tells_nothing_of_the_clocks() -> None:
    run = run_of(np.tile([0, 0, 0.2, 5.0, 0, 0], (30, 1)))
    guess = guess_from_tracks(tracks_of(run, mounted(0.0)), [run])
    assert guess.time_offset_s is None


def test_tracks_that_do_not_follow_the_lidar_are_refused() -> None:
    run = run_of(winding())
    tracks = tracks_of(run, mounted(0.0))
    rng = np.random.default_rng(1)
    wild = rng.permutation(tracks.second)
    with pytest.raises(TooFewFeaturesError, match="do not move as"):
        guess_from_tracks(replace(tracks, second=wild), [run])
    other = run_of(winding()[::-1] * [1, 1, 0.4, 1, 1, 1])  # images of another moment, or another vehicle's
    with pytest.raises(TooFewFeaturesError, match="do not move as"):
        guess_from_tracks(tracks, [other])
    few = np.flatnonzero(tracks.pair < 3)
    with pytest.raises(TooFewFeaturesError, match="tracked"):
        guess_from_tracks(replace(tracks, pair=tracks.pair[few], first=tracks.first[few], second=tracks.second[few]), [run])


def frame_at(seconds: float, twist: np.ndarray | None, delay_s: float = 0.0) -> Frame:
    stamp = round(seconds * NANOSECONDS)
    cloud = PointCloud(np.ones((400, 3), np.float32))
    late = stamp + round(delay_s * NANOSECONDS)
    return Frame(np.zeros((240, 640), np.uint8), cloud, CAMERA, late, stamp, name=f"{seconds:g}", twist=twist)


def test_a_vehicle_that_stands_is_told() -> None:
    extract = FeatureExtractor(CAMERA, Config())
    for step, count, twist, says in (
        (0.1, 10, np.zeros(6), "stands still"),
        (3.0, 10, STRAIGHT, "follow each other"),
        (0.0, 1, STRAIGHT, "consecutive"),
        (0.1, 10, STRAIGHT, "tracked"),
    ):
        with pytest.raises(TooFewFeaturesError, match=says):
            motion_guess([frame_at(step * k, twist) for k in range(count)], extract)
    with pytest.raises(BadInputError, match="order"):
        motion_guess([frame_at(-0.1 * k, STRAIGHT) for k in range(10)], extract)


def test_the_calibrator_says_what_motion_lacks() -> None:
    frames = [frame_at(0.1 * k, np.zeros(6)) for k in range(4)]
    result = Calibrator(CAMERA, QUICK).calibrate(frames, "motion")
    assert result.status == INSUFFICIENT
    np.testing.assert_array_equal(result.T_camera_lidar, nominal())


def test_auto_falls_back_on_the_nominal_extrinsic() -> None:
    """Of a vehicle that stops for every frame, without classes."""
    drive = RenderedDrive(seed=1, **SIZE)
    frames = [drive[k] for k in range(2)]
    result = Calibrator(frames[0].camera, QUICK).calibrate(frames, "auto")
    assert result.status == CONVERGED
    assert result.origin is InitialSource.NOMINAL
    assert "not by motion" in result.reason


def test_a_drive_is_calibrated_from_its_motion() -> None:
    """A camera that looks backward, registered from every fourth frame."""
    T = se3.perturb(nominal(180.0), np.array([2.0, -1.5, 1.0]), np.zeros(3))
    T[:3, 3] = -T[:3, :3] @ [-0.3, 0.1, -0.1]
    drive = RenderedDrive(seed=6, frames=11, rings=32, width=448, height=168, stride=3, T_camera_lidar=T)
    frames = [drive[k] for k in range(len(drive))]
    result = Calibrator(frames[0].camera, QUICK).calibrate(frames[::4], "motion", consecutive=frames)
    assert result.initial is not None
    assert se3.rotation_error_deg(T, result.initial) < 4
    assert result.status == CONVERGED
    assert result.origin is InitialSource.MOTION
    assert se3.rotation_error_deg(T, result.T_camera_lidar) < 0.5
