"""Configuration of what is done with the raw data: image, scan, and the vehicle's motion during a scan."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from calib_ros.config.options import Stage, option
from calib_ros.errors import ConfigError

ESTIMATE = "estimate"  # of motion.time_offset
GIVEN, REFINE = "given", "refine"  # of camera.intrinsics
MAX_OFFSET_S = 0.5  # to either side of motion.time_offset_s, in which offsets are searched
CENTRE_PER_FOCAL = 0.6  # uncertainty of the principal point, a share of the width, by that of the focal length, a share of it
FARTHEST_OFFSET_S = 60.0  # of motion.time_offset_s: messages wait no longer, and other epochs are found


@dataclass(frozen=True)
class ImageConfig(Stage):
    """Image preparation and edge maps (thesis 3.2, 3.4.1)."""

    max_width: int = option(1280, "wider images are shrunk to this width for the registration, px", low=160, high=8192)
    projection: str = option(
        "auto",
        "what images are rectified to: pinhole, sphere (the radius is the angle from the axis, up to 140 deg), or auto ="
        " sphere for lenses of more than 125 deg",
        choices=("auto", "pinhole", "sphere"),
    )
    mask: str = option(
        "",
        "picture (PNG) of the size of the recorded image, black where pixels are not to be used, for instance on the "
        "vehicle's own bonnet; empty = none",
    )
    ignored_boxes: tuple[float, ...] = option(
        (0.0,) * 4,
        "boxes of the recorded image that are not to be used, left, top, right, bottom of each, as shares of the width "
        "and height; zeros = none",
        low=0.0,
        high=1.0,
    )

    def check_with(self, config: Any) -> None:
        """ConfigError for boxes that are not four numbers each, or have no area."""
        if len(self.ignored_boxes) % 4:
            raise ConfigError(
                f"image.ignored_boxes has {len(self.ignored_boxes)} numbers; give left, top, right, bottom for each box"
            )
        for k in range(0, len(self.ignored_boxes), 4):
            left, top, right, bottom = box = self.ignored_boxes[k : k + 4]
            if any(box) and not (left < right and top < bottom):
                raise ConfigError(
                    f"image.ignored_boxes: box {list(box)} is empty; give left, top, right, bottom with left < right and "
                    "top < bottom"
                )


@dataclass(frozen=True)
class CameraConfig(Stage):
    """How well the intrinsics are known, and whether they are estimated."""

    intrinsics: str = option(
        GIVEN,
        "given = focal length, principal point and distortion are as stated; refine = they are corrected together with the "
        "extrinsic, and a file can be written; the node goes on with the stated ones and tells the others",
        choices=(GIVEN, REFINE),
    )
    # Calibrations of one camera on different days, as KITTI's, differ by 0.4 %.
    focal_sigma: float = option(
        0.005,
        "standard deviation of the focal length, as a share of it; that of the principal point, as a share of the image width, "
        "is 0.6 of it; 0 = exact: the lens is not judged",
        low=0.0,
        high=0.1,
    )

    @property
    def centre_sigma(self) -> float:
        """Standard deviation of the principal point, each way, as a share of the image width: boards tell it to 3 px of 1000."""
        return CENTRE_PER_FOCAL * self.focal_sigma


@dataclass(frozen=True)
class LidarConfig(Stage):
    """Edge points of a scan, detected in its own range image."""

    layout: str = option(
        "auto",
        "scan layout: rings (spinning scanners), projection (solid-state and non-repetitive scanners), or auto = detected"
        " from the points",
        choices=("auto", "rings", "projection"),
    )
    accumulate_s: float = option(
        0.0,
        "time over which scans are put together, moved by the vehicle's motion, s: about 1 for scanners whose pattern does not "
        "repeat (Livox), of which one scan is too sparse; 0 = each scan alone",
        low=0.0,
        high=3.0,
    )
    scanner_pose: str = option(
        "auto",
        "pose of the scanner in the frame of its clouds: auto = that frame itself, unless the rings show another one; "
        "given = by the next two",
        choices=("auto", "given"),
    )
    scanner_position_m: tuple[float, ...] = option(
        (0.0,) * 3, "x, y, z of the scanner in the frame of its clouds, if given, m", low=-20.0, high=20.0, length=3
    )
    scanner_rpy_deg: tuple[float, ...] = option(
        (0.0,) * 3,
        "roll, pitch, yaw of the scanner in the frame of its clouds, if given, as in URDF, deg",
        low=-180.0,
        high=180.0,
        length=3,
    )
    min_range: float = option(1.0, "points closer than this (the vehicle itself) are dropped, m", low=0.0, high=20.0)
    ego_box: tuple[float, ...] = option(
        (0.0,) * 6,
        "x_min, x_max, y_min, y_max, z_min, z_max of the vehicle itself in the frame of the clouds, within which points "
        "make no edges, m; zeros = none",
        low=-100.0,
        high=100.0,
        length=6,
    )

    def check_with(self, config: Any) -> None:
        """ConfigError for a box of the vehicle without volume."""
        box = self.ego_box
        if any(box) and not all(low < high for low, high in zip(box[::2], box[1::2], strict=True)):
            raise ConfigError(
                f"lidar.ego_box = {list(box)} is empty; give x_min, x_max, y_min, y_max, z_min, z_max with each minimum below "
                "its maximum"
            )


@dataclass(frozen=True)
class MotionConfig(Stage):
    """The vehicle's motion during a scan: edge points are moved to where they are at the time of the image."""

    deskew: str = option(
        "auto",
        "auto = compensate the vehicle's motion whenever its velocity is known or can be estimated; off = never, for "
        "clouds that are already compensated",
        choices=("auto", "off"),
    )
    time_offset: str = option(
        ESTIMATE,
        "offset between the clocks of camera and LiDAR: estimate = together with the extrinsic; fixed = it is "
        "time_offset_s, and an estimate that clearly contradicts it is refused",
        choices=(ESTIMATE, "fixed"),
    )
    time_offset_s: float = option(
        0.0,
        "added to the time of every point relative to the image, s; positive = the points were measured later, or the "
        "image was exposed earlier, than the stamps say",
        low=-FARTHEST_OFFSET_S,
        high=FARTHEST_OFFSET_S,
    )
    time_offset_sigma_s: float = option(
        0.003,
        "standard deviation of the clocks' offset, and up to 3 ms of stamps that scatter, for a moving vehicle's covariance, "
        "s; 0 = exact",
        low=0.0,
        high=0.5,
    )
    max_time_offset_s: float = option(
        0.05,
        "largest offset of the clocks that may be there unnoticed: until frames of other speeds or turns show that there "
        "is none, an extrinsic is tentative, s; 0 = the clocks are known to agree",
        low=0.0,
        high=0.5,
    )
    readout_s: float = option(
        0.0,
        "rolling shutter: time from the exposure of an image's first row to that of its last, s; negative = from the "
        "bottom up; 0 = global shutter",
        low=-0.2,
        high=0.2,
    )
    stamping: str = option(
        "auto",
        "how the scanner turns and what its stamps refer to, for clouds without times per point: auto = found where the "
        "vehicle's velocity is known, beginning with the four below; stated = as they say",
        choices=("auto", "stated"),
    )
    scan_period_s: float = option(
        0.1, "duration of one revolution, of clouds without times per point, as the next three, s", low=0.005, high=1.0
    )
    spin: str = option(
        "clockwise",
        "direction of rotation seen from above; none = all points are measured at the cloud's stamp",
        choices=("clockwise", "counterclockwise", "none"),
    )
    stamp_azimuth_deg: float = option(
        0.0, "azimuth of the scanner at the cloud's stamp, counter-clockwise from the LiDAR's +x, deg", low=-180.0, high=180.0
    )
    stamp_at: str = option(
        "middle",
        "part of the scan that the cloud's stamp refers to; middle with azimuth 0 = stamped when facing forward, as in KITTI",
        choices=("start", "middle", "end"),
    )
    from_scans: str = option(
        "timed",
        "estimate the velocity from the previous cloud where there is no odometry: timed = if points have times, always ="
        " also by the four above, never; needs small_gicp",
        choices=("timed", "always", "never"),
    )
