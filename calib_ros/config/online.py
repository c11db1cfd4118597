"""Configuration of online operation: synchronisation, keyframes, estimates, tracking, monitoring."""

from __future__ import annotations

from dataclasses import dataclass

from calib_ros.config.options import Stage, option

MANUAL, PERIODIC, CONTINUOUS = "manual", "periodic", "continuous"  # modes


@dataclass(frozen=True)
class OnlineConfig(Stage):
    """Synchronisation, keyframes, and when to estimate."""

    pair_tolerance_s: float = option(
        0.0,
        "largest difference between the stamp of an image and the moment at which its scan swept the view of the camera, "
        "s; 0 = half the longer of the two periods and a tenth of it, at most 0.12 s; any other value is an upper limit "
        "to that",
        low=0.0,
        high=1.0,
    )
    similarity_threshold: float = option(
        0.92, "an image less similar to the last keyframe's than this becomes a keyframe (eq. 3.15)", low=0.0, high=1.0
    )
    keyframe_spacing_s: float = option(0.25, "smallest time between keyframes, s", low=0.0, high=60.0)
    buffer_size: int = option(20, "number of keyframes in the ring buffer", low=1, high=200)
    min_keyframes: int = option(5, "number of keyframes before the first estimate", low=1, high=200)
    mode: str = option(
        "continuous",
        "when to estimate: continuous = at new keyframes; periodic = every period_s if there are new keyframes; "
        "manual = only through the service",
        choices=("manual", "periodic", "continuous"),
    )
    period_s: float = option(60.0, "time between estimates in mode periodic, by the data's stamps, s", low=0.1, high=86400.0)
    rest_period_s: float = option(
        5.0,
        "shortest time between estimates in mode continuous while the extrinsic is converged and all newer keyframes fit it, by "
        "the data's stamps, s; it grows as long as that lasts, up to a minute; 0 = no rest",
        low=0.0,
        high=3600.0,
    )
    max_load: float = option(
        0.5,
        "CPU time that the node may use, as a share of one core: above it classes, estimates and keyframes wait, but not "
        "the service",
        low=0.05,
        high=1.0,
    )
    max_turn_deg_s: float = option(30.0, "no keyframes above this turn rate of the vehicle, deg/s", low=0.1, high=1000.0)


@dataclass(frozen=True)
class TrackerConfig(Stage):
    """Which estimates are accepted, and how they are fused over time."""

    confirmations: int = option(
        5,
        "keyframes after the first accepted estimate that must be consistent with it before the status is converged; "
        "without mode manual a later estimate must agree, too; 0 = none",
        low=0,
        high=100,
    )
    max_sigma_deg: float = option(
        0.25, "status insufficient while the standard deviation of a rotation is larger than this, deg", low=0.01, high=90.0
    )
    max_sigma_m: float = option(
        0.05, "status insufficient while the standard deviation of a translation is larger than this, m", low=0.001, high=10.0
    )


@dataclass(frozen=True)
class MonitorConfig(Stage):
    """The test at every keyframe whether the current extrinsic still holds and whether the sensors deliver usable data."""

    enabled: bool = option(True, "test the current extrinsic at every keyframe")
    false_alarms_per_hour: float = option(
        0.5,
        "at most so often per hour a correct extrinsic is called suspect, and moved a tenth as often; a higher rate notices "
        "smaller movements, and earlier",
        low=1e-4,
        high=1e4,
    )
