"""The constants of the vehicle's motion during a scan."""

from __future__ import annotations

from dataclasses import dataclass

from calib_ros.config.options import Stage, option


@dataclass(frozen=True)
class MotionConfig(Stage):
    """The vehicle's motion during a scan: edge points move to where they stand at the moment of the image."""

    deskew: str = option(
        "auto",
        "auto = points are moved whenever the LiDAR's velocity is known or can be estimated; off = never, "
        "for clouds that the driver or an odometry has compensated already",
        choices=("auto", "off"),
    )
    time_offset_s: float = option(
        0.0,
        "added to the time of every point relative to the image, s; positive = the points were measured later, or the image was "
        "exposed earlier, than the stamps say",
        low=-0.5,
        high=0.5,
    )
    scan_period_s: float = option(
        0.1, "one turn of the scanner, s; this and the next three are for clouds without times per point", low=0.005, high=1.0
    )
    spin: str = option(
        "clockwise",
        "how the scanner turns, seen from above; none = all points are measured at the cloud's stamp",
        choices=("clockwise", "counterclockwise", "none"),
    )
    stamp_azimuth_deg: float = option(
        0.0,
        "azimuth that the scanner faces at the cloud's stamp, counter-clockwise from the LiDAR's +x, deg",
        low=-180.0,
        high=180.0,
    )
    stamp_at: str = option(
        "middle",
        "part of the scan that the cloud's stamp belongs to; middle with azimuth 0 = stamped when facing forward, as KITTI",
        choices=("start", "middle", "end"),
    )
    from_scans: str = option(
        "timed",
        "clouds whose velocity no odometry gives: estimate it from the cloud before, timed = if points have times, "
        "always = also by azimuth (set the four above to your driver first), never; needs small_gicp",
        choices=("timed", "always", "never"),
    )
    max_gap_s: float = option(0.35, "scans farther apart than this tell no velocity, s", low=0.01, high=2.0)
    voxel_m: float = option(0.8, "scans are thinned to one point per cube of this size to be aligned, m", low=0.05, high=5.0)
    max_speed: float = option(60.0, "an estimated velocity above this is taken for wrong, m/s", low=0.1, high=200.0)
    max_turn_rate: float = option(2.0, "an estimated turn rate above this is taken for wrong, rad/s", low=0.01, high=20.0)
    min_matched: float = option(
        0.65,
        "aligned scans with a smaller share of matched points are taken for wrong "
        "(the same street 0.73 to 0.98, other places up to 0.59)",
        low=0.05,
        high=1.0,
    )
