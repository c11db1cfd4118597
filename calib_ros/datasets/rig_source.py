"""The protocol of recordings of several cameras and LiDARs, and of the descriptions that they are opened by."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from calib_ros.arrays import Transform
from calib_ros.camera import Camera
from calib_ros.datasets.recent import Timed
from calib_ros.datasets.source import Source

CAMERA = "camera"  # kind of a sensor; others are LiDARs
KEPT_CLOUDS = 32  # about 100 MB


class RigSource(Protocol):
    """The recording of a rig: every pair of a camera and a LiDAR is a Source of its own. What several of them need is read once,
    as long as it is among the newest. BadInputError or KeyError for names that are none of its sensors."""

    @property
    def name(self) -> str:
        """For display."""

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras."""

    @property
    def lidars(self) -> tuple[str, ...]:
        """Names of the LiDARs."""

    @property
    def reference_sensor(self) -> str:
        """The sensor that `reference` is relative to."""

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


class DescribedSensor(Protocol):
    """What is asked of a sensor of a description. prior: T_reference_sensor (4, 4), None = as recorded."""

    @property
    def name(self) -> str: ...
    @property
    def kind(self) -> str: ...
    @property
    def topic(self) -> str: ...
    @property
    def camera_info(self) -> str: ...
    @property
    def frame(self) -> str: ...
    @property
    def prior(self) -> Transform | None: ...


class DescribedRig(Protocol):
    """What is asked of a description of a rig."""

    @property
    def sensors(self) -> Sequence[DescribedSensor]: ...
    @property
    def reference(self) -> str: ...


class ByDescription:
    """What rigs that are opened by a description have in common."""

    def __init__(self, name: str, description: DescribedRig) -> None:
        self.name, self.reference_sensor = name, description.reference
        self.sensors = {sensor.name: sensor for sensor in description.sensors}
        self.cameras = tuple(sensor.name for sensor in description.sensors if sensor.kind == CAMERA)
        self.lidars = tuple(sensor.name for sensor in description.sensors if sensor.kind != CAMERA)
