"""What is taken to be known before a first guess."""

from __future__ import annotations

from dataclasses import dataclass

from calib_ros.config.options import Stage, option


@dataclass(frozen=True)
class GuessConfig(Stage):
    """The first guess from classes (thesis 3.5). The LiDAR's z axis points up, give or take tilt_deg; its yaw is unknown."""

    tilt_deg: float = option(25.0, "largest angle between the camera's vertical and the LiDAR's, deg", low=1.0, high=60.0)
    distance_m: float = option(2.0, "largest distance of the camera from the LiDAR, m", low=0.1, high=10.0)
    candidates: int = option(5, "hypotheses told at most, best first", low=1, high=64)
