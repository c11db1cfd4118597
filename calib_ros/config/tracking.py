"""The constants of what guards the extrinsic over time."""

from __future__ import annotations

from dataclasses import dataclass

from calib_ros.config.options import Stage, option


@dataclass(frozen=True)
class TrackerConfig(Stage):
    """Which estimates are taken in, and how they are fused over time."""

    process_noise_deg: float = option(
        0.1,
        "process noise of the filter, rotation per axis, deg per square root of a minute (0.1 follows a drift of 0.5 deg per "
        "minute with a lag of 0.1 deg)",
        low=0.0,
        high=10.0,
        formerly="drift_deg",
    )
    process_noise_m: float = option(
        0.01,
        "process noise of the filter, translation per axis, m per square root of a minute",
        low=0.0,
        high=1.0,
        formerly="drift_m",
    )
    max_step_deg: float = option(
        1.0, "an estimate that turns the current extrinsic further than this is not taken in, deg", low=0.01, high=90.0
    )
    max_step_m: float = option(
        0.15, "an estimate that shifts the current extrinsic further than this is not taken in, m", low=0.001, high=10.0
    )
    gate: float = option(
        1e-4, "an estimate less probable than this, given the current extrinsic, is not taken in", low=0.0, high=0.5
    )
    max_sigma_deg: float = option(
        0.25,
        "status is insufficient while a rotation is known less well than this (standard deviation), deg",
        low=0.01,
        high=90.0,
    )
    max_sigma_m: float = option(
        0.05, "status is insufficient while a shift is known less well than this (standard deviation), m", low=0.001, high=10.0
    )


@dataclass(frozen=True)
class MonitorConfig(Stage):
    """The test at every keyframe whether the current extrinsic is still right, and whether the sensors see."""

    enabled: bool = option(True, "test the current extrinsic at every keyframe")
    false_alarm_rate: float = option(
        0.01,
        "share of the tests of a right extrinsic that find it suspect; more also finds more that is wrong",
        low=1e-6,
        high=0.5,
    )
    window: int = option(5, "newest keyframes that are tested together", low=1, high=50)
    confirm: int = option(3, "keyframes that must speak for a movement before it is called one", low=1, high=20)
    least_deg: float = option(0.15, "a smaller turn is no movement: the estimates follow it", low=0.0, high=10.0)
    least_m: float = option(0.04, "a smaller shift is no movement: the estimates follow it", low=0.0, high=1.0)
    blind_contrast: float = option(
        0.25, "an image with less than this share of the usual contrast shows nothing: a covered lens", low=0.0, high=0.9
    )
    blind_returns: float = option(
        0.2, "a scan with less than this share of the usual returns shows nothing: a covered scanner", low=0.0, high=0.9
    )
    frozen_images: int = option(
        5, "so many images in a row without a changed pixel, while the scans change, are frozen; 0 = never", low=0, high=1000
    )
