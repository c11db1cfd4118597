"""Sensor rigs for the synthetic drive, each the model of one that exists: scanners, cameras, mounts, own vehicle, pictures.

Positions are in the vehicle's frame base_link: x forward, y left, z up, its origin on the ground below the middle of the vehicle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from calib_ros import lens, se3
from calib_ros.camera import Camera
from calib_ros_synthetic.scanners import RATE
from calib_ros_synthetic.solids import Floats

FOCAL = 0.58  # focal length as a share of the image width, as KITTI's
OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # a vehicle's axes from those of a camera that looks ahead


# Which fields a cloud has beside xyz: all that drivers give, and one less from each to the next, as bare data sets.
FIELDS = ("all", "xyzir", "xyzi", "xyz")
# Scale of the intensity: 0..1, 0..255, photons (they fall with the squared distance), or up to 70,000 with few values above 1000.
UNIT, BYTE, SIGNAL, WIDE = ("unit", "byte", "signal", "wide")


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
        # Distance from the principal point, in focal lengths, at which the lens images half of its field.
        D = np.array(self.D) if self.D else np.zeros(4)
        f = width / 2 / float(lens.LensProjection(self.model, D).radius(np.deg2rad([self.field / 2]))[0])
        # Principal points are not in the middle, as they never are.
        K = np.array([[f, 0, 0.493 * width], [0, f * height / width * self.width / self.height, 0.512 * height], [0, 0, 1]])
        return Camera(K, width, height, self.model, np.array(self.D))


class PlainLens(Lens):
    """A pinhole with square pixels whose focal length is FOCAL of the width; width and height do not depend on each other."""

    def camera(self, width: int | None = None, height: int | None = None) -> Camera:
        """As of any lens."""
        width, height = width or self.width, height or self.height
        f = FOCAL * width
        return Camera(np.array([[f, 0, 0.491 * width], [0, f, 0.461 * height], [0, 0, 1]]), width, height)


@dataclass(frozen=True)
class MountedSensor:
    """mount: by the drawing. kind: the lens of a camera, or a name that scanners.scanner knows. rate: Hz; of one pair only
    the scanner's is used. late_ms: by which its clock is ahead, so that it stamps that much too late."""

    mount: Mount
    kind: Lens | str
    rate: float = RATE
    late_ms: float = 0.0

    def pose(self) -> Floats:
        """T_base_sensor (4, 4) by the drawing; a camera's frame is the optical one."""
        T = self.mount.pose()
        if isinstance(self.kind, Lens):
            T[:3, :3] = T[:3, :3] @ OPTICAL
        return T


@dataclass(frozen=True)
class Rig:
    """A vehicle's sensors. Those of one pair measure together, frame by frame; more go each at its own rate.

    why: it is here. sensors: by name; the others are stated in the first LiDAR. vehicle: a name in ego.BODIES, "" = out of view,
    None = none: the scanner rides by itself. condition: a name in camera.CONDITIONS. fields, intensity: of clouds, see FIELDS.
    base_frame: they are given in base_link. compensated: the points are moved to where they are at the cloud's stamp. crop: m to
    either side at which the cloud ends. triggered: the picture is taken when the scan sweeps the camera's axis, else at the
    cloud's stamp. top_speed: m/s.
    """

    why: str
    sensors: dict[str, MountedSensor]
    vehicle: str | None = "car"
    condition: str = "clear"
    fields: str = FIELDS[0]
    intensity: str = BYTE
    base_frame: bool = False
    compensated: bool = False
    crop: float = np.inf
    triggered: bool = False
    top_speed: float = 30.0

    @property
    def cameras(self) -> tuple[str, ...]:
        """Their names."""
        return tuple(name for name, sensor in self.sensors.items() if isinstance(sensor.kind, Lens))

    @property
    def lidars(self) -> tuple[str, ...]:
        """Their names."""
        return tuple(name for name in self.sensors if name not in self.cameras)

    @property
    def is_pair(self) -> bool:
        """Whether it is of one camera and one LiDAR."""
        return len(self.sensors) == 2


def _pair(
    why: str, scanner: str, lidar: Mount, lens: Lens, camera: Mount, rate: float = RATE, vehicle: str | None = "", **more: Any
) -> Rig:
    """A rig of one scanner and one camera at their mounts."""
    return Rig(why, {"lidar": MountedSensor(lidar, scanner, rate), "camera": MountedSensor(camera, lens)}, vehicle, **more)


def plain(rings: int) -> Rig:
    """The rig of a drive that names none: a scanner of scanners.PLAIN that rides by itself, and a camera below and before it."""
    lidar, camera = (
        MountedSensor(Mount(0.0, 0.0, 0.0), str(rings)),
        MountedSensor(Mount(0.29, 0.05, -0.11), PlainLens(82.0, 1242, 375)),
    )
    return Rig("", {"velodyne": lidar, "camera": camera}, None, intensity=UNIT)


NARROW = Lens(34.0, 720, 540, D=(-0.08, 0.12, 4e-4, -3e-4, 0.0))
WAYMO = Lens(50.0, 960, 640, D=(0.04, -0.33, 1e-3, -3e-4, 0.0))
KITTI = Lens(82.0, 1242, 375)
VGA = Lens(80.0, 640, 480, D=(-0.29, 0.085, 2e-4, -3e-4, 0.0))
NUSCENES = Lens(65.0, 800, 450)
WINDSHIELD = Lens(60.0, 960, 604, D=(-0.33, 0.12, 3e-4, 1e-4, 0.0))
SIDE = Lens(90.0, 800, 500, D=(-0.30, 0.10, 5e-4, -4e-4, -0.016))

RING = {
    "lidar_top": MountedSensor(Mount(-0.1, 0.0, 1.95), "pandar64"),
    "front": MountedSensor(Mount(0.62, 0.02, 1.58, pitch=2.0), WINDSHIELD, 30.0, 2.0),
    "front_left": MountedSensor(Mount(0.45, 0.52, 1.60, yaw=55.0, pitch=3.0), NUSCENES, 15.0, -3.0),
    "front_right": MountedSensor(Mount(0.45, -0.52, 1.60, yaw=-55.0, pitch=3.0), NUSCENES, 15.0, 4.0),
    "back_left": MountedSensor(Mount(-0.85, 0.76, 1.74, yaw=112.0, pitch=4.0), SIDE, 10.0, 1.0),
    "back_right": MountedSensor(Mount(-0.85, -0.76, 1.74, yaw=-112.0, pitch=4.0), SIDE, 10.0, -2.0),
    "back": MountedSensor(Mount(-1.75, 0.03, 1.55, yaw=180.0, pitch=5.0), SIDE, 10.0, 5.0),
}

RIGS: dict[str, Rig] = {
    "vlp16_narrow": _pair(
        "Few rings in a narrow picture: 16 rings 2 deg apart through a 34 deg lens, 0.1 m apart, as hand-made research rigs have",
        "vlp16", Mount(0.0, 0.0, 0.9), NARROW, Mount(0.05, 0.02, 0.81), top_speed=1.5,
    ),
    "vlp32c_roof": _pair(
        "Uneven rings, dense around the horizon, on a car's roof, and a usual 80 deg camera above the windshield",
        "vlp32c", Mount(0.0, 0.0, 1.95), VGA, Mount(0.45, 0.15, 1.66, pitch=3.0), vehicle="car",
    ),
    "hdl32e_front": _pair(
        "nuScenes: 32 rings at 20 Hz on the roof, the front camera 0.85 m before and below it, taken as the scan sweeps it",
        "hdl32e", Mount(-0.05, 0.0, 1.84), NUSCENES, Mount(0.71, 0.02, 1.51), rate=20.0, vehicle="car", triggered=True,
    ),
    "hdl64e_kitti": _pair(
        "KITTI: 64 rings in two blocks, given without rings and times, and a rectified 82 deg picture 0.33 m away",
        "hdl64e", Mount(0.0, 0.0, 1.73), KITTI, Mount(0.29, 0.05, 1.62), fields="xyzi", intensity=UNIT,
    ),
    "hdl64e_waymo": _pair(
        "Waymo: a 50 deg lens; the cloud in the vehicle's frame, compensated, cut off at 22 m to the side, without rings",
        "hdl64e", Mount(-0.1, 0.0, 2.05, pitch=1.5, yaw=148.0), WAYMO, Mount(0.1, -0.05, 1.86), vehicle="car",
        fields="xyzi", intensity=WIDE, base_frame=True, compensated=True, crop=22.0,
    ),
    "pandar64_roof": _pair(
        "64 rings, 0.17 deg apart around the horizon and up to 6 deg below, and a 50 deg camera, as in PandaSet",
        "pandar64", Mount(0.0, 0.0, 1.95), Lens(52.0, 960, 540, D=(-0.52, 0.30, 1e-3, 2e-4, -0.05)), Mount(0.25, 0.0, 1.72),
        vehicle="car",
    ),
    "os1_64_robot": _pair(
        "A small robot: 64 staggered rings 0.6 m above the floor and a 90 deg camera 0.15 m below",
        "os1_64", Mount(0.0, 0.0, 0.62), Lens(90.0, 800, 592, D=(-0.30, 0.10, 5e-4, -4e-4, -0.016)), Mount(0.13, 0.03, 0.54),
        vehicle="robot", intensity=SIGNAL, top_speed=2.0,
    ),
    "os1_128_windshield": _pair(
        "128 rings on the roof, and a 60 deg camera behind the windshield 1.2 m away, with the bonnet in the picture",
        "os1_128", Mount(-0.5, 0.0, 1.9), WINDSHIELD, Mount(0.55, 0.10, 1.33, pitch=2.0), vehicle="car",
        intensity=SIGNAL,
    ),
    "pandar40p_roof": _pair(
        "Robotaxis: 40 rings, 0.33 deg apart around the horizon, in a cloud that the driver gives in base_link, without times",
        "pandar40p", Mount(-0.2, 0.05, 1.95, yaw=-3.0, pitch=2.0, roll=1.0), WINDSHIELD, Mount(0.35, -0.12, 1.70, pitch=1.0),
        vehicle="car", fields="xyzir", base_frame=True,
    ),
    "vlp16_upside_down": _pair(
        "An automated forklift: 16 rings at 5 Hz under its roof, upside down, and an 80 deg camera 0.5 m below",
        "vlp16", Mount(0.75, 0.0, 2.15, roll=180.0), VGA, Mount(0.78, 0.08, 1.62, pitch=4.0), rate=5.0, vehicle="forklift",
        top_speed=2.0,
    ),
    "os1_128_tilted_bumper": _pair(
        "The scanner tilted 20 deg down on the roof's front edge, the camera low in the bumper, 1.9 m away",
        "os1_128", Mount(0.35, 0.0, 1.78, pitch=20.0), Lens(70.0, 800, 500, D=(-0.31, 0.11, 0.0, 0.0, -0.018)),
        Mount(2.36, 0.0, 0.62, pitch=-2.0), vehicle="car",
    ),
    "pandar64_truck": _pair(
        "A truck: the scanner on the left mirror, tilted 4 deg and turned 20 deg out, an 8 Mpx camera in the cab 1.5 m away",
        "pandar64", Mount(1.35, 1.55, 2.35, yaw=20.0, pitch=4.0), Lens(60.0, 3840, 2160, D=(-0.36, 0.17, 2e-4, 1e-4, -0.04)),
        Mount(1.45, 0.1, 2.55, pitch=4.0), vehicle="truck", condition="rolling",
    ),
    "hdl32e_side": _pair(
        "nuScenes: the camera to the front left, which the scan sweeps 8 ms before its stamp",
        "hdl32e", Mount(-0.05, 0.0, 1.84), NUSCENES, Mount(0.62, 0.5, 1.51, yaw=55.0), rate=20.0, vehicle="car", triggered=True,
    ),
    "vls128_wide": _pair(
        "A 120 deg lens with the strong distortion of the rational model, and 128 rings",
        "vls128", Mount(0.0, 0.0, 2.0),
        Lens(120.0, 960, 604, "rational_polynomial", (0.9, 0.1, 1e-4, -1e-4, 0.001, 1.2, 0.3, 0.01)),
        Mount(0.8, 0.0, 1.72, pitch=3.0), vehicle="car",
    ),
    "os1_64_wide": _pair(
        "A cheap 120 deg lens, plumb bob, on a robot whose clouds are bare points",
        "os1_64", Mount(0.0, 0.0, 0.62), Lens(118.0, 800, 600, D=(-0.23, 0.042, 3e-4, -2e-4, -0.0029)), Mount(0.2, 0.0, 0.50),
        vehicle="robot", condition="jpeg", fields="xyz", top_speed=2.0,
    ),
    "os1_64_portrait": _pair(
        "The same robot with its camera on its side, for pictures in portrait format",
        "os1_64", Mount(0.0, 0.0, 0.62), Lens(70.0, 800, 592, D=(-0.28, 0.09, 4e-4, -3e-4, -0.012)),
        Mount(0.13, -0.06, 0.52, roll=90.0), vehicle="robot", intensity=SIGNAL, top_speed=2.0,
    ),
    "os1_128_fisheye": _pair(
        "A 190 deg fisheye on a car's roof bar, looking 10 deg down over the bonnet; 128 rings 1.2 m behind it",
        "os1_128", Mount(-0.3, 0.0, 1.95), Lens(190.0, 960, 768, "equidistant", (0.02, -0.004, 8e-4, -1.5e-4)),
        Mount(0.85, 0.0, 1.72, pitch=10.0), vehicle="car", intensity=SIGNAL,
    ),
    "mid360_fisheye": _pair(
        "A walking robot: a Mid-360 without rings that never repeats, 0.12 m above a 190 deg fisheye",
        "mid360", Mount(0.1, 0.0, 0.60), Lens(190.0, 800, 640, "equidistant", (0.015, -0.003, 6e-4, -1e-4)),
        Mount(0.18, 0.0, 0.51), top_speed=1.5,
    ),
    "mid360_90": _pair(
        "A Mid-360 without rings and a usual 90 deg camera 0.14 m below, as on drones and robots",
        "mid360", Mount(0.1, 0.0, 0.60), Lens(90.0, 800, 600, D=(-0.30, 0.10, 5e-4, -4e-4, -0.016)), Mount(0.2, 0.03, 0.50),
        top_speed=1.5,
    ),
    "vls128_roof": _pair(
        "128 rings in eight columns, 0.11 deg apart around the horizon, 245 m far, and an 80 deg camera",
        "vls128", Mount(0.0, 0.0, 2.0), VGA, Mount(0.3, -0.2, 1.72, pitch=2.0), vehicle="car",
    ),
    "rs_m1_grille": _pair(
        "A solid-state scanner in the grille, five fields of lines that bend, and a 60 deg camera behind the windshield",
        "rs_m1", Mount(2.1, 0.0, 0.65), WINDSHIELD, Mount(0.55, 0.05, 1.38, pitch=1.0),
    ),
    "ft120_side": _pair(
        "A flash scanner for the blind spot, 160 by 120 points at once, below a 90 deg camera",
        "ft120", Mount(0.6, 0.0, 0.95), Lens(90.0, 800, 600, D=(-0.30, 0.10, 5e-4, -4e-4, -0.016)), Mount(0.62, 0.04, 1.1),
    ),
    "six_cameras_one_lidar": Rig(
        "Robotaxi: a ring of six cameras around 64 rings on the roof, which all of them share", RING
    ),
    "six_cameras_two_lidars": Rig(
        "The same with a second scanner at the roof's rear, tilted down, for what the first one does not see behind the vehicle",
        {**RING, "lidar_rear": MountedSensor(Mount(-1.7, 0.0, 1.75, yaw=180.0, pitch=8.0), "os1_64", 10.0, -3.0)},
    ),
    "two_lidars_three_cameras": Rig(
        "Two scanners on the roof's edges, tilted outwards, which share the front camera's view; side cameras have one each",
        {
            "lidar_left": MountedSensor(Mount(0.1, 0.62, 1.85, yaw=10.0, roll=-12.0), "pandar64"),
            "lidar_right": MountedSensor(Mount(0.1, -0.62, 1.85, yaw=-10.0, roll=12.0), "os1_64", 20.0, 3.0),
            "front": MountedSensor(Mount(0.62, 0.0, 1.58, pitch=2.0), WINDSHIELD, 30.0, -2.0),
            "left": MountedSensor(Mount(0.3, 0.66, 1.55, yaw=80.0, pitch=4.0), SIDE, 15.0, 4.0),
            "right": MountedSensor(Mount(0.3, -0.66, 1.55, yaw=-80.0, pitch=4.0), SIDE, 10.0, -4.0),
        },
    ),
    "cameras_apart": Rig(
        "Solid-state scanners in grille and tail, with a camera each: nothing sees both ends, only the motion joins them",
        {
            "lidar_front": MountedSensor(Mount(2.1, 0.0, 0.65), "rs_m1"),
            "lidar_rear": MountedSensor(Mount(-2.3, 0.05, 0.75, yaw=180.0), "rs_m1", late_ms=-3.0),
            "front": MountedSensor(Mount(0.55, 0.05, 1.40, pitch=1.0), WINDSHIELD, 15.0, 2.0),
            "rear": MountedSensor(Mount(-2.1, -0.03, 1.15, yaw=180.0, pitch=2.0), VGA, 30.0, 3.0),
        },
        vehicle="",
    ),
}  # fmt: skip
PAIRS = tuple(name for name, rig in RIGS.items() if rig.is_pair)
