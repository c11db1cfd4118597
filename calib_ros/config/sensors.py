"""Configuration of what is done with the raw data: image, scan, and the vehicle's motion during a scan."""

from __future__ import annotations

from dataclasses import dataclass

from calib_ros.config.options import Stage, option
from calib_ros.errors import ConfigError

ESTIMATE = "estimate"  # of motion.time_offset
MAX_OFFSET_S = 0.5  # of motion.time_offset_s


@dataclass(frozen=True)
class ImageConfig(Stage):
    """Image preparation and edge maps (thesis 3.2, 3.4.1)."""

    equalization: str = option(
        "clahe",
        "histogram equalisation: none, global (eq. 3.4), adaptive (local, no clip limit) or clahe (local, clip limit)",
        choices=("none", "global", "adaptive", "clahe"),
    )
    equalize_color: bool = option(False, "equalise the three colour channels before conversion to grey (figure 3.5)")
    clahe_clip: float = option(2.0, "clip limit of CLAHE", low=0.1, high=40.0)
    clahe_tiles: int = option(8, "tiles per axis of adaptive equalisation and CLAHE", low=1, high=64)
    filter: str = option(
        "bilateral",
        "noise filter: bilateral (eq. 3.5), gaussian (eq. 3.6, 3.7) or none",
        choices=("bilateral", "gaussian", "none"),
    )
    gaussian_sigma: float = option(1.0, "sigma of the Gaussian noise filter, px", low=0.1, high=20.0)
    bilateral_diameter: int = option(5, "diameter of the bilateral filter's neighbourhood, px", low=1, high=25)
    bilateral_color: float = option(40.0, "sigma of the bilateral filter in brightness, grey levels", low=1.0, high=255.0)
    bilateral_space: float = option(5.0, "sigma of the bilateral filter in space, px", low=0.5, high=50.0)
    max_width: int = option(
        1280,
        "wider images are shrunk to this width for the registration, px; finer pixels do not lower the error",
        low=160,
        high=8192,
    )
    projection: str = option(
        "auto",
        "what images are rectified to: pinhole (very wide lenses: their central field), cylinder (up to 100 deg to either side "
        "and 60 deg up and down), or auto = cylinder for lenses of more than 125 deg",
        choices=("auto", "pinhole", "cylinder"),
    )
    gradient_percentile: float = option(97.0, "gradient magnitude that counts as a full edge, percentile", low=50.0, high=100.0)
    mask: str = option(
        "",
        "picture (PNG) of the size of the recorded image in which pixels that are not to be used are black: the vehicle's own "
        "bonnet, mirrors, mounts; empty = none",
    )
    ignored_boxes: tuple[float, ...] = option(
        (0.0,) * 4,
        "boxes of the recorded image that are not to be used: left, top, right, bottom of each, one after the other, as shares "
        "of the width and height; zeros = none",
        low=0.0,
        high=1.0,
    )

    def check(self) -> None:
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
    """How well the intrinsics are known."""

    focal_sigma: float = option(
        0.003,
        "standard deviation of the focal length, as a share of it: 0.001 for good calibrations, 0.005 for ordinary ones; what "
        "the scenes leave of it is part of the covariance; 0 = exact",
        low=0.0,
        high=0.1,
    )


@dataclass(frozen=True)
class LidarConfig(Stage):
    """Edge points of a scan, detected in its own range image."""

    layout: str = option(
        "auto",
        "scan layout: rings (spinning scanners), projection (solid-state and non-repetitive scanners), or auto = detected from "
        "the points",
        choices=("auto", "rings", "projection"),
    )
    scanner_pose: str = option(
        "auto",
        "pose of the scanner in the frame of its clouds: auto = that frame itself, or found from the rings where they show that "
        "it is another one (clouds in the vehicle's frame, tilted scanners); given = by the next two",
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
        "x_min, x_max, y_min, y_max, z_min, z_max of the vehicle itself in the frame of the clouds, m: points inside make no "
        "edges, but still hide what is behind them; zeros = none",
        low=-100.0,
        high=100.0,
        length=6,
    )
    max_range: float = option(60.0, "edges farther than this are dropped, m", low=5.0, high=300.0)
    jump_min: float = option(
        0.3,
        "smallest range jump of an edge, m",
        low=0.02,
        high=5.0,
    )
    side_jump_ratio: float = option(0.02, "smallest left/right range jump relative to the range", low=0.0, high=0.5)
    top_jump_ratio: float = option(0.05, "smallest upward range jump relative to the range", low=0.0, high=0.5)
    jump_saturation: float = option(
        3.0, "range jump of full edge strength, m; strength is the square root of the ratio", low=0.1, high=50.0
    )
    reflectivity_step: float = option(
        0.12,
        "reflectivity step that makes an edge wherever it exceeds the noise, share of full scale; less does where it stands out "
        "of the scan's own noise",
        low=0.01,
        high=1.0,
    )
    reflectivity_max_range: float = option(40.0, "reflectivity edges farther than this are dropped, m", low=2.0, high=300.0)
    reflectivity_max_jump: float = option(
        0.2, "range step above which a reflectivity step counts as a range edge, m", low=0.01, high=2.0
    )
    outward_shift: float = option(
        0.5,
        "share of the angular step by which edge points move outward: the last return lies inside the object",
        low=0.0,
        high=1.0,
    )
    top_spread: float = option(
        1.0,
        "share of the step to the next ring over which upward edges are spread around their shifted position, so that no single "
        "height biases the estimate",
        low=0.0,
        high=1.0,
    )
    gap_steps: int = option(6, "number of empty columns that makes an edge against the sky", low=1, high=50)
    hole_jump: float = option(
        0.5, "a single lost return is filled in if its neighbours differ by less than this, m", low=0.0, high=5.0
    )

    def check(self) -> None:
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
        "auto = compensate whenever the LiDAR's velocity is known or can be estimated; off = never, for clouds that the driver "
        "or an odometry has already compensated",
        choices=("auto", "off"),
    )
    time_offset: str = option(
        ESTIMATE,
        "offset between the clocks of camera and LiDAR: estimate = together with the extrinsic, where frames of different speeds "
        "or turns show it; fixed = it is time_offset_s, and what clearly contradicts that is refused",
        choices=(ESTIMATE, "fixed"),
    )
    time_offset_s: float = option(
        0.0,
        "added to the time of every point relative to the image, s; positive = the points were measured later, or the image was "
        "exposed earlier, than the stamps say",
        low=-MAX_OFFSET_S,
        high=MAX_OFFSET_S,
    )
    time_offset_sigma_s: float = option(
        0.003,
        "standard deviation of the clocks' offset, s: what the scenes leave of it is part of a moving vehicle's covariance; 0 = "
        "exact",
        low=0.0,
        high=0.5,
    )
    max_time_offset_s: float = option(
        0.05,
        "offset of the clocks that nobody would notice, s (half a scan at 10 Hz): the node calls an extrinsic tentative until "
        "frames of other speeds or turns show that there is none; 0 = the clocks are known to agree",
        low=0.0,
        high=0.5,
    )
    readout_s: float = option(
        0.0,
        "rolling shutter: time from the exposure of an image's first row to that of its last, s, as the driver or the sensor's "
        "data sheet gives it; negative = from the bottom up; 0 = global shutter",
        low=-0.2,
        high=0.2,
    )
    exposure_s: float = option(
        0.0,
        "exposure time of cameras whose images are stamped when the exposure of the first row begins, s: the moment of the image "
        "is half of it, and of readout_s, later; 0 = stamped at the middle",
        low=0.0,
        high=0.2,
    )
    check_times: bool = option(
        True,
        "where time_offset is fixed: refuse the result of a search whose scenes match clearly better with another offset",
    )
    stamping: str = option(
        "auto",
        "which way the scanner turns and what its stamps refer to, for clouds without times per point: auto = found from the "
        "scenes where the vehicle's velocity is known, beginning with the four below; stated = as they say",
        choices=("auto", "stated"),
    )
    scan_period_s: float = option(
        0.1, "duration of one revolution, s; this and the next three apply to clouds without times per point", low=0.005, high=1.0
    )
    spin: str = option(
        "clockwise",
        "direction of rotation seen from above; none = all points are measured at the cloud's stamp",
        choices=("clockwise", "counterclockwise", "none"),
    )
    stamp_azimuth_deg: float = option(
        0.0,
        "azimuth of the scanner at the cloud's stamp, counter-clockwise from the LiDAR's +x, deg",
        low=-180.0,
        high=180.0,
    )
    stamp_at: str = option(
        "middle",
        "part of the scan that the cloud's stamp refers to; middle with azimuth 0 = stamped when facing forward, as in KITTI",
        choices=("start", "middle", "end"),
    )
    from_scans: str = option(
        "timed",
        "estimate the velocity from the previous cloud where there is no odometry: timed = if points have times, always = also "
        "by azimuth (set the four above to your driver first), never; needs small_gicp",
        choices=("timed", "always", "never"),
    )
    max_gap_s: float = option(0.35, "largest time between two scans used for a velocity, s", low=0.01, high=2.0)
    voxel_m: float = option(0.8, "voxel size to which scans are thinned before they are aligned, m", low=0.05, high=5.0)
    max_speed: float = option(60.0, "estimated velocities above this are rejected, m/s", low=0.1, high=200.0)
    max_turn_rate: float = option(2.0, "estimated turn rates above this are rejected, rad/s", low=0.01, high=20.0)
    min_matched: float = option(
        0.65,
        "alignments with a smaller share of matched points are rejected as of another place",
        low=0.05,
        high=1.0,
    )
