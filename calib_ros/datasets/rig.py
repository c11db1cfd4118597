"""Opening the recording of several cameras and LiDARs by the description of its sensors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from calib_ros import se3
from calib_ros.arrays import Transform
from calib_ros.camera import Camera
from calib_ros.datasets.folder_rig import FolderRig, is_folder_rig
from calib_ros.datasets.kitti import KittiSource
from calib_ros.datasets.nuscenes import NuScenesSource
from calib_ros.datasets.open import is_bag, open_dataset
from calib_ros.datasets.recent import Recent, Timed
from calib_ros.datasets.rig_source import (
    CAMERA,
    KEPT_CLOUDS,
    ByDescription,
    DescribedRig,
    DescribedSensor,
    RecordedRig,
    RigSource,
)
from calib_ros.datasets.source import Source
from calib_ros.errors import BadInputError
from calib_ros.extensions import RIGS, source_of

__all__ = ["RecordedRig", "RigSource", "named_rig", "open_rig"]


def open_rig(path_or_text: str | Path, description: DescribedRig, **options: Any) -> RigSource:
    """Open the recording of the rig that is described: a bag by the topics of its sensors; or a synthetic rig, nuScenes, KITTI or
    plain folders, where `topic` is the recording's own name of a sensor (nuScenes: channel; KITTI: number of the camera; plain
    folders: see `FolderRig`), by default its name.

    options : of a bag, see `BagSource`: tolerance_s, rectified, motion, windows, clock, incomplete.

    Raises BadInputError for other recordings, and for sensors that the recording does not have.
    """
    text, path = str(path_or_text), Path(path_or_text).expanduser()
    if not path.exists() and (rig := named_rig(text)) is not None:
        return ChosenSensors(rig, description)
    if path.exists() and is_bag(path):
        from calib_ros.datasets.bag_rig import BagRig

        return BagRig(path, description, **options)
    if is_folder_rig(path, description):
        return FolderRig(path, description)
    return OneLidarRig(text, description)


def named_rig(text: str) -> RecordedRig | None:
    """The rig that another package brings by its name, as "synthetic:rig=..."; None where the text is something else."""
    opened_by_name = None if Path(text).expanduser().exists() else source_of(text, RIGS)
    rig: RecordedRig | None = None if opened_by_name is None else opened_by_name(text)
    return rig


class ChosenSensors(ByDescription):
    """Some sensors of a rig, under the names of a description."""

    def __init__(self, rig: RigSource, description: DescribedRig) -> None:
        super().__init__(rig.name, description)
        self.rig = rig
        self._own = {sensor.name: _own_name(sensor, rig) for sensor in description.sensors}

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

    def pair(self, camera: str, lidar: str) -> Source:
        """As of any rig."""
        return self.rig.pair(self._own[camera], self._own[lidar])

    def scans(self, lidar: str) -> Timed:
        """As of any rig."""
        return self.rig.scans(self._own[lidar])


def _own_name(sensor: DescribedSensor, rig: RigSource) -> str:
    names = rig.cameras if sensor.kind == CAMERA else rig.lidars
    found = [name for name in (sensor.topic, sensor.name) if name in names]
    if not found:
        raise BadInputError(
            f"{rig.name} has no {sensor.kind} {sensor.name}; name by topic one that it has: {', '.join(names) or 'none'}"
        )
    return found[0]


class OneLidarRig(ByDescription):
    """KITTI or nuScenes: several cameras around one LiDAR."""

    def __init__(self, text: str, description: DescribedRig) -> None:
        super().__init__(text, description)
        if len(self.lidars) != 1 or not self.cameras:
            raise BadInputError(
                f"{text} has one LiDAR, but the description has {len(self.lidars)} and {len(self.cameras)} cameras; "
                "list the LiDAR and one camera or more"
            )
        recent = Recent(KEPT_CLOUDS)
        self._sources: dict[str, KittiSource | NuScenesSource] = {}
        for name in self.cameras:
            source = open_dataset(text, self.sensors[name].topic or name)
            if not isinstance(source, (KittiSource, NuScenesSource)):
                raise BadInputError(
                    f"{text} is no recording of a rig; give a bag, KITTI, nuScenes, synthetic:rig=NAME, or folders of cameras"
                )
            source.recent = recent
            self._sources[name] = source

    def camera(self, name: str) -> Camera:
        """As of any rig."""
        return self._sources[name].camera

    def frame_id(self, name: str) -> str:
        """As of any rig."""
        own = self._first.lidar_frame if name in self.lidars else self._sources[name].camera_frame
        return self.sensors[name].frame or own

    def reference(self, name: str) -> Transform | None:
        """As of any rig; of nuScenes and KITTI objects, of the first frames."""
        base, own = (np.eye(4) if of in self.lidars else self._sources[of].reference for of in (self.reference_sensor, name))
        return np.asarray(base @ se3.inverse(own))

    def pair(self, camera: str, lidar: str) -> Source:
        """As of any rig."""
        self.lidars.index(lidar)
        return self._sources[camera]

    def scans(self, lidar: str) -> Timed:
        """As of any rig."""
        return self._first.scans()

    @property
    def _first(self) -> KittiSource | NuScenesSource:
        return self._sources[self.cameras[0]]
