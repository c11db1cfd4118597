"""Rigs of several cameras and LiDARs on one vehicle, each sensor with a rate and a clock of its own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from calib_ros import se3
from calib_ros_synthetic.installation import Installation
from calib_ros_synthetic.rigs import NUSCENES, OPTICAL, VGA, WINDSHIELD, Intensity, Lens, Mount, Rig
from calib_ros_synthetic.solids import Floats

SIDE = Lens(90.0, 800, 500, D=(-0.30, 0.10, 5e-4, -4e-4, -0.016))
UNUSED = Mount(0.0, 0.0, 1.0)


@dataclass(frozen=True)
class MountedSensor:
    """mount: by the drawing. kind: the lens of a camera, or the name of a scanner in scanners.MODELS. rate: Hz. late_ms: by which
    its clock is ahead, so that it stamps that much too late."""

    mount: Mount
    kind: Lens | str
    rate: float = 10.0
    late_ms: float = 0.0

    @property
    def is_camera(self) -> bool:
        """Else a LiDAR."""
        return isinstance(self.kind, Lens)

    def pose(self) -> Floats:
        """T_base_sensor (4, 4) by the drawing; a camera's frame is the optical one."""
        T = self.mount.pose()
        if self.is_camera:
            T[:3, :3] = T[:3, :3] @ OPTICAL
        return T

    def installed(self, vehicle: str, width: int | None, displaced: Floats) -> Installation:
        """The sensor on a vehicle, displaced there (4, 4) from its mount. width: of pictures, px."""
        if isinstance(self.kind, Lens):  # an installation has one sensor of either kind
            rig = Rig("", "vlp16", UNUSED, self.kind, self.mount, vehicle=vehicle)
            return Installation(rig, 0, 0.0, width, None, displaced)
        rig = Rig("", self.kind, self.mount, VGA, UNUSED, self.rate, vehicle, intensity=Intensity.BYTE)
        return Installation(rig, 0, 0.0, None, None, displaced)


@dataclass(frozen=True)
class MultiRig:
    """why: it is here. sensors: by name; the first LiDAR is what the others are stated in. vehicle: a name in ego.BODIES."""

    why: str
    sensors: dict[str, MountedSensor]
    vehicle: str = "car"


def displacement(centre: ArrayLike, rotation_deg: ArrayLike, shift_m: ArrayLike) -> Floats:
    """(4, 4): turns what is mounted around a place on the vehicle (3,) about it by a rotation vector (3,), and shifts it (3,)."""
    R = se3.exp(np.r_[np.deg2rad(rotation_deg), 0, 0, 0])[:3, :3]
    centre = np.asarray(centre, float)
    return se3.from_parts(R, centre + np.asarray(shift_m, float) - R @ centre)


RING = {
    "lidar_top": MountedSensor(Mount(-0.1, 0.0, 1.95), "pandar64"),
    "front": MountedSensor(Mount(0.62, 0.02, 1.58, pitch=2.0), WINDSHIELD, 30.0, 2.0),
    "front_left": MountedSensor(Mount(0.45, 0.52, 1.60, yaw=55.0, pitch=3.0), NUSCENES, 15.0, -3.0),
    "front_right": MountedSensor(Mount(0.45, -0.52, 1.60, yaw=-55.0, pitch=3.0), NUSCENES, 15.0, 4.0),
    "back_left": MountedSensor(Mount(-0.85, 0.76, 1.74, yaw=112.0, pitch=4.0), SIDE, 10.0, 1.0),
    "back_right": MountedSensor(Mount(-0.85, -0.76, 1.74, yaw=-112.0, pitch=4.0), SIDE, 10.0, -2.0),
    "back": MountedSensor(Mount(-1.75, 0.03, 1.55, yaw=180.0, pitch=5.0), SIDE, 10.0, 5.0),
}

MULTI_RIGS: dict[str, MultiRig] = {
    "six_cameras_one_lidar": MultiRig(
        "Robotaxi: a ring of six cameras around 64 rings on the roof, which all of them share", RING
    ),
    "six_cameras_two_lidars": MultiRig(
        "The same with a second scanner at the roof's rear, tilted down, for what the first one does not see behind the vehicle",
        {**RING, "lidar_rear": MountedSensor(Mount(-1.7, 0.0, 1.75, yaw=180.0, pitch=8.0), "os1_64", 10.0, -3.0)},
    ),
    "two_lidars_three_cameras": MultiRig(
        "Two scanners on the roof's edges, tilted outwards, which share the front camera's view; side cameras have one each",
        {
            "lidar_left": MountedSensor(Mount(0.1, 0.62, 1.85, yaw=10.0, roll=-12.0), "pandar64"),
            "lidar_right": MountedSensor(Mount(0.1, -0.62, 1.85, yaw=-10.0, roll=12.0), "os1_64", 20.0, 3.0),
            "front": MountedSensor(Mount(0.62, 0.0, 1.58, pitch=2.0), WINDSHIELD, 30.0, -2.0),
            "left": MountedSensor(Mount(0.3, 0.66, 1.55, yaw=80.0, pitch=4.0), SIDE, 15.0, 4.0),
            "right": MountedSensor(Mount(0.3, -0.66, 1.55, yaw=-80.0, pitch=4.0), SIDE, 10.0, -4.0),
        },
    ),
    "cameras_apart": MultiRig(
        "Solid-state scanners in grille and tail, with a camera each: nothing sees both ends, only the motion joins them",
        {
            "lidar_front": MountedSensor(Mount(2.1, 0.0, 0.65), "rs_m1"),
            "lidar_rear": MountedSensor(Mount(-2.3, 0.05, 0.75, yaw=180.0), "rs_m1", late_ms=-3.0),
            "front": MountedSensor(Mount(0.55, 0.05, 1.40, pitch=1.0), WINDSHIELD, 15.0, 2.0),
            "rear": MountedSensor(Mount(-2.1, -0.03, 1.15, yaw=180.0, pitch=2.0), VGA, 30.0, 3.0),
        },
        vehicle="",
    ),
}
