"""Recordings of several cameras and LiDARs: the descriptions that they are opened by, and pairs of sensors as views of them."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from dataclasses import dataclass
from itertools import combinations, product
from typing import Any, Protocol

import numpy as np
import yaml

from calib_ros import se3
from calib_ros.arrays import Covariance, Transform
from calib_ros.camera import Camera
from calib_ros.datasets.recent import Recent, Timed
from calib_ros.datasets.source import Source
from calib_ros.errors import BadInputError

CAMERA, LIDAR = KINDS = "camera", "lidar"  # of sensors
# As the default search box of the registration: what mounting by a drawing leaves open.
SIGMA_DEG, SIGMA_M = 3.0, 0.2
KEPT_CLOUDS = 32  # about 100 MB
SHOWN_DIGITS = 6  # of priors: micrometres


class RigSource(Protocol):
    """The recording of a rig: every pair of a camera and a LiDAR is a Source of its own. What several of them need is read once,
    as long as it is among the newest. BadInputError or KeyError for names that are none of its sensors."""

    name: str  # for display
    cameras: tuple[str, ...]  # names
    lidars: tuple[str, ...]
    reference_sensor: str  # that `reference` is relative to

    def camera(self, name: str) -> Camera:
        """The intrinsics of a camera."""

    def frame_id(self, name: str) -> str:
        """TF frame of a sensor."""

    def reference(self, name: str) -> Transform | None:
        """T_reference_sensor (4, 4) of a sensor as the recording states it at its beginning; None if unknown."""

    def pair(self, camera: str, lidar: str) -> Source:
        """Images of a camera with the scans of a LiDAR that are next to them; the reference is T_camera_lidar."""

    def scans(self, lidar: str) -> Timed:
        """All scans of a LiDAR with their stamps, ns, in time."""


class RecordedRig(RigSource, Protocol):
    """A rig whose images can be read for themselves, so that all of it can be written to a bag."""

    def pictures(self, camera: str) -> Timed:
        """All images of a camera with their stamps, ns, in time."""

    def prior(self, name: str) -> Transform:
        """T_reference_sensor (4, 4) as somebody who mounts the sensors believes it."""


@dataclass(frozen=True, eq=False)
class Sensor:
    """A sensor of a rig.

    kind: camera or lidar. topic: of a bag, else the recording's own name of it, "" = `name`. camera_info: its topic. frame: of
    TF, "" = as recorded. prior: T_reference_sensor (4, 4); None = as the recording states it. sigma_deg, sigma_m: standard
    deviations of the prior along every axis. mask: image file of what a camera's pictures leave out, "" = none.
    """

    name: str
    kind: str
    topic: str = ""
    camera_info: str = ""
    frame: str = ""
    prior: Transform | None = None
    sigma_deg: float = SIGMA_DEG
    sigma_m: float = SIGMA_M
    mask: str = ""

    def believed(self, T: Transform) -> tuple[Transform, Covariance]:
        """T_reference_sensor (4, 4) as its prior, with the covariance (6, 6) of a left twist, rad and m."""
        return T, prior_covariance(T, self.sigma_deg, self.sigma_m)


@dataclass(frozen=True, eq=False)
class RigDescription:
    """The sensors of a rig. reference: the one whose frame the others are stated in. pairs: those to be registered; None = all
    that share a view by their priors."""

    sensors: tuple[Sensor, ...]
    reference: str
    pairs: tuple[tuple[str, str], ...] | None = None

    def __getitem__(self, name: str) -> Sensor:
        """The sensor of a name. KeyError if there is none."""
        return {sensor.name: sensor for sensor in self.sensors}[name]

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(sensor.name for sensor in self.sensors if sensor.kind == CAMERA)

    @property
    def lidars(self) -> tuple[str, ...]:
        """Names of the LiDARs."""
        return tuple(sensor.name for sensor in self.sensors if sensor.kind == LIDAR)

    @property
    def lidar_pairs(self) -> list[tuple[str, str]]:
        """The pairs of two LiDARs."""
        return [pair for pair in self.pairs or combinations(self.lidars, 2) if self[pair[0]].kind == LIDAR]

    @property
    def camera_pairs(self) -> list[tuple[str, str]]:
        """The pairs of a camera and a LiDAR, whether they share a view or not where no pairs are given."""
        return [pair for pair in self.pairs or product(self.cameras, self.lidars) if self[pair[0]].kind == CAMERA]


def rig_yaml(description: RigDescription) -> str:
    """rig.yaml of a description. A sensor without a prior is to be looked up in the recording."""
    sensors: dict[str, Any] = {}
    for own in description.sensors:
        texts = {key: getattr(own, key) for key in ("kind", "topic", "camera_info", "frame", "mask")}
        sensors[own.name] = {key: value for key, value in texts.items() if value}
        if own.prior is not None and own.name != description.reference:
            parts = {"translation_m": own.prior[:3, 3], "quaternion_xyzw": se3.quaternion_from_rotation(own.prior[:3, :3])}
            sensors[own.name]["prior"] = {key: [round(float(v), SHOWN_DIGITS) for v in values] for key, values in parts.items()}
        sigmas = {"sigma_deg": (own.sigma_deg, SIGMA_DEG), "sigma_m": (own.sigma_m, SIGMA_M)}
        sensors[own.name] |= {key: value for key, (value, usual) in sigmas.items() if value != usual}
    pairs = {} if description.pairs is None else {"pairs": [list(pair) for pair in description.pairs]}
    content = {"reference": description.reference, "sensors": sensors, **pairs}
    return str(yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=200))


def prior_covariance(T: Transform, sigma_deg: float, sigma_m: float) -> Covariance:
    """Covariance (6, 6) of a left twist of T (4, 4), rad and m: the sensor turns about itself, whatever its lever arm is."""
    to_twist = np.linalg.inv(se3.parts_jacobian(T))
    variances = np.repeat([np.deg2rad(sigma_deg) ** 2, sigma_m**2], 3)
    return np.asarray(to_twist * variances @ to_twist.T)


class DescribedRig(ABC):
    """A recording by a description of its sensors, as of `RigSource`; of one LiDAR, unless it is said otherwise."""

    def __init__(self, name: str, description: RigDescription) -> None:
        self.name, self.reference_sensor = name, description.reference
        self.sensors = {sensor.name: sensor for sensor in description.sensors}
        self.cameras, self.lidars = description.cameras, description.lidars
        self._recent = Recent(KEPT_CLOUDS)
        self._pairs: dict[tuple[str, str], Any] = {}

    @abstractmethod
    def open_pair(self, camera: Sensor, lidar: Sensor) -> Any:
        """The source of a pair, when it is asked for first."""

    def lidar_of(self, name: str) -> str | None:
        """The LiDAR that the reference of a sensor's source is to; None if that is not said."""
        return name if name in self.lidars else self.lidars[0] if len(self.lidars) == 1 else None

    def camera(self, name: str) -> Camera:
        """As of any rig."""
        camera: Camera = self._usual_pair(name).camera
        return camera

    def frame_id(self, name: str) -> str:
        """By the description, else as of any rig."""
        source = self._usual_pair(self.cameras[0] if name in self.lidars else name)
        return self.sensors[name].frame or str(source.lidar_frame if name in self.lidars else source.camera_frame)

    def reference(self, name: str) -> Transform | None:
        """As of any rig; None of sensors which no calibration joins to the reference. Of nuScenes and KITTI objects, of the first
        frames."""
        if (lidar := self.lidar_of(name)) is None or lidar != self.lidar_of(self.reference_sensor):
            return None
        both = self.reference_sensor, name
        base, own = (np.eye(4) if of in self.lidars else self.pair(of, lidar).reference for of in both)
        return None if base is None or own is None else np.asarray(base @ se3.inverse(own))

    def pair(self, camera: str, lidar: str) -> Any:
        """As of any rig."""
        if (camera, lidar) not in self._pairs:
            source = self.open_pair(self.sensors[camera], self.sensors[lidar])
            if hasattr(source, "recent"):
                source.recent = self._recent
            self._pairs[camera, lidar] = source
        return self._pairs[camera, lidar]

    def scans(self, lidar: str) -> Timed:
        """As of any rig."""
        source = self.pair(self.cameras[0], lidar)
        if hasattr(source, "scans"):
            own: Timed = source.scans()
            return own
        stamps = np.array([source[k].moment_of_cloud for k in range(len(source))], np.int64)
        return Timed(stamps, lambda k: source[k].cloud)

    def _usual_pair(self, camera: str) -> Any:
        return self.pair(camera, self.lidar_of(camera) or self.lidars[0])


class ChosenSensors(DescribedRig):
    """Some sensors of a rig, under the names of a description."""

    def __init__(self, rig: RigSource, description: RigDescription) -> None:
        super().__init__(rig.name, description)
        self.rig = rig
        self._own: dict[str, str] = {}
        for sensor in description.sensors:
            names = rig.cameras if sensor.kind == CAMERA else rig.lidars
            found = [name for name in (sensor.topic, sensor.name) if name in names]
            if not found:
                raise BadInputError(
                    f"{rig.name} has no {sensor.kind} {sensor.name}; name by topic one that it has: {', '.join(names) or 'none'}"
                )
            self._own[sensor.name] = found[0]

    def open_pair(self, camera: Sensor, lidar: Sensor) -> Source:
        """That of the rig."""
        return self.rig.pair(self._own[camera.name], self._own[lidar.name])

    def camera(self, name: str) -> Camera:
        """As of any rig."""
        return self.rig.camera(self._own[name])

    def frame_id(self, name: str) -> str:
        """As of any rig."""
        return self.sensors[name].frame or self.rig.frame_id(self._own[name])

    def reference(self, name: str) -> Transform | None:
        """As of any rig."""
        base, own = self.rig.reference(self._own[self.reference_sensor]), self.rig.reference(self._own[name])
        return None if base is None or own is None else np.asarray(se3.inverse(base) @ own)

    def scans(self, lidar: str) -> Timed:
        """As of any rig."""
        return self.rig.scans(self._own[lidar])


def ros_name(text: str) -> str:
    """What a name of ROS can be made of."""
    name = re.sub(r"[^A-Za-z0-9]+", "_", text).strip("_")
    return name if re.match("[A-Za-z]", name) else f"sensor_{name}"
