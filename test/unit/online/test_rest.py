"""Once the extrinsic is steady, keyframes are tested as before and estimates are made seldom, until a keyframe disagrees."""

from __future__ import annotations

import dataclasses
from itertools import pairwise

import numpy as np
import pytest
from driven import Driven, config

from calib_ros import se3
from calib_ros.config import Config, update
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.online import pacing
from calib_ros.online.monitor import CONFIRM
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.online.tracker import Confirmations
from calib_ros.result import BLINDED, CONVERGED, MOVED, SUSPECT
from calib_ros_synthetic.drive import SyntheticDrive

GAP_S = 1.0  # between frames
CONFIG = Config.from_dict(
    {
        "search": {"rotation_deg": 0.0, "translation_m": 0.0},
        "semantics": {"segmentation": "none"},
        "motion": {"max_time_offset_s": 0.0},  # always the same street at the same speed, which says nothing of the clocks
        "online": {"min_keyframes": 3, "buffer_size": 6, "similarity_threshold": 1.0},
    }
)


class Parade:
    """The frames of a drive over and over again, as seen by a camera that may be turned a little.
    estimates: data times, s, at which one was made. keyframes: the same of keyframes."""

    def __init__(self, frames: list[Frame], start: np.ndarray, **changes: object) -> None:
        self.frames = frames
        self.recalibrator = Recalibrator(frames[0].camera, start, update(CONFIG, changes))
        self.estimates: list[float] = []
        self.keyframes: list[float] = []
        self.n: float = 0  # frames, each GAP_S later
        self.permitted = True  # by the load

    def __call__(self, seconds: float, turned_deg: float = 0.0, drift_deg_s: float = 0.0) -> None:
        for _ in range(round(seconds / GAP_S)):
            turned_deg += drift_deg_s * GAP_S
            self.show(turned(self.frames[int(self.n) % len(self.frames)], turned_deg))

    def settle(self) -> None:
        """Until the last keyframes led to no estimate."""
        while self.keyframes[-3] < self.estimates[-1]:
            self(1)
            assert self.n < 60

    def stand(self, seconds: float, turned_deg: float) -> list[str]:
        """The status after each of ten frames a second of one place."""
        found = []
        for _ in range(round(seconds / 0.1)):
            self.n += 0.1 - 1
            self.show(turned(self.frames[0], turned_deg))
            found.append(self.recalibrator.current.result.status)
        return found

    def show(self, frame: Frame) -> None:
        now = self.n * GAP_S
        self.n += 1
        stamp = round((1000 + now) * NANOSECONDS)
        frame = dataclasses.replace(frame, stamp=stamp, cloud_stamp=stamp, compensated=True)
        if self.recalibrator.ingest(frame, permit=lambda: self.permitted):
            self.keyframes.append(now)
        if self.recalibrator.ready():
            self.recalibrator.estimate()
            self.estimates.append(now)


def turned(frame: Frame, deg: float) -> Frame:
    """The scan as it would be if the camera were turned about its y axis, so that `turned_mount` is right."""
    M = se3.inverse(turned_mount(frame.reference, deg)) @ frame.reference
    xyz = (frame.cloud.xyz @ M[:3, :3].T + M[:3, 3]).astype(np.float32)
    return dataclasses.replace(frame, cloud=dataclasses.replace(frame.cloud, xyz=xyz))


def turned_mount(T: np.ndarray, deg: float) -> np.ndarray:
    return se3.exp(np.deg2rad([0, deg, 0, 0, 0, 0])) @ T


def gaps(times: list[float]) -> list[float]:
    return [b - a for a, b in pairwise(times)]


@pytest.fixture(autouse=True)
def without_spacing(monkeypatch: pytest.MonkeyPatch) -> None:
    """At rest as many keyframes as else, unless the test says otherwise."""
    monkeypatch.setattr(pacing, "REST_SPACING_S", (0.0, 0.0))


@pytest.fixture
def start(drive: SyntheticDrive) -> np.ndarray:
    return se3.perturb(drive.reference, [0.2, 0, 0], [0.01, 0, 0])


@pytest.mark.parametrize(
    "changes",
    [{"online": {"rest_period_s": 0.0}}, {"online": {"rest_period_s": 100.0}, "monitor": {"enabled": False}}],
    ids=["no rest", "no monitor"],
)
def test_where_nothing_tells_that_keyframes_fit_each_leads_to_an_estimate(
    street: list[Frame], start: np.ndarray, changes: dict[str, object]
) -> None:
    parade = Parade(street, start, **changes)
    parade(8)
    assert parade.estimates == parade.keyframes[2:]


def test_a_steady_extrinsic_is_estimated_seldom_and_the_same_recording_gives_the_same(
    street: list[Frame], start: np.ndarray
) -> None:
    parade, again = (Parade(street, start, online={"rest_period_s": 5.0}) for _ in range(2))
    for own in (parade, again):
        own(12)
    assert parade.estimates == again.estimates
    np.testing.assert_array_equal(*(own.recalibrator.current.result.T_camera_lidar for own in (parade, again)))
    parade(18)
    assert len(parade.keyframes) == 30  # each of them is tested
    assert parade.recalibrator.current.result.status == CONVERGED
    assert 6 <= len(parade.estimates) <= 10  # 5 of them until it is steady
    assert max(gaps(parade.estimates[:7])) == 5.0
    steady = [gap for gap in gaps(parade.estimates) if gap > 5.0]
    assert steady
    assert steady == sorted(steady)  # as long as it has been steady


def test_at_rest_keyframes_are_taken_seldom_until_one_does_not_fit(
    street: list[Frame], start: np.ndarray, drive: SyntheticDrive, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pacing, "REST_SPACING_S", (3.0, 3.0))
    parade = Parade(street, start)
    parade(18)
    seen, now, between = len(parade.keyframes), parade.n * GAP_S, gaps(parade.keyframes)
    steady = between.index(3.0)
    assert set(between[:steady]) == {1.0}
    assert set(between[steady:]) == {3.0}
    assert parade.recalibrator.at_rest
    parade(11, turned_deg=1.5)
    after = parade.keyframes[seen:]
    assert after[0] - now <= 3.0
    assert gaps(after[:6]) == [1.0] * 5  # the displaced mount is not waited for
    T = parade.recalibrator.current.result.T_camera_lidar
    assert se3.rotation_error_deg(turned_mount(drive.reference, 1.5), T) < 0.2


def test_what_only_lacks_frames_of_another_speed_is_estimated_seldom_until_one_comes(
    street: list[Frame], start: np.ndarray
) -> None:
    ahead = np.array([8.0, 0.0, 0.0])
    alike = [dataclasses.replace(frame, twist=np.r_[0.0, 0.0, 0.0, ahead]) for frame in street]
    clocks = {"motion": {"max_time_offset_s": 0.05}, "tracker": {"confirmations": 3}}
    parade = Parade(alike, start, online={"rest_period_s": 4.0}, **clocks)
    parade(30)
    tracker = parade.recalibrator.tracker
    assert tracker.missing == Confirmations(clocks=1)
    assert set(gaps(parade.estimates)[-4:]) == {4.0}
    assert len(parade.keyframes) == 30  # each of them may be the one
    made = len(parade.estimates)
    while parade.n * GAP_S - parade.estimates[-1] > GAP_S:
        parade(1)
    slower = dataclasses.replace(alike[int(parade.n) % len(alike)], twist=np.r_[0.0, 0.0, 0.0, ahead / 2])
    parade.show(slower)
    assert len(parade.estimates) > made
    assert parade.estimates[-1] == parade.keyframes[-1]


@pytest.fixture
def resting(street: list[Frame], start: np.ndarray) -> Parade:
    """At rest, and for 100 s."""
    parade = Parade(street, start, online={"rest_period_s": 100.0})
    parade(15)
    parade.settle()
    return parade


def test_a_keyframe_that_fits_a_little_worse_ends_the_rest(resting: Parade) -> None:
    """0.14 deg are no movement (LEAST_DEG): the estimates are to follow."""
    made = len(resting.estimates)
    resting(6, turned_deg=0.14)
    tracker = resting.recalibrator.tracker
    assert tracker.current.result.status == CONVERGED
    assert len(resting.estimates) > made
    assert resting.estimates[made] - resting.keyframes[-6] <= 2 * GAP_S


def test_a_refused_estimate_and_a_displaced_mount_end_the_rest(resting: Parade, drive: SyntheticDrive) -> None:
    """The displaced mount is estimated at every keyframe until it is confirmed."""
    recalibrator, made = resting.recalibrator, len(resting.estimates)
    recalibrator.tracker.update(dataclasses.replace(recalibrator.current.result, status="refused", reason="nothing fits"))
    resting(1)
    assert len(resting.estimates) == made + 1
    resting.settle()

    made, now = len(resting.estimates), resting.n * GAP_S
    resting(12, turned_deg=1.5)
    after = resting.estimates[made:]
    assert CONFIRM * GAP_S - GAP_S <= after[0] - now <= (CONFIRM + 3) * GAP_S  # the monitor decides first
    assert gaps(after[:5]) == [GAP_S] * 4
    T = recalibrator.current.result.T_camera_lidar
    assert se3.rotation_error_deg(turned_mount(drive.reference, 1.5), T) < 0.2


@pytest.fixture
def standing(street: list[Frame], start: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> Parade:
    """At rest, in front of a picture that stays the same, so that there is no keyframe; looks at the frames go on."""
    monkeypatch.setattr("calib_ros.online.sensor_health.FROZEN_IMAGES", 1000)
    parade = Parade(street, start)
    parade(8)
    parade.settle()
    return parade


def test_a_knock_of_a_scanner_at_rest_shows_within_a_second(standing: Parade) -> None:
    assert set(standing.stand(8, 0.0)) == {CONVERGED}  # ten looks tell what is usual
    keyframes = len(standing.keyframes)
    after = standing.stand(3, 1.5)
    assert SUSPECT in after[:10]
    assert MOVED in after
    assert len(standing.keyframes) <= keyframes + 1


def test_a_look_that_struck_is_followed_by_a_test_once_the_load_allows_for_it(standing: Parade) -> None:
    standing.stand(8, 0.0)
    standing.permitted = False
    assert standing.stand(3, 1.5)[-1] == CONVERGED
    standing.permitted = True
    assert standing.stand(0.5, 1.5)[-1] == SUSPECT


def test_at_rest_pairs_between_two_looks_are_not_even_decoded_unless_something_is_in_doubt(
    street: list[Frame], drive: SyntheticDrive
) -> None:
    settings = update(config(rest_period_s=100.0, min_keyframes=3, buffer_size=6), {"motion": {"max_time_offset_s": 0.0}})
    with Driven(drive, settings) as driven:
        pipeline, stamp = driven.pipeline, street[0].stamp

        def feed(frame: Frame, after_s: float) -> int:
            """How many pairs were left out."""
            nonlocal stamp
            stamp, before = stamp + round(after_s * NANOSECONDS), pipeline.rested_pairs
            driven.feed(dataclasses.replace(frame, stamp=stamp, cloud_stamp=stamp, compensated=True))
            return pipeline.rested_pairs - before

        for k in range(15):
            assert feed(street[k % len(street)], GAP_S) == 0
        assert pipeline.recalibrator.at_rest
        assert sum(feed(street[14 % len(street)], 0.1) for _ in range(12)) == 10  # a look in 0.6 s
        covered = dataclasses.replace(street[0], image=np.zeros_like(street[0].image))
        while feed(covered, 0.1):
            pass
        assert [feed(covered, 0.1) for _ in range(5)] == [0] * 5
        assert pipeline.recalibrator.current.result.status == BLINDED
