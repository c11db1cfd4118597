"""A drive with events: the true extrinsic of each frame holds for its image and cloud."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from benchmarks import events_study as er
from benchmarks.events import (
    Covered,
    Drift,
    EmptyRoad,
    EventSource,
    LateCamera,
    LostClouds,
    MountDisplacement,
    drive_times,
    mount,
)
from benchmarks.events_recorded import ThereAndBack
from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.errors import BadInputError
from calib_ros.frame import Frame
from calib_ros.frame import SemanticClass as Label
from calib_ros.lidar.deskew import moved
from calib_ros_synthetic.drive import SyntheticDrive

SMALL: dict[str, Any] = {"rings": 16, "width": 160, "height": 96, "stride": 1}


class Plain:
    """Frames of a drive as a recording gives them: nothing can be rendered anew."""

    def __init__(self, drive: SyntheticDrive, stamps: list[int] | None = None) -> None:
        self.drive, self.stamps = drive, stamps
        self.name, self.camera, self.reference = "plain", drive.camera, drive.reference
        self.camera_frame, self.lidar_frame = "camera", "lidar"
        self._read: dict[int, Frame] = {}

    def __len__(self) -> int:
        return len(self.drive)

    def __getitem__(self, index: int) -> Frame:
        frame = self._read[index] = self._read.get(index) or self.drive[index]
        if self.stamps is None:
            return frame
        return replace(frame, stamp=self.stamps[index] + 4_000_000, cloud_stamp=self.stamps[index])

    def describe(self) -> dict[str, str]:
        return {}


def same(a: Frame, b: Frame) -> None:
    np.testing.assert_array_equal(a.image, b.image)
    np.testing.assert_array_equal(a.cloud.xyz, b.cloud.xyz)
    np.testing.assert_array_equal(a.reference, b.reference)
    assert (a.stamp, a.cloud_stamp) == (b.stamp, b.cloud_stamp)


def test_a_mount_drifts_and_jumps_and_stays() -> None:
    events = [MountDisplacement(6.0, deg=2.0, axis=(0, 0, 2), m=0.05, direction=(3, 0, 0)), Drift(1.0, 3.0, deg=-0.5)]
    np.testing.assert_array_equal(mount(events, 0.9), np.eye(4))
    for time, deg in ((2.0, -0.25), (3.0, -0.5), (5.9, -0.5)):
        np.testing.assert_allclose(se3.log(mount(events, time)), [0, np.deg2rad(deg), 0, 0, 0, 0], atol=1e-12)
    displacement = se3.exp([0, 0, np.deg2rad(2), 0.05, 0, 0])
    np.testing.assert_allclose(mount(events, 6.0), displacement @ mount(events, 5.9), atol=1e-12)
    np.testing.assert_array_equal(mount(events, 99.0), mount(events, 6.0))


def test_displaced_camera_sees_like_one_mounted_there() -> None:
    base = SyntheticDrive(3, frames=5, **SMALL)
    displacement = MountDisplacement(0.3)
    source = EventSource(base, [displacement])
    after = SyntheticDrive(3, frames=5, **SMALL, T_camera_lidar=se3.exp(displacement.xi(0.3)) @ base.reference)
    for i in range(5):
        expected = base[i] if i < 3 else after[i]
        frame = source[i]
        np.testing.assert_array_equal(frame.image, expected.image)
        np.testing.assert_array_equal(frame.cloud.xyz, expected.cloud.xyz)
        np.testing.assert_allclose(frame.reference, expected.reference, atol=1e-12)
    np.testing.assert_array_equal(source.reference, base.reference)
    assert se3.rotation_error_deg(base.reference, source[4].reference) == pytest.approx(2.0)


def test_a_late_camera_sees_the_street_of_before() -> None:
    base = SyntheticDrive(3, frames=6, **SMALL, noise=0)
    frame = EventSource(base, [LateCamera(0.3, 0.4, delay_s=0.1)])[3]
    np.testing.assert_array_equal(frame.image, base[2].image)  # 0.1 s before is where frame 2 was taken
    np.testing.assert_array_equal(frame.cloud.xyz, base[3].cloud.xyz)
    assert frame.stamp == base[3].stamp
    half = EventSource(base, [LateCamera(0.3, 0.4, delay_s=0.05)])[3]
    differences = [np.abs(half.image.astype(float) - base[i].image).mean() for i in (1, 2, 3, 4)]
    assert max(differences[1:3]) < min(differences[0], differences[3])
    standing = SyntheticDrive(3, frames=6, **SMALL, speed=0)
    np.testing.assert_array_equal(EventSource(standing, [LateCamera(0.3, 0.4)])[3].image, standing[3].image)


def test_a_covered_lens_shows_nothing() -> None:
    base = Plain(SyntheticDrive(3, frames=6, **SMALL))
    source = EventSource(base, [Covered(0.2, 0.5)])
    for i in (0, 1, 5):
        same(source[i], base[i])
    for i in (2, 3, 4):
        np.testing.assert_array_equal(source[i].cloud.xyz, base[i].cloud.xyz)
        assert source[i].stamp == base[i].stamp
    dark = source[3].image.astype(float)
    assert dark.mean() < 10
    assert 1 < dark.std() < 3
    assert not np.array_equal(dark, source[4].image)
    np.testing.assert_array_equal(EventSource(base.drive, [Covered(0.2, 0.5)])[3].image, source[3].image)


def test_lost_clouds_are_missing_frames() -> None:
    drive = SyntheticDrive(3, frames=120, **SMALL)
    source = EventSource(drive, [LostClouds(2.0, 12.0)])
    lost = np.setdiff1d(np.arange(120), source.positions)
    assert len(lost) == 20
    assert len(source) == len(source.times) == 100
    assert lost.min() >= 20
    np.testing.assert_allclose(np.diff(source.times).max(), 0.1 * np.diff(source.positions).max())
    i = int(np.searchsorted(source.positions, 50))
    assert source[i].stamp == drive[int(source.positions[i])].stamp
    np.testing.assert_array_equal(EventSource(drive, [LostClouds(2.0, 12.0)]).positions, source.positions)
    assert source[-1].stamp == drive[119].stamp
    with pytest.raises(IndexError):
        source[100]


def test_an_empty_road_has_nothing_in_sight_and_the_rest_of_the_street_stays() -> None:
    size = {**SMALL, "stride": 10}
    base = SyntheticDrive(3, frames=100, **size)
    source = EventSource(base, [EmptyRoad(60, 90)])
    emptied = source.source
    assert isinstance(emptied, SyntheticDrive)
    for i in (60, 75, 89):
        labels = emptied.labels(i)
        assert set(np.unique(labels.image).tolist()) == {Label.GROUND, Label.SKY}
        assert set(np.unique(base.labels(i).image).tolist()) > {Label.GROUND, Label.SKY}
    assert set(np.unique(emptied.labels(89).points).tolist()) == {Label.GROUND}
    same(source[20], base[20])  # too far away to be seen
    np.testing.assert_array_equal(emptied.reference, base.reference)
    with pytest.raises(BadInputError, match=r"empty=\(5, 5\)"):
        SyntheticDrive(3, empty=(5, 5))


def test_points_hit_the_same_grey_values_in_a_turned_image() -> None:
    K = np.array([[360.0, 0, 304], [0, 360, 87], [0, 0, 1]])
    camera = Camera(K, 620, 188, "plumb_bob", np.array([-0.2, 0.05, 1e-3, 0, 0]))
    drive = SyntheticDrive(2, 6, 32, speed=0, noise=0, camera=camera)
    displacement = MountDisplacement(0.5, deg=2.0, m=0.05)
    source = EventSource(Plain(drive), [displacement])
    before, after = drive[5], source[5]
    np.testing.assert_allclose(after.reference, se3.exp(displacement.xi(1)) @ drive.reference, atol=1e-12)
    uv, inside = (np.stack(v) for v in zip(*(
        f.camera.project(se3.transform(f.reference, f.cloud.xyz)) for f in (before, after)
    ), strict=True))  # fmt: skip
    # A border of 30 px: what had been out of sight is not known.
    seen = inside.all(axis=0) & (np.abs(uv - [310, 94]) < [280, 64]).all(axis=(0, 2))
    grey = [
        cv2.remap(f.image.mean(axis=2).astype(np.float32), *(uv[k][seen].astype(np.float32).T[:, :, None]), cv2.INTER_LINEAR)
        for k, f in enumerate((before, after))
    ]
    assert seen.sum() > 3000
    difference = np.abs(grey[0] - grey[1]).ravel()
    assert np.median(difference) < 1.0
    assert np.percentile(difference, 90) < 8
    wrong = after.camera.project(se3.transform(before.reference, after.cloud.xyz))[0][seen].astype(np.float32)
    missed = cv2.remap(after.image.mean(axis=2).astype(np.float32), *wrong.T[:, :, None], cv2.INTER_LINEAR)
    assert np.percentile(np.abs(grey[0] - missed), 90) > 20


def test_a_shifted_lidar_moves_as_the_car_carries_it() -> None:
    drive = SyntheticDrive(2, 8, 16, speed=10, noise=0, width=64, height=48)
    before, after = drive[7], EventSource(Plain(drive), [MountDisplacement(0.0, m=0.3)])[7]
    assert before.cloud.time is not None
    time = before.cloud.time
    assert before.twist is not None
    assert after.twist is not None
    straight = moved(before.cloud.xyz, before.twist, time)
    shifted = moved(after.cloud.xyz, after.twist, time)
    offset = shifted - straight
    np.testing.assert_allclose(offset, np.broadcast_to(offset[0], offset.shape), atol=1e-4)


def test_a_late_recorded_image_is_stamped_late_and_the_nearest_one() -> None:
    drive = SyntheticDrive(3, frames=5, **SMALL)
    stamps = [10**18 + round(t * 1e9) for t in (0, 0.1, 0.2, 0.3, 1.3)]
    base = Plain(drive, stamps)
    source = EventSource(base, [LateCamera(0.2, 9.0)])
    same(source[1], base[1])
    for i, shown in ((2, 1), (3, 2), (4, 4)):  # a second after the one before, no other image comes nearer
        frame = source[i]
        np.testing.assert_array_equal(frame.image, base[shown].image)
        np.testing.assert_array_equal(frame.cloud.xyz, base[i].cloud.xyz)
        assert frame.stamp == base[shown].stamp + 80_000_000
        assert frame.cloud_stamp == base[i].cloud_stamp


def test_there_and_back_goes_on_in_time() -> None:
    drive = SyntheticDrive(3, frames=4, **SMALL, speed=8)
    stamps = [10**18 + round(t * 1e9) for t in (0, 0.1, 0.2, 1.2)]
    base = Plain(drive, stamps)
    source = ThereAndBack(base, 5.0)
    np.testing.assert_allclose(source.times, [0, 0.1, 0.2, 1.2, 2.2, 2.3, 2.4, 2.5, 2.6, 3.6, 4.6, 4.7, 4.8, 4.9])
    np.testing.assert_array_equal(drive_times(source), source.times)
    frames = [source[i] for i in range(len(source))]
    assert [round((f.moment_of_cloud - 10**18) / 1e9, 6) for f in frames] == np.round(source.times, 6).tolist()
    assert [f.stamp - f.moment_of_cloud for f in frames[2:6]] == [4_000_000, 4_000_000, -4_000_000, -4_000_000]
    for i, shown in enumerate((0, 1, 2, 3, 2, 1, 0, 1, 2, 3, 2, 1, 0, 1)):
        np.testing.assert_array_equal(frames[i].image, base[shown].image)
    forwards, back = frames[2], frames[4]
    assert forwards.twist is not None
    assert back.twist is not None
    np.testing.assert_array_equal(back.twist, -forwards.twist)
    straight = [moved(f.cloud.xyz, f.twist, f.cloud.time) for f in (forwards, back)]
    np.testing.assert_allclose(*straight, atol=1e-9)
    assert len(ThereAndBack(base, 0.15)) == 2
    with pytest.raises(BadInputError, match="do not rise"):
        ThereAndBack(Plain(drive, [5, 5, 6, 7]), 1.0)


def test_alarms_recoveries_and_false_claims_are_counted() -> None:
    def moment(t: float) -> er.Moment:
        status, deg, news = "converged", 0.1, t % 1 == 0
        if 10 <= t < 17:
            status, deg = ("converged", 2.0) if t < 11.5 else ("moved", 2.0)
        if 18 <= t < 19:
            deg = 0.4  # not wrong, but not right yet
        six = np.zeros(6)
        return er.Moment(t, six, six, six, status, deg, 2.0, news, news)

    moments, displacement = [moment(k / 2) for k in range(60)], MountDisplacement(10.0)
    assert er.alarm(moments, displacement, 30.0) == "1.5 s, moved"
    assert er.recovery(moments, displacement) == "9.0 s"
    assert er.alarm(moments, Covered(15.0, 20.0), 30.0) == "was moved"
    assert er.alarm(moments, Covered(2.0, 4.0), 10.0) == "none"
    assert er.recovery(moments, Covered(40.0, 50.0)) == "-"
    said = er.verdict(moments, [displacement]).splitlines()
    assert said[0].startswith("publications: 30, converged 25, of these wrong 2; worst at 10.0 s")
    assert "converged 49, of these wrong 3" in said[1]
    assert "mount displacement at 10 s" in said[1]
    assert "| mount displacement at 10 s | 1.5 s, moved | 9.0 s | 2.00 deg, 2.0 cm |" in er.table(moments, [displacement])
