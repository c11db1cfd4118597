"""A rig on the vehicle of a synthetic drive: where everything is and moves, and how its driver hands out the cloud."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.frame import PointCloud
from calib_ros.lens import PERSPECTIVE
from calib_ros_synthetic import ego
from calib_ros_synthetic.lidar import OwnReturns, own_returns
from calib_ros_synthetic.rays import CameraView
from calib_ros_synthetic.rigs import Fields, Intensity, Rig
from calib_ros_synthetic.scanners import RosetteScanner, in_frame, scanner
from calib_ros_synthetic.solids import Floats
from calib_ros_synthetic.street import LIDAR_HEIGHT
from calib_ros_synthetic.wide import WideView

SIGNAL = 2000.0  # photons from a white wall 10 m away
BRIGHTEST = 70_000.0


class Installation:
    """What follows from a rig, the seed and the size of the picture.

    camera, scanner. T_base_lidar, T_base_camera: poses (4, 4) on the vehicle. T_base_frame: of the frame that clouds are given
    in. reference: T_camera_frame (4, 4). frame: name of that frame. displaced: (4, 4) that moves the sensors on the vehicle.
    """

    def __init__(
        self, rig: Rig, seed: int, tilt_deg: float, width: int | None, height: int | None, displaced: Floats | None = None
    ) -> None:
        self.rig = rig
        self.camera: Camera = rig.lens.camera(width, height)
        self.scanner = scanner(rig.scanner, rig.rate)
        self.T_base_lidar = rig.lidar.pose()
        self.T_base_camera = rig.T_base_camera(seed, tilt_deg)
        if displaced is not None:
            self.T_base_lidar, self.T_base_camera = displaced @ self.T_base_lidar, displaced @ self.T_base_camera
        self.T_base_frame: Floats = np.eye(4) if rig.base_frame else self.T_base_lidar
        self.reference = np.asarray(se3.inverse(self.T_base_camera) @ self.T_base_frame)
        self.frame = "base_link" if rig.base_frame else "lidar"
        self._solids = ego.body(rig.vehicle)
        # The ride is that of a scanner above the origin of the vehicle's frame.
        self._T_ride_base = se3.from_parts(np.eye(3), [0.0, 0.0, -LIDAR_HEIGHT])

    def pose(self, ride: Floats, T_base: Floats) -> Floats:
        """The pose (4, 4) of a frame that lies at T_base (4, 4) on the vehicle, from that of the ride (4, 4)."""
        return np.asarray(ride @ self._T_ride_base @ T_base)

    def twist(self, ride: Floats, T_base: Floats) -> Floats:
        """The twist (6,) of the ride in such a frame."""
        return in_frame(ride, self._T_ride_base @ T_base)

    @property
    def image_delay(self) -> float:
        """Seconds from the cloud's stamp to the picture: a triggered camera waits until the scan sweeps its axis."""
        return sweep_s(self.T_base_lidar, self.T_base_camera, self.rig.rate) if self.rig.triggered else 0.0

    def view(self, camera: Camera) -> CameraView:
        """The pixels of a camera: the rig's, or one given instead of it."""
        if camera == self.camera and camera.model not in PERSPECTIVE:
            return WideView(camera, self.rig.lens.field)
        return CameraView(camera)

    @cached_property
    def own_returns(self) -> OwnReturns | None:
        """What the scanner hits of the vehicle; a pattern that never repeats has none of it, for that is near its blind zone."""
        if self._solids is None or isinstance(self.scanner, RosetteScanner):
            return None
        return own_returns(self._solids, self.scanner.beams()[0], self.T_base_lidar)

    def own_layer(self, view: CameraView, T_camera_frame: Floats) -> ego.OwnLayer | None:
        """What a camera mounted at T_camera_frame (4, 4) sees of the vehicle."""
        if self._solids is None:
            return None
        return ego.own_layer(self._solids, view, self.T_base_frame @ se3.inverse(T_camera_frame))

    def delivered(
        self, cloud: PointCloud, twist: Floats, fields: Fields, rng: np.random.Generator
    ) -> tuple[PointCloud, NDArray[np.intp]]:
        """A scan as the driver or the data set hands it out, and which of its points (n,) are left.

        cloud: in the frame of the moving scanner; twist: (6,) of the scanner.
        """
        xyz = cloud.xyz.astype(float)
        intensity = self._intensity(cloud, rng)
        if self.rig.compensated and cloud.time is not None:
            xyz = _compensated(xyz, twist, cloud.time.astype(float))
        base = se3.transform(self.T_base_lidar, xyz)
        keep = np.flatnonzero(np.abs(base[:, 1]) <= self.rig.crop)
        if self.rig.base_frame:
            xyz = base
        left_out = ("time", "ring", "intensity")[: list(Fields).index(fields)]
        whole = replace(cloud, xyz=xyz.astype(np.float32), intensity=intensity)
        return replace(whole, **dict.fromkeys(left_out)).select(keep), keep  # type: ignore[arg-type]

    def _intensity(self, cloud: PointCloud, rng: np.random.Generator) -> NDArray[np.float32]:
        assert cloud.intensity is not None
        unit = cloud.intensity
        if self.rig.intensity is Intensity.BYTE:
            return np.rint(255 * unit).astype(np.float32)
        if self.rig.intensity is Intensity.SIGNAL:
            squared = np.square(cloud.xyz).sum(axis=1)
            photons = SIGNAL * 100.0 * unit / np.maximum(squared, 1.0)
            return np.asarray(rng.poisson(np.minimum(photons, 60_000.0)), np.float32)
        if self.rig.intensity is Intensity.WIDE:
            return np.asarray(np.where(unit > 0.97, BRIGHTEST * rng.random(len(unit)) ** 3, unit), np.float32)
        return unit


def sweep_s(T_base_lidar: Floats, T_base_camera: Floats, rate: float) -> float:
    """From a scan's stamp to when it sweeps a camera's axis. Poses (4, 4); rate: turns per second."""
    axis = (T_base_lidar[:3, :3].T @ T_base_camera[:3, 2])[:2]
    return float(-np.arctan2(axis[1], axis[0]) / (2 * np.pi * rate))


def _compensated(xyz: Floats, twist: Floats, time: Floats) -> Floats:
    """Points (n, 3) measured at time (n,) s, where they are in the scanner's frame at time 0."""
    if not twist.any() or not len(time):
        return xyz
    knots = np.linspace(time.min(), time.max(), 65)
    motion = np.array([se3.exp(twist * s)[:3] for s in knots])
    at = make_interp_spline(knots, motion, k=1)(time)
    return np.asarray(np.einsum("nij,nj->ni", at[:, :, :3], xyz) + at[:, :, 3])
