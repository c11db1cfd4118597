"""How the vehicle of a synthetic drive moves, and what of a scan its stamp refers to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calib_ros import se3
from calib_ros_synthetic.solids import Floats
from calib_ros_synthetic.street import LIDAR_HEIGHT, Street

STEADY, WEAVING = RIDES = ("steady", "weaving")
SPINS = ("clockwise", "counterclockwise")
SWERVE, SWERVE_LENGTH = 0.8, 35.0  # m; at 5 m/s the vehicle turns at up to 7 deg/s
SPEED_CHANGE, SPEED_PERIOD_S = 0.5, 12.0  # of the mean speed, up and down
STAMP_AT = {"start": -0.5, "middle": 0.0, "end": 0.5}  # share of a revolution after the scanner has faced ahead


@dataclass(frozen=True)
class Ride:
    """The vehicle's way along a street: a lane offset in metres, and slow swaying in yaw, pitch, roll and height.

    speed: m/s on average. weaving: it accelerates and brakes, and swerves to either side, by heading where it goes.
    """

    seed: int
    speed: float
    weaving: bool = False

    def station(self, seconds: float) -> float:
        """m from the start."""
        if not self.weaving:
            return self.speed * seconds
        wave, phase = 2 * np.pi / SPEED_PERIOD_S, self._phase
        return float(self.speed * (seconds + SPEED_CHANGE * (np.sin(wave * seconds + phase) - np.sin(phase)) / wave))

    def speed_at(self, seconds: float) -> float:
        """m/s."""
        if not self.weaving:
            return self.speed
        return float(self.speed * (1 + SPEED_CHANGE * np.cos(2 * np.pi * seconds / SPEED_PERIOD_S + self._phase)))

    @property
    def _phase(self) -> float:
        return float(np.random.default_rng([self.seed, 12]).uniform(0, 2 * np.pi))

    def pose(self, street: Street, s: float) -> Floats:
        """T_world_lidar (4, 4) at station s."""
        rng = np.random.default_rng([self.seed, 2])
        phase = rng.uniform(0, 2 * np.pi, (5, 2))
        wave = 2 * np.pi / rng.uniform([[40, 17]] * 2 + [[13, 7]] * 3, [[70, 29]] * 2 + [[29, 11]] * 3)
        size = np.array([[0.25, 0.1], [1.5, 0.4], [0.5, 0.25], [0.7, 0.3], [0.012, 0.006]])  # m, deg, deg, deg, m
        lane, yaw, pitch, roll, bump = (np.sin(wave * s + phase) * size).sum(axis=1)
        if self.weaving:
            angle = 2 * np.pi * s / SWERVE_LENGTH + phase[0, 0]
            lane += SWERVE * np.sin(angle)
            yaw += np.rad2deg(np.arctan(SWERVE * np.cos(angle) * 2 * np.pi / SWERVE_LENGTH))
        x, y, heading = street.path.place(s, street.lane + lane)
        angles = [np.rad2deg(heading) + yaw, pitch, roll]
        R = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
        return se3.from_parts(R, [x, y, LIDAR_HEIGHT + bump])

    def twist(self, street: Street, s: float, speed: float) -> Floats:
        """(rx, ry, rz, tx, ty, tz) in rad/s and m/s in the LiDAR's own frame: T(t) = T(0) exp(twist t)."""
        h = 0.05  # m; short against the waves, long against rounding
        step = se3.log(se3.inverse(self.pose(street, s - h)) @ self.pose(street, s + h))
        return np.asarray(step * (speed / (2 * h)))
