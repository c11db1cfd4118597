"""Which frames become keyframes: histogram similarity, selection, speed; the buffer; normalised innovation."""

from __future__ import annotations

import dataclasses
from dataclasses import replace

import numpy as np
import pytest

from calib_ros import se3
from calib_ros.config import Config, OnlineConfig
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.lidar.ego_motion import Motion
from calib_ros.online.keyframes import KeyframeBuffer, KeyframeSelector, SpeedGate, similarity
from calib_ros.online.monitor import UNIT_ROTATION_DEG, UNIT_TRANSLATION_M, normalised_innovation
from calib_ros.online.recalibrator import Recalibrator
from calib_ros_synthetic.drive import SyntheticDrive

CONFIG = OnlineConfig(keyframe_spacing_s=0.0)


def flat(*shares: tuple[int, float], shape: tuple[int, int] = (80, 100)) -> np.ndarray:
    """Rows of these grey levels in these shares of the picture."""
    rows = np.concatenate([np.full(round(share * shape[0] / 2) * 2, level) for level, share in shares])
    return np.tile(rows[:, None], (1, shape[1])).astype(np.uint8)


def hist(*values: float) -> np.ndarray:
    out = np.zeros((1, 256), np.float32)
    out[0, : len(values)] = values
    return out


# --- eq. 3.15 -------------------------------------------------------------------------------------------------------------


ONE, HALVES = hist(1.0), hist(0.5, 0.5)


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        (ONE, ONE, 1.0),
        (ONE, hist(0.0, 1.0), 0.0),
        (HALVES, hist(0.5, 0.25, 0.25), 0.75 / 1.25),
        (hist(0.2, 0.3, 0.5), hist(0.5, 0.3, 0.2), (0.2 + 0.3 + 0.2) / (2 - 0.7)),
        # The mean of the channels; a grey and a colour picture have nothing in common.
        (np.r_[ONE, ONE, HALVES], np.r_[ONE, hist(0.0, 1.0), hist(0.5, 0.25, 0.25)], (1 + 0 + 0.6) / 3),
        (np.r_[ONE, ONE, HALVES], ONE, 0.0),
    ],
)
def test_similarity_is_the_overlap_over_the_union(first, second, expected):
    assert similarity(first, second) == similarity(second, first) == pytest.approx(expected, abs=1e-6)


# --- algorithm 6 ----------------------------------------------------------------------------------------------------------


def offer_all(selector: KeyframeSelector, pictures: list[np.ndarray], period_s: float = 0.1) -> list[bool]:
    return [selector.select(p, round(k * period_s * NANOSECONDS)) for k, p in enumerate(pictures)]


def brightening(step: float, n: int) -> list[np.ndarray]:
    """The share of bright pixels grows by `step` from picture to picture."""
    return [flat((50, 1 - k * step), (200, k * step)) for k in range(n)]


def test_pictures_that_differ_enough_are_keyframes_and_the_next_reference():
    # 5 % of the pixels change: similarity 0.95 / 1.05 = 0.905; against the reference before, less still.
    assert offer_all(KeyframeSelector(CONFIG), brightening(0.05, 6)) == [True] * 6
    selector = KeyframeSelector(replace(CONFIG, similarity_threshold=0.7))
    # Similarity to the first: 1, .905, .818, .739, .667 -> a keyframe; then again from there.
    assert offer_all(selector, brightening(0.05, 9)) == [True, False, False, False, True, False, False, False, True]
    assert selector.last_similarity == pytest.approx(0.8 / 1.2, abs=1e-6)


@pytest.mark.parametrize("threshold", [0.92, 1.0])
def test_nothing_above_the_static_similarity_is_a_keyframe(threshold):
    """Whatever the similarity threshold and the time."""
    still, nearly, changed = (flat((50, 1.0)) for _ in range(3))
    nearly[0, :8], changed[0, :20] = 200, 200  # 4 and 10 of the 2000 pixels that count: similarity 0.996 and 0.990
    selector = KeyframeSelector(replace(CONFIG, similarity_threshold=threshold))
    assert offer_all(selector, [still, nearly, changed], period_s=100) == [True, False, True]


@pytest.mark.parametrize(
    ("steps", "taken"),
    [
        ([(0, 0.0), (1, 0.99), (1, 1.0), (0, 1.99), (0, 2.0)], [True, False, True, False, True]),  # a second from the last one
        ([(0, 1e6), (1, 5.0), (0, 5.5), (1, 4.0)], [True, True, False, False]),  # the clock was set back; the last shows the same
    ],
)
def test_after_a_while_a_small_change_is_enough(steps, taken):
    """Pictures by their number, at these seconds: their similarity is 0.951, too alike, yet not the same."""
    selector, pictures = KeyframeSelector(CONFIG), brightening(0.025, 2)
    assert [selector.select(pictures[k], round(t * NANOSECONDS)) for k, t in steps] == taken


def test_keyframes_keep_their_distance_in_time():
    """However much changes: 10 pictures a second, and no two keyframes within 0.5 s of each other."""
    pictures = brightening(0.05, 12)
    selector = KeyframeSelector(replace(CONFIG, keyframe_spacing_s=0.5))
    assert offer_all(selector, pictures) == [k % 5 == 0 for k in range(12)]
    assert selector.select(pictures[5], 0)  # the clock was set back
    selector.reset()
    assert selector.select(pictures[5], 1)


# --- drift ----------------------------------------------------------------------------------------------------------------


def test_drift_counts_rotation_and_translation_in_their_units():
    T = se3.exp([0.1, -1.2, 0.9, 0.27, -0.05, 0.1])
    for turns, shifts in ((0, 0), (1, 0), (0, 2), (1, 2)):
        other = T.copy()
        other[:3, :3] = se3.exp([0, np.deg2rad(turns * UNIT_ROTATION_DEG), 0, 0, 0, 0])[:3, :3] @ T[:3, :3]
        other[2, 3] += shifts * UNIT_TRANSLATION_M
        assert normalised_innovation(T, other) == pytest.approx(turns + shifts, abs=1e-6)
        assert normalised_innovation(other, T) == normalised_innovation(T, other)


# --- the buffer -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("since", "count", "left"),
    [
        (5, 2, [0, 1, 2, 5, 6, 7]),
        (3, 3, [0, 1, 2, 3, 4]),
        (8, 5, [5, 6, 7]),
        # Those that began earlier than the buffer reaches: a clock that was off for longer than it takes to fill it.
        (11, 8, [5, 6, 7]),
        (30, 27, [5, 6, 7]),
        (30, 20, list(range(8))),
        (30, 30, []),
    ],
)
def test_keyframes_that_are_out_of_sync_leave_the_buffer(since, count, left):
    buffer = KeyframeBuffer(8)
    for k in range(8):
        buffer.add(k)
    buffer.remove(since, count)
    assert list(buffer.features) == left
    assert buffer.features.maxlen == 8


def test_keyframes_that_should_not_have_been_taken_leave_the_buffer_with_their_counts():
    buffer = KeyframeBuffer(5)
    for k in range(7):
        buffer.add(k)
        if k == 3:
            buffer.batch(list(buffer.features))
    buffer.unfused = 4
    generation = buffer.generation
    buffer.drop(lambda k: k > 100)
    assert (list(buffer.features), buffer.generation) == ([2, 3, 4, 5, 6], generation)
    buffer.drop(lambda k: k in (2, 5))
    assert (list(buffer.features), buffer.new, buffer.unfused) == ([3, 4, 6], 2, 3)
    assert buffer.generation == generation + 1
    assert buffer.features.maxlen == 5


@pytest.fixture
def gate() -> SpeedGate:
    return SpeedGate(OnlineConfig(max_turn_deg_s=20.0))


def moving(frame: Frame, speed: float, turn_deg: float) -> Frame:
    return dataclasses.replace(frame, twist=np.array([0, 0, np.deg2rad(turn_deg), speed, 0, 0]))


@pytest.fixture
def still(street: list[Frame]) -> Frame:
    return dataclasses.replace(street[0], twist=None)


@pytest.mark.parametrize(
    ("speed", "turn", "figure"),
    [
        (0.0, 0.0, ""),
        (40.0, 20.0, ""),
        (40.1, 0.0, "40.1 m/s"),
        (-45.0, 0.0, "45.0 m/s"),
        (0.0, -21.0, "21.0 deg/s"),
        (None, 30.0, "30.0 deg/s"),
        (50.0, None, "50.0 m/s"),
        (None, None, ""),
        (float("nan"), float("inf"), ""),
    ],
)
def test_measurements(gate: SpeedGate, still: Frame, speed: float | None, turn: float | None, figure: str) -> None:
    """figure: what is above its limit; "" if nothing is."""
    gate.add_measurement(still.stamp, speed, turn)
    assert gate.allows(still) is (not figure)
    assert gate.rejected == bool(figure)
    assert gate.last_rejection.startswith(figure)


def test_stale_measurements_do_not_count(gate: SpeedGate, still: Frame) -> None:
    for age, allowed in ((0.0, False), (0.5, False), (-0.5, False), (0.51, True), (-0.51, True), (-3600.0, True)):
        gate.add_measurement(still.stamp - round(age * NANOSECONDS), 50.0, 0.0)
        assert gate.allows(still) is allowed, age


def test_a_frames_twist_counts_where_nothing_is_measured(gate: SpeedGate, still: Frame) -> None:
    fast, turning = moving(still, 50.0, 0.0), moving(still, 0.0, 45.0)

    def allowed() -> tuple[bool, bool]:
        return gate.allows(fast), gate.allows(turning)

    assert allowed() == (False, False)
    gate.add_measurement(still.stamp, 1.0, 1.0)  # measured: the twist of the frame is not asked
    assert allowed() == (True, True)
    gate.add_measurement(still.stamp, None, 1.0)  # an IMU knows the turn rate only
    assert allowed() == (False, True)
    gate.config = OnlineConfig(max_turn_deg_s=0.5)  # limits change at run time
    assert allowed() == (False, False)


def test_the_estimated_twist_counts_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no odometry tells, the motion estimated from scans does: the limit is below the drive's 3 m/s."""
    pytest.importorskip("small_gicp")
    drive = SyntheticDrive(seed=1, frames=4, rings=32, width=320, height=96, speed=3.0, stride=1)
    monkeypatch.setattr("calib_ros.online.keyframes.ROAD_SPEED", 2.0)
    options = {"online": {"keyframe_spacing_s": 0.0, "similarity_threshold": 1.0}}
    recalibrator = Recalibrator(drive.camera, drive.reference, Config.from_dict(options))
    taken = [recalibrator.ingest(dataclasses.replace(frame, twist=None)) for frame in (drive[i] for i in range(4))]
    assert isinstance(recalibrator.motion.last, Motion)
    assert recalibrator.motion.last.twist is not None, recalibrator.motion.last.reason
    assert np.linalg.norm(recalibrator.motion.last.twist[3:]) == pytest.approx(3.0, abs=0.4)
    assert taken == [True, False, False, False]  # before the first there is no scan to compare with
    assert recalibrator.speed_gate.rejected == 3
