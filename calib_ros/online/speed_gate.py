"""Frames taken while the vehicle drives or turns too fast to be keyframes."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass

import numpy as np

from calib_ros.config import OnlineConfig
from calib_ros.frame import NANOSECONDS, Frame

MAX_AGE_S = 0.5  # a measurement farther than this from a frame's stamp says nothing about it


@dataclass(frozen=True)
class Measured:
    """What odometry or an IMU said last. stamp: ns. speed: m/s, turn_rate: deg/s, None = this source does not tell."""

    stamp: int
    speed: float | None
    turn_rate: float | None


class SpeedGate:
    """Judges each frame by the newest measurement if that is of its time, else by the twist that the frame carries.

    For several threads at once. config may be replaced at any time. refused: frames turned away so far. last_refusal: why the
    newest of them was, in words.
    """

    def __init__(self, config: OnlineConfig) -> None:
        self.config = config
        self.newest: Measured | None = None
        self.refused = 0
        self.last_refusal = ""
        self._lock = threading.Lock()

    def measured(self, stamp: int, speed: float | None, turn_rate: float | None) -> None:
        """A measurement: stamp in ns, m/s and deg/s; what is None or not finite is not known."""
        known = [None if value is None or not math.isfinite(value) else abs(value) for value in (speed, turn_rate)]
        self.newest = Measured(stamp, known[0], known[1])

    def allows(self, frame: Frame) -> bool:
        """True if the frame is slow enough for a keyframe, or nothing tells how fast it is."""
        speed, turn_rate = self.motion_at(frame)
        problem = ""
        if speed is not None and speed > self.config.max_speed:
            problem = f"{speed:.1f} m/s are above online.max_speed = {self.config.max_speed:g}"
        elif turn_rate is not None and turn_rate > self.config.max_turn_deg_s:
            problem = f"{turn_rate:.1f} deg/s are above online.max_turn_deg_s = {self.config.max_turn_deg_s:g}"
        if problem:
            with self._lock:
                self.refused += 1
                self.last_refusal = problem
        return not problem

    def motion_at(self, frame: Frame) -> tuple[float | None, float | None]:
        """Speed, m/s, and turn rate, deg/s, at a frame; None where nothing tells."""
        measured, speed, turn_rate = self.newest, None, None
        if measured is not None and abs(measured.stamp - frame.stamp) <= MAX_AGE_S * NANOSECONDS:
            speed, turn_rate = measured.speed, measured.turn_rate
        if frame.twist is not None:
            speed = float(np.linalg.norm(frame.twist[3:])) if speed is None else speed
            turn_rate = float(np.rad2deg(np.linalg.norm(frame.twist[:3]))) if turn_rate is None else turn_rate
        return speed, turn_rate
