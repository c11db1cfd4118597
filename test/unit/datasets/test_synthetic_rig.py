"""Synthetic rigs of several sensors: one world and ride, exact truths, own clocks and rates, knocks."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import on_pixels_of_their_class

from calib_ros import se3
from calib_ros.datasets.open import open_dataset
from calib_ros.frame import NANOSECONDS, UNLABELLED
from calib_ros_synthetic.rig import RigPair, SyntheticRig, open_drive
from calib_ros_synthetic.rigs import RIGS

SIX = "six_cameras_one_lidar"


def small(rig: str = SIX, **options: object) -> SyntheticRig:
    return SyntheticRig(rig, **{"seed": 3, "frames": 3, "width": 240, "noise": 0.0, **options})  # type: ignore[arg-type]


def agreement(rig: SyntheticRig, camera: str, lidar: str, index: int, T: np.ndarray | None = None) -> float:
    """Share of a scan's points that fall on a pixel of their own class, in a frame of a pair."""
    pair, ahead = rig.pair(camera, lidar), rig.clock_s(camera) - rig.clock_s(lidar)
    own, same = on_pixels_of_their_class(pair, index, pair[index].reference if T is None else T, ahead_s=ahead)
    assert np.count_nonzero(own != UNLABELLED) > 1000
    return float(same[own != UNLABELLED].mean())


PAIRS = [
    (SIX, "front_left", "lidar_top"),
    (SIX, "back", "lidar_top"),
    ("two_lidars_three_cameras", "front", "lidar_right"),
    ("cameras_apart", "rear", "lidar_rear"),
]


@pytest.mark.parametrize(("name", "camera", "lidar"), PAIRS)
def test_points_fall_on_pixels_of_their_class_whatever_the_clocks_say(name: str, camera: str, lidar: str) -> None:
    rig = small(name, ride="weaving")
    truth = rig.pair(camera, lidar)[1].reference
    assert truth is not None
    expected = se3.inverse(rig.reference(camera)) @ rig.reference(lidar)
    np.testing.assert_allclose(truth, expected, atol=1e-12)
    good = agreement(rig, camera, lidar, 1)
    assert good > 0.9
    for axis in np.eye(3):
        assert agreement(rig, camera, lidar, 1, se3.perturb(truth, 3 * axis, np.zeros(3))) < good - 0.01


def test_every_sensor_has_its_own_rate_and_clock() -> None:
    rig, alike = small(), small(clocks=0)
    for name, sensor in RIGS[SIX].sensors.items():
        stamps = rig.stamps(name)
        np.testing.assert_allclose(np.diff(stamps), NANOSECONDS / sensor.rate, atol=1)
        assert len(stamps) == pytest.approx(3 * sensor.rate, abs=1)
        np.testing.assert_allclose(stamps - alike.stamps(name), sensor.late_ms * 1e6, atol=1)
    assert len({int(rig.stamps(name)[0]) for name in rig.cameras}) == len(rig.cameras)
    pair = rig.pair("front_left", "lidar_top")
    assert len(pair) == 3
    for frame in (pair[0], pair[2]):
        # A scan is a tenth of a second long, and the camera looks to the left, which is swept before the scan's stamp.
        assert abs((frame.stamp - frame.moment_of_cloud) / NANOSECONDS + 55 / 3600) < 0.06
        assert frame.stamp in rig.stamps("front_left")
    assert (pair[2].moment_of_cloud - pair[0].moment_of_cloud) / NANOSECONDS == pytest.approx(2.0, abs=0.11)


def test_a_scan_is_rendered_once_for_all_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    rig, scans = small(width=96), []
    counting = rig._scan
    monkeypatch.setattr(rig, "_scan", lambda name, index: scans.append(index) or counting(name, index))
    clouds = [rig.pair(camera, "lidar_top")[1].cloud for camera in ("front", "front_left", "back")]
    stamp, cloud = rig.scans("lidar_top")[scans[0]]
    assert len(scans) == 1
    np.testing.assert_array_equal(cloud.xyz, clouds[0].xyz)
    assert stamp == rig.pair("front", "lidar_top")[1].moment_of_cloud
    clouds[0].xyz[:] = 0  # a caller's frame is its own
    assert np.abs(rig.pair("front", "lidar_top")[1].cloud.xyz).max() > 1


def test_no_sensor_sits_at_its_mount() -> None:
    rig, other, straight = small(tilt_deg=2), small(seed=4), small(tilt_deg=0)
    for name in rig.cameras:
        apart = se3.rotation_error_deg(rig.prior(name), rig.reference(name))
        assert 0.3 < apart <= 4.0  # camera and LiDAR are turned by 2 deg each
        assert 0.002 < np.linalg.norm(rig.prior(name)[:3, 3] - rig.reference(name)[:3, 3]) < 0.12
        assert not np.allclose(rig.reference(name), other.reference(name), atol=1e-3)
        np.testing.assert_allclose(straight.reference(name), rig.prior(name), atol=1e-9)


@pytest.mark.parametrize("knock", ["front_left", "front_left+front", "lidar_top"])
def test_a_knock_displaces_what_is_on_the_bracket_from_its_time_on(knock: str) -> None:
    rig = small(knock=knock, knock_at=1.5, knock_deg=2.0, knock_m=0.1)
    pair = rig.pair("front_left", "lidar_top")
    before, after = pair[0].reference, pair[2].reference
    assert before is not None
    assert after is not None
    np.testing.assert_array_equal(before, pair.reference)
    assert se3.rotation_error_deg(before, after) == pytest.approx(2.0, abs=1e-6)
    assert agreement(rig, "front_left", "lidar_top", 2) > agreement(rig, "front_left", "lidar_top", 2, before) + 0.01
    # Within a bracket nothing moves.
    moves = se3.inverse(rig.reference_at("front_left", pair[2].stamp)) @ rig.reference_at("front", pair[2].stamp)
    still = np.allclose(moves, se3.inverse(rig.reference("front_left")) @ rig.reference("front"), atol=1e-9)
    assert still == (knock != "front_left")
    if knock != "lidar_top":
        untouched = rig.pair("back", "lidar_top")
        np.testing.assert_array_equal(untouched[0].reference, untouched[2].reference)
        seen = small().pair("back", "lidar_top")
        np.testing.assert_array_equal(untouched[2].image, seen[2].image)


def test_a_pair_is_an_ordinary_source() -> None:
    text = f"synthetic:seed=5,frames=2,width=96,rig={SIX}"
    pair = open_dataset(text, camera="back_left")
    assert isinstance(pair, RigPair)
    assert pair.name == f"{text},camera=back_left,lidar=lidar_top"
    np.testing.assert_array_equal(open_drive(pair.name)[1].image, pair[1].image)
    np.testing.assert_array_equal(open_dataset(text, camera=3)[-1].image, pair[1].image)
    assert (pair.camera_frame, pair.lidar_frame) == ("back_left_optical", "lidar_top")
    assert "back_left (chosen)" in pair.describe()["cameras"]
    assert open_drive("synthetic:rig=os1_64_robot", 2).camera_frame == "camera"  # the only one
    with pytest.raises(IndexError):
        pair[2]
