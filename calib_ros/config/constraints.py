"""What a user knows of the extrinsic beforehand."""

from __future__ import annotations

from dataclasses import dataclass

from calib_ros.config.options import Stage, option

NO_LIMIT_DEG, NO_LIMIT_M = 180.0, 100.0  # limits of this size are none
_ANYWHERE_DEG, _ANYWHERE_M, _UNKNOWN = (NO_LIMIT_DEG,) * 3, (NO_LIMIT_M,) * 3, (0.0,) * 3


@dataclass(frozen=True)
class ConstraintsConfig(Stage):
    """What is known of the extrinsic beforehand, around the initial one, per axis x, y, z of the camera (optical axes)."""

    limit_deg: tuple[float, ...] = option(
        _ANYWHERE_DEG,
        "how far the camera may turn from the initial extrinsic about x, y, z, deg; 0 = fixed, 180 = free",
        low=0.0,
        high=NO_LIMIT_DEG,
        length=3,
    )
    limit_m: tuple[float, ...] = option(
        _ANYWHERE_M,
        "how far it may shift along x, y, z, m; 0 0 0 = rotation only, 100 = free",
        low=0.0,
        high=NO_LIMIT_M,
        length=3,
    )
    sigma_deg: tuple[float, ...] = option(
        _UNKNOWN,
        "standard deviation of the initial rotation about x, y, z, deg; 0 = not known",
        low=0.0,
        high=180.0,
        length=3,
    )
    sigma_m: tuple[float, ...] = option(
        _UNKNOWN,
        "standard deviation of the initial translation along x, y, z, m; 0 = not known",
        low=0.0,
        high=100.0,
        length=3,
    )
