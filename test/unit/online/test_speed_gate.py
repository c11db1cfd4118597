"""Frames at too high a speed for a keyframe, by odometry, IMU or the frame's own twist."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from calib_ros.config import Config, OnlineConfig
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.lidar.ego_motion import Motion
from calib_ros.online.keyframes import SpeedGate
from calib_ros.online.recalibrator import Recalibrator
from calib_ros_synthetic.drive import SyntheticDrive


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
    monkeypatch.setattr("calib_ros.online.keyframes.MAX_SPEED", 2.0)
    options = {"online": {"keyframe_spacing_s": 0.0, "similarity_threshold": 1.0}}
    recalibrator = Recalibrator(drive.camera, drive.reference, Config.from_dict(options))
    taken = [recalibrator.ingest(dataclasses.replace(frame, twist=None)) for frame in (drive[i] for i in range(4))]
    assert isinstance(recalibrator.motion.last, Motion)
    assert recalibrator.motion.last.twist is not None, recalibrator.motion.last.reason
    assert np.linalg.norm(recalibrator.motion.last.twist[3:]) == pytest.approx(3.0, abs=0.4)
    assert taken == [True, False, False, False]  # before the first there is no scan to compare with
    assert recalibrator.speed_gate.rejected == 3
