"""Sensor rigs for the synthetic drive, each the model of one that exists: scanner, camera, mounts, own vehicle, picture.

Positions are in the vehicle's frame base_link: x forward, y left, z up, its origin on the ground below the middle of the vehicle.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from calib_ros import lens, se3
from calib_ros.camera import Camera
from calib_ros_synthetic.scanners import RATE
from calib_ros_synthetic.solids import Floats

OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # a vehicle's axes from those of a camera that looks ahead


class Fields(Enum):
    """Which fields a cloud has beside xyz: all that drivers give, and one less from each to the next, as bare data sets."""

    ALL = "all"
    NO_TIME = "xyzir"
    INTENSITY = "xyzi"
    BARE = "xyz"


class Intensity(Enum):
    """Scale of the intensity."""

    UNIT = "0..1"
    BYTE = "0..255"
    SIGNAL = "signal"  # photons: falls with the squared distance, up to some thousands
    WIDE = "wide"  # up to 70,000, few values above 1000


@dataclass(frozen=True)
class Mount:
    """Pose on the vehicle: metres and degrees. yaw to the left, pitch nose down, roll to the right; applied in this order."""

    x: float
    y: float
    z: float
    yaw: float = 0.0
    pitch: float = 0.0
    roll: float = 0.0

    def pose(self) -> Floats:
        """T_base_sensor (4, 4), for a sensor with x forward, y left, z up."""
        R = se3.rotation_from_euler(*np.deg2rad([self.yaw, self.pitch, self.roll]))
        return se3.from_parts(R, [self.x, self.y, self.z])


@dataclass(frozen=True)
class Lens:
    """A camera. field: degrees from the left to the right border along the middle row. width, height: px. D: as in ROS."""

    field: float
    width: int
    height: int
    model: str = "plumb_bob"
    D: tuple[float, ...] = ()

    def camera(self, width: int | None = None, height: int | None = None) -> Camera:
        """The camera with an image of width x height px; one alone keeps the shape of the picture."""
        if width is None:
            width = self.width if height is None else round(self.width * height / self.height)
        if height is None:
            height = round(self.height * width / self.width)
        f = width / 2 / self._radius()
        # Principal points are not in the middle, as they never are.
        K = np.array([[f, 0, 0.493 * width], [0, f * height / width * self.width / self.height, 0.512 * height], [0, 0, 1]])
        return Camera(K, width, height, self.model, np.array(self.D))

    def _radius(self) -> float:
        """Distance from the principal point, in focal lengths, at which the lens images half of its field."""
        D = np.array(self.D) if self.D else np.zeros(4)
        return float(lens.LensProjection(self.model, D).radius(np.deg2rad([self.field / 2]))[0])


@dataclass(frozen=True)
class Rig:
    """A vehicle's sensors.

    why: it is here. scanner: a name in scanners.MODELS. rate: turns per second. lidar, camera: where they are. vehicle: a name in
    ego.BODIES, "" = not in view. condition: a name in conditions.CONDITIONS. base_frame: the cloud is given in base_link.
    compensated: the points are moved to where they are at the cloud's stamp. crop: m to either side at which the cloud ends.
    triggered: the picture is taken when the scan sweeps the camera's axis, else at the cloud's stamp. top_speed: m/s.
    """

    why: str
    scanner: str
    lidar: Mount
    lens: Lens
    camera: Mount
    rate: float = RATE
    vehicle: str = ""
    condition: str = "clear"
    fields: Fields = Fields.ALL
    intensity: Intensity = Intensity.BYTE
    base_frame: bool = False
    compensated: bool = False
    crop: float = np.inf
    triggered: bool = False
    top_speed: float = 30.0

    def T_base_camera(self, seed: int, tilt_deg: float) -> Floats:
        """Pose (4, 4) of the camera, turned from its mount by tilt_deg about an axis that depends on the seed."""
        axis = np.random.default_rng([seed, 7]).standard_normal(3)
        T = self.camera.pose()
        T[:3, :3] = T[:3, :3] @ OPTICAL @ se3.exp(np.r_[np.deg2rad(tilt_deg) * axis / np.linalg.norm(axis), 0, 0, 0])[:3, :3]
        return T


NARROW = Lens(34.0, 720, 540, D=(-0.08, 0.12, 4e-4, -3e-4, 0.0))
WAYMO = Lens(50.0, 960, 640, D=(0.04, -0.33, 1e-3, -3e-4, 0.0))
KITTI = Lens(82.0, 1242, 375)
VGA = Lens(80.0, 640, 480, D=(-0.29, 0.085, 2e-4, -3e-4, 0.0))
NUSCENES = Lens(65.0, 800, 450)
WINDSHIELD = Lens(60.0, 960, 604, D=(-0.33, 0.12, 3e-4, 1e-4, 0.0))

RIGS: dict[str, Rig] = {
    "vlp16_narrow": Rig(
        "Few rings in a narrow picture: 16 rings 2 deg apart through a 34 deg lens, 0.1 m apart, as hand-made research rigs have",
        "vlp16", Mount(0.0, 0.0, 0.9), NARROW, Mount(0.05, 0.02, 0.81), top_speed=1.5,
    ),
    "vlp32c_roof": Rig(
        "Uneven rings, dense around the horizon, on a car's roof, and a usual 80 deg camera above the windshield",
        "vlp32c", Mount(0.0, 0.0, 1.95), VGA, Mount(0.45, 0.15, 1.66, pitch=3.0), vehicle="car",
    ),
    "hdl32e_front": Rig(
        "nuScenes: 32 rings at 20 Hz on the roof, the front camera 0.85 m before and below it, taken as the scan sweeps it",
        "hdl32e", Mount(-0.05, 0.0, 1.84), NUSCENES, Mount(0.71, 0.02, 1.51), rate=20.0, vehicle="car", triggered=True,
    ),
    "hdl64e_kitti": Rig(
        "KITTI: 64 rings in two blocks, given without rings and times, and a rectified 82 deg picture 0.33 m away",
        "hdl64e", Mount(0.0, 0.0, 1.73), KITTI, Mount(0.29, 0.05, 1.62), fields=Fields.INTENSITY, intensity=Intensity.UNIT,
    ),
    "hdl64e_waymo": Rig(
        "Waymo: a 50 deg lens; the cloud in the vehicle's frame, compensated, cut off at 22 m to the side, without rings",
        "hdl64e", Mount(-0.1, 0.0, 2.05, pitch=1.5, yaw=148.0), WAYMO, Mount(0.1, -0.05, 1.86), vehicle="car",
        fields=Fields.INTENSITY, intensity=Intensity.WIDE, base_frame=True, compensated=True, crop=22.0,
    ),
    "pandar64_roof": Rig(
        "64 rings, 0.17 deg apart around the horizon and up to 6 deg below, and a 50 deg camera, as in PandaSet",
        "pandar64", Mount(0.0, 0.0, 1.95), Lens(52.0, 960, 540, D=(-0.52, 0.30, 1e-3, 2e-4, -0.05)), Mount(0.25, 0.0, 1.72),
        vehicle="car",
    ),
    "os1_64_robot": Rig(
        "A small robot: 64 staggered rings 0.6 m above the floor and a 90 deg camera 0.15 m below",
        "os1_64", Mount(0.0, 0.0, 0.62), Lens(90.0, 800, 592, D=(-0.30, 0.10, 5e-4, -4e-4, -0.016)), Mount(0.13, 0.03, 0.54),
        vehicle="robot", intensity=Intensity.SIGNAL, top_speed=2.0,
    ),
    "os1_128_windshield": Rig(
        "128 rings on the roof, and a 60 deg camera behind the windshield 1.2 m away, with the bonnet in the picture",
        "os1_128", Mount(-0.5, 0.0, 1.9), WINDSHIELD, Mount(0.55, 0.10, 1.33, pitch=2.0), vehicle="car",
        intensity=Intensity.SIGNAL,
    ),
    "pandar40p_roof": Rig(
        "Robotaxis: 40 rings, 0.33 deg apart around the horizon, in a cloud that the driver gives in base_link, without times",
        "pandar40p", Mount(-0.2, 0.05, 1.95, yaw=-3.0, pitch=2.0, roll=1.0), WINDSHIELD, Mount(0.35, -0.12, 1.70, pitch=1.0),
        vehicle="car", fields=Fields.NO_TIME, base_frame=True,
    ),
    "vlp16_upside_down": Rig(
        "An automated forklift: 16 rings at 5 Hz under its roof, upside down, and an 80 deg camera 0.5 m below",
        "vlp16", Mount(0.75, 0.0, 2.15, roll=180.0), VGA, Mount(0.78, 0.08, 1.62, pitch=4.0), rate=5.0, vehicle="forklift",
        top_speed=2.0,
    ),
    "os1_128_tilted_bumper": Rig(
        "The scanner tilted 20 deg down on the roof's front edge, the camera low in the bumper, 1.9 m away",
        "os1_128", Mount(0.35, 0.0, 1.78, pitch=20.0), Lens(70.0, 800, 500, D=(-0.31, 0.11, 0.0, 0.0, -0.018)),
        Mount(2.36, 0.0, 0.62, pitch=-2.0), vehicle="car",
    ),
    "pandar64_truck": Rig(
        "A truck: the scanner on the left mirror, tilted 4 deg and turned 20 deg out, an 8 Mpx camera in the cab 1.5 m away",
        "pandar64", Mount(1.35, 1.55, 2.35, yaw=20.0, pitch=4.0), Lens(60.0, 3840, 2160, D=(-0.36, 0.17, 2e-4, 1e-4, -0.04)),
        Mount(1.45, 0.1, 2.55, pitch=4.0), vehicle="truck", condition="rolling",
    ),
    "hdl32e_side": Rig(
        "nuScenes: the camera to the front left, which the scan sweeps 8 ms before its stamp",
        "hdl32e", Mount(-0.05, 0.0, 1.84), NUSCENES, Mount(0.62, 0.5, 1.51, yaw=55.0), rate=20.0, vehicle="car", triggered=True,
    ),
    "vls128_wide": Rig(
        "A 120 deg lens with the strong distortion of the rational model, and 128 rings",
        "vls128", Mount(0.0, 0.0, 2.0),
        Lens(120.0, 960, 604, "rational_polynomial", (0.9, 0.1, 1e-4, -1e-4, 0.001, 1.2, 0.3, 0.01)),
        Mount(0.8, 0.0, 1.72, pitch=3.0), vehicle="car",
    ),
    "os1_64_wide": Rig(
        "A cheap 120 deg lens, plumb bob, on a robot whose clouds are bare points",
        "os1_64", Mount(0.0, 0.0, 0.62), Lens(118.0, 800, 600, D=(-0.23, 0.042, 3e-4, -2e-4, -0.0029)), Mount(0.2, 0.0, 0.50),
        vehicle="robot", condition="jpeg", fields=Fields.BARE, top_speed=2.0,
    ),
    "os1_64_portrait": Rig(
        "The same robot with its camera on its side, for pictures in portrait format",
        "os1_64", Mount(0.0, 0.0, 0.62), Lens(70.0, 800, 592, D=(-0.28, 0.09, 4e-4, -3e-4, -0.012)),
        Mount(0.13, -0.06, 0.52, roll=90.0), vehicle="robot", intensity=Intensity.SIGNAL, top_speed=2.0,
    ),
    "os1_128_fisheye": Rig(
        "A 190 deg fisheye on a car's roof bar, looking 10 deg down over the bonnet; 128 rings 1.2 m behind it",
        "os1_128", Mount(-0.3, 0.0, 1.95), Lens(190.0, 960, 768, "equidistant", (0.02, -0.004, 8e-4, -1.5e-4)),
        Mount(0.85, 0.0, 1.72, pitch=10.0), vehicle="car", intensity=Intensity.SIGNAL,
    ),
    "mid360_fisheye": Rig(
        "A walking robot: a Mid-360 without rings that never repeats, 0.12 m above a 190 deg fisheye",
        "mid360", Mount(0.1, 0.0, 0.60), Lens(190.0, 800, 640, "equidistant", (0.015, -0.003, 6e-4, -1e-4)),
        Mount(0.18, 0.0, 0.51), top_speed=1.5,
    ),
    "mid360_90": Rig(
        "A Mid-360 without rings and a usual 90 deg camera 0.14 m below, as on drones and robots",
        "mid360", Mount(0.1, 0.0, 0.60), Lens(90.0, 800, 600, D=(-0.30, 0.10, 5e-4, -4e-4, -0.016)), Mount(0.2, 0.03, 0.50),
        top_speed=1.5,
    ),
    "vls128_roof": Rig(
        "128 rings in eight columns, 0.11 deg apart around the horizon, 245 m far, and an 80 deg camera",
        "vls128", Mount(0.0, 0.0, 2.0), VGA, Mount(0.3, -0.2, 1.72, pitch=2.0), vehicle="car",
    ),
    "rs_m1_grille": Rig(
        "A solid-state scanner in the grille, five fields of lines that bend, and a 60 deg camera behind the windshield",
        "rs_m1", Mount(2.1, 0.0, 0.65), WINDSHIELD, Mount(0.55, 0.05, 1.38, pitch=1.0),
    ),
    "ft120_side": Rig(
        "A flash scanner for the blind spot, 160 by 120 points at once, below a 90 deg camera",
        "ft120", Mount(0.6, 0.0, 0.95), Lens(90.0, 800, 600, D=(-0.30, 0.10, 5e-4, -4e-4, -0.016)), Mount(0.62, 0.04, 1.1),
    ),
}  # fmt: skip
