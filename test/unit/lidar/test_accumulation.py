"""Scans of a scanner that does not repeat its pattern, put together over a while."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from calib_ros import Calibrator, se3
from calib_ros.cli.calibrate import replay
from calib_ros.config import Config, MotionConfig, update
from calib_ros.datasets import open_dataset
from calib_ros.datasets.source import WithMotion
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.lidar.accumulation import Accumulator
from calib_ros.lidar.deskew import moved
from calib_ros.online.keyframes import EgoMotion
from calib_ros.registration.features import FeatureExtractor
from calib_ros_synthetic.drive import SyntheticDrive

MOTION, SECONDS, NEWEST = MotionConfig(), 0.5, 7


@pytest.fixture(scope="module")
def drive() -> SyntheticDrive:
    return open_dataset("synthetic:rig=mid360_90,seed=4,width=320,frames=8,stride=1")


@pytest.fixture(scope="module")
def frames(drive) -> list[Frame]:
    return [drive[k] for k in range(len(drive))]


def earlier(frames: list[Frame], newest: int) -> list[tuple[int, object]]:
    return [(frame.cloud_stamp, frame.cloud) for frame in frames[newest - 1 :: -1]]


@pytest.fixture(scope="module")
def merged(frames) -> Frame:
    return Accumulator()(frames[NEWEST], earlier(frames, NEWEST), SECONDS, MOTION)


def test_scans_of_the_time_asked_for_are_put_together(frames, merged):
    own, cloud = frames[NEWEST].cloud, merged.cloud
    assert len(cloud) == sum(len(frame.cloud) for frame in frames[NEWEST - 4 : NEWEST + 1])
    assert np.array_equal(cloud.xyz[: len(own)], own.xyz)
    assert np.array_equal(cloud.time[: len(own)], own.time)
    assert not cloud.time[len(own) :].any()
    assert cloud.ring is None
    assert len(cloud.intensity) == len(cloud)


def test_earlier_points_are_where_they_would_have_been_measured(drive, frames, merged):
    """As the drive's own velocity moves them, to a centimetre or two where the vehicle has gone on by more."""
    T, expected = np.eye(4), []
    for k in range(NEWEST - 1, NEWEST - 5, -1):
        gap = (frames[k + 1].cloud_stamp - frames[k].cloud_stamp) / NANOSECONDS
        twist = (drive[k].twist + drive[k + 1].twist) / 2
        T = T @ se3.inverse(se3.exp(twist * gap))
        expected.append(se3.transform(T, moved(frames[k].cloud.xyz, drive[k].twist, frames[k].cloud.time)))
    expected = np.concatenate(expected)
    found = merged.cloud.xyz[len(frames[NEWEST].cloud) :]
    near = np.linalg.norm(found, axis=1) < 15
    off = np.linalg.norm(found - expected, axis=1)[near]
    gone = np.linalg.norm(drive[NEWEST].twist[3:]) * 0.4
    assert gone > 0.3
    assert np.median(off) < 0.02
    assert np.percentile(off, 99) < 0.06


def test_what_is_seen_grows_with_the_time(drive, frames, merged):
    calibrator = Calibrator(drive.camera, update(Config(), {"semantics": {"image_classes": "", "cloud_classes": ""}}))
    alone, together = (calibrator.extract(frame).points for frame in (replace(frames[NEWEST], twist=drive[NEWEST].twist), merged))
    assert len(together) > 2.5 * len(alone)
    # Edges of the sparse scan are among those of the dense one.
    distance, _ = cKDTree(together.xyz).query(alone.xyz)
    assert np.median(distance) < 0.25


def test_scans_before_a_gap_or_a_leap_of_time_are_left_out(frames):
    stamp = frames[NEWEST].cloud_stamp
    newest = earlier(frames, NEWEST)
    gap = [newest[0], *((at - NANOSECONDS // 2, cloud) for at, cloud in newest[1:])]
    back = [newest[0], *((at + NANOSECONDS, cloud) for at, cloud in newest[1:])]
    for scans in (gap, back):
        assert len(Accumulator()(frames[NEWEST], scans, 2.0, MOTION).cloud) == sum(
            len(cloud) for cloud in (newest[0][1], frames[NEWEST].cloud)
        )
    for own, scans, seconds in (
        (frames[NEWEST], newest, 0.0),
        (frames[NEWEST], [], 1.0),
        (replace(frames[NEWEST], cloud_stamp=None), newest, 1.0),
        (frames[NEWEST], [(stamp, frames[NEWEST].cloud)], 1.0),
    ):
        assert Accumulator()(own, scans, seconds, MOTION) is own


def test_compensated_scans_have_no_times(frames):
    still = [replace(f, compensated=True, cloud=replace(f.cloud, time=None)) for f in frames]
    joined = Accumulator()(still[NEWEST], earlier(still, NEWEST), SECONDS, MOTION)
    assert len(joined.cloud) == sum(len(frame.cloud) for frame in frames[NEWEST - 4 : NEWEST + 1])
    assert joined.cloud.time is None


def test_online_and_offline_give_the_same(drive, frames, merged):
    offline = WithMotion(drive, MOTION, accumulate_s=SECONDS)[NEWEST]
    online = EgoMotion(MOTION, SECONDS)
    for frame in frames:
        online.add(frame)
    for cloud in (offline.cloud, online.accumulated(frames[NEWEST]).cloud):
        assert len(cloud) == len(merged.cloud)
        assert np.median(np.linalg.norm(cloud.xyz - merged.cloud.xyz, axis=1)) < 0.02
    online.add(frames[0])  # time went back
    assert online.accumulated(frames[0]) is frames[0]


@pytest.mark.parametrize("chosen", ["3:8", "3:8:2"])
def test_a_replay_puts_each_scan_in_once_whether_or_not_frames_are_skipped(drive, frames, chosen, monkeypatch):
    sizes, extract = [], FeatureExtractor.__call__

    def seen(self, frame, *args, **options):
        sizes.append((frame.stamp, len(frame.cloud)))
        return extract(self, frame, *args, **options)

    monkeypatch.setattr(FeatureExtractor, "__call__", seen)
    changed = {"semantics": {"image_classes": "", "cloud_classes": ""}, "lidar": {"accumulate_s": SECONDS}}
    list(replay(drive, chosen, "reference", 0.0, update(Config(), changed)))
    stamps = [frame.stamp for frame in frames]
    for stamp, size in sizes:
        k = stamps.index(stamp)
        first = 3 if chosen == "3:8" else 0  # of a whole drive only what was replayed is known
        assert size == sum(len(frame.cloud) for frame in frames[max(k - 4, first) : k + 1])
    assert len(sizes) > 0
