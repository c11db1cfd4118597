"""The vehicle of a synthetic drive on its way: what its scanners and cameras measure at any moment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import BadInputError
from calib_ros.frame import UNLABELLED, PointCloud
from calib_ros.frame import SemanticClass as Label
from calib_ros_synthetic.camera import Scene, render
from calib_ros_synthetic.conditions import Conditions
from calib_ros_synthetic.ego import OwnLayer
from calib_ros_synthetic.lidar import OwnReturns, scan
from calib_ros_synthetic.rays import CameraView, row_motion
from calib_ros_synthetic.ride import SPINS, Ride
from calib_ros_synthetic.scanners import SpinningScanner
from calib_ros_synthetic.solids import Floats, Solids
from calib_ros_synthetic.street import Street

V = TypeVar("V")
Ids = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Trip:
    """street: what stands where. ride: how the vehicle moves. condition: of the weather and the pictures.
    noise: factor on all sensor noise. moving: else the vehicle stops for every measurement. spin: of scanners."""

    street: Street
    ride: Ride
    condition: Conditions
    noise: float
    moving: bool = True
    spin: str = SPINS[0]

    def station(self, seconds: float) -> float:
        """m from the start."""
        return self.ride.station(seconds)

    def pose(self, seconds: float) -> Floats:
        """T_world_ride (4, 4)."""
        return self.ride.pose(self.street, self.station(seconds))

    def twist(self, seconds: float) -> Floats:
        """Of the ride in its own frame, (6,) rad/s and m/s."""
        speed = self.ride.speed_at(seconds) if self.moving else 0.0
        return self.ride.twist(self.street, self.station(seconds), speed)

    def scan(
        self,
        solids: Solids,
        scanner: SpinningScanner,
        number: int,
        T_world_lidar: Floats,
        twist: Floats,
        own: OwnReturns | None,
        rng: np.random.Generator,
    ) -> tuple[PointCloud, Ids]:
        """Scan `number` of a scanner at T_world_lidar (4, 4) that moves by twist (6,), as `lidar.scan` returns it. solids: in the
        world."""
        # Everything is cast relative to the sensor: far from the world's origin float32 would be too coarse.
        return scan(
            self.street, solids.moved(-T_world_lidar[:3, 3]), replace(scanner, number=number), T_world_lidar, twist, self.noise,
            rng, visibility=self.condition.visibility, own=own, reverse=self.spin != SPINS[0],
        )  # fmt: skip

    def picture(
        self,
        solids: Solids,
        view: CameraView,
        T_world_camera: Floats,
        twist: Floats,
        own: OwnLayer | None,
        R_vehicle: Floats | None,
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.uint8], Ids]:
        """The image of a camera at T_world_camera (4, 4) that moves by twist (6,), and what each pixel sees. solids: in the
        world. R_vehicle: world from vehicle."""
        lens = T_world_camera[:3, 3]
        scene = Scene(
            *(self.street, solids.moved(-lens), lens, T_world_camera[:3, :3]),
            *(self.condition.lit(self.street.indoors), own, R_vehicle),
            *(row_motion(T_world_camera, twist, self.condition.readout, view.x.shape[0]), twist),
        )
        return render(scene, view, self.noise * self.condition.noise, rng, self.condition)


def labels_of(solids: Solids, ids: Ids) -> NDArray[np.uint8]:
    """SemanticClass of what rays have met, as `cast` writes it."""
    # Ids below 0 index this table from its end: own vehicle, curb, pavement and road, then the sky.
    return np.asarray(np.r_[solids.label, UNLABELLED, [Label.GROUND] * 3, Label.SKY].astype(np.uint8)[ids])


def named(parameter: str, name: str, known: Mapping[str, V]) -> V:
    """What a name stands for. BadInputError for an unknown one."""
    if name not in known:
        raise BadInputError(f"synthetic drive: {parameter}={name} is not known; choose one of {', '.join(known)}")
    return known[name]
